"""Events that a program can observe: modes, arming, texts, silence, reboots, link quality, a blocked loop."""

from __future__ import annotations

import asyncio
import itertools
import sys
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from flight_harness import Flight, block_loop, in_the_air, now, open_flight

import aerokit
from aerokit import messages as m
from aerokit.connection.bus import Subscription
from aerokit.connection.cells import Source
from aerokit.errors import LinkLost, OperationTimeout, StaleValueError, ValueUnknownError
from aerokit.events import (
    ArmedChanged,
    Event,
    LandedStateChanged,
    LinkClosed,
    LinkReport,
    LoopBlocked,
    ModeChanged,
    StatusTextReceived,
    VehicleRebooted,
    VehicleRecovered,
    VehicleSilent,
)
from aerokit.mavlink.enums import CopterMode
from aerokit.sim import SimulatedCopter, simulated_link

pytestmark = pytest.mark.anyio


def drained(events: Subscription[Any]) -> list[Event]:
    found: list[Event] = []
    while (event := events.get_nowait()) is not None:
        found.append(event)
    return found


async def test_heartbeat_before_connect_is_as_old_as_received() -> None:
    copter = SimulatedCopter()
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        await anyio.sleep(5.05)
        copter.faults.silent = True
        await anyio.sleep(1.0)
        async with aerokit.connect(connection) as vehicle:
            assert vehicle.heartbeat_age == vehicle.armed.age > 1.0
            await anyio.sleep(3.0)
            assert vehicle.is_silent


# ---------------------------------------------------------------------------- modes and arming


