"""``Vehicle`` and ``connect`` of the classic API, on top of ``aerokit.sync``."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import asynccontextmanager, nullcontext
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import anyio

from aerokit.connection.heartbeats import OwnHeartbeat
from aerokit.connection.tasks import BackgroundTasks
from aerokit.dronekit.attributes import NO_MODE
from aerokit.dronekit.channels import Channels
from aerokit.dronekit.classic_connection import weak_callback
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name
from aerokit.dronekit.flight import FlightMethods
from aerokit.dronekit.flight_orders import Maintenance, mode_name
from aerokit.dronekit.gimbal import Gimbal
from aerokit.dronekit.observers import MessageListeners, listener_decorator
from aerokit.dronekit.parameters import Parameters
from aerokit.dronekit.privates import OverridableProperty, VehiclePrivates
from aerokit.dronekit.util import ErrprinterHandler
from aerokit.errors import AerokitError, ConnectFailed
from aerokit.mavlink.enums import MavCmd
from aerokit.protocols.command import command_long
from aerokit.vehicle.connect import connect as connect_async

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable

    from typing_extensions import Self, TypeVar

    from aerokit import sync
    from aerokit.connection.connection import Connection
    from aerokit.dronekit.commands import CommandSequence, WaypointLoader
    from aerokit.dronekit.master import Master
    from aerokit.dronekit.mavlink import MAVConnection
    from aerokit.dronekit.observers import AttributeListener
    from aerokit.mavlink.message_factory import MessageFactory
    from aerokit.sync.loop_thread import OpenContext
    from aerokit.vehicle.state.condition import StatusText
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

    VehicleT = TypeVar("VehicleT", bound="Vehicle", default="Vehicle")

FIRST_VALUES = ("attitude", "location.global_relative_frame", "heading", "gps_0", "battery")

# DroneKit programs read attributes right after connect(), which therefore waits up to FIRST_VALUES_TIMEOUT_S for the
# first telemetry. Not every vehicle reports every value, so the wait also ends if no value arrives for
# NEXT_VALUE_TIMEOUT_S.
FIRST_VALUES_TIMEOUT_S, NEXT_VALUE_TIMEOUT_S = 1.0, 0.4

CONNECT_TIMEOUT_S = 30.0

MAX_STREAM_RATE_HZ = 1000.0

# Maps MAV_SEVERITY (the index) to levels of the logger `autopilot`.
LEVELS = (logging.CRITICAL,) * 3 + (logging.ERROR, logging.WARNING, logging.INFO, logging.INFO, logging.DEBUG)


class Vehicle(FlightMethods, Maintenance, VehiclePrivates):
    """A vehicle: its attributes and their listeners, orders, parameters and missions.

    :func:`connect` creates it. ``connect(…, vehicle_class=MyVehicle)`` creates a ``MyVehicle``, a subclass of this
    class. The constructor of ``MyVehicle`` gets one argument and must pass it to the constructor of this class. The
    constructor may add listeners and attributes.

    The vehicle can be used from any thread. Listeners run one after the other on a separate thread, and may use the
    vehicle, too. The vehicle is a context manager; :meth:`close` closes the connection.
    """

    def __init__(self, handler: MAVConnection) -> None:
        super().__init__(handler)
        # None before initialize().
        self._dk_context: OpenContext[AsyncVehicle] | None = None
        self._dk_sync: sync.Vehicle | None = None
        self._dk_initializing = threading.Lock()
        self._message_listeners = MessageListeners(self, handler)
        self._channels = Channels(self, count=8)
        self._gimbal = Gimbal(self)
        self._parameters = Parameters(self)
        self._dk.ready.mark("commands")  # Until download() is called, an empty mission is a valid value of `commands`.

    # --------------------------------------------------------------------------------- parts

    @property
    def channels(self) -> Channels:
        """RC channels by number. Set ``vehicle.channels.overrides`` to override them."""
        return self._channels

    @property
    def gimbal(self) -> Gimbal:
        """The gimbal: its attitude, and orders to turn it."""
        return self._gimbal

    @property
    def mount_status(self) -> list[float | None]:
        """``[pitch, yaw, roll]`` of the gimbal in degrees; see :attr:`gimbal`."""
        return self._gimbal.mount_status

    @property
    def parameters(self) -> Parameters:
        """The autopilot's parameters as a mapping of names to values."""
        return self._parameters

    @cached_property
    def _commands(self) -> CommandSequence:
        # Imported here, because it imports pymavlink, which programs without missions do not need.
        from aerokit.dronekit.commands import CommandSequence

        # Two threads may get here at the same time; setdefault returns the same object to both.
        commands: CommandSequence = self.__dict__.setdefault("_commands", CommandSequence(self))
        return commands

    @property
    def commands(self) -> CommandSequence:
        """The vehicle's mission, to download, change and upload."""
        return self._commands

    @property
    def _params_map(self) -> dict[str, float]:
        return self._parameters.known_values()

    @property
    def _wploader(self) -> WaypointLoader:
        from aerokit.dronekit.commands import WaypointLoader

        return WaypointLoader(self._commands)

    def flush(self) -> None:
        """Upload the mission; same as ``commands.upload()``."""
        self._commands.upload()

    @OverridableProperty
    def aio(self) -> AsyncVehicle:
        """The asynchronous vehicle (:class:`aerokit.Vehicle`), for coroutines on its loop.

        Its state values (``vehicle.aio.position.latest``) can be read from any thread. :meth:`run` runs a coroutine
        function on its loop. Raises APIException before the vehicle is connected.
        """
        return self._dk.aio

    @OverridableProperty
    def sync(self) -> sync.Vehicle:
        """This vehicle as an :class:`aerokit.sync.Vehicle`, aerokit's blocking API, on the same connection.

        A program can use both APIs side by side, and so move to the blocking API one call at a time. For example, use
        ``vehicle.sync.take_off(10)`` in place of ``vehicle.simple_takeoff(10)``: it returns at that altitude. Raises
        APIException before the vehicle is connected.
        """
        if self._dk_context is None:
            raise APIException("the vehicle is not connected yet: call initialize()")
        if self._dk_sync is None:
            from aerokit.sync import Vehicle

            self._dk_sync = Vehicle(self._handler.loop, self._dk_context, owns_loop=False)
        return self._dk_sync

    def run(self, function: Callable[..., Awaitable[Any]], /, *args: Any, **kwargs: Any) -> Any:
        """Await a coroutine function on the vehicle's loop: ``vehicle.run(survey, vehicle.aio)``.

        Ctrl-C cancels the coroutine. Exceptions of the coroutine propagate unchanged.
        """
        return self._handler.loop.run(function, *args, **kwargs)

    # ------------------------------------------------------------------------------ messages

    def add_message_listener(self, name: str, fn: AttributeListener) -> None:
        """Call ``fn(vehicle, name, message)`` for every message of this name (``'*'``: every message).

        Messages are objects of pymavlink. Attributes are updated before the call.
        """
        self._message_listeners.add(name, fn)

    def remove_message_listener(self, name: str, fn: AttributeListener) -> None:
        """Remove a listener; ignored if the listener is not registered."""
        self._message_listeners.remove(name, fn)

    def on_message(self, name: str | list[str] | tuple[str, ...]) -> Callable[[AttributeListener], AttributeListener]:
        """Decorator: add a message listener for one name or a list of names."""
        return listener_decorator(self.add_message_listener, name)

    def notify_message_listeners(self, name: str, msg: Any) -> None:
        """Call the listeners of a message as if the message was received, and wait until they return."""
        self._message_listeners.notify(name, msg, waits=True)

    @property
    def message_factory(self) -> MessageFactory:
        """Creates pymavlink's messages for :meth:`send_mavlink`: ``vehicle.message_factory.command_long_encode(…)``."""
        return self._handler.master.mav

    def send_mavlink(self, message: Any) -> None:
        """Send a message made by :attr:`message_factory`, pymavlink or ``aerokit.messages`` once, without blocking.

        Sets ``target_system`` in the message to this vehicle; ``target_component`` stays. Raises InvalidArgument (a
        ValueError) for a wrong field, and APIException while the link is down; in both cases nothing was sent.
        """
        from aerokit.mavlink.pymavlink import from_pymavlink

        self._dk.check_link()
        target = self._dk.target_system
        self._handler.send(from_pymavlink(message, target), to=target)

    # ---------------------------------------------------------------------------- life cycle

    def initialize(self, rate: float | None = 4, heartbeat_timeout: float = 30) -> None:
        """Wait for the vehicle's first heartbeat and start receiving; :func:`connect` calls it.

        Args:
            rate: Hz of the requested data streams; None requests none.
            heartbeat_timeout: seconds to wait for the first heartbeat. In addition, calls raise APIException when no
                heartbeat has arrived for this many seconds. With 0 or less, the first heartbeat is awaited for 30 s,
                and calls do not raise for missing heartbeats.

        Raises:
            APIException: no vehicle was found in time; the text describes what was received instead.
        """
        heartbeat_limit_s = max(heartbeat_timeout or 0.0, 0.0)
        timeout = heartbeat_limit_s or CONNECT_TIMEOUT_S
        with self._dk_initializing:
            if self._dk.aio_or_none is not None:  # An earlier call has connected the vehicle.
                self._dk_wait_until_booted(timeout)
                return
            self._dk.heartbeat_limit_s = heartbeat_limit_s
            try:
                connected = _connected(self._handler.connection, timeout, weak_callback(self._dk_begin), rate)
                self._dk_context = self._handler.loop.open_context(connected)
                self._dk_wait_until_booted(timeout)
                if rate is not None:
                    self._dk_wait_for_first_values()
            except ConnectFailed as error:
                raise APIException(f"Timeout in initializing connection. {error}") from None
            except AerokitError as error:
                raise APIException(str(error)) from None

    def close(self) -> None:
        """Wait up to two seconds for answers to recent orders, then close the link and end the threads.

        Idempotent; can be called from any thread, including callbacks. Releases overridden RC channels
        (``connect(release_overrides=)``) and sends nothing else, so a vehicle in the air continues as before. Calls
        that wait in other threads raise APIException.
        """
        self._handler.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _master(self) -> Master:
        return self._handler.master

    def _is_mode_available(self, mode_code: int, base_mode: int = 0) -> bool:
        # The name of an unknown mode ends with its number.
        return not mode_name(self._dk.aio, mode_code).endswith(f" {mode_code}")

    def _dk_begin(self, aio: AsyncVehicle, tasks: BackgroundTasks) -> None:
        """Start receiving. Called on the loop as soon as the vehicle is found, so that no message is missed."""
        core = self._dk
        core.start_receiving(aio, tasks)
        self._handler.vehicle = self
        self._handler.on_sent = aio.note_sent
        self._handler.calls.describe = self._dk_describe
        # The event loop keeps these callbacks, so weak references let the vehicle be garbage collected. `_handler` may
        # have strong ones, because it belongs to this vehicle.
        aio.telemetry.status_text.observe(weak_callback(self._dk_on_status_text), every_arrival=True)
        aio._session.on_reboot.append(weak_callback(self._dk_on_reboot))
        # The heartbeat that revealed the vehicle arrived before the handlers were attached, so it is handled here.
        first_heartbeat = aio.connection.heartbeats.get((aio.system_id, aio.component_id))
        if first_heartbeat is not None:
            self._dk_on_heartbeat(first_heartbeat)
        self._message_listeners.start()
        core.background(lambda: _request_capabilities(aio))
        core.watch_link()
        for function in core.on_connected:
            function()

    def _dk_on_status_text(self, _: StatusText | None, text: StatusText) -> None:
        level = LEVELS[min(text.severity, len(LEVELS) - 1)]
        if self._autopilot_logger.isEnabledFor(level):
            self._handler.listener_thread.post(self._autopilot_logger.log, level, "%s", text.text.strip())

    def _dk_describe(self) -> str:
        return f"the vehicle is {'armed' if self._armed else 'disarmed'}, in {self._flightmode}"

    def _dk_wait_for_first_values(self) -> None:
        """Wait until all attributes in FIRST_VALUES have values, or until values stop arriving."""
        names, ready = set[str](FIRST_VALUES), self._dk.ready
        now = time.monotonic()
        deadline = now + FIRST_VALUES_TIMEOUT_S
        next_value_deadline = deadline  # NEXT_VALUE_TIMEOUT_S applies after the first value.
        missing_before = names
        while (missing := names - ready.names) and now < min(deadline, next_value_deadline):
            if len(missing) < len(missing_before):  # Another value has arrived.
                missing_before = missing
                next_value_deadline = now + NEXT_VALUE_TIMEOUT_S
            ready.wait_for_change(names, min(deadline, next_value_deadline) - now)
            now = time.monotonic()

    def _dk_wait_until_booted(self, timeout: float) -> None:
        try:
            self.wait_for(lambda: self._flightmode not in NO_MODE, timeout)
        except TimeoutError:
            raise APIException(
                f"Timeout in initializing connection. The vehicle is still in mode {self._flightmode}"
            ) from None


