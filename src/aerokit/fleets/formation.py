"""Formations: places around a leader, to which followers fly once (``form``) or all the time (``following``)."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from itertools import combinations
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.values import Snapshot
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import BusyError, InvalidArgument, OperationRejected, SetpointStreamStopped, ValueUnknownError
from aerokit.fleets.action import ActionKind, FleetAction
from aerokit.fleets.distances import POSITION_MAX_AGE_S, altitude_amsl, position_of
from aerokit.fleets.events import FollowingStopped
from aerokit.fleets.members import Member
from aerokit.fleets.paths import vector_between
from aerokit.fleets.policy import FleetResult
from aerokit.fleets.separation import to_local_points
from aerokit.fleets.travel import FlightOptions, Travel
from aerokit.position import Position
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Self

    from aerokit.fleets.action import FleetContext

__all__ = ["Following", "Formation", "Formations", "Offset", "follow_velocity"]

# Maximum age of the positions of leader and follower, and of the leader's heading.
FOLLOWING_MAX_AGE_S = 1.5

# Speed of a follower towards its place in the formation, per metre of its distance from the place, in 1/s.
FOLLOW_GAIN = 0.6


class Offset(Snapshot):
    """Offset from the leader in metres: north, east and up; in the frame ``"heading"`` ahead, right and up."""

    north_m: float = 0.0
    east_m: float = 0.0
    up_m: float = 0.0

    def turned(self, heading_deg: float) -> Offset:
        """Convert an offset ahead and right of a vehicle with this heading to an offset north and east."""
        angle = math.radians(heading_deg)
        return Offset(
            self.north_m * math.cos(angle) - self.east_m * math.sin(angle),
            self.north_m * math.sin(angle) + self.east_m * math.cos(angle),
            self.up_m,
        )

    def _check(self) -> None:
        for name in self.__match_args__:
            if not math.isfinite(getattr(self, name)):
                raise InvalidArgument(f"{name} = {getattr(self, name)!r} is not a finite number")


class Formation(Snapshot):
    """Maps names of followers to their offsets from the leader.

    With the frame ``"north"``, offsets are metres north and east; with ``"heading"``, ahead and right of the leader.
    """

    offsets: Mapping[str, Offset]
    frame: Literal["north", "heading"] = "north"

    @classmethod
    def line(cls, names: Sequence[str], spacing_m: float, *, frame: Literal["north", "heading"] = "heading") -> Self:
        """Make a line behind the leader, with ``spacing_m`` metres between neighbours."""
        return cls({name: Offset(-spacing_m * number, 0.0) for number, name in enumerate(names, 1)}, frame)

    @classmethod
    def wedge(cls, names: Sequence[str], spacing_m: float, *, frame: Literal["north", "heading"] = "heading") -> Self:
        """Make a V behind the leader, with members alternately on the left and right.

        Each pair is ``spacing_m`` metres behind the pair before it, and ``spacing_m`` metres farther out on both sides.
        """
        offsets: dict[str, Offset] = {}
        for index, name in enumerate(names):
            row = index // 2 + 1  # the leader is row 0
            side = 1 if index % 2 else -1  # 1 is right, -1 is left
            offsets[name] = Offset(-spacing_m * row, spacing_m * row * side)
        return cls(offsets, frame)

    def offset_of(self, name: str, heading_deg: float | None) -> Offset:
        """Return the offset of a member in metres north, east and up of the leader.

        Raises:
            InvalidArgument: the leader's heading is needed and unknown.
        """
        offset = self.offsets[name]
        if self.frame == "north":
            return offset
        if heading_deg is None:
            raise InvalidArgument("frame = 'heading' needs the leader's heading, which is unknown")
        return offset.turned(heading_deg)

    def min_distance_m(self) -> float:
        """Return the smallest distance between two places in metres; the leader's place counts, too."""
        places = [(offset.north_m, offset.east_m, offset.up_m) for offset in (Offset(), *self.offsets.values())]
        distances = (math.dist(first, second) for first, second in combinations(places, 2))
        return min(distances, default=math.inf)

    def _check(self) -> None:
        # A copy, so that the caller may change its own dictionary later. Plain assignment would raise, because the
        # class is immutable.
        object.__setattr__(self, "offsets", dict(self.offsets))
        if self.frame not in ("north", "heading"):
            raise InvalidArgument(f"frame = {self.frame!r} is not allowed: it must be 'north' or 'heading'")
        for name, offset in self.offsets.items():
            if not isinstance(offset, Offset):
                raise InvalidArgument(f"offsets[{name!r}] = {offset!r} is not an Offset")


