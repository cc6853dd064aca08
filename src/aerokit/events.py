"""Events that programs can subscribe to: small immutable values, separate from MAVLink messages.

``vehicle.subscribe(events.ModeChanged)`` yields events of one class; subscribing to :class:`Event` yields all.
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
    "DuplicateSender",
    "Event",
    "FrameRefused",
    "GimbalControlLost",
    "HeartbeatPaused",
    "HeartbeatResumed",
    "ImageCaptured",
    "LandedStateChanged",
    "LinkClosed",
    "LinkDrained",
    "LinkInterrupted",
    "LinkReport",
    "LinkRestored",
    "LinkSelected",
    "LinkStalled",
    "LinkState",
    "LinkStateChanged",
    "LinkStatus",
    "LoopBlocked",
    "MemberLinkOpenFailed",
    "MemberLinkStateChanged",
    "MissionCurrentChanged",
    "MissionFinished",
    "MissionItemReached",
    "ModeChanged",
    "OrderRefused",
    "ParameterChanged",
    "RouteChangeRefused",
    "RouteChanged",
    "SettingChanged",
    "StatusTextReceived",
    "StreamSlow",
    "StreamUnavailable",
    "VehicleFound",
    "VehicleRebooted",
    "VehicleRecovered",
    "VehicleSilent",
]


class Event(Snapshot):
    """Base class of all events.

    ``at`` is the time in seconds on the event loop's clock. ``system_id`` identifies the vehicle; it is 0 for events
    about the whole link.
    """

    at: float
    system_id: int


class VehicleFound(Event):
    """The first heartbeat of an autopilot arrived on the connection, whether or not the program has a `Vehicle` for it.

    ``vehicle_type`` is the MAV_TYPE, ``autopilot`` the MAV_AUTOPILOT in the heartbeat.
    """

    component_id: int
    vehicle_type: int
    autopilot: int


class ComponentFound(Event):
    """The first heartbeat of a component other than an autopilot arrived on the connection.

    Reported for cameras, gimbals, companion computers and other ground stations of any system. ``type`` is the
    MAV_TYPE.
    """

    component_id: int
    type: int


class VehicleSilent(Event):
    """The vehicle has sent no heartbeat for ``silent_for_s`` seconds."""

    silent_for_s: float


class VehicleRecovered(Event):
    """Heartbeats arrive again after a silence of ``silent_for_s`` seconds."""

    silent_for_s: float


class VehicleRebooted(Event):
    """The autopilot rebooted: its time since boot went backwards. aerokit requests message rates again.

    After a lost link was reopened, this event is also published if the time since boot does not continue the earlier
    times, or cannot be compared with them. The vehicle may have rebooted, or the link may lead to another vehicle.
    """


class DuplicateSender(Event):
    """A second sender uses a system and component id that is already in use. Its messages are ignored.

    The second sender is recognised by its other address, or by a second series of sequence numbers from the same
    address. Published once for each address.
    """

    component_id: int


class RouteChanged(Event):
    """A component is now received from another peer of the link. ``before`` and ``after`` are the peers' addresses."""

    component_id: int
    before: str
    after: str


class RouteChangeRefused(Event):
    """Frames of a component that fell silent arrive from the new address ``peer``, but aerokit ignores them.

    Their sequence numbers do not continue those of the component, so the sender may be another vehicle, or the same
    vehicle after a reboot. ``aerokit.connect(…, may_move=True)`` accepts the frames in both cases.
    """

    component_id: int
    peer: str


class FrameRefused(Event):
    """A frame was dropped because it has no valid signature made with our key.

    Published once for each reason. ``connection.signing.refused`` counts all refused frames.
    """

    component_id: int
    reason: str


