"""``Connection``: this program as one MAVLink node on a link."""

from __future__ import annotations

import logging
import math
import time
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit._internal.arguments import checked
from aerokit.connection.bus import Bus, EndSignal, Overflow, Subscription
from aerokit.connection.cells import StateCell
from aerokit.connection.frame_receiver import FrameReceiver
from aerokit.connection.heartbeats import (
    BLOCKING_MAX_IDLE_S,
    ActivityMonitor,
    HeartbeatWatchdog,
    LinkStateTracker,
    OwnHeartbeat,
    discovery_event,
)
from aerokit.connection.loop_watch import loop_clock
from aerokit.connection.routes import EVERY_PEER, MAX_ROUTES, Routes
from aerokit.connection.signatures import SignatureFilter
from aerokit.connection.tasks import BackgroundTasks, Deadlines
from aerokit.errors import AerokitError, BusyError, ConnectionClosed, InvalidArgument, LinkLost
from aerokit.events import (
    Event,
    LinkClosed,
    LinkDrained,
    LinkInterrupted,
    LinkRestored,
    LinkStalled,
    LinkState,
    OrderRefused,
    VehicleFound,
)
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavComponent
from aerokit.mavlink.frame import Frame, is_whole_frame
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Heartbeat
from aerokit.transport.link import Link

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncGenerator, Callable, Iterator, Sequence

    from aerokit.connection.bus import Detach, Sink
    from aerokit.connection.frame_receiver import FrameCounts
    from aerokit.connection.multilink.routes import MultiLinkRoutes
    from aerokit.errors import LinkOpenError
    from aerokit.events import LinkStatus
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.signing import Signing
    from aerokit.mavlink.statistics import FramerStatistics
    from aerokit.transport.link import Peer

    FrameObserver = Callable[[Frame, Peer], object]

logger: logging.Logger = logging.getLogger("aerokit")

ItemT = TypeVar("ItemT", bound="Message | Event")

HEARTBEAT_INTERVAL_S = 1.0


