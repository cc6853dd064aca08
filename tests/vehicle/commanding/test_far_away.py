"""Places out of reach are rejected before anything is sent, and a plane arrives although it never reaches the place."""

from __future__ import annotations

import math
from collections.abc import Iterable
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import anyio
import pytest
from flight_harness import Flight

from aerokit import Position
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavType
from aerokit.missions import Mission, RallyPoints, rally_point, waypoint
from aerokit.vehicle.commanding.progress import MAX_DISTANCE_M, CircleDetector

if TYPE_CHECKING:
    from aerokit.vehicle.session.session import VehicleSession

pytestmark = pytest.mark.anyio


def exchanged(flight: Flight) -> Position:
    """Longitude for latitude: half round the earth."""
    here = flight.vehicle.position.value
    return Position(-here.latitude_deg, here.longitude_deg - 90.0, altitude_relative_m=20.0)


async def test_go_to_far_target_sends_nothing(flying: Flight) -> None:
    target = exchanged(flying)
    with pytest.raises(InvalidArgument, match=r"target = .* m away, more than max_distance_m = 100,000"):
        await flying.vehicle.go_to(target)
    assert flying.wire.sent == [] or all(m.NAME == "HEARTBEAT" for _, m in flying.wire.sent)


async def test_error_of_far_place_has_metres(flying: Flight) -> None:
    target = flying.vehicle.position.value.offset(north_m=400.0)
    with pytest.raises(InvalidArgument, match=r"the place is 400 m away, more than max_distance_m = 300;"):
        await flying.vehicle.go_to(target, max_distance_m=300.0)


async def test_error_of_far_place_names_the_argument(flying: Flight) -> None:
    far = exchanged(flying)
    with pytest.raises(InvalidArgument, match=r"^target = .* is not allowed: the place is"):
        await flying.vehicle.loiter(far)
    with pytest.raises(InvalidArgument, match=r"^center = .* is not allowed: the place is"):
        await flying.vehicle.figure_eight(far, major_radius_m=20, minor_radius_m=8, axis_deg=90, speed_m_s=4)


async def test_go_to_far_target_with_raised_limit_flies(flying: Flight) -> None:
    with anyio.move_on_after(3.0):
        await flying.vehicle.go_to(exchanged(flying), max_distance_m=2.1e7)
    assert flying.wire.commands(192)


@pytest.mark.parametrize(("metres", "is_allowed"), [(MAX_DISTANCE_M - 500, True), (MAX_DISTANCE_M + 500, False)])
async def test_distance_is_compared_exactly(flying: Flight, metres: float, is_allowed: bool) -> None:
    target = flying.vehicle.position.value.offset(north_m=0.6 * metres, east_m=0.8 * metres)
    with anyio.move_on_after(1.0):
        if is_allowed:
            await flying.vehicle.go_to(target)
        else:
            with pytest.raises(InvalidArgument):
                await flying.vehicle.go_to(target)
    assert bool(flying.wire.commands(192)) is is_allowed


async def test_go_to_place_far_above_sends_nothing(flying: Flight) -> None:
    target = flying.vehicle.position.value.offset(up_m=2000.0)
    with pytest.raises(InvalidArgument, match=r"the place is 2,000 m away, more than max_distance_m = 1,000;"):
        await flying.vehicle.go_to(target, max_distance_m=1000.0)
    assert not flying.wire.commands(192)


@pytest.mark.parametrize("kind", ["mission", "rally"])
async def test_plan_with_far_item_is_not_uploaded(grounded: Flight, kind: str) -> None:
    here, far = grounded.vehicle.position.value, exchanged(grounded)
    if kind == "mission":
        places = [here.offset(north_m=50.0), far]
        items = [waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=20) for place in places]
        with pytest.raises(InvalidArgument, match="more than max_distance_m"):
            await grounded.vehicle.mission.upload(Mission(items))
        await grounded.vehicle.mission.upload(Mission(items), max_distance_m=2.1e7)
    else:
        points = RallyPoints([rally_point(far.latitude_deg, far.longitude_deg, altitude_relative_m=20.0)])
        with pytest.raises(InvalidArgument, match="more than max_distance_m"):
            await grounded.vehicle.rally.upload(points)


CENTER = Position(47.0, 8.0, altitude_relative_m=60.0)


def detects(places: Iterable[tuple[float, float, float]], vehicle_type: int = MavType.FIXED_WING) -> bool:
    """Return True if a vehicle at these places (metres north, east and up of the center) circles the center."""
    position = SimpleNamespace(latest=None)
    telemetry = SimpleNamespace(position=position, vtol_state=SimpleNamespace(latest=None))
    session = SimpleNamespace(telemetry=telemetry, vehicle_type=vehicle_type)
    detector = CircleDetector(cast("VehicleSession", session))
    detected = False
    for north_m, east_m, up_m in places:
        position.latest = CENTER.offset(north_m=north_m, east_m=east_m).replace(altitude_relative_m=60.0 + up_m)
        detected = detector.circles(CENTER)
    return detected


def arc(degrees: int, radius_m: float = 150.0, *, up_m: float = 0.0) -> list[tuple[float, float, float]]:
    angles = map(math.radians, range(0, degrees + 1, 10))
    return [(radius_m * math.cos(angle), radius_m * math.sin(angle), up_m) for angle in angles]


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        ([], False),
        (arc(170), False),
        (arc(190), True),
        (arc(190, 15.0), False),
        (arc(190, up_m=30.0), False),  # still climbing
        (arc(190) + arc(10, 300.0), False),  # gone since
        ([(50.0, east_m, 0.0) for east_m in range(-2000, 2001, 20)], False),
        ([(0.0, 0.0, 0.0)] * 100, False),
    ],
)
def test_circle_around_target_is_detected(places: list[tuple[float, float, float]], expected: bool) -> None:
    assert detects(places) == expected
    assert detects((north_m, -east_m, up_m) for north_m, east_m, up_m in places) == expected  # the other direction


@pytest.mark.parametrize("vehicle_type", [MavType.QUADROTOR, MavType.SURFACE_BOAT])
def test_circle_of_vehicle_without_wings_is_no_arrival(vehicle_type: MavType) -> None:
    """A boat circles a place that it misses, and a copter with a wrong compass circles its target."""
    assert not detects(arc(190), vehicle_type)
