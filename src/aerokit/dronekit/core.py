"""``Core``: the connection underneath a classic vehicle, as all its parts use it."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name
from aerokit.dronekit.observers import HasObservers, Listeners
from aerokit.dronekit.readiness import Readiness
from aerokit.dronekit.weakly import weakly
from aerokit.errors import AerokitError, LocalProtocolError, OperationTimeout

if TYPE_CHECKING:
    import concurrent.futures
    from collections.abc import Awaitable, Callable
    from contextlib import ExitStack

    from aerokit.dronekit.mavlink import MAVConnection
    from aerokit.dronekit.reception import Stream
    from aerokit.mavlink.message import Message
    from aerokit.runtime.background import Background
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["Core", "VehicleCore", "core_of"]

DEFAULT_ATTRIBUTES = ("parameters", "gps_0", "armed", "mode", "attitude")
"""What ``wait_ready(True)`` waits for."""


class Core:
    """What is sent, waited for and heard by way of the asynchronous vehicle, once there is one, and what is told of it.

    The parts of a vehicle know this, and not the vehicle.
    """

    def __init__(self, handler: MAVConnection, owner: object) -> None:
        self.handler = handler
        self.logger = logging.getLogger("dronekit")
        self.ready = Readiness(self.check_link, self.review)
        self.listeners = Listeners(owner, handler.listener_thread, self.ready.note, self.review)
        """Of the vehicle's attributes."""
        self.heartbeat_limit_s = 0.0
        """Longer silences are errors; 0: none is."""
        self.streams: dict[type[Message], Stream] = {}
        """What comes again and again."""
        self._reviewing = threading.Lock()
        self._aio: AsyncVehicle | None = None
        self._tasks: Background | None = None
        self._sinks: list[tuple[type[Message], Callable[[Any], None]]] = []
        self._starters: list[Callable[[ExitStack], None]] = []

    # --------------------------------------------------------------------------------- state

    @property
    def target_system(self) -> int:
        """System id of the vehicle, 0 before it was heard."""
        return self.handler.target_system

    @property
    def is_connected(self) -> bool:
        """Whether the vehicle was found."""
        return self._aio is not None

    @property
    def aio(self) -> AsyncVehicle:
        """The asynchronous vehicle; APIException before it was found."""
        if self._aio is None:
            raise APIException("the vehicle is not connected yet: call initialize()")
        return self._aio

    def check_link(self) -> AsyncVehicle:
        """The asynchronous vehicle; APIException unless it can be talked to."""
        aio = self.aio
        if self.handler.is_closed:
            raise APIException("the vehicle was closed")
        try:
            aio.connection.raise_if_ended()
        except AerokitError as error:
            raise APIException(str(error)) from error
        age = aio.heartbeat_age
        if self.heartbeat_limit_s and age > self.heartbeat_limit_s:
            raise APIException(f"no heartbeat of the vehicle for {age:.0f} s")
        return aio

    # ------------------------------------------------------------------------------- hearing

    def on(self, message_type: type[Message], handler: Callable[[Any], None]) -> None:
        """Have a handler called with messages of the autopilot (loop thread, weakly)."""
        stream = self.streams.get(message_type)
        if stream is None:
            self._sinks.append((message_type, handler))
        else:
            stream.add(handler)

    def review(self) -> None:
        """Messages are looked at when they come only as long as somebody listens; from any thread."""
        with self._reviewing:
            for stream in self.streams.values():
                stream.review(self.ready.names, self.listeners.by_name)

    def at_start(self, function: Callable[[ExitStack], None]) -> None:
        """Have a function called on the loop when the vehicle is found; what it puts into the stack is its end."""
        self._starters.append(function)

    def begin(self, aio: AsyncVehicle, tasks: Background) -> None:
        """The vehicle was found (loop thread)."""
        self._aio, self._tasks = aio, tasks
        self.handler.target_system = aio.system_id

    def hear(self, ends: ExitStack) -> None:
        """Begin to hear what the parts want to; the loop gets weak references only."""
        aio = self.aio
        bus, own = aio.connection.bus, aio.component_id
        for message_type, stream in self.streams.items():
            stream.begin(own)
            ends.callback(bus.attach_frames(message_type, weakly(stream.take), system_id=aio.system_id))
        for message_type, handler in self._sinks:
            take = _only_of(own, weakly(handler))
            ends.callback(bus.attach(message_type, take, system_id=aio.system_id))

    def start_parts(self, ends: ExitStack) -> None:
        """Call what waits for the vehicle (loop thread)."""
        for starter in self._starters:
            starter(ends)

    def background(self, function: Callable[[], Awaitable[None]]) -> None:
        """Run a coroutine function for as long as the vehicle is connected (loop thread)."""
        if self._tasks is not None:
            self._tasks.start(function, f"dronekit {getattr(function, '__name__', 'task')}")

    # ------------------------------------------------------------------------------- sending

    def run(self, function: Callable[..., Awaitable[Any]], *args: Any, **kwargs: Any) -> Any:
        """Wait for a coroutine function on the loop; what it raises becomes DroneKit's errors."""
        self.check_link()
        try:
            return self.handler.loop.run(function, *args, **kwargs)
        except LocalProtocolError:
            raise
        except OperationTimeout as error:
            raise TimeoutError(str(error)) from error
        except AerokitError as error:
            raise APIException(str(error)) from error

    def order(
        self, kind: str, function: Callable[..., Awaitable[object]], *args: Any, **kwargs: Any
    ) -> concurrent.futures.Future[None]:
        """Give an order without waiting; a newer one of its kind replaces it."""
        self.check_link()
        try:
            return self.handler.orders.give(kind, function, *args, **kwargs)
        except AerokitError as error:
            raise APIException(str(error)) from error

    def send(self, message: Message) -> None:
        """Send a message once, in the order of the calls."""
        self.check_link()
        self.handler.send(message)

    def pause(self, seconds: float) -> None:
        """Sleep, unless the vehicle is closed meanwhile."""
        self.handler.wait_closed(seconds)


class VehicleCore(HasObservers):
    """A vehicle and its core.

    ``_dk``: names that no subclass in the classic style takes for its own things.
    """

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
        return self._dk.ready.wait(
            wanted, timeout, raise_exception, still_waiting_callback, still_waiting_interval
        )


def core_of(vehicle: VehicleCore) -> Core:
    """The core of a vehicle, for its parts: their constructors have DroneKit's argument."""
    return vehicle._dk


def _only_of(component_id: int, handler: Callable[[Any], None]) -> Callable[[Any], None]:
    """Other components of the system (gimbals, companions) have no say in the autopilot's state."""

    def take(message: Any) -> None:
        if message.received_frame.component_id == component_id:
            handler(message)

    return take
