"""``Core``: the connection and the received messages that the parts of a DroneKit `Vehicle` share."""

from __future__ import annotations

import asyncio
import functools
import logging
import math
import threading
import time
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from aerokit.dronekit.classic_connection import weak_callback
from aerokit.dronekit.exceptions import APIException, TimeoutError, classic_errors  # noqa: A004 - DroneKit's name
from aerokit.dronekit.observers import EVERY_NAME, HasObservers, Listeners
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message, decoder_of
from aerokit.protocols.command import allowed_attempts
from aerokit.sync.thread_future import ThreadFuture

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from aerokit.connection.tasks import BackgroundTasks
    from aerokit.dronekit.classic_connection import BackgroundCall, CoroutineFunction
    from aerokit.dronekit.mavlink import MAVConnection
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

# Attributes that `wait_ready(True)` waits for.
DEFAULT_ATTRIBUTES = ("parameters", "gps_0", "armed", "mode", "attitude")

WAIT_STEP_S = 0.2  # Ctrl-C and a lost link end a wait within this time.
SILENCE_WARNING_S = 5
TICK_INTERVAL_S = 0.05
IDLE_TICK_INTERVAL_S = 1.0

MessageT = TypeVar("MessageT", bound=Message)


class Readiness:
    """Records which attributes have a value, and waits for missing values. Can be used from any thread."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self.fetchers: dict[str, Callable[[], None]] = {}
        """Maps attributes to functions that request the value; called repeatedly while a program waits for it."""
        self._failures: dict[str, APIException] = {}  # errors with which reading an attribute has failed
        self._lock = threading.Lock()
        self._changed: ThreadFuture[None] = ThreadFuture()  # finished and replaced at the next value or failure

    def mark(self, name: str) -> None:
        if name in self.names and name not in self._failures:
            return  # Nothing changes.
        with self._lock:
            self._failures.pop(name, None)
            self.names.add(name)
            self._notify()

    def unmark(self, name: str) -> None:
        with self._lock:
            self._failures.pop(name, None)
            self.names.discard(name)

    def fail(self, name: str, error: APIException) -> None:
        """Raise this error in all threads that wait for the attribute."""
        with self._lock:
            self._failures[name] = error
            self._notify()

    def _notify(self) -> None:
        changed, self._changed = self._changed, ThreadFuture()
        changed.finish()

    def failure_of(self, names: set[str]) -> APIException | None:
        for name in names:
            if name in self._failures:
                return self._failures[name]
        return None

    def wait_for_change(self, names: set[str], max_wait_s: float) -> None:
        """Wait briefly (at most ``max_wait_s``) for an attribute to get a value or to fail.

        Returns at once if all attributes in ``names`` have a value, or if reading a missing one has failed.
        """
        with self._lock:
            missing, changed = names - self.names, self._changed
            must_wait = missing and self.failure_of(missing) is None
        if must_wait:
            changed.wait(min(WAIT_STEP_S, max_wait_s))


class LatestMessage(Generic[MessageT]):
    """The latest message of a type from the autopilot, and the handlers of the type.

    A message is decoded only if a handler needs it, or when :attr:`message` is read.
    """

    def __init__(self, message_type: type[MessageT], ready: set[str], listeners: Listeners) -> None:
        self._decode: Callable[[Frame], MessageT] = decoder_of(message_type)
        self._ready_names = ready  # names of the attributes that have a value
        self._listeners = [listeners]
        self._notified_names: set[str] = set()  # attributes whose listeners the handlers notify
        # Without listeners, messages are not decoded. True if a handler needs them nevertheless.
        self._needs_every_message = False
        self._handlers: list[Callable[[MessageT], object]] = []
        self._latest: Frame | MessageT | None = None  # a Frame if the latest message was not decoded on arrival
        self._decoded: MessageT | None = None  # cache of the property `message`; may be older than `_latest`
        self.component_id = 0
        """Component id of the autopilot; messages of other components are ignored."""

    @property
    def message(self) -> MessageT | None:
        """The latest message, or None before the first. Decodes it on first access, on any thread."""
        latest = self._latest
        if not isinstance(latest, Frame):
            return latest
        decoded = self._decoded
        if decoded is None or decoded.received_frame is not latest:
            decoded = self._decoded = self._decode(latest)
        return decoded

    def values(self, *fields: str) -> tuple[Any, ...]:
        message = self.message
        return tuple([None if message is None else getattr(message, field) for field in fields])

    def add(self, handler: Callable[[MessageT], object], names: tuple[str, ...], listeners: Listeners | None) -> None:
        self._handlers.append(handler)
        self._notified_names.update(names)
        self._needs_every_message = self._needs_every_message or not names
        if listeners is not None:
            self._listeners.append(listeners)

    def on_frame(self, frame: Frame, message: MessageT | None = None) -> None:
        """Receive a frame on the loop thread, and its message if it is already decoded."""
        if frame.component_id != self.component_id:
            return
        if self._must_decode():
            self.receive(self._decode(frame) if message is None else message)
        else:
            self._latest = frame

    def receive(self, message: MessageT) -> None:
        self._latest = message
        for handler in self._handlers:
            handler(message)

    def _must_decode(self) -> bool:
        """Return True if a handler needs the message now."""
        names = self._notified_names
        have_all_values = names <= self._ready_names  # wait_ready() needs the first value even without listeners.
        if self._needs_every_message or not have_all_values:
            return True
        for listeners in self._listeners:
            by_name = listeners.by_name
            if by_name and (EVERY_NAME in by_name or not names.isdisjoint(by_name)):
                return True
        return False


class Core:
    """State that the parts of a DroneKit `Vehicle` share: the asynchronous vehicle, messages, listeners and orders."""

    def __init__(self, handler: MAVConnection, owner: object) -> None:
        self.handler = handler
        self.logger: logging.Logger = logging.getLogger("dronekit")
        self.ready: Readiness = Readiness()
        self.listeners: Listeners = Listeners(owner, handler.listener_thread, self.ready.mark)
        """Listeners of the vehicle's attributes."""
        self.heartbeat_limit_s: float = 0.0
        """Orders raise APIException after this many seconds without a heartbeat; 0: never."""
        self.aio_or_none: AsyncVehicle | None = None
        """The asynchronous vehicle; None before it is connected."""
        self._tasks: BackgroundTasks | None = None  # None before the vehicle is connected
        self._latest: dict[type[Message], LatestMessage[Any]] = {}
        self.on_connected: list[Callable[[], None]] = []
        """Functions to call on the loop when the vehicle is connected."""
        self._is_silent = False  # True while the last heartbeat is older than SILENCE_WARNING_S

    # --------------------------------------------------------------------------------- state

    @property
    def target_system(self) -> int:
        return self.handler.target_system

    @property
    def aio(self) -> AsyncVehicle:
        """The asynchronous vehicle; raises APIException before it is connected."""
        if self.aio_or_none is None:
            raise APIException("the vehicle is not connected yet: call initialize()")
        return self.aio_or_none

    def check_link(self) -> AsyncVehicle:
        """Return the asynchronous vehicle. Raise APIException if commands cannot be sent to it."""
        aio = self.aio
        if self.handler.is_closed:
            raise APIException("the vehicle was closed")
        with classic_errors():
            aio.connection.raise_if_ended()
        age = aio.heartbeat_age
        if self.heartbeat_limit_s and age > self.heartbeat_limit_s:
            raise APIException(f"no heartbeat from the vehicle for {age:.0f} s")
        return aio

    def check_may_wait(self) -> None:
        """Raise APIException if the link is down, or on the loop's thread, where a wait would be a deadlock."""
        self.check_link()
        with classic_errors():
            self.handler.loop.check_may_wait()

    # ----------------------------------------------------------------------------- receiving

    def on(
        self,
        message_type: type[MessageT],
        handler: Callable[[MessageT], object],
        *names: str,
        listeners: Listeners | None = None,
    ) -> LatestMessage[MessageT]:
        """Call a handler with each message of this type from the autopilot. Return the type's `LatestMessage`.

        Add the handler before the vehicle is connected. It is called on the loop thread, as long as the `Core` exists.

        If the handler only notifies the listeners of attributes, pass the ``names`` of the attributes. When all of them
        have a value, messages for which there are no listeners (on the vehicle or in ``listeners``) may be skipped.
        """
        if message_type not in self._latest:
            self._latest[message_type] = LatestMessage(message_type, self.ready.names, self.listeners)
        latest = self._latest[message_type]
        latest.add(handler, names, listeners)
        return latest

    def notify_on(self, message_type: type[MessageT], *names: str) -> LatestMessage[MessageT]:
        """Like :meth:`on`, with a handler that notifies the listeners of the attributes ``names``."""

        def notify(_: MessageT) -> None:
            for name in names:
                self.listeners.notify_attribute(name)

        return self.on(message_type, notify, *names)

    def start_receiving(self, aio: AsyncVehicle, tasks: BackgroundTasks) -> None:
        """Start receiving on the loop thread, once the vehicle is connected."""
        self.aio_or_none, self._tasks = aio, tasks
        self.handler.target_system = aio.system_id
        _ = aio.parameters  # This creates the object, so that it gets each PARAM_VALUE before our handlers.
        # The loop gets weak references only, so that a vehicle that the program drops can be garbage collected.
        for message_type, latest in self._latest.items():
            latest.component_id = aio.component_id
            aio.connection.bus.attach_lazily(message_type, weak_callback(latest.on_frame), system_id=aio.system_id)

    def watch_link(self) -> None:
        """Log when silence begins and ends, and report the heartbeat's age to the listeners of ``last_heartbeat``."""
        aio = self.aio
        if not aio.connection.is_open:
            return
        age = aio.heartbeat_age
        self.listeners.notify("last_heartbeat", age)
        is_silent = age > SILENCE_WARNING_S
        if is_silent != self._is_silent:
            self._is_silent = is_silent
            post = self.handler.listener_thread.post  # The loop does not log, because the log handlers may block.
            if is_silent:
                post(self.logger.warning, "Link timeout, no heartbeat in last %d seconds", SILENCE_WARNING_S)
            else:
                post(self.logger.info, "...link restored.")
        wait_s = TICK_INTERVAL_S
        # Each wake-up costs as much as a few messages, so the wait is longer if no listener needs `last_heartbeat`.
        if not is_silent and not self.listeners.has_listener("last_heartbeat"):
            wait_s = max(wait_s, min(IDLE_TICK_INTERVAL_S, SILENCE_WARNING_S - age))
        asyncio.get_running_loop().call_later(wait_s, weak_callback(self.watch_link))

    def background(self, function: Callable[[], Awaitable[None]]) -> None:
        if self._tasks is not None:
            self._tasks.start(function, f"dronekit {getattr(function, '__name__', 'task')}")

    # ------------------------------------------------------------------------------- sending

    def run(self, function: Callable[..., Awaitable[Any]], *args: Any, **kwargs: Any) -> Any:
        """Run a coroutine function on the loop and wait for its result. Errors are converted to those of DroneKit."""
        self.check_link()
        with classic_errors():
            return self.handler.loop.run(function, *args, **kwargs)

    def order(self, kind: str, function: CoroutineFunction, *args: Any, **kwargs: Any) -> BackgroundCall:
        """Start an order without waiting. It replaces an older order of the same kind."""
        self.check_link()
        with classic_errors():
            return self.handler.calls.start(kind, function, *args, **kwargs)

    def command(self, kind: str, command: int, *params: float, **options: Any) -> BackgroundCall:
        """Send a command to all components of the vehicle without waiting. Only the autopilot's answer counts."""
        options.setdefault("retries", allowed_attempts(command, params) - 1)
        return self.order(kind, self.check_link().command, command, *params, component_id=0, **options)

    def send(self, message: Message) -> None:
        self.check_link()
        self.handler.send(message)