async def test_modes_and_arming(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    with vehicle.subscribe(ModeChanged, ArmedChanged, capacity=20) as events:
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        grounded.copter.set_mode(CopterMode.ALT_HOLD)
        await anyio.sleep(1.5)
        await vehicle.disarm()
        await anyio.sleep(2.0)
        found = drained(events)
    assert [type(event) for event in found] == [ModeChanged, ArmedChanged, ModeChanged, ArmedChanged]
    assert [(e.before, e.after) for e in found if isinstance(e, ModeChanged)] == [
        ("STABILIZE", "GUIDED"),
        ("GUIDED", "ALT_HOLD"),
    ]
    assert [event.is_armed for event in found if isinstance(event, ArmedChanged)] == [True, False]
    assert {event.system_id for event in found} == {1}
    assert all(earlier.at <= later.at <= now() for earlier, later in itertools.pairwise(found))


async def test_unchanged_state_publishes_nothing(grounded: Flight) -> None:
    kinds = (
        ModeChanged,
        ArmedChanged,
        LandedStateChanged,
        VehicleSilent,
        VehicleRecovered,
        VehicleRebooted,
        LoopBlocked,
    )
    with grounded.vehicle.subscribe(*kinds, capacity=20) as events:
        await anyio.sleep(30.0)
        assert events.get_nowait() is None


async def test_landed_state(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    with vehicle.subscribe(LandedStateChanged, capacity=20) as events:
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(5.0)
        await anyio.sleep(3.0)
        await vehicle.land()
        await anyio.sleep(3.0)
        states = []
        while (event := events.get_nowait()) is not None:
            states.append(event.after)
    assert states[-1] == 1
    assert 2 in states
    assert len(states) <= 4


# --------------------------------------------------------------------------------------- texts


async def test_repeated_status_text_is_two_events(grounded: Flight) -> None:
    with grounded.vehicle.subscribe(StatusTextReceived, capacity=20) as events:
        for _ in range(2):
            grounded.copter.send_text(4, "Bad GPS signal")
            await anyio.sleep(1.0)
        first, second = await events.get(timeout=2.0), await events.get(timeout=2.0)
    assert (first.severity, first.text) == (second.severity, second.text) == (4, "Bad GPS signal")
    assert second.at - first.at == pytest.approx(1.0, abs=0.3)


async def test_long_status_text_is_joined(grounded: Flight) -> None:
    text = "This text has more than fifty characters and therefore it travels in several chunks, joined here."
    with grounded.vehicle.subscribe(StatusTextReceived, capacity=20) as events:
        grounded.copter.send_text(6, text)
        event = await events.get(timeout=5.0)
    assert event.text == text
    assert grounded.vehicle.status_text.value.text == text


# ----------------------------------------------------------------------------- silence, reboot


async def test_silence_and_return_publish_events(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    with vehicle.subscribe(VehicleSilent, VehicleRecovered, capacity=20) as events:
        grounded.copter.faults.silent = True
        silent = await events.get(timeout=10.0)
        assert isinstance(silent, VehicleSilent)
        assert 3.5 < silent.silent_for_s < 4.7
        assert vehicle.is_silent
        assert vehicle.heartbeat_age > 3.5
        await anyio.sleep(10.0)
        assert events.get_nowait() is None  # Reported once.
        grounded.copter.faults.silent = False
        back = await events.get(timeout=3.0)
        assert isinstance(back, VehicleRecovered)
        assert back.silent_for_s > 13.0
        assert vehicle.is_silent is False


async def test_silence_is_detected_despite_other_traffic(grounded: Flight) -> None:
    with grounded.vehicle.subscribe(VehicleSilent, capacity=5) as events:
        grounded.copter.faults.heartbeats_stopped = True
        assert await events.get(timeout=10.0)
        assert grounded.vehicle.attitude.fresh(within=0.5)


async def test_unordered_reboot_is_detected(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    await anyio.sleep(10.0)
    with vehicle.subscribe(VehicleRebooted, capacity=20) as events:
        restarted_at = now()
        grounded.copter.restart()
        event = await events.get(timeout=10.0)
        assert event.at - restarted_at < 6.0
        await anyio.sleep(20.0)
        assert events.get_nowait() is None  # one reboot is one event


async def test_frozen_autopilot_is_silent_without_reboot(grounded: Flight) -> None:
    await anyio.sleep(10.0)
    with grounded.vehicle.subscribe(VehicleSilent, VehicleRecovered, VehicleRebooted, capacity=20) as events:
        grounded.copter.faults.frozen = True
        await anyio.sleep(10.0)
        grounded.copter.faults.frozen = False
        await anyio.sleep(5.0)
        assert [type(event) for event in drained(events)] == [VehicleSilent, VehicleRecovered]


# ------------------------------------------------------------------------------------- the link


async def test_link_report_is_published_every_second(grounded: Flight) -> None:
    await anyio.sleep(1.5)
    with grounded.vehicle.subscribe(LinkReport, capacity=20) as events:
        await anyio.sleep(5.05)
        reports = [events.get_nowait() for _ in range(6)]
    assert [report is None for report in reports] == [False] * 5 + [True]
    for report in reports[:5]:
        assert report is not None
        assert report.loss_percent == 0.0
        assert 40.0 < report.frames_per_s < 80.0
        assert 1000.0 < report.bytes_per_s < 5000.0
    assert grounded.vehicle.link_quality.value == reports[4]
    assert grounded.vehicle.link_quality.source == Source(1, 1, "link")


async def test_loss_is_measured(grounded: Flight) -> None:
    grounded.copter.faults.loss = 0.3
    await anyio.sleep(2.0)
    with grounded.vehicle.subscribe(LinkReport, capacity=40) as events:
        await anyio.sleep(20.0)
        losses = [report.loss_percent for report in iter(events.get_nowait, None)]
    assert all(loss is not None for loss in losses)
    assert sum(loss or 0.0 for loss in losses) / len(losses) == pytest.approx(30.0, abs=6.0)


async def test_single_lost_frame_is_counted(grounded: Flight) -> None:
    received, lost = grounded.vehicle.connection.counts(1)
    grounded.copter.faults.drop_outgoing = 1
    await anyio.sleep(2.0)
    assert grounded.vehicle.connection.counts(1)[1] == lost + 1
    assert grounded.vehicle.connection.counts(1)[0] > received


async def test_link_report_without_traffic_has_no_loss(grounded: Flight) -> None:
    grounded.copter.faults.silent = True
    await anyio.sleep(3.0)
    report = grounded.vehicle.link_quality.value
    assert (report.loss_percent, report.frames_per_s) == (None, 0.0)


async def test_round_trip_is_measured() -> None:
    async with open_flight(latency_s=0.15) as flight:
        await anyio.sleep(6.0)
        assert flight.vehicle.link_quality.value.round_trip_s == pytest.approx(0.3, abs=0.001)


async def test_timesync_answers_to_others_are_no_round_trip() -> None:
    async with open_flight(latency_s=0.15) as flight:
        await anyio.sleep(6.0)
        flight.copter.send(m.Timesync(int(5e9), int((now() - 0.01) * 1e9)))  # Requested by another station.
        await anyio.sleep(1.2)
        assert flight.vehicle.link_quality.value.round_trip_s == pytest.approx(0.3, abs=0.001)


async def test_timesync_answer_of_companion_first_is_ignored() -> None:
    async with open_flight(latency_s=0.15) as flight:

        def answer_first(question: m.Timesync, _: object) -> None:
            flight.copter.send(m.Timesync(1, question.ts1), sender=(1, 191))

        flight.copter.observe(m.Timesync, answer_first)
        with flight.vehicle.subscribe(VehicleRebooted) as reboots:
            await anyio.sleep(6.0)
            answer = flight.vehicle._session.watch._last_answer
            assert now() - answer.read_at < 3.0
            assert answer.milliseconds > 1000
            assert reboots.get_nowait() is None


async def test_calls_link_lost_raise(grounded: Flight) -> None:
    with grounded.vehicle.subscribe(LinkClosed, capacity=2) as events:
        grounded.wire.lose()
        event = await events.get(timeout=1.0)
        assert isinstance(event.error, LinkLost)
        with pytest.raises(LinkLost):
            await events.get(timeout=1.0)


# -------------------------------------------------------------------------------- a blocked loop


async def test_blocked_loop_publishes_event(grounded: Flight) -> None:
    with grounded.vehicle.subscribe(LoopBlocked, capacity=5) as events:
        await anyio.sleep(1.0)
        block_loop(0.2)
        await anyio.sleep(1.0)
        assert events.get_nowait() is None
        block_loop(1.5)
        event = await events.get(timeout=1.0)
        assert event.system_id == 0
        assert event.seconds == pytest.approx(1.5, abs=0.15)


async def test_loop_blocked_for_long_logs_warning(grounded: Flight, caplog: pytest.LogCaptureFixture) -> None:
    await anyio.sleep(1.0)
    block_loop(0.5)
    await anyio.sleep(1.0)
    assert not caplog.records
    block_loop(6.0)
    await anyio.sleep(1.0)
    (warning,) = caplog.records
    assert (warning.name, warning.levelname) == ("aerokit", "WARNING")
    assert warning.getMessage().startswith("the event loop was blocked for 6.")
    assert "time.sleep" in warning.getMessage()


class FakeShell:
    """The interface of IPython 9's terminal."""

    active_eventloop: str | None = None


@pytest.mark.parametrize("gui", [None, "asyncio"])
async def test_terminal_ipython_without_gui_asyncio_is_named(
    gui: str | None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    shell, loop = FakeShell(), asyncio.get_running_loop()
    shell.active_eventloop = gui
    terminal = SimpleNamespace(TerminalInteractiveShell=SimpleNamespace(_instance=shell))
    monkeypatch.setitem(sys.modules, "IPython.terminal.interactiveshell", terminal)
    monkeypatch.setitem(sys.modules, "IPython.core.async_helpers", SimpleNamespace(_asyncio_event_loop=loop))
    async with open_flight():
        block_loop(3.0)
        await anyio.sleep(1.0)
    named = ["%gui asyncio" in record.getMessage() for record in caplog.records]
    assert named == ([True, True] if gui is None else [False])


async def test_blocked_loop_is_not_vehicle_silence(grounded: Flight) -> None:
    """Messages received meanwhile wait in the socket's buffer and are read before the vehicle counts as silent."""
    with grounded.vehicle.subscribe(VehicleSilent, VehicleRebooted, capacity=5) as events:
        block_loop(10.0)
        await anyio.sleep(3.0)
        assert events.get_nowait() is None


# --------------------------------------------------------------------------- ages and sources


async def test_values_have_time_and_source(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    assert vehicle.attitude.source == Source(1, 1, "ATTITUDE")
    assert vehicle.mode.source == Source(1, 1, "HEARTBEAT")
    assert vehicle.attitude.age < 0.15
    grounded.copter.faults.silent = True
    await anyio.sleep(2.5)
    assert vehicle.attitude.age == pytest.approx(2.5, abs=0.15)
    assert vehicle.attitude.value is vehicle.attitude.latest  # `value` returns an old value, too.
    with pytest.raises(StaleValueError, match=r"attitude is 2\.\d s old.*no ATTITUDE since"):
        vehicle.attitude.fresh(within=1.0)
    assert vehicle.attitude.fresh(within=5.0)


async def test_missing_state_is_unknown(grounded: Flight) -> None:
    with pytest.raises(ValueUnknownError, match="range_finders is not known yet: no DISTANCE_SENSOR"):
        _ = grounded.vehicle.range_finders.value
    assert grounded.vehicle.range_finders.latest is None
    with pytest.raises(OperationTimeout, match="range_finders is not known yet"):
        await grounded.vehicle.range_finders.wait_until(lambda _: True, timeout=2.0)


async def test_wait_until_held_for() -> None:
    async with in_the_air() as flight:
        started = now()
        position = await flight.vehicle.position.wait_until(
            lambda p: (p.altitude_relative_m or 0.0) > 9.0, held_for=2.0, timeout=5.0
        )
        assert now() - started == pytest.approx(2.0, abs=0.01)
        assert position.altitude_relative_m == pytest.approx(10.0, abs=0.5)


async def test_wait_until_ends_with_connection(grounded: Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def unplug() -> None:
            await anyio.sleep(1.0)
            grounded.wire.lose()

        tasks.start_soon(unplug)
        with pytest.raises(LinkLost):
            await grounded.vehicle.mode.wait_until(lambda mode: mode.name == "RTL")


async def test_stored_position_before_fix_is_ignored() -> None:
    async with open_flight(SimulatedCopter(boot_time_s=60.0)) as flight:
        await anyio.sleep(8.0)
        assert flight.vehicle.attitude.is_known
        with pytest.raises(ValueUnknownError):
            flight.vehicle.position.fresh(within=10.0)
