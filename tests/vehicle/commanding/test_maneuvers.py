"""Manoeuvres, speeds, the altitude of returns, and the reason of an arming."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from flight_harness import HeldHeartbeats, Wire, in_the_air, now, open_flight

import aerokit
from aerokit import messages as m
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    ConnectionClosed,
    InvalidArgument,
    LinkLost,
    NotSupported,
    OperationRejected,
    OperationTimeout,
    SetpointStreamStopped,
)
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult, MavSeverity, MavVtolState
from aerokit.missions import Mission, return_to_launch, waypoint
from aerokit.sim import (
    SimulatedCopter,
    SimulatedPlane,
    SimulatedPx4,
    SimulatedPx4Plane,
    SimulatedRover,
    SimulatedVehicle,
    simulated_link,
)
from aerokit.sim.px4.modes import HOLD
from aerokit.vehicle.commanding.follow import FollowedTarget
from aerokit.vehicle.state.movement import Velocity

pytestmark = pytest.mark.anyio

SPEED = MavCmd.DO_CHANGE_SPEED


async def test_set_climb_speed_changes_the_copter() -> None:
    async with in_the_air() as flight:
        await flight.vehicle.set_climb_speed(1.25)
        assert flight.copter.guided.climb == 1.25


async def test_set_airspeed_of_plane_outside_guided_is_refused() -> None:
    async with simulated_link(SimulatedPlane(boot_time_s=0.0)) as link, aerokit.connect(link) as vehicle:
        with pytest.raises(CommandRejected):
            await vehicle.set_airspeed(20)


@pytest.mark.parametrize(
    ("name", "simulated"),
    [("set_airspeed", SimulatedPx4), ("set_climb_speed", SimulatedPx4Plane), ("set_climb_speed", SimulatedPlane)],
)
async def test_speed_of_other_kind_is_not_supported(name: str, simulated: Callable[[], SimulatedVehicle]) -> None:
    """PX4 would take a climb speed for its cruise speed."""
    async with simulated_link(simulated()) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            with pytest.raises(NotSupported, match=vehicle.autopilot.firmware):
                await getattr(vehicle, name)(5)
            assert wire.commands(SPEED) == []


@pytest.mark.parametrize(
    ("simulated", "name", "value"),
    [
        (SimulatedPlane, "RTL_ALTITUDE", 45.5),
        (SimulatedPx4, "RTL_RETURN_ALT", 45.5),
        (SimulatedPx4Plane, "RTL_RETURN_ALT", 45.5),
    ],
)
async def test_return_altitude_is_in_metres(simulated: Callable[[], SimulatedVehicle], name: str, value: float) -> None:
    vehicle_end = simulated()
    async with simulated_link(vehicle_end) as link, aerokit.connect(link) as vehicle:
        await vehicle.set_return_altitude(value)
        assert vehicle_end.parameters[name] == value  # type: ignore[attr-defined]
        assert await vehicle.return_altitude() == value


async def test_return_altitude_of_old_copter_is_in_centimetres_there() -> None:
    async with open_flight() as flight:
        await flight.vehicle.set_return_altitude(45.5)
        assert flight.copter.parameters["RTL_ALT"] == 4550
        assert await flight.vehicle.return_altitude() == 45.5


async def test_return_altitude_of_rover_is_not_supported() -> None:
    async with simulated_link(SimulatedRover()) as link, aerokit.connect(link) as vehicle:
        with pytest.raises(NotSupported, match="Rover does not climb"):
            await vehicle.set_return_altitude(20)


async def test_arm_with_reason_sends_it_before_the_command(caplog: pytest.LogCaptureFixture) -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        with caplog.at_level(logging.INFO, "aerokit"):
            await flight.vehicle.arm(mode="GUIDED", reason="survey of field 7")
        assert flight.wire.last(m.Statustext).text == "survey of field 7"
        (text_at,) = flight.wire.times(m.Statustext)
        command_at = next(at for at, sent in flight.wire.sent if getattr(sent, "command", 0) == 400)
        assert text_at <= command_at
        assert "arming vehicle 1: survey of field 7" in caplog.text


async def test_arm_with_long_reason_sends_nothing() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        with pytest.raises(InvalidArgument, match="at most 50 bytes"):
            await flight.vehicle.arm(reason="ä" * 26)
        assert flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM) == []


# --------------------------------------------------------------------------- around a place


Kind = SimulatedCopter | SimulatedPx4


@asynccontextmanager
async def hovering(simulated: Kind) -> AsyncIterator[tuple[aerokit.Vehicle, Wire]]:
    async with simulated_link(simulated) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(10.0)
            wire.clear()
            yield vehicle, wire


BOTH = pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])


async def places_during(vehicle: aerokit.Vehicle, call: Awaitable[None]) -> list[aerokit.Position]:
    """Return the positions that the vehicle reported during the call."""
    places: list[aerokit.Position] = []
    stop = vehicle.position.observe(lambda _, place: places.append(place))
    try:
        await call
    finally:
        stop()
    return places


def turns_around(center: aerokit.Position, places: list[aerokit.Position]) -> float:
    """Return the turns that these places make around the center, clockwise."""
    bearings = [center.bearing_to(place) for place in places]
    return sum(math.remainder(after - before, 360.0) for before, after in pairwise(bearings)) / 360


@pytest.mark.sampled(4)
@pytest.mark.parametrize("clockwise", [True, False])
@BOTH
async def test_orbit_flies_its_turns_then_holds(kind: Callable[..., Kind], clockwise: bool) -> None:
    async with hovering(kind(boot_time_s=0.0)) as (vehicle, _):
        center = vehicle.position.value.offset(north_m=25)
        orbit = vehicle.orbit(center, radius_m=12, speed_m_s=4, turns=1.5, clockwise=clockwise)
        places = await places_during(vehicle, orbit)
        assert turns_around(center, places) == pytest.approx(1.5 if clockwise else -1.5, abs=0.1)
        assert all(abs(center.distance_to(place) - 12) < 2 for place in places[len(places) // 2 :])
        assert vehicle.mode_name in ("BRAKE", "LOITER")


@pytest.mark.sampled(3)
@pytest.mark.parametrize("facing", ["center", "ahead", "initial"])
async def test_orbit_of_copter_faces_as_ordered(facing: Any) -> None:
    async with hovering(SimulatedCopter(boot_time_s=0.0)) as (vehicle, wire):
        center = vehicle.position.value.offset(north_m=12)
        await vehicle.orbit(center, radius_m=12, speed_m_s=4, turns=0.25, facing=facing)
        yaw = math.degrees(wire.all(m.SetPositionTargetLocalNed)[-20].yaw) % 360
        wanted = {"center": 90, "ahead": 0, "initial": 0}[facing]  # The orbit ends west of the center.
        assert abs(math.remainder(yaw - wanted, 360)) < 20


async def test_fast_orbit_with_small_radius_stays_on_its_circle() -> None:
    """Real ArduCopter leaves a circle of 6 m at 4 m/s by 0.6 m at most, because it uses the ordered acceleration."""
    distances_m: list[float] = []
    async with in_the_air() as flight:
        vehicle = flight.vehicle
        center = vehicle.position.value.offset(north_m=6.0)
        vehicle.position.observe(lambda _, here: distances_m.append(here.distance_to(center)), every_arrival=True)
        await vehicle.orbit(center, radius_m=6.0, speed_m_s=4.0)
    assert max(distances_m) < 7.0


async def test_orbit_without_turns_ends_in_a_hold_when_cancelled() -> None:
    async with hovering(SimulatedPx4(boot_time_s=0.0)) as (vehicle, wire):
        with anyio.move_on_after(20):
            await vehicle.orbit(vehicle.position.value, radius_m=10, speed_m_s=4, turns=None)
        await vehicle.mode.wait_until(lambda mode: mode.name == "LOITER", timeout=5)
        assert len(wire.commands(MavCmd.DO_ORBIT)) == 1


@pytest.mark.parametrize("call", ["orbit", "go_to"])
async def test_call_raises_error_of_ended_connection(call: str) -> None:
    async with in_the_air() as flight:
        place = flight.vehicle.position.value.offset(north_m=100)
        arguments = {"radius_m": 10} if call == "orbit" else {}
        task = asyncio.create_task(getattr(flight.vehicle, call)(place, **arguments))
        await anyio.sleep(5.0)
        flight.wire.lose()
        with pytest.raises(LinkLost, match="cable"):
            await task


async def test_orbit_px4_radius_too_large_reports_its_reason() -> None:
    """PX4 accepts the command, and only sends a text."""
    async with hovering(SimulatedPx4(boot_time_s=0.0)) as (vehicle, _):
        with pytest.raises(OperationRejected, match="Orbit radius limit exceeded"):
            await vehicle.orbit(vehicle.position.value, radius_m=500)


async def test_later_refusal_text_does_not_end_orbit() -> None:
    """The text is about something else, such as a mission that another ground station uploads."""
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, _):
        asyncio.get_running_loop().call_later(8.0, simulated.send_text, MavSeverity.WARNING, "Mission rejected")
        await vehicle.orbit(vehicle.position.value, radius_m=10, speed_m_s=4)


async def test_orbit_px4_flying_another_circle_is_held() -> None:
    """The real PX4 accepts a radius above MC_ORBIT_RAD_MAX, and flies its previous circle."""
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, _):
        plan = simulated.flight.orbit.plan
        simulated.flight.orbit.plan = lambda _, *others: plan(20.0, *others)  # type: ignore[method-assign]
        with pytest.raises(OperationRejected, match=r"the vehicle flies a circle of 20\.0 m instead of 500 m"):
            await vehicle.orbit(vehicle.position.value, radius_m=500)
        await vehicle.mode.wait_until(lambda mode: mode.name == "LOITER", timeout=5)


async def test_hold_mode_of_pilot_during_orbit_sends_no_hold() -> None:
    """The status of the previous circle, with another radius, is no reason to order a hold."""
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, wire):
        plan = simulated.flight.orbit.plan
        simulated.flight.orbit.plan = lambda _, *others: plan(20.0, *others)  # type: ignore[method-assign]
        asyncio.get_running_loop().call_later(1.5, simulated.switch_to, HOLD)
        with pytest.raises(OperationRejected, match="the mode changed to LOITER"):
            await vehicle.orbit(vehicle.position.value, radius_m=500)
        await anyio.sleep(3)
        assert wire.commands(MavCmd.DO_REPOSITION) == []


async def test_orbit_of_moving_copter_needs_new_positions() -> None:
    """Otherwise the center would be displaced by the distance that the vehicle has flown since its last position."""
    async with in_the_air() as flight:
        vehicle, here = flight.vehicle, flight.copter.motion
        center, center_north_m, center_east_m = vehicle.position.value.offset(north_m=60), here.north + 60, here.east
        going = asyncio.ensure_future(vehicle.go_to(vehicle.position.value.offset(north_m=300)))
        await anyio.sleep(8)
        flight.copter.faults.lose(m.GlobalPositionInt, times=20)
        await anyio.sleep(1.2)
        await vehicle.orbit(center, radius_m=12, speed_m_s=4, turns=0.25)
        with pytest.raises(OperationRejected):
            await going
        last = flight.wire.last(m.SetPositionTargetLocalNed)
        assert math.hypot(last.x - center_north_m, last.y - center_east_m) == pytest.approx(12, abs=0.5)


@pytest.mark.exhaustive
@BOTH
async def test_figure_eight_reaches_both_lobes_and_its_center(kind: Callable[..., Kind]) -> None:
    async with hovering(kind(boot_time_s=0.0)) as (vehicle, _):
        center = vehicle.position.value
        figure = vehicle.figure_eight(center, major_radius_m=20, minor_radius_m=8, axis_deg=90, speed_m_s=4)
        places = await places_during(vehicle, figure)
        east = [place.longitude_deg for place in places]
        reach_m = [center.distance_to(center.replace(longitude_deg=edge)) for edge in (min(east), max(east))]
        assert reach_m == pytest.approx([20, 20], abs=2)
        assert vehicle.distance_to(center) < 3


async def test_pilot_during_set_point_orbit_keeps_the_vehicle() -> None:
    async with in_the_air() as flight:
        asyncio.get_running_loop().call_later(5, flight.pilot_takes_over)
        with pytest.raises(OperationRejected, match="LOITER"):
            await flight.vehicle.orbit(flight.vehicle.position.value, radius_m=10)
        flight.wire.clear()
        await anyio.sleep(5)
        assert flight.wire.mode_orders() == []
        assert flight.wire.setpoints() == []


@pytest.mark.sampled(2)
@BOTH
async def test_loiter_returns_after_its_time_at_the_place(kind: Callable[..., Kind]) -> None:
    async with hovering(kind(boot_time_s=0.0)) as (vehicle, _):
        place = vehicle.position.value.offset(east_m=20)
        await vehicle.loiter(place)
        assert vehicle.distance_to(place) <= vehicle.autopilot.arrival_radius_m
        began = now()
        await vehicle.loiter(duration_s=7)
        assert now() - began == pytest.approx(7, abs=0.6)


async def test_hold_mode_of_pilot_ends_loiter() -> None:
    """The hold mode is one of the modes of the order, so it does not end the order itself."""
    async with in_the_air() as flight:
        asyncio.get_running_loop().call_later(5, flight.pilot_takes_over, CopterMode.BRAKE)
        with pytest.raises(OperationRejected, match="the mode changed to BRAKE"):
            await flight.vehicle.loiter(duration_s=30)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", [SimulatedPlane, SimulatedPx4Plane])
async def test_loiter_of_plane_circles_with_its_radius(kind: Callable[..., SimulatedVehicle]) -> None:
    async with simulated_link(kind(boot_time_s=0.0)) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(50.0, timeout=120)
        center = vehicle.position.value.offset(north_m=200).replace(altitude_amsl_m=None, altitude_relative_m=60.0)
        loiter = vehicle.loiter(center, radius_m=120, turns=1, clockwise=False, timeout=300)
        places = await places_during(vehicle, loiter)
        assert center.distance_to(places[-1]) == pytest.approx(120, abs=36)
        assert turns_around(center, [p for p in places if center.distance_to(p) < 156]) < -0.9
        await vehicle.go_to(center.offset(north_m=300), timeout=120)  # ArduPlane keeps the radius of the loiter.


@pytest.mark.parametrize(("kind", "radius"), [(SimulatedPlane, "WP_LOITER_RAD"), (SimulatedPx4Plane, "NAV_LOITER_RAD")])
async def test_plane_on_wide_circle_has_arrived(kind: Callable[..., Any], radius: str) -> None:
    plane = kind(boot_time_s=0.0)
    plane.parameters[radius] = 200.0
    async with simulated_link(plane) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(50.0, timeout=120)
        target = vehicle.position.value.offset(north_m=600).replace(altitude_amsl_m=None, altitude_relative_m=60.0)
        for call in (vehicle.go_to(target, timeout=200), vehicle.loiter(target, duration_s=1, timeout=200)):
            await call
            assert vehicle.position.value.distance_to(target) == pytest.approx(200, rel=0.25)
        if kind is SimulatedPlane:
            await vehicle.return_to_launch(timeout=200)
            assert vehicle.position.value.distance_to(vehicle.home.value.position) < 250
            await vehicle.mission.upload(Mission([waypoint(target, altitude_relative_m=50), return_to_launch()]))
            await vehicle.mission.start()
            await vehicle.mission.wait_finished(timeout=200)


async def test_circle_that_is_too_tight_for_plane_is_rejected() -> None:
    async with simulated_link(SimulatedPlane(boot_time_s=0.0)) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(50.0, timeout=120)
        center = vehicle.position.value.offset(north_m=300).replace(altitude_amsl_m=None, altitude_relative_m=60.0)
        with pytest.raises(OperationRejected, match=r"loiter: the vehicle flies a circle of 2\d m instead of 15 m"):
            await vehicle.loiter(center, radius_m=15, turns=2, timeout=600)
        await vehicle.mode.wait_until(lambda mode: mode.name == "LOITER", timeout=10)


async def test_figure_eight_axis_is_within_pi() -> None:
    plane = SimulatedPx4Plane(boot_time_s=0.0)
    axes_rad: list[float] = []

    def record(message: Any, _: object) -> None:
        if message.command == MavCmd.DO_FIGURE_EIGHT:
            axes_rad.append(message.param4)

    plane.observe(m.CommandInt, record)
    async with simulated_link(plane) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(50.0, timeout=120)
        center = vehicle.position.value.offset(north_m=200).replace(altitude_amsl_m=None, altitude_relative_m=60.0)
        with pytest.raises(CommandRejected):  # The usual builds of PX4 do not have the command.
            await vehicle.figure_eight(center, major_radius_m=200, minor_radius_m=80, axis_deg=270)
    assert axes_rad == [pytest.approx(-math.pi / 2)]


@pytest.mark.sampled(2)
@BOTH
async def test_follow_stays_behind_a_moving_leader(kind: Callable[..., Kind]) -> None:
    leader_end = SimulatedCopter(boot_time_s=0.0, system_id=7)
    async with hovering(kind(boot_time_s=0.0)) as (vehicle, _), hovering(leader_end) as (leader, _):
        async with (
            vehicle.follow(leader, distance_m=12, bearing_deg=180, from_course=True, height_m=4) as following,
            leader.guided.velocity() as lead,
        ):
            for _ in range(60):
                lead.set(aerokit.VelocitySetpoint(east_m_s=3))
                await following.fly(0.5)
            here, there = vehicle.position.value, leader.position.value
            assert here.bearing_to(there) == pytest.approx(90, abs=5)
            assert following.distance_m == pytest.approx(12, abs=1.5)
            assert (here.altitude_amsl_m or 0) - (there.altitude_amsl_m or 0) == pytest.approx(4, abs=0.5)
        assert vehicle.mode_name in ("BRAKE", "LOITER")


async def test_follow_of_plane_is_not_supported() -> None:
    async with simulated_link(SimulatedPx4Plane()) as link, aerokit.connect(link) as vehicle:
        with pytest.raises(NotSupported, match="flies on its wings"):
            vehicle.follow(lambda: None)


async def _two_places(place: aerokit.Position) -> AsyncIterator[aerokit.Position]:
    for east_m in (0, 2):
        yield place.offset(east_m=east_m)
        await anyio.sleep(1)


async def test_follow_ends_with_the_positions_of_its_target() -> None:
    async with in_the_air() as flight:
        place = flight.vehicle.position.value.offset(north_m=30)
        with pytest.raises(SetpointStreamStopped, match="the positions of the target ended"):
            async with flight.vehicle.follow(_two_places(place)) as following:
                await following.fly()
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "BRAKE", timeout=5)


async def test_follow_holds_when_the_leader_falls_silent() -> None:
    leader_end = SimulatedCopter(boot_time_s=0.0, system_id=7)
    async with in_the_air() as flight, hovering(leader_end) as (leader, _):
        with pytest.raises(SetpointStreamStopped, match="no new position of the target was supplied"):
            async with flight.vehicle.follow(leader) as following:
                await following.fly(3)
                leader_end.faults.silent = True
                await following.fly(10)
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "BRAKE", timeout=5)


async def test_follow_holds_when_the_target_is_too_far_away() -> None:
    async with in_the_air() as flight:
        places = iter([flight.vehicle.position.value.offset(north_m=20)])
        far = flight.vehicle.position.value.offset(north_m=3000)
        with pytest.raises(SetpointStreamStopped, match="max_distance_m = 1000"):
            async with flight.vehicle.follow(lambda: next(places, far)) as following:
                await following.fly(5)


async def test_follow_without_own_altitude_holds() -> None:
    async with in_the_air() as flight:
        cell = flight.vehicle.telemetry.position
        here = cell.value
        cell.set(
            aerokit.Position(here.latitude_deg, here.longitude_deg, altitude_relative_m=10.0),
            Source(1, 1, "GLOBAL_POSITION_INT"),
        )
        flight.wire.clear()
        with pytest.raises(OperationRejected, match="altitude above sea level is unknown"):
            async with flight.vehicle.follow(lambda: here):
                pass
        assert flight.wire.mode_orders() == [CopterMode.BRAKE]


async def test_follow_without_target_holds_after_unreported_go_to() -> None:
    """HEARTBEAT reports GUIDED only after `follow` has replaced `go_to`."""
    async with in_the_air() as flight:
        await flight.vehicle.set_mode("LOITER")
        heartbeats = HeldHeartbeats(flight.wire)
        going = asyncio.ensure_future(flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=300)))
        await anyio.sleep(0.3)
        following = asyncio.ensure_future(flight.vehicle.follow(lambda: None).__aenter__())
        await anyio.sleep(0.3)
        heartbeats.stop()
        with pytest.raises(OperationTimeout, match="no position of the target"):
            await following
        with pytest.raises(OperationRejected, match="another order was given"):
            await going
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "BRAKE", timeout=3.0)


async def test_follow_takes_altitude_above_sea_level_of_positions() -> None:
    """The leader's altitude above home refers to the leader's home, which may be lower."""
    async with in_the_air() as flight:
        here = flight.vehicle.position.value
        assert here.altitude_amsl_m is not None
        target = here.replace(altitude_relative_m=45.0).offset(north_m=20)
        async with flight.vehicle.follow(lambda: target, height_m=2) as following:
            await following.fly(1)
        sent = flight.wire.last(m.SetPositionTargetGlobalInt)
        assert sent.coordinate_frame == 5
        assert sent.alt == pytest.approx(here.altitude_amsl_m + 2)


async def test_follow_function_that_raises_stops_it() -> None:
    async with in_the_air() as flight:
        places = iter([flight.vehicle.position.value])
        with pytest.raises(SetpointStreamStopped, match="StopIteration"):
            async with flight.vehicle.follow(lambda: next(places)) as following:
                await following.fly(5)


async def test_follow_from_course_without_bearing_keeps_place_at_first() -> None:
    async with in_the_air() as flight:
        here = flight.vehicle.position.value
        target = here.offset(east_m=-20)
        async with flight.vehicle.follow(lambda: target, distance_m=20, from_course=True) as following:
            await following.fly(1)
        sent = flight.wire.last(m.SetPositionTargetGlobalInt)
        assert aerokit.Position(sent.lat_int / 1e7, sent.lon_int / 1e7).distance_to(here) < 0.5


async def test_follow_positions_that_raise_cancellation_stop_it() -> None:
    async def positions(place: aerokit.Position) -> AsyncIterator[aerokit.Position]:
        yield place
        await anyio.sleep(1.0)
        raise asyncio.CancelledError

    async with in_the_air() as flight:
        place = flight.vehicle.position.value
        with pytest.raises(SetpointStreamStopped, match="the reading of the target was cancelled"):
            async with flight.vehicle.follow(positions(place), valid_for_s=5.0) as following:
                await following.fly(10)


async def test_follow_without_target_ends_with_vehicle_block() -> None:
    async with in_the_air() as flight:
        entering = asyncio.ensure_future(flight.vehicle.follow(lambda: None, valid_for_s=30.0).__aenter__())
        await anyio.sleep(0.1)
    with pytest.raises(ConnectionClosed):
        await entering


async def test_follow_closes_positions_after_invalid_one() -> None:
    ends: list[str] = []

    async def positions(first: aerokit.Position) -> AsyncIterator[Any]:
        try:
            yield first
            await anyio.sleep(1)
            yield "north"
        finally:
            ends.append("closed")

    async with in_the_air() as flight:
        target = positions(flight.vehicle.position.value)  # a reference, so that it is not collected
        with pytest.raises(SetpointStreamStopped, match="must be a Position"):
            async with flight.vehicle.follow(target) as following:
                await following.fly(5)
        assert ends == ["closed"]


async def test_follow_position_out_of_range_stops_it() -> None:
    async with in_the_air() as flight:
        here = flight.vehicle.position.value
        places = iter([here])
        high = here.replace(altitude_amsl_m=1e6)
        with pytest.raises(SetpointStreamStopped, match="cannot follow the position of the target: altitude"):
            async with flight.vehicle.follow(lambda: next(places, high), height_m=5) as following:
                await following.fly(5)


def test_followed_velocity_that_is_no_longer_received_is_ignored() -> None:
    clock = [0.0]
    position = StateCell[aerokit.Position]("position", lambda: clock[0], "GLOBAL_POSITION_INT")
    velocity = StateCell[Velocity]("velocity", lambda: clock[0], "GLOBAL_POSITION_INT")
    leader: Any = SimpleNamespace(telemetry=SimpleNamespace(position=position, velocity=velocity))
    target, source = FollowedTarget(leader, lambda: clock[0]), Source(1, 1, "GLOBAL_POSITION_INT")
    velocity.set(Velocity(5.0, 0.0, 0.0), source)
    velocities = []
    for now_s in (1.0, 3.0):
        clock[0] = now_s
        position.set(aerokit.Position(47.0, 8.0), source)
        state = target.read()
        assert state is not None
        velocities.append(state.velocity)
    assert velocities == [(5.0, 0.0, 0.0), (0.0, 0.0, 0.0)]


async def test_transition_returns_in_its_state() -> None:
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, _):
        simulated.vtol_state = int(MavVtolState.MC)
        await vehicle.vtol_state.wait_until(lambda state: state == MavVtolState.MC, timeout=5)
        await vehicle.transition_to("fixed_wing")
        assert simulated.vtol_state == vehicle.vtol_state.latest == MavVtolState.FW


async def test_transition_of_copter_is_not_supported() -> None:
    """ArduCopter reports MAV_VTOL_STATE_MC, and is not a VTOL."""
    async with in_the_air() as flight:
        with pytest.raises(NotSupported, match="is not a VTOL"):
            await flight.vehicle.transition_to("fixed_wing")
        assert flight.wire.commands(MavCmd.DO_VTOL_TRANSITION) == []


async def test_takeover_before_first_target_position_keeps_vehicle() -> None:
    async with in_the_air() as flight:
        asyncio.get_running_loop().call_later(1, flight.pilot_takes_over)
        places = iter([None] * 20)
        with pytest.raises(OperationRejected, match="LOITER"):
            async with flight.vehicle.follow(lambda: next(places, flight.vehicle.position.value)):
                pass
        await anyio.sleep(3)
        assert flight.wire.mode_orders() == []


async def test_autotune_reports_its_progress() -> None:
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, _):
        seen: list[int] = []
        await vehicle.autotune(on_progress=seen.append)
        assert seen == [0, 20, 40, 60, 80, 95]


async def test_autotune_ignores_unknown_progress() -> None:
    """COMMAND_ACK.progress 255 means that the vehicle does not report its progress."""
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, _):
        simulated.faults.ignore(MavCmd.DO_AUTOTUNE_ENABLE, times=1)
        ack = m.CommandAck(MavCmd.DO_AUTOTUNE_ENABLE, MavResult.IN_PROGRESS, 255, 0, 0, 0)
        asyncio.get_running_loop().call_later(0.2, simulated.send, ack)
        seen: list[int] = []
        await vehicle.autotune(on_progress=seen.append)
        assert seen == [0, 20, 40, 60, 80, 95]


async def test_autotune_timeout_without_progress_names_no_percentage() -> None:
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, _):
        simulated.faults.ignore(MavCmd.DO_AUTOTUNE_ENABLE, times=1)
        ack = m.CommandAck(MavCmd.DO_AUTOTUNE_ENABLE, MavResult.IN_PROGRESS, 255, 0, 0, 0)
        asyncio.get_running_loop().call_later(0.2, simulated.send, ack)
        with pytest.raises(OperationTimeout, match=r"within 0\.5 s \(progress unknown\)"):
            await vehicle.autotune(timeout=0.5)


async def test_autotune_ignores_ack_of_another_component() -> None:
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, _):
        simulated.faults.ignore(MavCmd.DO_AUTOTUNE_ENABLE, times=1)
        foreign_ack = m.CommandAck(MavCmd.DO_AUTOTUNE_ENABLE, MavResult.DENIED, 0, 0, 0, 0)
        own_ack = m.CommandAck(MavCmd.DO_AUTOTUNE_ENABLE, MavResult.IN_PROGRESS, 0, 0, 0, 0)
        loop = asyncio.get_running_loop()
        loop.call_later(0.2, partial(simulated.send, foreign_ack, sender=(1, 100)))
        loop.call_later(0.4, simulated.send, own_ack)
        await vehicle.autotune()


async def test_autotune_is_not_asked_again_after_a_lost_answer() -> None:
    """After the end of the tuning, PX4 takes the command that asks for the progress for another start."""
    simulated = SimulatedPx4(boot_time_s=0.0)
    async with hovering(simulated) as (vehicle, wire):
        asyncio.get_running_loop().call_later(3.5, simulated.faults.ignore, MavCmd.DO_AUTOTUNE_ENABLE)
        with pytest.raises(CommandTimeout, match="may go on tuning"):
            await vehicle.autotune()
        sent = len(wire.commands(MavCmd.DO_AUTOTUNE_ENABLE))
        await anyio.sleep(10)
        assert len(wire.commands(MavCmd.DO_AUTOTUNE_ENABLE)) == sent <= 5


async def test_autotune_of_copter_is_not_supported() -> None:
    async with in_the_air() as flight:
        with pytest.raises(NotSupported, match="needs a pilot"):
            await flight.vehicle.autotune()
        assert flight.wire.commands(MavCmd.DO_AUTOTUNE_ENABLE) == []
