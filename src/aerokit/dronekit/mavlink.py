"""``dronekit.mavlink``: the connection underneath a vehicle, as far as DroneKit programs touch it."""

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

from aerokit.connection.opening import open_connection
from aerokit.connection.own_heartbeat import OwnHeartbeat
from aerokit.dronekit.exceptions import APIException
from aerokit.dronekit.line import Line, OverrideRelease
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
    from aerokit.sync.loop_thread import Held
    from aerokit.transport.link import Peer

__all__ = ["APIException", "MAVConnection", "MAVWriter", "mavudpin_multi"]

logger: logging.Logger = logging.getLogger("dronekit.mavlink")

FunctionT = TypeVar("FunctionT", bound=Callable[..., object])

TICK_S = 0.05
ATTEMPTS, BETWEEN_ATTEMPTS_S = 3, 1.0


class MAVConnection(Line):
    """A link, open until it is closed, with an event loop on a thread of its own.

    ``ip`` is any connection string of DroneKit and pymavlink (a bare ``host:port`` and ``udp:`` listen), or of aerokit.
    A link that is lost is opened again. ``use_native`` is accepted and means nothing.

    Raises:
        OSError: the link cannot be opened; ConnectionRefusedError, socket.gaierror, serial.SerialException as the
            system says.
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
        loop, overrides = LoopThread(), OverrideRelease()
        held = _open(loop, ip, baud, source_system, source_component, overrides, heartbeat)
        super().__init__(ip, loop, held, target_system, overrides)
        self.loop_listeners: list[Callable[[MAVConnection], object]] = []
        """Functions that are called about 20 times a second; see :meth:`forward_loop`."""
        self.message_listeners: list[Callable[[MAVConnection, Any], object]] = []
        """Functions that get every message; see :meth:`forward_message`."""
        made = _made.get()
        if made is not None:
            made.add(self)

    def fix_targets(self, message: Any) -> None:
        """Write the vehicle's system id into ``message.target_system``, if the message has such a field."""
        if hasattr(message, "target_system"):
            message.target_system = self.target_system

    @cached_property
    def master(self) -> Master:
        """What DroneKit programs use of pymavlink's connection object."""
        from aerokit.dronekit.master import Master

        return Master(self)

    # ----------------------------------------------------------------------------- receiving

    def forward_message(self, fn: FunctionT) -> FunctionT:
        """Have ``fn(connection, message)`` called on the listener thread for every message, pymavlink's. Decorator."""
        self.message_listeners.append(fn)
        if len(self.message_listeners) == 1:
            self.loop.call_soon(self.connection.tap, self._forward)
        return fn

    def forward_loop(self, fn: FunctionT) -> FunctionT:
        """Have ``fn(connection)`` called on the listener thread about 20 times a second. Decorator."""
        self.loop_listeners.append(fn)
        if len(self.loop_listeners) == 1:
            self.loop.call_soon(self._tick)
        return fn

    def pipe(self, target: MAVConnection) -> MAVConnection:
        """Pass everything on that comes here to ``target``, and the other way round; returns ``target``."""
        target.target_system = self.target_system
        self.loop.call_soon(self.connection.tap, lambda frame, peer: target.pass_on(frame))
        target.loop.call_soon(target.connection.tap, lambda frame, peer: self.pass_on(frame))
        return target

    # ---------------------------------------------------------------------------- life cycle

    def start(self) -> None:
        """Nothing is left to do: reception and heartbeat run since the connection was made."""
        self.connection.raise_if_ended()

    def reset(self) -> None:
        """Close the link and open it again."""
        link = self.connection.link
        if isinstance(link, ReconnectingLink):
            self.loop.call_soon(link.reopen)

    def stop_threads(self) -> None:
        """As :meth:`close`."""
        self.close()

    @property
    def _alive(self) -> bool:
        return self.connection.is_open

    @property
    def _accept_input(self) -> bool:
        return self._alive and "bytes_received" not in vars(self.connection)

    @_accept_input.setter
    def _accept_input(self, value: bool) -> None:
        """False: as if nothing came, which is how programs try what they do then. What comes meanwhile is lost."""
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
        """Always empty: what is sent does not wait."""
        return queue.Queue()

    def _forward(self, frame: Frame, peer: Peer) -> None:
        self.listener_thread.offer(self._deliver, frame)

    def _deliver(self, frame: Frame) -> None:
        self._call(self.message_listeners, message_of(frame))

    def _tick(self) -> None:
        if self.connection.is_open:
            self.listener_thread.offer(self._call, self.loop_listeners)
            asyncio.get_running_loop().call_later(TICK_S, self._tick)

    def _call(self, listeners: list[Callable[..., object]], *args: Any) -> None:
        for listener in tuple(listeners):
            try:
                listener(self, *args)
            except BaseException:
                logger.exception("Exception in a listener of the connection")

    def pass_on(self, frame: Frame) -> None:
        """Write a frame as it is; from any thread, silent when the connection is closed."""
        with contextlib.suppress(ConnectionClosed):
            self.loop.call_soon(self._write_raw, frame)

    def _write_raw(self, frame: Frame) -> None:
        with contextlib.suppress(AerokitError):
            self.connection.write_raw(frame.raw)


