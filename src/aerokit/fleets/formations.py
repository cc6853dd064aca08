"""``Formations``: taking places around a leader, and keeping them while it moves."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.wording import shown
from aerokit.connection.tasks import Background
from aerokit.errors import (
    BusyError,
    InvalidArgument,
    OperationRejected,
    SetpointStreamStopped,
    ValueUnknownError,
)
from aerokit.fleets.action import CommonAction
from aerokit.fleets.distances import altitude_amsl, position_of
from aerokit.fleets.events import FollowingStopped
from aerokit.fleets.formation import Formation, follow_velocity
from aerokit.fleets.members import Member
from aerokit.fleets.policy import FleetResult
from aerokit.fleets.separation import local_places
from aerokit.fleets.travel import Travel
from aerokit.position import Position
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.fleets.action import Crew

__all__ = ["Following", "Formations"]

OLD_LEADER_S = 1.5
"""Where the leader was longer ago is no place to follow."""

GAIN = 0.6


@checks_arguments
class Following:
    """In its block the followers keep their places; leaving it, in any way, tells them to hold.

    It stops by itself when the leader is lost or taken over, and as the fleet's policy says when a follower is. The
    event :class:`FollowingStopped` tells it at once, and so does ``wait_stopped``; the block's program runs on, and
    ``raise_if_stopped`` and leaving the block raise :class:`SetpointStreamStopped`.
    """

    def __init__(
        self,
        crew: Crew,
        leader: Member,
        followers: list[Member],
        formation: Formation,
        rate_hz: float,
        max_speed_m_s: float,
    ) -> None:
        self._crew, self._leader, self._followers, self._formation = crew, leader, followers, formation
        self._period_s, self._rate_hz, self._max_speed_m_s = 1 / rate_hz, rate_hz, max_speed_m_s
        self._tasks = Background(self._on_mistake)
        self._ended = asyncio.Event()
        self._was_entered = self._was_told = False
        self._why = ""

    @property
    def is_running(self) -> bool:
        """Whether the followers follow."""
        return self._was_entered and not self._ended.is_set()

    @property
    def why(self) -> str:
        """Why it has stopped by itself, in words; empty while it has not."""
        return self._why

    def error_m(self, name: str) -> float:
        """Metres between where a follower is and where its place is now; infinite while that is not known."""
        member = next((each for each in self._followers if each.name == name), None)
        try:
            return math.inf if member is None else math.hypot(*self._to_go(member))
        except (ValueUnknownError, OperationRejected):
            return math.inf

    async def wait_stopped(self) -> str:
        """Wait until it stops by itself, and return why; empty once the block was left."""
        await self._ended.wait()
        return self._why

    def raise_if_stopped(self) -> None:
        """For loops of the block's program: ``while True: following.raise_if_stopped(); …``.

        Raises:
            SetpointStreamStopped: it has stopped by itself; the text says why.
        """
        if self._why:
            self._was_told = True
            raise SetpointStreamStopped(f"following has stopped: {self._why}")

    async def __aenter__(self) -> Self:
        if self._was_entered:
            raise BusyError("following is entered once; make a new one")
        self._was_entered = True
        self._look_at_leader()
        self._action = CommonAction(self._crew, "following", self._followers, self._fly)
        self._tasks.start(self._follow, "aerokit following")
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        await self._tasks.aclose()
        if exc is None and not self._was_told:
            self.raise_if_stopped()

    # --------------------------------------------------------------------------------------- inside

    async def _follow(self) -> None:
        await self._action.run()
        self._look_who_follows()

    async def _fly(self, member: Member) -> None:
        try:
            async with member.vehicle.guided.velocity(rate_hz=self._rate_hz) as stream:
                while not self._leader_is_gone():
                    stream.set(self._wanted(member))
                    await anyio.sleep(self._period_s)
                await asyncio.Event().wait()  # it is being cancelled with all the others, and holds by that
        finally:  # told before the others have landed by policy, and after the action knows why
            asyncio.get_running_loop().call_soon(self._look_who_follows)

    def _look_who_follows(self) -> None:
        if not self._action.under_way and self._action.mistake is None:
            result = self._action.so_far()
            failed = {name: str(error) for name, error in result.failed.items()}
            why = "; ".join(f"{name}: {error}" for name, error in failed.items())
            self._stop(why or "nobody follows", self._action.orders, {**result.left_out, **failed})

    def _leader_is_gone(self) -> bool:
        """Stop all of it if there is nobody to follow any more."""
        if not self._ended.is_set():
            try:
                self._look_at_leader()
                position_of(self._leader, OLD_LEADER_S)
            except (OperationRejected, ValueUnknownError) as error:
                following = self._action.under_way  # their streams tell them to hold as they are cancelled
                left_alone = {
                    each.name: f"{each.state.value}: {each.why}" if each.why else "it does not follow"
                    for each in self._followers
                    if each.name not in following
                }
                self._stop(str(error), dict.fromkeys(following, "hold"), left_alone)
                self._tasks.cancel()
        return self._ended.is_set()

    def _wanted(self, member: Member) -> VelocitySetpoint:
        moving = self._leader.vehicle.velocity.latest
        target = (0.0, 0.0, 0.0) if moving is None else (moving.north_m_s, moving.east_m_s, -moving.down_m_s)
        north, east, up = follow_velocity(
            self._to_go(member), target, gain=GAIN, max_speed_m_s=self._max_speed_m_s
        )
        return VelocitySetpoint(north, east, -up)

    def _to_go(self, member: Member) -> tuple[float, float, float]:
        """Metres north, east and up to its place, as of now: what was told a moment ago has moved on since."""
        leader, vehicle = self._leader.vehicle, member.vehicle
        there, here = position_of(self._leader, OLD_LEADER_S), position_of(member, OLD_LEADER_S)
        places = local_places(
            {
                "there": (there.latitude_deg, there.longitude_deg, altitude_amsl(self._leader, there)),
                "here": (here.latitude_deg, here.longitude_deg, altitude_amsl(member, here)),
            }
        )
        offset = self._formation.offset_of(member.name, leader.heading_deg.latest)
        to_go = [
            places["there"][i] - places["here"][i] + each
            for i, each in enumerate((offset.north_m, offset.east_m, offset.up_m))
        ]
        for one, sign in ((leader, 1.0), (vehicle, -1.0)):
            moving = one.velocity.latest
            if moving is not None:
                age = sign * one.position.age
                to_go[0] += age * moving.north_m_s
                to_go[1] += age * moving.east_m_s
                to_go[2] -= age * moving.down_m_s
        return to_go[0], to_go[1], to_go[2]

    def _look_at_leader(self) -> None:
        self._leader.look()
        if not self._leader.takes_orders:
            raise OperationRejected(
                f"the leader {self._leader.name} is {self._leader.state.value}: {self._leader.why}"
            )

    def _stop(self, why: str, orders: Mapping[str, str], left_alone: Mapping[str, str]) -> None:
        """It has stopped by itself."""
        if self._ended.is_set():
            return
        self._why = why
        self._ended.set()
        leader = self._leader
        event = FollowingStopped(
            self._crew.now(), leader.vehicle.system_id, leader.name, why, dict(orders), dict(left_alone)
        )
        self._crew.tell(event)

    def _on_mistake(self, error: Exception) -> None:
        holding = dict.fromkeys((each.name for each in self._followers if each.takes_orders), "hold")
        self._stop(str(error) or type(error).__name__, self._action.orders or holding, {})


@checks_arguments
class Formations(Travel):
    """Places by offsets from a leader."""

    async def form(
        self,
        formation: Formation,
        *,
        leader: str,
        speed_m_s: float | None = None,
        timeout: float | None = None,
    ) -> FleetResult:
        """Fly each to its place around the leader, who stays where it is; as :meth:`go_to`.

        Args:
            formation: who flies where.
            leader: the name of the member around whom it is; it is not in the formation itself.
            speed_m_s: ground speed; None leaves it.
            timeout: seconds that each of them has for a leg; None: as long as it takes.

        Raises:
            InvalidArgument: a name is nobody's, or two places are too near to each other. Nothing was sent.
            OperationRejected: the leader does not take part, or the ways come too near. Nothing was sent.
            ValueUnknownError: it is not known where the leader is, or one whose way is compared.
        """
        member, followers = self._roles(formation, leader)
        here, heading = position_of(member), member.vehicle.heading_deg.latest
        places: dict[str, Position] = {}
        for each in followers:
            offset = formation.offset_of(each.name, heading)
            there = here.offset(north_m=offset.north_m, east_m=offset.east_m, up_m=offset.up_m)
            # above the sea: their homes may not be at the leader's height
            places[each.name] = (
                there
                if there.altitude_amsl_m is None
                else Position(there.latitude_deg, there.longitude_deg, altitude_amsl_m=there.altitude_amsl_m)
            )
        if speed_m_s is not None:
            check_range("speed_m_s", speed_m_s, 0, 1000, above=True)
        return await self._travel("form", places, speed_m_s, timeout)

    def following(
        self, formation: Formation, *, leader: str, rate_hz: float = 5.0, max_speed_m_s: float = 10.0
    ) -> Following:
        """``async with fleet.following(formation, leader="north/1"):`` keep the places while the leader moves.

        Each follower is flown by velocity set-points. When the leader is lost or taken over, the followers hold; when a
        follower fails, the others are told what the fleet's policy says.

        Args:
            formation: who flies where.
            leader: the name of the member whom they follow; somebody else flies it, such as the block's program.
            rate_hz: set-points a second, 2 to 50.
            max_speed_m_s: nobody is told to fly faster, in m/s.

        Raises:
            InvalidArgument: a name is nobody's, or an argument is out of range.
            OperationRejected: the leader does not take part.
        """
        check_range("rate_hz", rate_hz, 2, 50)
        check_range("max_speed_m_s", max_speed_m_s, 0, 100, above=True)
        member, followers = self._roles(formation, leader)
        return Following(self._crew, member, followers, formation, rate_hz, max_speed_m_s)

    def _roles(self, formation: Formation, leader: str) -> tuple[Member, list[Member]]:
        for name in (leader, *formation.offsets):
            if name not in self.members:
                raise InvalidArgument(f"formation: {shown(name)} is not one of {', '.join(self.members)}")
        if leader in formation.offsets:
            raise InvalidArgument(f"formation: {leader!r} is the leader, and has no place of its own")
        least_m = self._crew.min_distance_m
        if least_m is not None and formation.least_distance_m() < least_m:
            nearest = formation.least_distance_m()
            raise InvalidArgument(
                f"formation: two places are {nearest:.1f} m apart, and this fleet keeps {least_m:g} m"
            )
        member = self.members[leader]
        member.look()
        if not member.takes_orders:
            raise OperationRejected(f"the leader {leader} is {member.state.value}: {member.why}")
        return member, [self.members[name] for name in formation.offsets]
