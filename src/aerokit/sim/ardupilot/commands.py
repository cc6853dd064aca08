"""The commands (MAV_CMD) that each simulated ArduPilot knows, with the real one's conditions and results."""

from __future__ import annotations

from aerokit.mavlink.enums import MavCmd, MavFrame, MavResult
from aerokit.mavlink.messages import AutopilotVersion, GpsGlobalOrigin, MissionCurrent, SetGpsGlobalOrigin
from aerokit.sim.ardupilot.payload_commands import (
    GimbalCommands,
    RegionOfInterest,
    camera_commands,
    equipment_commands,
)
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler, whole
from aerokit.sim.local_frame import Ned

_FORCE_ARM_OR_DISARM, _FORCE_ARM = 21196.0, 2989.0
_FORCE_REBOOT = 20190226


def common_commands(vehicle: ArduPilotVehicle) -> dict[int, CommandHandler]:
    """MAV_CMD → handler; each kind of vehicle adds its own, and drops what is to be unsupported."""
    state, setup = _State(vehicle), _Setup(vehicle)
    return {
        **equipment_commands(vehicle),
        MavCmd.COMPONENT_ARM_DISARM: state.arm_or_disarm,
        MavCmd.DO_SET_MODE: state.set_mode,
        MavCmd.DO_SET_MISSION_CURRENT: state.set_mission_current,
        MavCmd.DO_FLIGHTTERMINATION: state.terminate,
        MavCmd.REQUEST_AUTOPILOT_CAPABILITIES: setup.request_capabilities,
        MavCmd.REQUEST_MESSAGE: vehicle.requests.request_message,
        MavCmd.SET_MESSAGE_INTERVAL: vehicle.requests.set_interval,
        MavCmd.GET_MESSAGE_INTERVAL: vehicle.requests.get_interval,
        MavCmd.RUN_PREARM_CHECKS: setup.run_prearm_checks,
        MavCmd.DO_FENCE_ENABLE: lambda command: vehicle.fence.command(command),
        MavCmd.PREFLIGHT_REBOOT_SHUTDOWN: setup.reboot,
        MavCmd.DO_SEND_BANNER: setup.send_banner,
        **vehicle.calibrations.commands,
        **GimbalCommands(vehicle).commands,
        **HomeAndOrigin(vehicle).commands,
        **RegionOfInterest(vehicle).commands,
        **camera_commands(vehicle),
    }


class _State:
    """Arming, modes, the place in the mission."""

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle

    def arm_or_disarm(self, command: Command) -> int:
        if command.param1 == 1.0:
            if self._vehicle.motors.is_armed:
                return MavResult.ACCEPTED
            done = self._vehicle.arming.arm(force=command.param2 in (_FORCE_ARM, _FORCE_ARM_OR_DISARM))
        elif command.param1 == 0.0:
            done = self._vehicle.arming.disarm(force=command.param2 == _FORCE_ARM_OR_DISARM)
        else:
            return MavResult.UNSUPPORTED
        return MavResult.ACCEPTED if done else MavResult.FAILED

    def set_mode(self, command: Command) -> int:
        return self._vehicle.set_mode_from(whole(command.param1), whole(command.param2))

    def set_mission_current(self, command: Command) -> int:
        vehicle, resets = self._vehicle, command.param2 == 1.0
        if not 0 <= command.param1 < vehicle.missions.commands.count:
            return MavResult.DENIED
        if resets:
            vehicle.mission.reset()
        if not vehicle.mission.set_current(whole(command.param1)):
            return MavResult.FAILED
        if resets:
            vehicle.mission.start_or_resume()
        vehicle.requests.send_soon(MissionCurrent.ID, command.channel)
        return MavResult.ACCEPTED

    def terminate(self, command: Command) -> int:
        if command.param1 <= 0.5:
            return MavResult.FAILED
        self._vehicle.arming.disarm()
        return MavResult.ACCEPTED


class _Setup:
    """Commands that ask for or change settings."""

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle

    def request_capabilities(self, command: Command) -> int:
        if command.param1 != 1.0:
            return MavResult.FAILED
        self._vehicle.requests.send_soon(AutopilotVersion.ID, command.channel)
        return MavResult.ACCEPTED

    def run_prearm_checks(self, _: Command) -> int:
        if self._vehicle.motors.is_armed:
            return MavResult.TEMPORARILY_REJECTED
        self._vehicle.arming.report()
        return MavResult.ACCEPTED

    def reboot(self, command: Command) -> int:
        if self._vehicle.is_armed and command.y != _FORCE_REBOOT:
            return MavResult.FAILED
        if command.param1 not in (1.0, 3.0):
            return MavResult.UNSUPPORTED
        self._vehicle.call_later(0.1, self._vehicle.restart)  # the answer still goes out
        return MavResult.ACCEPTED

    def send_banner(self, _: Command) -> int:
        self._vehicle.send_banner()
        return MavResult.ACCEPTED


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
        return {MavCmd.DO_SET_HOME: self._set_home, MavCmd.GET_HOME_POSITION: self._get_home}

    def _set_home(self, command: Command) -> int:
        nav, motion = self._vehicle.navigation, self._vehicle.motion
        if command.param1 == 1.0 or command.place() == (0, 0):
            if not nav.has_position:
                return MavResult.FAILED
            return self._make_home(motion.place)
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
        origin = vehicle.build(GpsGlobalOrigin.ID)
        if origin is not None:
            vehicle.send(origin, channel)
