"""``Line``: a link that is open until it is closed, with the threads of the classic API, and what is ordered there."""

from __future__ import annotations

import asyncio
import atexit
import concurrent.futures
import contextlib
import functools
import logging
import threading
import weakref
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from aerokit.connection.components import is_autopilot
from aerokit.dronekit.exceptions import classic_errors
from aerokit.dronekit.listener_thread import ListenerThread
from aerokit.errors import AerokitError, CommandRejected, ConnectionClosed
from aerokit.mavlink.messages import RcChannelsOverride

if TYPE_CHECKING:
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.message import Message
    from aerokit.sync.loop_thread import Held, LoopThread

logger: logging.Logger = logging.getLogger("dronekit.mavlink")

of_vehicles: logging.Logger = logging.getLogger("dronekit")

ORDERS_END_S = 2.0
"""How long closing waits for what was ordered a moment before to be answered."""

REPLACES = {"disarm": "arm"}
"""Kinds that are one: the newer replaces the older."""

Work = Callable[..., Awaitable[object]]


class Line:
    """An open connection, its event loop on a thread, and the thread of the program's callbacks."""

    def __init__(
        self,
        address: str,
        loop: LoopThread,
        held: Held[Connection],
        target_system: int,
        overrides: OverrideRelease,
    ) -> None:
        self.target_system = target_system
        """System id of the vehicle, 0 before it was heard."""
        self.listener_thread: ListenerThread = ListenerThread()
        """Where the callbacks of the program run."""
        self.listener_thread.on_called = loop.proof.feed
        self.loop = loop
        """The event loop's thread."""
        self._held = held
        self.connection: Connection = held.value
        """The asynchronous connection, for code that runs on its loop."""
        self.calls: BackgroundCalls = BackgroundCalls(loop)
        """What was ordered without waiting."""
        self.overrides = overrides
        """The RC channels that are given back when the connection ends."""
        self.knows_mavlink_2 = False
        """Whether the vehicle has said that it understands MAVLink 2, whichever version it speaks so far."""
        self.note_sent: Callable[[Message], None] = lambda message: None
        """Is told what has been sent, on the loop's thread: what steers is a newer order."""
        self.vehicle: Any = None
        """The vehicle of this connection, once there is one."""
        self._is_closed = threading.Event()
        self._closing = threading.Lock()
        self._at_close: list[Callable[[], object]] = []
        self._at_exit = weakly(self.close)
        atexit.register(self._at_exit)
        loop.when_dropped(
            functools.partial(_let_go, address, self._at_exit, self.listener_thread, self._at_close)
        )

    def send(self, message: Message, *, to: int | None = None) -> None:
        """Send a message, in the order of the calls; from any thread, never blocks.

        InvalidArgument: a field is out of range; APIException: the connection is closed.
        """
        message.encode()  # so that what is wrong with it is told to who made it
        with classic_errors():
            self.connection.raise_if_ended()
            self.calls.post(self._send, message, to)

    def _send(self, message: Message, to: int | None) -> None:
        try:
            self.connection.send(message, to=to)
            self.overrides.note_sent(message)
            self.note_sent(message)
        except AerokitError as error:
            logger.warning("%s was not sent: %s", message.NAME, error)

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
            self.calls.wait(ORDERS_END_S)
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


