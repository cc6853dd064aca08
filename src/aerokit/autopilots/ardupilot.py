"""ArduPilot's vehicles (https://ardupilot.org/dev/docs/mavlink-commands.html).

Modes are from ``enum class Number`` in each vehicle's mode.h. Their names are those of ground stations and pymavlink
(``SMART_RTL``, ``FBWA``); different names in AVAILABLE_MODES are aliases.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

from aerokit.autopilots.base import (
    VTOLS,
    Autopilot,
    GimbalRules,
    Purpose,
    Reposition,
    SetpointRules,
    StickRules,
    TakeOff,
)
from aerokit.autopilots.external import ARDUPILOT_EXTERNAL, ExternalRules
from aerokit.autopilots.modes import Mode, ModeTable
from aerokit.autopilots.telemetry import ARDUPILOT_GROUPS, ATTITUDE_AND_HEIGHT, POS_HORIZ_ABS, bit_names
from aerokit.mavlink.enums import EkfStatusFlags, MavCmd, MavLandedState, MavState, MavType, SpeedType

if TYPE_CHECKING:
    from aerokit.mavlink.messages import Heartbeat

COPTER = ModeTable(
    {
        0: "STABILIZE",
        1: "ACRO",
        2: "ALT_HOLD",
        3: "AUTO",
        4: "GUIDED",
        5: "LOITER",
        6: "RTL",
        7: "CIRCLE",
        8: "POSITION",  # until 3.1
        9: "LAND",
        10: "OF_LOITER",  # until 3.3
        11: "DRIFT",
        13: "SPORT",
        14: "FLIP",
        15: "AUTOTUNE",
        16: "POSHOLD",
        17: "BRAKE",
        18: "THROW",
        19: "AVOID_ADSB",
        20: "GUIDED_NOGPS",
        21: "SMART_RTL",
        22: "FLOWHOLD",
        23: "FOLLOW",
        24: "ZIGZAG",
        25: "SYSTEMID",
        26: "AUTOROTATE",
        27: "AUTO_RTL",
        28: "TURTLE",
        29: "RATE_ACRO",
    }
)

PLANE = ModeTable(
    {
        0: "MANUAL",
        1: "CIRCLE",
        2: "STABILIZE",
        3: "TRAINING",
        4: "ACRO",
        5: "FBWA",
        6: "FBWB",
        7: "CRUISE",
        8: "AUTOTUNE",
        10: "AUTO",
        11: "RTL",
        12: "LOITER",
        13: "TAKEOFF",
        14: "AVOID_ADSB",
        15: "GUIDED",
        16: "INITIALISING",
        17: "QSTABILIZE",
        18: "QHOVER",
        19: "QLOITER",
        20: "QLAND",
        21: "QRTL",
        22: "QAUTOTUNE",
        23: "QACRO",
        24: "THERMAL",
        25: "LOITERALTQLAND",
        26: "AUTOLAND",
    },
    {"FLY_BY_WIRE_A": "FBWA", "FLY_BY_WIRE_B": "FBWB", "LOITER_TO_QLAND": "LOITERALTQLAND"},
)

ROVER = ModeTable(
    {
        0: "MANUAL",
        1: "ACRO",
        2: "LEARNING",  # until 3.2
        3: "STEERING",
        4: "HOLD",
        5: "LOITER",
        6: "FOLLOW",
        7: "SIMPLE",
        8: "DOCK",
        9: "CIRCLE",
        10: "AUTO",
        11: "RTL",
        12: "SMART_RTL",
        15: "GUIDED",
        16: "INITIALISING",
    }
)

SUB = ModeTable(
    {
        0: "STABILIZE",
        1: "ACRO",
        2: "ALT_HOLD",
        3: "AUTO",
        4: "GUIDED",
        7: "CIRCLE",
        9: "SURFACE",
        16: "POSHOLD",
        19: "MANUAL",
        20: "MOTOR_DETECT",
        21: "SURFTRAK",
    },
    {"DEPTH_HOLD": "ALT_HOLD"},
)

BLIMP = ModeTable(
    {
        0: "LAND",
        1: "MANUAL",
        2: "VELOCITY",
        3: "LOITER",
        4: "RTL",
        5: "AUTO",  # AUTO and HOLD are in pymavlink, but not in Blimp/mode.h.
        6: "HOLD",
    }
)

TRACKER = ModeTable({0: "MANUAL", 1: "STOP", 2: "SCAN", 3: "SERVOTEST", 4: "GUIDED", 10: "AUTO", 16: "INITIALISING"})

EKF_PROBLEMS: Mapping[int, str] = {
    EkfStatusFlags.UNINITIALIZED.value: "initialisation",
    EkfStatusFlags.GPS_GLITCHING.value: "GPS without glitches",
}

COPTERS = (
    MavType.QUADROTOR,
    MavType.COAXIAL,
    MavType.HELICOPTER,
    MavType.HEXAROTOR,
    MavType.OCTOROTOR,
    MavType.TRICOPTER,
    MavType.DODECAROTOR,
    MavType.DECAROTOR,
)


class ArduPilot(Autopilot):
    """Base class of ArduPilot's vehicles. Describes an ArduPilot vehicle of unknown type."""

    name = "ArduPilot"
    gimbals: GimbalRules = GimbalRules(has_secondary=False, roi_per_gimbal=False, roi_needs_control=False)
    firmware = "ArduPilot"
    home_is_item_0 = True
    runs_prearm_checks = True
    calibrates_compasses_by_command = True
    calibration_protocol = "acknowledgements"
    has_fixed_parameter_encoding = True
    parameter_interval_s: float | None = 0.02
    mission_storage = "ardupilot"
    mission_upload_window = 6
    mission_download_window = 10
    writes_partial_missions = True
    overwrites_plans_in_place: frozenset[int] = frozenset((0, 2))
    evaluates_incomplete_files = True
    hides_fence_at_boot = True
    erases_small_fences = True
    mission_completes_at_home = True
    mission_starts_by_command = True
    sets_current_by_command = True
    accepts_ftp_session_ids = True
    has_upper_case_parameters = True
    plan_size_parameters: frozenset[str] = frozenset(("FENCE_TOTAL", "MIS_TOTAL", "RALLY_TOTAL"))
    external: ExternalRules = ARDUPILOT_EXTERNAL
    log_suffix = ".bin"
    video_addresses_camera = True
    log_directories: ClassVar[tuple[str, str]] = ("/APM/LOGS", "/logs")
    first_log_id = 1
    prefers_log_messages = True
    stream_groups = ARDUPILOT_GROUPS
    # ATTITUDE_QUATERNION is not listed, because it is sent on request.
    unsupported_messages: frozenset[str] = frozenset(
        {
            "ESTIMATOR_STATUS",
            "WIND_COV",
            "ALTITUDE",
            "CURRENT_MODE",
            "ODOMETRY",
            "HIL_STATE_QUATERNION",
            "ACTUATOR_CONTROL_TARGET",
        }
    )
    highres_imu_field_ut: float = 1e-4
    reports_gripper_by_text = True
    winch_actions: frozenset[int] = frozenset()

    def missing_estimates(self, flags: int) -> tuple[str, ...]:
        return (
            *self._missing_estimates(
                flags, required=ATTITUDE_AND_HEIGHT, horizontal=POS_HORIZ_ABS | EkfStatusFlags.PRED_POS_HORIZ_ABS.value
            ),
            *bit_names(flags, EKF_PROBLEMS),
        )

    def arming_reason(self, text: str) -> str | None:
        return _text_after(text, "PreArm: ", "Arm: ")

    def is_refusal(self, text: str) -> bool:
        lower_text = text.lower()
        return super().is_refusal(text) or ("mode change" in lower_text and "failed" in lower_text)

    def _git_hash(self, custom_version: bytes) -> str:
        return custom_version.split(b"\0")[0].decode("ascii", "replace")


