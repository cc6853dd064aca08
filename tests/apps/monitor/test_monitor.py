"""``aerokit monitor``, driven by keys against simulated vehicles, on virtual time."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import anyio
import pytest
from flight_harness import Wire
from textual.widgets import RichLog

from aerokit.apps.cli import main
from aerokit.apps.cli.events import _text
from aerokit.apps.monitor import app as monitor
from aerokit.apps.monitor import watch as watch_module
from aerokit.apps.monitor.app import Monitor, Question
from aerokit.apps.monitor.lines import Canvas
from aerokit.apps.monitor.watch import Watch, _words
from aerokit.connection.opening import open_connection
from aerokit.connection.tasks import Background
from aerokit.errors import LinkLost
from aerokit.events import LandedStateChanged, ParameterChanged
from aerokit.mavlink.enums import MavCmd, MavLandedState
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.vehicle.connect import vehicles_on

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
        self.app.look()

    async def drawn(self, text: str) -> None:
        """Wait until that can be drawn: a screen draws at its next frame, in the time of the test."""
        for _ in range(100):
            if text in self.screen():
                break
            await self.pilot.pause(0.02)

    def screen(self) -> str:
        """What stands on the terminal."""
        lines = self.app.screen._compositor.render_strips()
        return "\n".join("".join(segment.text for segment in strip) for strip in lines)

    def mode_orders(self) -> list[int]:
        """Who was sent a mode."""
        return [each.target_system for each in self.wire.commands(MavCmd.DO_SET_MODE)]


@asynccontextmanager
async def stage(count: int = 2) -> AsyncIterator[Stage]:
    copters = [SimulatedCopter(system_id=1 + number, boot_time_s=0.0) for number in range(count)]
    async with simulated_link(copters) as link:
        wire = Wire(link)
        async with open_connection(wire) as connection, vehicles_on(connection) as vehicles:
            watch, orders = Watch(connection, vehicles), Background(connection.fail)
            app = Monitor(watch, orders, "memory")
            async with app.run_test(size=(80, 24)) as pilot:
                await anyio.sleep(6)
                app.look()
                await pilot.pause()
                wire.forget()
                yield Stage(app, pilot, wire, copters)
            watch.close()
            await orders.aclose()


async def test_it_shows_what_is_known_and_orders_only_after_a_yes_and_only_the_one_that_was_named() -> None:
    async with stage() as it:
        await it.drawn("2 vehicles")
        assert "2 vehicles" in it.screen()
        await it.drawn("STABILIZE  disarmed")
        assert "STABILIZE  disarmed" in it.screen()
        assert "HEARTBEAT" in str([name for name, _ in it.app._watch.rates(1)])
        for keys in (("l",), ("enter",), ("h",), ("n",), ("r",), ("escape",), ("r",), ("q",)):
            await it.press(*keys)
        assert not isinstance(it.app.screen, Question)
        assert it.mode_orders() == []
        await it.press("down")
        await it.press("l")
        assert isinstance(it.app.screen, Question)
        assert it.app.screen.text == "LAND: vehicle 2?"
        assert it.mode_orders() == []
        await it.press("y")
        assert set(it.mode_orders()) == {2}
        assert [each.mode.value.name for each in it.app._watch.vehicles.values()] == ["STABILIZE", "LAND"]
        await it.drawn("land was ordered")
        assert "land was ordered" in it.screen()


async def test_an_order_goes_to_the_vehicle_in_the_question_whichever_is_selected_by_then() -> None:
    async with stage() as it:
        await it.press("h")
        it.app.screen_stack[0].query_one("#vehicles").highlighted = 1  # type: ignore[attr-defined]
        await it.press("right", "enter")
        assert it.app.selected is not None
        assert it.app.selected.system_id == 2
        assert set(it.mode_orders()) == {1}


async def test_a_refusal_is_shown_and_what_is_old_has_its_age() -> None:
    async with stage(1) as it:
        it.copters[0].faults.refuse(MavCmd.DO_SET_MODE, 2, "no")
        await it.press("h")
        await it.press("y")
        await it.drawn("hold failed")
        assert "hold failed" in it.screen()
        it.wire._link.close()  # it says nothing more
        await anyio.sleep(20)
        it.app.look()
        await it.drawn("old)")
        assert "old)" in it.screen()
        await it.drawn("silent")
        assert "silent" in it.screen()


async def test_what_a_vehicle_says_does_not_command_the_terminal() -> None:
    async with stage(1) as on:
        on.copters[0].send_text(4, "hello \x1b[2J\x9b2J \x1b]0;title\x07 there")
        await anyio.sleep(2)
        on.app.look()
        shown = "".join(
            segment.text for strip in on.app.query_one("#texts", RichLog).lines for segment in strip
        )
        assert "hello" in shown
        assert not {"\x1b", "\x9b", "\x07"} & set(shown)


async def test_made_up_messages_fill_no_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch_module, "MOST_KINDS", 3)
    async with stage(1) as on:
        await on.press()
        rates = on.app._watch.rates(1)
        assert len(rates) == 3
        assert any(hz > 0 for _, hz in rates)


async def test_of_nothing_heard_it_says_what_it_waits_for_and_nothing_is_zero() -> None:
    async with stage(0) as it:
        await it.drawn("waiting for the heartbeat of a vehicle")
        assert "waiting for the heartbeat of a vehicle" in it.screen()
        await it.press("l")
        assert not isinstance(it.app.screen, Question)


async def test_the_end_of_the_connection_is_the_end_of_the_monitor(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run(app: Monitor) -> None:
        async with app.run_test(size=(80, 24)) as pilot:
            await anyio.sleep(3)
            wire.lose()
            await pilot.pause()
            assert not app.is_running or app._exit

    monkeypatch.setattr(Monitor, "run_async", run)
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
        wire = Wire(link)
        with pytest.raises(LinkLost, match="pulled out"):
            await monitor.run_monitor(wire)


def test_without_a_terminal_it_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", "tcp:127.0.0.1:1"]) == 2
    assert "needs a terminal" in capsys.readouterr().err


def test_a_map_keeps_north_up_and_all_points_inside() -> None:
    canvas = Canvas(20, 5, [(0.0, 0.0), (100.0, 0.0), (0.0, -50.0)])
    canvas.dot((0.0, -50.0), "red")
    canvas.mark((100.0, 0.0), "↑1", "bold")
    lines = canvas.text().plain.split("\n")
    assert len(lines) == 5
    assert "↑1" in lines[0]
    assert any(ord(character) > 0x2800 for character in lines[-1])


async def test_an_event_has_names_as_the_command_events_has() -> None:
    landed = LandedStateChanged(1.0, 1, MavLandedState.ON_GROUND, MavLandedState.TAKEOFF)
    changed = ParameterChanged(1.0, 1, "WPNAV_SPEED", 1234.5, 0.1354)
    assert _words(landed) == "landed state changed: before ON_GROUND, after TAKEOFF"
    assert _words(changed) == "parameter changed: name WPNAV_SPEED, before 1234, after 0.135, component id 1"
    details = {"before": landed.before, "after": landed.after}
    assert _text(landed, details) == "LandedStateChanged  before ON_GROUND, after TAKEOFF"
