"""Making a vehicle move: modes, arming, take-off, places, speeds, and waiting for what comes of it."""

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

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from aerokit.dronekit.line import BackgroundCall

HOME_TIMEOUT_S = 10.0
ORDERS_LOOK_S = 0.02
ARMING = ("disarm", "arm")


class FlightMethods(VehicleAttributes):
    """Setters and the ``simple_…`` methods return at once: the order is sent, repeated until it is answered, and a
    refusal becomes a warning of the logger ``dronekit``. The ``wait_…`` methods, :meth:`arm` and :meth:`disarm` wait.
    All of them raise APIException while the link is down.
    """

    _dk_arming: BackgroundCall | None = None

    # --------------------------------------------------------------------------------- modes

    @property
    def mode(self) -> VehicleMode:
        """The flight mode by HEARTBEAT, by pymavlink's name for it; ``UNKNOWN`` before the first.

        Set it to a :class:`VehicleMode`, to a name, or on ArduPilot to a number: the order is sent at once
        (MAV_CMD_DO_SET_MODE, and SET_MODE where that is not known). :meth:`wait_for_mode` waits. KeyError, and nothing
        sent: this vehicle has no such mode.
        """
        return VehicleMode(self._flightmode)

    @mode.setter
    def mode(self, value: VehicleMode | str | int) -> None:
        self._dk_set_mode(value)

    def _dk_set_mode(self, value: VehicleMode | str | int) -> tuple[str, BackgroundCall]:
        aio = self._dk.check_link()
        wanted = flight_orders.mode_named(aio, value.name if isinstance(value, VehicleMode) else value)
        return wanted.name, self._dk.order("mode", flight_orders.change_mode, aio, wanted)

    def wait_for_mode(self, mode: VehicleMode | str | int, timeout: float | None = None) -> None:
        """Set the mode and wait until the vehicle is in it.

        TimeoutError: not within ``timeout`` seconds, or, sooner, the vehicle has refused it.
        """
        name, done = self._dk_set_mode(mode)
        self._dk_wait_for_order(done, lambda: self._flightmode == name, timeout, "failed to set flight mode")

    # -------------------------------------------------------------------------------- arming

    @property
    def armed(self) -> bool:
        """Whether the motors are armed, by HEARTBEAT. Setting it sends the order, if it is another value than told, or
        than ordered a moment before: **propellers may start to turn**. :meth:`arm` waits, and tells why it is refused.
        """
        return self._armed

    @armed.setter
    def armed(self, value: bool) -> None:
        if bool(value) != self._armed or self._dk_is_changing_to(not value):
            self._dk_set_armed(bool(value))
        else:
            self._dk.check_link()

    def _dk_set_armed(self, value: bool) -> BackgroundCall:
        aio = self._dk.check_link()
        self._dk_arming = order = self._dk.order(ARMING[value], flight_orders.change_armed, aio, value)
        return order

    def _dk_is_changing_to(self, value: bool) -> bool:
        """Whether an order to arm or disarm has not ended yet."""
        order = self._dk_arming
        return order is not None and order.kind == ARMING[value] and not order.done()

    def arm(self, wait: bool = True, timeout: float | None = None) -> None:
        """Arm the motors: **propellers may start to turn**; with ``wait`` until HEARTBEAT says armed.

        TimeoutError: not within ``timeout`` seconds, or, sooner, the vehicle has refused; the text has its reasons.
        """
        self._dk_change_armed(True, wait, timeout, "failed to arm vehicle")

    def disarm(self, wait: bool = True, timeout: float | None = None) -> None:
        """Stop the motors; as :meth:`arm`. In the air the vehicle refuses."""
        self._dk_change_armed(False, wait, timeout, "failed to disarm vehicle")

    def _dk_change_armed(self, value: bool, wait: bool, timeout: float | None, text: str) -> None:
        is_overruling = self._dk_is_changing_to(not value)
        if self._armed == value and not is_overruling:
            self._dk.check_link()
            return
        order = self._dk_set_armed(value)
        if wait:

            def is_done() -> bool:
                return self._armed == value and (order.done() or not is_overruling)

            self._dk_wait_for_order(order, is_done, timeout, text)

    # -------------------------------------------------------------------------------- flying

    def simple_takeoff(self, alt: float | None = None) -> None:
        """Take off and climb to ``alt`` metres above home; returns at once. Copters, armed and in GUIDED mode.

        Without an altitude nothing is sent. ValueError: it is not a finite number.
        """
        if alt is not None:
            self._dk_take_off(float(alt))

    def _dk_take_off(self, altitude: float) -> BackgroundCall:
        """Altitude above home in metres."""
        if not math.isfinite(altitude):
            raise ValueError("Altitude was NaN or Infinity. Please provide a real number")
        aio = self._dk.check_link()
        give = functools.partial(self._dk.order, "takeoff", flight_orders.take_off, aio)
        if not aio.autopilot.repositions_amsl:  # as it does take-offs
            return give((), MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude)
        plan = aio.autopilot.take_off(altitude, self._dk_known_home().alt, is_vtol=aio.is_vtol)
        mode = aio.autopilot.mode_for("take_off")
        if plan is None or plan.command is None or mode is None:
            raise APIException("this vehicle cannot take off by a command")
        return give((mode,), plan.command, *plan.params)

    def wait_simple_takeoff(
        self, alt: float | None = None, epsilon: float = 0.1, timeout: float | None = None
    ) -> None:
        """:meth:`simple_takeoff`, then wait as :meth:`wait_for_alt` does; TimeoutError at once when it has refused."""
        if alt is not None:
            order = self._dk_take_off(float(alt))
            is_there = self._dk_passes(float(alt), epsilon, is_relative=True)
            self._dk_wait_for_order(order, is_there, timeout, "failed to reach specified altitude")

    def simple_goto(
        self,
        location: LocationGlobal | LocationGlobalRelative,
        airspeed: float | None = None,
        groundspeed: float | None = None,
    ) -> None:
        """Send the vehicle to a place; returns at once, and nothing tells of the arrival.

        In GUIDED mode only (PX4: LOITER): the mode is left as it is, so that a pilot who has taken over keeps the
        vehicle; the vehicle's refusal becomes a warning of the logger ``dronekit``.

        Args:
            location: latitude and longitude in degrees; altitude in metres above the sea or above home, by its class.
            airspeed: m/s, as the attribute.
            groundspeed: m/s, as the attribute.

        Raises:
            ValueError: it is no such location, or one of its numbers is missing or wrong. Nothing was sent.
        """
        aio = self._dk.check_link()
        flies_in = flight_orders.flies_to_places_in(aio)
        place = self._dk_place(location, is_relative=not flies_in)
        for name, speed in (("airspeed", airspeed), ("groundspeed", groundspeed)):
            flight_orders.check_speed(name, speed)
        if flies_in and self._flightmode not in map(str, flies_in):
            reason = f"not in {self._flightmode}: set the mode {flies_in[0]} first"
            self._dk.order("goto", flight_orders.refuse, reason)
        else:
            self._dk.order("goto", flight_orders.go_to, aio, *place)
        if airspeed is not None:
            self.airspeed = airspeed
        if groundspeed is not None:
            self.groundspeed = groundspeed

    def _dk_place(self, location: object, *, is_relative: bool) -> tuple[int, int, float]:
        """Latitude and longitude in 1e-7 degrees, altitude above home or above the sea."""
        if not isinstance(location, (LocationGlobal, LocationGlobalRelative)):
            raise ValueError("Expecting location to be LocationGlobal or LocationGlobalRelative.")
        latitude, longitude, altitude = flight_orders.checked_place(location)
        if is_relative and isinstance(location, LocationGlobal):
            altitude -= self._dk_known_home().alt or 0.0
        elif not is_relative and not isinstance(location, LocationGlobal):
            altitude += self._dk_known_home().alt or 0.0
        return latitude, longitude, altitude

    # -------------------------------------------------------------------------------- speeds

    @property
    def airspeed(self) -> float | Any:
        """Speed through the air in m/s (VFR_HUD), None where nobody knows it. Set as :attr:`groundspeed`."""
        speed = self._dk_vfr_hud.values("airspeed")[0]
        return None if speed is None or math.isnan(speed) else speed

    @airspeed.setter
    def airspeed(self, speed: float) -> None:
        self._dk_change_speed("airspeed", SpeedType.AIRSPEED, speed)

    @property
    def groundspeed(self) -> float | Any:
        """Speed over ground in m/s (VFR_HUD). Setting it asks for this speed (MAV_CMD_DO_CHANGE_SPEED)."""
        return self._dk_vfr_hud.values("groundspeed")[0]

    @groundspeed.setter
    def groundspeed(self, speed: float) -> None:
        self._dk_change_speed("groundspeed", SpeedType.GROUNDSPEED, speed)

    def _dk_change_speed(self, name: str, kind: int, speed: float) -> None:
        flight_orders.check_speed(name, speed)
        self._dk.command(name, MavCmd.DO_CHANGE_SPEED, kind, float(speed), -1)

    # ---------------------------------------------------------------------------------- home

    @property
    def home_location(self) -> LocationGlobal | Any:
        """Where it returns to, a new object each time; None until HOME_POSITION or a mission told it.

        Setting it sends MAV_CMD_DO_SET_HOME, and the attribute has the new place at once; ValueError, and nothing sent:
        it is no LocationGlobal, or one of its numbers is missing or wrong.
        """
        home = self._home_location
        return None if home is None else LocationGlobal(home.lat, home.lon, home.alt)

    @home_location.setter
    def home_location(self, pos: LocationGlobal) -> None:
        if not isinstance(pos, LocationGlobal):
            raise ValueError("Expecting home_location to be set to a LocationGlobal.")
        latitude, longitude, altitude = flight_orders.checked_place(pos)
        aio = self._dk.check_link()
        place = {"frame": MavFrame.GLOBAL, "x": latitude, "y": longitude, "z": altitude}
        order = self._dk.order(
            "home", aio.command_int, MavCmd.DO_SET_HOME, 0, **place, component_id=0, or_long=True
        )
        self._home_location = LocationGlobal(pos.lat, pos.lon, altitude)
        order.add_done_callback(self._dk_home_is_set)

    def _dk_home_is_set(self, order: Future[None]) -> None:
        """A place that the vehicle refused is not its home: what it told last is."""
        if not order.cancelled() and isinstance(order.exception(), (CommandRejected, OperationTimeout)):
            self._home_location = self._dk_told_home

    def _dk_known_home(self) -> LocationGlobal:
        if self._home_location is None:
            self._dk.run(self._dk_fetch_home)
        home = self.home_location
        if home is None:
            raise APIException(
                "the vehicle does not know its home yet: it is set with the first good position"
            )
        return home

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
        """Wait until ``condition()`` is true, asked every ``interval`` seconds on the caller's thread.

        TimeoutError: it is not within ``timeout`` seconds (None: as long as it takes); the text is ``errmsg``.
        """
        deadline = math.inf if not timeout else time.monotonic() + timeout
        while not condition():
            self._dk.check_link()
            if time.monotonic() >= deadline:
                raise TimeoutError(errmsg or f"what was waited for was not true within {timeout:g} s")
            self._handler.wait_closed(min(interval, max(deadline - time.monotonic(), 0.0)))

    def wait_for_armable(self, timeout: float | None = None) -> None:
        """Wait until :attr:`is_armable`; TimeoutError after ``timeout`` seconds."""
        self.wait_for(lambda: self.is_armable, timeout, errmsg="the vehicle did not become armable")

    def wait_for_alt(
        self, alt: float, epsilon: float = 0.1, rel: bool = True, timeout: float | None = None
    ) -> None:
        """Wait until the altitude is within ``epsilon`` metres of ``alt``, or has passed it on the way.

        ``rel``: above home, otherwise above the sea. TimeoutError after ``timeout`` seconds.
        """
        is_there = self._dk_passes(alt, epsilon, is_relative=rel)
        self.wait_for(is_there, timeout, errmsg="failed to reach specified altitude")

    def _dk_passes(self, alt: float, epsilon: float, *, is_relative: bool) -> Callable[[], bool]:
        """Whether the vehicle is at an altitude, or has passed it since this was asked first."""
        start: float | None = None

        def is_there() -> bool:
            nonlocal start
            location = self.location
            frame = location.global_relative_frame if is_relative else location.global_frame
            now: float | None = frame.alt
            if now is None:
                return False
            start = now if start is None else start
            return abs(now - alt) <= epsilon or (start < alt <= now) or (now <= alt < start)

        return is_there

    def _dk_wait_for_order(
        self,
        order: BackgroundCall,
        is_done: Callable[[], bool],
        timeout: float | None,
        text: str,
    ) -> None:
        """Wait for what an order is to bring about; that it failed is known before the time is over.

        A program that stops waiting takes it for failed: it is not sent again then.
        """

        def is_over() -> bool:
            if is_done():
                return True
            if order.done() and order.exception() is not None and not is_done():
                self._dk.check_link()
                raise TimeoutError(f"{text}: {order.exception()}") from order.exception()
            return False

        try:
            self.wait_for(is_over, timeout, ORDERS_LOOK_S, text)
        except BaseException:
            self._handler.calls.withdraw(order)
            raise