class ArduCopter(ArduPilot):
    """ArduCopter: multicopters and helicopters."""

    firmware = "ArduCopter"
    has_vtols = False
    winch_actions: frozenset[int] = frozenset((0, 1, 2))
    mission_needs_take_off = True  # ModeAuto::init refuses the mission with "Auto: Missing Takeoff Cmd".
    modes: ModeTable = COPTER
    purposes: ClassVar[Mapping[str, str]] = {
        "hold": "BRAKE",  # LOITER follows the throttle stick, which is down or absent while a program flies.
        "land": "LAND",
        "precision_land": "LAND",  # LAND uses the target if PLND_ENABLED is 1.
        "return": "RTL",
        "setpoint": "GUIDED",
        "sticks": "LOITER",
        "take_off": "GUIDED",
        "mission": "AUTO",
    }
    sticks: StickRules | None = StickRules()
    setpoints: SetpointRules = SetpointRules(body_yaw_is_relative=True, attitude_rate=True, trajectory=True)
    reposition: Reposition | None = Reposition(relative_altitude=True, yaw=False, speed=False)
    # ArduCopter treats SPEED_TYPE_AIRSPEED as the ground speed (GCS_MAVLink_Copter.cpp,
    # handle_MAV_CMD_DO_CHANGE_SPEED).
    speed_types: frozenset[int] = frozenset((SpeedType.GROUNDSPEED, SpeedType.CLIMB_SPEED))
    condition_yaw = True
    lands_after_return = True
    auto_disarm_parameter: ClassVar[str | None] = "DISARM_DELAY"
    # ArduCopter does not have MAV_CMD_DO_ORBIT, and its mode CIRCLE follows the throttle stick (mode_circle.cpp).
    circles_by: Literal["orbit", "reposition", "setpoints"] | None = "setpoints"
    arming_mode: ClassVar[str | None] = "GUIDED"
    unarmable_modes: frozenset[str] = frozenset(
        {
            "AUTOROTATE",
            "AUTOTUNE",
            "AUTO_RTL",
            "AVOID_ADSB",
            "BRAKE",
            "CIRCLE",
            "FLIP",
            "FOLLOW",
            "LAND",
            "RTL",
            "SMART_RTL",
            "SYSTEMID",
        }
    )
    armable_by_option: Mapping[str, str] = {"AUTO": "AUTO_OPTIONS"}
    modes_without_position: frozenset[str] = frozenset(
        ("ACRO", "ALT_HOLD", "FLOWHOLD", "GUIDED_NOGPS", "SPORT", "STABILIZE")
    )

    def take_off(self, altitude_relative_m: float, home_altitude_amsl_m: float | None, *, is_vtol: bool) -> TakeOff:
        # The vehicle stays in GUIDED after the take-off.
        params = (0, 0, 0, 0, 0, 0, altitude_relative_m)
        guided = self.modes.find("GUIDED")
        return TakeOff(mode=guided, command=MavCmd.NAV_TAKEOFF, params=params, mode_after=None)

    def landed_state_of(self, heartbeat: Heartbeat) -> int | None:
        # STANDBY means on the ground, ACTIVE in the air. CRITICAL, the state in a failsafe, may mean either.
        return _landed_state(heartbeat)

    def return_altitude_parameters(self, *, is_vtol: bool) -> tuple[tuple[str, float], ...]:
        return (("RTL_ALT_M", 1.0), ("RTL_ALT", 100.0))