def follow_velocity(
    distance_vector: tuple[float, float, float],
    target_velocity: tuple[float, float, float],
    *,
    gain: float,
    max_speed_m_s: float,
) -> tuple[float, float, float]:
    """Return the velocity to reach a moving target: the target's velocity plus ``gain`` times the distance vector.

    Args:
        distance_vector: vector to the target in metres.
        target_velocity: velocity of the target in m/s.
        gain: speed per metre of distance, in 1/s.
        max_speed_m_s: faster results are shortened to this speed.
    """
    velocity = [speed + gain * distance for speed, distance in zip(target_velocity, distance_vector, strict=True)]
    speed = math.hypot(*velocity)
    scale = 1.0 if speed <= max_speed_m_s else max_speed_m_s / speed
    north, east, up = (component * scale for component in velocity)
    return north, east, up


def _coordinates_of(member: Member) -> tuple[float, float, float]:
    position = position_of(member, FOLLOWING_MAX_AGE_S)
    return position.latitude_deg, position.longitude_deg, altitude_amsl(member, position)


def _heading_for(formation: Formation, leader: Member, max_age_s: float) -> float | None:
    """Return the leader's heading if the formation turns with it, otherwise None.

    Raises ValueUnknownError if the heading is needed and unknown or too old.
    """
    if formation.frame != "heading":
        return None
    try:
        return leader.vehicle.heading_deg.fresh(max_age_s)
    except ValueUnknownError as error:
        raise type(error)(f"{leader.name}: {error}") from None


def _check_leader(leader: Member) -> None:
    leader.refresh()
    if not leader.is_available:
        raise OperationRejected(f"the leader {leader.name} is {leader.status}")


