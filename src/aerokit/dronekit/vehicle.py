"""``Vehicle``: the classic API, spelled on top of ``aerokit.sync``."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import asynccontextmanager, nullcontext
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import anyio

from aerokit.connection.own_heartbeat import OwnHeartbeat
from aerokit.connection.tasks import Background
from aerokit.dronekit.attributes import NO_MODE
from aerokit.dronekit.channels import Channels
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name
from aerokit.dronekit.flight import FlightMethods
from aerokit.dronekit.flight_orders import Maintenance, mode_name
from aerokit.dronekit.gimbal import Gimbal
from aerokit.dronekit.line import weakly
from aerokit.dronekit.observers import MessageListeners, decorator_of
from aerokit.dronekit.parameters import Parameters
from aerokit.dronekit.privates import Shadowable, VehiclePrivates
from aerokit.dronekit.util import ErrprinterHandler
from aerokit.errors import AerokitError, ConnectFailed
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import CommandLong
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
    from aerokit.sync.loop_thread import Held
    from aerokit.vehicle.state.condition import StatusText
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

    VehicleT = TypeVar("VehicleT", bound="Vehicle", default="Vehicle")

FIRST_VALUES = ("attitude", "location.global_relative_frame", "heading", "gps_0", "battery")

FIRST_VALUES_S, NO_MORE_S = 1.0, 0.4
"""So long they are waited for: programs that read them as soon as they are connected expect values. Not every vehicle
has all of them: when one has come, the next is not waited for longer than the second time."""

CONNECT_S = 30.0
"""How long a vehicle is waited for when the program sets no limit."""

MOST_HZ = 1000.0

LEVELS = (logging.CRITICAL,) * 3 + (logging.ERROR, logging.WARNING, logging.INFO, logging.INFO, logging.DEBUG)
"""MAV_SEVERITY → level of the logger ``autopilot``."""


class Vehicle(FlightMethods, Maintenance, VehiclePrivates):
    """A vehicle: attributes to read and to listen to, orders, parameters, missions.

    Made by :func:`connect`, or of a subclass by ``connect(…, vehicle_class=…)``: the subclass passes on the one
    argument it gets, and may add listeners and attributes of its own. Any thread may use it; callbacks run in order
    on a thread of their own and may use it too. A context manager; :meth:`close` ends it.
    """

    def __init__(self, handler: MAVConnection) -> None:
        super().__init__(handler)
        self._dk_held: Held[AsyncVehicle] | None = None
        self._dk_sync: sync.Vehicle | None = None
        self._dk_initializing = threading.Lock()
        self._message_listeners = MessageListeners(self, handler)
        self._channels = Channels(self, 8)
        self._gimbal = Gimbal(self)
        self._parameters = Parameters(self)
        self._dk.ready.mark("commands")

    # --------------------------------------------------------------------------------- parts

    @property
    def channels(self) -> Channels:
        """RC channels by number, and ``.overrides`` of them."""
        return self._channels

    @property
    def gimbal(self) -> Gimbal:
        """The gimbal: where it points, and orders to it."""
        return self._gimbal

    @property
    def mount_status(self) -> list[float | None]:
        """``[pitch, yaw, roll]`` of the gimbal in degrees; use :attr:`gimbal`."""
        return self._gimbal.mount_status

    @property
    def parameters(self) -> Parameters:
        """The autopilot's parameters, as a mapping of names to values."""
        return self._parameters

    @cached_property
    def _commands(self) -> CommandSequence:
        # with pymavlink: programs without missions do without
        from aerokit.dronekit.commands import CommandSequence

        made: CommandSequence = self.__dict__.setdefault("_commands", CommandSequence(self))
        return made

    @property
    def commands(self) -> CommandSequence:
        """The mission: download, change, upload."""
        return self._commands

    @property
    def _params_map(self) -> dict[str, float]:
        return self._parameters.known_values()

    @property
    def _wploader(self) -> WaypointLoader:
        from aerokit.dronekit.commands import WaypointLoader

        return WaypointLoader(self._commands)

    def flush(self) -> None:
        """As ``commands.upload()``."""
        self._commands.upload()

    @Shadowable
    def aio(self) -> AsyncVehicle:
        """The asynchronous vehicle (:class:`aerokit.Vehicle`) underneath, for coroutines on its own loop.

        Its state cells (``vehicle.aio.position.latest``) may be read from any thread; :meth:`run` runs coroutines.
        APIException as long as the vehicle is not connected.
        """
        return self._dk.aio

    @Shadowable
    def sync(self) -> sync.Vehicle:
        """The blocking twin of the new API (:class:`aerokit.sync.Vehicle`) on the same connection.

        A program moves over function by function: ``vehicle.sync.take_off(10)`` returns at altitude. APIException as
        long as the vehicle is not connected.
        """
        if self._dk_held is None:
            raise APIException("the vehicle is not connected yet: call initialize()")
        if self._dk_sync is None:
            from aerokit.sync import Vehicle  # for programs that use it

            self._dk_sync = Vehicle(self._handler.loop, self._dk_held, owns_loop=False)
        return self._dk_sync

    def run(self, function: Callable[..., Awaitable[Any]], /, *args: Any, **kwargs: Any) -> Any:
        """Await a coroutine function on the vehicle's loop: ``vehicle.run(survey, vehicle.aio)``; Ctrl-C cancels it.

        What it raises comes out as it is.
        """
        return self._handler.loop.run(function, *args, **kwargs)

    # ------------------------------------------------------------------------------ messages

    def add_message_listener(self, name: str, fn: AttributeListener) -> None:
        """Have ``fn(vehicle, name, message)`` called for every message of this name (``'*'``: every message).

        Messages are objects of pymavlink. Attributes hold what the message says by the time it is called.
        """
        self._message_listeners.add(name, fn)

    def remove_message_listener(self, name: str, fn: AttributeListener) -> None:
        """Call it no more; silent when it does not listen."""
        self._message_listeners.remove(name, fn)

    def on_message(
        self, name: str | list[str] | tuple[str, ...]
    ) -> Callable[[AttributeListener], AttributeListener]:
        """Decorate a message listener with the name, or the list of names, of messages it listens to."""
        return decorator_of(self.add_message_listener, name)

    def notify_message_listeners(self, name: str, msg: Any) -> None:
        """Call the listeners of a message, as if it had come; returns when they have run."""
        self._message_listeners.tell(name, msg, waits=True)

    @property
    def message_factory(self) -> MessageFactory:
        """Makes pymavlink messages: ``vehicle.message_factory.command_long_encode(…)``, for :meth:`send_mavlink`."""
        return self._handler.master.mav

    def send_mavlink(self, message: Any) -> None:
        """Send a message made by :attr:`message_factory`, by pymavlink or of ``aerokit.messages``, once.

        ``target_system`` becomes this vehicle's, in the message itself; ``target_component`` stays. Never blocks.
        InvalidArgument, a ValueError: a field is wrong; APIException: the link is down. Nothing was sent.
        """
        from aerokit.mavlink.pymavlink import from_pymavlink

        self._dk.check_link()
        target = self._dk.target_system
        self._handler.send(from_pymavlink(message, target), to=target)

    # ---------------------------------------------------------------------------- life cycle

    def initialize(self, rate: float | None = 4, heartbeat_timeout: float = 30) -> None:
        """Wait for the vehicle's first heartbeat and begin to listen; :func:`connect` calls it.

        Args:
            rate: Hz of the data streams to ask for; None asks for none.
            heartbeat_timeout: seconds to wait for the first heartbeat (0 or less: 30), and after which, in flight,
                orders and waits raise APIException until heartbeats come again (0 or less: never).

        Raises:
            APIException: no vehicle was heard in time; the text says what was heard instead.
        """
        with self._dk_initializing:
            if self._dk.found is not None:
                self._dk_wait_until_booted(timeout=max(heartbeat_timeout or 0.0, 0.0) or CONNECT_S)
                return
            self._dk.heartbeat_limit_s = max(heartbeat_timeout or 0.0, 0.0)
            timeout = self._dk.heartbeat_limit_s or CONNECT_S
            try:
                found = _found(self._handler.connection, timeout, weakly(self._dk_begin), rate)
                self._dk_held = self._handler.loop.hold_open(found)
                self._dk_wait_until_booted(timeout)
                if rate is not None:
                    self._dk_wait_for_first_values()
            except ConnectFailed as error:
                raise APIException(f"Timeout in initializing connection. {error}") from None
            except AerokitError as error:
                raise APIException(str(error)) from None

    def close(self) -> None:
        """End it: what was ordered a moment before gets the time to be answered, then link and threads end.

        Idempotent; from any thread, callbacks included. Overridden RC channels are given back to the radio
        (``connect(release_overrides=)``); nothing else is sent: a vehicle in the air goes on with what it does. Calls
        that wait raise APIException.
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
        return not mode_name(self._dk.aio, mode_code).endswith(f" {mode_code}")

    def _dk_begin(self, aio: AsyncVehicle, tasks: Background) -> None:
        """On the loop, in the turn in which the vehicle was found; the loop gets weak references only."""
        core = self._dk
        core.begin(aio, tasks)
        self._handler.vehicle, self._handler.note_sent = self, aio.note_sent
        self._handler.calls.describe = self._dk_describe
        aio.telemetry.status_text.observe(weakly(self._dk_on_status_text), every_arrival=True)
        first = aio.connection.heard.get((aio.system_id, aio.component_id))
        if first is not None:
            self._dk_on_heartbeat(first)
        self._message_listeners.start()
        core.background(lambda: _request_capabilities(aio))
        core.watch_link()
        for function in core.at_start:
            function()

    def _dk_on_status_text(self, before: StatusText | None, text: StatusText) -> None:
        level = LEVELS[min(text.severity, len(LEVELS) - 1)]
        if self._autopilot_logger.isEnabledFor(level):
            self._handler.listener_thread.post(self._autopilot_logger.log, level, "%s", text.text.strip())

    def _dk_describe(self) -> str:
        return f"the vehicle is {'armed' if self._armed else 'disarmed'}, in {self._flightmode}"

    def _dk_wait_for_first_values(self) -> None:
        wanted, ready = set[str](FIRST_VALUES), self._dk.ready
        now = time.monotonic()
        end = no_more_at = now + FIRST_VALUES_S
        missing = wanted
        while (still := wanted - ready.names) and now < min(end, no_more_at):
            if still < missing:  # also what came before anybody waited
                missing, no_more_at = still, now + NO_MORE_S
            ready.wait_a_little(wanted, min(end, no_more_at) - now)
            now = time.monotonic()

    def _dk_wait_until_booted(self, timeout: float) -> None:
        try:
            self.wait_for(lambda: self._flightmode not in NO_MODE, timeout)
        except TimeoutError:
            raise APIException(
                f"Timeout in initializing connection. The vehicle is still in mode {self._flightmode}"
            ) from None


@asynccontextmanager
async def _found(
    connection: Connection, timeout: float, begin: Callable[..., None], rate: float | None
) -> AsyncIterator[AsyncVehicle]:
    """Held open by the loop: nothing of the classic vehicle is in here."""
    async with connect_async(connection, timeout=timeout, rates={}) as aio:
        tasks = Background(connection.fail)
        hz = None if rate is None else min(rate, MOST_HZ) if rate > 0 else 1.0
        try:
            begin(aio, tasks)
            with nullcontext() if hz is None else aio.streams(hz):
                yield aio
        finally:
            await tasks.aclose()


async def _request_capabilities(aio: AsyncVehicle) -> None:
    """As old firmware wants to be asked, with each heartbeat until there is an answer."""
    for _ in range(5):
        if aio.telemetry.version.is_known:
            return
        aio.send(CommandLong(aio.system_id, 0, MavCmd.REQUEST_AUTOPILOT_CAPABILITIES, 0, 1, *(0.0,) * 6))
        await anyio.sleep(1.0)


def default_still_waiting_callback(atts: Iterable[str]) -> None:
    """Log what is still waited for, at level DEBUG of the logger ``dronekit``."""
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
    """Connect to a vehicle and return it once it was heard.

    Args:
        ip: connection string: ``'127.0.0.1:14550'`` and ``'udp:…'`` listen, ``'tcp:127.0.0.1:5760'``,
            ``'/dev/ttyACM0'``, ``'com14'`` … (docs/addresses.md).
        wait_ready: True waits for ``parameters``, ``gps_0``, ``armed``, ``mode`` and ``attitude``; a list of names for
            these; nothing is waited for otherwise.
        timeout: seconds for ``wait_ready``.
        still_waiting_callback: called with the set of missing names.
        still_waiting_interval: how often, in seconds.
        status_printer: called with every text of the autopilot, on the listener thread, until the vehicle is closed.
        vehicle_class: a subclass of :class:`Vehicle`.
        rate: Hz of the data streams that are asked for; None asks for none.
        baud: of a serial port whose string names none, bits per second.
        heartbeat_timeout: seconds to wait for the first heartbeat (0: 30), and in flight until orders and waits raise
            (0: never).
        source_system: our own system id, 1 to 255.
        source_component: our own component id, 0 to 255.
        use_native: accepted; means nothing.
        release_overrides: give RC channels that are still overridden back to the radio when the connection ends. False
            leaves them as DroneKit does, until the vehicle gives them up (ArduPilot: RC_OVERRIDE_TIME).
        heartbeat: what our own HEARTBEAT says, and how long it is sent without a sign of the program: reading an
            attribute, an order, a wait, a listener that is called (60 seconds; :class:`aerokit.OwnHeartbeat`). None:
            none is sent.

    Raises:
        OSError: the link cannot be opened (ConnectionRefusedError, socket.gaierror, serial.SerialException …).
        ValueError: an argument is wrong; a connection string that names no link is an OSError, too.
        APIException: no vehicle was heard in time; the text says what was heard instead.
        TimeoutError: ``wait_ready`` was not satisfied in time. Whatever fails, nothing stays open.
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
    except (OSError, ValueError) as error:
        raise error.with_traceback(None) from None  # where in here it came from says nothing to a program
    handler.overrides.is_wanted = release_overrides
    try:
        vehicle = cast("VehicleT", Vehicle(handler)) if vehicle_class is None else vehicle_class(handler)
        if status_printer is not None:
            _print_texts(handler, status_printer)
            handler.listener_thread.keep(vehicle, has_listeners=True)
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
    except BaseException:
        handler.close()
        raise
    return vehicle


def _print_texts(handler: MAVConnection, status_printer: Callable[[str], object]) -> None:
    """Through the logger ``autopilot``, whose level decides, as with DroneKit; until the connection is closed."""
    logger, printer = logging.getLogger("autopilot"), ErrprinterHandler(status_printer)
    logger.addHandler(printer)
    handler.on_close(lambda: logger.removeHandler(printer))
