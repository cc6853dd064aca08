"""``aerokit monitor``, driven by keys against simulated vehicles, on virtual time."""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import anyio
import pytest
from flight_harness import Wire, open_flight
from rich.style import Style
from textual.widgets import RichLog

from aerokit.apps.cli import main
from aerokit.apps.cli.listening import _event_text
from aerokit.apps.monitor import app as monitor
from aerokit.apps.monitor import model as model_module
from aerokit.apps.monitor.app import ConfirmScreen, Monitor, Panel
from aerokit.apps.monitor.lines import DANGER, LINK_STYLES, WARNING, Canvas, VehicleText, _heading, number
from aerokit.apps.monitor.model import SEVERITY_STYLES, MonitorModel, _event_line
from aerokit.connection.opening import open_connection
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import LinkLost
from aerokit.events import (
    ArmedChanged,
    DuplicateSender,
    LandedStateChanged,
    ParameterChanged,
    StreamSlow,
    VehicleFound,
    VehicleSilent,
)
from aerokit.mavlink.enums import MavCmd, MavLandedState
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.vehicle.connect import vehicles_on
from aerokit.vehicle.vehicle import Vehicle

pytestmark = pytest.mark.anyio


@dataclass
class Stage:
    app: Monitor
    pilot: Any
    wire: Wire
    copters: list[SimulatedCopter]

    async def press(self, *keys: str) -> None:
        await self.pilot.press(*keys)
        await anyio.sleep(0.5)
        self.app.update_view()

    async def wait_drawn(self, text: str) -> None:
        """Wait until the text is on the screen, which is drawn in real time."""
        for _ in range(100):
            if text in self.screen():
                break
            await self.pilot.pause(0.02)

    def screen(self) -> str:
        """Return the text on the screen."""
        lines = self.app.screen._compositor.render_strips()
        return "\n".join("".join(segment.text for segment in strip) for strip in lines)

    def mode_commands(self) -> list[int]:
        """Return the system ids of mode commands."""
        return [each.target_system for each in self.wire.commands(MavCmd.DO_SET_MODE)]


@asynccontextmanager
async def stage(count: int = 2, size: tuple[int, int] = (80, 24)) -> AsyncIterator[Stage]:
    copters = [SimulatedCopter(system_id=1 + number, boot_time_s=0.0) for number in range(count)]
    async with simulated_link(copters) as link:
        wire = Wire(link)
        async with open_connection(wire) as connection, vehicles_on(connection) as vehicles:
            model, commands = MonitorModel(connection, vehicles), BackgroundTasks(connection.fail)
            app = Monitor(model, commands, "memory")
            async with app.run_test(size=size) as pilot:
                await anyio.sleep(6)
                app.update_view()
                await pilot.pause()
                wire.clear()
                yield Stage(app, pilot, wire, copters)
            model.close()
            await commands.aclose()


async def test_monitor_commands_named_vehicle_after_confirmation() -> None:
    async with stage() as it:
        await it.wait_drawn("2 vehicles")
        assert "2 vehicles" in it.screen()
        await it.wait_drawn("STABILIZE  disarmed")
        assert "STABILIZE  disarmed" in it.screen()
        assert "HEARTBEAT" in str([name for name, _ in it.app._model.rates(1)])
        for keys in (("l",), ("enter",), ("h",), ("n",), ("r",), ("escape",), ("r",), ("q",)):
            await it.press(*keys)
        assert not isinstance(it.app.screen, ConfirmScreen)
        assert it.mode_commands() == []
        await it.press("down")
        await it.press("l")
        assert isinstance(it.app.screen, ConfirmScreen)
        assert it.app.screen.text == "LAND: vehicle 2?"
        assert it.mode_commands() == []
        await it.press("y")
        assert set(it.mode_commands()) == {2}
        assert [each.mode.value.name for each in it.app._model.vehicles.values()] == ["STABILIZE", "LAND"]
        await it.wait_drawn("land: sending")
        assert "land: sending" in it.screen()


