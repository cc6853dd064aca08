"""Taking off, going somewhere, coming back: each call returns when the vehicle has completed the action."""

from __future__ import annotations

import asyncio
import math
from functools import partial
from typing import Any

import anyio
import pytest
from flight_harness import Flight, in_the_air, now, open_flight, open_px4, speed_of

from aerokit import Position
from aerokit import messages as m
from aerokit._internal import geo
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
    StaleValueError,
)
from aerokit.mavlink.enums import CopterMode, MavCmd, MavLandedState, MavResult
from aerokit.sim import SimulatedCopter
from aerokit.vehicle.commanding import flight
from aerokit.vehicle.commanding.ground import GroundCheck
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint
from aerokit.vehicle.state.movement import Velocity

pytestmark = pytest.mark.anyio

GUIDED, BRAKE, LOITER, LAND, RTL = (
    CopterMode.GUIDED,
    CopterMode.BRAKE,
    CopterMode.LOITER,
    CopterMode.LAND,
    CopterMode.RTL,
)


def north_of_home(flight: Flight, north_m: float, altitude_m: float = 10.0) -> Position:
    home = flight.vehicle.home.value
    latitude, longitude = geo.offset(home.latitude_deg, home.longitude_deg, north_m, 0.0)
    return Position(latitude, longitude, altitude_relative_m=altitude_m)


async def cancelled_after(seconds: float, action: object) -> None:
    """Run a coroutine and cancel it while it is in progress."""
    with anyio.move_on_after(seconds) as scope:
        await action  # type: ignore[misc]
    assert scope.cancelled_caught


# ------------------------------------------------------------------------------------ readiness


async def test_wait_ready_says_what_is_missing() -> None:
    async with open_flight(SimulatedCopter(boot_time_s=40.0)) as flight:
        with pytest.raises(OperationTimeout) as caught:
            await flight.vehicle.wait_ready(timeout=6.3)
    text = str(caught.value)
    assert "not ready within 6.3 s" in text
    assert "home (HOME_POSITION not received)" in text
    assert "position (GLOBAL_POSITION_INT with a fix not received)" in text
    assert "absolute horizontal position" in text
    assert "last heartbeat 0." in text


async def test_wait_ready_returns_when_the_vehicle_can_be_armed() -> None:
    async with open_flight(SimulatedCopter(boot_time_s=20.0)) as flight:
        await flight.vehicle.wait_ready()
        assert flight.vehicle.missing_for_flight() == []
        assert flight.copter.navigation.has_position
        await flight.vehicle.set_mode("GUIDED")
        await flight.vehicle.arm()


async def test_wait_ready_requests_needed_streams() -> None:
    async with open_flight(rates={}) as flight:
        await flight.vehicle.wait_ready(timeout=10.0)


async def test_wait_ready_names_a_failing_check_and_a_silent_vehicle(grounded: Flight) -> None:
    grounded.copter.faults.prearm_failures.append("Compass not healthy")
    await anyio.sleep(3.0)
    with pytest.raises(OperationTimeout, match="PreArm: Compass not healthy"):
        await grounded.vehicle.wait_ready(timeout=2.0)
    grounded.copter.faults.silent = True
    with pytest.raises(OperationTimeout, match="heartbeats \\(the last one"):
        await grounded.vehicle.wait_ready(timeout=6.0)


# ------------------------------------------------------------------------------------- take-off


async def test_take_off_in_the_air_sends_nothing(flying: Flight) -> None:
    with pytest.raises(OperationRejected, match="is already"):
        await flying.vehicle.take_off(20.0)
    assert not flying.wire.commands(MavCmd.NAV_TAKEOFF)


async def test_take_off_while_landing_is_rejected(flying: Flight) -> None:
    """In the air the vehicle would refuse the take-off but accept the change to GUIDED, and would hover."""
    vehicle = flying.vehicle
    await vehicle.set_mode("LAND")
    await vehicle.landed_state.wait_until(lambda state: state == MavLandedState.LANDING, timeout=10)
    flying.wire.clear()
    with pytest.raises(OperationRejected, match=r"is already landing"):
        await vehicle.take_off(20.0)
    assert not flying.wire.mode_orders()
    assert not flying.wire.commands(MavCmd.NAV_TAKEOFF)
    await vehicle.landed_state.wait_until(lambda state: state == MavLandedState.ON_GROUND, timeout=60)


