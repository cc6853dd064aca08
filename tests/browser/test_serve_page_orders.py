"""Orders, parameters and readiness on the page of ``aerokit serve``, in headless Chromium (`nox -s browser`)."""

from __future__ import annotations

import json
import re
from pathlib import Path
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

import aerokit
from aerokit.missions import (
    Fence,
    FencePolygon,
    Mission,
    Plan,
    format_plan,
    format_waypoints,
    take_off,
    waypoint,
)
from aerokit.sim import SimulatedCopter
from aerokit.testing.track import true_point

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium"), pytest.mark.timeout(300)]


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
        page.fill("input[type=search]", "rtl_atl")
        page.locator("#panel .note", has_text=re.compile("^0 of .*: did you mean RTL_ALT[?]$")).wait_for()
        page.fill("input[type=search]", "wpnav_speed")
        page.locator("tr", has_text="WPNAV_SPEED_UP").wait_for()
        page.fill("input[type=search]", "wp_spd_up")  # its other name
        page.locator("tr", has_text="WPNAV_SPEED_UP").click()
        page.fill("dialog input[name=value]", "321")
        assert "Vehicle 2" in page.locator("dialog").inner_text()
        page.click("dialog .yes")
        wait_done(page, "WPNAV_SPEED_UP to 321: done; range not checked (serve --metadata FILE checks it)")
        page.locator("tr", has_text="321").wait_for()
        picture(page, "parameters")


def test_page_shows_why_vehicle_is_not_ready(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    (_, second), address = copters
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        page.locator("#readiness.good", has_text="Ready to arm").wait_for()
        second.faults.prearm_failures = ["Compass not healthy"]
        try:
            page.locator("#readiness.warn li", has_text="Compass not healthy").wait_for(timeout=30_000)
            arm = page.locator("button[data-order='arm']")
            assert (arm.is_disabled(), arm.locator("small").inner_text()) == (True, "Cannot arm")
            page.locator("#readiness.warn strong", has_text="Cannot arm").wait_for()
            assert arm.get_attribute("title") == "Cannot arm: Compass not healthy"
            picture(page, "cannot-arm")
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
    const link = { state: "connected", heartbeat_age_s: 0 };
    const known = { firmware: "ArduCopter", link, missing_for_flight: [], not_armable: [] };
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
        assert rows == ["Not known yet whether it can arm", *reasons[:4], "and 3 more", *reasons[4:], "A seventh"]
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
            "If the vehicle refuses to arm in AUTO (AUTO_OPTIONS), Arm changes the mode to GUIDED and arms there",
        ]
        sensors = {"sensors": {"value": {}, "age_s": 0}}
        for vehicle_type, title in ((2, "Arms, but is not ready to fly"), (10, "Arms, but cannot drive by itself yet")):
            missing = {"missing_for_flight": ["home"], "states": sensors, "vehicle_type": vehicle_type}
            assert page.evaluate(READINESS, missing)[0] == title
        disarming = {"age_s": 3, "armed_for_s": 4, "parameter": "DISARM_DELAY", "delay_s": 10, "is_automatic": False}
        text = "Disarmed 4 s after arming, not by an order of this server (DISARM_DELAY = 10 s)"
        assert page.evaluate(READINESS, {"disarming": disarming}) == ["Ready to arm", text]
        assert page.evaluate(READINESS, {"disarming": {**disarming, "age_s": 61}}) == ["Ready to arm"]
        switched_off = {**disarming, "parameter": "COM_DISARM_PRFLT", "delay_s": -1}
        text_without_delay = "Disarmed 4 s after arming, not by an order of this server"
        assert page.evaluate(READINESS, {"disarming": switched_off}) == ["Ready to arm", text_without_delay]
        refused = {"missing_for_flight": ["compass", "home"], "not_armable": ["compass"]}
        rows = page.evaluate(READINESS, refused)
        assert rows == ["Cannot arm", "compass", "and 2 more", "Also missing for flight:", "home", "A seventh"]


OBSTACLE = """async ([order, landed, age, type, link]) => {
    const { obstacle } = await import("/static/readiness.js");
    const states = { armed: { value: true, age_s: 0 }, landed_state: { value: landed, age_s: age } };
    const vehicle = { states, link: { state: link }, vehicle_type: type, missing_for_flight: [] };
    return obstacle(order, vehicle, { isOpen: true });
}"""


def test_disarm_needs_known_ground(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    expected = {"ON_GROUND": "", "TAKEOFF": "Land first", "LANDING": "Land first", "IN_AIR": "Land first"}
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        for landed, text in expected.items():
            assert page.evaluate(OBSTACLE, ["disarm", landed, 0, 2, "connected"]) == text
        assert page.evaluate(OBSTACLE, ["disarm", "ON_GROUND", 10, 2, "connected"]) == "May be flying"
        assert page.evaluate(OBSTACLE, ["disarm", "ON_GROUND", 0, 2, "silent"]) == "May be flying"
        assert page.evaluate(OBSTACLE, ["disarm", None, 0, 10, "silent"]) == ""
        assert page.evaluate(OBSTACLE, ["disarm", None, 0, 10, "connected"]) == ""  # a rover has no landed state


def test_resume_is_disabled_on_known_ground(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    on_ground = "On the ground: use Start"
    cases = {("ON_GROUND", 0, 2): on_ground, ("IN_AIR", 0, 2): "", ("ON_GROUND", 9, 2): "", ("ON_GROUND", 0, 10): ""}
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        found = {case: page.evaluate(OBSTACLE, ["mission/resume", *case, "connected"]) for case in cases}
        assert found == cases


def test_take_off_dialog_reports_disarming(browser: Any, copters: tuple[list[SimulatedCopter], str]) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)
        order(page, "arm")
        page.locator("button[data-order='mission/resume'][disabled]", has_text="Use Start").wait_for()
        picture(page, "resume-on-ground")
        page.locator("button[data-order='take_off']:enabled").click()
        page.locator("dialog .yes:enabled").wait_for()
        blocked = page.locator("dialog .blocked")
        blocked.filter(has_text="It disarmed").wait_for(timeout=30_000)  # after DISARM_DELAY
        assert "The vehicle is not armed: press “Arm” first. It disarmed 1 s ago." in blocked.inner_text()
        assert "ArduCopter disarms itself on the ground after DISARM_DELAY, 10 s by default." in blocked.inner_text()
        assert page.locator("dialog .yes").is_disabled()
        picture(page, "disarmed-in-dialog")


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
        page.locator(
            ".toast.failed", has_text="notes.plan: line 1, column 1: the text is not valid JSON: Expecting value"
        ).wait_for()
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
