"""``dronekit.mavlink``: the connection of a vehicle, as DroneKit programs use it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import queue
import time
import weakref
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from functools import cached_property
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from aerokit.connection.heartbeats import OwnHeartbeat
from aerokit.connection.opening import open_connection
from aerokit.dronekit.classic_connection import ClassicConnection, OverrideRelease
from aerokit.dronekit.exceptions import APIException
from aerokit.dronekit.observers import message_of
from aerokit.errors import AerokitError, ConnectionClosed, InvalidArgument, LinkOpenError
from aerokit.sync.loop_thread import LoopThread
from aerokit.transport.address import ACCEPTED_FORMS, parse_address
from aerokit.transport.reconnecting import ReconnectingLink

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aerokit.connection.connection import Connection
    from aerokit.dronekit.master import Master
    from aerokit.mavlink.frame import Frame
    from aerokit.sync.loop_thread import OpenContext
    from aerokit.transport.link import Peer

__all__ = ["APIException", "MAVConnection", "MAVWriter", "mavudpin_multi"]

logger: logging.Logger = logging.getLogger("dronekit.mavlink")

FunctionT = TypeVar("FunctionT", bound=Callable[..., object])

TICK_INTERVAL_S = 0.05
MAX_OPEN_ATTEMPTS, RETRY_INTERVAL_S = 3, 1.0


class MAVConnection(ClassicConnection):
    """An open link to a vehicle, with an event loop on a separate thread.

    ``ip`` is a connection string of DroneKit, pymavlink or aerokit. As in pymavlink, a bare ``host:port`` and ``udp:``
    listen. A lost link is reopened. ``use_native`` is ignored.

    Raises:
        OSError: the link cannot be opened: ConnectionRefusedError, socket.gaierror, serial.SerialException …
        ValueError: the connection string or another argument is wrong.
    """

    def __init__(
        self,
        ip: str,
        baud: int = 115200,
        target_system: int = 0,
        source_system: int = 255,
        source_component: int = 0,
        use_native: bool = False,
        heartbeat: OwnHeartbeat | None = OwnHeartbeat(),  # noqa: B008 - it is immutable
    ) -> None:
        loop = LoopThread()
        overrides = OverrideRelease()
        context = _open(loop, ip, baud, source_system, source_component, overrides, heartbeat)
        super().__init__(ip, loop, context, target_system, overrides)
        self.loop_listeners: list[Callable[[MAVConnection], object]] = []
        """Functions called about 20 times a second; see :meth:`forward_loop`."""
        self.message_listeners: list[Callable[[MAVConnection, Any], object]] = []
        """Functions called with every message; see :meth:`forward_message`."""
        created = _created_connections.get()
        if created is not None:
            created.add(self)

    def fix_targets(self, message: Any) -> None:
        """Set ``message.target_system`` to the vehicle's system id, if the message has this field."""
        if hasattr(message, "target_system"):
            message.target_system = self.target_system

    @cached_property
    def master(self) -> Master:
        """The part of pymavlink's connection object that DroneKit programs use."""
        from aerokit.dronekit.master import Master

        return Master(self)

    # ----------------------------------------------------------------------------- receiving

    def forward_message(self, fn: FunctionT) -> FunctionT:
        """Decorator: call ``fn(connection, message)`` on the listener thread with every pymavlink message."""
        self.message_listeners.append(fn)
        if len(self.message_listeners) == 1:
            self.loop.call_soon(self.connection.observe_frames, self._forward)
        return fn

    def forward_loop(self, fn: FunctionT) -> FunctionT:
        """Decorator: call ``fn(connection)`` on the listener thread about 20 times a second."""
        self.loop_listeners.append(fn)
        if len(self.loop_listeners) == 1:
            self.loop.call_soon(self._tick)
        return fn

    def pipe(self, target: MAVConnection) -> MAVConnection:
        """Forward all messages received on this connection to ``target``, and vice versa; return ``target``.

        ``target`` gets the ``target_system`` of this connection.
        """
        target.target_system = self.target_system
        self.loop.call_soon(self.connection.observe_frames, lambda frame, peer: target.write_frame(frame))
        target.loop.call_soon(target.connection.observe_frames, lambda frame, peer: self.write_frame(frame))
        return target

    # ---------------------------------------------------------------------------- life cycle

    def start(self) -> None:
        """Do nothing, because the connection already receives. If the connection has ended, raise an error."""
        self.connection.raise_if_ended()

    def reset(self) -> None:
        """Close the link and open it again."""
        link = self.connection.link
        assert isinstance(link, ReconnectingLink)  # `_open` opens every link with reconnect=True.
        self.loop.call_soon(link.reopen)

    def stop_threads(self) -> None:
        self.close()

    @property
    def _alive(self) -> bool:
        return self.connection.is_open

    @property
    def _accept_input(self) -> bool:
        return self._alive and "bytes_received" not in vars(self.connection)

    @_accept_input.setter
    def _accept_input(self, value: bool) -> None:
        # Tests of programs set this to False to simulate a silent link. Received bytes are then discarded: an instance
        # attribute hides the method `bytes_received`, which the link calls.
        if value:
            vars(self.connection).pop("bytes_received", None)
        else:
            vars(self.connection)["bytes_received"] = lambda data, peer: None

    @property
    def _death_error(self) -> Exception | None:
        try:
            self.connection.raise_if_ended()
        except AerokitError as error:
            return error
        return None

    @property
    def out_queue(self) -> queue.Queue[bytes]:
        """A queue that is always empty, because messages are sent immediately."""
        return queue.Queue()

    def _forward(self, frame: Frame, peer: Peer) -> None:
        self.listener_thread.post_or_drop(self._deliver, frame)

    def _deliver(self, frame: Frame) -> None:
        self._call(self.message_listeners, message_of(frame))

    def _tick(self) -> None:
        if self.connection.is_open:
            self.listener_thread.post_or_drop(self._call, self.loop_listeners)
            asyncio.get_running_loop().call_later(TICK_INTERVAL_S, self._tick)

    def _call(self, listeners: list[Callable[..., object]], *args: Any) -> None:
        for listener in tuple(listeners):
            try:
                listener(self, *args)
            except BaseException:  # SystemExit would only end the listener thread.
                logger.exception("Exception in a listener of the connection")

    def write_frame(self, frame: Frame) -> None:
        """Send a frame unchanged, from any thread. Ignored after the connection is closed."""
        with contextlib.suppress(ConnectionClosed):
            self.loop.call_soon(self._write_raw, frame)

    def _write_raw(self, frame: Frame) -> None:
        with contextlib.suppress(AerokitError):
            self.connection.write_raw(frame.raw)


