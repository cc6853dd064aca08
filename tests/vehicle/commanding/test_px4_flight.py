"""The same actions on a PX4: altitudes above the sea, a mode for everything, heartbeats once a second only."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import AsyncIterator, Awaitable, Callable

import anyio
import pytest
from flight_harness import Px4Flight, now, open_px4

from aerokit import Position, Vehicle
from aerokit import messages as m
from aerokit._internal import geo
from aerokit.connection.cells import StateCell
from aerokit.dronekit import flight_orders
from aerokit.errors import CommandRejected, CommandTimeout, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim.px4.modes import HOLD, POSITION, custom_mode
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint

pytestmark = pytest.mark.anyio


@pytest.fixture
async def flying(anyio_backend: object) -> AsyncIterator[Px4Flight]:
    async with open_px4() as flight:
        await flight.take_off()
        yield flight


def north_of_home(flight: Px4Flight, north_m: float, altitude_m: float = 10.0) -> Position:
    home = flight.vehicle.home.value
    latitude, longitude = geo.offset(home.latitude_deg, home.longitude_deg, north_m, 0.0)
    return Position(latitude, longitude, altitude_relative_m=altitude_m)


def speed(flight: Px4Flight) -> float:
    return math.hypot(flight.px4.motion.velocity_north, flight.px4.motion.velocity_east)


async def test_px4_take_off_uses_amsl_altitude_and_ends_in_loiter() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        flight.wire.clear()
        await flight.vehicle.take_off(12.0)
        (command,) = flight.wire.commands(MavCmd.NAV_TAKEOFF)
        assert isinstance(command, m.CommandLong)
        assert command.param7 == pytest.approx(flight.vehicle.home.value.altitude_amsl_m + 12.0, abs=0.01)
        assert math.isnan(command.param5)
        assert not flight.wire.commands(MavCmd.DO_SET_MODE)
        assert flight.vehicle.position.value.altitude_relative_m == pytest.approx(12.0, abs=0.7)
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "LOITER", timeout=10.0)


async def test_px4_orbit_after_abandoned_mode_names_mode_of_pilot(flying: Px4Flight) -> None:
    """The pilot chooses LOITER, in which the orbit ends, while the abandoned mode may still be reported."""
    vehicle, px4 = flying.vehicle, flying.px4
    with anyio.move_on_after(0.0):
        await vehicle.set_mode("RTL")
    orbit = asyncio.create_task(vehicle.orbit(vehicle.position.value, radius_m=10.0))
    await vehicle.mode.wait_until(lambda mode: mode.name == "ORBIT")
    px4.change_mode(HOLD)
    with pytest.raises(OperationRejected, match="the mode changed to LOITER"):
        await orbit


def move_home_up(flight: Px4Flight, metres: float) -> None:
    """Correct the altitude of home, as PX4 does in the first two minutes of a flight (HomePosition.cpp)."""
    north, east, down = flight.px4.home
    flight.px4.home = (north, east, down - metres)


@pytest.mark.parametrize("home_error_m", [-2.0, 2.0])
async def test_take_off_ends_at_ordered_altitude_when_home_moves(home_error_m: float) -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        asyncio.get_running_loop().call_later(3.0, move_home_up, flight, home_error_m)
        await flight.vehicle.take_off(12.0, timeout=30.0)
        assert -flight.px4.motion.down == pytest.approx(12.0, abs=0.7)


async def test_lost_take_off_is_repeated_although_home_moves() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        flight.px4.faults.ignore(MavCmd.NAV_TAKEOFF, times=1)
        asyncio.get_running_loop().call_later(0.3, move_home_up, flight, -2.0)  # A lower home is no climb.
        await flight.vehicle.take_off(12.0, timeout=30.0)
        assert len(flight.wire.commands(MavCmd.NAV_TAKEOFF)) == 2


@pytest.mark.parametrize("tells_landed_state", [True, False])
async def test_take_off_is_not_repeated_after_mode_report(
    monkeypatch: pytest.MonkeyPatch, tells_landed_state: bool
) -> None:
    """A take-off starts and ends in LOITER, and the vehicle stays on the ground while the motors spin up."""
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("LOITER")
        await flight.vehicle.arm()
        if not tells_landed_state:
            cell = StateCell[int]("landed_state", now, "nothing")
            monkeypatch.setattr(flight.vehicle.telemetry, "landed_state", cell)
        flight.px4.faults.motor_failed = True  # the vehicle does not climb
        flight.px4.faults.lose_ack(MavCmd.NAV_TAKEOFF, times=9)
        with pytest.raises(OperationTimeout):
            await flight.vehicle.take_off(10.0, timeout=8.0)
        assert len(flight.wire.commands(MavCmd.NAV_TAKEOFF)) == 1


async def test_take_off_refused_says_why() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        flight.px4.faults.refuse(MavCmd.NAV_TAKEOFF, MavResult.TEMPORARILY_REJECTED, "Takeoff denied: no GPS\t")
        with pytest.raises(CommandRejected, match="Takeoff denied: no GPS"):
            await flight.vehicle.take_off(12.0)


async def test_take_off_cancelled_holds() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        with anyio.move_on_after(5.0) as scope:
            await flight.vehicle.take_off(40.0)
        assert scope.cancelled_caught
        await anyio.sleep(4.0)
        altitude = flight.vehicle.position.value.altitude_relative_m
        assert altitude is not None
        await anyio.sleep(4.0)
        assert flight.vehicle.position.value.altitude_relative_m == pytest.approx(altitude, abs=0.3)
        assert altitude < 30.0
        assert flight.vehicle.mode_name == "LOITER"


async def test_go_to_with_speed_and_heading(flying: Px4Flight) -> None:
    target = north_of_home(flying, 40.0, 15.0)
    fastest = 0.0

    async def watch() -> None:
        nonlocal fastest
        while True:
            fastest = max(fastest, speed(flying))
            await anyio.sleep(0.1)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(watch)
        await flying.vehicle.go_to(target, speed_m_s=4.0, heading_deg=270.0)
        tasks.cancel_scope.cancel()
    assert flying.vehicle.distance_to(target) <= flying.vehicle.autopilot.arrival_radius_m
    assert fastest == pytest.approx(4.0, abs=0.6)
    (command,) = flying.wire.commands(MavCmd.DO_REPOSITION)
    assert isinstance(command, m.CommandInt)
    assert (command.frame, command.param1, command.param2) == (5, 4.0, 1.0)
    assert command.param4 == pytest.approx(-math.pi / 2)
    assert command.z == pytest.approx(flying.vehicle.home.value.altitude_amsl_m + 15.0, abs=0.01)


async def go_to_10_m_north(vehicle: Vehicle) -> None:
    await vehicle.go_to(vehicle.home.value.position.offset(north_m=10.0))


async def turn_east(vehicle: Vehicle) -> None:
    await vehicle.set_heading(90.0)


async def go_to_as_dronekit(vehicle: Vehicle) -> None:
    home = vehicle.home.value
    latitude, longitude = round(home.latitude_deg * 1e7), round(home.longitude_deg * 1e7)
    await flight_orders.go_to(vehicle, flight_orders.Target(latitude, longitude, home.altitude_amsl_m + 10.0))


@pytest.mark.parametrize("order", [go_to_10_m_north, turn_east, go_to_as_dronekit])
async def test_lost_order_right_after_take_off_is_repeated(order: Callable[[Vehicle], Awaitable[None]]) -> None:
    async with open_px4(latency_s=0.3) as flight:
        vehicle = flight.vehicle
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(10.0)  # The mode changes to LOITER later.
        flight.px4.faults.ignore(MavCmd.DO_REPOSITION, times=1)
        await order(vehicle)
        assert len(flight.wire.commands(MavCmd.DO_REPOSITION)) == 2


async def test_go_to_arrives_at_ordered_altitude_when_home_moves(flying: Px4Flight) -> None:
    target = north_of_home(flying, 30.0, altitude_m=15.0)
    asyncio.get_running_loop().call_later(2.0, move_home_up, flying, 4.0)
    await flying.vehicle.go_to(target, timeout=60.0)
    assert -flying.px4.motion.down == pytest.approx(15.0, abs=1.5)


async def keep_moving_home(flight: Px4Flight) -> None:
    """Correct the altitude of home once a second, as real PX4 does."""
    for error_m in itertools.cycle((1.5, -1.5)):
        await anyio.sleep(1.0)
        move_home_up(flight, error_m)


async def test_stalled_go_to_fails_although_home_moves(flying: Px4Flight) -> None:
    target = north_of_home(flying, 30.0)
    flying.px4.flight.fly_to_target = lambda: None  # type: ignore[method-assign]  # The vehicle stays where it is.
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(keep_moving_home, flying)
        with pytest.raises(OperationTimeout, match=r"has not moved for 1[23] s; the vehicle is 3\d"):
            await flying.vehicle.go_to(target, timeout=90.0)
        tasks.cancel_scope.cancel()


async def test_px4_go_to_cancelled_stops_in_place(flying: Px4Flight) -> None:
    """A PX4 that flies to a destination is in LOITER as well, so setting the mode would not stop it."""
    with anyio.move_on_after(5.0) as scope:
        await flying.vehicle.go_to(north_of_home(flying, 300.0))
    assert scope.cancelled_caught
    await anyio.sleep(6.0)
    assert speed(flying) < 0.2
    assert flying.px4.motion.north < 100.0
    assert flying.vehicle.mode_name == "LOITER"


async def test_order_after_cancelled_go_to_stays_valid(flying: Px4Flight) -> None:
    with anyio.move_on_after(4.0):
        await flying.vehicle.go_to(north_of_home(flying, 300.0))
    await flying.vehicle.go_to(north_of_home(flying, 5.0))
    assert flying.px4.motion.north == pytest.approx(5.0, abs=2.5)
    await anyio.sleep(3.0)
    assert flying.px4.motion.north == pytest.approx(5.0, abs=2.5)


async def test_go_to_ends_when_a_pilot_takes_over(flying: Px4Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def pilot() -> None:
            await anyio.sleep(3.0)
            flying.px4.switch_to(POSITION)

        tasks.start_soon(pilot)
        with pytest.raises(OperationRejected, match="mode changed to POSCTL"):
            await flying.vehicle.go_to(north_of_home(flying, 300.0))
    await anyio.sleep(2.0)
    assert flying.px4.mode == POSITION


async def test_px4_hold_stops_reposition(flying: Px4Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def fly_on() -> None:
            with pytest.raises(OperationRejected):
                await flying.vehicle.go_to(north_of_home(flying, 300.0))

        tasks.start_soon(fly_on)
        await anyio.sleep(5.0)
        assert speed(flying) > 3.0
        await flying.vehicle.hold()
    await anyio.sleep(5.0)
    assert speed(flying) < 0.2


async def test_set_heading_turns_on_the_spot(flying: Px4Flight) -> None:
    await flying.vehicle.set_heading(120.0)
    assert math.degrees(flying.px4.motion.yaw) == pytest.approx(120.0, abs=6.0)
    await flying.vehicle.set_heading(-60.0, relative=True)
    assert math.degrees(flying.px4.motion.yaw) == pytest.approx(60.0, abs=11.0)
    assert not flying.wire.commands(MavCmd.CONDITION_YAW)


async def test_land_and_return(flying: Px4Flight) -> None:
    await flying.vehicle.go_to(north_of_home(flying, 20.0))
    await flying.vehicle.return_to_launch()
    assert flying.px4.is_landed
    assert flying.px4.motion.north == pytest.approx(0.0, abs=1.5)


async def test_land(flying: Px4Flight) -> None:
    await flying.vehicle.land()
    assert flying.px4.is_landed


async def test_land_while_px4_disarms_after_landing_returns(flying: Px4Flight) -> None:
    await flying.vehicle.land()
    await anyio.sleep(flying.px4.parameters["COM_DISARM_LAND"] - 0.6)
    assert flying.px4.is_armed
    await flying.vehicle.land()
    assert flying.vehicle.armed.value is False


@pytest.mark.parametrize("is_taken", [False, True])
async def test_land_current_mode_before_heartbeat_ends_landing(
    flying: Px4Flight, monkeypatch: pytest.MonkeyPatch, is_taken: bool
) -> None:
    """The vehicle leaves LAND when it disarms; CURRENT_MODE arrives up to a second before the HEARTBEAT."""
    reported: list[str] = []

    def look() -> None:
        reported.append(flying.vehicle.taken_over)

    monkeypatch.setattr(flying.vehicle.telemetry, "landed_state", StateCell[int]("landed_state", now, "nothing"))
    async with anyio.create_task_group() as tasks:

        async def current_mode() -> None:
            await flying.vehicle.mode.wait_until(lambda mode: mode.name == "LAND")
            if is_taken:
                await anyio.sleep(2.5)
                flying.px4.switch_to(POSITION)
            else:
                while flying.px4.is_armed:  # noqa: ASYNC110
                    await anyio.sleep(0.01)
            received = flying.vehicle.armed.updated_at
            flying.px4.send(m.CurrentMode(0, custom_mode(flying.px4.mode), custom_mode(flying.px4.mode)))
            await flying.vehicle.mode.wait_until(lambda mode: mode.name != "LAND")
            assert flying.vehicle.armed.updated_at == received, "no HEARTBEAT came meanwhile"
            look()
            await flying.vehicle.armed.wait_until(lambda _: flying.vehicle.armed.updated_at > received)
            look()

        tasks.start_soon(current_mode)
        if is_taken:
            with pytest.raises(OperationRejected, match="land: the mode changed to POSCTL"):
                await flying.vehicle.land()
        else:
            await flying.vehicle.land()
    assert reported == (["", "the mode changed to POSCTL"] if is_taken else ["", "the mode changed to LOITER"])


async def test_reboot() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        started = now()
        await flight.vehicle.reboot()
        assert now() - started < 12.0
        assert flight.px4.uptime < 12.0
        await flight.vehicle.wait_ready()


@pytest.mark.parametrize("second_result", [MavResult.ACCEPTED, MavResult.TEMPORARILY_REJECTED])
async def test_second_ack_of_cancelled_mode_is_not_taken_for_next(
    monkeypatch: pytest.MonkeyPatch, second_result: MavResult
) -> None:
    """PX4 acks DO_SET_MODE twice. Both acks of a cancelled RTL arrive while a lost LAND waits for its own."""
    async with open_px4(latency_s=0.2) as flight:
        await flight.take_off()
        vehicle = flight.vehicle
        if second_result != MavResult.ACCEPTED:
            monkeypatch.setattr(flight.px4, "change_mode", lambda _: False)
        with anyio.move_on_after(0.25):
            await vehicle.set_mode("RTL")
        monkeypatch.undo()
        flight.px4.faults.ignore(MavCmd.DO_SET_MODE, times=1)
        await vehicle.land(timeout=60.0)
        modes = [command for command in flight.wire.commands(MavCmd.DO_SET_MODE) if isinstance(command, m.CommandLong)]
        assert [int(mode.param3) for mode in modes] == [5, 6, 6]


async def test_landing_right_after_accepted_go_to_is_not_taken_over() -> None:
    """The HEARTBEAT that reports the mode of `go_to` was sent before the vehicle received the order to land."""
    async with open_px4(latency_s=0.3) as flight:
        await flight.take_off()
        await flight.vehicle.set_mode("RTL")
        await flight.vehicle._session.wait_for_heartbeat()
        going = asyncio.ensure_future(flight.vehicle.go_to(north_of_home(flight, 50.0)))
        await anyio.sleep(0.75)
        assert flight.vehicle.mode_name == "RTL"
        await flight.vehicle.land(timeout=60.0)
        with pytest.raises(OperationRejected, match="another order was given"):
            await going


async def test_mode_refused_after_acceptance_is_not_flown_by_program(flying: Px4Flight) -> None:
    arbiter = flying.vehicle._arbiter
    arbiter.newest = arbiter._arming_order = None  # as if another party had armed the vehicle
    with pytest.raises(CommandRejected, match="accepted the command and then refused it"):
        await flying.vehicle.set_mode("OFFBOARD")
    assert not flying.vehicle.is_flown_by_program


@pytest.mark.parametrize("phase_s", [0.0, 0.25, 0.5])
async def test_lost_hold_after_setpoints_is_repeated_before_failsafe(phase_s: float) -> None:
    async with open_px4() as flight:
        await flight.take_off(10.0)
        async with flight.vehicle.guided.velocity() as stream:
            await stream.fly(VelocitySetpoint(north_m_s=2.0), 3.0 + phase_s)
            flight.px4.faults.ignore(MavCmd.DO_REPOSITION, times=1)
        await anyio.sleep(3.0)
        assert flight.vehicle.mode_name == "LOITER"


@pytest.mark.parametrize(("latency_s", "max_wait_s"), [(0.0, 6.0), (0.3, 6.0), (1.0, 17.0)])
async def test_unanswered_hold_on_slow_link_ends_in_time(latency_s: float, max_wait_s: float) -> None:
    async with open_px4(latency_s=latency_s) as flight:
        await flight.take_off(10.0)
        flight.px4.faults.ignore(MavCmd.DO_REPOSITION)
        began_at = flight.vehicle.connection.now()
        with pytest.raises(CommandTimeout):
            await flight.vehicle.hold()
        assert flight.vehicle.connection.now() - began_at <= max_wait_s
