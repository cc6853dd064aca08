"""``Connection``: we, as one MAVLink node on one link, with our heartbeat, our bus and our routes."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit._internal.arguments import checked
from aerokit.connection.bus import Bus, Ending, Overflow, Subscription
from aerokit.connection.cells import StateCell
from aerokit.connection.components import found_by
from aerokit.connection.frame_receiver import Intake
from aerokit.connection.link_state import LinkStateWatch
from aerokit.connection.own_heartbeat import BLOCKING_FED_WITHIN_S, HeartbeatSwitch, OwnHeartbeat, ProofOfLife
from aerokit.connection.routes import MOST_ROUTES, Routes
from aerokit.connection.signatures import SignatureGate, check_signing
from aerokit.connection.tasks import Background, Deadlines
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
    from aerokit.connection.multilink.routes import SeveralRoutes
    from aerokit.errors import LinkOpenError
    from aerokit.events import LinkStatus
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.signing import Signing
    from aerokit.mavlink.statistics import FramerStatistics
    from aerokit.transport.link import Peer

    Tap = Callable[[Frame, Peer], object]

logger: logging.Logger = logging.getLogger("aerokit")

ItemT = TypeVar("ItemT", bound="Message | Event")

HEARTBEAT_PERIOD_S = 1.0


class Connection:
    """One MAVLink node (system id, component id) on one link.

    Frames come in through ``bytes_received``, are checked by one framer for each remote peer, and go to ``bus``. Who
    may speak in whose name is said in :class:`aerokit.connection.routes.Routes`; ``may_move`` is its own.
    ``send`` numbers a message and writes it to where its target was last heard. Everything runs on the loop's thread.
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
            raise InvalidArgument(f"source_system = {source_system} is not allowed: 1 to 255")
        if not 0 <= source_component <= 255:
            raise InvalidArgument(f"source_component = {source_component} is not allowed: 0 to 255")
        _check_version(mavlink_version)
        if dialect.get(Heartbeat.ID) is not Heartbeat:
            raise InvalidArgument(
                f"dialect {dialect.name!r} has no HEARTBEAT: pass Dialect.extended_by of the standard one"
            )
        self.link = link
        self.bus: Bus = Bus(dialect)
        self.source_system: int = source_system
        self.source_component: int = source_component
        self.attached: set[int] = set()
        """System ids that have a vehicle object on this connection."""
        self.boot_clocks: dict[tuple[int, int], Callable[[float], float | None]] = {}
        """Of some (system id, component id): its time since boot in milliseconds, by our time; None while unknown."""
        self.link_state: StateCell[LinkState] = StateCell("link_state", self.now, "frame")
        """Whether frames come at all, from whomever; ``vehicle.link_state`` is about one vehicle."""
        self.deadlines: Deadlines = Deadlines()
        """What has to happen at a time, as long as the connection is open."""
        self._clock = asyncio.get_running_loop().time
        self._wall_at_0 = time.time() - self._clock()
        self._encoder = FrameEncoder(source_system, source_component, version=mavlink_version)
        self._gate = SignatureGate(self._encoder, self.unix_time, self.bus.publish)
        self.signing = signing
        make_routes = partial(
            Routes, link, self.bus.publish, self.attached, self.boot_clocks, may_move=may_move
        )
        self._several = self._make_several(make_routes) if link.is_several else None
        self._routes: Routes | SeveralRoutes = self._several or make_routes()
        self._intake = Intake(link, self.bus, self._routes, self._several, self._gate, self._clock)
        self._taps = self._intake.taps
        self.heard: dict[tuple[int, int], Heartbeat] = self._intake.heard
        """The last HEARTBEAT of every (system id, component id) on the link."""
        self.keeps_peers = True
        self._background = Background(self.fail)
        self._is_on_link = True
        self._state_watch = LinkStateWatch(self.link_state, self.bus, system_id=0)
        self._ending = Ending()
        self._heartbeat = (
            None if heartbeat is None else HeartbeatSwitch(heartbeat, self._clock, self.bus.publish)
        )

    def _make_several(self, make_routes: Callable[[], Routes]) -> SeveralRoutes:
        from aerokit.connection.multilink.routes import SeveralRoutes
        from aerokit.transport.several import SeveralLinks  # few programs have several

        assert isinstance(self.link, SeveralLinks)
        return SeveralRoutes(
            self.link,
            make_routes,
            self.bus,
            we=(self.source_system, self.source_component),
            attached=self.attached,
            send=self._send_to_peer,
            now=self.now,
        )

    # ------------------------------------------------------------------------------- sending

    @checked
    def send(self, message: Message, *, to: int | None = None) -> None:
        """Number, frame and write a message; never blocks.

        It goes to where its ``target_component`` of the system ``to`` (None: its ``target_system``) was last heard;
        to every peer with components of that system when it names none of them; and to every peer when it is for all
        or for one that was never heard.

        Raises:
            InvalidArgument: a field is out of range; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        self.raise_if_ended()
        now = 0.0 if self._encoder.signing is None else self.unix_time()
        data = self._encoder.encode(message, now)
        self._write(data, message, to)
        self._taps.give_sent(data)

    @checked
    def write_raw(self, data: bytes) -> None:
        """Write one whole frame of somebody else as it is, for programs that forward; never blocks.

        It goes where :meth:`send` would send its message: where its target was last heard, or to every peer. Its
        signature, or that it has none, stays as it is.

        Raises:
            InvalidArgument: this is not exactly one MAVLink frame; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        self.raise_if_ended()
        if not is_whole_frame(data):
            raise InvalidArgument(
                f"{len(data)} bytes beginning with {bytes(data[:3]).hex()!r} are not one frame"
            )
        frame = Frame.parse(bytes(data))
        known = self.bus.dialect.get(frame.message_id)
        self._write(frame.raw, None if known is None else self.bus.dialect.decode(frame), None)

    def feed(self) -> None:
        """Show that the program runs: our heartbeat is sent for another ``fed_within_s`` seconds (`OwnHeartbeat`).

        Any thread may call it.
        """
        if self._heartbeat is not None:
            self._heartbeat.proof.feed()

    def _prove_life_by(self, proof: ProofOfLife) -> None:
        """The program calls from other threads than the loop's, which goes on when it hangs."""
        if self._heartbeat is not None:
            self._heartbeat.require(proof, BLOCKING_FED_WITHIN_S)

    @property
    def links(self) -> StateCell[tuple[LinkStatus, ...]] | None:
        """How each of several links does; None where there is one link only. Told once a second, and at each change."""
        return None if self._several is None else self._several.status

    @property
    def unsent_bytes(self) -> int:
        """Bytes that were sent and have not left this machine, as far as the link can tell: they may still arrive.

        Above 0 for longer than a moment when a link does not drain (TCP without a network, a serial port that is held
        up): :class:`LinkStalled`. 0 for UDP.
        """
        return self.link.unsent_bytes

    def discard_unsent(self) -> None:
        """Take back what was sent and has not left, as far as that is possible: an order that is not wanted any more.

        All that waits goes, whoever it is for. What the system has of a TCP connection stays in :attr:`unsent_bytes`.
        """
        self.link.discard_unsent()

    @property
    def mavlink_version(self) -> int:
        """Of what we send, 1 or 2. MAVLink 1 has no message ids above 255 and no extension fields.

        May be set while the connection is open, to what the vehicle speaks; InvalidArgument for another number.
        """
        return self._encoder.version

    @mavlink_version.setter
    def mavlink_version(self, version: int) -> None:
        _check_version(version)
        check_signing(self.signing, version)
        self._encoder.version = version

    @property
    def signing(self) -> Signing | None:
        """What signs the frames that we send and checks those that we receive; None: neither.

        It has the time stamp to keep (``signing.timestamp``) and counts refused frames (``signing.refused``). May be
        set while the connection is open; InvalidArgument while we send MAVLink 1, which has no signatures.
        """
        return self._encoder.signing

    @signing.setter
    def signing(self, signing: Signing | None) -> None:
        self._gate.use(signing)

    @checked
    def subscribe(
        self,
        *types: type[ItemT],
        system_id: int = 0,
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
    ) -> Subscription[ItemT]:
        """Return a stream of these messages or events, of one system (or of all: 0), for use in a ``with`` block.

        Raises:
            InvalidArgument: no type, or a type that the dialect does not hold.
        """
        self.check_types(types)

        def attach(sink: Sink) -> list[Detach]:
            return [self.on_end(subscription.close), *self.attach(types, sink, system_id=system_id)]

        subscription: Subscription[ItemT] = Subscription(attach, capacity=capacity, overflow=overflow)
        return subscription

    async def vehicles(self) -> AsyncGenerator[VehicleFound, None]:
        """Each autopilot once: those that were heard already, then those that will be, until the connection ends.

        ``async for found in connection.vehicles(): async with aerokit.connect(connection, system_id=found.system_id)…``

        Raises:
            ConnectionClosed, LinkLost: the connection ended.
        """
        self.raise_if_ended()
        with self.subscribe(VehicleFound, capacity=MOST_ROUTES) as news:
            known = [found_by(heartbeat, self.now(), *source) for source, heartbeat in self.heard.items()]
            for found in known:
                if isinstance(found, VehicleFound):
                    yield found
            async for each in news:
                yield each

    def attach(self, types: Sequence[type[Any]], sink: Sink, *, system_id: int = 0) -> list[Detach]:
        """Have these messages and events, of one system or of all (0), delivered to ``sink``."""
        return [self._attach(item, sink, system_id) for item in types]

    def tap(self, sink: Tap) -> Detach:
        """Have every frame that is received given to ``sink(frame, peer)``, after those who subscribed to its message.

        Frames of messages that the dialect does not know come too, their checksums unchecked; what a second peer says
        in the name of a component of the first (:class:`HeardTwice`) does not. ``sink`` must be quick and must not
        await; what it raises is logged. While nobody taps, frames that nobody subscribed to are not even made.
        """
        return self._taps.add(sink)

    def tap_sent(self, sink: Callable[[bytes], object]) -> Detach:
        """Have every frame of our own that is sent given to ``sink(raw)``, signed if we sign; not those of `write_raw`.

        ``sink`` must be quick and must not await; what it raises is logged.
        """
        return self._taps.add_sent(sink)

    def check_types(self, types: tuple[type[Any], ...]) -> None:
        """Raise InvalidArgument unless each of these can be subscribed to."""
        if not types:
            raise InvalidArgument("name at least one message or event class to subscribe to")
        for item in types:
            if not isinstance(item, type) or not issubclass(item, (Message, Event)):
                raise InvalidArgument(f"{item!r} is neither a message class nor an event class")
            if issubclass(item, Message) and self.bus.dialect.get(item.ID) is None:
                raise InvalidArgument(f"{item.NAME} is not in this connection's dialect")

    def on_end(self, ender: Callable[[Exception], None]) -> Detach:
        """Have ``ender(error)`` called when the connection ends; at once if it has ended already."""
        return self._ending.on_end(ender)

    # ---------------------------------------------------------------------------------- state

    @property
    def is_open(self) -> bool:
        """Whether messages can still be sent and received."""
        return self._ending.error is None

    def raise_if_ended(self) -> None:
        """Raise what ended the connection (ConnectionClosed, LinkLost), if it has ended."""
        self._ending.raise_if_ended()

    def heard_at(self, system_id: int, component_id: int) -> float:
        """When the last HEARTBEAT of a component came, on :meth:`now`'s clock; −inf: none has."""
        heartbeat = self.heard.get((system_id, component_id))
        frame = None if heartbeat is None else heartbeat.received_frame
        return -math.inf if frame is None else frame.received_at

    def now(self) -> float:
        """Seconds on the event loop's clock, the one that all ages and deadlines are measured on."""
        return self._clock()

    @checked
    def new_cell(self, name: str, waits_for: str) -> StateCell[Any]:
        """Make a cell whose values are as old as the messages they came in; see :class:`StateCell`."""
        return StateCell(name, self.now, waits_for, stamp=self.arrived_at)

    def arrived_at(self) -> float:
        """When the message that is delivered now arrived, on the clock of :meth:`now`; the time stamp of cells.

        That is earlier than now if the event loop was kept from reading: the message may have waited in the socket.
        """
        return self._intake.arrived_at()

    def unix_time(self) -> float:
        """Seconds since 1970, as the system had them at the beginning, gone on by :meth:`now`: nobody sets it back."""
        return self._wall_at_0 + self._clock()

    def describe_signatures(self, system_id: int = 0, component_id: int = 0) -> str:
        """What signatures keep from us, or us from this component (0: all), for error texts; empty when nothing."""
        return self._gate.describe(
            heartbeat
            for (system, component), heartbeat in self.heard.items()
            if system == system_id and component_id in (0, component)
        )

    def statistics(self) -> Iterator[FramerStatistics]:
        """The counters of every peer that is remembered."""
        return self._intake.statistics()

    def counts(self, system_id: int) -> tuple[int, int]:
        """Frames of this system that were received, and frames that its sequence numbers say were lost."""
        return self._intake.counts(system_id)

    def close(self, error: Exception | None = None) -> None:
        """End it: what waits gets ``error``, the link closes, our tasks are cancelled. Never blocks; idempotent.

        Inside the connection's block as well: the block goes on, and whatever it asks of the connection raises.
        """
        self._end(error or ConnectionClosed("the connection was closed"))
        if self._is_on_link:
            self.link.close()
        self._taps.close()

    def fail(self, error: Exception) -> None:
        """Close it because of a mistake inside aerokit: whoever waits is told, and it never surfaces elsewhere."""
        if not self.is_open and isinstance(error, AerokitError):
            return  # a task of ours was told of the end
        logger.error("a mistake inside aerokit closes the connection", exc_info=error)
        closed = ConnectionClosed(f"a mistake inside aerokit closed the connection: {error!r}")
        closed.__cause__ = error
        self.close(closed)

    def record(self, path: str | os.PathLike[str]) -> None:
        """Write everything sent and received from now on to a ``.tlog`` file, until the connection is closed.

        Raises:
            LinkOpenError: the file cannot be written.
            BusyError: a recording is under way.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        self.raise_if_ended()
        self._taps.record(path, self._clock())

    # -------------------------------------------------------------------- what the link calls

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Take bytes off the link (called by the link); never raises."""
        try:
            self._intake.receive(data, peer)
        except Exception as error:
            self.fail(error)

    def link_interrupted(self, error: LinkLost) -> None:
        """The link has gone and is being opened again (called by the link)."""
        self._state_watch.lost(self._clock())
        self.bus.publish(LinkInterrupted(self._clock(), 0, error))

    def link_restored(self, away_s: float) -> None:
        """The link is back (called by the link)."""
        self._intake.begin_anew()
        self._state_watch.heard(self._clock())
        self.bus.publish(LinkRestored(self._clock(), 0, away_s))

    def link_stalled(self, unsent_bytes: int) -> None:
        """What is written does not leave (called by the link)."""
        self.bus.publish(LinkStalled(self._clock(), 0, unsent_bytes))

    def link_drained(self, stalled_s: float) -> None:
        """It does again (called by the link)."""
        self.bus.publish(LinkDrained(self._clock(), 0, stalled_s))

    def one_link_changed(self, link: int, is_there: bool) -> None:
        """One of several links has gone or is there again (called by the link)."""
        if self._several is not None:
            self._several.link_changed(link, is_there)

    def one_link_stalled(self, link: int, is_stalled: bool) -> None:
        """What is written to one of several links does not leave, or does again (called by the link)."""
        if self._several is not None:
            self._several.link_stalled(link, is_stalled)

    def one_link_not_opened(self, link: int, error: LinkOpenError) -> None:
        """One of several links could not be opened, and is tried again (called by the link)."""
        if self._several is not None:
            self._several.link_not_opened(link, error)

    def order_refused(self, message: str, reason: str, helm: str | None, answers: tuple[bytes, ...]) -> None:
        """The other side of a network let no order of ours through (called by the link)."""
        self.bus.publish(OrderRefused(self._clock(), 0, message, reason, helm))
        for answer in answers:  # past the framers: they are nobody's of those that they count
            self.bus.deliver(Frame.parse(answer, self._clock()))

    def link_lost(self, error: LinkLost) -> None:
        """The link has gone (called by the link): whatever waits ends with this error."""
        self._end(error)

    # ------------------------------------------------------------------------------- inside

    async def _open_link(self) -> None:
        """Open the link; one that is open already is somebody else's, and stays as it is."""
        try:
            await self.link.open(self)
        except BusyError:
            self._is_on_link = False
            raise

    async def _wait_until_link_is_closed(self) -> None:
        if self._is_on_link:
            await self.link.wait_closed()

    def _start(self) -> None:
        self._state_watch.heard(self._clock())
        self._intake.start()
        self._background.start(self._send_heartbeats, "aerokit heartbeat")
        if self._several is not None:
            self._background.start(self._several.watch, "aerokit links")

    async def _send_heartbeats(self) -> None:
        while self.is_open:
            if self._heartbeat is not None and self._heartbeat.is_on():
                self.send(self._heartbeat.message)
            self._gate.tell_keeping()
            self._state_watch.count(self._clock(), sum(each.frames for each in self.statistics()))
            self._taps.flush()
            await anyio.sleep(HEARTBEAT_PERIOD_S)

    def _end(self, error: Exception) -> None:
        if not self.is_open:
            return
        self._ending.error = error
        self._intake.close()
        self._state_watch.lost(self._clock(), is_told=isinstance(error, LinkLost))
        self.link_state.close(error)
        if self._several is not None:
            self._several.status.close(error)
        if isinstance(error, LinkLost):
            self.bus.publish(LinkClosed(self._clock(), 0, error))
        self._ending.tell(error)
        self.deadlines.close()
        self._background.cancel()

    def _write(self, data: bytes, message: Message | None, to: int | None) -> None:
        system_id = getattr(message, "target_system", 0) if to is None else to
        for peer in self._routes.peers_of(system_id, getattr(message, "target_component", 0), message):
            self.link.write(data, peer)
        self._taps.keep_sent(data, self._clock())

    def _send_to_peer(self, message: Message, peer: Peer) -> None:
        """Number, frame and write a message to one peer, whoever is behind it; for what is asked over each link."""
        now = 0.0 if self._encoder.signing is None else self.unix_time()
        data = self._encoder.encode(message, now)
        self.link.write(data, peer)
        self._taps.keep_sent(data, self._clock())

    def _attach(self, item: type[Any], sink: Sink, system_id: int) -> Detach:
        if issubclass(item, Message):
            return self.bus.attach(item, sink, system_id=system_id)
        return self.bus.attach_event(item, _only(system_id, sink) if system_id else sink)


def _only(system_id: int, sink: Sink) -> Sink:
    """Let events of this system through, and those of the link as a whole."""

    def filtered(event: Event) -> None:
        if event.system_id in (0, system_id):
            sink(event)

    return filtered


def _check_version(version: int) -> None:
    if version not in (1, 2):
        raise InvalidArgument(f"mavlink_version = {version} is not allowed: 1 or 2")
