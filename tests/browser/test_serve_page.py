"""The page of ``aerokit serve`` in headless Chromium (`nox -s browser`); skipped where one is missing.

With AEROKIT_SCREENSHOTS=DIRECTORY it leaves pictures of the page there.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from anyio.from_thread import start_blocking_portal
from served_copter import served

import aerokit
from aerokit.missions import (
    Fence,
    FencePolygon,
    Mission,
    Plan,
    format_plan,
    format_waypoints,
    return_to_launch,
    take_off,
    waypoint,
)
from aerokit.sim import SimulatedCopter
from aerokit.sim.motion import GlobalPoint, LocalFrame
from aerokit.testing.track import true_point

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is installed by `nox -s browser`")
axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is installed by `nox -s browser`")
CHROMIUM = os.environ.get("AEROKIT_CHROMIUM") or shutil.which("chromium")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium"),
    pytest.mark.timeout(300),
]

HOME = (-35.363261, 149.165230, 584.0)
HOSTILE = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    quiet = [
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ]
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-quic", *quiet]
        )
        yield chromium
        chromium.close()


@contextlib.contextmanager
def serving(*arguments: str) -> Iterator[dict[str, Any]]:
    command = [sys.executable, "-m", "aerokit", "serve", *arguments, "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())
        finally:
            process.terminate()
            assert process.wait(10) == 0


@pytest.fixture(scope="module")
def copters() -> Iterator[tuple[list[SimulatedCopter], str]]:
    frame = LocalFrame(GlobalPoint(round(HOME[0] * 1e7), round(HOME[1] * 1e7), HOME[2]))
    made = []
    for number in (1, 2):
        place = frame.to_global(0.0, 25.0 * (number - 1), 0.0)
        made.append(
            SimulatedCopter(
                system_id=number,
                home=(place.latitude_e7 / 1e7, place.longitude_e7 / 1e7, HOME[2]),
                boot_time_s=0.0,
            )
        )
    with served(made, speedup=4.0) as address:
        with start_blocking_portal() as portal:  # this thread has playwright's loop
            portal.call(upload, address)
        yield made, address


async def upload(address: str) -> None:
    async with aerokit.connect(address, system_id=1) as vehicle:
        await vehicle.wait_ready()
        here = vehicle.position.value
        corners = [here.offset(north_m=n, east_m=e) for n, e in ((70, -20), (80, 60), (30, 95), (-15, 50))]
        items = [waypoint(at.latitude_deg, at.longitude_deg, altitude_relative_m=20) for at in corners]
        await vehicle.mission.upload(Mission([take_off(altitude_relative_m=20), *items, return_to_launch()]))


@contextlib.contextmanager
def opened(browser: Any, url: str, wide: int = 1360, high: int = 820, scheme: str = "dark") -> Iterator[Any]:
    """A page, which at the end must have had no mistake, no foreign request and nothing refused by its policy."""
    mistakes: list[str] = []
    context = browser.new_context(viewport={"width": wide, "height": high}, color_scheme=scheme)
    page = context.new_page()
    page.set_default_timeout(10_000)
    page.on("pageerror", lambda error: mistakes.append(str(error)))
    page.on("console", lambda each: mistakes.append(each.text) if each.type == "error" else None)
    page.on("dialog", lambda each: mistakes.append(each.message))
    page.on("request", lambda each: mistakes.append(each.url) if "//127.0.0.1:" not in each.url else None)
    page.goto(url)
    page.wait_for_selector(".vehicle[aria-pressed=true]")
    yield page
    assert [each for each in mistakes if "Failed to load resource" not in each] == []  # refused orders
    context.close()


def picture(page: Any, name: str) -> None:
    if directory := os.environ.get("AEROKIT_SCREENSHOTS"):
        page.screenshot(path=str(Path(directory) / f"{name}.png"))


def order(page: Any, name: str, fields: dict[str, str] | None = None) -> None:
    page.click(f"button[data-order='{name}']")
    for field, value in (fields or {}).items():
        page.fill(f"dialog input[name={field}]", value)
    page.click("dialog .yes")


def wait_done(page: Any, text: str) -> None:
    page.locator(".toast.done", has_text=text).first.wait_for(timeout=60_000)


def test_page_commands_flight(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    (first, second), address = copters
    with serving(address) as server, opened(browser, server["page"]) as page:
        assert server["token"] not in page.url  # it was taken out of the address
        page.get_by_role("tab", name="Mission").click()
        page.locator("#panel tr").nth(5).wait_for()
        assert page.locator("#tiles-of-state dd > span").first.inner_text() == "STABILIZE"

        places = boxes_of_orders(page)
        take_off = page.locator("button[data-order='take_off']")
        assert (take_off.is_disabled(), take_off.locator("small").inner_text()) == (True, "Arm first")
        page.click("button[data-order='arm']")
        assert "Vehicle 1" in page.locator("dialog .target").inner_text()
        picture(page, "dialog")
        page.click("dialog button >> text=Cancel")
        assert not first.is_armed

        order(page, "arm")
        wait_done(page, "arm")
        assert (first.is_armed, second.is_armed) == (True, False)
        order(page, "take_off", {"altitude_m": "20"})
        disarm = page.locator("button[data-order='disarm']")
        page.locator("button[data-order='disarm'][disabled]").wait_for()
        seen = set()
        while not page.locator(".toast.done", has_text="take off to 20 m: done").count():
            if true_point(first).altitude_m > 1:
                seen.add((disarm.is_disabled(), disarm.locator("small").inner_text()))
        assert seen == {(True, "Land first")}
        wait_done(page, "Vehicle 1: take off to 20 m: done")
        assert boxes_of_orders(page) == places
        assert_toasts_beside_orders(page)
        values_have_units(page)
        order(page, "mission/start")
        wait_done(page, "Vehicle 1: mission started at item 0")
        for name in ("mission/start", "mission/resume"):
            button = page.locator(f"button[data-order='{name}'][disabled]")
            button.wait_for()
            assert button.locator("small").inner_text() == "Running"
        assert page.locator("button[data-order='mission/pause']").is_enabled()
        page.locator("tr.current", has_text=re.compile("^[34]")).wait_for(timeout=90_000)
        picture(page, "mission")
        fly_to_a_click(page, first)
        order(page, "land")
        wait_done(page, "land")
        page.get_by_role("tab", name="Orders").click()
        page.locator("#panel .text", has_text="go to: latitude -35.").wait_for()  # it is drawn with the next frame
        picture(page, "orders")
        with page.expect_response("**/api/vehicles/1/track") as track:
            page.reload()
        assert len(track.value.json()["points"]) > 20


def boxes_of_orders(page: Any) -> list[Any]:
    return list(page.locator("#orders button").evaluate_all("all => all.map(e => e.getBoundingClientRect().toJSON())"))


def assert_toasts_beside_orders(page: Any) -> None:
    orders, toasts = page.locator("#orders").bounding_box(), page.locator("#toasts").bounding_box()
    assert toasts["y"] + toasts["height"] <= orders["y"] or orders["y"] + orders["height"] <= toasts["y"]


def values_have_units(page: Any) -> None:
    page.get_by_role("tab", name="State").click()
    rows = dict(
        page.locator("#panel tbody tr").evaluate_all(
            "rows => rows.map(r => [...r.cells].map(c => c.innerText).slice(0, 2))"
        )
    )
    metres, speed = r"-?\d+\.\d\d m", r"-?\d+\.\d\d m/s"
    local = rf"north {metres} · east {metres} · down {metres} · north {speed} · east {speed} · down {speed}"
    assert re.fullmatch(local, rows["local position"]), rows["local position"]
    assert re.search(r"voltage \d+\.\d\d V", rows["batteries"])
    assert re.match(r"latitude -35\.\d{6} °", rows["position"])
    assert re.fullmatch(r"\d+\.\d °", rows["heading"])
    assert rows["mode"] == "GUIDED"
    picture(page, "state")
    page.set_viewport_size({"width": 1300, "height": 820})
    page.evaluate("document.querySelectorAll('#tiles-of-state dd > span')[7].textContent = '10 · RTK fixed (12 s)'")
    assert page.locator("#tiles-of-state dd").evaluate_all("all => all.every(e => e.scrollWidth <= e.clientWidth)")
    picture(page, "narrow")
    page.set_viewport_size({"width": 1360, "height": 820})
    page.get_by_role("tab", name="Mission").click()


def fly_to_a_click(page: Any, copter: SimulatedCopter) -> None:
    page.click("button[data-order='pick']")
    box = page.locator("#map").bounding_box()
    page.mouse.click(box["x"] + box["width"] * 0.55, box["y"] + box["height"] * 0.55)
    where = page.locator("dialog .where")
    where.filter(has_text=re.compile(r"^\d+ m (north|east|south|west)\S* of the vehicle$")).wait_for()
    assert page.locator("dialog").bounding_box()["x"] > box["x"] + box["width"] * 0.55  # the position stays visible
    page.wait_for_function(TARGET_IS_DRAWN, arg=[0.55, 0.55])
    picture(page, "go-to")
    asked = re.search(r"(-?\d+\.\d+), (-?\d+\.\d+)", page.locator("dialog p").first.inner_text())
    assert asked is not None
    page.click("dialog .yes")
    wait_done(page, "go to")
    place = true_point(copter)
    assert place.latitude_deg == pytest.approx(float(asked[1]), abs=3e-5)
    assert place.longitude_deg == pytest.approx(float(asked[2]), abs=3e-5)


# Whether the mark of a target is on the map at this fraction of its width and height.
TARGET_IS_DRAWN = """([x, y]) => {
    const map = document.getElementById("map"), sample = document.createElement("canvas").getContext("2d");
    sample.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--accent");
    sample.fillRect(0, 0, 1, 1);
    const accent = sample.getImageData(0, 0, 1, 1).data.join();
    const pixels = map.getContext("2d").getImageData(map.width * x - 12, map.height * y - 12, 24, 24).data;
    let count = 0;
    for (let at = 0; at < pixels.length; at += 4) count += pixels.slice(at, at + 4).join() === accent;
    return count > 30;
}"""
RTL_ALT = {"DisplayName": "Altitude", "Description": "", "Units": "cm", "Range": {"low": "30", "high": "300000"}}


def test_page_needs_confirmation_outside_metadata(
    browser: Any, copters: tuple[list[SimulatedCopter], str], tmp_path: Path
) -> None:
    (_, second), address = copters
    metadata = tmp_path / "apm.pdef.json"
    climb = {"DisplayName": "", "Description": "", "Units": "m/s", "Range": {"low": "0.1", "high": "10"}}
    metadata.write_text(json.dumps({"": {"RTL_ALT": RTL_ALT, "WP_SPD_UP": climb}}))
    before = second.parameters["RTL_ALT"]
    with serving(address, "--metadata", str(metadata)) as server, opened(browser, server["page"]) as page:
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        page.get_by_role("tab", name="Parameters").click()
        page.fill("input[type=search]", "rtl_alt")
        page.locator("tr", has_text="30 … 300000").click()
        value, yes, problem = (page.locator(f"dialog {each}") for each in ("input[name=value]", ".yes", ".problem"))
        assert (problem.is_hidden(), yes.is_enabled()) == (True, True)
        value.fill("-99999")
        text = "RTL_ALT = -99999 is not in 30..300000 cm"
        assert (problem.inner_text(), yes.is_disabled()) == (text, True)
        check_contrast(page)
        value.press("Enter")
        assert page.locator("dialog[open]").count() == 1
        picture(page, "out-of-range")

        headers = {"Authorization": f"Bearer {server['token']}", "Idempotency-Key": "beside-the-page"}
        url = f"{server['url'].rstrip('/')}/api/vehicles/2/parameters/RTL_ALT"
        answer = page.request.put(url, headers=headers, data={"value": -99999})
        assert (answer.status, answer.json()["detail"].partition(";")[0]) == (400, text)
        assert second.parameters["RTL_ALT"] == before

        page.check("dialog input[name=force]")
        yes.click()
        wait_done(page, "RTL_ALT to -99999")
        assert second.parameters["RTL_ALT"] == -99999
        page.request.put(url, headers={**headers, "Idempotency-Key": "restore-it"}, data={"value": before})
        assert second.parameters["RTL_ALT"] == before

        page.fill("input[type=search]", "wpnav_speed_up")  # the metadata has its other name
        page.locator("tr", has_text="WPNAV_SPEED_UP").click()
        value.fill("99999")
        yes.click()
        problem.filter(has_text="WPNAV_SPEED_UP = 99999: WP_SPD_UP = 999.99 is not in 0.1..10 m/s").wait_for()
        assert yes.is_disabled()


def test_page_sets_parameter_after_confirmation(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    _, address = copters
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        page.get_by_role("tab", name="Parameters").click()
        page.fill("input[type=search]", "wpnav_speed")
        page.locator("tr", has_text="WPNAV_SPEED_UP").wait_for()
        page.fill("input[type=search]", "wp_spd_up")  # its other name
        page.locator("tr", has_text="WPNAV_SPEED_UP").click()
        page.fill("dialog input[name=value]", "321")
        assert "Vehicle 2" in page.locator("dialog").inner_text()
        page.click("dialog .yes")
        wait_done(page, "WPNAV_SPEED_UP")
        page.locator("tr", has_text="321").wait_for()
        picture(page, "parameters")


def test_page_escapes_texts(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    (_, second), address = copters
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.get_by_role("tab", name="Messages").click()
        second.send_text(4, HOSTILE)
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        page.get_by_text(HOSTILE).wait_for()
        assert page.locator("#panel img").count() == 0


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_page_shows_silence_with_readable_values(
    browser: Any, copters: tuple[list[SimulatedCopter], str], scheme: str
) -> None:
    (_, second), address = copters
    with serving(address) as server, opened(browser, server["page"], scheme=scheme) as page:
        page.locator("#server.good", has_text="live").wait_for()
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        # The page reads it too, but perhaps not before the silence.
        parameter = f"{server['url'].rstrip('/')}/api/vehicles/2/parameters/FS_GCS_ENABLE"
        assert page.request.get(parameter, headers={"Authorization": f"Bearer {server['token']}"}).ok
        second.faults.silent = True
        try:
            page.locator("#tiles-of-state dd.old small", has_text="old").first.wait_for()
            banner = page.locator(".silence", has_text=re.compile(r"Vehicle 2 is silent since \d+:\d\d:\d\d"))
            banner.wait_for()
            assert re.search(
                r"Last position, \d+ s old: -35\.363\d+, 149\.165\d+, -?0\.0 m above home",
                banner.inner_text(),
            )
            assert "it continues: the failsafe is off (FS_GCS_ENABLE = 0)" in banner.inner_text()
            page.locator("#server.bad", has_text="1 of 2 silent").wait_for()
            page.locator(".vehicle .dot.silent").wait_for()
            page.locator("#readiness.bad", has_text="No contact for").wait_for()
            styles = page.locator("#tiles-of-state dd, #panel td.value").evaluate_all(
                "all => [...new Set(all.map(e => { const s = getComputedStyle(e);"
                " return `${s.textDecorationLine} ${s.fontStyle} ${s.opacity}`; }))]"
            )
            assert styles == ["none normal 1"]
            arm = page.locator("button[data-order='arm']")
            assert (arm.is_disabled(), arm.locator("small").inner_text()) == (True, "Silent")
            assert page.locator("button[data-order='land']").is_enabled(), "safe orders are tried all the same"
            check_contrast(page)
            picture(page, f"silent-{scheme}")
        finally:
            second.faults.silent = False
        page.locator(".silence").wait_for(state="detached")


def check_contrast(page: Any) -> None:
    found = axe.Axe().run(page).response["violations"]
    severe = [each for each in found if each["impact"] in ("serious", "critical")]
    assert [(each["id"], [node["html"][:120] for node in each["nodes"]]) for each in severe] == []


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_page_has_accessible_contrast(browser: Any, copters: tuple[list[SimulatedCopter], str], scheme: str) -> None:
    _, address = copters
    with serving(address) as server, opened(browser, server["page"], scheme=scheme) as page:
        assert page.evaluate("document.documentElement.dataset.theme") == scheme
        for tab in ("Mission", "Messages", "Orders", "State", "Parameters"):
            page.get_by_role("tab", name=tab).click()
            if tab == "Parameters":
                page.get_by_text("1349 of 1349 parameters").wait_for()
                page.fill("input[type=search]", "wpnav")
            check_contrast(page)
        page.click("button[data-order='arm']")
        check_contrast(page)


def test_page_keeps_chosen_theme(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    _, address = copters
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.click("#theme")
        page.reload()
        page.wait_for_selector(".vehicle[aria-pressed=true]")
        assert page.evaluate("document.documentElement.dataset.theme") == "light"
        page.click("#theme")
        assert page.evaluate("document.documentElement.dataset.theme") == "dark"


def test_page_shows_why_vehicle_is_not_ready(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    (_, second), address = copters
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        page.locator("#readiness.good", has_text="Ready to arm").wait_for()
        second.faults.prearm_failures = ["Compass not healthy"]
        try:
            page.locator("#readiness.warn li", has_text="Compass not healthy").wait_for(timeout=30_000)
            arm = page.locator("button[data-order='arm']")
            assert (arm.is_disabled(), arm.locator("small").inner_text()) == (True, "Not ready")
            picture(page, "not-ready")
        finally:
            second.faults.prearm_failures = []
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)


def test_page_disables_take_off_without_position(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    (_, second), address = copters
    delay, second.parameters["DISARM_DELAY"] = second.parameters["DISARM_DELAY"], 0
    with serving(address) as server, opened(browser, server["page"], 390, 844) as page:
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)
        places = boxes_of_orders(page)
        order(page, "arm")
        wait_done(page, "arm")
        assert boxes_of_orders(page) == places
        assert_toasts_beside_orders(page)
        page.locator("#readiness", has_text="Armed: propellers may turn").wait_for()
        page.locator("button[data-order='take_off']:enabled").wait_for()
        second.faults.gps_lost = True
        try:
            page.locator("button[data-order='take_off'][disabled]", has_text="No position").wait_for(timeout=30_000)
            page.locator("#readiness", has_text="Armed: propellers may turn").wait_for()
        finally:
            second.faults.gps_lost = False
            second.parameters["DISARM_DELAY"] = delay
        order(page, "disarm")
        wait_done(page, "disarm")
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)


READINESS = """async (vehicle) => {
    const { showReadiness } = await import("/static/readiness.js");
    const box = document.createElement("section");
    box.id = "shown";
    document.getElementById("shown")?.remove();
    document.getElementById("readiness").after(box);
    const known = { firmware: "ArduCopter", link: { state: "connected", heartbeat_age_s: 0 }, missing_for_flight: [] };
    const show = (more) => showReadiness(box, { ...known, states: {}, ...vehicle, ...more }, { isOpen: true });
    show({});
    if (box.querySelector("details")) {
        box.querySelector("details").open = true;
        show({ missing_for_flight: [...vehicle.missing_for_flight, "a seventh"] });
    }
    return box.innerText.split("\\n").filter(Boolean);
}"""


def test_readiness_shows_all_reasons_and_notes(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        reasons = [f"Reason {number}" for number in range(1, 7)]
        rows = page.evaluate(READINESS, {"missing_for_flight": reasons})
        assert rows == ["Not ready", *reasons[:4], "and 3 more", *reasons[4:], "A seventh"]
        armed = {"armed": {"value": True, "age_s": 0}, "landed_state": {"value": "ON_GROUND", "age_s": 0}}
        assert page.evaluate(READINESS, {"states": armed}) == ["Armed: propellers may turn"]
        after_return = {"mode": "RTL", "arms_in": "GUIDED", "unless": None}
        assert page.evaluate(READINESS, {"unarmable_mode": after_return}) == [
            "Ready to arm",
            "Arm changes the mode to GUIDED first: ArduCopter cannot arm in RTL",
        ]
        after_mission = {"mode": "AUTO", "arms_in": "GUIDED", "unless": "AUTO_OPTIONS"}
        assert page.evaluate(READINESS, {"unarmable_mode": after_mission}) == [
            "Ready to arm",
            "Arm changes the mode to GUIDED first: ArduCopter cannot arm in AUTO unless AUTO_OPTIONS allows it",
        ]
        assert page.evaluate(READINESS, {"unarmable_mode": {"mode": "RTL", "arms_in": None}}) == [
            "Not ready",
            "ArduCopter cannot arm in RTL",
        ]


def test_disarm_needs_known_ground(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    expected = {"ON_GROUND": "", "TAKEOFF": "Land first", "LANDING": "Land first", "IN_AIR": "Land first"}
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        obstacles = """async ([landed, age, type, link]) => {
            const { obstacle } = await import("/static/readiness.js");
            const states = { armed: { value: true, age_s: 0 }, landed_state: { value: landed, age_s: age } };
            const vehicle = { states, link: { state: link }, vehicle_type: type, missing_for_flight: [] };
            return obstacle("disarm", vehicle, { isOpen: true });
        }"""
        for landed, text in expected.items():
            assert page.evaluate(obstacles, [landed, 0, 2, "connected"]) == text
        assert page.evaluate(obstacles, ["ON_GROUND", 10, 2, "connected"]) == "May be flying"
        assert page.evaluate(obstacles, ["ON_GROUND", 0, 2, "silent"]) == "May be flying"
        assert page.evaluate(obstacles, [None, 0, 10, "silent"]) == ""
        assert page.evaluate(obstacles, [None, 0, 10, "connected"]) == ""  # a rover has no landed state


def test_page_words_errors_for_people(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    said = {
        "take_off: the vehicle is not armed: arm() comes first": "The vehicle is not armed: “Arm” comes first",
        "MAV_CMD_NAV_TAKEOFF was refused: FAILED": "The vehicle refused (failed)",
        "MAV_CMD_COMPONENT_ARM_DISARM was refused: FAILED\n  - not on the ground": (
            "The vehicle refused (failed)\n  - not on the ground"
        ),
        "x.plan: line 3: no JSON": "x.plan: line 3: no JSON",
    }
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        words = """async (details) => {
            const { inWords } = await import("/static/readiness.js");
            return details.map((detail) => inWords({ detail }));
        }"""
        assert page.evaluate(words, [*said]) == [*said.values()]


DROP = """([name, text]) => {
    const data = new DataTransfer();
    data.items.add(new File([text], name));
    window.dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
}"""


def test_page_uploads_dropped_plan_after_confirmation(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    (_, second), address = copters
    place = true_point(second)
    here = aerokit.Position(place.latitude_deg, place.longitude_deg)
    corners = [here.offset(north_m=n, east_m=e) for n, e in ((90, -90), (90, 90), (-90, 90), (-90, -90))]
    leg = waypoint(corners[0].latitude_deg, corners[0].longitude_deg, altitude_relative_m=15)
    plan = Plan(Mission([take_off(altitude_relative_m=15), leg]), Fence([FencePolygon(corners)]))
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        page.evaluate(DROP, ["notes.plan", "no JSON"])
        page.locator(".toast.failed", has_text="notes.plan: line 1: expected 'QGC WPL 110', found 'no JSON'").wait_for()
        page.evaluate(DROP, ["field.plan", format_plan(plan)])
        text = page.locator("dialog[open]").inner_text()
        assert "Vehicle 2" in text
        assert "get 2 mission items, 1 fence area from field.plan" in text
        page.click("dialog .yes")
        wait_done(page, "upload field.plan (2 items)")
        page.get_by_role("tab", name="Mission").click()
        page.locator("#panel tr", has_text="waypoint").wait_for()
        page.evaluate(DROP, ["field.waypoints", format_waypoints(plan.mission)])
        assert "get 2 mission items from field.waypoints" in page.locator("dialog[open]").inner_text()
        page.click("dialog .yes")
        wait_done(page, "upload field.waypoints (2 items)")
        page.evaluate(DROP, ["broken.plan", format_plan(plan).replace('"version": 2', '"version": 7')])
        page.locator(".toast.failed", has_text="broken.plan").wait_for()
        picture(page, "uploaded")


def test_map_labels_do_not_overlap_on_phone(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    _, address = copters
    with serving(address) as server, opened(browser, server["page"], 390, 844) as page:
        boxes = page.evaluate("""async () => {
            const { MapView } = await import("/static/map.js");
            const map = new MapView(document.getElementById("map"), () => {}), drawn = [];
            const at = (east) => ({ latitude_deg: -35.36, longitude_deg: 149.165 + east * 1e-6 });
            const vehicles = [1, 2, 3, 4].map((id) => ({ id, position: at(id), age: 0, heading: 0,
                labels: [`${id} · STABILIZE · 10.0 m`, `${id} · 10.0 m`, String(id)] }));
            const fillRect = map.context.fillRect.bind(map.context);
            map.context.fillRect = (...box) => { drawn.push(box); fillRect(...box); };
            map.draw(vehicles, 1, { items: [], current: null }, null, { polygons: [], circles: [], rally: [] });
            return drawn.slice(1); // the first one is the background
        }""")
        assert len(boxes) == 4
        for index, (left, top, wide, high) in enumerate(boxes):
            assert 0 <= left <= left + wide <= 390
            for other in boxes[:index]:
                apart = left > other[0] + other[2] or other[0] > left + wide
                assert apart or top > other[1] + other[3] or other[1] > top + high


def test_page_on_phone_without_token_and_read_only(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    _, address = copters
    with serving(address, "--read-only") as server, opened(browser, server["url"], 390, 844) as page:
        page.locator("#server", has_text="read-only").wait_for()
        assert page.locator("#orders button:enabled").count() == 0
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        picture(page, "phone")


def test_page_without_token_asks_at_once(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    with serving(copters[1]) as server, opened(browser, server["url"], 1280, 800) as page:
        page.locator("#server", has_text="no token").wait_for()
        arm = page.locator("button[data-order='arm']")
        assert (arm.is_disabled(), arm.locator("small").inner_text()) == (True, "No token")
        page.fill("#notice input", server["token"])
        page.click("#notice button")
        page.locator("#notice").wait_for(state="hidden")
        page.locator("button[data-order='arm']:enabled").wait_for()
        picture(page, "token")
        widths = page.locator("#orders button").evaluate_all("all => all.map(e => e.getBoundingClientRect().width)")
        assert max(widths) < 2.5 * min(widths)
        panel = page.locator("#side").bounding_box()
        page.evaluate(
            "document.getElementById('toasts').append(Object.assign(document.createElement('button'),"
            " { className: 'toast', textContent: 'x'.repeat(300) }))"
        )
        toast = page.locator("#toasts").bounding_box()
        assert toast["x"] + toast["width"] <= panel["x"]


def test_page_after_server_end_shows_banner(browser: Any) -> None:
    with serving("--sim") as server:
        started = opened(browser, server["url"])
        page = started.__enter__()
    page.locator("#banner", has_text="No connection").wait_for()
    page.locator("#tiles-of-state dd.old").first.wait_for()
    assert page.locator("#orders button:enabled").count() == 0
    picture(page, "ended")
    page.context.close()
