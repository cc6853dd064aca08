"""PX4 (https://docs.px4.io/main/en/mavlink/): main and sub modes, and PX4's special behaviour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

from aerokit.autopilots.base import (
    NAN,
    VTOLS,
    Autopilot,
    GimbalRules,
    ModeOrder,
    Purpose,
    Reposition,
    SetpointRules,
    StickRules,
    TakeOff,
    mode_numbers,
)
from aerokit.autopilots.external import PX4_EXTERNAL, ExternalRules
from aerokit.autopilots.modes import CUSTOM_MODE_ENABLED, NO_MODES, Mode, ModeTable
from aerokit.autopilots.telemetry import ATTITUDE_AND_HEIGHT, POS_HORIZ_ABS, PREARM_CHECK, SENSORS, bit_names
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import EstimatorStatusFlags, MavCmd, MavType, SpeedType

MAIN_POSCTL, MAIN_AUTO, SUB_MISSION = 3, 4, 4
ESTIMATES_REQUIRED = (
    ATTITUDE_AND_HEIGHT | EstimatorStatusFlags.VELOCITY_HORIZ.value | EstimatorStatusFlags.VELOCITY_VERT.value
)
ESTIMATOR_PROBLEMS: Mapping[int, str] = {
    EstimatorStatusFlags.GPS_GLITCH.value: "GPS without glitches",
    EstimatorStatusFlags.ACCEL_ERROR.value: "accelerometer without errors",
}


def px4_custom_mode(main: int, sub: int = 0) -> int:
    """Compose PX4's custom_mode: the main mode is the third byte, the sub mode the fourth."""
    return main << 16 | sub << 24


def _auto(sub: int) -> int:
    """Return the custom_mode of a sub mode of AUTO."""
    return px4_custom_mode(MAIN_AUTO, sub)


# The numbers are from px4_custom_mode.h, the names from pymavlink. Names that QGroundControl uses are aliases.
MODES = ModeTable(
    {
        px4_custom_mode(1): "MANUAL",
        px4_custom_mode(2): "ALTCTL",
        px4_custom_mode(MAIN_POSCTL): "POSCTL",
        px4_custom_mode(MAIN_POSCTL, 1): "ORBIT",
        px4_custom_mode(MAIN_POSCTL, 2): "POSITION_SLOW",
        _auto(1): "READY",
        _auto(2): "TAKEOFF",
        _auto(3): "LOITER",
        _auto(4): "MISSION",
        _auto(5): "RTL",
        _auto(6): "LAND",
        _auto(7): "RTGS",  # until 1.10
        _auto(8): "FOLLOWME",
        _auto(9): "PRECLAND",
        _auto(10): "VTOL_TAKEOFF",
        **{_auto(10 + number): f"EXTERNAL{number}" for number in range(1, 9)},
        px4_custom_mode(5): "ACRO",
        px4_custom_mode(6): "OFFBOARD",
        px4_custom_mode(7): "STABILIZED",
        px4_custom_mode(8): "RATTITUDE",  # until 1.12
        px4_custom_mode(9): "SIMPLE",
        px4_custom_mode(10): "TERMINATION",
        px4_custom_mode(11): "ALTITUDE_CRUISE",
    },
    {
        **{f"AUTO.{name}": name for name in ("READY", "TAKEOFF", "LOITER", "MISSION", "RTL", "LAND", "PRECLAND")},
        "AUTO.FOLLOW_TARGET": "FOLLOWME",
        "FOLLOW_TARGET": "FOLLOWME",
        "ALTITUDE": "ALTCTL",
        "POSITION": "POSCTL",
        "HOLD": "LOITER",
        "RETURN": "RTL",
        "STABILIZE": "STABILIZED",
        "PRECISION_LANDING": "PRECLAND",
        "DESCEND": "LAND",
    },
)

_EXTERNAL_MODES = range(_auto(11), _auto(19))