@asynccontextmanager
async def _connected(
    connection: Connection, timeout: float, on_connected: Callable[..., None], rate: float | None
) -> AsyncIterator[AsyncVehicle]:
    """Connect, call ``on_connected``, and request streams. Runs in the event loop's thread."""
    async with connect_async(connection, timeout=timeout, rates={}) as aio:
        tasks = BackgroundTasks(connection.fail)
        rate_hz: float | None = None
        if rate is not None:
            # DroneKit accepts a rate of 0 or less, but aio.streams() does not; 1 Hz is requested instead.
            rate_hz = min(rate, MAX_STREAM_RATE_HZ) if rate > 0 else 1.0
        try:
            # `on_connected` is a weak callback, so that this coroutine does not keep the vehicle alive.
            on_connected(aio, tasks)
            with nullcontext() if rate_hz is None else aio.streams(rate_hz):
                yield aio
        finally:
            await tasks.aclose()


async def _request_capabilities(aio: AsyncVehicle) -> None:
    # Old firmware sends its version only after this command, which is repeated until the version arrives.
    for _ in range(5):
        if aio.telemetry.version.is_known:
            return
        aio.send(command_long(aio.system_id, 0, MavCmd.REQUEST_AUTOPILOT_CAPABILITIES, (1,)))
        await anyio.sleep(1.0)


