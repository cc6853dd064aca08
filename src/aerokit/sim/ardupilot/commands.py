"""Commands (MAV_CMD) that all simulated ArduPilots implement, with the conditions and results of the firmware.

Plane's results are those of a plane without lifting rotors, which is not a QuadPlane.
"""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import MavDoRepositionFlags, MavFrame, MavSeverity
from aerokit.mavlink.enums import MavResult as Result
from aerokit.sim.ardupilot.host import ABSOLUTE_FRAMES, RELATIVE_FRAMES, TERRAIN_FRAMES
from aerokit.sim.ardupilot.kinds import Kind, rows_of
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, ReceivedCommand, to_int
from aerokit.sim.motion import Ned

_FORCE_ARM_OR_DISARM, _FORCE_ARM = 21196.0, 2989.0
_FORCE_REBOOT = 20190226
_SOURCE_SETS = (1.0, 2.0, 3.0)
_NOTICE, _WARNING = MavSeverity.NOTICE, MavSeverity.WARNING

_FIXED_TEXTS: dict[tuple[int, Kind], tuple[tuple[int, str], ...]] = {
    (Cmd.DO_LAND_START, "plane"): ((_WARNING, "Unable to start landing sequence"),),
    (Cmd.DO_LAND_START, "copter"): (
        (_WARNING, "Unable to start landing sequence"),
        (_WARNING, "Mode change to AUTO RTL failed: No landing sequence found"),
    ),
    (Cmd.DO_VTOL_TRANSITION, "plane"): ((_NOTICE, "VTOL not available"),),
}


def common_commands(vehicle: ArduPilotVehicle) -> dict[int, CommandHandler]:
    common, requests = _CommonCommands(vehicle), vehicle.requests
    # `fixed_results.csv` lists commands that the simulation does not execute, each with the MAV_RESULT that it returns.
    handlers: dict[int, CommandHandler] = {
        Cmd[command]: common.constant_answer(Result[result], _FIXED_TEXTS.get((Cmd[command], vehicle.KIND), ()))
        for command, result in rows_of(vehicle.KIND, "fixed_results.csv")
    }
    if vehicle.KIND != "sub":
        handlers[Cmd.DO_FOLLOW] = lambda command: Result.ACCEPTED if 0 < command.param1 <= 255 else Result.DENIED
    # A reboot replaces the device objects, so the lambdas look them up at each call.
    if vehicle.KIND in ("copter", "plane"):
        handlers[Cmd.AIRFRAME_CONFIGURATION] = lambda command: vehicle.devices.move_gear(command)
        handlers[Cmd.DO_PARACHUTE] = lambda command: vehicle.devices.handle_chute(command)
    if vehicle.KIND == "copter":
        handlers[Cmd.DO_WINCH] = lambda command: vehicle.devices.move_winch(command)
    return {
        **handlers,
        Cmd.DO_GRIPPER: lambda command: vehicle.devices.grip(command),
        Cmd.DO_SET_SERVO: lambda command: vehicle.devices.set_servo(command),
        # The simulation executes only the first of the repeated movements, like a DO_SET_SERVO.
        Cmd.DO_REPEAT_SERVO: lambda command: vehicle.devices.set_servo(command),
        Cmd.DO_SET_RELAY: lambda command: vehicle.devices.set_relay(command),
        Cmd.DO_REPEAT_RELAY: lambda command: vehicle.devices.set_relay(command),
        Cmd.DO_AUX_FUNCTION: lambda command: vehicle.devices.switch(command),
        Cmd.DO_FENCE_ENABLE: lambda command: vehicle.fence.command(command),
        Cmd.IMAGE_START_CAPTURE: lambda command: vehicle.camera.start_capture(command),
        Cmd.IMAGE_STOP_CAPTURE: lambda command: vehicle.camera.stop_capture(command),
        Cmd.DO_DIGICAM_CONTROL: lambda command: vehicle.camera.digicam_control(command),
        Cmd.DO_SET_CAM_TRIGG_DIST: lambda command: vehicle.camera.set_trigger_distance(command),
        Cmd.SET_CAMERA_ZOOM: lambda command: vehicle.camera.zoom(command),
        Cmd.SET_CAMERA_FOCUS: lambda command: vehicle.camera.focus(command),
        Cmd.EXTERNAL_WIND_ESTIMATE: lambda command: vehicle.external.set_wind(command),
        Cmd.SET_EKF_SOURCE_SET: lambda command: Result.ACCEPTED if command.param1 in _SOURCE_SETS else Result.DENIED,
        Cmd.BATTERY_RESET: common.reset_battery,
        Cmd.CONTROL_HIGH_LATENCY: common.control_high_latency,
        Cmd.COMPONENT_ARM_DISARM: common.arm_or_disarm,
        Cmd.DO_SET_MODE: lambda command: vehicle.set_mode_from(to_int(command.param1), to_int(command.param2)),
        Cmd.DO_SET_MISSION_CURRENT: common.set_mission_current,
        Cmd.DO_FLIGHTTERMINATION: common.terminate,
        Cmd.MISSION_START: common.start_mission,
        Cmd.DO_REPOSITION: common.reposition,
        Cmd.REQUEST_AUTOPILOT_CAPABILITIES: common.request_capabilities,
        Cmd.REQUEST_MESSAGE: requests.request_message,
        Cmd.SET_MESSAGE_INTERVAL: requests.set_interval,
        Cmd.GET_MESSAGE_INTERVAL: requests.get_interval,
        Cmd.RUN_PREARM_CHECKS: common.run_prearm_checks,
        Cmd.PREFLIGHT_REBOOT_SHUTDOWN: common.reboot,
        Cmd.DO_SEND_BANNER: common.send_banner,
        **dict.fromkeys((Cmd.DO_SET_ROI, Cmd.DO_SET_ROI_LOCATION, Cmd.DO_SET_ROI_NONE), common.look_at),
        Cmd.DO_SET_ROI_SYSID: common.look_at_vehicle,
        **vehicle.calibrations.commands,
        Cmd.DO_MOUNT_CONFIGURE: lambda command: vehicle.gimbal.configure_mount(command),
        Cmd.DO_MOUNT_CONTROL: lambda command: vehicle.gimbal.control_mount(command),
        Cmd.DO_GIMBAL_MANAGER_PITCHYAW: lambda command: vehicle.gimbal.point_or_turn(command),
        Cmd.DO_GIMBAL_MANAGER_CONFIGURE: lambda command: vehicle.gimbal.configure_manager(command),
        Cmd.DO_SET_HOME: common.set_home,
        Cmd.GET_HOME_POSITION: common.get_home,
    }


