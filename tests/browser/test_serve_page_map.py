"""The map of the page of ``aerokit serve``, in headless Chromium (`nox -s browser`)."""

from __future__ import annotations

import contextlib
import struct
import threading
import zlib
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from page_stage import CHROMIUM, opened, serving

from aerokit.sim import SimulatedCopter

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium"), pytest.mark.timeout(300)]

Copters = tuple[list[SimulatedCopter], str]

# Replaces the map of the page by `view`, which draws what the test gives to `show`.
OWN_MAP = """async () => {
    const { MapView } = await import("/static/map.js"), node = document.getElementById("map").cloneNode();
    document.getElementById("map").replaceWith(node);
    const picked = (position) => { window.picked = position; }, chosen = (id) => { window.chosen = id; };
    window.view = new MapView(node, { picked, chosen, changed() {} });
    const fence = { polygons: [], circles: [], rally: [] };
    window.show = (vehicles, items = []) => view.draw(vehicles, 1, { items, current: null }, null, fence);
    window.boxes = (selector) => [...node.querySelectorAll(selector)].map((each) => each.getBoundingClientRect())
        .map(({ left, top, right, bottom }) => [left, top, right, bottom]);
}"""


@pytest.fixture(params=[(1360, 820), (390, 844)], ids=["desk", "phone"])
def own_map(request: Any, browser: Any, copters: Copters) -> Iterator[Any]:
    with serving(copters[1]) as server, opened(browser, server["page"], *request.param) as page:
        page.evaluate(OWN_MAP)
        yield page


# Waits until the page has shown newer values twice.
DRAWN_TWICE = """() => new Promise((done) => {
    let count = 0;
    const observer = new MutationObserver(() => { if (++count === 2) { observer.disconnect(); done(); } });
    observer.observe(document.getElementById("panel"), { subtree: true, childList: true, characterData: true });
})"""


def box_of_map(page: Any) -> list[float]:
    box = page.locator("#map").bounding_box()
    return [box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]]


def center(box: list[float]) -> tuple[float, float]:
    left, top, right, bottom = box
    return (left + right) / 2, (top + bottom) / 2


def test_map_labels_do_not_overlap(own_map: Any) -> None:
    boxes = own_map.evaluate("""() => {
        const at = (east) => ({ latitude_deg: -35.36, longitude_deg: 149.165 + east * 1e-6 });
        show([1, 2, 3, 4].map((id) => ({ id, position: at(id), age: 0, heading: 0,
            labels: [`${id} · STABILIZE · 10.0 m`, `${id} · 10.0 m`, String(id)] })));
        return boxes(".label");
    }""")
    assert len(boxes) == 4
    map_left, _, map_right, _ = box_of_map(own_map)
    for index, (left, top, right, bottom) in enumerate(boxes):
        assert map_left <= left <= right <= map_right
        for other in boxes[:index]:
            assert left > other[2] or other[0] > right or top > other[3] or other[1] > bottom


def test_fitted_map_is_left_of_zoom_buttons(own_map: Any) -> None:
    marks = own_map.evaluate("""() => {
        const at = (east) => ({ latitude_deg: -35.36, longitude_deg: 149.165 + east * 1e-5 });
        const vehicle = { id: 1, position: at(100), home: at(100), age: 0, heading: 0, labels: ["1"] };
        show([vehicle], [{ index: 0, position: at(0) }]);
        return boxes(".craft, .disc");
    }""")
    left, right = min(box[0] for box in marks), max(box[2] for box in marks)
    assert box_of_map(own_map)[0] < left < right < own_map.locator("#map-tools").bounding_box()["x"]
    assert right - left > 150


def test_map_shows_both_sides_of_antimeridian(own_map: Any) -> None:
    home, craft = own_map.evaluate("""() => {
        const at = (longitude_deg) => ({ latitude_deg: 51.9, longitude_deg });
        view.addPoint(1, at(179.9995), false);
        view.addPoint(1, at(-179.9995), false);
        show([{ id: 1, position: at(-179.9995), home: at(179.9995), age: 0, heading: 90, labels: ["1"] }]);
        return [...boxes(".home"), ...boxes(".craft")];
    }""")
    map_left, _, map_right, _ = box_of_map(own_map)
    assert map_left < center(home)[0] < center(craft)[0] < map_right
    own_map.evaluate("view.isPicking = true")
    own_map.mouse.click(center(craft)[0] + 1, center(craft)[1])
    assert own_map.evaluate("picked.longitude_deg") == pytest.approx(-179.9995, abs=1e-4)
    assert own_map.evaluate("picked.latitude_deg") == pytest.approx(51.9, abs=1e-4)