class BackgroundCall(concurrent.futures.Future[None]):
    """A call that runs on the loop while the program goes on: done when it has ended, with its failure."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind
        self.task: asyncio.Task[None] | None = None


class BackgroundCalls:
    """Runs coroutine functions on the loop in the background; a failure becomes one warning, too.

    A newer call of a kind ends the wait of the one before. What may still be sent is not decided here, but by the
    vehicle's :class:`aerokit.vehicle.commanding.arbiter.CommandArbiter`.
    """

    def __init__(self, loop: LoopThread) -> None:
        self._loop = loop
        self._newest: dict[str, BackgroundCall] = {}
        self._pending: set[BackgroundCall] = set()
        self.describe: Callable[[], str] | None = None
        """What to say of the vehicle when it has refused an order."""

    def give(self, kind: str, function: Work, *args: Any, **kwargs: Any) -> BackgroundCall:
        """Start it; what it sends first goes out in the order of these calls. Never blocks; from any thread.

        ConnectionClosed when the connection was closed.
        """
        order = BackgroundCall(kind)
        self._pending.add(order)
        order.add_done_callback(self._pending.discard)
        try:
            self._loop.call_soon(self._begin, order, functools.partial(function, *args, **kwargs))
        except ConnectionClosed:
            order.cancel()
            raise
        return order

    def withdraw(self, order: BackgroundCall) -> None:
        """What :meth:`give` returned is not wanted any more: it is not sent again. Never blocks; from any thread."""
        with contextlib.suppress(ConnectionClosed):
            self._loop.call_soon(self._withdraw, order)

    def post(self, function: Callable[..., object], *args: Any) -> None:
        """Call a function that neither waits nor raises on the loop; in order with other calls and :meth:`give`."""
        if self._loop.is_current:
            function(*args)
        else:
            self._loop.call_soon(_call_next, function, *args)

    def wait(self, timeout: float) -> None:
        """Wait until all that were given have ended, at most so many seconds."""
        pending = self._pending.copy()
        if pending and not self._loop.is_current:
            concurrent.futures.wait(pending, timeout)

    def _begin(self, order: BackgroundCall, work: Work) -> None:
        place = REPLACES.get(order.kind, order.kind)
        if place in self._newest:
            self._withdraw(self._newest[place])
        if order.set_running_or_notify_cancel():
            name = f"dronekit {order.kind}"
            order.task = asyncio.get_running_loop().create_task(self._run(order, work), name=name)
            order.task.add_done_callback(lambda _: self._end(place, order))
            self._newest[place] = order

    def _withdraw(self, order: BackgroundCall) -> None:
        if order.task is not None and order in self._newest.values():
            order.task.cancel()

    def _end(self, place: str, order: BackgroundCall) -> None:
        if self._newest.get(place) is order:
            del self._newest[place]
        if not order.done():  # it was cancelled before its first step, or while it waited
            why = "a newer order replaced it, it was withdrawn, or the connection was closed"
            order.set_exception(ConnectionClosed(f"{order.kind}: {why}"))

    async def _run(self, order: BackgroundCall, work: Work) -> None:
        try:
            await work()
        except Exception as error:
            if not isinstance(error, ConnectionClosed):
                text = str(error)  # who keeps log records keeps no frames, and so no vehicle
                if isinstance(error, CommandRejected) and self.describe is not None:
                    text += f" ({self.describe()})"  # most refusals are for what the vehicle does not say
                of_vehicles.warning("%s: %s", order.kind, text)
            order.set_exception(error)
        else:
            order.set_result(None)


def _call_next(function: Callable[..., object], *args: Any) -> None:
    """In the turn in which tasks begun before take their first step."""
    asyncio.get_running_loop().call_soon(function, *args)


def weakly(method: Callable[..., object]) -> Callable[..., None]:
    """A function that calls a bound method for as long as its object, which it does not keep, is there."""
    bound: Any = method
    owner, function = weakref.ref(bound.__self__), bound.__func__

    def call(*args: object) -> None:
        present = owner()
        if present is not None:
            function(present, *args)

    return call


IGNORE = 0xFFFF

RELEASE = 0

RELEASE_UPPER = 0xFFFE
"""Gives a channel above 8 back to the radio; 0 leaves it alone."""

CHANNELS_OF_MAVLINK_1 = 8

CHANNELS = 18

COPIES = 3
"""A release is not acknowledged, so it is sent more than once: frames get lost."""


class OverrideRelease:
    """The channels that this connection overrides, by target, and the messages that end that.

    https://mavlink.io/en/messages/common.html#RC_CHANNELS_OVERRIDE
    """

    is_wanted: bool

    def __init__(self) -> None:
        self.is_wanted = True
        self._overridden: dict[tuple[int, int], set[int]] = {}

    def note_sent(self, message: Message) -> None:
        """Take the channels of an RC_CHANNELS_OVERRIDE that was sent; other messages mean nothing."""
        if not isinstance(message, RcChannelsOverride):
            return
        target = message.target_system, message.target_component
        overridden = self._overridden.setdefault(target, set())
        for channel in range(1, CHANNELS + 1):
            value = getattr(message, f"chan{channel}_raw")
            is_upper = channel > CHANNELS_OF_MAVLINK_1
            if value == (RELEASE_UPPER if is_upper else RELEASE):
                overridden.discard(channel)
            elif value not in (IGNORE, RELEASE):
                overridden.add(channel)

    def send(self, connection: Connection) -> None:
        """Give back what is overridden, if that is wanted (loop thread). Never raises."""
        for (system, component), channels in self._overridden.items():
            if self.is_wanted and channels:
                values = [_released(channel, channel in channels) for channel in range(1, CHANNELS + 1)]
                message = RcChannelsOverride(system, component, *values)
                with contextlib.suppress(AerokitError):  # the link is gone
                    for _ in range(COPIES):
                        connection.send(message)


def _released(channel: int, is_overridden: bool) -> int:
    if channel > CHANNELS_OF_MAVLINK_1:
        return RELEASE_UPPER if is_overridden else 0
    return RELEASE if is_overridden else IGNORE