@pytest.mark.exhaustive
async def test_command_goes_to_vehicle_in_question_despite_selection() -> None:
    async with stage() as it:
        await it.press("h")
        it.app.screen_stack[0].query_one("#vehicles").highlighted = 1  # type: ignore[attr-defined]
        await it.press("right", "enter")
        assert it.app.selected is not None
        assert it.app.selected.system_id == 2
        assert set(it.mode_commands()) == {1}
        await it.wait_drawn("hold: in BRAKE, may still be stopping")


async def test_refusal_and_old_values_are_shown() -> None:
    async with stage(1) as it:
        it.copters[0].faults.refuse(MavCmd.DO_SET_MODE, 2, "no")
        await it.press("h")
        await it.press("y")
        await it.wait_drawn("hold failed")
        assert "hold failed" in it.screen()
        it.wire._link.close()  # the vehicle becomes silent
        await anyio.sleep(20)
        it.app.update_view()
        await it.wait_drawn("values are from before")
        screen = it.screen()
        assert "; values are from before" in screen
        assert "STABILIZE  disarmed" in screen
        assert " old)" not in screen


@pytest.mark.exhaustive
async def test_reason_against_arming_is_requested_from_vehicle() -> None:
    """By itself, ArduPilot sends the reasons every 30 s."""
    async with stage(1) as it:
        it.copters[0].faults.prearm_failures.append("Compass not healthy")
        await anyio.sleep(4)
        it.app.update_view()
        await anyio.sleep(3)
        it.app.update_view()
        await it.wait_drawn("Compass not healthy")
        await anyio.sleep(20)
    assert len(it.wire.commands(MavCmd.RUN_PREARM_CHECKS)) == 1


async def test_control_characters_in_texts_are_replaced() -> None:
    async with stage(1) as on:
        on.copters[0].send_text(4, "hello \x1b[2J\x9b2J \x1b]0;title\x07 there")
        await anyio.sleep(2)
        on.app.update_view()
        shown = "".join(segment.text for strip in on.app.query_one("#texts", RichLog).lines for segment in strip)
        assert "hello" in shown
        assert not {"\x1b", "\x9b", "\x07"} & set(shown)


async def test_message_counts_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_module, "MAX_MESSAGE_TYPES", 3)
    async with stage(1) as on:
        await on.press()
        rates = on.app._model.rates(1)
        assert len(rates) == 3
        assert any(hz > 0 for _, hz in rates)


async def test_without_vehicle_monitor_shows_reason_and_no_zeros() -> None:
    async with stage(0) as it:
        await it.wait_drawn("waiting for a vehicle's heartbeat")
        assert "waiting for a vehicle's heartbeat" in it.screen()
        await it.press("l")
        assert not isinstance(it.app.screen, ConfirmScreen)


