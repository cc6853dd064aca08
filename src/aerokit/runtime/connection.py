"""``Connection``: we, as one MAVLink node on one link, with our heartbeat, our bus and our routes."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit.errors import AerokitError, ConnectionClosed, LinkLost, LocalProtocolError
from aerokit.links import create_link
from aerokit.links.link import Link
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Heartbeat
from aerokit.mavlink.tlog import TlogWriter
from aerokit.runtime.bus import Bus
from aerokit.runtime.events import Event, LinkClosed
from aerokit.runtime.loop_watch import watch_loop
from aerokit.runtime.subscription import Overflow, Subscription

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence

    from anyio.abc import TaskGroup

    from aerokit.links.link import Peer
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.statistics import FramerStatistics
    from aerokit.runtime.bus import Detach, Sink

__all__ = ["Connection", "open_connection"]

logger = logging.getLogger("aerokit")

ItemT = TypeVar("ItemT", bound="Message | Event")

MAV_TYPE_GCS = 6
MAV_AUTOPILOT_INVALID = 8
MAV_STATE_ACTIVE = 4
MAV_COMP_ID_MISSIONPLANNER = 190
HEARTBEAT_PERIOD_S = 1.0
CLOSE_TIMEOUT_S = 2.0
MOST_PEERS = 256


@asynccontextmanager
async def open_connection(
    address: str | Link,
    *,
    source_system: int = 255,
    source_component: int = MAV_COMP_ID_MISSIONPLANNER,
    baud: int = 57600,
    dialect: Dialect = STANDARD,
    mavlink_version: int = 2,
    record: str | os.PathLike[str] | None = None,
) -> AsyncIterator[Connection]:
    """Open a link and be a MAVLink node on it for the time of the ``async with`` block.

    Runs in the asyncio loop that is already running, in one task group; nothing outlives the block. Our HEARTBEAT
    goes out at 1 Hz from the start (https://mavlink.io/en/services/heartbeat.html).

    Args:
        address: a connection string (``"udpin:0.0.0.0:14550"``, ``"/dev/ttyACM0,57600"``, …) or a link not yet open.
        source_system: our own system id, 1–255; ground stations take 255.
        source_component: our own component id, 1–255.
        baud: of a serial link whose address names none.
        dialect: the messages that are understood.
        mavlink_version: of what we send, 1 or 2; both are understood.
        record: a ``.tlog`` file for everything received and sent; an existing file is appended to.

    Raises:
        LocalProtocolError: an argument is wrong; nothing was opened.
        LinkOpenError: the link could not be opened.
    """
    link = create_link(address, baud=baud) if isinstance(address, str) else address
    connection = Connection(
        link,
        source_system=source_system,
        source_component=source_component,
        dialect=dialect,
        mavlink_version=mavlink_version,
        recorder=None if record is None else TlogWriter(record),
    )
    failure: BaseException | None = None
    try:
        await link.open(connection)
        async with anyio.create_task_group() as tasks:
            connection._start(tasks)
            try:
                yield connection
            except asyncio.CancelledError:
                raise
            except BaseException as error:
                failure = error  # raised below: a task group would wrap it in an exception group
            finally:
                connection.close()
    finally:
        connection.close()
        with anyio.CancelScope(shield=True), anyio.move_on_after(CLOSE_TIMEOUT_S):
            await link.wait_closed()
    if failure is not None:
        raise failure


class Connection:
    """One MAVLink node (system id, component id) on one link.

    Frames come in through ``bytes_received``, are checked by one framer for each remote peer, and go to ``bus``.
    ``send`` numbers a message and writes it to where its target was last heard. Everything runs on the loop's thread.
    """

    def __init__(
        self,
        link: Link,
        *,
        source_system: int = 255,
        source_component: int = MAV_COMP_ID_MISSIONPLANNER,
        dialect: Dialect = STANDARD,
        mavlink_version: int = 2,
        recorder: TlogWriter | None = None,
    ) -> None:
        for field, value in (("source_system", source_system), ("source_component", source_component)):
            if not 1 <= value <= 255:
                raise LocalProtocolError(f"{field} = {value} is not allowed: 1 to 255")
        if mavlink_version not in (1, 2):
            raise LocalProtocolError(f"mavlink_version = {mavlink_version} is not allowed: 1 or 2")
        self.link = link
        self.bus = Bus(dialect)
        self.source_system, self.source_component = source_system, source_component
        self.heard: dict[tuple[int, int], Heartbeat] = {}
        """The last HEARTBEAT of every (system id, component id) on the link."""
        self.attached: set[int] = set()
        """System ids that have a vehicle object on this connection."""
        self._clock = asyncio.get_running_loop().time
        self._encoder = FrameEncoder(source_system, source_component, version=mavlink_version)
        self._framers: dict[Peer, Framer] = {}
        self._routes: dict[int, Peer] = {}
        self._recorder = recorder
        self._enders: list[Callable[[Exception], None]] = []
        self._tasks: TaskGroup | None = None
        self._error: Exception | None = None
        self.bus.attach(Heartbeat, _ignore)  # routes and diagnosis need every heartbeat

    # ------------------------------------------------------------------------------- sending

    def send(self, message: Message, *, to: int | None = None) -> None:
        """Number, frame and write a message; never blocks.

        It goes to where the system ``to`` (None: the one in its ``target_system``) was last heard, and to every peer
        when there is none.

        Raises:
            LocalProtocolError: a field is out of range; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        self.raise_if_ended()
        data = self._encoder.encode(message)
        target = getattr(message, "target_system", 0) if to is None else to
        self.link.write(data, self._routes.get(target))
        if self._recorder is not None:
            self._recorder.write(data, time.time())

    def subscribe(
        self,
        *types: type[ItemT],
        system_id: int = 0,
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
    ) -> Subscription[ItemT]:
        """Return a stream of these messages or events, of one system (or of all: 0), for use in a ``with`` block.

        Raises:
            LocalProtocolError: no type, or a type that the dialect does not hold.
        """
        self.check_types(types)

        def attach(sink: Sink) -> list[Detach]:
            return [self.on_end(subscription.close), *self.attach(types, sink, system_id=system_id)]

        subscription: Subscription[ItemT] = Subscription(attach, capacity=capacity, overflow=overflow)
        return subscription

    def attach(self, types: Sequence[type[Any]], sink: Sink, *, system_id: int = 0) -> list[Detach]:
        """Have these messages and events, of one system or of all (0), delivered to ``sink``."""
        return [self._attach(item, sink, system_id) for item in types]

    def check_types(self, types: tuple[type[Any], ...]) -> None:
        """Raise LocalProtocolError unless each of these can be subscribed to."""
        if not types:
            raise LocalProtocolError("name at least one message or event class to subscribe to")
        for item in types:
            if not isinstance(item, type) or not issubclass(item, (Message, Event)):
                raise LocalProtocolError(f"{item!r} is neither a message class nor an event class")
            if issubclass(item, Message) and self.bus.dialect.get(item.ID) is None:
                raise LocalProtocolError(f"{item.NAME} is not in this connection's dialect")

    def on_end(self, ender: Callable[[Exception], None]) -> Detach:
        """Have ``ender(error)`` called when the connection ends; at once if it has ended already."""
        if self._error is not None:
            ender(self._error)
            return _nothing
        self._enders.append(ender)

        def detach() -> None:
            if ender in self._enders:
                self._enders.remove(ender)

        return detach

    # ---------------------------------------------------------------------------------- state

    @property
    def is_open(self) -> bool:
        """Whether messages can still be sent and received."""
        return self._error is None

    def raise_if_ended(self) -> None:
        """Raise what ended the connection (ConnectionClosed, LinkLost), if it has ended."""
        if self._error is not None:
            raise self._error

    def now(self) -> float:
        """Seconds on the event loop's clock, the one that all ages and deadlines are measured on."""
        return self._clock()

    def statistics(self) -> Iterator[FramerStatistics]:
        """The counters of every peer heard so far."""
        return (framer.statistics for framer in self._framers.values())

    def counts(self, system_id: int) -> tuple[int, int]:
        """Frames of this system that were received, and frames that its sequence numbers say were lost."""
        sources = [
            source
            for statistics in self.statistics()
            for source in statistics.sources.values()
            if source.system_id == system_id
        ]
        return sum(source.received for source in sources), sum(source.lost for source in sources)

    def close(self, error: Exception | None = None) -> None:
        """End it: what waits gets ``error``, the link closes, tasks are cancelled. Never blocks; idempotent."""
        self._end(error or ConnectionClosed("the connection was closed"))
        self.link.close()
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None
        if self._tasks is not None:
            self._tasks.cancel_scope.cancel()

    # -------------------------------------------------------------------- what the link calls

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Take bytes off the link (called by the link)."""
        framer = self._framers.get(peer)
        if framer is None:
            framer = self._new_framer(peer)
        for frame in framer.receive(data, self._clock()):
            if frame.message_id == Heartbeat.ID:
                self._note_heartbeat(frame, peer)
            if self._recorder is not None:
                self._recorder.write(frame.raw, time.time())
            self.bus.deliver(frame)

    def link_lost(self, error: LinkLost) -> None:
        """The link has gone (called by the link): whatever waits ends with this error."""
        if self._error is None:
            self._end(error)
            self.bus.publish(LinkClosed(self._clock(), 0, error))

    # ------------------------------------------------------------------------------- inside

    def _start(self, tasks: TaskGroup) -> None:
        self._tasks = tasks
        tasks.start_soon(self.guarded, self._send_heartbeats, name="aerokit heartbeat")
        tasks.start_soon(self.guarded, self._watch_loop, name="aerokit loop watch")

    async def guarded(self, function: Callable[[], Awaitable[None]]) -> None:
        """Run a background task of ours: a mistake in it ends the connection, and never surfaces as a group."""
        try:
            await function()
        except AerokitError as error:
            if self.is_open:
                self._end(error)
        except Exception as error:
            logger.exception("a background task of aerokit failed")
            closed = ConnectionClosed(f"a background task of aerokit failed: {error!r}")
            closed.__cause__ = error
            self._end(closed)

    async def _watch_loop(self) -> None:
        await watch_loop(self)

    async def _send_heartbeats(self) -> None:
        heartbeat = Heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID, 0, 0, MAV_STATE_ACTIVE, 3)
        while self.is_open:
            self.send(heartbeat)
            await anyio.sleep(HEARTBEAT_PERIOD_S)

    def _end(self, error: Exception) -> None:
        if self._error is not None:
            return
        self._error = error
        enders, self._enders = self._enders, []
        for ender in enders:
            ender(error)

    def _attach(self, item: type[Any], sink: Sink, system_id: int) -> Detach:
        if issubclass(item, Message):
            return self.bus.attach(item, sink, system_id=system_id)
        return self.bus.attach_event(item, _only(system_id, sink) if system_id else sink)

    def _new_framer(self, peer: Peer) -> Framer:
        while len(self._framers) >= MOST_PEERS:
            self._framers.pop(next(iter(self._framers)))
        framer = self._framers[peer] = Framer(self.bus.dialect)
        framer.wanted = None if self._recorder is not None else self.bus.wanted
        return framer

    def _note_heartbeat(self, frame: Frame, peer: Peer) -> None:
        heartbeat = self.bus.dialect.decode(frame)
        if frame.system_id != 0 and isinstance(heartbeat, Heartbeat):
            self.heard[frame.system_id, frame.component_id] = heartbeat
            self._routes[frame.system_id] = peer


def _only(system_id: int, sink: Sink) -> Sink:
    """Let events of this system through, and those of the link as a whole."""

    def filtered(event: Event) -> None:
        if event.system_id in (0, system_id):
            sink(event)

    return filtered


def _ignore(message: object) -> None:
    pass


def _nothing() -> None:
    pass
