"""``Core``: the connection underneath a classic vehicle, as all its parts use it, and what was received on it."""

from __future__ import annotations

import asyncio
import functools
import logging
import math
import threading
import time
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from aerokit.dronekit.exceptions import APIException, TimeoutError, classic_errors  # noqa: A004 - DroneKit's name
from aerokit.dronekit.line import weakly
from aerokit.dronekit.observers import EVERY_NAME, HasObservers, Listeners
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message
from aerokit.protocols.command import attempts_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from aerokit.connection.tasks import Background
    from aerokit.dronekit.line import BackgroundCall, Work
    from aerokit.dronekit.mavlink import MAVConnection
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

DEFAULT_ATTRIBUTES = ("parameters", "gps_0", "armed", "mode", "attitude")
"""What ``wait_ready(True)`` waits for."""

LONGEST_WAIT_S = 0.2
"""Waits are cut into slices: Ctrl-C and the end of the link are noticed between them."""
SILENT_AFTER_S = 5
TICK_S = 0.05
IDLE_TICK_S = 1.0

MessageT = TypeVar("MessageT", bound=Message)


class Readiness:
    """What is ready is what was told at least once. Any thread may use it."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        """What has values."""
        self.seekers: dict[str, Callable[[], None]] = {}
        """What is called while somebody waits for a name that does not come by itself."""
        self._failures: dict[str, APIException] = {}
        self._changed = threading.Condition()

    def mark(self, name: str) -> None:
        """The attribute has a value, as it may have had before: whoever waits for it goes on."""
        if name in self.names and name not in self._failures:
            return
        with self._changed:
            self._failures.pop(name, None)
            self.names.add(name)
            self._changed.notify_all()

    def unmark(self, name: str) -> None:
        """The attribute will get a new value, and is to be waited for."""
        with self._changed:
            self._failures.pop(name, None)
            self.names.discard(name)

    def fail(self, name: str, error: APIException) -> None:
        """The attribute will get no value: whoever waits for it is told why."""
        with self._changed:
            self._failures[name] = error
            self._changed.notify_all()

    def failure_of(self, names: set[str]) -> APIException | None:
        """Why one of these will get no value, if that is known."""
        return next(filter(None, map(self._failures.get, names)), None)

    def wait_a_little(self, wanted: set[str], at_most_s: float) -> None:
        """Wait until something may have happened to these, as long as one of them is missing."""
        with self._changed:
            missing = wanted - self.names
            if missing and self.failure_of(missing) is None:
                self._changed.wait(min(LONGEST_WAIT_S, at_most_s))


class Latest(Generic[MessageT]):
    """The latest message of a kind that the autopilot sent, and who is given each of them."""

    def __init__(self, message_type: type[MessageT], ready: set[str], listeners: Listeners) -> None:
        self._decode: Callable[[bytes, Frame], MessageT] = message_type.decode_body
        self._ready = ready
        self._listeners = [listeners]
        self._names: set[str] = set()
        self._handlers: list[Callable[[MessageT], object]] = []
        self._held: Frame | MessageT | None = None
        self._made: MessageT | None = None
        self.component_id = 0
        """Of the autopilot: nobody else counts."""

    @property
    def message(self) -> MessageT | None:
        """The message, None before the first; made by the first who reads it, on any thread."""
        held = self._held
        if not isinstance(held, Frame):
            return held
        made = self._made
        if made is None or made.received_frame is not held:
            made = self._made = self._decode(held.body, held)
        return made

    def values(self, *fields: str) -> tuple[Any, ...]:
        """Fields of one message, None before the first."""
        message = self.message
        return tuple([None if message is None else getattr(message, field) for field in fields])

    def add(
        self, handler: Callable[[MessageT], object], names: tuple[str, ...], listeners: Listeners | None
    ) -> None:
        """Have a handler called, after those added before: with each message, or, with ``names``, only as long as not
        all of them were told, or somebody listens to one of them, or has any of the other ``listeners``.
        """
        self._handlers.append(handler)
        self._names.update(names)
        if listeners is not None:
            self._listeners.append(listeners)

    def take(self, frame: Frame, message: MessageT | None = None) -> None:
        """Take a frame of the vehicle's system (loop thread), and its message if that was made already."""
        if frame.component_id != self.component_id:
            return
        if self._is_wanted():
            self.receive(self._decode(frame.body, frame) if message is None else message)
        else:
            self._held = frame

    def receive(self, message: MessageT) -> None:
        """Keep it, and give it to the handlers."""
        self._held = message
        for handler in self._handlers:
            handler(message)

    def _is_wanted(self) -> bool:
        names = self._names
        if not names or not names <= self._ready:
            return True
        for each in self._listeners:
            listened = each.by_name
            if listened and (EVERY_NAME in listened or not names.isdisjoint(listened)):
                return True
        return False


