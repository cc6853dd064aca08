"""``ClassicConnection``: an open connection, with its threads and the calls that run in the background."""

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

from aerokit.connection.heartbeats import is_autopilot
from aerokit.dronekit.exceptions import classic_errors
from aerokit.dronekit.listener_thread import ListenerThread
from aerokit.errors import AerokitError, CommandRejected, ConnectionClosed
from aerokit.mavlink.messages import RcChannelsOverride
from aerokit.sync.thread_future import ThreadFuture

if TYPE_CHECKING:
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.message import Message
    from aerokit.sync.loop_thread import LoopThread, OpenContext

logger: logging.Logger = logging.getLogger("dronekit.mavlink")

vehicle_logger: logging.Logger = logging.getLogger("dronekit")

CLOSE_TIMEOUT_S = 2.0  # maximum time that close() waits for the answers to recent orders

# Disarming counts as a call of the kind "arm", so that arming and disarming replace each other.
SHARED_KINDS = {"disarm": "arm"}

CoroutineFunction = Callable[..., Awaitable[object]]


class ClassicConnection:
    """An open connection, its event loop on a thread, and the thread of the program's callbacks."""

    def __init__(
        self,
        address: str,
        loop: LoopThread,
        context: OpenContext[Connection],
        target_system: int,
        overrides: OverrideRelease,
    ) -> None:
        self.target_system = target_system
        """System id of the vehicle, 0 until it is found."""
        self.listener_thread: ListenerThread = ListenerThread()
        self.listener_thread.on_called = loop.activity.feed  # Without activity, the HEARTBEAT of aerokit stops.
        self.loop = loop
        self._context = context  # the context manager of `open_connection`; close() exits it
        self.connection: Connection = context.value
        """The asynchronous connection, for code that runs on its loop."""
        self.calls: BackgroundCalls = BackgroundCalls(loop)
        self.overrides = overrides
        self.supports_mavlink_2 = False
        """True once the vehicle has reported that it supports MAVLink 2, even if it still sends version 1."""
        self.on_sent: Callable[[Message], None] = lambda message: None
        """Called on the loop with each sent message, because a message may overrule earlier orders."""
        self.vehicle: Any = None
        """The vehicle on this connection; None before it is connected."""
        self._closed: ThreadFuture[None] = ThreadFuture()  # finished when close() was called
        self._closing = threading.Lock()  # held while one thread decides to close
        self._close_callbacks: list[Callable[[], object]] = []
        # Closes the connection when the interpreter exits, without keeping this object alive until then.
        self._exit_callback = weak_callback(self.close)
        atexit.register(self._exit_callback)
        loop.when_dropped(
            functools.partial(_on_dropped, address, self._exit_callback, self.listener_thread, self._close_callbacks)
        )

    def send(self, message: Message, *, to: int | None = None) -> None:
        """Send a message without blocking, from any thread.

        Messages are sent in the order of the calls. With ``to``, the message goes to the system with this id, instead
        of that in its ``target_system``. Raises InvalidArgument if a field is out of range, and APIException if the
        connection is closed.
        """
        message.encode()  # Raises for an invalid field here. On the loop, the error would only be logged.
        with classic_errors():
            self.connection.raise_if_ended()
            self.calls.post(self._send, message, to)

    def _send(self, message: Message, to: int | None) -> None:
        try:
            self.connection.send(message, to=to)
            self.overrides.record(message)
            self.on_sent(message)
        except AerokitError as error:
            logger.warning("%s was not sent: %s", message.NAME, error)

    def close(self) -> None:
        """Wait up to two seconds for answers to recent orders, then close the link and end the threads.

        Idempotent. Can be called from any thread and callback, at interpreter exit, and after the link was lost.
        """
        with self._closing:
            if self._closed.is_done:
                return
            self._closed.finish()
        atexit.unregister(self._exit_callback)
        try:
            self.calls.wait(CLOSE_TIMEOUT_S)
        finally:
            self.listener_thread.stop()
            try:
                self._context.close()
            finally:
                self.loop.close()
            self.listener_thread.join()
            for function in self._close_callbacks:
                function()

    def on_close(self, function: Callable[[], object]) -> None:
        self._close_callbacks.append(function)

    def wait_closed(self, timeout: float) -> bool:
        """Wait for :meth:`close`, at most ``timeout`` seconds. Return True if it was called."""
        return self._closed.wait(timeout)

    @property
    def is_closed(self) -> bool:
        return self._closed.is_done

    def is_of_another_vehicle(self, system_id: int) -> bool:
        return system_id != self.target_system and any(
            sender_system == system_id and is_autopilot(heartbeat)
            for (sender_system, _), heartbeat in self.connection.heartbeats.items()
        )

    def match_mavlink_version(self, heartbeat: Message) -> None:
        """Set the version of sent messages: 2 if the vehicle supports MAVLink 2, otherwise that of its HEARTBEAT."""
        frame = heartbeat.received_frame
        if frame is not None:
            version = 2 if self.supports_mavlink_2 else frame.version
            if version != self.connection.mavlink_version:
                self.connection.mavlink_version = version