@checks_arguments
class Following:
    """Keeps followers at their places in a formation while its ``async with`` block runs. Then the followers hold.

    Following stops early if the leader is lost or taken over, or if the fleet's policy stops all followers because one
    of them failed. Then :class:`FollowingStopped` is published and ``wait_stopped`` returns. The program's block
    continues to run; ``raise_if_stopped`` and the end of the block raise :class:`SetpointStreamStopped`.
    """

    def __init__(
        self,
        context: FleetContext,
        leader: Member,
        followers: list[Member],
        formation: Formation,
        rate_hz: float,
        max_speed_m_s: float,
    ) -> None:
        self._context, self._leader, self._followers, self._formation = context, leader, followers, formation
        self._rate_hz, self._period_s = rate_hz, 1 / rate_hz
        self._max_speed_m_s = max_speed_m_s
        self._tasks = BackgroundTasks(self._on_error)
        self._stopped = asyncio.Event()
        self._was_entered = False
        self._has_raised = False
        self._reason = ""

    @property
    def is_running(self) -> bool:
        """True from the entry of the block until following has stopped."""
        return self._was_entered and not self._stopped.is_set()

    @property
    def reason(self) -> str:
        """The reason for which following has stopped early; an empty string if it has not."""
        return self._reason

    def error_m(self, name: str) -> float:
        """Return the distance of a follower from its place in metres; infinite if unknown."""
        member = next((follower for follower in self._followers if follower.name == name), None)
        if member is None:
            return math.inf
        try:
            return math.hypot(*self._vector_to_place(member))
        except (ValueUnknownError, OperationRejected):
            return math.inf

    async def wait_stopped(self) -> str:
        """Wait until following stops. Return the reason of an early stop; an empty string if the block ended first."""
        await self._stopped.wait()
        return self._reason

    def raise_if_stopped(self) -> None:
        """Raise SetpointStreamStopped if following has stopped early. Call it in loops inside the `async with` block.

        Raises:
            SetpointStreamStopped: following has stopped; the text has the reason.
        """
        if self._reason:
            self._has_raised = True
            raise SetpointStreamStopped(f"following has stopped: {self._reason}")

    async def __aenter__(self) -> Self:
        if self._was_entered:
            raise BusyError("a Following can be entered only once; call following() again")
        _check_leader(self._leader)
        self._was_entered = True
        self._action = FleetAction(
            self._context, "following", self._followers, self._fly_follower, kind=ActionKind.MOVES
        )
        self._tasks.start(self._follow, "aerokit following")
        return self

    async def __aexit__(self, exc_type: object, exc: object, traceback: object) -> None:
        self._stopped.set()
        await self._tasks.aclose()
        self._context.actions.pop(self._action, None)  # `run` does this, unless its task was cancelled early.
        if exc is None and not self._has_raised:
            self.raise_if_stopped()

    # --------------------------------------------------------------------------------------- private

    async def _follow(self) -> None:
        await self._action.run()
        self._stop_if_no_followers()

    async def _fly_follower(self, member: Member) -> None:
        try:
            async with member.vehicle.guided.velocity(rate_hz=self._rate_hz) as stream:
                while not self._stop_if_leader_lost():
                    stream.set(self._setpoint(member))
                    await anyio.sleep(self._period_s)
                await asyncio.Event().wait()  # Wait for the cancellation, which makes the vehicle hold.
        finally:
            # Check in the next iteration of the loop, when the action has recorded this follower's failure. The end of
            # the action would be too late, because the action also waits for the policy's orders, such as landing.
            asyncio.get_running_loop().call_soon(self._stop_if_no_followers)

    def _stop_if_no_followers(self) -> None:
        if not self._action.active_names and self._action.program_error is None:
            result = self._action.result_so_far()
            failed = {name: str(error) for name, error in result.failed.items()}
            reason = "; ".join(f"{name}: {error}" for name, error in failed.items())
            self._stop(reason or "no follower is left", self._action.policy_orders, {**result.skipped, **failed})

    def _stop_if_leader_lost(self) -> bool:
        """Stop following if the leader is lost. Return True if following has stopped."""
        if not self._stopped.is_set():
            try:
                _check_leader(self._leader)
                position_of(self._leader, FOLLOWING_MAX_AGE_S)
                _heading_for(self._formation, self._leader, FOLLOWING_MAX_AGE_S)
            except (OperationRejected, ValueUnknownError) as error:
                # The active members hold, because `_tasks.cancel()` below ends their streams.
                holding = self._action.active_names
                skipped = {
                    member.name: member.status if member.reason else "it does not follow"
                    for member in self._followers
                    if member.name not in holding
                }
                self._stop(str(error), dict.fromkeys(holding, "hold"), skipped)
                self._tasks.cancel()
        return self._stopped.is_set()

    def _setpoint(self, member: Member) -> VelocitySetpoint:
        velocity = self._leader.vehicle.velocity.latest
        leader_velocity = (0.0, 0.0, 0.0)  # An unknown velocity counts as zero.
        if velocity is not None:
            leader_velocity = velocity.north_m_s, velocity.east_m_s, -velocity.down_m_s
        north, east, up = follow_velocity(
            self._vector_to_place(member), leader_velocity, gain=FOLLOW_GAIN, max_speed_m_s=self._max_speed_m_s
        )
        return VelocitySetpoint(north, east, -up)

    def _vector_to_place(self, member: Member) -> tuple[float, float, float]:
        """Return the present vector from a member to its place, in metres north, east and up."""
        leader, vehicle = self._leader.vehicle, member.vehicle
        points = to_local_points({"leader": _coordinates_of(self._leader), "member": _coordinates_of(member)})
        heading = _heading_for(self._formation, self._leader, FOLLOWING_MAX_AGE_S)
        offset = self._formation.offset_of(member.name, heading)
        north, east, up = vector_between(points["member"], points["leader"])
        north, east, up = north + offset.north_m, east + offset.east_m, up + offset.up_m
        # Both vehicles have moved on after their positions were measured. The leader's movement makes the vector
        # longer, the member's own movement makes it shorter.
        for moving_vehicle, sign in ((leader, 1.0), (vehicle, -1.0)):
            velocity = moving_vehicle.velocity.latest
            if velocity is not None:
                signed_age = sign * moving_vehicle.position.age
                north += signed_age * velocity.north_m_s
                east += signed_age * velocity.east_m_s
                up -= signed_age * velocity.down_m_s
        return north, east, up

    def _stop(self, reason: str, orders: Mapping[str, str], skipped: Mapping[str, str]) -> None:
        if self._stopped.is_set():
            return
        self._reason = reason
        self._stopped.set()
        now, system_id, name = self._context.now(), self._leader.vehicle.system_id, self._leader.name
        self._context.publish(
            FollowingStopped(now, system_id, name, reason=reason, orders=dict(orders), skipped=dict(skipped))
        )

    def _on_error(self, error: Exception) -> None:
        hold_orders = dict.fromkeys((member.name for member in self._followers if member.is_available), "hold")
        self._stop(str(error) or type(error).__name__, self._action.policy_orders or hold_orders, {})


