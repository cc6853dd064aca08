"""Texts and layout of the page of ``aerokit serve`` in detail, in headless Chromium (`nox -s browser`)."""

from __future__ import annotations

from typing import Any

import pytest
from page_stage import CHROMIUM, opened, serving

from aerokit.sim import SimulatedCopter

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium"), pytest.mark.timeout(300)]

Copters = tuple[list[SimulatedCopter], str]


def test_parameter_dialog_refuses_values_of_other_types(browser: Any, copters: Copters) -> None:
    (_, second), address = copters
    before = second.parameters["RTL_ALT"]
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.locator(".vehicle", has_text="2 ArduCopter").click()
        page.get_by_role("tab", name="Parameters").click()
        page.fill("input[type=search]", "rtl_alt")
        page.locator("tr", has_text="RTL_ALT").first.click()
        value, yes, problem, force = (
            page.locator(f"dialog {each}") for each in ("input[name=value]", ".yes", ".problem", ".force")
        )
        details = page.locator("dialog .detail").all_inner_texts()
        assert details[0] == "Whole numbers -2147483648 … 2147483647 (INT32)."
        texts = {
            "2000.5": "RTL_ALT = 2000.5 must be a whole number (its type is INT32).",
            "1e30": "RTL_ALT = 1e+30 must be in -2147483648..2147483647 (its type is INT32).",
        }
        for text, expected in texts.items():
            value.fill(text)
            assert (problem.inner_text(), yes.is_disabled(), force.is_visible()) == (expected, True, False)
            value.press("Enter")
            assert page.locator("dialog[open]").count() == 1
        value.fill("2000")
        assert (problem.is_visible(), yes.is_enabled()) == (False, True)
        types = """async (cases) => {
            const { typeProblem } = await import("/static/panels.js");
            return cases.map(([type, value]) => Boolean(typeProblem({ name: "X", type }, value)));
        }"""
        allowed = [["INT8", -128], ["UINT16", 65535], ["REAL32", 1.5], ["REAL32", 3e38], ["REAL64", 1e300]]
        refused = [["INT8", -129], ["UINT16", -1], ["UINT16", 65536], ["INT16", 0.5], ["REAL32", -1e39]]
        assert page.evaluate(types, allowed + refused) == [False] * 5 + [True] * 5
    assert second.parameters["RTL_ALT"] == before


def test_page_shortens_floats_and_words_fix(browser: Any, copters: Copters) -> None:
    (first, _), address = copters
    first.parameters["ATC_RAT_RLL_P"] = 0.15000000596046448
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.locator("#panel tr", has_text="fix type rtk fixed").wait_for()
        fractions = """async () => {
            const { shortest, spelled } = await import("/static/dom.js");
            const numbers = [0.15000000596046448, 1234567890, -2.5e-8, 16777.216796875];
            return [...numbers.map(shortest), spelled("TYPE_3D_FIX")];
        }"""
        assert page.evaluate(fractions) == ["0.15", "1234567890", "-2.5e-8", "16777.217", "3D"]
        page.get_by_role("tab", name="Parameters").click()
        page.fill("input[type=search]", "atc_rat_rll_p")
        page.locator("tr.clickable:visible", has_text="ATC_RAT_RLL_P").first.click()
        assert "set ATC_RAT_RLL_P, currently 0.15." in page.locator("dialog").inner_text()
        assert page.input_value("dialog input[name=value]") == "0.15"
        assert page.locator("dialog .detail").all_inner_texts()[0] == "Numbers with fractions (REAL32)."


def test_page_light_and_dot_of_vehicle_agree(browser: Any, copters: Copters) -> None:
    (first, _), address = copters
    with serving(address) as server, opened(browser, server["page"]) as page:
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)
        page.locator(".vehicle[data-id='1'] .dot.good").wait_for()
        first.faults.prearm_failures = ["Compass not healthy"]
        try:
            page.locator("#readiness.warn strong", has_text="Cannot arm").wait_for(timeout=30_000)
            page.locator(".vehicle[data-id='1'] .dot.warn").wait_for()
            page.locator(".vehicle[data-id='2'] .dot.good").wait_for()
            colours = "all => all.map((each) => getComputedStyle(each).backgroundColor)"
            dot, light = page.locator(".vehicle[data-id='1'] .dot, #readiness .light").evaluate_all(colours)
            assert dot == light
            assert page.locator(".vehicle[data-id='1']").get_attribute("title") == "Cannot arm · link connected"
        finally:
            first.faults.prearm_failures = []
        page.locator(".vehicle[data-id='1'] .dot.good").wait_for(timeout=30_000)


