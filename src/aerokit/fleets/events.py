"""What happens to a fleet and its members: events, each with the member's name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.events import Event

if TYPE_CHECKING:
    from aerokit.fleets.separation import Deconfliction

__all__ = [
    "FleetEvent",
    "FollowingStopped",
    "MemberBack",
    "MemberFailed",
    "MemberLost",
    "MemberTakenBack",
    "MemberTakenOver",
    "PathsDecided",
    "PolicyCarriedOut",
    "PolicyOrdered",
    "StateTold",
    "Told",
    "TooClose",
]


class FleetEvent(Event):
    """Something happened to ``member``; ``at`` is the loop's clock, ``system_id`` the member's."""

    member: str


class Told(FleetEvent):
    """An event of one vehicle, as :class:`aerokit.Vehicle` gives it; ``member`` is the network when it is the link's.

    Such as ``ModeChanged``, ``StatusTextReceived``, ``LinkReport``.
    """

    event: Event


class StateTold(FleetEvent):
    """A vehicle has told one of its states: ``state`` as in docs/states.md, and the ``value``."""

    state: str
    value: Any


class MemberLost(FleetEvent):
    """A member is not heard any more: its heartbeats have stopped, or its link has gone."""

    why: str


class MemberBack(FleetEvent):
    """A member that was lost is heard again, and nobody else has taken it meanwhile."""

    away_s: float


class MemberTakenOver(FleetEvent):
    """A pilot, a failsafe or another program has taken a member: nothing is ordered of it until ``take_back``."""

    why: str


class MemberTakenBack(FleetEvent):
    """The program has taken a member back into the fleet."""


class MemberFailed(FleetEvent):
    """A member did not do its part in ``action``: a refusal, a time-out, a lost link, somebody else at the helm."""

    action: str
    error: str


class PolicyOrdered(FleetEvent):
    """``member`` has failed in ``action``, and these are ordered for it: name → ``"hold"``, ``"land"`` or ``"return"``.

    ``left_alone`` are the others, and why nothing is ordered of them.
    """

    action: str
    orders: dict[str, str]
    left_alone: dict[str, str]


class PolicyCarriedOut(FleetEvent):
    """What was ordered because ``member`` failed is done; ``errors`` has those who did not do it, and why."""

    action: str
    orders: dict[str, str]
    errors: dict[str, str]


class FollowingStopped(FleetEvent):
    """The leader, ``member``, is not followed any more: ``why``, and what is ordered of the followers.

    ``orders``: name → ``"hold"``, ``"land"`` or ``"return"``. ``left_alone`` are the others, and why nothing is ordered
    of them. Leaving the block is no such event.
    """

    why: str
    orders: dict[str, str]
    left_alone: dict[str, str]


class PathsDecided(FleetEvent):
    """Ways were compared before they are flown, of several members: ``member`` is empty; ``decided`` says how."""

    decided: Deconfliction


class TooClose(FleetEvent):
    """``member`` and ``other`` are nearer to each other than the fleet allows; ``ordered`` are those told to hold."""

    other: str
    distance_m: float
    ordered: tuple[str, ...]