def _recording_activity(original: property) -> property:
    """Wrap a property, so that reading it counts as activity of the program. Without activity, our HEARTBEAT stops."""
    getter = original.fget
    assert getter is not None

    @functools.wraps(getter)
    def recording_getter(vehicle: VehicleCore) -> Any:
        vehicle._dk.handler.loop.feed()
        return getter(vehicle)

    return property(recording_getter, original.fset, original.fdel, original.__doc__)


class VehicleCore(HasObservers):
    """Base class of the vehicle, with its core. The prefix ``_dk`` avoids collisions with names in subclasses."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # Wrap the properties of our own classes only, not those of a program's subclass.
        if cls.__module__.startswith("aerokit."):
            for name, member in list(vars(cls).items()):
                if isinstance(member, property) and not name.startswith("_"):
                    setattr(cls, name, _recording_activity(member))

    def __init__(self, handler: MAVConnection) -> None:
        self._handler = handler
        self._dk = Core(handler, self)
        self._dk_observe(self._dk.listeners)
        self._logger = self._dk.logger
        self._ready_attrs = self._dk.ready.names
        self._autopilot_logger = logging.getLogger("autopilot")

    def wait_ready(
        self,
        *types: str | bool,
        timeout: float | None = 30,
        raise_exception: bool = True,
        still_waiting_callback: Callable[[set[str]], object] | None = None,
        still_waiting_interval: float = 1,
        **_: Any,
    ) -> bool:
        """Wait until attributes have values. Without names, or with True, wait for five default attributes.

        Args:
            types: names of attributes, including your own; ``wait_ready(True)`` is ``'parameters'``, ``'gps_0'``,
                ``'armed'``, ``'mode'`` and ``'attitude'``.
            timeout: seconds; None means no limit.
            raise_exception: if false, return False instead of raising the errors about missing values.
            still_waiting_callback: called with the missing names.
            still_waiting_interval: seconds between these calls.

        Returns:
            True if all these attributes have values.

        Raises:
            TimeoutError: a value is missing after ``timeout``.
            APIException: reading an attribute has failed; or the link is down, whatever ``raise_exception`` is.
            ValueError: a name is not a string.
        """
        waits_for_defaults = not types or types == (True,)
        names = DEFAULT_ATTRIBUTES if waits_for_defaults else types
        if not all(isinstance(name, str) for name in names):
            raise ValueError("wait_ready expects one or more string arguments.")
        required = {str(name) for name in names}
        ready = self._dk.ready
        started_at = reported_at = time.monotonic()
        deadline = math.inf if timeout is None else started_at + timeout
        while missing := required - ready.names:
            now = time.monotonic()
            if now >= deadline:
                if raise_exception:
                    # The text is that of DroneKit. The cause of the exception names the missing values.
                    error = TimeoutError(f"wait_ready experienced a timeout after {timeout} seconds.")
                    raise error from LookupError(f"not received: {', '.join(sorted(missing))}")
                return False
            self._dk.check_may_wait()
            if (failure := ready.failure_of(missing)) is not None:
                if raise_exception:  # Each thread raises a copy, because a shared exception would mix the tracebacks.
                    raise type(failure)(str(failure)) from failure.__cause__
                return False
            for name in ready.fetchers.keys() & missing:
                ready.fetchers[name]()
            if still_waiting_callback is not None and now >= reported_at + still_waiting_interval:
                reported_at = now
                still_waiting_callback(missing)
            ready.wait_for_change(required, deadline - now)
        return True


def core_of(vehicle: VehicleCore) -> Core:
    return vehicle._dk