def test_arm_dialog_and_light_agree_about_auto(browser: Any, copters: Copters) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        lines = page.evaluate("""async () => {
            const { orderFacts } = await import("/static/facts.js");
            const mode = { mode: "AUTO", arms_in: "GUIDED", unless: "AUTO_OPTIONS" };
            return orderFacts("arm", { firmware: "ArduCopter", unarmable_mode: mode, missing_for_flight: [] }, []);
        }""")
        text = "If the vehicle refuses to arm in AUTO (AUTO_OPTIONS), Arm changes the mode to GUIDED and arms there."
        assert lines == [text]  # test_readiness_shows_all_reasons_and_notes has the text of the light


def test_hold_names_mode_instead_of_done(browser: Any, copters: Copters) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        texts = page.evaluate("""async () => {
            const { OrderPanel } = await import("/static/panels.js");
            const panel = new OrderPanel(), done = { key: "k", state: "done", arguments: {} };
            const orders = [["hold", "LOITER"], ["mission/pause", "BRAKE"]];
            return orders.map(([order, mode]) => panel.outcome({ ...done, order, result: { mode } }));
        }""")
        stopping = "may still be stopping"
        assert texts == [f"hold: in LOITER, {stopping}", f"mission pause: in BRAKE, {stopping}"]


def test_mission_list_shows_speed_and_delay(browser: Any, copters: Copters) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        rows = page.evaluate("""async () => {
            const { MissionPanel } = await import("/static/panels.js");
            const panel = new MissionPanel(() => {}, () => {});
            const items = [
                { name: "DO_CHANGE_SPEED", param1: 1, param2: 4.5, param3: -1 },
                { name: "DO_CHANGE_SPEED", param1: 1, param2: -1, param3: 60 },
                { name: "NAV_DELAY", param1: 12, param2: -1, param3: -1 },
                { name: "NAV_RETURN_TO_LAUNCH", param1: 0, param2: 0, param3: 0 },
            ].map((item, index) => ({ index, position: null, z: 0, ...item }));
            panel.missions.set(1, { items, note: "" });
            panel.show({ system_id: 1 });
            return [...panel.body.rows].map((row) => [row.cells[1].textContent, row.cells[3].textContent]);
        }""")
        values = ["4.5 m/s", "60 %", "12 s", ""]
        assert rows == list(map(list, zip(["change speed"] * 2 + ["delay", "return to launch"], values, strict=True)))


def test_toast_breaks_no_line_inside_option(browser: Any, copters: Copters) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"]) as page:
        counts = page.evaluate("""async () => {
            const { element, unbroken } = await import("/static/dom.js");
            const text = "done; range not checked (serve --metadata FILE checks it)";
            const toast = element("button", { class: "toast" }, ...unbroken(text));
            document.getElementById("toasts").append(toast);
            return [...Array(300).keys()].map((width) => {
                toast.style.width = `${width + 120}px`;
                return toast.querySelector(".option").getClientRects().length;
            });
        }""")
        assert set(counts) == {1}


def test_dialog_words_share_line_and_tiles_are_apart(browser: Any, copters: Copters) -> None:
    with serving(copters[1]) as server, opened(browser, server["page"], 1280, 900) as page:
        page.locator("#readiness.good", has_text="Ready to arm").wait_for(timeout=30_000)
        page.click("button[data-order='arm']")
        words = page.locator("dialog p").first.locator("span:not(.target)")
        expected = "(ArduCopter) will arm the motors: propellers may start to turn."
        assert words.evaluate_all("all => all.map((each) => each.textContent.trim())") == [expected]
        page.click("dialog button >> text=Cancel")
        gap = page.evaluate("""() => {
            const values = document.querySelectorAll("#tiles-of-state dd > span");
            values[6].textContent = "100 % · 12.6 V";
            values[7].textContent = "10 · RTK fixed";
            const list = document.getElementById("tiles-of-state").getBoundingClientRect();
            const [left, right] = [values[6], values[7]].map((each) => each.getBoundingClientRect());
            return [right.left - left.right, left.height === right.height, right.right <= list.right];
        }""")
        assert gap[0] >= 14
        assert gap[1:] == [True, True]