_made: ContextVar[weakref.WeakSet[MAVConnection] | None] = ContextVar("connections_made", default=None)


@contextlib.contextmanager
def connections_made() -> Iterator[weakref.WeakSet[MAVConnection]]:
    """Collect the connections that this thread makes in the block, without keeping those that are dropped."""
    connections: weakref.WeakSet[MAVConnection] = weakref.WeakSet()
    token = _made.set(connections)
    try:
        yield connections
    finally:
        _made.reset(token)


def _open(
    loop: LoopThread,
    ip: str,
    baud: int,
    source_system: int,
    source_component: int,
    overrides: OverrideRelease,
    heartbeat: OwnHeartbeat | None,
) -> Held[Connection]:
    """Open it; what refuses at first may be a simulator that the program has just started."""
    ids: dict[str, Any] = {"source_system": source_system, "source_component": source_component}
    try:
        _check_address(ip)
        for attempt in range(ATTEMPTS):
            try:
                opened = open_connection(ip, baud=baud, reconnect=True, heartbeat=heartbeat, **ids)
                held = loop.hold_open(_releasing(opened, overrides))
                held.value._prove_life_by(loop.proof)
                return held
            except LinkOpenError as error:
                if attempt == ATTEMPTS - 1 or not isinstance(error.__context__, ConnectionRefusedError):
                    _raise_classic(error)
                time.sleep(BETWEEN_ATTEMPTS_S)
        raise AssertionError
    except BaseException:
        loop.close()
        raise


@contextlib.asynccontextmanager
async def _releasing(
    opened: contextlib.AbstractAsyncContextManager[Connection], overrides: OverrideRelease
) -> AsyncIterator[Connection]:
    """However the connection ends, the last that is sent gives the RC channels back."""
    async with opened as connection:
        try:
            yield connection
        finally:
            overrides.send(connection)


def _check_address(ip: object) -> None:
    if not isinstance(ip, str):
        raise InvalidArgument(f"ip = {ip!r} is no connection string; accepted are\n{ACCEPTED_FORMS}")
    try:
        parse_address(ip)
    except InvalidArgument as error:
        from aerokit.transport.address_error import AddressError

        raise AddressError(str(error)) from None


def _raise_classic(error: LinkOpenError) -> NoReturn:
    """As what the system called it: programs catch ConnectionRefusedError, socket.gaierror, SerialException."""
    cause = error.__context__
    if isinstance(cause, OSError):
        if cause.errno is not None:
            raise type(cause)(cause.errno, str(error)) from error
        raise type(cause)(str(error)) from error
    if isinstance(cause, ValueError):  # pyserial: no such baud rate
        raise ValueError(str(error)) from error
    raise error


def mavudpin_multi(device: str, baud: int | None = None, **_: Any) -> MAVConnection:
    """Listen for UDP and answer everybody heard: any connection that listens does."""
    return MAVConnection(f"udpin:{device}")


class MAVWriter:
    """A file-like object whose ``write`` puts bytes into a queue, as programs that build their own MAVLink use it."""

    def __init__(self, queue: queue.Queue[bytes]) -> None:
        self.queue = queue

    def write(self, pkt: bytes) -> None:
        """Put them there."""
        self.queue.put(pkt)

    def read(self) -> NoReturn:
        """Nothing can be read: always RuntimeError."""
        raise RuntimeError("a MAVWriter is for writing")