async def test_connection_end_ends_monitor(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run(app: Monitor) -> None:
        async with app.run_test(size=(80, 24)) as pilot:
            await anyio.sleep(3)
            wire.lose()
            await pilot.pause()
            assert not app.is_running or app._exit

    monkeypatch.setattr(Monitor, "run_async", run)
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
        wire = Wire(link)
        with pytest.raises(LinkLost, match="unplugged"):
            await monitor.run_monitor(wire)


def test_monitor_without_terminal_exits_with_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", "tcp:127.0.0.1:1"]) == 2
    assert "needs a terminal" in capsys.readouterr().err


def test_canvas_keeps_north_up_and_points_inside() -> None:
    canvas = Canvas(20, 5, [(0.0, 0.0), (100.0, 0.0), (0.0, -50.0)])
    canvas.line([(0.0, -50.0), (50.0, -50.0)], "red")
    canvas.mark((100.0, 0.0), "↑1", "bold")
    lines = canvas.text().plain.split("\n")
    assert len(lines) == 5
    assert "↑1" in lines[0]
    assert all(any(character > "\u2800" for character in lines[row]) for row in (2, 3))  # without gaps
    assert lines[-1].endswith("▲N")


@pytest.mark.parametrize("span_m", [20.0, 60.0, 333.0, 9000.0])
def test_canvas_scale_bar_has_length_it_states(span_m: float) -> None:
    columns = 61
    canvas = Canvas(columns, 40, [(0.0, 0.0), (0.0, span_m)])
    bar = canvas.text().plain.split("\n")[-1].removesuffix("▲N").rstrip()
    assert bar.endswith(" m" if span_m < 1000 else " km")
    length, unit = bar.rpartition("┤ ")[2].split()
    metres = float(length) * (1000 if unit == "km" else 1)
    assert metres / span_m == pytest.approx(len(bar.partition(" ")[0]) / columns, abs=0.03)


@pytest.mark.parametrize(
    ("value", "text"),
    [(-0.04, "0.0 m/s"), (-0.06, "-0.1 m/s"), (0.04, "0.0 m/s"), (0.06, "+0.1 m/s"), (None, "—")],
)
def test_number_has_no_sign_for_zero(value: float | None, text: str) -> None:
    assert number(value, 1, " m/s", "+") == text


@pytest.mark.exhaustive
@pytest.mark.parametrize(("heading_deg", "text"), [(0.2, "0°"), (359.4, "359°"), (359.7, "0°"), (-10.0, "350°")])
def test_heading_has_no_360_degrees(heading_deg: float, text: str) -> None:
    assert _heading(heading_deg) == text


async def test_heading_is_shown_once_and_zero_without_sign() -> None:
    async with stage(1) as it:
        await it.wait_drawn("climb")
        screen = it.screen()
    assert "climb 0.0 m/s" in screen
    assert "heading" in screen
    assert "yaw" not in screen
    assert "-0" not in screen.replace("-35", "")


@pytest.mark.exhaustive
async def test_wide_terminal_shows_more_and_puts_texts_below_map() -> None:
    async with stage(2, size=(200, 50)) as it:
        await it.wait_drawn("throttle")
        lines = it.screen().splitlines()
    (texts,) = [line for line in lines if "texts and events" in line]
    assert texts.index("texts and events") > 64
    for label in ("home", "wind", "version", "ready"):
        assert any(label in line for line in lines)
    empty = sum(line[1:60].strip() == "" for line in lines)
    assert empty < len(lines) / 3


async def test_wide_row_of_armed_vehicle_is_not_ready() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        assert VehicleText(flight.vehicle).list_row(is_selected=True, more=True).plain.split()[-1] == "ready"
        await flight.vehicle.arm()
        assert VehicleText(flight.vehicle).list_row(is_selected=True, more=True).plain.split()[-1] == "armed"


@pytest.mark.parametrize(
    ("size", "shown"),
    [
        ((60, 30), ["cannot arm: Compass", "RC", "Gyro"]),
        ((60, 11), ["cannot arm: Compass", "RC (and 1 more)"]),
        ((0, 0), ["cannot arm: Compass (and 2 more)"]),
    ],
)
async def test_state_lists_missing_reasons_where_room(size: tuple[int, int], shown: list[str]) -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(flight.vehicle), "missing_for_flight", lambda _: ["Compass", "RC", "Gyro"])
            rows = dict(VehicleText(flight.vehicle).rows(size=size))
        assert rows["missing"].plain.split("\n") == shown


@pytest.mark.exhaustive
async def test_tall_wide_terminal_lists_all_missing_reasons() -> None:
    names = ("horizontal velocity", "relative horizontal position", "absolute horizontal position", "vertical speed")
    reasons = [f"the estimator has no {name} (EKF_STATUS_REPORT)" for name in names]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Vehicle, "missing_for_flight", lambda _: reasons)
        async with stage(1, size=(130, 50)) as it:
            it.app.update_view()
            await it.wait_drawn("vertical speed")
            assert all(name.split()[-1] in it.screen() for name in names)
            assert "more)" not in it.app._state_content()[1][1].plain


@pytest.mark.exhaustive
async def test_key_shows_all_missing_reasons_in_small_terminal() -> None:
    reasons = [*(f"reason {number}" for number in range(1, 10)), "home (HOME_POSITION not received)"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Vehicle, "missing_for_flight", lambda _: reasons)
        async with stage(1, size=(80, 24)) as it:
            await it.press("m")
            await it.wait_drawn("also missing for flight: home")
            assert all(f"reason {number}" in it.screen() for number in range(1, 10))
            reasons.insert(0, "a new one")
            await it.wait_drawn("cannot arm: a new one")
            await it.press("m")
            await it.press("m", "escape")
            assert len(it.app.screen_stack) == 1
            assert it.app.is_running


