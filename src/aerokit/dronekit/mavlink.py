"""``dronekit.mavlink``: the connection underneath a vehicle, as far as DroneKit programs touch it."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import functools
import logging
import queue
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from aerokit.dronekit.exceptions import APIException
from aerokit.dronekit.listener_thread import ListenerThread
from aerokit.dronekit.mav_writer import MAVWriter
from aerokit.dronekit.orders import Orders
from aerokit.dronekit.weakly import weakly
from aerokit.errors import AerokitError, ConnectionClosed, LinkOpenError, LocalProtocolError
from aerokit.links.address import ACCEPTED_FORMS, parse_address
from aerokit.links.reconnecting import ReconnectingLink
from aerokit.runtime.components import is_autopilot
from aerokit.runtime.opening import open_connection
from aerokit.sync.loop_thread import LoopThread

if TYPE_CHECKING:
    from aerokit.dronekit.line import Steered
    from aerokit.dronekit.master import Master
    from aerokit.links.link import Peer
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.runtime.bus import Detach
    from aerokit.runtime.connection import Connection
    from aerokit.sync.loop_thread import Held

__all__ = ["MAVConnection", "MAVWriter", "mavudpin_multi"]

logger, of_vehicles = logging.getLogger("dronekit.mavlink"), logging.getLogger("dronekit")

FunctionT = TypeVar("FunctionT", bound=Callable[..., object])

ORDERS_END_S = 2.0
"""How long closing waits for what was ordered a moment before to be answered."""
TICK_S = 0.05
ATTEMPTS, BETWEEN_ATTEMPTS_S = 3, 1.0


class MAVConnection:
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
    ) -> None:
        self.target_system = target_system
        """System id of the vehicle, 0 before it was heard."""
        self.listener_thread = ListenerThread()
        """Where the callbacks of the program run."""
        self.loop = LoopThread()
        """The event loop's thread."""
        self._held = _open(self.loop, ip, baud, source_system, source_component)
        self.connection = self._held.value
        """The asynchronous connection, for code that runs on its loop."""
        self.orders = Orders(self.loop)
        """What was ordered without waiting."""
        self._is_closed = threading.Event()
        self._closing = threading.Lock()
        self._detach: list[Detach] = []
        self.knows_mavlink_2 = False
        """Whether the vehicle has said that it understands MAVLink 2, whichever version it speaks so far."""
        self._at_close: list[Callable[[], object]] = []
        self._master: Master | None = None
        self.note_sent: Callable[[Message], None] = lambda message: None
        """Is told what has been sent, on the loop's thread: what steers is a newer order."""
        self.vehicle: Steered | None = None
        """The vehicle of this connection, once there is one."""
        self.loop_listeners: list[Callable[[MAVConnection], object]] = []
        """Functions that are called about 20 times a second; see :meth:`forward_loop`."""
        self.message_listeners: list[Callable[[MAVConnection, Any], object]] = []
        """Functions that get every message; see :meth:`forward_message`."""
        self._at_exit = weakly(self.close)
        atexit.register(self._at_exit)
        self.loop.when_dropped(
            functools.partial(_let_go, ip, self._at_exit, self.listener_thread, self._at_close)
        )
        made = _made.get()
        if made is not None:
            made.add(self)

    # ------------------------------------------------------------------------------- sending

    def send(self, message: Message, *, to: int | None = None) -> None:
        """Send a message, in the order of the calls; from any thread, never blocks.

        Raises:
            LocalProtocolError: a field is out of range; nothing was sent.
            APIException: the connection is closed.
        """
        message.encode()  # so that what is wrong with it is told to who made it
        try:
            self.connection.raise_if_ended()
            self.orders.post(self._send, message, to)
        except AerokitError as error:
            raise APIException(str(error)) from error

    def _send(self, message: Message, to: int | None) -> None:
        try:
            self.connection.send(message, to=to)
            self.note_sent(message)
        except AerokitError as error:
            logger.warning("%s was not sent: %s", message.NAME, error)

    def fix_targets(self, message: Any) -> None:
        """Write the vehicle's system id into ``message.target_system``, if the message has such a field."""
        if hasattr(message, "target_system"):
            message.target_system = self.target_system

    @property
    def master(self) -> Master:
        """What DroneKit programs use of pymavlink's connection object."""
        if self._master is None:
            from aerokit.dronekit.master import Master

            self._master = Master(self)
        return self._master

    # ----------------------------------------------------------------------------- receiving

    def forward_message(self, fn: FunctionT) -> FunctionT:
        """Have ``fn(connection, message)`` called on the listener thread for every message (pymavlink's classes).

        Usable as a decorator.
        """
        self.message_listeners.append(fn)
        if len(self.message_listeners) == 1:
            self.loop.call_soon(self.tap, self._forward)
        return fn

    def forward_loop(self, fn: FunctionT) -> FunctionT:
        """Have ``fn(connection)`` called on the listener thread about 20 times a second. Usable as a decorator."""
        self.loop_listeners.append(fn)
        if len(self.loop_listeners) == 1:
            self.loop.call_soon(self._tick)
        return fn

    def pipe(self, target: MAVConnection) -> MAVConnection:
        """Pass everything on that comes here to ``target``, and the other way round; returns ``target``."""
        target.target_system = self.target_system
        self.loop.call_soon(self.tap, lambda frame, peer: target.pass_on(frame))
        target.loop.call_soon(target.tap, lambda frame, peer: self.pass_on(frame))
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

    def close(self) -> None:
        """Wait shortly for the answers to what was ordered, then close the link and end the threads.

        Idempotent; from any thread, callbacks included, at the interpreter's exit and after the link was lost.
        """
        with self._closing:
            if self._is_closed.is_set():
                return
            self._is_closed.set()
        atexit.unregister(self._at_exit)
        try:
            self.orders.wait(ORDERS_END_S)
        finally:
            self.listener_thread.stop()
            try:
                self._held.close()
            finally:
                self.loop.close()
            self.listener_thread.join()
            for function in self._at_close:
                function()

    def on_close(self, function: Callable[[], object]) -> None:
        """Have a function called when the connection is closed."""
        self._at_close.append(function)

    def wait_closed(self, timeout: float) -> bool:
        """Wait at most ``timeout`` seconds for the connection to be closed by the program; says whether it is."""
        return self._is_closed.wait(timeout)

    @property
    def is_closed(self) -> bool:
        """Whether it was closed by the program."""
        return self._is_closed.is_set()

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

    # ------------------------------------------------------------------------------- inside

    def tap(self, sink: Callable[[Frame, Peer], None]) -> None:
        """Have a function called with every frame that comes, until the connection is closed (loop thread)."""
        self._detach.append(self.connection.tap(sink))

    def _forward(self, frame: Frame, peer: Peer) -> None:
        self.listener_thread.offer(self._deliver, frame)

    def _deliver(self, frame: Frame) -> None:
        from aerokit.dronekit.pymavlink_messages import message_of

        message = message_of(frame)
        for listener in tuple(self.message_listeners):
            self._call(listener, message)

    def _tick(self) -> None:
        if self.connection.is_open:
            self.listener_thread.offer(self._tell_loop_listeners)
            asyncio.get_running_loop().call_later(TICK_S, self._tick)

    def _tell_loop_listeners(self) -> None:
        for listener in tuple(self.loop_listeners):
            self._call(listener)

    def _call(self, listener: Callable[..., object], *args: Any) -> None:
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

    def is_of_another_vehicle(self, system_id: int) -> bool:
        """Whether this system has an autopilot of its own and is not the connected vehicle."""
        heard = self.connection.heard
        return system_id != self.target_system and any(
            source[0] == system_id and is_autopilot(heartbeat) for source, heartbeat in heard.items()
        )

    def follow_version(self, heartbeat: Message) -> None:
        """Speak the version of MAVLink that the vehicle speaks: old firmware knows no other one (loop thread)."""
        frame = heartbeat.received_frame
        if frame is not None:
            version = 2 if self.knows_mavlink_2 else frame.version
            if version != self.connection.mavlink_version:
                self.connection.mavlink_version = version


