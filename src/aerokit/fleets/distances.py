"""``DistanceMonitor``: measures the distances between flying members, and orders them to hold if they are too close."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit._internal import geo
from aerokit.errors import ValueUnknownError
from aerokit.fleets.events import TooClose
from aerokit.fleets.separation import pairs_within, to_local_points
from aerokit.mavlink.enums import MavLandedState
from aerokit.position import Position

if TYPE_CHECKING:
    from aerokit.fleets.action import FleetContext
    from aerokit.fleets.members import Member
    from aerokit.fleets.paths import LocalPoint

POSITION_MAX_AGE_S = 2.0
POLL_INTERVAL_S = 0.25

# A pair is reported again only after its distance has exceeded the minimum by this factor.
RESET_FACTOR = 1.2


def position_of(member: Member, max_age_s: float = POSITION_MAX_AGE_S) -> Position:
    """Return the position of a member.

    Raises:
        ValueUnknownError, StaleValueError: the position is unknown or older than ``max_age_s``; the text names the
            member.
    """
    try:
        return member.vehicle.position.fresh(max_age_s)
    except ValueUnknownError as error:
        raise type(error)(f"{member.name}: {error}") from None


def altitude_amsl(member: Member, target: Position) -> float:
    """Return the altitude above sea level of a target for this member, in metres.

    If the target has no altitude, the member's present altitude is used.

    Raises:
        ValueUnknownError, StaleValueError: the position of the member or of its home is unknown.
    """
    if target.altitude_amsl_m is not None:
        return target.altitude_amsl_m
    here = position_of(member)
    if here.altitude_amsl_m is None:
        raise ValueUnknownError(f"{member.name} does not report its altitude above sea level")
    if target.altitude_relative_m is None:
        return here.altitude_amsl_m
    if here.altitude_relative_m is None:
        raise ValueUnknownError(f"{member.name} does not report its altitude above home")
    return here.altitude_amsl_m - here.altitude_relative_m + target.altitude_relative_m


class LocalOrigin:
    """Converts positions to metres north and east of an origin, and metres above sea level."""

    def __init__(self, origin: Position) -> None:
        self._origin = origin

    def to_local(self, position: Position, altitude_amsl_m: float) -> LocalPoint:
        north, east = geo.north_east_m(
            self._origin.latitude_deg,
            self._origin.longitude_deg,
            position.latitude_deg,
            position.longitude_deg,
        )
        return north, east, altitude_amsl_m

    def to_position(self, point: LocalPoint) -> Position:
        there = self._origin.offset(north_m=point[0], east_m=point[1])
        return Position(there.latitude_deg, there.longitude_deg, altitude_amsl_m=point[2])

    def of_member(self, member: Member) -> LocalPoint:
        """Return the current position of a member.

        Raises:
            ValueUnknownError, StaleValueError: the position is unknown.
        """
        here = position_of(member)
        return self.to_local(here, altitude_amsl(member, here))


class DistanceMonitor:
    """Compares the positions of flying members four times a second.

    A pair is reported again only after its distance has exceeded the minimum by the factor ``RESET_FACTOR``.
    """

    def __init__(self, context: FleetContext, min_distance_m: float, *, holds: bool) -> None:
        self._context, self._min_distance_m, self._holds = context, min_distance_m, holds
        self._reported: set[tuple[str, str]] = set()

    async def run(self) -> None:
        while True:
            self.check()
            await anyio.sleep(POLL_INTERVAL_S)

    def check(self) -> None:
        points = to_local_points(self._flying_positions())
        pairs = pairs_within(points, RESET_FACTOR * self._min_distance_m)
        self._reported &= {(one, other) for one, other, _ in pairs}
        for one, other, distance_m in pairs:
            if distance_m < self._min_distance_m and (one, other) not in self._reported:
                self._reported.add((one, other))
                self._on_too_close(self._context.members[one], self._context.members[other], distance_m)

    def _flying_positions(self) -> dict[str, tuple[float, float, float]]:
        """Return latitude, longitude and altitude of all members in the air, whoever controls them."""
        positions: dict[str, tuple[float, float, float]] = {}
        for member in self._context.members.values():
            vehicle = member.vehicle
            here = vehicle.position.latest
            if here is None or here.altitude_amsl_m is None or vehicle.position.age > POSITION_MAX_AGE_S:
                continue
            if vehicle.is_armed and vehicle.landed_state.latest != MavLandedState.ON_GROUND:
                positions[member.name] = here.latitude_deg, here.longitude_deg, here.altitude_amsl_m
        return positions

    def _on_too_close(self, one: Member, other: Member, distance_m: float) -> None:
        for member in (one, other):
            member.refresh()
        ordered = [member for member in (one, other) if self._holds and member.is_flown_by_program]
        for member in ordered:
            self._context.hold(member, f"aerokit too close {member.name}")
        self._context.publish(
            TooClose(
                self._context.now(),
                one.vehicle.system_id,
                one.name,
                other.name,
                distance_m,
                tuple(member.name for member in ordered),
            )
        )
