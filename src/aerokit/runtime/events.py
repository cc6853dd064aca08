"""What a program may want to be told of: a small family of frozen events, apart from wire messages.

``vehicle.subscribe(events.ModeChanged)`` gives them one after the other; subscribing to :class:`Event` gives all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.errors import AerokitError

__all__ = [
    "ArmedChanged",
    "Event",
    "LandedStateChanged",
    "LinkClosed",
    "LinkReport",
    "LoopBlocked",
    "ModeChanged",
    "StatusTextReceived",
    "StreamSlow",
    "StreamUnavailable",
    "VehicleBack",
    "VehicleFound",
    "VehicleRebooted",
    "VehicleSilent",
]


@dataclass(frozen=True)
class Event:
    """Something happened at ``at`` (seconds on the event loop's clock) to ``system_id`` (0: to the link as a whole)."""

    at: float
    system_id: int


@dataclass(frozen=True)
class VehicleFound(Event):
    """The first heartbeat of an autopilot with this system id was heard."""

    component_id: int


@dataclass(frozen=True)
class VehicleSilent(Event):
    """No heartbeat has come for ``silent_for_s`` seconds."""

    silent_for_s: float


@dataclass(frozen=True)
class VehicleBack(Event):
    """Heartbeats come again after a silence of ``silent_for_s`` seconds."""

    silent_for_s: float


@dataclass(frozen=True)
class VehicleRebooted(Event):
    """The autopilot's time since boot went backwards: it has started anew. Message rates are asked for again."""


@dataclass(frozen=True)
class ModeChanged(Event):
    """The flight mode that HEARTBEAT tells has changed; names as in ``vehicle.mode``."""

    before: str | None
    after: str


@dataclass(frozen=True)
class ArmedChanged(Event):
    """The armed flag of HEARTBEAT has changed."""

    is_armed: bool


@dataclass(frozen=True)
class LandedStateChanged(Event):
    """EXTENDED_SYS_STATE.landed_state has changed (MAV_LANDED_STATE)."""

    before: int | None
    after: int


@dataclass(frozen=True)
class StatusTextReceived(Event):
    """The vehicle said something (STATUSTEXT, chunks joined); ``severity`` is a MAV_SEVERITY, 0 the worst, 7 debug."""

    severity: int
    text: str


@dataclass(frozen=True)
class StreamSlow(Event):
    """A message comes at less than half the rate that was asked for."""

    message: str
    asked_hz: float
    achieved_hz: float


@dataclass(frozen=True)
class StreamUnavailable(Event):
    """The vehicle refuses to send this message at the rate that was asked for."""

    message: str
    reason: str


@dataclass(frozen=True)
class LinkReport(Event):
    """How the link did in the last second, once a second.

    ``loss_percent`` (frames missing by sequence number, None before any), ``round_trip_s`` (TIMESYNC, None before the
    first answer), ``frames_per_s`` and ``bytes_per_s`` as received.
    """

    loss_percent: float | None
    round_trip_s: float | None
    frames_per_s: float
    bytes_per_s: float


@dataclass(frozen=True)
class LoopBlocked(Event):
    """The program kept the event loop from running for ``seconds``: nothing was received or sent meanwhile."""

    seconds: float


@dataclass(frozen=True)
class LinkClosed(Event):
    """The link has gone and will not come back by itself."""

    error: AerokitError