def _let_go(
    address: str,
    at_exit: Callable[[], None],
    listener_thread: ListenerThread,
    at_close: list[Callable[[], object]],
) -> None:
    """On the loop, which ends then: nobody can reach the connection any more, or has anything called by it."""
    of_vehicles.warning("the vehicle at %s is closed: the program has dropped it without close()", address)
    atexit.unregister(at_exit)
    listener_thread.stop()
    for function in at_close:
        function()


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
    loop: LoopThread, ip: str, baud: int, source_system: int, source_component: int
) -> Held[Connection]:
    """Open it; what refuses at first may be a simulator that the program has just started."""
    try:
        _check_address(ip)
        for attempt in range(ATTEMPTS):
            try:
                return loop.hold_open(
                    open_connection(
                        ip,
                        baud=baud,
                        source_system=source_system,
                        source_component=source_component,
                        reconnect=True,
                    )
                )
            except LinkOpenError as error:
                if attempt == ATTEMPTS - 1 or not isinstance(error.__cause__, ConnectionRefusedError):
                    _raise_classic(error)
                time.sleep(BETWEEN_ATTEMPTS_S)
        raise AssertionError
    except BaseException:
        loop.close()
        raise


def _check_address(ip: object) -> None:
    if not isinstance(ip, str):
        raise LocalProtocolError(f"ip = {ip!r} is no connection string; accepted are\n{ACCEPTED_FORMS}")
    try:
        parse_address(ip)
    except LocalProtocolError as error:
        from aerokit.links.address_error import AddressError

        raise AddressError(str(error)) from None


def _raise_classic(error: LinkOpenError) -> NoReturn:
    """As what the system called it: programs catch ConnectionRefusedError, socket.gaierror, SerialException."""
    cause = error.__cause__
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