class Core:
    """What is sent, waited for and heard by way of the asynchronous vehicle, once there is one, and what is told of it.

    The parts of a vehicle know this, and not the vehicle.
    """

    def __init__(self, handler: MAVConnection, owner: object) -> None:
        self.handler = handler
        self.logger: logging.Logger = logging.getLogger("dronekit")
        self.ready: Readiness = Readiness()
        self.listeners: Listeners = Listeners(owner, handler.listener_thread, self.ready.mark)
        """Of the vehicle's attributes."""
        self.heartbeat_limit_s: float = 0.0
        """Longer silences are errors; 0: none is."""
        self.found: AsyncVehicle | None = None
        """The asynchronous vehicle, once it was found."""
        self._tasks: Background | None = None
        self._latest: dict[type[Message], Latest[Any]] = {}
        self.at_start: list[Callable[[], None]] = []
        """What is called on the loop when the vehicle is found."""
        self._is_silent = False

    # --------------------------------------------------------------------------------- state

    @property
    def target_system(self) -> int:
        """System id of the vehicle, 0 before it was heard."""
        return self.handler.target_system

    @property
    def aio(self) -> AsyncVehicle:
        """The asynchronous vehicle; APIException before it was found."""
        if self.found is None:
            raise APIException("the vehicle is not connected yet: call initialize()")
        return self.found

    def check_link(self) -> AsyncVehicle:
        """The asynchronous vehicle; APIException unless it can be talked to."""
        aio = self.aio
        if self.handler.is_closed:
            raise APIException("the vehicle was closed")
        with classic_errors():
            aio.connection.raise_if_ended()
        age = aio.heartbeat_age
        if self.heartbeat_limit_s and age > self.heartbeat_limit_s:
            raise APIException(f"no heartbeat of the vehicle for {age:.0f} s")
        return aio

    # ------------------------------------------------------------------------------- hearing

    def on(
        self,
        message_type: type[MessageT],
        handler: Callable[[MessageT], object],
        *names: str,
        listeners: Listeners | None = None,
    ) -> Latest[MessageT]:
        """Have a handler called with messages of the autopilot (loop thread, weakly); returns what has the latest one.

        If it does nothing but tell ``names``, attributes of the vehicle, and to ``listeners`` of others, it is called
        only where somebody may want to know.
        """
        if message_type not in self._latest:
            self._latest[message_type] = Latest(message_type, self.ready.names, self.listeners)
        latest = self._latest[message_type]
        latest.add(handler, names, listeners)
        return latest

    def announce(self, message_type: type[MessageT], *names: str) -> Latest[MessageT]:
        """Have messages of this kind told as these attributes; returns what has the latest one."""

        def announce(_: MessageT) -> None:
            for name in names:
                self.listeners.announce(name)

        return self.on(message_type, announce, *names)

    def begin(self, aio: AsyncVehicle, tasks: Background) -> None:
        """The vehicle was found (loop thread): hear what the parts want to; the loop gets weak references only."""
        self.found, self._tasks = aio, tasks
        self.handler.target_system = aio.system_id
        _ = aio.parameters  # made first: its table takes a value before the parts here are told of it
        for message_type, latest in self._latest.items():
            latest.component_id = aio.component_id
            aio.connection.bus.attach_lazily(message_type, weakly(latest.take), system_id=aio.system_id)

    def watch_link(self) -> None:
        """Tell how old the last heartbeat is, 20 times a second if somebody listens; log a silence, and its end."""
        aio = self.aio
        if not aio.connection.is_open:
            return
        age = aio.heartbeat_age
        self.listeners.tell("last_heartbeat", age)
        if (age > SILENT_AFTER_S) != self._is_silent:
            self._is_silent = not self._is_silent
            post = self.handler.listener_thread.post  # the program's log handlers may take their time
            if self._is_silent:
                post(self.logger.warning, "Link timeout, no heartbeat in last %d seconds", SILENT_AFTER_S)
            else:
                post(self.logger.info, "...link restored.")
        # Each tick wakes a sleeping process, which costs as much as a few messages.
        is_told = self._is_silent or self.listeners.heed("last_heartbeat")
        wait_s = TICK_S if is_told else max(TICK_S, min(IDLE_TICK_S, SILENT_AFTER_S - age))
        asyncio.get_running_loop().call_later(wait_s, weakly(self.watch_link))

    def background(self, function: Callable[[], Awaitable[None]]) -> None:
        """Run a coroutine function for as long as the vehicle is connected (loop thread)."""
        if self._tasks is not None:
            self._tasks.start(function, f"dronekit {getattr(function, '__name__', 'task')}")

    # ------------------------------------------------------------------------------- sending

    def run(self, function: Callable[..., Awaitable[Any]], *args: Any, **kwargs: Any) -> Any:
        """Wait for a coroutine function on the loop; what it raises becomes DroneKit's errors."""
        self.check_link()
        with classic_errors():
            return self.handler.loop.run(function, *args, **kwargs)

    def order(self, kind: str, function: Work, *args: Any, **kwargs: Any) -> BackgroundCall:
        """Give an order without waiting; a newer one of its kind replaces it."""
        self.check_link()
        with classic_errors():
            return self.handler.calls.give(kind, function, *args, **kwargs)

    def command(self, kind: str, command: int, *params: float, **options: Any) -> BackgroundCall:
        """Order that a command is sent to all components, of which the autopilot's answer counts."""
        options.setdefault("retries", attempts_of(command, params) - 1)
        return self.order(kind, self.check_link().command, command, *params, component_id=0, **options)

    def send(self, message: Message) -> None:
        """Send a message once, in the order of the calls."""
        self.check_link()
        self.handler.send(message)