def default_still_waiting_callback(atts: Iterable[str]) -> None:
    """Log the names of missing attributes with the logger ``dronekit``, at level DEBUG."""
    logging.getLogger("dronekit").debug("Still waiting for data from vehicle: %s", ",".join(sorted(atts)))


def connect(
    ip: str,
    _initialize: bool = True,
    wait_ready: bool | str | Iterable[str] | None = None,
    timeout: float = 30,
    still_waiting_callback: Callable[[Any], object] = default_still_waiting_callback,
    still_waiting_interval: float = 1,
    status_printer: Callable[[str], object] | None = None,
    vehicle_class: Callable[[MAVConnection], VehicleT] | None = None,
    rate: float | None = 4,
    baud: int = 115200,
    heartbeat_timeout: float = 30,
    source_system: int = 255,
    source_component: int = 0,
    use_native: bool = False,
    release_overrides: bool = True,
    heartbeat: OwnHeartbeat | None = OwnHeartbeat(),  # noqa: B008 - it is immutable
) -> VehicleT:
    """Connect to a vehicle and return it after its first heartbeat.

    Args:
        ip: connection string, such as ``'127.0.0.1:14550'`` or ``'udp:…'``, which both listen,
            ``'tcp:127.0.0.1:5760'``, ``'/dev/ttyACM0'`` or ``'com14'`` (docs/addresses.md).
        _initialize: False to return before the first heartbeat; then call :meth:`Vehicle.initialize`.
        wait_ready: True waits for ``parameters``, ``gps_0``, ``armed``, ``mode`` and ``attitude``; a name or a list of
            names waits for these attributes. With None or False, ``connect`` does not wait.
        timeout: seconds for ``wait_ready``.
        still_waiting_callback: called with the set of missing names.
        still_waiting_interval: seconds between these calls.
        status_printer: called on the listener thread, until the vehicle is closed, with every STATUSTEXT of the
            autopilot that the level of the logger ``autopilot`` allows (by default, severity WARNING and above).
        vehicle_class: a subclass of :class:`Vehicle`.
        rate: Hz of the requested data streams; None requests none.
        baud: bits per second, for a serial port whose string has no baud rate.
        heartbeat_timeout: seconds to wait for the first heartbeat; 0 means 30 s. Later, orders and waits raise
            APIException after this many seconds without a heartbeat; 0 means never.
        source_system: own system id, 1 to 255.
        source_component: own component id, 0 to 255.
        use_native: ignored.
        release_overrides: release RC channels that are still overridden when the connection ends. With False, overrides
            stay, as in DroneKit, until the vehicle ends them (ArduPilot: after RC_OVERRIDE_TIME).
        heartbeat: content of our HEARTBEAT; None sends none. Our HEARTBEAT stops when the program has done nothing for
            60 s (see :class:`aerokit.OwnHeartbeat`): no attribute read, no order, no wait, no return from a listener.

    Raises:
        OSError: the link cannot be opened (ConnectionRefusedError, socket.gaierror, serial.SerialException …).
        ValueError: an argument is wrong; for an invalid connection string also an OSError.
        APIException: no vehicle was found in time; the text describes what was received instead.
        TimeoutError: a value for ``wait_ready`` did not arrive in time. On any error, the connection is closed.
    """
    from aerokit.dronekit.mavlink import MAVConnection

    try:
        handler = MAVConnection(
            ip,
            baud=baud,
            source_system=source_system,
            source_component=source_component,
            use_native=use_native,
            heartbeat=heartbeat,
        )
    except (OSError, ValueError, KeyboardInterrupt) as error:
        raise error.with_traceback(None) from None  # Frames of this package do not help the user.
    handler.overrides.is_enabled = release_overrides
    try:
        vehicle = cast("VehicleT", Vehicle(handler)) if vehicle_class is None else vehicle_class(handler)
        if status_printer is not None:
            _print_texts(handler, status_printer)
            handler.listener_thread.keep_alive(vehicle, has_listeners=True)
        if _initialize:
            vehicle.initialize(rate=rate, heartbeat_timeout=heartbeat_timeout)
        if wait_ready:
            names = (wait_ready,) if isinstance(wait_ready, (bool, str)) else wait_ready
            vehicle.wait_ready(
                *names,
                timeout=timeout,
                still_waiting_callback=still_waiting_callback,
                still_waiting_interval=still_waiting_interval,
            )
    except BaseException as error:
        handler.close()
        if isinstance(error, KeyboardInterrupt) and vehicle_class is None:
            # After Ctrl-C, a traceback through this package would not help the user.
            raise error.with_traceback(None) from error.__cause__
        raise
    return vehicle


def _print_texts(handler: MAVConnection, status_printer: Callable[[str], object]) -> None:
    # As in DroneKit, the printer is a handler of the logger `autopilot`, so that the logger's level applies.
    logger, printer = logging.getLogger("autopilot"), ErrprinterHandler(status_printer)
    logger.addHandler(printer)
    handler.on_close(lambda: logger.removeHandler(printer))