class Px4(Autopilot):
    """PX4, for all vehicle types."""

    name = "PX4"
    firmware = "PX4"
    signing_key_restriction = "PX4 accepts a signing key only on its USB port, and before 1.17 on no port"
    modes = MODES
    modes_are_numbered = False
    # PX4's MAVLink module acknowledges DO_SET_MODE at once with ACCEPTED. Later, the commander acknowledges the result.
    acks_per_command: ClassVar[Mapping[int, int]] = {MavCmd.DO_SET_MODE: 2}
    setpoints: SetpointRules = SetpointRules(stream_before_mode=True, attitude_rate=True, trajectory=True)
    sticks: StickRules | None = StickRules(release="none")
    external: ExternalRules = PX4_EXTERNAL
    actuators_until: tuple[int, int] | None = (1, 14)  # PX4's commit 27658354 removed SET_ACTUATOR_CONTROL_TARGET.
    reposition: Reposition | None = Reposition(relative_altitude=False, yaw=True, speed=True)
    gimbals: GimbalRules = GimbalRules(
        has_secondary=False,
        supports_retract=False,
        supports_pitchyaw=False,
        supports_roi_sysid=False,
        roi_per_gimbal=False,
        roi_needs_control=False,
    )
    log_suffix = ".ulg"
    log_directories: ClassVar[tuple[str, str]] = ("/fs/microsd/log", "/log")
    silent_without_logs = True
    _bytewise_by_default = True
    has_fixed_parameter_encoding = True
    has_parameter_hash = True
    unknown_currents_ca: frozenset[int] = frozenset((-1, -100))  # PX4 may send an unknown current as −1 A (-100).
    reposition_purpose: Purpose = "hold"
    holds_after_mission = True
    mission_end_text: str | None = "Mission finished"  # mission_base.cpp
    # PX4 sends this text if it has no mission, and if a finished mission is started without selecting an item
    # (mission_base.cpp, update_mission).
    no_mission_text: str | None = "No valid mission available"
    prearm_depends_on_mode = True
    # PX4 answers by a status text for each failing check (Commander.cpp; measured with 1.17 in simulation).
    runs_prearm_checks = True
    # Modes that need an RC receiver (mode_requirements.cpp). The receiver's health bit says whether these modes can be
    # used, even if another mode is active (modeCheck.cpp).
    modes_with_rc: frozenset[str] | None = frozenset(
        ("MANUAL", "ALTCTL", "POSCTL", "POSITION_SLOW", "ALTITUDE_CRUISE", "ACRO", "STABILIZED", "RATTITUDE", "SIMPLE")
    )
    auto_disarm_parameter: ClassVar[str | None] = "COM_DISARM_PRFLT"
    has_status_text_id_0 = True  # The first text after the start of a link has id 0 (STATUSTEXT.hpp).
    calibration_protocol = "texts"
    camera_by_trigger_only = True
    arming_mode: ClassVar[str | None] = "LOITER"
    # Commander.cpp of 1.17 refuses these modes. External modes can be selected by the names that the vehicle reports,
    # but not as EXTERNAL1 to EXTERNAL8.
    unselectable_modes: frozenset[str] = frozenset(
        ("ORBIT", "RATTITUDE", "READY", "RTGS", "SIMPLE", "TERMINATION", "VTOL_TAKEOFF")
    ).union(f"EXTERNAL{number}" for number in range(1, 9))
    # Modes in which PX4 does not arm (mode_requirements.cpp), and OFFBOARD, which needs a stream of set-points.
    unarmable_modes: frozenset[str] = frozenset(
        ("FOLLOWME", "LAND", "OFFBOARD", "ORBIT", "PRECLAND", "RTL", "TERMINATION")
    )
    # The navigator executes these modes as soon as the vehicle is armed. When a vehicle disarms, it returns to the last
    # mode that allows arming (UserModeIntention.cpp, onDisarm): to MISSION after a return that interrupted a mission.
    modes_starting_flight: frozenset[str] = frozenset(("MISSION", "TAKEOFF", "VTOL_TAKEOFF"))
    purposes: ClassVar[Mapping[str, str]] = {
        "hold": "LOITER",
        "land": "LAND",
        "precision_land": "PRECLAND",
        "return": "RTL",
        "setpoint": "OFFBOARD",
        "sticks": "POSCTL",
        "take_off": "TAKEOFF",
        "mission": "MISSION",
    }
    can_shut_down = True
    tunes_by_command = True
    mission_storage = "px4"
    mission_upload_window = 6
    reports_mission_checksum = True
    overwrites_plans_in_place: frozenset[int] = frozenset()  # PX4 writes a new plan into a second storage area.
    repeats_item_reached = True
    completes_mission_in_other_modes = True  # takeoff.cpp and land.cpp set mission_result.finished.
    unsupported_messages: frozenset[str] = frozenset(
        ("EKF_STATUS_REPORT", "WIND", "RANGEFINDER", "AHRS", "AHRS2", "MEMINFO", "POWER_STATUS", "RAW_IMU")
    )

    has_shell = True
    winch_actions: frozenset[int] = frozenset()  # PX4 passes DO_WINCH on to other components, and ignores it itself.

    def __init__(self, vehicle_type: int) -> None:
        super().__init__(vehicle_type)
        self.is_surface_vehicle: bool = vehicle_type in (MavType.GROUND_ROVER, MavType.SURFACE_BOAT)
        self.circles_by: Literal["orbit", "reposition", "setpoints"] | None = None if self._cannot_fly else "orbit"
        self.lands_after_return: bool = not self._cannot_fly and vehicle_type != MavType.FIXED_WING
        if vehicle_type == MavType.FIXED_WING or vehicle_type in VTOLS:
            # Only the fixed-wing controller uses an airspeed. PX4 applies every other SPEED_TYPE to the cruise speed,
            # even CLIMB_SPEED (navigator_main.cpp).
            self.speed_types: frozenset[int] = frozenset((SpeedType.AIRSPEED, SpeedType.GROUNDSPEED))
        if vehicle_type == MavType.FIXED_WING:
            # A plane circles its target with NAV_LOITER_RAD (80 m by default), so it never comes closer.
            self.arrival_radius_m: float = 120.0

    def mode(self, custom_mode: int, base_mode: int, reported_names: Mapping[int, str] = NO_MODES) -> Mode:
        """Return the mode with these numbers. An external mode has its registered name, if that is known."""
        if custom_mode in _EXTERNAL_MODES and custom_mode in reported_names:
            return Mode(reported_names[custom_mode], custom_mode, base_mode)
        return super().mode(custom_mode, base_mode, reported_names)

    def find_mode(self, mode: str | int | Mode, reported_names: Mapping[int, str] = NO_MODES) -> Mode:
        """Find a mode by name or number. External modes are also found by their registered names."""
        found_mode = super().find_mode(mode, reported_names)
        return Mode(reported_names.get(found_mode.custom_mode, found_mode.name), found_mode.custom_mode)

    def mode_order(self, mode: Mode) -> ModeOrder:
        # param2 is the main mode, param3 the sub mode.
        main = mode.custom_mode >> 16 & 0xFF
        sub = mode.custom_mode >> 24
        return ModeOrder((CUSTOM_MODE_ENABLED, main, sub), CUSTOM_MODE_ENABLED, mode.custom_mode)

    def _modes_of_do_set_mode(self, params: Sequence[float], reported_names: Mapping[int, str]) -> tuple[Mode, ...]:
        base_mode, main, sub = mode_numbers((*params, 0.0, 0.0, 0.0)[:3])  # Missing parameters are 0.
        if not base_mode & CUSTOM_MODE_ENABLED:
            return ()
        if main == MAIN_AUTO and not sub:
            sub = SUB_MISSION  # PX4's default
        return (self.mode(px4_custom_mode(main & 0xFF, sub & 0xFF), CUSTOM_MODE_ENABLED, reported_names),)

    def learn_mode_name(self, custom_mode: int, name: str) -> str | None:
        """Like the method of the base class, but a reported name replaces EXTERNAL1 to EXTERNAL8."""
        if name.startswith("("):  # "(Mode not available)": this external mode is not registered
            return None
        if custom_mode in _EXTERNAL_MODES:
            return name or None
        return super().learn_mode_name(custom_mode, name)

    def take_off(
        self, altitude_relative_m: float, home_altitude_amsl_m: float | None, *, is_vtol: bool
    ) -> TakeOff | None:
        """Return the procedure: NAV_TAKEOFF to the altitude, at the current position and heading, then LOITER.

        None for vehicles that cannot fly.

        Raises:
            InvalidArgument: the altitude of home is not given.
        """
        if self._cannot_fly:
            return None
        if home_altitude_amsl_m is None:
            raise InvalidArgument("take-off on PX4 needs the altitude of home: NAV_TAKEOFF is above mean sea level")
        altitude_amsl_m = home_altitude_amsl_m + altitude_relative_m
        # NaN leaves pitch, heading, latitude and longitude to PX4.
        params = (NAN, 0, 0, NAN, NAN, NAN, altitude_amsl_m)
        loiter = self.modes.find("LOITER")
        return TakeOff(mode=None, command=MavCmd.NAV_TAKEOFF, params=params, mode_after=loiter)

    def return_altitude_parameters(self, *, is_vtol: bool) -> tuple[tuple[str, float], ...]:
        return () if self._cannot_fly else (("RTL_RETURN_ALT", 1.0),)

    def take_off_needs_home(self) -> bool:
        """Return True, because PX4's NAV_TAKEOFF needs an altitude above mean sea level."""
        return not self._cannot_fly

    def failing_sensors(self, present: int, enabled: int, health: int) -> tuple[str, ...]:
        # A sensor that is required but missing is reported as enabled but not present.
        missing = bit_names(enabled & ~present & ~health & ~PREARM_CHECK, SENSORS)
        return (*super().failing_sensors(present, enabled, health), *(f"{name} (missing)" for name in missing))

    def prearm_checks_pass(self, present: int, enabled: int, health: int) -> bool:
        # PX4 sets this bit only in ``health``, and only if the vehicle can be armed in its current mode.
        return bool(health & PREARM_CHECK)

    def missing_estimates(self, flags: int) -> tuple[str, ...]:
        missing = self._missing_estimates(flags, required=ESTIMATES_REQUIRED, horizontal=POS_HORIZ_ABS)
        return (*missing, *bit_names(flags, ESTIMATOR_PROBLEMS))

    def arming_reason(self, text: str) -> str | None:
        for prefix in ("Preflight Fail: ", "Preflight: ", "Arming denied: ", "Arming denied! "):
            if text.startswith(prefix):
                return text[len(prefix) :].strip()
        return None

    def is_refusal(self, text: str) -> bool:
        return super().is_refusal(text) or "limit exceeded" in text.lower()  # "Orbit radius limit exceeded"

    def _purpose_name(self, purpose: Purpose, is_vtol: bool) -> str | None:
        if self._cannot_fly and purpose in ("take_off", "land"):
            return None
        return super()._purpose_name(purpose, is_vtol)

    @property
    def _cannot_fly(self) -> bool:
        return self.vehicle_type in (MavType.GROUND_ROVER, MavType.SURFACE_BOAT, MavType.SUBMARINE)

    def _git_hash(self, custom_version: bytes) -> str:
        # The bytes of the commit hash are in reverse order, after three bytes with the vendor's version.
        return custom_version[3:8][::-1].hex() if any(custom_version[3:8]) else ""
