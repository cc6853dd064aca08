"""The page of ``aerokit serve`` in headless Chromium (`nox -s browser`); skipped where one is missing."""

from __future__ import annotations

import re
from typing import Any

import pytest
from page_stage import (
    CHROMIUM,
    assert_toasts_beside_orders,
    boxes_of_orders,
    check_contrast,
    opened,
    order,
    picture,
    serving,
    wait_done,
)

from aerokit.sim import SimulatedCopter
from aerokit.testing.track import true_point

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium"), pytest.mark.timeout(300)]
HOSTILE = "<img src=x onerror=alert(1)>"


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
        from_to = re.compile(r"^\d+:\d\d:\d\d– \d+:\d\d:\d\dvehicle 1: land: done")
        page.locator("#panel .text", has_text=from_to).wait_for()
        picture(page, "orders")
        with page.expect_response("**/api/vehicles/1/track") as track:
            page.reload()
        assert len(track.value.json()["points"]) > 20


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
    x, y = box["x"] + box["width"] * 0.55, box["y"] + box["height"] * 0.55
    page.mouse.click(x, y)
    where = page.locator("dialog .where")
    where.filter(has_text=re.compile(r"^\d+ m (north|east|south|west)\S* of the vehicle$")).wait_for()
    assert page.locator("dialog").bounding_box()["x"] > x  # the position stays visible
    page.wait_for_function(TARGET_IS_DRAWN, arg=[x, y])
    picture(page, "go-to")
    asked = re.search(r"(-?\d+\.\d+), (-?\d+\.\d+)", page.locator("dialog p").first.inner_text())
    assert asked is not None
    page.click("dialog .yes")
    wait_done(page, "go to")
    place = true_point(copter)
    assert place.latitude_deg == pytest.approx(float(asked[1]), abs=3e-5)
    assert place.longitude_deg == pytest.approx(float(asked[2]), abs=3e-5)


# Whether the mark of a target is on the map at this position of the window.
TARGET_IS_DRAWN = """([x, y]) => {
    const mark = document.querySelector("#map .target")?.getBoundingClientRect();
    return mark && Math.hypot(mark.x + mark.width / 2 - x, mark.y + mark.height / 2 - y) < 2;
}"""


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
        # The page reads FS_GCS_ENABLE, too, but perhaps only after the vehicle has become silent.
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


def test_page_words_errors_for_people(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    said = {
        "take_off: the vehicle is not armed: call arm() first; nothing was sent": (
            "The vehicle is not armed: press “Arm” first; nothing was sent"
        ),
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


def test_refused_take_off_names_automatic_disarming(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    texts = {
        ("DISARM_DELAY", 5): "It disarmed 5 s ago. X disarms itself on the ground after DISARM_DELAY, 10 s by default.",
        (None, 5): "It disarmed 5 s ago.",
        ("DISARM_DELAY", 61): "",
    }
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        words = """async ([disarm_parameter, seconds]) => {
            const { inWords } = await import("/static/readiness.js");
            const disarmedAt = performance.now() - 1000 * seconds;
            const states = { armed: { value: false } };
            return inWords({ detail: "it is not armed" }, { firmware: "X", disarm_parameter, disarmedAt, states });
        }"""
        for case, text in texts.items():
            assert page.evaluate(words, [*case]) == ". ".join(filter(None, ("It is not armed", text)))


def test_messages_leave_out_item_texts(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    texts = ["Mission: 4 WP", "Reached command #3", "Mission finished early", "Crash: Disarming"]
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        shown = """async (texts) => {
            const { TextPanel } = await import("/static/panels.js");
            const panel = new TextPanel();
            const event = { event: "StatusTextReceived", severity: 6, system_id: 1, time_unix_s: 0 };
            texts.forEach((text, number) => panel.add({ ...event, number, text }));
            panel.show({ system_id: 1 });
            return [...panel.node.querySelectorAll(".text span")].map((each) => each.textContent);
        }"""
        assert page.evaluate(shown, texts) == ["Crash: Disarming", "Mission finished early"]


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