def commanded_heading(command: ReceivedCommand, yaw: float) -> float | None:
    """Return the heading in radians that CONDITION_YAW commands, or None if its params are invalid."""
    angle_deg, relative_flag = command.param1, command.param4
    if not 0.0 <= angle_deg <= 360.0 or relative_flag not in (0.0, 1.0):
        return None
    angle = math.radians(angle_deg)
    if relative_flag == 0.0:
        return angle
    direction = command.param3 or 1.0  # Without a direction, the vehicle turns clockwise.
    return yaw + math.copysign(angle, direction)


class _CommonCommands:
    """Handlers of the commands that all ArduPilot vehicles execute in the same way.

    SET_GPS_GLOBAL_ORIGIN is accepted only once, and only before GPS has set the origin. Until the origin is set, Copter
    and Sub refuse DO_SET_HOME, whereas Plane and Rover accept it.
    """

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        vehicle.on(m.SetGpsGlobalOrigin, self._on_origin)

    def constant_answer(self, result: int, texts: tuple[tuple[int, str], ...]) -> CommandHandler:
        def handle(_: ReceivedCommand) -> int:
            for severity, text in texts:
                self._vehicle.send_text(severity, text)
            return result

        return handle

    def arm_or_disarm(self, command: ReceivedCommand) -> int:
        vehicle = self._vehicle
        must_arm, must_disarm = command.param1 == 1.0, command.param1 == 0.0
        if must_arm:
            skips_checks = command.param2 in (_FORCE_ARM, _FORCE_ARM_OR_DISARM)
            is_done = vehicle.motors.is_armed or vehicle.arming.arm(force=skips_checks)
        elif must_disarm:
            stops_in_air = command.param2 == _FORCE_ARM_OR_DISARM
            is_done = vehicle.arming.disarm(force=stops_in_air)
        else:
            return Result.UNSUPPORTED
        return Result.ACCEPTED if is_done else Result.FAILED

    def set_mission_current(self, command: ReceivedCommand) -> int:
        vehicle = self._vehicle
        resets_mission = command.param2 == 1.0
        if not 0 <= command.param1 < vehicle.missions.commands.count:
            return Result.DENIED
        if resets_mission:
            vehicle.mission.reset()  # also sets the counters of DO_JUMP to 0
        if not vehicle.mission.set_current(to_int(command.param1)):
            return Result.FAILED
        if resets_mission:
            vehicle.mission.start_or_resume()  # After a reset, even a complete mission starts again.
        vehicle.requests.send_soon(m.MissionCurrent.ID, command.channel)
        return Result.ACCEPTED

    def start_mission(self, command: ReceivedCommand) -> int:
        vehicle = self._vehicle
        if command.param1 or command.param2:  # The firmware refuses a first and a last item.
            return Result.DENIED
        result = vehicle.change_to(vehicle.auto.number)
        if result == Result.ACCEPTED:
            vehicle.auto.may_lift_off = vehicle.is_armed
            # Only ArduCopter starts a mission that does not run in AUTO (GCS_MAVLink_Copter.cpp).
            if vehicle.KIND == "copter" and not vehicle.mission.is_running:
                vehicle.mission.start_or_resume()
        return result

    def reposition(self, command: ReceivedCommand) -> int:
        vehicle, guided = self._vehicle, self._vehicle.guided
        if command.is_long:  # ArduPilot requires an altitude frame here, and COMMAND_LONG has none.
            return Result.UNSUPPORTED
        may_change_mode = bool(to_int(command.param2) & MavDoRepositionFlags.CHANGE_MODE)
        if vehicle.mode is not guided and not may_change_mode:
            return Result.DENIED
        point = vehicle.world_point(*command.place(), command.z, command.altitude_frame)
        if point is None:
            return Result.DENIED
        # Check the target first, so that the mode stays unchanged if the vehicle may not fly to the target.
        if not vehicle.accept_reposition(point) or not vehicle.set_mode(guided.number):
            return Result.FAILED
        guided.go_to(point)
        return Result.ACCEPTED

    def terminate(self, command: ReceivedCommand) -> int:
        if command.param1 <= 0.5:
            return Result.FAILED
        self._vehicle.arming.disarm()
        return Result.ACCEPTED

    def request_capabilities(self, command: ReceivedCommand) -> int:
        if command.param1 != 1.0:
            return Result.FAILED
        self._vehicle.requests.send_soon(m.AutopilotVersion.ID, command.channel)
        return Result.ACCEPTED

    def run_prearm_checks(self, _: ReceivedCommand) -> int:
        if self._vehicle.motors.is_armed:
            return Result.TEMPORARILY_REJECTED
        self._vehicle.arming.report()
        return Result.ACCEPTED

    def reboot(self, command: ReceivedCommand) -> int:
        if self._vehicle.is_armed and command.y != _FORCE_REBOOT:  # y is param 6.
            return Result.FAILED
        if command.param1 not in (1.0, 3.0):
            return Result.UNSUPPORTED
        self._vehicle.call_later(0.1, self._vehicle.restart)  # later, so that the acknowledgement is still sent
        return Result.ACCEPTED

    def send_banner(self, _: ReceivedCommand) -> int:
        self._vehicle.send_banner()
        return Result.ACCEPTED

    def reset_battery(self, command: ReceivedCommand) -> int:
        # The simulation has one battery, which is the first bit of the mask.
        if to_int(command.param1) & 1:
            self._vehicle.battery.percent = max(0.0, min(100.0, command.param2))
        return Result.ACCEPTED

    def control_high_latency(self, command: ReceivedCommand) -> int:
        # The simulated vehicle has no high-latency link that the command could enable.
        if command.param1:
            return Result.FAILED
        self._vehicle.send_text(_NOTICE, "High Latency disabled")
        return Result.ACCEPTED

    def look_at(self, command: ReceivedCommand) -> int:
        point = None
        if command.command != Cmd.DO_SET_ROI_NONE:
            point = self._vehicle.world_point(*command.place(), command.z, command.altitude_frame)
            if point is None:
                return Result.DENIED
            has_only_zeros = command.place() == (0, 0) and command.z == 0
            if has_only_zeros:
                point = None
        self._vehicle.look_at(point)  # None clears the region of interest.
        return Result.ACCEPTED

    def look_at_vehicle(self, command: ReceivedCommand) -> int:
        self._vehicle.gimbal.follow(to_int(command.param1))
        return Result.ACCEPTED

    def set_home(self, command: ReceivedCommand) -> int:
        vehicle, nav = self._vehicle, self._vehicle.navigation
        uses_current_place = command.param1 == 1.0 or command.place() == (0, 0)
        if uses_current_place:
            return self._make_home(vehicle.motion.place) if nav.has_position else Result.FAILED
        if command.param1 != 0.0:
            return Result.FAILED
        # COMMAND_LONG has no frame. The firmware takes the altitude as AMSL.
        frame = MavFrame.GLOBAL if command.is_long else command.altitude_frame
        if frame not in RELATIVE_FRAMES | TERRAIN_FRAMES | ABSOLUTE_FRAMES:
            vehicle.info(f"Unknown mavlink coordinate frame {frame}")
            return Result.DENIED
        point = vehicle.world_point(*command.place(), command.z, frame)
        if point is None or (nav.origin is None and vehicle.HOME_NEEDS_ORIGIN):
            return Result.FAILED
        return self._make_home(point)

    def _make_home(self, point: Ned) -> int:
        vehicle = self._vehicle
        vehicle.navigation.set_home(point, lock=True)
        if vehicle.REPORTS_HOME:
            place = vehicle.frame.to_global(*point)
            latitude, longitude = place.latitude_e7 / 1e7, place.longitude_e7 / 1e7
            vehicle.info(f"Set HOME to {latitude:.6f} {longitude:.6f} at {place.altitude_m:.2f}m")
        return Result.ACCEPTED

    def get_home(self, command: ReceivedCommand) -> int:
        if self._vehicle.navigation.home is None:
            return Result.FAILED
        self._vehicle.send_home(command.channel)
        return Result.ACCEPTED

    def _on_origin(self, message: m.SetGpsGlobalOrigin, channel: Channel) -> None:
        vehicle = self._vehicle
        place = (message.latitude, message.longitude)
        point = vehicle.world_point(*place, message.altitude / 1000.0, MavFrame.GLOBAL)
        if point is None or place == (0, 0):
            return
        if vehicle.navigation.set_origin(point):
            vehicle.send_built(m.GpsGlobalOrigin.ID, channel)
