"""Calls that fly the vehicle fail as soon as the vehicle hits the ground, or disarms in the air."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest
from flight_harness import Flight, in_the_air, now, open_flight, open_px4

import aerokit
from aerokit.connection.cells import Source
from aerokit.errors import OperationRejected, SetpointStreamStopped
from aerokit.events import ComputerSlept
from aerokit.mavlink.enums import CopterMode, MavSeverity
from aerokit.missions import Mission, waypoint
from aerokit.position import Position
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.vehicle.commanding.ground import ImpactDetector
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint
from aerokit.vehicle.state.movement import Velocity

pytestmark = pytest.mark.anyio

FLIGHTS = pytest.mark.parametrize("opened", [open_flight, open_px4], ids=["ardupilot", "px4"])
IMPACT = r"the vehicle hit the ground at \d+\.\d m/s"


async def go_to(flight: Any) -> None:
    await flight.vehicle.go_to(place_of(flight).offset(north_m=300.0))


async def take_off(flight: Any) -> None:
    await flight.vehicle.take_off(200.0)


async def orbit(flight: Any) -> None:
    await flight.vehicle.orbit(place_of(flight), radius_m=20.0, turns=20)


async def loiter(flight: Any) -> None:
    here = place_of(flight)
    # Without an altitude, a vehicle that lies on the ground counts as being at the place.
    await flight.vehicle.loiter(Position(here.latitude_deg, here.longitude_deg), duration_s=60.0)


async def figure_eight(flight: Any) -> None:
    await flight.vehicle.figure_eight(place_of(flight), major_radius_m=40.0, minor_radius_m=15.0, rounds=20)


async def fly_velocity(flight: Any) -> None:
    async with flight.vehicle.guided.velocity() as stream:
        await stream.fly(VelocitySetpoint(north_m_s=3.0), 60.0)


async def follow(flight: Any) -> None:
    here = place_of(flight)
    async with flight.vehicle.follow(lambda: here) as following:
        await following.fly()


async def return_to_launch(flight: Any) -> None:
    await flight.vehicle.return_to_launch()


async def fly_mission(flight: Any) -> None:
    mission = flight.vehicle.mission
    await mission.upload(Mission([waypoint(place_of(flight).offset(north_m=north_m)) for north_m in (50.0, 300.0)]))
    await mission.start()
    await mission.wait_finished()


CALLS: dict[str, Callable[[Any], Awaitable[None]]] = {
    call.__name__: call
    for call in (go_to, take_off, orbit, loiter, figure_eight, fly_velocity, follow, return_to_launch, fly_mission)
}


def place_of(flight: Any) -> Position:
    place: Position = flight.vehicle.position.value
    return place


def simulated(flight: Any) -> Any:
    return flight.copter if isinstance(flight, Flight) else flight.px4


async def get_ready(flight: Any, name: str) -> None:
    if name != "take_off":
        await flight.take_off(20.0)
        return
    await flight.vehicle.wait_ready()
    if isinstance(flight, Flight):
        await flight.vehicle.set_mode("GUIDED")
    await flight.vehicle.arm()


async def fall_later(flight: Any, impacts: list[float]) -> None:
    await anyio.sleep(9.0)
    simulated(flight).faults.motor_failed = True
    while not simulated(flight).motion.is_on_ground:  # noqa: ASYNC110
        await anyio.sleep(0.05)
    impacts.append(now())


@pytest.mark.sampled(3)
@FLIGHTS
@pytest.mark.parametrize("name", CALLS)
async def test_impact_ends_flight_call_at_once(name: str, opened: Any) -> None:
    impacts: list[float] = []
    async with opened() as flight, anyio.create_task_group() as group:
        await get_ready(flight, name)
        group.start_soon(fall_later, flight, impacts)
        with pytest.raises((OperationRejected, SetpointStreamStopped), match=IMPACT):
            await CALLS[name](flight)
        assert 0 <= now() - impacts[0] < 1.5


async def test_go_to_holds_after_impact() -> None:
    """The target of the order may still be in the air, and the motors turn."""
    async with in_the_air(20.0) as flight, anyio.create_task_group() as group:
        group.start_soon(fall_later, flight, [])
        with pytest.raises(OperationRejected, match=f"go_to.*{IMPACT}"):
            await go_to(flight)
        await anyio.sleep(1.0)
        assert flight.wire.mode_orders() == [CopterMode.BRAKE]


@FLIGHTS
async def test_return_sends_nothing_after_impact(opened: Any) -> None:
    async with opened() as flight, anyio.create_task_group() as group:
        await get_ready(flight, "return_to_launch")
        group.start_soon(fall_later, flight, [])
        with pytest.raises(OperationRejected, match=IMPACT):
            await flight.vehicle.return_to_launch()
        flight.wire.clear()
        await anyio.sleep(3.0)
        assert not flight.wire.mode_orders()


@pytest.mark.sampled(3)
@FLIGHTS
@pytest.mark.parametrize("name", ["go_to", "orbit", "fly_velocity", "follow"])
async def test_disarming_in_the_air_ends_flight_call_at_once(name: str, opened: Any) -> None:
    disarmed_at: list[float] = []

    async def disarm(flight: Any) -> None:
        await anyio.sleep(5.0)
        if isinstance(flight, Flight):
            flight.copter.arming.disarm(force=True)
        else:
            flight.px4.arming.disarm("test", force=True)
        disarmed_at.append(now())

    async with opened() as flight, anyio.create_task_group() as group:
        await flight.take_off(60.0)
        group.start_soon(disarm, flight)
        with pytest.raises((OperationRejected, SetpointStreamStopped), match="the vehicle disarmed"):
            await CALLS[name](flight)
        assert now() - disarmed_at[0] < 1.5
        assert (place_of(flight).altitude_relative_m or 0.0) > 30.0


async def test_texts_about_progress_are_no_reasons_of_impact() -> None:
    async with open_px4() as flight, anyio.create_task_group() as group:
        await flight.take_off(20.0)
        group.start_soon(fall_later, flight, [])

        async def send_texts() -> None:
            await anyio.sleep(8.0)
            flight.px4.send_text(MavSeverity.INFO, "Mission finished, loitering")
            flight.px4.send_text(MavSeverity.CRITICAL, "Motor failure detected")

        group.start_soon(send_texts)
        with pytest.raises(OperationRejected, match=IMPACT) as caught:
            await go_to(flight)
        assert caught.value.reasons == ("Motor failure detected",)


# ------------------------------------------------------------------------------- false alarms


@pytest.mark.sampled(4)
@pytest.mark.parametrize("speedup", [1.0, 20.0])
@pytest.mark.parametrize(
    "simulated_vehicle",
    [
        lambda: SimulatedCopter(boot_time_s=0.0, parameters={"WPNAV_SPEED_DN": 500.0}),
        lambda: SimulatedPx4(boot_time_s=1.0, parameters={"MPC_Z_V_AUTO_DN": 5.0}),
    ],
    ids=["ardupilot", "px4"],
)
async def test_fast_descent_that_brakes_is_no_impact(simulated_vehicle: Callable[[], Any], speedup: float) -> None:
    async with simulated_link(simulated_vehicle(), speedup=speedup) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        if vehicle.autopilot.name == "ArduPilot":
            await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(60.0)
        await vehicle.go_to(vehicle.position.value.offset(up_m=-50.0))
        assert (vehicle.position.value.altitude_relative_m or 60.0) < 13.0


async def test_sleep_after_fast_descent_is_no_impact() -> None:
    """All velocities are then older, so that the last one seems to follow the descent at once."""
    async with in_the_air(20.0) as flight:
        flight.copter.faults.silent = True
        telemetry = flight.vehicle.telemetry
        detector = ImpactDetector(telemetry)
        for sink_m_s in [*[0.0] * 5, 4.0, 8.0, 8.0, *[4.0] * 10, *[0.0] * 5]:
            telemetry.velocity.set(Velocity(0.0, 0.0, sink_m_s), Source(1, 1, "the test"))
            detector.update()
            await anyio.sleep(0.1)
        flight.vehicle.connection.bus.publish(ComputerSlept(now(), 0, 60.0))
        detector.update()
        telemetry.velocity.set(Velocity(0.0, 0.0, 0.0), Source(1, 1, "the test"))
        detector.update()
        assert not detector.describe()


@pytest.mark.parametrize(
    ("drop_m", "ground_speed_m_s", "is_impact"), [(4.0, 0.0, True), (0.0, 0.0, False), (4.0, 20.0, False)]
)
async def test_impact_needs_lost_height_and_low_speed(drop_m: float, ground_speed_m_s: float, is_impact: bool) -> None:
    """The velocity of an estimator may jump, and a fixed wing may level off."""
    async with in_the_air(20.0) as flight:
        flight.copter.faults.silent = True
        telemetry = flight.vehicle.telemetry
        detector = ImpactDetector(telemetry)
        here = place_of(flight)
        for sink_m_s in [*[0.0] * 10, 4.0, 8.0, 8.0, *[0.0] * 5]:
            here = here.offset(up_m=-drop_m / 3 if sink_m_s else 0.0)
            telemetry.position.set(here, Source(1, 1, "the test"))
            telemetry.velocity.set(Velocity(ground_speed_m_s, 0.0, sink_m_s), Source(1, 1, "the test"))
            detector.update()
            await anyio.sleep(0.1)
        assert bool(detector.describe()) is is_impact


@pytest.mark.parametrize(("in_fall_m", "after_impact_m"), [(6.0, 0.0), (0.0, 4.0)])
async def test_moving_home_hides_no_impact(in_fall_m: float, after_impact_m: float) -> None:
    """PX4 corrects the altitude of home in flight: the height above home then changes without a movement."""
    async with in_the_air(20.0) as flight:
        flight.copter.faults.silent = True
        telemetry = flight.vehicle.telemetry
        detector = ImpactDetector(telemetry)
        here = place_of(flight)
        relative_m = here.altitude_relative_m or 0.0
        for sink_m_s in [*[0.0] * 10, 4.0, 8.0, 8.0, *[0.0] * 5]:
            here = here.offset(up_m=-2.0 if sink_m_s else 0.0)
            relative_m += in_fall_m / 3 - 2.0 if sink_m_s else 0.0
            telemetry.position.set(here.replace(altitude_relative_m=relative_m), Source(1, 1, "the test"))
            telemetry.velocity.set(Velocity(0.0, 0.0, sink_m_s), Source(1, 1, "the test"))
            detector.update()
            await anyio.sleep(0.1)
        await anyio.sleep(0.5)
        telemetry.position.set(here.replace(altitude_relative_m=relative_m + after_impact_m), Source(1, 1, "the test"))
        telemetry.velocity.set(Velocity(0.0, 0.0, 0.0), Source(1, 1, "the test"))
        detector.update()
        assert detector.describe()