def _feeding(read: property) -> property:
    """The same property, of which each reading shows that the program runs."""
    getter = read.fget
    assert getter is not None

    @functools.wraps(getter)
    def fed(vehicle: VehicleCore) -> Any:
        vehicle._dk.handler.loop.feed()
        return getter(vehicle)

    return property(fed, read.fset, read.fdel, read.__doc__)


class VehicleCore(HasObservers):
    """A vehicle and its core. ``_dk``: names that no subclass in the classic style takes for its own things."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.__module__.startswith("aerokit."):
            for name, member in list(vars(cls).items()):
                if isinstance(member, property) and not name.startswith("_"):
                    setattr(cls, name, _feeding(member))

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
        """Wait until these attributes have values; without names, or with True, for those that most programs need.

        Args:
            types: names of attributes, your own too; ``wait_ready(True)`` is ``'parameters'``, ``'gps_0'``,
                ``'armed'``, ``'mode'`` and ``'attitude'``.
            timeout: seconds; None waits as long as the link lives.
            raise_exception: whether to raise when the time is over.
            still_waiting_callback: called with the names that are missing.
            still_waiting_interval: how often, in seconds.

        Returns:
            Whether all of them have values.

        Raises:
            TimeoutError: they have not in time, and ``raise_exception`` is true.
            ValueError: a name is no text.
            APIException: the link is down, or what is waited for has failed.
        """
        names = DEFAULT_ATTRIBUTES if not types or types == (True,) else types
        if not all(isinstance(name, str) for name in names):
            raise ValueError("wait_ready expects one or more string arguments.")
        wanted = {str(name) for name in names}
        ready = self._dk.ready
        started = told_at = time.monotonic()
        deadline = math.inf if timeout is None else started + timeout
        while missing := wanted - ready.names:
            now = time.monotonic()
            if now >= deadline:
                if raise_exception:
                    error = TimeoutError(f"wait_ready experienced a timeout after {timeout} seconds.")
                    raise error from LookupError(f"never told: {', '.join(sorted(missing))}")
                return False
            self._dk.check_link()
            if (failure := ready.failure_of(missing)) is not None:
                if raise_exception:
                    raise type(failure)(str(failure)) from failure.__cause__
                return False
            for name in ready.seekers.keys() & missing:
                ready.seekers[name]()
            if still_waiting_callback is not None and now >= told_at + still_waiting_interval:
                told_at = now
                still_waiting_callback(missing)
            ready.wait_a_little(wanted, deadline - now)
        return True


def core_of(vehicle: VehicleCore) -> Core:
    """The core of a vehicle, for its parts: their constructors have DroneKit's argument."""
    return vehicle._dk