@pytest.mark.exhaustive
async def test_vehicle_without_mission_shows_no_item() -> None:
    async with stage(1, size=(200, 50)) as it:
        await it.wait_drawn("mission")
        assert "No mission" in it.screen()


async def test_slow_streams_are_one_line_with_count() -> None:
    async with stage(1) as it:
        bus, texts = it.app._model.connection.bus, it.app.query_one("#texts", RichLog)
        before = len(texts.lines)
        for number_ in range(40):
            bus.publish(StreamSlow(1.0, 1, f"MESSAGE_{number_}", 2.0, 0.5))
        await it.press()
        assert len(texts.lines) == before
        assert str(texts.border_subtitle).startswith("40 × stream slow, last ")
        assert str(texts.border_subtitle).endswith(" 1 MESSAGE_39 0.5 of 2 Hz")


@pytest.mark.exhaustive
async def test_idle_monitor_draws_only_changed_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    async with stage(2) as it:
        await anyio.sleep(10)
        it.app.update_view()
        drawn: Counter[str | None] = Counter()
        show = Panel.show

        def count(panel: Panel, content: Any) -> None:
            drawn[panel.id] += 1
            show(panel, content)

        monkeypatch.setattr(Panel, "show", count)
        for _ in range(60):
            await anyio.sleep(0.5)
            it.app.update_view()
    assert set(drawn) <= {"rates"}
    assert drawn["rates"] <= 30  # the rates are counted once a second


def test_text_styles_are_readable_on_light_and_dark_terminals() -> None:
    """A background needs a foreground; without one, no colour that is as bright as white or as dark as black."""
    styles = [DANGER, WARNING, *LINK_STYLES.values(), *SEVERITY_STYLES]
    for style in map(Style.parse, styles):
        if style.bgcolor is not None:
            assert (style.color and style.color.name, style.bgcolor.name) in {
                ("white", "red"),
                ("black", "yellow"),
            }
        else:
            assert style.color is None or style.color.name in {"red", "magenta", "green"}


@pytest.mark.exhaustive
async def test_vehicles_behind_one_peer_are_not_heard_twice() -> None:
    copters = [SimulatedCopter(system_id=1 + number_, boot_time_s=0.0) for number_ in range(3)]
    async with simulated_link(copters) as link, open_connection(link) as connection, vehicles_on(connection):
        events: list[DuplicateSender] = []
        connection.bus.attach_event(DuplicateSender, events.append)
        await anyio.sleep(60)
        assert len(connection.heartbeats) == 3
    assert events == []


def test_event_text_rounds_float_below_1000_without_exponent() -> None:
    assert _event_text(VehicleSilent(1.0, 1, 999.7)) == "VehicleSilent  silent for 1000 s"
    assert _event_text(VehicleSilent(1.0, 1, 999.4)) == "VehicleSilent  silent for 999 s"


async def test_event_text_uses_enum_names() -> None:
    landed = LandedStateChanged(1.0, 1, MavLandedState.ON_GROUND, MavLandedState.TAKEOFF)
    changed = ParameterChanged(1.0, 1, "WPNAV_SPEED", 1234.5, 0.1354)
    assert _event_line(landed) == "landed state changed: ON_GROUND → TAKEOFF"
    assert _event_line(changed) == "parameter changed: WPNAV_SPEED, 1234 → 0.135, component 1"
    assert _event_line(ArmedChanged(1.0, 1, False)) == "armed changed: not armed"
    assert _event_text(landed) == "LandedStateChanged  ON_GROUND → TAKEOFF"
    assert _event_line(DuplicateSender(1.0, 1, 1)) == (
        "duplicate sender: component 1, a second sender has the same ids, and is ignored"
    )
    assert _event_text(VehicleFound(1.0, 1, 1, 2, 3)) == "VehicleFound  component 1, QUADROTOR, ARDUPILOTMEGA"
    assert _event_text(VehicleFound(1.0, 1, 1, 250, 3)) == "VehicleFound  component 1, vehicle type 250, ARDUPILOTMEGA"
    assert _event_text(VehicleSilent(1.0, 1, 3.5)) == "VehicleSilent  silent for 3.5 s"
