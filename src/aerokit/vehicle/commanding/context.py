"""`VehicleContext`: objects shared by all actions of one vehicle, and their shutdown."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Any

from aerokit.connection.bus import once
from aerokit.vehicle.commanding.arbiter import CommandArbiter
from aerokit.vehicle.commanding.cleanup import ArmCleanup, FlightCleanup
from aerokit.vehicle.commanding.health import Health
from aerokit.vehicle.commanding.progress import POSITION_MAX_AGE_S, VehiclePosition
from aerokit.vehicle.commanding.sender import OrderSender
from aerokit.vehicle.state.states import States
from aerokit.vehicle.state.telemetry import height_above_home, is_reported_on_ground

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Autopilot
    from aerokit.connection.bus import Detach
    from aerokit.connection.cells import StateCell
    from aerokit.connection.connection import Connection
    from aerokit.events import LinkReport
    from aerokit.vehicle.session.session import VehicleSession
    from aerokit.vehicle.state.telemetry import Telemetry

logger: logging.Logger = logging.getLogger("aerokit")


class VehicleContext:
    """The session with the vehicle, the arbiter of its orders, and the objects that send orders."""

    def __init__(self, session: VehicleSession) -> None:
        self.session = session
        connection = session.connection
        self.arbiter: CommandArbiter = CommandArbiter(
            connection.now,
            session.telemetry,
            connection._slept_since,
            partial(connection.is_held_back, session.system_id),
        )
        self.sender: OrderSender = OrderSender(session, self.arbiter)
        self.flight_cleanup: FlightCleanup = FlightCleanup(session, self.arbiter, self.sender)
        self.arm_cleanup: ArmCleanup = ArmCleanup(session, self.arbiter, self.sender, self.flight_cleanup.hold)
        self.health: Health = Health(session)
        self.vehicle_position: VehiclePosition = VehiclePosition(session)
        self.finish_callbacks: list[Callable[[], None]] = []
        """Callbacks of :meth:`on_finish`, in the order in which they were added."""
        # After a reboot, no earlier command arms the vehicle.
        session.on_reboot += [self.arbiter.on_reboot, self.arm_cleanup.stop_watching]

    def on_finish(self, callback: Callable[[], None]) -> Detach:
        """Call ``callback`` at the end of the vehicle's `async with` block. Returns a function that removes it.

        The callback may send messages, but must not wait.
        """
        self.finish_callbacks.append(callback)
        return once(partial(self.finish_callbacks.remove, callback))

    async def finish(self) -> bool:
        """Run the callbacks of `on_finish`, and hold the vehicle if a flight is unfinished.

        Called at the end of the vehicle's `async with` block. Returns True if it has ordered a hold, or if an earlier
        hold was not confirmed yet.
        """
        # The newest callback runs first, as with nested blocks: a gimbal is stopped before its control is released.
        for callback in tuple(reversed(self.finish_callbacks)):
            try:
                callback()
            except Exception:  # The vehicle must hold even if a device fails.
                logger.exception("a callback at the end of the async with block of this vehicle failed")
        self.flight_cleanup.end_flights()
        was_hold_pending = self.flight_cleanup.is_hold_pending
        await self.flight_cleanup.finish()
        await self.arm_cleanup.finish()
        return was_hold_pending

    def describe_now(self) -> str:
        autopilot, telemetry = self.session.autopilot, self.session.telemetry
        hold_mode = autopilot.mode_for("hold", is_vtol=telemetry.is_vtol)
        mode = telemetry.mode.latest
        if telemetry.is_armed and is_reported_on_ground(telemetry):
            where = "on the ground in"  # A copter in LAND stays armed for some seconds after the touchdown.
        elif mode is not None and mode == hold_mode and not telemetry.is_confirmed_disarmed:
            where = "holding in"
        else:
            where = "in"
        if telemetry.is_armed:
            armed = "still armed"
        else:
            armed = "disarmed" if telemetry.is_confirmed_disarmed else "possibly armed"
        height_m = height_above_home(telemetry)
        age_s = telemetry.position.age
        when = f" {age_s:.0f} s ago" if age_s > POSITION_MAX_AGE_S else ""  # The vehicle may have lost its position.
        height = "" if height_m is None else f" {height_m:.1f} m above home{when},"
        return f"{where} {telemetry.mode_name}, {armed},{height} last heartbeat {self.session.heartbeat_age:.1f} s ago"


class VehicleBase(States):
    """Base class of the mix-ins of :class:`aerokit.Vehicle`, which share the context and do not call each other."""

    def __init__(self, context: VehicleContext) -> None:
        session = context.session
        self.connection: Connection = session.connection
        """The connection of the vehicle."""
        self.system_id: int = session.system_id
        """MAVLink system id, 1–255."""
        self.component_id: int = session.component_id
        """Component id of the vehicle's autopilot, usually 1."""
        self.vehicle_type: int = session.vehicle_type
        """MAV_TYPE of the first heartbeat (https://mavlink.io/en/messages/minimal.html#MAV_TYPE)."""
        self.autopilot: Autopilot = session.autopilot
        """Description of the autopilot's behaviour, which differs between ArduPilot, PX4 and other firmware."""
        self.telemetry: Telemetry = session.telemetry
        """The state cells. Most of them are also properties of the vehicle."""
        self.link_quality: StateCell[LinkReport] = session.link_quality
        """Packet loss, delay and data rates of the last second."""
        self._context = context
        self._session = session
        self._arbiter = context.arbiter
        self._sender = context.sender
        self._flight_cleanup = context.flight_cleanup
        self._arm_cleanup = context.arm_cleanup
        self._health = context.health
        self._position = context.vehicle_position

    def _cell_of(self, name: str) -> StateCell[Any]:
        return self.telemetry.cells[name]
