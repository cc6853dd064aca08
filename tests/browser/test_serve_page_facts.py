"""Facts about orders, automatic disarming and crashes on the page of ``aerokit serve`` (`nox -s browser`)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from page_stage import CHROMIUM, check_contrast, opened, order, picture, serving, wait_done
from served_copter import served

import aerokit
from aerokit.mavlink.messages import MissionAck
from aerokit.missions import Fence, FencePolygon, Mission, Plan, format_plan, take_off, waypoint
from aerokit.sim import SimulatedCopter
from aerokit.testing.track import true_point

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium"), pytest.mark.timeout(300)]


@contextmanager
def page_of(browser: Any, **options: Any) -> Iterator[tuple[SimulatedCopter, Any]]:
    """Serve one copter in real time, and open the page when it is ready to arm."""
    copter = SimulatedCopter(boot_time_s=0.0, **options)
    with (
        served([copter], speedup=1.0) as address,
        serving(address) as server,
        opened(browser, server["page"]) as page,
    ):
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)
        yield copter, page


def click_map(page: Any) -> None:
    page.click("button[data-order='pick']")
    box = page.locator("#map").bounding_box()
    page.mouse.click(box["x"] + box["width"] * 0.55, box["y"] + box["height"] * 0.55)


def cancel(page: Any) -> None:
    page.click("dialog button >> text=Cancel")


def test_go_to_during_take_off_keeps_its_altitude(browser: Any) -> None:
    with page_of(browser) as (copter, page):
        order(page, "arm")
        wait_done(page, "arm")
        order(page, "take_off", {"altitude_m": "8"})
        take_off_button = page.locator("button[data-order='take_off'][disabled][aria-busy=true]")
        take_off_button.filter(has_text="Running").wait_for()
        page.locator("#readiness strong", has_text="Flying").wait_for()
        click_map(page)
        page.locator("dialog .facts", has_text="Replaces: take off to 8 m").wait_for()
        assert page.input_value("dialog input[name=altitude_relative_m]") == "8"
        assert true_point(copter).altitude_m < 7, "the take-off is still running"
        picture(page, "replaces")
        page.click("dialog .yes")
        toast = page.locator(".toast.replaced", has_text="take off to 8 m: replaced by go to a position at 8 m")
        toast.wait_for()
        assert page.locator(".toast.failed").count() == 0
        page.get_by_role("tab", name="Orders").click()
        page.locator("#panel .replaced", has_text="take off to 8 m: replaced by").wait_for()
        assert page.locator("#panel .failed").count() == 0
        wait_done(page, "go to")
        assert true_point(copter).altitude_m == pytest.approx(8, abs=1)
        click_map(page)
        assert float(page.input_value("dialog input[name=altitude_relative_m]")) == pytest.approx(8, abs=1)
        assert page.locator("dialog .facts p").count() == 0, "the take-off does not run any more"
        cancel(page)


def test_dialogs_refuse_altitudes_below_ground(browser: Any) -> None:
    with page_of(browser) as (copter, page):
        order(page, "arm")
        wait_done(page, "arm")
        page.locator("button[data-order='return_to_launch'][disabled]", has_text="On the ground").wait_for()
        page.click("button[data-order='take_off']")
        problem, yes = page.locator("dialog .problem"), page.locator("dialog .yes")
        for value, text in (
            ("-5", "The altitude must be above 0 m."),
            ("20000", "The altitude must be at most 10,000 m."),
        ):
            page.fill("dialog input[name=altitude_m]", value)
            assert (problem.inner_text(), yes.is_disabled()) == (text, True)
            page.locator("dialog input[name=altitude_m]").press("Enter")
            assert page.locator("dialog[open]").count() == 1
            assert page.locator("dialog .force").is_hidden()
        page.fill("dialog input[name=altitude_m]", "6")
        assert (problem.is_hidden(), yes.is_enabled()) == (True, True)
        yes.click()
        wait_done(page, "take off to 6 m")
        click_map(page)
        page.fill("dialog input[name=altitude_relative_m]", "-20")
        assert "below home there is ground" in problem.inner_text()
        assert yes.is_disabled()
        check_contrast(page)
        cancel(page)
        assert true_point(copter).altitude_m > 5


def test_page_reports_automatic_disarming(browser: Any) -> None:
    with page_of(browser) as (_, page):
        order(page, "arm")
        wait_done(page, "arm")
        text = re.compile(
            r"Disarmed by the vehicle \d+ s after arming, because it was not in the air \(DISARM_DELAY = 10 s\)"
        )
        page.locator("#readiness.good li", has_text=text).wait_for(timeout=30_000)
        page.locator(".toast.note", has_text=text).wait_for()
        assert page.locator("dialog[open]").count() == 0
        picture(page, "disarmed-by-vehicle")


def test_dialogs_name_disarm_delay_and_return_altitude(browser: Any) -> None:
    with page_of(browser, parameters={"DISARM_DELAY": 25.0, "RTL_ALT": 2250.0}) as (_, page):
        page.click("button[data-order='arm']")
        page.locator("dialog .facts", has_text="it disarms itself after 25 s (DISARM_DELAY)").wait_for()
        page.click("dialog .yes")
        wait_done(page, "arm")
        order(page, "take_off", {"altitude_m": "5"})
        wait_done(page, "take off to 5 m")
        page.click("button[data-order='return_to_launch']")
        page.locator("dialog .facts", has_text="It first climbs to 22.5 m above home, unless it is higher.").wait_for()
        cancel(page)
        facts = page.evaluate(
            """async () => {
                const { orderFacts } = await import("/static/facts.js");
                const usual = { disarm_parameter: "COM_DISARM_PRFLT", disarm_delay_s: null, missing_for_flight: [] };
                return [usual, { ...usual, disarm_delay_s: -1 }].map((each) => orderFacts("arm", each, []));
            }"""
        )
        assert facts == [["If it does not take off, it usually disarms itself after 10 s (COM_DISARM_PRFLT)."], []]


def test_page_announces_failsafe_until_it_ends(browser: Any) -> None:
    with page_of(browser) as (copter, page):
        order(page, "arm")
        wait_done(page, "arm")
        order(page, "take_off", {"altitude_m": "5"})
        wait_done(page, "take off to 5 m")
        page.locator("#readiness.good", has_text="Flying").wait_for()
        copter.faults.rc_lost = True
        page.locator("#readiness.warn li", has_text="Radio Failsafe").wait_for()
        assert page.locator("#readiness strong").inner_text() == "Failsafe: RTL"
        assert page.locator(".toast.failed").all_inner_texts() == ["Vehicle 1: Failsafe: RTL. Radio Failsafe"]
        assert page.locator(".vehicle .dot.warn").count() == 1
        picture(page, "failsafe")
        copter.faults.rc_lost = False
        page.locator("#readiness.good", has_text="Flying").wait_for()
        assert page.locator(".toast.failed").count() == 1


def test_page_reports_crash_and_lets_disarm(browser: Any) -> None:
    with page_of(browser) as (copter, page):
        order(page, "arm")
        wait_done(page, "arm")
        order(page, "take_off", {"altitude_m": "10"})
        wait_done(page, "take off to 10 m")
        disarm = page.locator("button[data-order='disarm']")
        assert (disarm.is_disabled(), page.locator("#crashes .silence").count()) == (True, 0)
        copter.faults.motor_failed = True
        banner = page.locator("#crashes .silence")
        banner.filter(has_text=re.compile(r"Vehicle 1 hit the ground at \d+\.\d m/s at \d\d:\d\d:\d\d")).wait_for()
        page.locator("#readiness.bad strong", has_text="Crashed: propellers may turn").wait_for()
        page.locator("button.urgent[data-order='disarm']").wait_for()
        assert "It is still armed" in banner.inner_text()
        for name in ("take_off", "pick"):
            assert page.locator(f"button[data-order='{name}'] small").inner_text() == "Crashed"
        for name in ("hold", "land", "return_to_launch"):
            assert page.locator(f"button[data-order='{name}']").is_enabled(), "the page may be wrong"
        check_contrast(page)
        picture(page, "crashed")
        disarm.click()
        facts = page.locator("dialog .facts")
        facts.filter(has_text="It hit the ground at").wait_for()
        assert re.search(r"Now: -?0\.\d m above home, 0\.0 m/s, it reports “\w[\w ]*”", facts.inner_text())
        needs_force = "“on ground”" not in facts.inner_text()
        assert ("The motors stop whatever it reports" in facts.inner_text()) is needs_force
        with page.expect_request("**/disarm?*") as sent:
            page.click("dialog .yes")
        assert json.loads(sent.value.post_data) == ({"force": True} if needs_force else {})
        wait_done(page, "disarm")
        assert not copter.is_armed
        page.locator("#crashes .silence", has_text="It is disarmed").wait_for()


NEEDS_FORCE = """async ([crash, landed]) => {
    const { needsForce } = await import("/static/facts.js");
    return needsForce({ crash, states: landed ? { landed_state: { value: landed } } : {} });
}"""


def test_only_crash_that_reports_flying_needs_force(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    crash = {"text": "the vehicle hit the ground at 9.0 m/s", "at_unix_s": 0}
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        for state, expected in (("IN_AIR", True), ("TAKEOFF", True), (None, True), ("ON_GROUND", False)):
            assert page.evaluate(NEEDS_FORCE, [crash, state]) is expected
            assert page.evaluate(NEEDS_FORCE, [None, state]) is False


def test_page_separates_cannot_arm_from_cannot_take_off(browser: Any) -> None:
    with page_of(browser) as (copter, page):
        copter.faults.gps_lost = True
        page.locator("#readiness.warn strong", has_text="Arms, but cannot take off yet").wait_for(timeout=30_000)
        page.locator("button[data-order='arm']:enabled").click()
        text = re.compile("Arms, but cannot take off yet: .*the estimator has no absolute horizontal position")
        page.locator("dialog .facts", has_text=text).wait_for()
        picture(page, "arms-only")
        page.click("dialog .yes")
        wait_done(page, "arm")
        assert copter.is_armed


def test_arm_dialog_names_mode_change(browser: Any) -> None:
    with page_of(browser) as (_, page):
        page.select_option("#orders select", "LAND")
        page.click("dialog .yes")
        wait_done(page, "mode LAND")
        text = "Arm changes the mode to GUIDED first: ArduCopter cannot arm in LAND"
        page.locator("#readiness", has_text=text).wait_for()
        page.click("button[data-order='arm']")
        page.locator("dialog .facts", has_text=text).wait_for()
        cancel(page)


DROP = """([name, text]) => {
    const data = new DataTransfer();
    data.items.add(new File([text], name));
    window.dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
}"""
# Whether the map shows exactly these items of a mission.
SHOWS_ITEMS = """(wanted) => {
    const items = [...document.querySelectorAll("#map .item")].map((each) => each.textContent);
    return JSON.stringify(items.sort()) === JSON.stringify(wanted);
}"""

PLACE_OF_ITEM = "() => document.querySelector('#map .item').getBoundingClientRect().y"


def test_upload_dialog_previews_plan_on_map(browser: Any) -> None:
    with page_of(browser) as (copter, page):
        place = true_point(copter)
        here = aerokit.Position(place.latitude_deg, place.longitude_deg)
        legs = [here.offset(north_m=north_m) for north_m in (200, 400)]
        items = [waypoint(at.latitude_deg, at.longitude_deg, altitude_relative_m=15) for at in legs]
        area = [here.offset(north_m=n, east_m=e) for n, e in ((500, -90), (500, 90), (-90, 90), (-90, -90))]
        plan = Plan(Mission([take_off(altitude_relative_m=15), *items]), Fence([FencePolygon(area)]))
        page.wait_for_function(SHOWS_ITEMS, arg=[])
        page.evaluate(DROP, ["field.plan", format_plan(plan)])
        page.locator("dialog[open]", has_text="Its first place is 200 m north of the vehicle.").wait_for()
        page.locator("dialog .detail", has_text="It keeps its rally points, because the file has none.").wait_for()
        page.wait_for_function(SHOWS_ITEMS, arg=["1", "2"])
        picture(page, "preview")
        place_before = page.evaluate(PLACE_OF_ITEM)
        page.click("#zoom-in")
        page.wait_for_function(f"before => ({PLACE_OF_ITEM})() !== before", arg=place_before)
        assert page.locator("#orders").evaluate("orders => orders.inert")
        page.keyboard.press("Escape")
        page.locator("dialog[open]").wait_for(state="detached")
        assert not page.locator("#orders").evaluate("orders => orders.inert")
        page.wait_for_function(SHOWS_ITEMS, arg=[])
        far = here.offset(east_m=25_000)
        plan = Plan(Mission([waypoint(far.latitude_deg, far.longitude_deg, altitude_relative_m=15)]))
        page.evaluate(DROP, ["elsewhere.plan", format_plan(plan)])
        text = re.compile(r"Its first place is 24\.9 km east of the vehicle: is this the plan for this vehicle\?")
        page.locator("dialog .facts", has_text=text).wait_for()
        picture(page, "far-plan")


def test_mission_of_another_station_replaces_shown_mission(browser: Any) -> None:
    with page_of(browser) as (copter, page):
        place = true_point(copter)
        at = place.latitude_deg, place.longitude_deg
        missions = [Mission([waypoint(*at, altitude_relative_m=height)]) for height in (11, 22)]
        page.evaluate(DROP, ["first.plan", format_plan(Plan(missions[0]))])
        page.locator("dialog[open]").wait_for()
        page.click("dialog .yes")
        wait_done(page, "upload first.plan")
        page.get_by_role("tab", name="Mission").click()
        page.locator("#panel tr", has_text="11.0 m").wait_for()
        copter.missions.replace(0, missions[1].to_items(home_is_item_0=True))
        copter.send(MissionAck(254, 190, 0))
        page.locator("#panel tr", has_text="22.0 m").wait_for()


def test_orders_tell_when_mission_finished(browser: Any) -> None:
    with page_of(browser) as (copter, page):
        place = true_point(copter)
        end = aerokit.Position(place.latitude_deg, place.longitude_deg).offset(north_m=5)
        items = [take_off(altitude_relative_m=3), waypoint(end.latitude_deg, end.longitude_deg, altitude_relative_m=3)]
        page.evaluate(DROP, ["short.plan", format_plan(Plan(Mission(items)))])
        page.locator("dialog[open]", has_text="The map shows the plan.").wait_for()
        page.click("dialog .yes")
        wait_done(page, "upload short.plan")
        order(page, "arm")
        wait_done(page, "arm")
        order(page, "mission/start")
        for _ in range(2):
            page.get_by_role("tab", name="Orders").click()
            text = re.compile(r"mission started at item 0, all items done at \d+:\d\d:\d\d")
            page.locator("#panel .done", has_text=text).wait_for(timeout=60_000)
            page.reload()


def test_start_dialog_names_the_item(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)
        order(page, "arm")
        wait_done(page, "arm")
        page.locator("button[data-order='mission/start']:enabled").click()
        text, problem = page.locator("dialog p").first, page.locator("dialog .problem")
        assert "will fly its mission from item 0;" in text.inner_text()
        page.fill("dialog input[name=item]", "3")
        assert "will fly its mission from item 3;" in text.inner_text()
        page.fill("dialog input[name=item]", "99")
        assert problem.inner_text() == "The mission has the items 0 to 5."
        assert page.locator("dialog .yes").is_disabled()
        cancel(page)
        order(page, "disarm")
        wait_done(page, "disarm")


# The reasons (of all that `obstacle` can return) that are too long for the text below a button.
CUT_OFF = """async () => {
    const source = await (await fetch("/static/readiness.js")).text();
    const body = source.slice(source.indexOf("function obstacle"), source.indexOf("const EKF_POS_HORIZ"));
    const reasons = [...body.matchAll(/(?:return|[?:]) "([^"]+)"/g)].map(([, text]) => text.split(": ").pop());
    const small = document.querySelector("#orders small");
    const cut = reasons.filter((text) => { small.textContent = text; return small.scrollWidth > small.clientWidth; });
    return [reasons.length, cut];
}"""


def test_reasons_fit_into_buttons(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        for wide in (1360, 1200, 390):
            page.set_viewport_size({"width": wide, "height": 820})
            count, cut = page.evaluate(CUT_OFF)
            assert count > 15
            assert cut == []


def test_parameters_look_clickable_with_token_only(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    style = "e => getComputedStyle(e).textDecorationLine"
    with serving(copters[1]) as server:
        for url, line, note in ((server["page"], "underline", " · click one to set it"), (server["url"], "none", "")):
            with opened(browser, url) as page:
                page.get_by_role("tab", name="Parameters").click()
                text = re.compile(rf"^\d+ of \d+ parameters, received at [\d:]+{note}$")
                page.locator("#panel .note", has_text=text).wait_for()
                assert page.locator("#panel .link").first.evaluate(style) == line
                if line == "underline":
                    check_contrast(page)
