"""Events of a fleet and its members. Each event has the member's name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.events import Event

if TYPE_CHECKING:
    from aerokit.fleets.separation import Deconfliction

__all__ = [
    "FleetEvent",
    "FollowingStopped",
    "MemberBack",
    "MemberEvent",
    "MemberFailed",
    "MemberLost",
    "MemberReclaimed",
    "MemberTakenOver",
    "PathsCompared",
    "PolicyApplied",
    "PolicyCompleted",
    "StateUpdate",
    "TooClose",
]


class FleetEvent(Event):
    """Base class of the events of a fleet.

    ``at`` is the time on the event loop's clock, ``system_id`` is that of ``member``.
    """

    member: str


class MemberEvent(FleetEvent):
    """Contains an event of one vehicle (``ModeChanged``, ``LinkReport`` …) or of one network (``LinkInterrupted`` …).

    ``member`` is the name of this vehicle or network.
    """

    event: Event


class StateUpdate(FleetEvent):
    """One of a vehicle's states, such as its mode, has a new ``value``. docs/states.md lists all states by name."""

    state: str
    value: Any


class MemberLost(FleetEvent):
    """A member is lost: its heartbeats stopped, or its link closed."""

    reason: str


class MemberBack(FleetEvent):
    """A lost member is back after ``away_s`` seconds, and still under this program's control."""

    away_s: float


class MemberTakenOver(FleetEvent):
    """A pilot, a failsafe or another program controls the member. The fleet sends it no orders until ``reclaim``."""

    reason: str


class MemberReclaimed(FleetEvent):
    """The program called ``reclaim`` for the member."""


class MemberFailed(FleetEvent):
    """A member failed in ``action``: it refused, timed out, was lost or was taken over."""

    action: str
    error: str


class PolicyApplied(FleetEvent):
    """``member`` failed in ``action``, and the policy sends ``orders`` to other members.

    ``orders`` maps names to ``"hold"``, ``"land"`` or ``"return"``. ``skipped`` maps the names of members that got no
    order to the reason.
    """

    action: str
    orders: dict[str, str]
    skipped: dict[str, str]


class PolicyCompleted(FleetEvent):
    """All orders that the policy sent after the failure of ``member`` have ended.

    ``errors`` maps members whose order failed to the text of the error.
    """

    action: str
    orders: dict[str, str]
    errors: dict[str, str]


class FollowingStopped(FleetEvent):
    """The followers stopped following the leader ``member`` before the end of the program's block.

    ``orders`` and ``skipped`` are as in :class:`PolicyApplied`.
    """

    reason: str
    orders: dict[str, str]
    skipped: dict[str, str]


class PathsCompared(FleetEvent):
    """The paths of several members were compared before a flight. ``member`` is an empty string."""

    deconfliction: Deconfliction


class TooClose(FleetEvent):
    """``member`` and ``other`` are closer than the minimum distance. ``ordered`` names the members ordered to hold."""

    other: str
    distance_m: float
    ordered: tuple[str, ...]
