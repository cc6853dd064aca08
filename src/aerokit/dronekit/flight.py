"""Flight methods of a vehicle: modes, arming, take-off, positions, speeds and waiting."""

from __future__ import annotations

import contextlib
import functools
import math
import time
from typing import TYPE_CHECKING, Any

from aerokit.dronekit import flight_orders
from aerokit.dronekit.attributes import VehicleAttributes
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name
from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative, VehicleMode
from aerokit.errors import CommandRejected, OperationTimeout
from aerokit.mavlink.enums import MavCmd, MavFrame, SpeedType
from aerokit.mavlink.messages import HomePosition
from aerokit.vehicle.commanding.arbiter import MODE_MAX_AGE_S

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from aerokit.autopilots.modes import Mode
    from aerokit.dronekit.classic_connection import BackgroundCall

HOME_TIMEOUT_S = 10.0
ORDER_POLL_INTERVAL_S = 0.02


def _armed_order_kind(armed: bool) -> str:
    return "arm" if armed else "disarm"


class FlightMethods(VehicleAttributes):
    """Orders that change modes, arm and move the vehicle.

    Setters and ``simple_…`` methods return immediately. Their order is sent and repeated until it is acknowledged; a
    rejection is logged as a warning of the logger ``dronekit``. :meth:`arm`, :meth:`disarm` and ``wait_…`` methods
    wait for the effect. All methods raise APIException while the link is down.
    """

    _dk_arming: BackgroundCall | None = None

    # --------------------------------------------------------------------------------- modes

    @property
    def mode(self) -> VehicleMode:
        """The flight mode of the last HEARTBEAT, by pymavlink's name; ``UNKNOWN`` before the first HEARTBEAT.

        Set it to a :class:`VehicleMode`, a name or, on ArduPilot, a number. Setting it sends the order at once
        (MAV_CMD_DO_SET_MODE, or SET_MODE for old firmware) and does not wait; :meth:`wait_for_mode` waits. Raises
        KeyError, without sending, if the vehicle has no mode of this name; numbers are not checked.
        """
        return VehicleMode(self._flightmode)

    @mode.setter
    def mode(self, value: VehicleMode | str | int) -> None:
        self._dk_set_mode(self._dk_find_mode(value))

    def _dk_find_mode(self, value: VehicleMode | str | int) -> Mode:
        return flight_orders.find_mode(self._dk.check_link(), value.name if isinstance(value, VehicleMode) else value)

    def _dk_set_mode(self, mode: Mode) -> BackgroundCall:
        return self._dk.order("mode", flight_orders.change_mode, self._dk.aio, mode)

    def wait_for_mode(self, mode: VehicleMode | str | int, timeout: float | None = None) -> None:
        """Set the mode and wait until HEARTBEAT confirms it.

        Raises TimeoutError after ``timeout`` seconds, or as soon as the vehicle rejects the mode.
        """
        target_mode = self._dk_find_mode(mode)
        order = self._dk_set_mode(target_mode)

        def is_done() -> bool:
            return self._flightmode == target_mode.name and not self._dk_is_heartbeat_old

        self._dk_wait_for_order(order, is_done, timeout, "failed to set flight mode")

    @property
    def _dk_is_heartbeat_old(self) -> bool:
        """True if the mode and the armed flag of the last HEARTBEAT may be outdated."""
        aio = self._dk.aio_or_none
        return aio is not None and aio.heartbeat_age > MODE_MAX_AGE_S

    # -------------------------------------------------------------------------------- arming

    @property
    def armed(self) -> bool:
        """True if HEARTBEAT reports armed motors.

        Set it to arm or disarm: **propellers may start to turn**. Setting it does not wait; :meth:`arm` waits, and
        raises the reason of a refusal. As in DroneKit, the truth of the value counts: the string ``"False"`` arms.

        PX4 takes off when it is armed in MISSION or TAKEOFF. Unless your program has set such a mode since the vehicle
        disarmed, the mode is changed to LOITER before arming.

        Nothing is sent if the vehicle already reports the value. There are two exceptions: an opposite order is
        pending, or the order is to disarm a silent vehicle, whose last report may be outdated.
        """
        return self._armed

    @armed.setter
    def armed(self, value: bool) -> None:
        if not self._dk_reports_armed(bool(value)) or self._dk_has_pending_order(armed=not value):
            self._dk_order_armed(bool(value))
        else:
            self._dk.check_link()

    def _dk_reports_armed(self, armed: bool) -> bool:
        # An old HEARTBEAT of a disarmed vehicle is not trusted, because a pilot may have armed it since.
        return self._armed == armed and (armed or not self._dk_is_heartbeat_old)

    def _dk_order_armed(self, armed: bool) -> BackgroundCall:
        aio = self._dk.check_link()
        order = self._dk.order(_armed_order_kind(armed), flight_orders.arm_or_disarm, aio, armed)
        self._dk_arming = order
        return order

    def _dk_has_pending_order(self, armed: bool) -> bool:
        order = self._dk_arming
        return order is not None and order.kind == _armed_order_kind(armed) and not order.done()

    def arm(self, wait: bool = True, timeout: float | None = None) -> None:
        """Arm the motors: **propellers may start to turn**. With ``wait``, wait until HEARTBEAT reports armed motors.

        Waiting raises TimeoutError after ``timeout`` seconds, or as soon as the vehicle refuses, with its reasons.
        """
        self._dk_arm_or_disarm(True, wait, timeout, "failed to arm vehicle")

    def disarm(self, wait: bool = True, timeout: float | None = None) -> None:
        """Disarm the motors; arguments and errors as for :meth:`arm`. A vehicle in the air refuses."""
        self._dk_arm_or_disarm(False, wait, timeout, "failed to disarm vehicle")

    def _dk_arm_or_disarm(self, armed: bool, wait: bool, timeout: float | None, failure_text: str) -> None:
        had_opposite_order = self._dk_has_pending_order(armed=not armed)
        if self._dk_reports_armed(armed) and not had_opposite_order:
            self._dk.check_link()
            return
        order = self._dk_order_armed(armed)
        if wait:

            def is_done() -> bool:
                # While an earlier opposite order has no effect yet, HEARTBEAT still reports the wanted state, which
                # proves nothing until `order` is done.
                return self._dk_reports_armed(armed) and (order.done() or not had_opposite_order)

            self._dk_wait_for_order(order, is_done, timeout, failure_text)

    # -------------------------------------------------------------------------------- flying

    def simple_takeoff(self, alt: float | None = None) -> None:
        """Take off and climb to ``alt`` metres above home; returns immediately.

        The copter must be armed in GUIDED mode. Without an altitude, nothing is sent. Raises ValueError if the
        altitude is not a finite number.
        """
        if alt is not None:
            self._dk_take_off(float(alt))

    def _dk_take_off(self, altitude: float) -> BackgroundCall:
        """Start the take-off order of this autopilot. ``altitude`` is in metres above home."""
        if not abs(altitude) <= flight_orders.MAX_FLOAT:
            raise ValueError("Altitude was NaN or Infinity. Please provide a real number")
        aio = self._dk.check_link()
        takes_altitude_amsl = aio.autopilot.repositions_amsl
        if not takes_altitude_amsl:  # ArduPilot takes off in its present mode, so `()` selects no mode.
            params = (0, 0, 0, 0, 0, 0, altitude)
            return self._dk.order("takeoff", flight_orders.take_off, aio, (), MavCmd.NAV_TAKEOFF, *params)
        plan = aio.autopilot.take_off(altitude, self._dk_home_altitude(), is_vtol=aio.is_vtol)
        mode = aio.autopilot.mode_for("take_off")
        if plan is None or plan.command is None or mode is None:
            raise APIException("simple_takeoff: this vehicle has no take-off command")
        return self._dk.order("takeoff", flight_orders.take_off, aio, (mode,), plan.command, *plan.params)

    def wait_simple_takeoff(self, alt: float | None = None, epsilon: float = 0.1, timeout: float | None = None) -> None:
        """Call :meth:`simple_takeoff` and wait like :meth:`wait_for_alt`. Without an altitude, do nothing.

        Raises TimeoutError as soon as the order fails.
        """
        if alt is not None:
            order = self._dk_take_off(float(alt))
            has_reached = self._dk_altitude_condition(float(alt), epsilon, is_relative=True)
            self._dk_wait_for_order(order, has_reached, timeout, "failed to reach specified altitude")

    def simple_goto(
        self,
        location: LocationGlobal | LocationGlobalRelative,
        airspeed: float | None = None,
        groundspeed: float | None = None,
    ) -> None:
        """Fly to a location; returns immediately and does not report the arrival.

        Works in GUIDED mode only (PX4: LOITER). The mode is not changed, so that a pilot who has taken over keeps
        control. A rejection is logged as a warning of the logger ``dronekit``.

        Args:
            location: latitude and longitude in degrees, and the altitude in metres above sea level (LocationGlobal) or
                home (LocationGlobalRelative).
            airspeed: in m/s; has the same effect as setting :attr:`airspeed`.
            groundspeed: in m/s; has the same effect as setting :attr:`groundspeed`.

        Raises:
            ValueError: the location has another type, or one of its numbers is missing or wrong. Nothing was sent.
        """
        aio = self._dk.check_link()
        modes = flight_orders.reposition_modes(aio)
        target = self._dk_target(location, is_relative=not aio.autopilot.repositions_amsl)
        for name, speed in (("airspeed", airspeed), ("groundspeed", groundspeed)):
            flight_orders.check_speed(name, speed)  # Raises before anything is sent.
        if modes and self._flightmode not in map(str, modes):
            reason = f"not sent in mode {self._flightmode}: set mode {modes[0]} first"
            self._dk.order("goto", flight_orders.reject, reason)
            return  # The speeds are not sent, because they would change the flight in the present mode.
        self._dk.order("goto", flight_orders.go_to, aio, target)
        if airspeed is not None:
            self.airspeed = airspeed
        if groundspeed is not None:
            self.groundspeed = groundspeed

    def _dk_target(self, location: object, *, is_relative: bool) -> flight_orders.Target:
        """Convert a location. The altitude is above home with ``is_relative``, otherwise above sea level."""
        if not isinstance(location, (LocationGlobal, LocationGlobalRelative)):
            raise ValueError("Expecting location to be LocationGlobal or LocationGlobalRelative.")
        target = flight_orders.checked_location(location)
        if is_relative and isinstance(location, LocationGlobal):
            return target._replace(altitude_m=target.altitude_m - self._dk_home_altitude())
        if not is_relative and not isinstance(location, LocationGlobal):
            return target._replace(altitude_m=target.altitude_m + self._dk_home_altitude())
        return target

    # -------------------------------------------------------------------------------- speeds

    @property
    def airspeed(self) -> float | Any:
        """Airspeed in m/s (VFR_HUD); None if unknown. Set it to change the airspeed (MAV_CMD_DO_CHANGE_SPEED)."""
        (speed,) = self._dk_vfr_hud.values("airspeed")
        return None if speed is None or math.isnan(speed) else speed

    @airspeed.setter
    def airspeed(self, speed: float) -> None:
        self._dk_change_speed("airspeed", SpeedType.AIRSPEED, speed)

    @property
    def groundspeed(self) -> float | Any:
        """Ground speed in m/s (VFR_HUD). Set it to change the ground speed (MAV_CMD_DO_CHANGE_SPEED)."""
        (speed,) = self._dk_vfr_hud.values("groundspeed")
        return speed

    @groundspeed.setter
    def groundspeed(self, speed: float) -> None:
        self._dk_change_speed("groundspeed", SpeedType.GROUNDSPEED, speed)

    def _dk_change_speed(self, name: str, kind: int, speed: float) -> None:
        flight_orders.check_speed(name, speed)
        unchanged_throttle = -1
        self._dk.command(name, MavCmd.DO_CHANGE_SPEED, kind, float(speed), unchanged_throttle)

    # ---------------------------------------------------------------------------------- home

    @property
    def home_location(self) -> LocationGlobal | Any:
        """Home location; None until HOME_POSITION or a downloaded mission reports home, and after a reboot.

        Each access returns a new object.

        Set the attribute to a LocationGlobal to move home (MAV_CMD_DO_SET_HOME). As in DroneKit, the attribute changes
        at once; a refusal restores the old home. An invalid coordinate or another type raises ValueError, and nothing
        is sent.
        """
        home = self._home_location
        return None if home is None else LocationGlobal(home.lat, home.lon, home.alt)

    @home_location.setter
    def home_location(self, pos: LocationGlobal) -> None:
        if not isinstance(pos, LocationGlobal):
            raise ValueError("Expecting home_location to be set to a LocationGlobal.")
        target = flight_orders.checked_location(pos)
        aio = self._dk.check_link()
        home = {"frame": MavFrame.GLOBAL, "x": target.latitude_e7, "y": target.longitude_e7, "z": target.altitude_m}
        use_given_place = 0  # Param 1 of DO_SET_HOME is 1 for the current position of the vehicle.
        order = self._dk.order(
            "home", aio.command_int, MavCmd.DO_SET_HOME, use_given_place, **home, component_id=0, or_long=True
        )
        self._home_location = LocationGlobal(pos.lat, pos.lon, target.altitude_m)
        order.add_done_callback(functools.partial(self._dk_on_home_answer, self._home_location))

    def _dk_on_home_answer(self, new_home: LocationGlobal, order: Future[None]) -> None:
        """Confirm the new home if the vehicle has accepted it; restore the old one on a rejection or a time-out."""
        error = order.exception()
        if error is None:
            self._dk_confirmed_home = new_home
        elif isinstance(error, (CommandRejected, OperationTimeout)):
            self._home_location = self._dk_confirmed_home

    def _dk_home_altitude(self) -> float:
        """Return home's altitude above sea level. Request home if it is unknown."""
        if self._home_location is None:
            self._dk.run(self._dk_fetch_home)
        home = self.home_location
        if home is None or home.alt is None:
            raise APIException("the vehicle has not reported home yet: it sets home when it has a good position")
        return float(home.alt)

    async def _dk_fetch_home(self) -> None:
        aio = self._dk.check_link()
        with contextlib.suppress(CommandRejected):
            await aio.command(MavCmd.REQUEST_MESSAGE, HomePosition.ID)
        await aio.telemetry.home.wait_until(lambda _: True, timeout=HOME_TIMEOUT_S, description="home")

    # ------------------------------------------------------------------------------- waiting

    def wait_for(
        self,
        condition: Callable[[], object],
        timeout: float | None = None,
        interval: float = 0.1,
        errmsg: str | None = None,
    ) -> None:
        """Wait until ``condition()`` is true; it is called every ``interval`` seconds on the caller's thread.

        Raises TimeoutError with the text ``errmsg`` after ``timeout`` seconds (None or 0: no limit).
        """
        deadline = math.inf if not timeout else time.monotonic() + timeout
        while not condition():
            self._dk.check_may_wait()
            if time.monotonic() >= deadline:
                raise TimeoutError(errmsg or f"the condition was not true within {timeout:g} s")
            self._handler.wait_closed(min(interval, max(deadline - time.monotonic(), 0.0)))

    def wait_for_armable(self, timeout: float | None = None) -> None:
        """Wait until :attr:`is_armable` is true. Raises TimeoutError after ``timeout`` seconds."""
        self.wait_for(lambda: self.is_armable, timeout, errmsg="the vehicle did not become armable")

    def wait_for_alt(self, alt: float, epsilon: float = 0.1, rel: bool = True, timeout: float | None = None) -> None:
        """Wait until the altitude is within ``epsilon`` metres of ``alt``, or has passed it.

        With ``rel``, ``alt`` is above home, otherwise above sea level. Raises TimeoutError after ``timeout`` seconds.
        """
        has_reached = self._dk_altitude_condition(alt, epsilon, is_relative=rel)
        self.wait_for(has_reached, timeout, errmsg="failed to reach specified altitude")

    def _dk_altitude_condition(self, alt: float, epsilon: float, *, is_relative: bool) -> Callable[[], bool]:
        """Return a condition that is true if the altitude is near ``alt``, or has passed it since the first call."""
        first_altitude: float | None = None

        def has_reached() -> bool:
            nonlocal first_altitude
            location = self.location
            frame = location.global_relative_frame if is_relative else location.global_frame
            altitude: float | None = frame.alt
            if altitude is None:
                return False
            if first_altitude is None:
                first_altitude = altitude
            has_passed = first_altitude < alt <= altitude or altitude <= alt < first_altitude  # on the way up, or down
            return abs(altitude - alt) <= epsilon or has_passed

        return has_reached

    def _dk_wait_for_order(
        self,
        order: BackgroundCall,
        is_done: Callable[[], bool],
        timeout: float | None,
        failure_text: str,
    ) -> None:
        """Wait for the effect of an order. Raise TimeoutError as soon as the order fails."""

        def is_over() -> bool:
            if is_done():
                return True
            # Call is_done again, because the effect may have been reported between the first call and the failure.
            if order.done() and order.exception() is not None and not is_done():
                self._dk.check_link()  # If the link is lost, this raises a more useful error.
                raise TimeoutError(f"{failure_text}: {order.exception()}") from order.exception()
            return False

        try:
            self.wait_for(is_over, timeout, ORDER_POLL_INTERVAL_S, failure_text)
        except BaseException:  # If waiting ends with an error, the order must not be sent again.
            self._handler.calls.cancel(order)
            raise