class ArduPlane(ArduPilot):
    """ArduPlane: planes, and VTOL planes, which ArduPilot calls QuadPlanes."""

    firmware = "ArduPlane"
    modes: ModeTable = PLANE
    purposes: ClassVar[Mapping[str, str]] = {
        "hold": "LOITER",
        "land": "AUTOLAND",
        "return": "RTL",
        "setpoint": "GUIDED",
        "sticks": "FBWA",
        "take_off": "TAKEOFF",
        "mission": "AUTO",
    }
    sticks: StickRules | None = StickRules()
    setpoints: SetpointRules = SetpointRules(
        local_position=False, global_position=False, velocity=False, acceleration=False
    )
    reposition: Reposition | None = Reposition(relative_altitude=True, yaw=False, speed=False)
    speed_types: frozenset[int] = frozenset((SpeedType.AIRSPEED, SpeedType.GROUNDSPEED))
    arrival_radius_m: float = 90.0  # A plane circles with WP_LOITER_RAD, 60 m by default.
    circles_by: Literal["orbit", "reposition", "setpoints"] | None = "reposition"
    # Armed in TAKEOFF or AUTO, a plane starts its motor by itself (takeoff.cpp, auto_takeoff_check). It stays in this
    # mode when it disarms. With FS_LONG_ACTN 4, a failsafe on the ground changes to AUTO (events.cpp).
    modes_starting_flight: frozenset[str] = frozenset(("AUTO", "TAKEOFF"))
    arming_mode: ClassVar[str | None] = "FBWA"
    # The hold mode LOITER flies forward at the present height: after a hold at 1 m, a plane and a QuadPlane hit the
    # ground (4.7, SITL).
    must_complete_take_off = True
    unarmable_modes: frozenset[str] = frozenset(("AUTOLAND", "INITIALISING", "QLAND", "QRTL", "RTL"))

    def _purpose_name(self, purpose: Purpose, is_vtol: bool) -> str | None:
        if self._can_hover(is_vtol) and purpose in _QUADPLANE:
            return _QUADPLANE[purpose]
        return super()._purpose_name(purpose, is_vtol)

    def return_modes(self, *, is_vtol: bool = False) -> tuple[Mode, ...]:
        # At the end of a mission, a QuadPlane returns in RTL as well, which Q_RTL_MODE may change to QRTL at home.
        names = ("QRTL", "RTL") if self._can_hover(is_vtol) else ("RTL",)
        return tuple(self.modes.find(name) for name in names)

    def lands_at_home(self, return_mode: Mode) -> bool:
        return return_mode.name == "QRTL"

    def take_off(self, altitude_relative_m: float, home_altitude_amsl_m: float | None, *, is_vtol: bool) -> TakeOff:
        # A QuadPlane climbs in GUIDED, a plane in TAKEOFF, to its parameter TKOFF_ALT. Both stay there.
        if self._can_hover(is_vtol):
            params = (0, 0, 0, 0, 0, 0, altitude_relative_m)
            guided = self.modes.find("GUIDED")
            return TakeOff(mode=guided, command=MavCmd.NAV_TAKEOFF, params=params, mode_after=None)
        take_off = self.modes.find("TAKEOFF")
        return TakeOff(mode=take_off, command=None, params=(), mode_after=None)

    def landed_state_of(self, heartbeat: Heartbeat) -> int | None:
        return _landed_state(heartbeat)

    def return_altitude_parameters(self, *, is_vtol: bool) -> tuple[tuple[str, float], ...]:
        if self._can_hover(is_vtol):
            return (("Q_RTL_ALT", 1.0),)  # A vehicle with this parameter returns in QRTL.
        return (("RTL_ALTITUDE", 1.0), ("ALT_HOLD_RTL", 100.0))

    def _can_hover(self, is_vtol: bool) -> bool:
        return is_vtol or self.vehicle_type in VTOLS


