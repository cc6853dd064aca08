"""How a client sets and asks for home and the estimator's origin on a simulated ArduPilot."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavFrame, MavResult
from aerokit.mavlink.messages import SetGpsGlobalOrigin
from aerokit.sim.ardupilot.telemetry_position import global_origin

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.navigation import Ned
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.channel import Channel
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["HomeAndOrigin"]

_FRAMES = frozenset(
    {
        MavFrame.GLOBAL,
        MavFrame.GLOBAL_INT,
        MavFrame.GLOBAL_RELATIVE_ALT,
        MavFrame.GLOBAL_RELATIVE_ALT_INT,
        MavFrame.GLOBAL_TERRAIN_ALT,
        MavFrame.GLOBAL_TERRAIN_ALT_INT,
    }
)


class HomeAndOrigin:
    """DO_SET_HOME, GET_HOME_POSITION and SET_GPS_GLOBAL_ORIGIN.

    The origin can be set once, before GPS does it: then the vehicle knows places without GPS. Copter and Sub take no
    home before they have an origin; Plane and Rover do.
    """

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        vehicle.on(SetGpsGlobalOrigin, self._on_origin)

    @property
    def commands(self) -> dict[int, CommandHandler]:
        """MAV_CMD → handler."""
        return {MavCmd.DO_SET_HOME: self._set_home, MavCmd.GET_HOME_POSITION: self._get_home}

    def _set_home(self, command: Command) -> int:
        nav, motion = self._vehicle.navigation, self._vehicle.motion
        if command.param1 == 1.0 or command.place() == (0, 0):
            if not nav.has_position:
                return MavResult.FAILED
            return self._make_home((motion.north, motion.east, motion.down))
        if command.param1 != 0.0:
            return MavResult.FAILED
        frame = MavFrame.GLOBAL if command.is_long else command.altitude_frame
        if frame not in _FRAMES:
            self._vehicle.info(f"Unknown mavlink coordinate frame {frame}")
            return MavResult.DENIED
        point = self._vehicle.point(*command.place(), command.z, frame)
        if point is None or (nav.origin is None and self._vehicle.HOME_NEEDS_ORIGIN):
            return MavResult.FAILED
        return self._make_home(point)

    def _make_home(self, point: Ned) -> int:
        vehicle = self._vehicle
        vehicle.navigation.set_home(point, lock=True)
        if vehicle.TELLS_HOME:
            place = vehicle.frame.to_global(*point)
            latitude, longitude = place.latitude_e7 / 1e7, place.longitude_e7 / 1e7
            vehicle.info(f"Set HOME to {latitude:.6f} {longitude:.6f} at {place.altitude_m:.2f}m")
        return MavResult.ACCEPTED

    def _get_home(self, command: Command) -> int:
        if self._vehicle.navigation.home is None:
            return MavResult.FAILED
        self._vehicle.send_home(command.channel)
        return MavResult.ACCEPTED

    def _on_origin(self, message: SetGpsGlobalOrigin, channel: Channel) -> None:
        """Told to who asked; nonsense, and a second origin, are ignored without a word."""
        vehicle = self._vehicle
        place = (message.latitude, message.longitude)
        point = vehicle.point(*place, message.altitude / 1000.0, MavFrame.GLOBAL)
        if point is None or place == (0, 0) or not vehicle.navigation.set_origin(point):
            return
        origin = global_origin(vehicle)
        if origin is not None:
            vehicle.send(origin, channel)
