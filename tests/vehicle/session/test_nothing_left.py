"""Every operation, cancelled anywhere, leaves no task, timer, subscription or sink behind."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

import anyio
import pytest
from flight_harness import Flight, attached_sinks, in_the_air, open_flight, waiting_on_cells
from hypothesis import given, settings
from hypothesis import strategies as st

import aerokit
from aerokit import Position, Vehicle
from aerokit import messages as m
from aerokit._internal import geo
from aerokit.errors import AerokitError
from aerokit.events import ModeChanged
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing.clock import run_virtual
from aerokit.vehicle.commanding.setpoints import BodyVelocitySetpoint, VelocitySetpoint

Action = Callable[[Flight], Awaitable[object]]


def place(flight: Flight, north_m: float, east_m: float) -> Position:
    home = flight.vehicle.home.value
    latitude, longitude = geo.offset(home.latitude_deg, home.longitude_deg, north_m, east_m)
    return Position(latitude, longitude, altitude_relative_m=10.0)


async def fly_by_velocity(flight: Flight) -> None:
    async with flight.vehicle.guided.velocity() as stream:
        await stream.fly(VelocitySetpoint(north_m_s=2.0), 3.0)


async def fly_until_the_stream_stops(flight: Flight) -> None:
    async with flight.vehicle.guided.body_velocity(valid_for_s=0.5) as stream:
        stream.set(BodyVelocitySetpoint(forward_m_s=1.0))
        await anyio.sleep(3.0)


async def read_attitudes(flight: Flight) -> None:
    with flight.vehicle.subscribe(m.Attitude, ModeChanged, rate_hz=30.0, capacity=5) as items:
        for _ in range(20):
            await items.get(timeout=2.0)


async def follow_the_position(flight: Flight) -> None:
    count = 0
    async for _ in flight.vehicle.position.changes():
        count += 1
        if count == 5:
            return


async def wait_for_a_mode(flight: Flight) -> None:
    await flight.vehicle.mode.wait_until(lambda mode: mode.name == "ACRO", held_for=1.0, timeout=2.0)


async def want_a_rate(flight: Flight) -> None:
    with flight.vehicle.rate(m.RawImu, 10.0):
        await anyio.sleep(1.0)


async def ask_at_the_same_time(flight: Flight) -> None:
    async with anyio.create_task_group() as tasks:
        for _ in range(3):
            tasks.start_soon(flight.vehicle.command, MavCmd.GET_MESSAGE_INTERVAL, m.Attitude.ID)


async def a_pilot_interferes(flight: Flight) -> None:
    flight.copter.rc[2] = 1500
    flight.copter.set_mode(CopterMode.LOITER)
    await anyio.sleep(1.2)


async def the_radio_fails_for_a_while(flight: Flight) -> None:
    flight.copter.faults.silent = True
    try:
        await anyio.sleep(4.0)
    finally:
        flight.copter.faults.silent = False


async def some_frames_are_lost(flight: Flight) -> None:
    flight.copter.faults.drop_outgoing += 15
    flight.copter.faults.drop_incoming += 3


async def the_next_mode_is_refused(flight: Flight) -> None:
    flight.copter.faults.refuse(MavCmd.DO_SET_MODE, MavResult.FAILED, "No", times=1)


ACTIONS: list[Action] = [
    lambda flight: flight.vehicle.wait_ready(timeout=3.0),
    lambda flight: flight.vehicle.set_mode("GUIDED"),
    lambda flight: flight.vehicle.set_mode("AUTO"),
    lambda flight: flight.vehicle.hold(),
    lambda flight: flight.vehicle.arm(),
    lambda flight: flight.vehicle.disarm(),
    lambda flight: flight.vehicle.take_off(15.0),
    lambda flight: flight.vehicle.go_to(place(flight, 20.0, 0.0)),
    lambda flight: flight.vehicle.go_to(place(flight, 0.0, 30.0), speed_m_s=4.0, heading_deg=90.0, timeout=8.0),
    lambda flight: flight.vehicle.set_heading(45.0, relative=True),
    lambda flight: flight.vehicle.set_speed(3.0),
    lambda flight: flight.vehicle.look_at(place(flight, 5.0, 5.0)),
    lambda flight: flight.vehicle.stop_looking(),
    lambda flight: flight.vehicle.land(timeout=20.0),
    lambda flight: flight.vehicle.return_to_launch(timeout=20.0),
    lambda flight: flight.vehicle.why_not_armable(),
    lambda flight: flight.vehicle.reboot(timeout=10.0),
    lambda flight: flight.vehicle.command(31_000, retries=1),
    fly_by_velocity,
    fly_until_the_stream_stops,
    read_attitudes,
    follow_the_position,
    wait_for_a_mode,
    want_a_rate,
    ask_at_the_same_time,
    a_pilot_interferes,
    the_radio_fails_for_a_while,
    some_frames_are_lost,
    the_next_mode_is_refused,
]

NEW_STREAMS = 1
"""The frame counter of a stream stays after its last subscription: here of the raw IMU."""

moments = st.one_of(st.none(), st.sampled_from([0.0, 0.001, 0.04, 0.1, 0.35]), st.floats(0.0, 8.0))
steps = st.lists(st.tuples(st.sampled_from(range(len(ACTIONS))), moments), min_size=1, max_size=5)


async def attempt(flight: Flight, action: Action, cancelled_after: float | None) -> None:
    """Errors of ours are fine here; groups, foreign errors and calls that do not end are not."""
    with anyio.move_on_after(60.0 if cancelled_after is None else cancelled_after):
        with contextlib.suppress(AerokitError):
            await action(flight)


async def after_the_dust_has_settled(flight: Flight) -> None:
    """Holds are confirmed and rates released; then the state equals the initial one."""
    flight.copter.faults.clear()
    await anyio.sleep(18.0)  # An abandoned arm command is monitored for 15 s.
    with anyio.fail_after(5.0):
        while is_asking(flight.vehicle):  # noqa: ASYNC110
            await anyio.sleep(0.05)


def is_asking(vehicle: Vehicle) -> bool:
    """Return True while a command waits for its ack; the vehicle object requests streams again from time to time."""
    return any(lock.locked() for lock in vehicle._session.commands._locks.values())


def tasks() -> int:
    return len(asyncio.all_tasks())


async def nothing_remains_of(steps: list[tuple[int, float | None]], airborne: bool, latency_s: float) -> None:
    alone = tasks()
    opened = in_the_air if airborne else open_flight
    async with opened(latency_s=latency_s) as flight:
        vehicle, connection = flight.vehicle, flight.vehicle.connection
        await vehicle.wait_ready()
        await after_the_dust_has_settled(flight)
        before = (tasks(), waiting_on_cells(vehicle))
        sinks = attached_sinks(connection)
        for index, cancelled_after in steps:
            await attempt(flight, ACTIONS[index], cancelled_after)
        await after_the_dust_has_settled(flight)
        assert (tasks(), waiting_on_cells(vehicle)) == before
        assert attached_sinks(connection) <= sinks + NEW_STREAMS
        flight.wire.clear()
        await anyio.sleep(3.0)
        assert not flight.wire.setpoints()  # No set-point is supplied, so none is sent.
    assert attached_sinks(connection) <= 1  # the connection's own
    assert tasks() == alone


@pytest.mark.exhaustive
@given(steps=steps, airborne=st.booleans(), latency_s=st.sampled_from([0.0, 0.12]))
def test_any_sequence_with_any_cancellation(
    steps: list[tuple[int, float | None]], airborne: bool, latency_s: float
) -> None:
    run_virtual(nothing_remains_of(steps, airborne, latency_s))


@given(leave_after=st.floats(0.0, 12.0), how=st.sampled_from(["cancel", "raise", "return", "unplug"]))
@settings(max_examples=16)
def test_setpoint_stream_exit_in_flight_holds(leave_after: float, how: str) -> None:
    """Also while connecting: the block and all its operations end at once."""

    async def flying(flight: Flight) -> None:
        vehicle = flight.vehicle
        await vehicle.wait_ready()
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(3.0)
        await fly_by_velocity(flight)

    async def main() -> None:
        alone, loop = tasks(), asyncio.get_running_loop()
        ended_at = 0.0
        try:
            with anyio.move_on_after(leave_after if how == "cancel" else 1000.0):
                async with open_flight(SimulatedCopter(boot_time_s=0.5)) as flight:
                    if how == "unplug":
                        loop.call_later(leave_after, flight.wire.lose)
                    with anyio.move_on_after(leave_after if how in ("raise", "return") else 1000.0):
                        await flying(flight)
                    ended_at = loop.time()
                    if how == "raise":
                        raise ZeroDivisionError
        except (AerokitError, ZeroDivisionError):
            pass
        assert tasks() == alone
        assert loop.time() - max(ended_at, leave_after) < 40.0

    run_virtual(main())


@pytest.mark.anyio
async def test_thousand_calls_leak_nothing() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await anyio.sleep(3.0)
        before = (tasks(), waiting_on_cells(flight.vehicle), attached_sinks(flight.vehicle.connection))
        for _ in range(300):
            await flight.vehicle.command(MavCmd.GET_MESSAGE_INTERVAL, m.Attitude.ID)
            with anyio.move_on_after(0.0):
                await flight.vehicle.command(MavCmd.GET_MESSAGE_INTERVAL, m.Attitude.ID)
            with flight.vehicle.subscribe(m.Attitude, ModeChanged, rate_hz=20.0):
                pass
            with anyio.move_on_after(0.0):
                await flight.vehicle.mode.wait_until(lambda mode: False)
        await anyio.sleep(5.0)
        assert before == (
            tasks(),
            waiting_on_cells(flight.vehicle),
            attached_sinks(flight.vehicle.connection),
        )
        assert not flight.vehicle._session.commands._pending_acks


@pytest.mark.anyio
async def test_rates_requested_after_vehicle_block_attach_nothing() -> None:
    async with simulated_link(SimulatedCopter()) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            pass
        before = attached_sinks(connection)
        with vehicle.subscribe(m.ScaledImu2), vehicle.rate(m.RawImu, 3.0):
            vehicle.message(m.ScaledImu3)
        assert attached_sinks(connection) == before