_QUADPLANE: Mapping[str, str] = {"land": "QLAND", "return": "QRTL", "sticks": "QLOITER", "take_off": "GUIDED"}


class ArduRover(ArduPilot):
    """ArduRover: rovers and boats."""

    firmware = "Rover"
    has_vtols = False
    # MISSION_START only changes the mode (GCS_MAVLink_Rover.cpp).
    restarts_mission_by_reset = True
    is_surface_vehicle = True
    modes: ModeTable = ROVER
    purposes: ClassVar[Mapping[str, str]] = {
        "hold": "HOLD",
        "return": "RTL",
        "setpoint": "GUIDED",
        "sticks": "MANUAL",
        "mission": "AUTO",
    }
    sticks: StickRules | None = StickRules(signed_throttle=True)
    setpoints: SetpointRules = SetpointRules(acceleration=False, body_yaw_is_relative=True)
    reposition: Reposition | None = Reposition(relative_altitude=True, yaw=False, speed=False)
    arrival_radius_m: float = 4.0
    arming_mode: ClassVar[str | None] = "HOLD"
    unarmable_modes: frozenset[str] = frozenset(("RTL", "SMART_RTL", "INITIALISING"))
    modes_without_position: frozenset[str] = frozenset(("HOLD", "MANUAL"))

    def _purpose_name(self, purpose: Purpose, is_vtol: bool) -> str | None:
        if purpose == "hold" and self.vehicle_type == MavType.SURFACE_BOAT:
            return "LOITER"  # In HOLD the motors are off, and a boat would drift.
        return super()._purpose_name(purpose, is_vtol)