def test_map_with_gap_draws_no_line_across_it(own_map: Any) -> None:
    moves = own_map.evaluate("""() => {
        const at = (east) => ({ latitude_deg: -35.36, longitude_deg: 149.165 + east * 1e-5 });
        for (const east of [0, 10, 20]) view.addPoint(1, at(east), east === 20);
        view.addPoint(1, at(30), false);
        show([{ id: 1, position: at(30), age: 0, heading: 0, labels: ["1"] }]);
        return document.querySelector("#map .track").getAttribute("d").match(/M/g).length;
    }""")
    assert moves == 2


def test_click_with_unsteady_hand_picks_target(own_map: Any) -> None:
    x, y = own_map.evaluate("""() => {
        const at = (east) => ({ latitude_deg: -35.36, longitude_deg: 149.165 + east * 1e-5 });
        show([1, 2].map((id) => ({ id, position: at(id * 100), home: at(0), age: 0, heading: 0, labels: ["1"] })));
        view.isPicking = true;
        const [left, top, right, bottom] = boxes(".craft")[0];
        return [(left + right) / 2, (top + bottom) / 2];
    }""")
    for east, south in ((0, 0), (3, 3)):
        own_map.evaluate("window.picked = window.chosen = null")
        own_map.mouse.move(x, y)
        own_map.mouse.down()
        own_map.mouse.move(x + east, y + south)
        own_map.mouse.up()
        assert own_map.evaluate("[picked !== null, chosen]") == [True, None]
    own_map.evaluate("view.isPicking = false")
    own_map.mouse.click(x + 5, y - 5)
    assert own_map.evaluate("chosen") == 1  # the selected vehicle is drawn first


def test_plan_begins_and_ends_at_home(own_map: Any) -> None:
    """The take-off and the return have no position of their own."""
    for last, count in (("NAV_RETURN_TO_LAUNCH", 3), ("NAV_LAND", 2)):
        points = own_map.evaluate(
            """(last) => {
                const at = (east) => ({ latitude_deg: -35.36, longitude_deg: 149.165 + east * 1e-5 });
                const items = [["NAV_TAKEOFF", null], ["NAV_WAYPOINT", at(100)], [last, null]];
                show([{ id: 1, position: at(0), home: at(0), age: 0, heading: 0, labels: ["1"] }],
                    items.map(([name, position], index) => ({ name, position, index })));
                return document.querySelector("#map .plan").getAttribute("d").split(/[ML]/).length - 1;
            }""",
            last,
        )
        assert points == count


def test_zoomed_and_dragged_map_is_not_fitted_again(browser: Any, copters: Copters) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)
        box = page.locator("#map").bounding_box()
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

        def place(mark: str = ".home") -> tuple[float, float]:
            page.evaluate(DRAWN_TWICE)
            found = page.locator(f"#map {mark}").first.bounding_box()
            return found["x"] + found["width"] / 2, found["y"] + found["height"] / 2

        fitted = place()
        page.mouse.move(round(fitted[0]), round(fitted[1]))
        page.mouse.wheel(0, -60)
        assert place() == pytest.approx(fitted, abs=3)  # the position under the mouse stays where it is
        page.mouse.move(*middle)
        page.mouse.down()
        page.mouse.move(middle[0] + 60, middle[1] + 40, steps=5)
        page.mouse.up()
        dragged = place()  # a little further, because the map glides on
        assert dragged[0] > fitted[0] + 55
        assert dragged[1] > fitted[1] + 35
        page.locator("#map").focus()
        page.keyboard.press("ArrowLeft")
        assert place()[0] > dragged[0] + 40
        page.click("#follow")
        assert place(".craft.selected") == pytest.approx(middle, abs=3)
        page.click("#fit")
        assert place() == pytest.approx(fitted, abs=3)


def test_map_shows_tiles_of_configured_server(browser: Any, copters: Copters) -> None:
    with tile_server() as (address, paths):
        tiles = ["--tiles", address + "/{z}/{x}/{y}.png", "--attribution", "© <b>Test</b>"]
        with serving(copters[1], *tiles) as server, opened(browser, server["page"]) as page:
            page.locator("#map.tiled .leaflet-tile-loaded").first.wait_for()
            page.locator("#attribution", has_text="© <b>Test</b>").wait_for()
            page.locator("#map .grid").wait_for(state="attached")
    assert all(path.count("/") == 3 and path.endswith(".png") for path in paths)


@contextlib.contextmanager
def tile_server() -> Iterator[tuple[str, list[str]]]:
    """Serve one grey pixel for every tile."""
    paths: list[str] = []

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0)
    pixel = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0\x80")) + chunk(b"IEND", b"")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            paths.append(self.path)
            self.send_response(200)
            self.send_header("Content-Type", "image/png")
            self.end_headers()
            self.wfile.write(b"\x89PNG\r\n\x1a\n" + pixel)

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the name in the base class
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", paths
        finally:
            server.shutdown()
            thread.join()