_created_connections: ContextVar[weakref.WeakSet[MAVConnection] | None] = ContextVar(
    "created_connections", default=None
)


@contextlib.contextmanager
def created_connections() -> Iterator[weakref.WeakSet[MAVConnection]]:
    """Collect the connections that this thread creates in the ``with`` block."""
    connections: weakref.WeakSet[MAVConnection] = weakref.WeakSet()
    token = _created_connections.set(connections)
    try:
        yield connections
    finally:
        _created_connections.reset(token)


def _open(
    loop: LoopThread,
    ip: str,
    baud: int,
    source_system: int,
    source_component: int,
    overrides: OverrideRelease,
    heartbeat: OwnHeartbeat | None,
) -> OpenContext[Connection]:
    own_ids: dict[str, Any] = {"source_system": source_system, "source_component": source_component}
    try:
        _check_address(ip)
        # A refused connection is retried, because the program may have just started a simulator.
        for attempt in range(MAX_OPEN_ATTEMPTS):
            try:
                opened = open_connection(ip, baud=baud, reconnect=True, heartbeat=heartbeat, **own_ids)
                context = loop.open_context(_with_override_release(opened, overrides))
                context.value._use_activity_monitor(loop.activity)
                return context
            except LinkOpenError as error:
                is_last_attempt = attempt == MAX_OPEN_ATTEMPTS - 1
                was_refused = isinstance(error.__context__, ConnectionRefusedError)
                if is_last_attempt or not was_refused:
                    raise _classic_error(error)  # noqa: B904 - `error` already is its cause
                time.sleep(RETRY_INTERVAL_S)
        raise AssertionError("unreachable: the last attempt returns or raises")
    except BaseException:
        loop.close()
        raise


@contextlib.asynccontextmanager
async def _with_override_release(
    opened: contextlib.AbstractAsyncContextManager[Connection], overrides: OverrideRelease
) -> AsyncIterator[Connection]:
    async with opened as connection:
        try:
            yield connection
        finally:
            # However the block ends, overridden RC channels are released before the link closes.
            overrides.send(connection)


def _check_address(ip: object) -> None:
    if not isinstance(ip, str):
        raise InvalidArgument(f"ip = {ip!r} is not a connection string; accepted forms:\n{ACCEPTED_FORMS}")
    try:
        parse_address(ip)
    except InvalidArgument as error:
        from aerokit.transport.serial import AddressError  # a subclass of the SerialException that pymavlink raises

        raise AddressError(str(error)) from None


def _classic_error(error: LinkOpenError) -> Exception:
    """Convert the error to the type of its cause, OSError or ValueError, which programs catch."""
    original = error.__context__
    classic: Exception
    if isinstance(original, OSError):
        make = type(original)
        classic = make(str(error)) if original.errno is None else make(original.errno, str(error))
    elif isinstance(original, ValueError):  # raised by pyserial for an unsupported baud rate
        classic = ValueError(str(error))
    else:
        return error
    classic.__cause__ = error
    return classic


def mavudpin_multi(device: str, baud: int | None = None, **_: Any) -> MAVConnection:
    """Listen on a UDP port, and send to every address from which data was received."""
    return MAVConnection(f"udpin:{device}")


class MAVWriter:
    """A file-like object whose ``write`` puts bytes into a queue, for programs that encode MAVLink themselves."""

    def __init__(self, queue: queue.Queue[bytes]) -> None:
        self.queue = queue

    def write(self, pkt: bytes) -> None:
        self.queue.put(pkt)

    def read(self) -> NoReturn:
        """Raise RuntimeError, because a MAVWriter can only be written to."""
        raise RuntimeError("a MAVWriter cannot be read, only written to")