class ArduSub(ArduPilot):
    """ArduSub: remotely operated and autonomous underwater vehicles."""

    firmware = "ArduSub"
    has_vtols = False
    # MISSION_START only changes the mode (GCS_MAVLink_Sub.cpp).
    restarts_mission_by_reset = True
    modes: ModeTable = SUB
    purposes: ClassVar[Mapping[str, str]] = {
        "hold": "POSHOLD",
        "land": "SURFACE",
        "setpoint": "GUIDED",
        "sticks": "ALT_HOLD",
        "mission": "AUTO",
    }
    sticks: StickRules | None = StickRules(release="channels")
    setpoints: SetpointRules = SetpointRules(acceleration=False, position_restarts_path=True)
    mode_when_landed: ClassVar[str | None] = "ALT_HOLD"  # The mode in which the vehicle stays at the surface.
    reposition: Reposition | None = Reposition(relative_altitude=True, yaw=False, speed=False)
    condition_yaw = True


class Blimp(ArduPilot):
    """ArduPilot's Blimp: airships."""

    firmware = "Blimp"
    modes: ModeTable = BLIMP
    purposes: ClassVar[Mapping[str, str]] = {"hold": "LOITER", "land": "LAND", "return": "RTL"}


class AntennaTracker(ArduPilot):
    """ArduPilot's antenna tracker."""

    firmware = "AntennaTracker"
    modes: ModeTable = TRACKER
    purposes: ClassVar[Mapping[str, str]] = {"hold": "STOP", "setpoint": "GUIDED"}


_BY_TYPE: Mapping[int, type[ArduPilot]] = {
    MavType.FIXED_WING: ArduPlane,
    MavType.GROUND_ROVER: ArduRover,
    MavType.SURFACE_BOAT: ArduRover,
    MavType.SUBMARINE: ArduSub,
    MavType.ANTENNA_TRACKER: AntennaTracker,
    MavType.AIRSHIP: Blimp,
    **dict.fromkeys(VTOLS, ArduPlane),
    **dict.fromkeys(COPTERS, ArduCopter),
}


def ardupilot_for(vehicle_type: int) -> ArduPilot:
    return _BY_TYPE.get(vehicle_type, ArduPilot)(vehicle_type)


def _landed_state(heartbeat: Heartbeat) -> int | None:
    if heartbeat.system_status == MavState.STANDBY:
        return MavLandedState.ON_GROUND
    return MavLandedState.IN_AIR if heartbeat.system_status == MavState.ACTIVE else None


def _text_after(text: str, *prefixes: str) -> str | None:
    """Return the text without its prefix, or None if it has none of the prefixes."""
    return next((text[len(prefix) :].strip() for prefix in prefixes if text.startswith(prefix)), None)