def _on_dropped(
    address: str,
    exit_callback: Callable[[], None],
    listener_thread: ListenerThread,
    close_callbacks: list[Callable[[], object]],
) -> None:
    """Clean up, on the loop, after a connection that was garbage-collected without close()."""
    vehicle_logger.warning("the connection to %s was closed: the program dropped it without close()", address)
    atexit.unregister(exit_callback)
    listener_thread.stop()
    for function in close_callbacks:
        function()


class BackgroundCall(concurrent.futures.Future[None]):
    """A call that runs on the loop in the background; a Future without a result."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind
        self.task: asyncio.Task[None] | None = None

    def done(self) -> bool:
        # Waits call this method often. Future.done acquires a lock, which Ctrl-C could leave acquired.
        return self._state not in ("PENDING", "RUNNING")


class BackgroundCalls:
    """Runs coroutine functions on the loop in the background, and logs each failure as a warning.

    A newer call cancels the previous call of the same kind. This class does not decide which commands may still be
    sent: that is the task of the vehicle's :class:`aerokit.vehicle.commanding.arbiter.CommandArbiter`.
    """

    def __init__(self, loop: LoopThread) -> None:
        self._loop = loop
        self._newest: dict[str, BackgroundCall] = {}  # the running call of each kind
        self._pending: set[BackgroundCall] = set()  # calls that have not ended
        self.describe: Callable[[], str] | None = None
        """Describes the vehicle's state in the warning about a rejected command."""

    def start(self, kind: str, function: CoroutineFunction, *args: Any, **kwargs: Any) -> BackgroundCall:
        """Start a call without blocking, from any thread. Calls send their first messages in the order of their start.

        Raises ConnectionClosed if the connection was closed.
        """
        call = BackgroundCall(kind)
        self._pending.add(call)
        call.add_done_callback(self._pending.discard)
        try:
            self._loop.call_soon(self._begin, call, functools.partial(function, *args, **kwargs))
        except ConnectionClosed:
            call.cancel()
            raise
        return call

    def cancel(self, call: BackgroundCall) -> None:
        """Cancel a call without blocking, from any thread."""
        with contextlib.suppress(ConnectionClosed):
            self._loop.call_soon(self._cancel, call)

    def post(self, function: Callable[..., object], *args: Any) -> None:
        """Call a function on the loop. The function must neither block nor raise.

        From another thread, the function is called as soon as all earlier calls have begun.
        """
        if self._loop.is_current:
            function(*args)
        else:
            self._loop.call_soon(_call_after_tasks, function, *args)

    def wait(self, timeout: float) -> None:
        """Wait until all calls have ended, at most ``timeout`` seconds. On the loop's thread, return at once."""
        pending = self._pending.copy()
        if pending and not self._loop.is_current:
            concurrent.futures.wait(pending, timeout)

    def _begin(self, call: BackgroundCall, function: CoroutineFunction) -> None:
        kind = SHARED_KINDS.get(call.kind, call.kind)
        if kind in self._newest:
            self._cancel(self._newest[kind])  # A new call replaces the previous one of its kind.
        if call.set_running_or_notify_cancel():  # False if the call was cancelled before its start
            name = f"dronekit {call.kind}"
            call.task = asyncio.get_running_loop().create_task(self._run(call, function), name=name)
            call.task.add_done_callback(lambda _: self._end(kind, call))
            self._newest[kind] = call

    def _cancel(self, call: BackgroundCall) -> None:
        if call.task is not None and call in self._newest.values():
            call.task.cancel()

    def _end(self, kind: str, call: BackgroundCall) -> None:
        if self._newest.get(kind) is call:
            del self._newest[kind]
        if not call.done():  # The task was cancelled before it had a result.
            reason = "the order was cancelled or replaced by a newer one, or the connection was closed"
            call.set_exception(ConnectionClosed(f"{call.kind}: {reason}"))

    async def _run(self, call: BackgroundCall, function: CoroutineFunction) -> None:
        try:
            await function()
        except Exception as error:
            if not isinstance(error, ConnectionClosed):
                text = str(error)  # A logged exception would keep its stack frames and so the vehicle alive.
                if isinstance(error, CommandRejected) and self.describe is not None:
                    text += f" ({self.describe()})"  # The vehicle's answer rarely names the cause.
                vehicle_logger.warning("%s: %s", call.kind, text)
            call.set_exception(error)
        else:
            call.set_result(None)