async def test_take_off_disarmed_sends_nothing(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    grounded.wire.clear()
    with pytest.raises(OperationRejected, match="not armed"):
        await grounded.vehicle.take_off(10.0)
    assert not grounded.wire.mode_orders()
    assert not grounded.wire.commands(MavCmd.NAV_TAKEOFF)


@pytest.mark.parametrize("altitude_m", [0.0, -3.0, 10_001.0, math.nan, math.inf])
async def test_take_off_invalid_altitude_sends_nothing(grounded: Flight, altitude_m: float) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    with pytest.raises(InvalidArgument, match="altitude_m"):
        await grounded.vehicle.take_off(altitude_m)
    assert not grounded.wire.commands(MavCmd.NAV_TAKEOFF)


async def test_take_off_changes_to_guided_and_returns_at_altitude(grounded: Flight) -> None:
    await grounded.vehicle.arm()
    await grounded.vehicle.take_off(15.0)
    assert grounded.copter.mode.number == GUIDED
    assert grounded.copter.altitude_m >= 14.2
    (command,) = grounded.wire.commands(MavCmd.NAV_TAKEOFF)
    assert isinstance(command, m.CommandLong)
    assert (command.target_system, command.target_component, command.param7) == (1, 1, 15.0)


async def test_take_off_works_without_default_streams() -> None:
    async with open_flight(rates={}) as flight:
        await anyio.sleep(3.0)
        await flight.vehicle.set_mode("GUIDED")
        await flight.vehicle.arm()
        await flight.vehicle.take_off(8.0)
        assert flight.copter.altitude_m >= 7.4


async def test_take_off_refused_says_why(grounded: Flight) -> None:
    grounded.copter.faults.refuse(MavCmd.NAV_TAKEOFF, MavResult.FAILED, "Takeoff: not today")
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    with pytest.raises(CommandRejected) as caught:
        await grounded.vehicle.take_off(10.0)
    assert caught.value.command == MavCmd.NAV_TAKEOFF
    assert caught.value.result == MavResult.FAILED
    assert "Takeoff: not today" in caught.value.reasons
    assert "Takeoff: not today" in str(caught.value)


async def test_take_off_refused_while_rising_says_why() -> None:
    async with open_flight(latency_s=0.3) as flight:  # The refusal arrives after reports of a further climb.
        vehicle = flight.vehicle
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(30.0)  # The call returns just below this altitude.
        with pytest.raises(CommandRejected, match="the vehicle is taking off"):
            await vehicle.take_off(40.0)


async def test_take_off_state_of_last_flight_is_no_effect(grounded: Flight) -> None:
    """TAKING_OFF was the last landed state before the stream of states ended."""
    await grounded.vehicle.wait_ready()
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    grounded.vehicle.telemetry.landed_state.set(3, Source(1, 1, "EXTENDED_SYS_STATE"))
    grounded.copter.faults.refuse(MavCmd.NAV_TAKEOFF, MavResult.FAILED, "No")
    with pytest.raises(CommandRejected, match="MAV_CMD_NAV_TAKEOFF was refused"):
        await grounded.vehicle.take_off(10.0)


async def test_take_off_climb_is_effect(grounded: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a landed state, the command is repeated while the vehicle stands, and confirmed by its climb."""
    vehicle = grounded.vehicle
    await vehicle.wait_ready()
    await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    cell = StateCell[int]("landed_state", now, "nothing")
    monkeypatch.setattr(vehicle.telemetry, "landed_state", cell)
    grounded.copter.faults.lose_ack(MavCmd.NAV_TAKEOFF, times=9)
    await vehicle.take_off(1.0)
    assert len(grounded.wire.commands(MavCmd.NAV_TAKEOFF)) == 4


@pytest.mark.parametrize("outdated_m", [-20.0, None])
async def test_altitude_higher_than_outdated_one_is_no_climb(grounded: Flight, outdated_m: float | None) -> None:
    vehicle = grounded.vehicle
    here = vehicle.position.value
    grounded.copter.faults.silent = True
    await anyio.sleep(1.0)
    unknown = here.replace(altitude_relative_m=None, altitude_amsl_m=None)
    outdated = unknown if outdated_m is None else here.offset(up_m=outdated_m)
    vehicle.position.set(outdated, Source(1, 1, "GLOBAL_POSITION_INT"))
    await anyio.sleep(3.0)
    is_rising = vehicle._climb_detector()
    assert not is_rising()
    grounded.copter.faults.silent = False
    await vehicle.position.wait_until(lambda place: place != outdated)
    assert not is_rising()
    vehicle.position.set(here.offset(up_m=5.0), Source(1, 1, "GLOBAL_POSITION_INT"))
    assert is_rising()


async def test_low_take_off_does_not_end_on_ground(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    await grounded.vehicle.take_off(0.5)
    height_m = grounded.vehicle.position.value.altitude_relative_m
    assert height_m is not None
    assert height_m >= 0.25


async def test_refused_take_off_on_ground_is_not_its_own_cause(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    grounded.copter.faults.refuse(MavCmd.NAV_TAKEOFF, MavResult.FAILED)
    with pytest.raises(CommandRejected) as caught:
        await grounded.vehicle.take_off(10.0)
    assert caught.value.__cause__ is None


async def test_landing_time_out_without_altitude_says_so(flying: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flying.vehicle.telemetry, "position", StateCell[Position]("position", now, "nothing"))
    with pytest.raises(OperationTimeout, match="the vehicle's altitude is unknown"):
        await flying.vehicle.land(timeout=2.0)


async def test_take_off_stale_landed_state_is_ignored(grounded: Flight) -> None:
    """Neither the landing nor a later landed state was received."""
    vehicle = grounded.vehicle
    await vehicle.wait_ready()
    await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    vehicle.telemetry.landed_state.set(2, Source(1, 1, "EXTENDED_SYS_STATE"))
    grounded.copter.faults.silent = True
    await anyio.sleep(4.0)
    grounded.copter.faults.silent = False
    assert vehicle.telemetry.landed_state.latest == 2
    await vehicle.take_off(8.0)


async def test_take_off_cancelled_holds(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    await cancelled_after(7.0, grounded.vehicle.take_off(30.0))
    await anyio.sleep(5.0)
    assert grounded.copter.mode.number == BRAKE
    assert 2.0 < grounded.copter.altitude_m < 28.0
    assert speed_of(grounded.copter) < 0.1


async def test_take_off_ends_when_a_pilot_takes_over(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    async with anyio.create_task_group() as tasks:

        async def pilot() -> None:
            await anyio.sleep(6.0)
            grounded.pilot_takes_over()

        tasks.start_soon(pilot)
        with pytest.raises(OperationRejected, match="mode changed to LOITER"):
            await grounded.vehicle.take_off(30.0)
    await anyio.sleep(3.0)
    assert grounded.copter.mode.number == LOITER  # the pilot's mode


async def test_take_off_not_executed_times_out(grounded: Flight) -> None:
    grounded.copter.faults.motor_failed = True
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    started = now()
    with pytest.raises(OperationTimeout, match=r"take_off\(10 m\): not done within 8 s; the vehicle is at -?0\.0 m"):
        await grounded.vehicle.take_off(10.0, timeout=8.0)
    assert 8.0 <= now() - started < 10.0


async def test_take_off_ends_when_it_is_disarmed(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    grounded.copter.faults.motor_failed = True
    async with anyio.create_task_group() as tasks:

        async def disarm() -> None:
            await anyio.sleep(2.0)
            await grounded.vehicle.disarm(force=True)

        tasks.start_soon(disarm)
        with pytest.raises(OperationRejected, match="disarmed"):
            await grounded.vehicle.take_off(10.0)


async def test_take_off_after_cancelled_one_continues(grounded: Flight) -> None:
    """The hold of the first call must not be sent after the order of the second call."""
    vehicle = grounded.vehicle
    await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    await cancelled_after(1.0, vehicle.take_off(20.0))
    await vehicle.take_off(10.0)
    assert grounded.copter.mode.number == GUIDED
    assert grounded.copter.altitude_m > 9.0


# ---------------------------------------------------------------------------------------- go_to


async def test_go_to_returns_on_arrival(flying: Flight) -> None:
    target = north_of_home(flying, 40.0, 15.0)
    await flying.vehicle.go_to(target)
    assert flying.vehicle.distance_to(target) <= flying.vehicle.autopilot.arrival_radius_m
    assert flying.copter.motion.north == pytest.approx(40.0, abs=2.5)
    assert flying.copter.altitude_m == pytest.approx(15.0, abs=2.0)
    (command,) = flying.wire.commands(MavCmd.DO_REPOSITION)
    assert isinstance(command, m.CommandInt)
    assert (command.target_system, command.frame, command.z) == (1, 6, 15.0)
    assert (command.x, command.y) == (round(target.latitude_deg * 1e7), round(target.longitude_deg * 1e7))
    assert math.isnan(command.param4)


async def test_go_to_takes_tolerance(flying: Flight) -> None:
    target = north_of_home(flying, 60.0)
    await flying.vehicle.go_to(target, tolerance_m=30.0)
    assert 5.0 < flying.vehicle.distance_to(target) <= 30.0
    await flying.vehicle.go_to(target, tolerance_m=0.5)
    assert flying.vehicle.distance_to(target) <= 0.5


async def test_go_to_keeps_the_altitude_when_none_is_given(flying: Flight) -> None:
    home = flying.vehicle.home.value
    latitude, longitude = geo.offset(home.latitude_deg, home.longitude_deg, 0.0, 20.0)
    await flying.vehicle.go_to(Position(latitude, longitude))
    assert flying.copter.altitude_m == pytest.approx(10.0, abs=0.3)
    assert flying.copter.motion.east == pytest.approx(20.0, abs=2.5)


async def test_go_to_understands_altitudes_above_the_sea(flying: Flight) -> None:
    home = flying.vehicle.home.value
    target = Position(home.latitude_deg, home.longitude_deg, altitude_amsl_m=home.altitude_amsl_m + 25.0)
    await flying.vehicle.go_to(target, tolerance_m=1.0)
    assert flying.copter.altitude_m == pytest.approx(25.0, abs=1.0)
    (command,) = flying.wire.commands(MavCmd.DO_REPOSITION)
    assert isinstance(command, m.CommandInt)
    assert command.frame == 5


async def test_home_is_accepted_as_a_place(flying: Flight) -> None:
    vehicle, home = flying.vehicle, flying.vehicle.home.value
    await vehicle.go_to(vehicle.position.value.offset(east_m=20.0))
    assert vehicle.position.value.distance_to(home) == pytest.approx(20.0, abs=2.5)
    assert vehicle.position.value.bearing_to(home) == pytest.approx(270.0, abs=5.0)
    await vehicle.go_to(home)
    assert flying.copter.altitude_m == pytest.approx(10.0, abs=0.3)  # the present altitude, not that of the ground
    assert vehicle.distance_to(home) == pytest.approx(10.0, abs=1.0)
    await vehicle.set_home(home)
    (command,) = flying.wire.commands(MavCmd.DO_SET_HOME)
    assert isinstance(command, m.CommandInt)
    assert command.x == round(home.latitude_deg * 1e7)
    assert command.z == pytest.approx(home.altitude_amsl_m)


async def test_go_to_state_cell_error_says_value(flying: Flight) -> None:
    with pytest.raises(InvalidArgument, match=r"^target = <StateCell home .* a Position or a Home; pass its \.value$"):
        await flying.vehicle.go_to(flying.vehicle.home)  # type: ignore[arg-type]


async def test_go_to_at_a_speed(flying: Flight) -> None:
    fastest = 0.0

    async def watch() -> None:
        nonlocal fastest
        while True:
            fastest = max(fastest, speed_of(flying.copter))
            await anyio.sleep(0.1)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(watch)
        await flying.vehicle.go_to(north_of_home(flying, 40.0), speed_m_s=3.0)
        tasks.cancel_scope.cancel()
    assert fastest == pytest.approx(3.0, abs=0.5)


async def test_go_to_with_a_heading(flying: Flight) -> None:
    await flying.vehicle.go_to(north_of_home(flying, 40.0), heading_deg=270.0)
    heading = await flying.vehicle.heading_deg.wait_until(lambda deg: abs(deg - 270.0) < 5.0, timeout=10.0)
    assert heading == pytest.approx(270.0, abs=5.0)


@pytest.mark.parametrize("after_s", [0.0, 0.001, 1.0, 3.0])
async def test_go_to_cancelled_holds(after_s: float) -> None:
    async with in_the_air(latency_s=0.05) as flying:
        await cancelled_after(after_s, flying.vehicle.go_to(north_of_home(flying, 200.0)))
        await anyio.sleep(6.0)
        where = flying.copter.motion.north
        await anyio.sleep(3.0)
        assert flying.copter.motion.north == pytest.approx(where, abs=0.1)
        assert flying.copter.motion.north < 60.0
        assert flying.copter.mode.number == BRAKE


async def test_order_after_cancelled_go_to_stays_valid(flying: Flight) -> None:
    await cancelled_after(2.0, flying.vehicle.go_to(north_of_home(flying, 200.0)))
    await flying.vehicle.go_to(north_of_home(flying, 0.0))
    await anyio.sleep(3.0)
    assert flying.copter.mode.number == GUIDED
    assert flying.copter.motion.north == pytest.approx(0.0, abs=2.5)


async def test_setpoint_stream_after_cancelled_go_to_continues() -> None:
    async with in_the_air(latency_s=0.2) as flying:
        await cancelled_after(2.0, flying.vehicle.go_to(north_of_home(flying, 200.0)))
        async with flying.vehicle.guided.velocity() as stream:
            await stream.fly(VelocitySetpoint(east_m_s=2.0), 5.0)
            assert flying.copter.motion.velocity_east == pytest.approx(2.0, abs=0.2)
        assert flying.copter.mode.number == BRAKE


async def test_land_after_cancelled_go_to_continues() -> None:
    async with in_the_air(latency_s=0.2) as flying:
        await cancelled_after(2.0, flying.vehicle.go_to(north_of_home(flying, 200.0)))
        await flying.vehicle.land()
        assert flying.copter.is_landed


@pytest.mark.sampled(2)
@pytest.mark.parametrize("order", ["hold", "land", "set_mode", "stream"])
async def test_refused_background_hold_is_not_next_ack(order: str) -> None:
    """COMMAND_ACK carries no request id: the ack of a cancelled call must not fail the next one."""
    async with in_the_air(latency_s=0.2) as flying:
        vehicle = flying.vehicle
        await cancelled_after(2.0, vehicle.go_to(north_of_home(flying, 200.0)))
        flying.copter.faults.refuse(MavCmd.DO_SET_MODE, MavResult.FAILED, "Mode change failed", times=1)
        if order == "hold":
            await vehicle.hold()
            assert flying.copter.mode.number == BRAKE
        elif order == "land":
            await vehicle.land()
            assert flying.copter.is_landed
        elif order == "set_mode":
            await vehicle.set_mode("RTL")
            assert flying.copter.mode.number == RTL
        else:
            async with vehicle.guided.velocity() as stream:
                await anyio.sleep(0.9)
                assert stream.is_running
                assert flying.copter.mode.number == GUIDED


async def test_go_to_without_do_reposition_sends_the_older_message() -> None:
    copter = SimulatedCopter(boot_time_s=0.0, unsupported_commands=[MavCmd.DO_REPOSITION])
    async with in_the_air(copter=copter) as flight:
        flight.pilot_takes_over(LOITER)
        await anyio.sleep(1.0)
        target = north_of_home(flight, 40.0)
        await flight.vehicle.go_to(target)
        assert flight.copter.motion.north == pytest.approx(40.0, abs=2.5)
        sent = flight.wire.all(m.SetPositionTargetGlobalInt)
        assert {message.type_mask for message in sent} == {0x0DF8}  # velocity, acceleration, yaw and yaw rate ignored
        assert {message.coordinate_frame for message in sent} == {6}
        assert sent[0].lat_int == round(target.latitude_deg * 1e7)
        flight.wire.clear()
        await anyio.sleep(5.0)
        assert not flight.wire.setpoints()  # nothing is resent once the call has ended


async def test_go_to_legacy_message_stops_after_cancellation() -> None:
    copter = SimulatedCopter(boot_time_s=0.0, unsupported_commands=[MavCmd.DO_REPOSITION])
    async with in_the_air(copter=copter) as flight:
        await cancelled_after(3.0, flight.vehicle.go_to(north_of_home(flight, 200.0)))
        flight.wire.clear()
        await anyio.sleep(5.0)
        assert not flight.wire.setpoints()
        assert flight.copter.mode.number == BRAKE


async def test_go_to_nowhere_sends_nothing(flying: Flight) -> None:
    with pytest.raises(InvalidArgument, match="latitude"):
        await flying.vehicle.go_to(Position(91.0, 8.0, altitude_relative_m=10.0))
    assert not flying.wire.commands(MavCmd.DO_REPOSITION)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("speed_m_s", value) for value in (0.0, -1.0, math.nan, math.inf)),
        *(("heading_deg", value) for value in (-1.0, 361.0, math.nan)),
        *(("tolerance_m", value) for value in (0.0, -1.0, math.nan)),
        ("timeout", -1.0),
    ],
)
async def test_go_to_with_nonsense_sends_nothing(flying: Flight, name: str, value: float) -> None:
    with pytest.raises(InvalidArgument, match=name):
        await flying.vehicle.go_to(north_of_home(flying, 10.0), **{name: value})
    await anyio.sleep(1.0)
    assert not flying.wire.commands(MavCmd.DO_REPOSITION)
    assert not flying.wire.mode_orders()


async def test_go_to_without_any_altitude_sends_nothing(flying: Flight) -> None:
    here = flying.vehicle.position.value
    low = Position(here.latitude_deg, here.longitude_deg, altitude_amsl_m=594.0)
    flying.vehicle.telemetry.position.set(low, Source(1, 1, "GLOBAL_POSITION_INT"))
    with pytest.raises(InvalidArgument, match="has no altitude, and the vehicle's altitude above home is unknown"):
        await flying.vehicle.go_to(Position(here.latitude_deg, here.longitude_deg))
    assert not flying.wire.commands(MavCmd.DO_REPOSITION)


async def test_go_to_disarmed_sends_nothing(grounded: Flight) -> None:
    with pytest.raises(OperationRejected, match="not armed"):
        await grounded.vehicle.go_to(north_of_home(grounded, 10.0))
    assert not grounded.wire.commands(MavCmd.DO_REPOSITION)


async def test_go_to_refused_says_why(flying: Flight) -> None:
    flying.copter.faults.refuse(MavCmd.DO_REPOSITION, MavResult.DENIED, "Target is outside the fence")
    with pytest.raises(CommandRejected) as caught:
        await flying.vehicle.go_to(north_of_home(flying, 10.0))
    assert caught.value.result == MavResult.DENIED
    assert caught.value.reasons == ("Target is outside the fence",)
    assert flying.copter.mode.number == GUIDED


async def test_go_to_ends_when_a_pilot_takes_over(flying: Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def pilot() -> None:
            await anyio.sleep(3.0)
            flying.pilot_takes_over()

        tasks.start_soon(pilot)
        with pytest.raises(OperationRejected, match="mode changed to LOITER"):
            await flying.vehicle.go_to(north_of_home(flying, 200.0))
    await anyio.sleep(2.0)
    assert flying.copter.mode.number == LOITER
    assert not flying.wire.mode_orders()


async def test_go_to_silent_vehicle_raises(flying: Flight) -> None:
    flying.copter.faults.silent = False
    async with anyio.create_task_group() as tasks:

        async def radio_fails() -> None:
            await anyio.sleep(2.0)
            flying.copter.faults.silent = True

        tasks.start_soon(radio_fails)
        started = now()
        with pytest.raises(HeartbeatTimeout, match="last heartbeat 1"):
            await flying.vehicle.go_to(north_of_home(flying, 500.0))
        assert now() - started < 15.0


async def test_go_to_times_out_and_says_how_far_it_is(flying: Flight) -> None:
    with pytest.raises(OperationTimeout, match=r"not done within 5 s; the vehicle is 1\d\d\.\d m away"):
        await flying.vehicle.go_to(north_of_home(flying, 200.0), timeout=5.0)


async def test_go_to_works_without_default_streams() -> None:
    async with open_flight(rates={}) as flight:
        vehicle = flight.vehicle
        await vehicle.wait_ready()
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(10.0)
        await vehicle.go_to(north_of_home(flight, 20.0), timeout=60.0)
        assert flight.copter.motion.north == pytest.approx(20.0, abs=2.5)


# ---------------------------------------------------------------------------------- coming back


async def test_land_returns_on_the_ground(flying: Flight) -> None:
    await flying.vehicle.land()
    assert flying.copter.is_landed
    await flying.vehicle.armed.wait_until(lambda armed: not armed, timeout=5.0)


@pytest.mark.parametrize("is_px4", [False, True])
async def test_land_of_vehicle_disarmed_in_the_air_is_rejected(is_px4: bool) -> None:
    """The firmware reports disarmed and ON_GROUND while it falls."""
    opened: Any = open_px4() if is_px4 else open_flight()
    async with opened as flight, anyio.create_task_group() as group:
        await flight.take_off(60.0)
        group.start_soon(disarm_later, flight, 3.0)
        with pytest.raises(OperationRejected, match=r"land: the vehicle was disarmed in the air and sinks at \d"):
            await flight.vehicle.land()


@pytest.mark.parametrize("name", ["land", "return_to_launch"])
async def test_fall_on_the_way_to_the_ground_is_rejected(name: str) -> None:
    async with in_the_air(30.0) as flight, anyio.create_task_group() as group:
        await flight.vehicle.go_to(north_of_home(flight, 40.0, 30.0))

        async def fail() -> None:
            await anyio.sleep(4.0)
            flight.copter.faults.motor_failed = True

        group.start_soon(fail)
        with pytest.raises(OperationRejected, match=rf"{name}: the vehicle hit the ground at \d+\.\d m/s"):
            await getattr(flight.vehicle, name)()


@pytest.mark.parametrize("name", ["land", "return_to_launch"])
@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_reboot_on_the_way_to_the_ground_is_rejected(opened: Any, name: str) -> None:
    async with opened() as flight:
        await flight.take_off(10.0)
        simulated = flight.copter if isinstance(flight, Flight) else flight.px4
        asyncio.get_running_loop().call_later(2.0, simulated.restart)
        with pytest.raises(OperationRejected, match=f"^{name}: the vehicle rebooted"):
            await getattr(flight.vehicle, name)()


async def test_return_disarmed_while_climbing_is_rejected() -> None:
    """The vehicle rises for half a second, and then falls."""
    async with open_px4() as flight, anyio.create_task_group() as group:
        await flight.take_off(10.0)
        await flight.vehicle.parameters.set("MPC_Z_V_AUTO_UP", 8.0)
        await flight.vehicle.parameters.set("RTL_RETURN_ALT", 60.0)
        place = flight.vehicle.position.value.offset(north_m=60.0)
        await flight.vehicle.go_to(place)
        group.start_soon(disarm_later, flight, 3.0)
        with pytest.raises(OperationRejected, match="disarmed in the air"):
            await flight.vehicle.return_to_launch()


@pytest.mark.parametrize("rate_hz", [10.0, 4.0, 1.0, 0.4])
async def test_impact_is_detected_at_any_rate(rate_hz: float, flying: Flight) -> None:
    flying.copter.faults.silent = True
    ground, cell = GroundCheck(flying.vehicle._context.session), flying.vehicle.velocity
    for tick in range(100):
        seconds = tick / 10
        sink = 5 * seconds if seconds < 3 else 0.0
        if seconds * rate_hz % 1 < 0.1 * rate_hz - 1e-6:
            cell.set(Velocity(0.0, 0.0, sink), Source(1, 1, "the test"))
        assert not ground.confirms(seconds >= 3)
        await anyio.sleep(0.1)
    assert "the vehicle hit the ground at" in (ground.failure_reason(lambda: None) or "")


@pytest.mark.parametrize("moves_m_s", [0.0, 0.6])
async def test_vehicle_that_tumbles_after_impact_has_fallen(moves_m_s: float, flying: Flight) -> None:
    flying.copter.faults.silent = True
    ground = GroundCheck(flying.vehicle._context.session)
    sinks = [*(0.5 * tick for tick in range(30)), *(moves_m_s, -moves_m_s) * 8, *[0.0] * 20]
    for sink in sinks:
        flying.vehicle.velocity.set(Velocity(0.0, 0.0, sink), Source(1, 1, "the test"))
        assert not ground.confirms(sink == 0.0)
        await anyio.sleep(0.1)


async def test_sinking_vehicle_with_outdated_height_is_not_on_ground(flying: Flight) -> None:
    flying.copter.faults.silent = True
    ground = GroundCheck(flying.vehicle._context.session)
    for _ in range(100):
        flying.vehicle.velocity.set(Velocity(0.0, 0.0, 2.5), Source(1, 1, "the test"))
        assert not ground.confirms(True)
        await anyio.sleep(0.1)


async def test_braking_before_touchdown_is_no_impact(flying: Flight) -> None:
    flying.copter.faults.silent = True
    ground = GroundCheck(flying.vehicle._context.session)
    is_down = False
    sinks = [*[8.0] * 10, *(8.0 - 0.64 * tick for tick in range(12)), *[0.4] * 5, *[0.0] * 7]
    for sink in sinks:
        flying.vehicle.velocity.set(Velocity(0.0, 0.0, sink), Source(1, 1, "the test"))
        is_down = ground.confirms(sink == 0.0)
        await anyio.sleep(0.1)
    assert is_down


async def test_fast_descent_before_landing_is_no_fall() -> None:
    copter = SimulatedCopter(boot_time_s=0.0, parameters={"LAND_SPEED_HIGH": 500.0, "LAND_SPEED": 200.0})
    async with open_flight(copter) as flight:
        await flight.take_off(60.0)
        await flight.vehicle.land()


async def disarm_later(flight: Any, seconds: float) -> None:
    await anyio.sleep(seconds)
    if isinstance(flight, Flight):
        flight.copter.arming.disarm(force=True)
    else:
        flight.px4.arming.disarm("test", force=True)


async def test_land_ends_when_a_pilot_takes_over(flying: Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def pilot() -> None:
            await anyio.sleep(2.0)
            flying.pilot_takes_over()

        tasks.start_soon(pilot)
        with pytest.raises(OperationRejected, match="land: the mode changed to LOITER"):
            await flying.vehicle.land()


@pytest.mark.parametrize("operation", ["land", "return_to_launch"])
async def test_refused_landing_of_disarmed_vehicle_raises(grounded: Flight, operation: str) -> None:
    grounded.copter.faults.refuse(MavCmd.DO_SET_MODE, MavResult.FAILED)
    with pytest.raises(CommandRejected):
        await getattr(grounded.vehicle, operation)()


async def test_land_refused_says_why(flying: Flight) -> None:
    flying.copter.faults.refuse(MavCmd.DO_SET_MODE, MavResult.FAILED, "Mode change to LAND failed: no")
    with pytest.raises(CommandRejected, match="Mode change to LAND failed: no"):
        await flying.vehicle.land()


async def test_return_to_launch_ends_on_the_ground_at_home(flying: Flight) -> None:
    await flying.vehicle.go_to(north_of_home(flying, 30.0))
    await flying.vehicle.return_to_launch()
    assert flying.copter.is_landed
    assert flying.copter.motion.north == pytest.approx(0.0, abs=1.0)


async def test_return_to_launch_times_out(flying: Flight) -> None:
    await flying.vehicle.go_to(north_of_home(flying, 50.0))
    with pytest.raises(OperationTimeout, match="return_to_launch: not done within 3 s; the vehicle is at"):
        await flying.vehicle.return_to_launch(timeout=3.0)
    assert flying.copter.mode.number == RTL


async def test_hold_stops(flying: Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def fly_on() -> None:
            with pytest.raises(OperationRejected, match="another order was given"):
                await flying.vehicle.go_to(north_of_home(flying, 500.0))

        tasks.start_soon(fly_on)
        await anyio.sleep(5.0)
        assert speed_of(flying.copter) > 3.0
        await flying.vehicle.hold()
        assert flying.vehicle.mode_name == "BRAKE"
    await anyio.sleep(5.0)
    assert speed_of(flying.copter) < 0.1


# ---------------------------------------------------------------------------- during the flight


async def test_set_speed(flying: Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def fly_on() -> None:
            await flying.vehicle.go_to(north_of_home(flying, 200.0))

        tasks.start_soon(fly_on)
        await anyio.sleep(1.0)
        await flying.vehicle.set_speed(2.0)
        await anyio.sleep(5.0)
        assert speed_of(flying.copter) == pytest.approx(2.0, abs=0.3)
        tasks.cancel_scope.cancel()


@pytest.mark.parametrize("speed", [0.0, -1.0, 1001.0, math.nan])
async def test_set_speed_out_of_range_sends_nothing(flying: Flight, speed: float) -> None:
    with pytest.raises(InvalidArgument, match="speed_m_s"):
        await flying.vehicle.set_speed(speed)
    assert not flying.wire.commands(MavCmd.DO_CHANGE_SPEED)


async def test_set_heading_absolute_and_relative(flying: Flight) -> None:
    vehicle = flying.vehicle
    await vehicle.set_heading(90.0, tolerance_deg=1.0)
    assert math.degrees(flying.copter.motion.yaw) == pytest.approx(90.0, abs=1.5)
    await vehicle.set_heading(-30.0, relative=True, tolerance_deg=1.0)
    assert math.degrees(flying.copter.motion.yaw) == pytest.approx(60.0, abs=3.0)
    await vehicle.set_heading(40.0, relative=True, rate_deg_s=20.0, tolerance_deg=1.0)
    assert math.degrees(flying.copter.motion.yaw) == pytest.approx(100.0, abs=4.0)
    absolute, left, right = (command for command in flying.wire.commands(MavCmd.CONDITION_YAW))
    assert (absolute.param1, absolute.param3, absolute.param4) == (90.0, 0.0, 0.0)
    assert left.param1 == pytest.approx(60.0, abs=1.5)
    assert (left.param3, left.param4) == (0.0, 0.0)
    assert right.param1 == pytest.approx(100.0, abs=3.0)  # absolute: a repetition does not turn the vehicle further
    assert (right.param2, right.param3, right.param4) == (20.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("angle_deg", "direction"), [(0, 0), (90, 0), (-90, 0), (180, 1), (-180, -1), (270, 1), (-270, -1), (-360, 0)]
)
async def test_set_heading_relative_sends_direction_of_large_turn(
    flying: Flight, angle_deg: float, direction: float
) -> None:
    """ArduPilot turns almost a full circle if its target heading is already slightly beyond the heading."""
    await flying.vehicle.set_heading(angle_deg, relative=True)
    (turn,) = flying.wire.commands(MavCmd.CONDITION_YAW)
    assert turn.param3 == direction


async def test_set_heading_relative_large_turn_is_not_repeated(flying: Flight) -> None:
    """A repetition near the goal might begin another circle."""
    flying.copter.faults.lose_ack(MavCmd.CONDITION_YAW)
    with pytest.raises(CommandTimeout):
        await flying.vehicle.set_heading(180.0, relative=True)
    assert len(flying.wire.commands(MavCmd.CONDITION_YAW)) == 1


async def test_set_heading_relative_needs_recent_heading(flying: Flight) -> None:
    for message_type in (m.GlobalPositionInt, m.VfrHud, m.Attitude):
        flying.copter.faults.lose(message_type, times=10_000)
    await anyio.sleep(3.0)
    with pytest.raises(StaleValueError):
        await flying.vehicle.set_heading(30.0, relative=True)
    assert not flying.wire.mode_orders()
    assert not flying.wire.commands(MavCmd.CONDITION_YAW)


async def test_set_heading_not_reached_times_out(flying: Flight) -> None:
    flying.copter.faults.lose_ack(MavCmd.CONDITION_YAW)
    flying.copter.yaw.turn_to = lambda *_, **__: None  # type: ignore[method-assign]
    with pytest.raises(OperationTimeout, match=r"set_heading\(90°\): not done within 3 s; the heading is \d+° off"):
        await flying.vehicle.set_heading(90.0, timeout=3.0)


@pytest.mark.parametrize("heading", [-361.0, 400.0, math.nan])
async def test_set_heading_out_of_range_sends_nothing(flying: Flight, heading: float) -> None:
    with pytest.raises(InvalidArgument, match="heading_deg"):
        await flying.vehicle.set_heading(heading)
    assert not flying.wire.commands(MavCmd.CONDITION_YAW)


async def test_look_at_and_stop_looking(flying: Flight) -> None:
    home = flying.vehicle.home.value
    latitude, longitude = geo.offset(home.latitude_deg, home.longitude_deg, 0.0, 50.0)
    await flying.vehicle.look_at(Position(latitude, longitude, altitude_relative_m=0.0))
    await flying.vehicle.heading_deg.wait_until(lambda deg: abs(deg - 90.0) < 2.0, timeout=20.0)
    (command,) = flying.wire.commands(MavCmd.DO_SET_ROI_LOCATION)
    assert isinstance(command, m.CommandInt)
    assert (command.frame, command.x) == (6, round(latitude * 1e7))
    await flying.vehicle.stop_looking()
    assert len(flying.wire.commands(MavCmd.DO_SET_ROI_NONE)) == 1


async def test_set_home_at_position_and_elsewhere(flying: Flight) -> None:
    await flying.vehicle.go_to(north_of_home(flying, 30.0))
    before = flying.vehicle.home.value
    await flying.vehicle.set_home()
    assert before.position.distance_to(flying.vehicle.home.value.position) == pytest.approx(30.0, abs=3.0)
    place = Position(before.latitude_deg, before.longitude_deg, altitude_amsl_m=before.altitude_amsl_m)
    await flying.vehicle.set_home(place)
    assert flying.vehicle.home.value.position.distance_to(place) < 0.1


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_position_after_set_home_has_altitude_above_new_home(opened: Any) -> None:
    async with opened() as flight:
        await flight.take_off(20.0)
        vehicle, home = flight.vehicle, flight.vehicle.home.value
        await vehicle.set_home(home.position.replace(altitude_amsl_m=home.altitude_amsl_m + 10.0))
        assert vehicle.position.value.altitude_relative_m == pytest.approx(10.0, abs=1.0)


@pytest.mark.parametrize("name", ["refuse", "ignore"])
async def test_set_home_without_requested_message_succeeds(flying: Flight, name: str) -> None:
    """ArduPilot sends HOME_POSITION without a request, too."""
    getattr(flying.copter.faults, name)(MavCmd.REQUEST_MESSAGE)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(flying.vehicle.set_home)
        await anyio.sleep(4.0)
        flying.copter.send_built(m.HomePosition.ID)


async def test_set_home_waits_for_report_of_new_home() -> None:
    """A HOME_POSITION that is older than the order may arrive after the acknowledgement."""
    async with in_the_air(rates={}) as flying:  # HOME_POSITION is not streamed.
        copter, home = flying.copter, flying.vehicle.home.value
        old_report = copter.build(m.HomePosition.ID)
        assert old_report is not None
        place = home.position.offset(north_m=30.0).replace(altitude_amsl_m=home.altitude_amsl_m)
        copter.faults.refuse(MavCmd.REQUEST_MESSAGE)
        copter.faults.lose(m.HomePosition)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(flying.vehicle.set_home, place)
            await anyio.sleep(1.0)
            copter.send(old_report)
            await anyio.sleep(1.0)
            copter.send_built(m.HomePosition.ID)
        assert flying.vehicle.home.value.position.distance_to(place) < 0.1


async def test_take_off_reaches_its_altitude_when_home_is_moved(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(partial(vehicle.take_off, 10.0, timeout=30.0))
        await vehicle.position.wait_until(lambda here: (here.altitude_relative_m or 0.0) > 5.0)
        await vehicle.set_home()
    assert -grounded.copter.motion.down == pytest.approx(10.0, abs=0.6)
    assert (vehicle.position.value.altitude_relative_m or 0.0) < 6.0


@pytest.mark.parametrize("name", ["go_to", "loiter"])
async def test_flight_to_place_keeps_altitude_when_home_is_moved(flying: Flight, name: str) -> None:
    """ArduPilot converts the altitude above home when it gets the order."""
    vehicle, home, target = flying.vehicle, flying.vehicle.home.value, north_of_home(flying, 60.0, 30.0)
    place = home.position.replace(altitude_amsl_m=home.altitude_amsl_m + 20.0)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(partial(getattr(vehicle, name), target, timeout=60.0))
        await anyio.sleep(2.0)
        await vehicle.set_home(place)
    assert flying.copter.motion.north == pytest.approx(60.0, abs=2.5)
    assert -flying.copter.motion.down == pytest.approx(30.0, abs=2.5)


async def test_home_moved_by_another_station_is_reported_despite_loss(flying: Flight) -> None:
    copter = flying.copter
    await anyio.sleep(5.0)
    copter.faults.lose(m.HomePosition)
    copter.navigation.set_home((300.0, 0.0, -30.0), lock=True)
    await anyio.sleep(2.5)
    assert flying.vehicle.home.value.north_m == pytest.approx(300.0)


async def test_set_home_requests_lost_report_again(flying: Flight) -> None:
    flying.copter.faults.lose(m.HomePosition, times=3)
    await flying.vehicle.set_home()
    assert flying.copter.faults.lost_messages[m.HomePosition.ID] == 0


async def test_set_home_reports_home_that_stays(flying: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    """PX4 may replace the ordered home by its own position at once (HomePosition.cpp)."""
    monkeypatch.setattr(flying.copter.navigation, "set_home", lambda *_, **__: None)
    home = flying.vehicle.home.value
    place = home.position.offset(north_m=30.0).replace(altitude_amsl_m=home.altitude_amsl_m)
    with pytest.raises(OperationTimeout, match=r"^set_home: not reached within 5 s; home is Home"):
        await flying.vehicle.set_home(place)


async def test_set_home_replaced_by_newer_one_is_rejected() -> None:
    async with in_the_air(rates={}) as flying:  # HOME_POSITION is not streamed.
        copter, home = flying.copter, flying.vehicle.home.value
        place = home.position.replace(altitude_amsl_m=home.altitude_amsl_m)
        copter.faults.refuse(MavCmd.REQUEST_MESSAGE)
        copter.faults.lose(m.HomePosition)
        first = asyncio.ensure_future(flying.vehicle.set_home(place.offset(north_m=30.0)))
        await anyio.sleep(0.5)
        second = asyncio.ensure_future(flying.vehicle.set_home(place.offset(north_m=60.0)))
        await anyio.sleep(0.5)
        copter.send_built(m.HomePosition.ID)
        await second
        with pytest.raises(OperationRejected, match=r"^set_home: another order was given"):
            await first


async def test_set_home_is_not_replaced_by_refused_one(flying: Flight) -> None:
    copter, home = flying.copter, flying.vehicle.home.value
    place = home.position.replace(altitude_amsl_m=home.altitude_amsl_m)
    old_home = copter.build(m.HomePosition.ID)
    assert old_home is not None
    copter.faults.refuse(MavCmd.REQUEST_MESSAGE)
    copter.faults.lose(m.HomePosition)
    first = asyncio.ensure_future(flying.vehicle.set_home(place.offset(north_m=30.0)))
    await anyio.sleep(0.5)
    copter.faults.refuse(MavCmd.DO_SET_HOME)
    with pytest.raises(CommandRejected):
        await flying.vehicle.set_home(place.offset(north_m=60.0))
    copter.send(old_home)
    await anyio.sleep(0.5)
    copter.send_built(m.HomePosition.ID)
    await first


async def test_look_at_refused(flying: Flight) -> None:
    flying.copter.faults.refuse(MavCmd.DO_SET_ROI_LOCATION, MavResult.DENIED, "No mount")
    with pytest.raises(CommandRejected, match="No mount"):
        await flying.vehicle.look_at(north_of_home(flying, 50.0))


async def test_take_off_refused_in_air_says_so(flying: Flight) -> None:
    """The vehicle answers only FAILED; the landed state was unknown when the order was given."""
    flying.vehicle.telemetry.landed_state.forget()
    with pytest.raises(
        CommandRejected, match=r"the vehicle is in the air, 10\.\d m above home and can only take off from the ground"
    ):
        await flying.vehicle.take_off(20)


async def test_take_off_refused_height_shows_flight(flying: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight, "IN_THE_AIR", {})
    flying.vehicle.telemetry.landed_state.forget()
    with pytest.raises(
        CommandRejected,
        match=r"the vehicle is probably in the air, 10\.\d m above home and can only take off from the ground",
    ):
        await flying.vehicle.take_off(20)


@pytest.mark.parametrize(("altitude_m", "is_said"), [(1.5, False), (2.5, True)])
async def test_take_off_height_above_two_metres_counts_as_flying(
    grounded: Flight, monkeypatch: pytest.MonkeyPatch, altitude_m: float, is_said: bool
) -> None:
    """The vehicle sends no landed state."""
    await grounded.take_off(altitude_m)
    cell = StateCell[int]("landed_state", now, "nothing")
    monkeypatch.setattr(grounded.vehicle.telemetry, "landed_state", cell)
    grounded.copter.faults.refuse(MavCmd.NAV_TAKEOFF, MavResult.FAILED)
    with pytest.raises(CommandRejected) as refusal:
        await grounded.vehicle.take_off(20)
    assert (f"probably in the air, {altitude_m} m above home" in str(refusal.value)) is is_said


async def test_set_home_with_both_altitudes_sends_amsl(flying: Flight) -> None:
    here = flying.vehicle.position.value
    assert here.altitude_relative_m is not None
    assert here.altitude_amsl_m is not None
    await flying.vehicle.set_home(here)
    (command,) = flying.wire.commands(MavCmd.DO_SET_HOME)
    assert isinstance(command, m.CommandInt)
    assert command.frame == 5
    assert command.z == pytest.approx(here.altitude_amsl_m)