class Connection:
    """One MAVLink node (system id, component id) on one link.

    Received bytes enter through ``bytes_received``. One framer per remote peer extracts frames, which go to ``bus``.
    ``send`` writes a message to the peer from which its target was last received; :class:`Routes` stores that peer
    and decides when it may change (``may_move``). Everything runs on the event loop's thread.
    """

    def __init__(
        self,
        link: Link,
        *,
        source_system: int = 255,
        source_component: int = MavComponent.MISSIONPLANNER.value,
        dialect: Dialect = STANDARD,
        mavlink_version: int = 2,
        signing: Signing | None = None,
        may_move: bool = False,
        heartbeat: OwnHeartbeat | None = OwnHeartbeat(),  # noqa: B008 - it is immutable
    ) -> None:
        if not 1 <= source_system <= 255:
            raise InvalidArgument(f"source_system = {source_system} is not allowed: it must be 1 to 255")
        # 0 is the broadcast id, but DroneKit programs send with it. The vehicle's answers then look as if they were for
        # all components of our system.
        if not 0 <= source_component <= 255:
            raise InvalidArgument(f"source_component = {source_component} is not allowed: it must be 0 to 255")
        _check_version(mavlink_version)
        if dialect.get(Heartbeat.ID) is not Heartbeat:
            raise InvalidArgument(
                f"dialect {dialect.name!r} lacks aerokit's HEARTBEAT: pass the standard dialect or an extension of it"
            )
        self.link = link
        self.bus: Bus = Bus(dialect)
        self.source_system: int = source_system
        self.source_component: int = source_component
        self.attached: set[int] = set()
        """System ids that have a vehicle object on this connection."""
        self.components: set[tuple[int, int]] = set()
        """(system id, component id) of the components that this program provides on this connection."""
        # Maps (system id, component id) to a function that converts loop time to the component's milliseconds since
        # boot. The function returns None while the time since boot is unknown.
        self.boot_clocks: dict[tuple[int, int], Callable[[float], float | None]] = {}
        self.link_state: StateCell[LinkState] = StateCell("link_state", self.now, "frame")
        """State of the link, from frames of any sender; ``vehicle.link_state`` is about one vehicle."""
        self.deadlines: Deadlines = Deadlines()
        self._clock = loop_clock()
        self._unix_epoch_s = time.time() - self._clock()  # seconds since 1970 at loop time 0
        self._encoder = FrameEncoder(source_system, source_component, version=mavlink_version)
        self._signatures = SignatureFilter(self._encoder, self.unix_time, self.bus.publish)
        self.signing = signing
        make_routes = partial(Routes, link, self.bus.publish, self.attached, self.boot_clocks, may_move=may_move)
        self._multilink = self._make_multilink(make_routes) if link.is_multilink else None  # None with a single link
        self._routes: Routes | MultiLinkRoutes = self._multilink or make_routes()
        self._receiver = FrameReceiver(link, self.bus, self._routes, self._signatures, self._clock)
        self._observers = self._receiver.observers
        self.heartbeats: dict[tuple[int, int], Heartbeat] = self._receiver.heartbeats
        """Last HEARTBEAT of every (system id, component id) on the link."""
        self.keeps_peers = True  # read by the link; see `aerokit.transport.link.PeerKeeper`
        self._background = BackgroundTasks(self.fail)
        self._owns_link = True  # False if the link turns out to belong to another connection
        self._state_tracker = LinkStateTracker(self.link_state, self.bus, system_id=0)
        self._end_signal = EndSignal()
        # None if this program sends no heartbeat.
        self._heartbeat = None if heartbeat is None else HeartbeatWatchdog(heartbeat, self._clock, self.bus.publish)

    def _make_multilink(self, make_routes: Callable[[], Routes]) -> MultiLinkRoutes:
        # Imported here because few programs have several links.
        from aerokit.connection.multilink.routes import MultiLinkRoutes
        from aerokit.transport.multilink import MultiLink

        assert isinstance(self.link, MultiLink)
        return MultiLinkRoutes(
            self.link,
            make_routes,
            self.bus,
            own_source=(self.source_system, self.source_component),
            vehicle_systems=self.attached,
            send=self._send_to_peer,
            now=self.now,
        )

    # ------------------------------------------------------------------------------- sending

    @checked
    def send(self, message: Message, *, to: int | None = None) -> None:
        """Encode a message with the next sequence number, and write it. Never blocks.

        A message for one component goes to the peer from which that component was last received. A message for a
        whole system goes to every peer with components of that system. A message for all or for an unknown target goes
        to every peer. With several links, nothing is sent over a link that leads to another vehicle with the same id
        (:class:`DuplicateSender`).

        With ``to``, the message is sent to the peers of the system with this id, not to those of ``target_system``. The
        message itself is not changed.

        Raises:
            InvalidArgument: a field is out of range; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        self._encode_and_write(self._encoder, message, to)

    @checked
    def write_raw(self, data: bytes) -> None:
        """Write one complete frame of another sender unchanged, for programs that forward frames. Never blocks.

        The frame goes to the peers that :meth:`send` would choose for the same message. A signature is kept. A frame
        for all or for an unknown target goes to every peer. Forward only frames that another connection has
        received, because a frame received by this connection could be sent back to its sender.

        Raises:
            InvalidArgument: ``data`` is not exactly one MAVLink frame; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        self.raise_if_ended()
        if not is_whole_frame(data):
            raise InvalidArgument(
                f"data is not exactly one MAVLink frame: {len(data)} bytes starting with {bytes(data[:3]).hex()!r}"
            )
        frame = Frame.parse(bytes(data))
        is_known = self.bus.dialect.get(frame.message_id) is not None
        # The frame is decoded only to find its target. An unknown message (None) goes to every peer.
        self._write(frame.raw, self.bus.dialect.decode(frame) if is_known else None, to=None)

    def send_as(self, encoder: FrameEncoder, message: Message, *, to: int | None = None) -> None:
        """Like :meth:`send`, for another component of this program, which has its own encoder."""
        encoder.version, encoder.signing = self._encoder.version, self._encoder.signing
        self._encode_and_write(encoder, message, to)

    def feed(self) -> None:
        """Keep our heartbeat going for another ``fed_within_s`` seconds (see `OwnHeartbeat`).

        Call it from any thread to show that the program is running.
        """
        if self._heartbeat is not None:
            self._heartbeat.activity.feed()

    def _use_activity_monitor(self, activity: ActivityMonitor) -> None:
        """Pause our heartbeat when the program's own threads hang."""
        if self._heartbeat is not None:
            self._heartbeat.watch(activity, BLOCKING_MAX_IDLE_S)

    @property
    def links(self) -> StateCell[tuple[LinkStatus, ...]] | None:
        """Status of each of several links, updated once a second and on every change; None with a single link."""
        return None if self._multilink is None else self._multilink.status

    @property
    def unsent_bytes(self) -> int:
        """Number of written bytes that have not left this machine; 0 if the link cannot measure the number.

        A value that stays above 0 means that the link does not drain (TCP without a network, a serial port with flow
        control asserted); see :class:`LinkStalled`. Always 0 for UDP.
        """
        return self.link.unsent_bytes

    def discard_unsent(self) -> None:
        """Discard written data that has not left this program yet, e.g. an outdated command.

        The call discards all waiting data, for all targets. Data in the system's TCP buffer cannot be discarded and
        stays in :attr:`unsent_bytes`.
        """
        self.link.discard_unsent()

    @property
    def mavlink_version(self) -> int:
        """MAVLink version of sent messages, 1 or 2. MAVLink 1 has no message ids above 255 and no extension fields.

        May be set while the connection is open. Other numbers raise InvalidArgument.
        """
        return self._encoder.version

    @mavlink_version.setter
    def mavlink_version(self, version: int) -> None:
        _check_version(version)
        self._signatures.check_version(version)
        self._encoder.version = version

    @property
    def signing(self) -> Signing | None:
        """Key that signs sent frames and verifies received frames; None: frames are neither signed nor verified.

        ``signing.timestamp`` is the time stamp to store; ``signing.refused`` counts refused frames. May be set while
        the connection is open; setting a key raises InvalidArgument with MAVLink 1, which has no signatures.
        """
        return self._encoder.signing

    @signing.setter
    def signing(self, signing: Signing | None) -> None:
        self._signatures.set_signing(signing)

    @checked
    def subscribe(
        self,
        *types: type[ItemT],
        system_id: int = 0,
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
    ) -> Subscription[ItemT]:
        """Return a subscription to these messages or events of one system (0: of all), to use in a ``with`` block.

        At most ``capacity`` unread items are kept, of all types together; by default only the newest. When a further
        item arrives, ``overflow="drop_oldest"`` drops the oldest unread item, ``"drop_newest"`` the new one, and
        ``"error"`` ends the subscription with an error, see :class:`Subscription`.

        Raises:
            InvalidArgument: no type is given, or the dialect does not have a given type.
        """
        self.check_types(types)

        def attach(sink: Sink) -> list[Detach]:  # called when the `with` block of the subscription is entered
            return [self.on_end(subscription.close), *self.attach(types, sink, system_id=system_id)]

        subscription: Subscription[ItemT] = Subscription(attach, capacity=capacity, overflow=overflow)
        return subscription

    async def vehicles(self) -> AsyncGenerator[VehicleFound, None]:
        """Yield every autopilot on the link once, until the connection ends. Autopilots already known come first.

        A known autopilot is yielded even if it has left; ``at`` is then the time of its last heartbeat.

        To use a vehicle, connect to it: ``aerokit.connect(connection, system_id=found.system_id)``.

        Raises:
            ConnectionClosed, LinkLost: the connection ended.
        """
        self.raise_if_ended()
        # New discoveries are queued while the earlier ones are yielded.
        with self.subscribe(VehicleFound, capacity=MAX_ROUTES) as discoveries:
            earlier_events = {
                source: discovery_event(heartbeat, self.last_heartbeat_at(*source), *source)
                for source, heartbeat in self.heartbeats.items()
            }
            for event in earlier_events.values():
                if isinstance(event, VehicleFound):
                    yield event
            yielded = set(earlier_events)
            async for event in discoveries:
                source = event.system_id, event.component_id
                if source not in yielded:  # A component is found again if its heartbeat was forgotten meanwhile.
                    yielded.add(source)
                    yield event

    def attach(self, types: Sequence[type[Any]], sink: Sink, *, system_id: int = 0) -> list[Detach]:
        """Deliver these messages and events, of one system (0: of all), to ``sink``."""
        return [self._attach(message_or_event, sink, system_id) for message_or_event in types]

    def observe_frames(self, callback: FrameObserver) -> Detach:
        """Call ``callback(frame, peer)`` with every received frame, after the subscribers got the message.

        Frames with message ids outside the dialect are included, and their checksums are not checked. Frames of a
        second peer under the ids of a known component are refused, and not included. On a reopened link, frames of a
        vehicle are included once its time since boot shows whether it is the same vehicle. The callback must return
        quickly; its exceptions are logged. Observers cost time, because every frame must then become an object.
        """
        return self._observers.add(callback)

    def observe_sent_frames(self, callback: Callable[[bytes], object]) -> Detach:
        """Call ``callback(raw)`` with every frame that :meth:`send` writes, signature included.

        Frames of :meth:`write_raw` are excluded. The callback must return quickly; its exceptions are logged.
        """
        return self._observers.add_sent(callback)

    def check_types(self, types: tuple[type[Any], ...]) -> None:
        """Raise InvalidArgument if ``types`` is empty, or an item is neither an event nor a message of the dialect."""
        if not types:
            raise InvalidArgument("name at least one message or event class to subscribe to")
        for item in types:
            if not isinstance(item, type) or not issubclass(item, (Message, Event)):
                raise InvalidArgument(f"{item!r} is neither a message class nor an event class")
            if issubclass(item, Message) and self.bus.dialect.get(item.ID) is not item:
                raise InvalidArgument(f"{item.NAME} is not in this connection's dialect")

    def on_end(self, callback: Callable[[Exception], None]) -> Detach:
        """Call ``callback(error)`` when the connection ends, or immediately if the connection has already ended."""
        return self._end_signal.on_end(callback)

    # ---------------------------------------------------------------------------------- state

    @property
    def is_open(self) -> bool:
        """True while messages can be sent and received."""
        return self._end_signal.error is None

    def raise_if_ended(self) -> None:
        """Raise the error that ended the connection (ConnectionClosed or LinkLost), unless the connection is open."""
        self._end_signal.raise_if_ended()

    def last_heartbeat_at(self, system_id: int, component_id: int) -> float:
        """Return the receive time of a component's last HEARTBEAT, on the clock of :meth:`now`; −inf if none."""
        heartbeat = self.heartbeats.get((system_id, component_id))
        frame = None if heartbeat is None else heartbeat.received_frame
        return -math.inf if frame is None else frame.received_at

    def now(self) -> float:
        """Return the event loop's time in seconds; all ages and deadlines use this clock."""
        return self._clock()

    def _slept_since(self, at: float) -> float:
        """Return for how many seconds the computer was suspended after ``at``, a time on the clock of :meth:`now`.

        This clock stands still meanwhile. If the suspension was not noticed before, the call publishes
        :class:`ComputerSlept`, and the vehicles add the suspension to the age of all their values before it returns.
        """
        return self._receiver.slept_since(at)

    @checked
    def new_cell(self, name: str, waits_for: str) -> StateCell[Any]:
        """Make a cell whose values are time-stamped with the receive time of their message; see :class:`StateCell`."""
        return StateCell(name, self.now, waits_for, stamp=self._receiver.arrived_at)

    def arrived_at(self) -> float:
        """Return the receive time of the message being delivered, on the clock of :meth:`now`.

        This time is earlier than now if the event loop was blocked, because the message may have waited in the socket.
        """
        return self._receiver.arrived_at()

    def unix_time(self) -> float:
        """Return seconds since 1970: the system time at the start, advanced by :meth:`now`. It never jumps."""
        return self._unix_epoch_s + self._clock()

    def describe_signature_problems(self, system_id: int = 0, component_id: int = 0) -> str:
        """Return a hint for error texts if signatures are probably the problem; otherwise "".

        With a signing key, the hint counts the refused frames of all senders. Without a key, it says that the last
        heartbeat of this component was signed. ``component_id`` 0 means any component of the system.
        """
        return self._signatures.describe(
            heartbeat
            for (system, component), heartbeat in self.heartbeats.items()
            if system == system_id and component_id in (0, component)
        )

    def statistics(self) -> Iterator[FramerStatistics]:
        """Iterate over the counters of every remembered peer."""
        return self._receiver.statistics()

    def counts(self, system_id: int) -> FrameCounts:
        """Return how many frames of this system were received, and how many sequence numbers are missing."""
        return self._receiver.counts(system_id)

    def received_from(self, system_id: int, component_id: int) -> int:
        """Return how many frames of this sender were received over the link with the most of them."""
        return self._receiver.received_from(system_id, component_id)

    def close(self, error: Exception | None = None) -> None:
        """Close the link, cancel background tasks and raise ``error`` in all waiters. Never blocks; idempotent.

        A link that another connection has opened stays open. May be called inside the connection's block. The block
        continues, but its further calls on the connection raise.
        """
        self._end(error or ConnectionClosed("the connection was closed"))
        if self._owns_link:
            self.link.close()
        self._observers.close()

    def fail(self, error: Exception) -> None:
        """Close the connection because of an internal error of aerokit, which becomes the cause of all later errors."""
        if not self.is_open and isinstance(error, AerokitError):
            return  # A background task failed only because the connection was closed before.
        logger.error("the connection is closed because of an internal error of aerokit", exc_info=error)
        closed = ConnectionClosed(f"an internal error of aerokit closed the connection: {error!r}")
        closed.__cause__ = error
        self.close(closed)

    def record(self, path: str | os.PathLike[str]) -> None:
        """Record all sent and received frames to a ``.tlog`` file until the connection is closed.

        A file that exists already stays as it is until the first frame is received. It is then renamed to the next free
        number (``flight.1.tlog``). The recording begins with the last frames that were sent until then, at most 1000.

        Raises:
            LinkOpenError: the file cannot be written.
            BusyError: the connection is already being recorded.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        self.raise_if_ended()
        self._observers.record(path, self._clock())

    # -------------------------------------------------------- called by the link (transport.link.Receiver)

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Process received bytes. Never raises."""
        try:
            self._receiver.receive(data, peer)
        except Exception as error:
            self.fail(error)

    def link_interrupted(self, error: LinkLost) -> None:
        """Called when the link was lost and is being reopened."""
        self._state_tracker.mark_lost(self._clock())
        self.bus.publish(LinkInterrupted(self._clock(), system_id=0, error=error))

    def link_restored(self, away_s: float) -> None:
        """Called when the link is open again after an interruption."""
        self._receiver.reset()
        self._state_tracker.record_activity(self._clock())
        self.bus.publish(LinkRestored(self._clock(), system_id=0, away_s=away_s))

    def hold_back(self, system_id: int, on_frame: Callable[[Frame], object]) -> Detach:
        """Give the frames of this system to ``on_frame`` only, until the returned function is called.

        ``on_frame`` may call that function; the frame is then delivered. The recording has all frames.
        """
        return self._receiver.hold_back(system_id, on_frame)

    def is_held_back(self, system_id: int) -> bool:
        """Return True while the frames of this system are held back."""
        return self._receiver.is_held_back(system_id)

    def link_stalled(self, unsent_bytes: int) -> None:
        """Called when written data has stopped leaving this machine."""
        self.bus.publish(LinkStalled(self._clock(), system_id=0, unsent_bytes=unsent_bytes))

    def link_drained(self, stalled_s: float) -> None:
        """Called when written data leaves this machine again."""
        self.bus.publish(LinkDrained(self._clock(), system_id=0, stalled_s=stalled_s))

    def member_link_changed(self, link: int, is_available: bool) -> None:
        """Called when one of several links was lost or is available again."""
        if self._multilink is not None:
            self._multilink.link_changed(link, is_available)

    def member_link_stalled(self, link: int, is_stalled: bool) -> None:
        """Called when data written to one of several links has stopped leaving, or leaves again."""
        if self._multilink is not None:
            self._multilink.link_stalled(link, is_stalled)

    def member_link_open_failed(self, link: int, error: LinkOpenError) -> None:
        """Called when one of several links could not be opened and will be retried."""
        if self._multilink is not None:
            self._multilink.link_open_failed(link, error)

    def order_refused(self, message: str, reason: str, lease_holder: str | None, answers: tuple[bytes, ...]) -> None:
        """Called when the other end of a zenoh link refused one of our commands."""
        refusal = OrderRefused(self._clock(), system_id=0, message=message, reason=reason, lease_holder=lease_holder)
        self.bus.publish(refusal)
        for answer in answers:  # The answers bypass the framers, which would count them as frames of the link.
            self.bus.deliver(Frame.parse(answer, self._clock()))

    def link_lost(self, error: LinkLost) -> None:
        """Called when the link is lost permanently; all waiting calls raise this error."""
        self._end(error)

    # ------------------------------------------------------------------------------- internal

    async def _open_link(self) -> None:
        try:
            await self.link.open(self)
        except BusyError:
            self._owns_link = False
            raise

    async def _wait_until_link_is_closed(self) -> None:
        if self._owns_link:
            await self.link.wait_closed()

    def _start(self) -> None:
        """Start the tasks that run until the connection ends."""
        self._state_tracker.record_activity(self._clock())
        self._receiver.start()
        self._background.start(self._send_heartbeats, "aerokit heartbeat")
        if self._multilink is not None:
            self._background.start(self._multilink.watch, "aerokit links")

    async def _send_heartbeats(self) -> None:
        while self.is_open:
            if self._heartbeat is not None and self._heartbeat.should_send():
                self.send(self._heartbeat.message)
            self._signatures.log_storage_errors()
            self._state_tracker.update(self._clock(), sum(counters.frames for counters in self.statistics()))
            self._observers.flush()
            await anyio.sleep(HEARTBEAT_INTERVAL_S)

    def _end(self, error: Exception) -> None:
        """End the connection. All waiters and later calls raise ``error``. Idempotent."""
        if not self.is_open:
            return
        self._end_signal.error = error  # Set first, because sinks of the events below must find it closed.
        self._receiver.close()
        self._observers.flush()  # The task that flushes regularly ends below, and the program may run on for hours.
        # Only a lost link is published as an event: a program that closes the connection itself needs none.
        self._state_tracker.mark_lost(self._clock(), publish=isinstance(error, LinkLost))
        self.link_state.close(error)
        if self._multilink is not None:
            self._multilink.status.close(error)
        if isinstance(error, LinkLost):
            self.bus.publish(LinkClosed(self._clock(), system_id=0, error=error))
        self._end_signal.notify(error)
        self.deadlines.close()
        self._background.cancel()

    def _try_to_send(self, message: Message) -> bool:
        """Send a message. Return False if no link accepted it."""
        return self._encode_and_write(self._encoder, message, to=None)

    def _encode_and_write(self, encoder: FrameEncoder, message: Message, to: int | None) -> bool:
        self.raise_if_ended()
        data = self._encode(encoder, message)
        is_written = self._write(data, message, to)
        if is_written:
            self._observers.notify_sent(data)
        return is_written

    def _encode(self, encoder: FrameEncoder, message: Message) -> bytes:
        return encoder.encode(message, 0.0 if encoder.signing is None else self.unix_time())

    def _write(self, data: bytes, message: Message | None, to: int | None) -> bool:
        """Write a frame to the peers of the target of ``message``, or to all peers if the message has no target.

        With ``to``, the system with this id is the target instead. Returns False if nothing was sent.
        """
        system_id = getattr(message, "target_system", 0) if to is None else to
        peers = self._routes.peers_of(system_id, getattr(message, "target_component", 0), message)
        dropped_before = self.link.dropped_writes
        for peer in peers:
            self.link.write(data, peer)
        # With EVERY_PEER, the number of peers is unknown: some may have got the frame although a write was dropped.
        is_written = peers is EVERY_PEER or self.link.dropped_writes - dropped_before < len(peers)
        if is_written:
            self._observers.record_sent(data, self._clock())
        return is_written

    def _send_to_peer(self, message: Message, peer: Peer) -> None:
        data = self._encode(self._encoder, message)
        self.link.write(data, peer)
        self._observers.record_sent(data, self._clock())

    def _attach(self, message_or_event: type[Any], sink: Sink, system_id: int) -> Detach:
        if issubclass(message_or_event, Message):
            return self.bus.attach(message_or_event, sink, system_id=system_id)
        return self.bus.attach_event(message_or_event, _filter_by_system(system_id, sink) if system_id else sink)


def _filter_by_system(system_id: int, sink: Sink) -> Sink:
    """Return a sink for the events of this system and of the whole link (system id 0)."""

    def filtered(event: Event) -> None:
        if event.system_id in (0, system_id):
            sink(event)

    return filtered


def _check_version(version: int) -> None:
    if version not in (1, 2):
        raise InvalidArgument(f"mavlink_version = {version} is not allowed: it must be 1 or 2")