def _call_after_tasks(function: Callable[..., object], *args: Any) -> None:
    # `call_soon` calls the function after the first steps of all tasks that earlier calls have created.
    asyncio.get_running_loop().call_soon(function, *args)


def weak_callback(method: Callable[..., object]) -> Callable[..., None]:
    """Return a function that calls a bound method without keeping its object alive."""
    bound_method: Any = method
    owner_reference, function = weakref.ref(bound_method.__self__), bound_method.__func__

    def call(*args: object) -> None:
        owner = owner_reference()
        if owner is not None:
            function(owner, *args)

    return call


IGNORE = 0xFFFF
RELEASE = 0
RELEASE_UPPER = 0xFFFE  # releases a channel above 8; 0 leaves such a channel unchanged

MAVLINK_1_CHANNELS = 8  # MAVLink 2 adds channels above this number to RC_CHANNELS_OVERRIDE.
MAX_CHANNELS = 18

RELEASE_COPIES = 3  # RC_CHANNELS_OVERRIDE is not acknowledged, and a frame may be lost.


class OverrideRelease:
    """Records the RC channels that this connection overrides, and releases them when the connection ends.

    https://mavlink.io/en/messages/common.html#RC_CHANNELS_OVERRIDE
    """

    is_enabled: bool

    def __init__(self) -> None:
        self.is_enabled = True
        self._overridden: dict[tuple[int, int], set[int]] = {}  # (system id, component id) → channels

    def record(self, message: Message) -> None:
        """Record which channels a sent RC_CHANNELS_OVERRIDE overrides or releases."""
        if not isinstance(message, RcChannelsOverride):
            return
        target = message.target_system, message.target_component
        overridden = self._overridden.setdefault(target, set())
        for channel in range(1, MAX_CHANNELS + 1):
            value = getattr(message, f"chan{channel}_raw")
            released = RELEASE_UPPER if channel > MAVLINK_1_CHANNELS else RELEASE
            if value == released:
                overridden.discard(channel)
            elif value not in (IGNORE, RELEASE):  # RELEASE leaves the channels above 8 unchanged.
                overridden.add(channel)

    def send(self, connection: Connection) -> None:
        for (system, component), channels in self._overridden.items():
            if self.is_enabled and channels:
                values = [_release_value(channel, channel in channels) for channel in range(1, MAX_CHANNELS + 1)]
                message = RcChannelsOverride(system, component, *values)
                with contextlib.suppress(AerokitError):  # The link may already be closed.
                    for _ in range(RELEASE_COPIES):
                        connection.send(message)


def _release_value(channel: int, is_overridden: bool) -> int:
    if channel > MAVLINK_1_CHANNELS:
        return RELEASE_UPPER if is_overridden else 0  # 0 leaves the channel unchanged.
    return RELEASE if is_overridden else IGNORE