@checks_arguments
class Formations(Travel):
    """Actions of a fleet that fly formations."""

    async def form(
        self, formation: Formation, *, leader: str, speed_m_s: float | None = None, timeout: float | None = None
    ) -> FleetResult:
        """Fly each follower to its place around the leader, which stays where it is; see :meth:`go_to`.

        Args:
            formation: the places of the followers.
            leader: name of the leading member, which has no offset in the formation.
            speed_m_s: ground speed in m/s; None: unchanged.
            timeout: seconds for each member and each leg; None: no limit.

        Raises:
            InvalidArgument: a name is unknown, two places are too close, or the speed is not allowed. Nothing was sent.
            OperationRejected: the leader is unavailable, or paths come too close. Nothing was sent.
            ValueUnknownError: the position of the leader or of a follower, or a heading that is needed, is unknown.
        """
        leader_member, followers = self._leader_and_followers(formation, leader)
        leader_position = position_of(leader_member)
        heading = _heading_for(formation, leader_member, POSITION_MAX_AGE_S)
        # An altitude above the leader's home is dropped, because a follower's home may be at another altitude.
        center = leader_position.replace(
            altitude_amsl_m=altitude_amsl(leader_member, leader_position), altitude_relative_m=None
        )
        targets: dict[str, Position] = {}
        for follower in followers:
            offset = formation.offset_of(follower.name, heading)
            target = center.offset(north_m=offset.north_m, east_m=offset.east_m, up_m=offset.up_m)
            targets[follower.name] = target
        if speed_m_s is not None:
            check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
        return await self._travel("form", targets, FlightOptions(speed_m_s, timeout))

    def following(
        self, formation: Formation, *, leader: str, rate_hz: float = 5.0, max_speed_m_s: float = 10.0
    ) -> Following:
        """Keep a formation while the leader moves: ``async with fleet.following(formation, leader="north/1"):``.

        Each follower is flown by velocity set-points. If the leader is lost or taken over, the followers hold. If a
        follower fails, the fleet's policy decides about the other followers.

        Args:
            formation: the places of the followers.
            leader: name of the leading member. Your program flies it, for example in the block.
            rate_hz: set-points per second, 2 to 50.
            max_speed_m_s: maximum speed of the followers in m/s.

        Raises:
            InvalidArgument: a name is unknown, or an argument is out of range.
            OperationRejected: the leader is unavailable.
        """
        check_range("rate_hz", rate_hz, 2, 50)
        check_range("max_speed_m_s", max_speed_m_s, 0, 100, above=True)
        member, followers = self._leader_and_followers(formation, leader)
        return Following(self._context, member, followers, formation, rate_hz, max_speed_m_s)

    def _leader_and_followers(self, formation: Formation, leader: str) -> tuple[Member, list[Member]]:
        self._check_members("leader", [leader])
        self._check_members("formation", formation.offsets)
        if leader in formation.offsets:
            raise InvalidArgument(f"formation: {leader!r} is the leader and cannot have an offset")
        min_m = self._context.min_distance_m
        closest_m = formation.min_distance_m()
        if min_m is not None and closest_m < min_m:
            raise InvalidArgument(
                f"formation: two places are {closest_m:.1f} m apart; the minimum of this fleet is {min_m:g} m"
            )
        member = self.members[leader]
        _check_leader(member)
        return member, [self.members[name] for name in formation.offsets]
