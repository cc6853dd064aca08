"""``DistanceMonitor``: reports flying members that are too close to each other, and orders them to hold."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit._internal import geo
from aerokit.errors import ValueUnknownError
from aerokit.fleets.events import TooClose
from aerokit.fleets.separation import pairs_within, to_local_points
from aerokit.position import Position
from aerokit.vehicle.state.telemetry import is_reported_on_ground

if TYPE_CHECKING:
    from aerokit.fleets.action import FleetContext
    from aerokit.fleets.members import Member
    from aerokit.fleets.paths import LocalPoint

POSITION_MAX_AGE_S = 2.0
POLL_INTERVAL_S = 0.25

# A pair is reported again only after its distance was larger than this factor times the minimum distance.
RESET_FACTOR = 1.2


def position_of(member: Member, max_age_s: float = POSITION_MAX_AGE_S) -> Position:
    """Return the position of a member.

    Raises ValueUnknownError, with the member's name in its text, if the position is unknown or too old.
    """
    try:
        return member.vehicle.position.fresh(max_age_s)
    except ValueUnknownError as error:
        raise type(error)(f"{member.name}: {error}") from None


def altitude_amsl(member: Member, target: Position) -> float:
    """Return a target's altitude above sea level in metres, for this member.

    A relative altitude counts from the member's home. A target without an altitude has the member's present altitude.
    Raises ValueUnknownError if an altitude of the member is needed and unknown.
    """
    if target.altitude_amsl_m is not None:
        return target.altitude_amsl_m
    position = position_of(member)
    if position.altitude_amsl_m is None:
        raise ValueUnknownError(f"{member.name} does not report its altitude above sea level")
    if target.altitude_relative_m is None:
        return position.altitude_amsl_m
    if position.altitude_relative_m is None:
        raise ValueUnknownError(f"{member.name} does not report its altitude above home")
    home_altitude_amsl_m = position.altitude_amsl_m - position.altitude_relative_m
    return home_altitude_amsl_m + target.altitude_relative_m


class LocalOrigin:
    """Converts positions to metres north, east and up of an origin (by default at sea level), and back."""

    def __init__(self, origin: Position, altitude_amsl_m: float = 0.0) -> None:
        self._origin, self._altitude_amsl_m = origin, altitude_amsl_m

    def to_local(self, position: Position, altitude_amsl_m: float) -> LocalPoint:
        north, east = geo.north_east_m(
            self._origin.latitude_deg, self._origin.longitude_deg, position.latitude_deg, position.longitude_deg
        )
        return north, east, altitude_amsl_m - self._altitude_amsl_m

    def to_position(self, point: LocalPoint) -> Position:
        north_m, east_m, up_m = point
        position = self._origin.offset(north_m=north_m, east_m=east_m)
        altitude_amsl_m = up_m + self._altitude_amsl_m
        return Position(position.latitude_deg, position.longitude_deg, altitude_amsl_m=altitude_amsl_m)

    def local_position_of(self, member: Member) -> LocalPoint:
        position = position_of(member)
        return self.to_local(position, altitude_amsl(member, position))


class DistanceMonitor:
    """Compares the positions of flying members four times a second.

    A pair that is too close is reported once, and again only after its distance was larger than ``RESET_FACTOR`` times
    the minimum.
    """

    def __init__(self, context: FleetContext, min_distance_m: float, *, holds: bool) -> None:
        self._context, self._min_distance_m, self._orders_hold = context, min_distance_m, holds
        self._reported: set[tuple[str, str]] = set()

    async def run(self) -> None:
        while True:
            self.check()
            await anyio.sleep(POLL_INTERVAL_S)

    def check(self) -> None:
        points = to_local_points(self._flying_positions())
        near_pairs = pairs_within(points, RESET_FACTOR * self._min_distance_m)
        # Pairs that are apart again can be reported again.
        self._reported &= {(first, second) for first, second, _ in near_pairs}
        for first, second, distance_m in near_pairs:
            if distance_m < self._min_distance_m and (first, second) not in self._reported:
                self._reported.add((first, second))
                self._on_too_close(self._context.members[first], self._context.members[second], distance_m)

    def _flying_positions(self) -> dict[str, tuple[float, float, float]]:
        """Return latitude, longitude and altitude above sea level of each member in the air."""
        positions: dict[str, tuple[float, float, float]] = {}
        for member in self._context.members.values():
            vehicle = member.vehicle
            position = vehicle.position.latest
            if position is None or position.altitude_amsl_m is None or vehicle.position.age > POSITION_MAX_AGE_S:
                continue
            if vehicle.is_armed and not is_reported_on_ground(vehicle.telemetry):
                positions[member.name] = position.latitude_deg, position.longitude_deg, position.altitude_amsl_m
        return positions

    def _on_too_close(self, first: Member, second: Member, distance_m: float) -> None:
        pair = (first, second)
        for member in pair:
            member.refresh()
        holding = [member for member in pair if self._orders_hold and member.is_flown_by_program]
        for member in holding:
            self._context.hold(member, f"aerokit too close {member.name}")
        self._context.publish(
            TooClose(
                at=self._context.now(),
                system_id=first.vehicle.system_id,
                member=first.name,
                other=second.name,
                distance_m=distance_m,
                ordered=tuple(member.name for member in holding),
            )
        )