class OrderRefused(Event):
    """The program that serves the vehicle on the network did not forward a message of this program (docs/network.md).

    ``message`` is the name of the MAVLink message, and ``reason`` a text that explains the refusal. ``lease_holder``
    is the client that controls the vehicle, if its control is the reason of the refusal; otherwise None. Published at
    most twice a second for each message name.
    """

    message: str
    reason: str
    lease_holder: str | None


class ModeChanged(Event):
    """The flight mode reported by HEARTBEAT changed. The names are the same as in ``vehicle.mode``."""

    before: str | None
    after: str


class ArmedChanged(Event):
    """The armed flag of HEARTBEAT changed."""

    is_armed: bool


class LandedStateChanged(Event):
    """EXTENDED_SYS_STATE.landed_state changed (MAV_LANDED_STATE)."""

    before: int | None
    after: int


class MissionItemReached(Event):
    """The vehicle reached mission item ``item``. The first item after home is 0.

    Some autopilots do not report items that they pass without stopping.
    """

    item: int


class MissionCurrentChanged(Event):
    """The current mission item changed from ``before`` to ``after``; None: no mission, or a mission not started yet."""

    before: int | None
    after: int | None


class MissionFinished(Event):
    """The vehicle completed its mission."""


class GimbalControlLost(Event):
    """A ``gimbal.control()`` block lost control: another system has it, or none (GIMBAL_MANAGER_STATUS).

    ``to_system_id`` and ``to_component_id`` identify the system now in control; both are 0 if there is none.
    ``is_primary`` is True for primary control, False for secondary control.
    """

    gimbal_device_id: int
    is_primary: bool
    to_system_id: int
    to_component_id: int


class StatusTextReceived(Event):
    """The vehicle sent a STATUSTEXT. The chunks of a long text are joined.

    ``severity`` is a MAV_SEVERITY: 0 emergency to 7 debug.
    """

    severity: int
    text: str


class StreamSlow(Event):
    """A message arrives at less than half of the rate requested from this component."""

    message: str
    requested_hz: float
    achieved_hz: float
    component_id: int = 1


class StreamUnavailable(Event):
    """The component refuses to send this message at the requested rate."""

    message: str
    reason: str
    component_id: int = 1


class ParameterChanged(Event):
    """A parameter whose value aerokit had already read has a new value, regardless of who changed it."""

    name: str
    before: int | float
    after: int | float
    component_id: int = 1


class SettingChanged(Event):
    """A setting (PARAM_EXT) whose value aerokit had already read has a new value, regardless of who changed it."""

    name: str
    before: bool | int | float | str | bytes
    after: bool | int | float | str | bytes
    component_id: int


class ImageCaptured(Event):
    """A camera reported a new image. ``camera.captures()`` returns its details.

    ``camera`` is 1 to 6 for cameras behind the autopilot, otherwise a component id. ``index`` counts from 0.
    ``success`` is None if not reported. Published only after the program has used ``vehicle.camera`` or
    ``vehicle.cameras``, or after the vehicle has sent a message about images.
    """

    camera: int
    index: int
    success: bool | None
    place: Position | None
    file_url: str
    component_id: int = 1


class LinkReport(Event):
    """Link quality of the last second, published every second.

    ``loss_percent`` is derived from missing sequence numbers (None before the first frame). ``round_trip_s`` is the
    last measurement by TIMESYNC (None if there was no answer in the last ten seconds). ``frames_per_s`` and
    ``bytes_per_s`` count received data.
    """

    loss_percent: float | None
    round_trip_s: float | None
    frames_per_s: float
    bytes_per_s: float


class LoopBlocked(Event):
    """The program blocked the event loop: nothing was received or sent meanwhile.

    ``seconds`` is an upper bound for the length of the pause. The real length is at most 0.12 s less.
    """

    seconds: float


class ComputerSlept(Event):
    """The computer was suspended for ``seconds``.

    The event loop's clock stood still meanwhile. aerokit adds this time to the age of every value of a vehicle.
    """

    seconds: float


