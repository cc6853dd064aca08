"""``connect``: from a connection string to a vehicle."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, cast

from aerokit.dronekit.util import ErrprinterHandler
from aerokit.runtime.own_heartbeat import OwnHeartbeat

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    from aerokit.dronekit.mavlink import MAVConnection
    from aerokit.dronekit.vehicle import Vehicle

    VehicleT = TypeVar("VehicleT", bound=Vehicle, default=Vehicle)

__all__ = ["connect", "default_still_waiting_callback"]


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
        from aerokit.dronekit.vehicle import Vehicle  # the link hears meanwhile: this takes a while

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
