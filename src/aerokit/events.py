"""What a program may want to be told of: a small family of frozen events, apart from wire messages.

``vehicle.subscribe(events.ModeChanged)`` gives them one after the other; subscribing to :class:`Event` gives all.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot

if TYPE_CHECKING:
    from aerokit.errors import AerokitError
    from aerokit.position import Position

__all__ = [
    "SILENT_AFTER_S",
    "ArmedChanged",
    "ComponentFound",
    "ComputerSlept",
    "Event",
    "FrameRefused",
    "GimbalControlLost",
    "HeardTwice",
    "HeartbeatPaused",
    "HeartbeatResumed",
    "ImageCaptured",
    "LandedStateChanged",
    "LinkChosen",
    "LinkClosed",
    "LinkDrained",
    "LinkInterrupted",
    "LinkReport",
    "LinkRestored",
    "LinkStalled",
    "LinkState",
    "LinkStateChanged",
    "LinkStatus",
    "LoopBlocked",
    "MissionCurrentChanged",
    "MissionFinished",
    "MissionItemReached",
    "ModeChanged",
    "MoveRefused",
    "OneLinkChanged",
    "OneLinkNotOpened",
    "OrderRefused",
    "ParameterChanged",
    "SettingChanged",
    "StatusTextReceived",
    "StreamSlow",
    "StreamUnavailable",
    "VehicleBack",
    "VehicleFound",
    "VehicleMoved",
    "VehicleRebooted",
    "VehicleSilent",
]


class Event(Snapshot):
    """Something happened at ``at`` (seconds on the event loop's clock) to ``system_id`` (0: to the link as a whole)."""

    at: float
    system_id: int


class VehicleFound(Event):
    """The first heartbeat of this autopilot was heard on the connection, whether a vehicle is connected to or not.

    ``vehicle_type`` is its MAV_TYPE, ``autopilot`` its MAV_AUTOPILOT.
    """

    component_id: int
    vehicle_type: int
    autopilot: int


class ComponentFound(Event):
    """The first heartbeat of another component than an autopilot was heard on the connection; ``type`` is its MAV_TYPE.

    Cameras, gimbals, companion computers, other ground stations: of any system, connected to or not.
    """

    component_id: int
    type: int


class VehicleSilent(Event):
    """No heartbeat has come for ``silent_for_s`` seconds."""

    silent_for_s: float


class VehicleBack(Event):
    """Heartbeats come again after a silence of ``silent_for_s`` seconds."""

    silent_for_s: float


class VehicleRebooted(Event):
    """The autopilot's time since boot went backwards: it has started anew. Message rates are asked for again."""


class HeardTwice(Event):
    """The same system and component id came from a second sender; what it says is not listened to.

    Two vehicles with the same ids, or two ways to the same one, behind two peers of the link or behind one (told apart
    by their sequence numbers). Told once for each such peer.
    """

    component_id: int


class VehicleMoved(Event):
    """A component is heard from another peer now: the addresses ``before`` and ``after``, as text."""

    component_id: int
    before: str
    after: str


class MoveRefused(Event):
    """A component is silent, and ``peer`` speaks in its name without going on where it stopped; it is not listened to.

    Another vehicle, or this one rebooted with another IP address: ``may_move=True`` allows it.
    """

    component_id: int
    peer: str


class FrameRefused(Event):
    """A frame was not let in, because it carries no good signature of our key. Told once for each reason.

    ``connection.signing.refused`` counts them all.
    """

    component_id: int
    reason: str


class OrderRefused(Event):
    """What we sent did not go to the vehicle: the program that has it on the network refused it (docs/network.md).

    ``message`` is the MAVLink message's name, ``reason`` a clause, ``helm`` who orders the vehicle, if that is why.
    Told twice a second at most of messages of one name.
    """

    message: str
    reason: str
    helm: str | None


class ModeChanged(Event):
    """The flight mode that HEARTBEAT tells has changed; names as in ``vehicle.mode``."""

    before: str | None
    after: str


class ArmedChanged(Event):
    """The armed flag of HEARTBEAT has changed."""

    is_armed: bool


class LandedStateChanged(Event):
    """EXTENDED_SYS_STATE.landed_state has changed (MAV_LANDED_STATE)."""

    before: int | None
    after: int


class MissionItemReached(Event):
    """The vehicle has reached item ``item`` of its mission (counted from 0, home never counts).

    An autopilot may leave items out that it flies past without stopping.
    """

    item: int


class MissionCurrentChanged(Event):
    """The vehicle goes for another item of its mission; None: for none, because it has not begun or has no mission."""

    before: int | None
    after: int | None


class MissionFinished(Event):
    """The vehicle has flown its mission to the end."""


class GimbalControlLost(Event):
    """A gimbal that a block ``gimbal.control()`` had in its hands is not ours any more (GIMBAL_MANAGER_STATUS).

    ``to_system_id`` and ``to_component_id`` are who has it now, zeros: nobody; ``is_primary``: which control it was.
    """

    gimbal_device_id: int
    is_primary: bool
    to_system_id: int
    to_component_id: int


class StatusTextReceived(Event):
    """The vehicle said something (STATUSTEXT, chunks joined); ``severity`` is a MAV_SEVERITY, 0 the worst, 7 debug."""

    severity: int
    text: str


class StreamSlow(Event):
    """A message comes at less than half the rate that this component was asked for."""

    message: str
    asked_hz: float
    achieved_hz: float
    component_id: int = 1


class StreamUnavailable(Event):
    """This component refuses to send this message at the rate that was asked for."""

    message: str
    reason: str
    component_id: int = 1


class ParameterChanged(Event):
    """A parameter of this component whose value was known has another one now, whoever changed it."""

    name: str
    before: int | float
    after: int | float
    component_id: int = 1


class SettingChanged(Event):
    """A setting of this component (PARAM_EXT) whose value was known has another one now, whoever changed it."""

    name: str
    before: bool | int | float | str | bytes
    after: bool | int | float | str | bytes
    component_id: int


class ImageCaptured(Event):
    """A camera has told of a picture, heard of for the first time; ``camera.captures()`` has more of it.

    ``camera`` is 1 to 6 behind the autopilot, otherwise a component id; ``index`` counts from 0; ``success`` is None
    where nobody said. Told once ``vehicle.camera`` or ``vehicle.cameras`` was used, or a message of this kind has come.
    """

    camera: int
    index: int
    success: bool | None
    place: Position | None
    file_url: str
    component_id: int = 1


class LinkReport(Event):
    """How the link did in the last second, once a second.

    ``loss_percent`` (frames missing by sequence number, None before any), ``round_trip_s`` (TIMESYNC, None before the
    first answer), ``frames_per_s`` and ``bytes_per_s`` as received.
    """

    loss_percent: float | None
    round_trip_s: float | None
    frames_per_s: float
    bytes_per_s: float


class LoopBlocked(Event):
    """The program kept the event loop from running for ``seconds``: nothing was received or sent meanwhile."""

    seconds: float


class ComputerSlept(Event):
    """The computer slept for ``seconds``, while the event loop's clock stood still: values are older by that."""

    seconds: float


class HeartbeatPaused(Event):
    """The program has shown no sign of life for ``idle_s`` seconds: our own heartbeat is not sent."""

    idle_s: float


class HeartbeatResumed(Event):
    """The program has shown one: our own heartbeat is sent again, after ``paused_s`` seconds."""

    paused_s: float


class LinkInterrupted(Event):
    """The link has gone and is being opened again (``reconnect=True``); what is sent meanwhile is lost."""

    error: AerokitError


class LinkRestored(Event):
    """The link is there again after ``away_s`` seconds. Message rates are asked for again."""

    away_s: float


class LinkStalled(Event):
    """What was written has not left for a second; ``unsent_bytes`` wait, and an order among them may arrive late.

    What has waited for a second in aerokit is dropped; what the system has taken (``connection.unsent_bytes``) is
    beyond recall. :class:`LinkDrained` is the end of it, or the link's own end.
    """

    unsent_bytes: int


class LinkDrained(Event):
    """What is written leaves again, after ``stalled_s`` seconds."""

    stalled_s: float


class LinkChosen(Event):
    """Of several links, ``link`` (its address) is used for this system from now on: orders go over it.

    ``before`` is the one used until now (None: this is the first), ``reason`` says why: "first heard", "silent",
    "stalled", "lost" (the former one), "better", "cheaper" (the former one is a costly one), or "another vehicle" (is
    behind the former one: told late, by its AUTOPILOT_VERSION). Message rates are asked for again, for an autopilot
    keeps them for each link.
    """

    link: str
    before: str | None
    reason: str


class OneLinkChanged(Event):
    """One of several links (its address) has gone, fallen silent, or is there again."""

    link: str
    before: LinkState
    after: LinkState


class OneLinkNotOpened(Event):
    """One of several links (its address) could not be opened at first, and why; it is tried again. Told once.

    That is some tenths of a second after the connection was opened; ``connection.links`` has it as LOST all the time,
    and ``OneLinkChanged`` tells when it is there.
    """

    link: str
    error: AerokitError


class LinkStateChanged(Event):
    """The way CONNECTED → SILENT → LOST, and back: of one vehicle, or of the link as a whole (``system_id`` 0)."""

    before: LinkState
    after: LinkState


class LinkClosed(Event):
    """The link has gone and will not come back by itself."""

    error: AerokitError


SILENT_AFTER_S = 3.5
"""Three missed heartbeats and a half."""


class LinkState(enum.Enum):
    """Told by ``vehicle.link_state`` and ``connection.link_state``; each change is a ``LinkStateChanged``."""

    CONNECTED = "connected"
    """Something was heard within the last 3.5 seconds: heartbeats of the vehicle, any frame on the link."""
    SILENT = "silent"
    """Nothing was heard for longer; the link itself is there, as far as the system tells."""
    LOST = "lost"
    """The link has gone, or the connection was closed. With ``reconnect=True`` it may be CONNECTED again."""


class LinkStatus(Snapshot):
    """How one of several links does: ``connection.links``."""

    link: str
    """Its address."""
    state: LinkState
    """SILENT: nothing of any vehicle has come for a second or two; LOST: it is closed, and opened again if possible."""
    is_costly: bool
    """Whether it is used only when the others fail (``costly=1``)."""
    systems: tuple[int, ...]
    """Which systems were heard over it."""
    used_for: tuple[int, ...]
    """What is for these goes over it, and what they say is taken from it."""
    loss_percent: float | None
    """Frames missing by their numbers in the last seconds, of the system that misses most; None: not known yet."""
    round_trip_s: float | None
    """Seconds from a question (TIMESYNC) to its answer, of the slowest system; None: nothing was answered yet."""