class HeartbeatPaused(Event):
    """The program has shown no activity for ``idle_s`` seconds, so aerokit stopped sending its own heartbeat."""

    idle_s: float


class HeartbeatResumed(Event):
    """aerokit sends its own heartbeat again after ``paused_s`` seconds, because the program is active again."""

    paused_s: float


class LinkInterrupted(Event):
    """The link failed, and aerokit is reopening it (``reconnect=True``).

    Data that is sent before the link is open again is lost.
    """

    error: AerokitError


class LinkRestored(Event):
    """The link is open again after ``away_s`` seconds. aerokit requests message rates again."""

    away_s: float


class LinkStalled(Event):
    """The link has not sent any of its queued data for a second, so commands may arrive late.

    ``unsent_bytes`` is the size of the data in the queues of aerokit and, on Linux, of the operating system. aerokit
    drops data that waited in its own queue for more than a second, but cannot drop data that the operating system has
    accepted. The next event is :class:`LinkDrained`, unless the link ends.
    """

    unsent_bytes: int


class LinkDrained(Event):
    """The link transmits again. ``stalled_s`` is the time in seconds since :class:`LinkStalled`."""

    stalled_s: float


class LinkSelected(Event):
    """The traffic to this system now uses ``link`` (its address), one of several links.

    ``before`` is the previous link; None if there was none. ``reason`` is "first heard" for the first link. Otherwise
    it describes the previous link ("silent", "stalled", "lost") or the new link ("better", "cheaper"), or is "another
    vehicle" if AUTOPILOT_VERSION showed that the previous link leads to another vehicle. aerokit requests message rates
    again, because autopilots keep separate rates for each link.
    """

    link: str
    before: str | None
    reason: str


class MemberLinkStateChanged(Event):
    """One of several links (``link`` is its address) failed, fell silent or recovered."""

    link: str
    before: LinkState
    after: LinkState


class MemberLinkOpenFailed(Event):
    """One of several links could not be opened at first; aerokit keeps trying. Published once for each link.

    Published some tenths of a second after the connection was opened. ``connection.links`` lists the link as LOST until
    ``MemberLinkStateChanged`` reports it as open.
    """

    link: str
    error: AerokitError


class LinkStateChanged(Event):
    """The state of one vehicle, or of the whole link (``system_id`` 0), changed to CONNECTED, SILENT or LOST."""

    before: LinkState
    after: LinkState


class LinkClosed(Event):
    """The link failed, and aerokit does not reopen it."""

    error: AerokitError


SILENT_AFTER_S = 3.5
"""Seconds without a heartbeat before a vehicle counts as silent: 3.5 heartbeat intervals."""


class LinkState(enum.Enum):
    """State of a vehicle (``vehicle.link_state``) or of a link (``connection.link_state``)."""

    CONNECTED = "connected"
    """The vehicle sent a heartbeat, or the link delivered any frame, within the last 3.5 seconds."""
    SILENT = "silent"
    """The link is open, but for more than 3.5 seconds no heartbeat of the vehicle, or no frame at all, has arrived."""
    LOST = "lost"
    """The link failed or the connection was closed. With ``reconnect=True`` the state may become CONNECTED again."""


class LinkStatus(Snapshot):
    """Status of one of several links, see ``connection.links``."""

    link: str
    """Address of the link."""
    state: LinkState
    """SILENT: no vehicle was received for a second or two. LOST: the link is closed, and aerokit tries to reopen it."""
    is_costly: bool
    """True if the link is used only when all others fail (``costly=1``)."""
    systems: tuple[int, ...]
    """Ids of the systems received over this link."""
    used_for: tuple[int, ...]
    """Ids of the systems whose traffic uses this link."""
    loss_percent: float | None
    """Percentage of lost frames among about the last dozen; None until known. With several systems, the highest one."""
    round_trip_s: float | None
    """Round-trip time (TIMESYNC) of the slowest system; None before the first answer."""
