"""``Autopilot``: describes everything that differs between autopilots."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

from aerokit._internal.values import Snapshot
from aerokit.autopilots.external import ExternalRules
from aerokit.autopilots.modes import CUSTOM_MODE_ENABLED, NO_MODES, Mode, ModeTable, base_mode_name
from aerokit.autopilots.telemetry import (
    ATTITUDE_AND_HEIGHT,
    ESTIMATES,
    POS_HORIZ_ABS,
    PREARM_CHECK,
    SENSORS,
    AutopilotVersion,
    bit_names,
    version_text,
)
from aerokit.mavlink import messages
from aerokit.mavlink.enums import MavCmd, MavProtocolCapability, MavType, SpeedType

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.mavlink.message import Message

NAN = math.nan
_BYTEWISE = MavProtocolCapability.PARAM_ENCODE_BYTEWISE.value
_C_CAST = MavProtocolCapability.PARAM_ENCODE_C_CAST.value

Purpose = Literal["hold", "land", "precision_land", "return", "setpoint", "sticks", "take_off", "mission"]
"""Purpose for which a program uses a mode."""

# Maps a MAV_CMD to the purposes of the modes that it may lead to, on any autopilot.
PURPOSES_OF_COMMANDS: Mapping[int, tuple[Purpose, ...]] = {
    MavCmd.NAV_RETURN_TO_LAUNCH: ("return",),
    MavCmd.NAV_LAND: ("land",),
    MavCmd.NAV_VTOL_LAND: ("land",),
    MavCmd.NAV_TAKEOFF: ("take_off", "hold", "setpoint"),
    MavCmd.NAV_VTOL_TAKEOFF: ("take_off", "hold", "setpoint"),
    MavCmd.MISSION_START: ("mission",),
    MavCmd.DO_REPOSITION: ("setpoint", "hold"),
    MavCmd.NAV_LOITER_UNLIM: ("hold",),
    MavCmd.DO_PAUSE_CONTINUE: ("hold", "mission"),
    MavCmd.OVERRIDE_GOTO: ("hold", "mission"),
    MavCmd.DO_ORBIT: ("setpoint", "hold"),
}
# Maps a MAV_CMD to the names of further modes that it may lead to, on autopilots that have these modes.
NAMES_OF_COMMANDS: Mapping[int, tuple[str, ...]] = {
    MavCmd.NAV_LOITER_UNLIM: ("LOITER",),
    MavCmd.DO_ORBIT: ("ORBIT", "CIRCLE"),
    MavCmd.DO_FLIGHTTERMINATION: ("TERMINATION",),
}


VTOLS = (
    MavType.VTOL_TAILSITTER_DUOROTOR,
    MavType.VTOL_TAILSITTER_QUADROTOR,
    MavType.VTOL_TILTROTOR,
    MavType.VTOL_FIXEDROTOR,
    MavType.VTOL_TAILSITTER,
    MavType.VTOL_TILTWING,
    MavType.VTOL_RESERVED5,
)


class TakeOff(Snapshot):
    """Take-off procedure of a vehicle.

    The caller changes to ``mode`` (None: the current mode is kept), arms, and sends ``command`` with ``params``. If
    ``command`` is None, the vehicle takes off when it is armed in ``mode``. After the take-off, the vehicle changes to
    ``mode_after`` by itself (None: the vehicle stays in ``mode``).
    """

    mode: Mode | None
    command: int | None
    params: tuple[float, ...]
    mode_after: Mode | None


class SetpointRules(Snapshot):
    """Kinds of set-points that an autopilot supports, and how it handles a stream of set-points.

    - ``stream_before_mode``: the stream must be running before the mode is requested.
    - ``body_yaw_is_relative``: in MAV_FRAME_BODY_NED, yaw is relative to the current heading.
    - ``position_restarts_path``: each position set-point restarts the path from a standstill, even if the position is
      unchanged.
    - ``trajectory``: set-points with position, velocity and acceleration are supported.
    """

    local_position: bool = True
    global_position: bool = True
    velocity: bool = True
    acceleration: bool = True
    attitude: bool = True
    stream_before_mode: bool = False
    body_yaw_is_relative: bool = False
    position_restarts_path: bool = False
    attitude_rate: bool = False
    trajectory: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the supported kinds of set-points."""
        kinds = "local_position global_position velocity acceleration attitude attitude_rate trajectory"
        return tuple(kind.replace("_", " ") for kind in kinds.split() if getattr(self, kind))


class StickRules(Snapshot):
    """How an autopilot interprets MANUAL_CONTROL.

    - ``signed_throttle``: if True, the throttle ranges from −1000 to 1000; otherwise from 0 to 1000.
    - ``release``: the message that returns control to the transmitter. ``"axes"``: MANUAL_CONTROL with axes that have
      no value; ``"channels"``: RC_CHANNELS_OVERRIDE with channels of 0; ``"none"``: the autopilot has no such message.
    """

    signed_throttle: bool = False
    release: Literal["axes", "channels", "none"] = "axes"


class GimbalRules(Snapshot):
    """Support of the gimbal protocol v2 by the autopilot's gimbal manager. The defaults follow the standard.

    - ``has_secondary``: the manager supports secondary control by another system.
    - ``supports_retract``: the manager executes GIMBAL_MANAGER_FLAGS_RETRACT.
    - ``supports_pitchyaw``: the manager accepts rates by GIMBAL_MANAGER_SET_PITCHYAW; otherwise by
      GIMBAL_MANAGER_SET_ATTITUDE.
    - ``supports_roi_sysid``: the manager supports MAV_CMD_DO_SET_ROI_SYSID.
    - ``roi_per_gimbal``: a region of interest applies to the gimbal named in the command; otherwise always to the first
      gimbal.
    - ``roi_needs_control``: the manager denies a region of interest to systems that are not in control.
    """

    has_secondary: bool = True
    supports_retract: bool = True
    supports_pitchyaw: bool = True
    supports_roi_sysid: bool = True
    roi_per_gimbal: bool = True
    roi_needs_control: bool = True


class Reposition(Snapshot):
    """How an autopilot interprets MAV_CMD_DO_REPOSITION (192).

    - ``relative_altitude``: frames relative to home are supported; otherwise the altitude must be above mean sea level.
    - ``yaw``: param4 is a heading in radians.
    - ``speed``: param1 sets the ground speed.
    """

    relative_altitude: bool
    yaw: bool
    speed: bool


class ModeOrder(Snapshot):
    """Parameters of MAV_CMD_DO_SET_MODE (176), and fields of the older SET_MODE message (11)."""

    params: tuple[float, float, float]
    base_mode: int
    custom_mode: int

    def legacy(self, target_system: int) -> messages.SetMode:
        """Return the SET_MODE message, which has no acknowledgement."""
        return messages.SetMode(target_system, self.base_mode, self.custom_mode)


def mode_numbers(params: Sequence[float]) -> list[int]:
    """Convert command parameters to mode numbers. Invalid parameters become 0."""
    return [int(param) if 0 <= param < 2**32 else 0 for param in params]


class Autopilot:
    """Description of an autopilot and vehicle type. The base class describes unknown autopilots.

    Each object describes one vehicle, and is created from its first HEARTBEAT. It has no state and does no IO.
    """

    name = "unknown autopilot"
    firmware = "unknown"
    """Name of the firmware for this vehicle type, for example ``"ArduCopter"``."""
    modes: ModeTable = ModeTable({})
    modes_are_numbered = True
    """True if users also refer to modes by number."""
    purposes: ClassVar[Mapping[str, str]] = {}
    """Maps purposes to names of modes."""
    setpoints: SetpointRules = SetpointRules(
        local_position=False, global_position=False, velocity=False, acceleration=False, attitude=False
    )
    external: ExternalRules = ExternalRules()
    """External measurements that the autopilot accepts by MAVLink."""
    sticks: StickRules | None = None
    """How the autopilot interprets MANUAL_CONTROL; None if the message is not known to work."""
    actuators_until: tuple[int, int] | None = None
    """First version (major, minor) without SET_ACTUATOR_CONTROL_TARGET; None if no version has ever had it."""
    reposition: Reposition | None = None
    """How the autopilot interprets MAV_CMD_DO_REPOSITION; None if the command is not known to work."""
    home_is_item_0 = False
    """True if item 0 of a mission is home."""
    acks_per_command: ClassVar[Mapping[int, int]] = {}
    """Maps a MAV_CMD to the number of COMMAND_ACKs for each transmission, if there is more than one."""
    signing_key_restriction = ""
    """Clause for error texts that names the links on which SETUP_SIGNING is accepted; empty if all links are."""
    runs_prearm_checks = False
    """True if MAV_CMD_RUN_PREARM_CHECKS (401) repeats the failing checks as status texts."""
    calibrates_compasses_by_command = False
    """True if MAV_CMD_DO_START_MAG_CAL (42424) calibrates compasses; otherwise PREFLIGHT_CALIBRATION does."""
    speed_types: frozenset[int] = frozenset((SpeedType.GROUNDSPEED,))
    """SPEED_TYPEs that MAV_CMD_DO_CHANGE_SPEED (178) supports. Any other type changes no speed, or another speed."""
    circles_by: Literal["orbit", "reposition", "setpoints"] | None = None
    """Way to circle a place: MAV_CMD_DO_ORBIT (34), DO_REPOSITION (192) with a radius, or set-points; None if there is
    none.
    """
    tunes_by_command = False
    """True if MAV_CMD_DO_AUTOTUNE_ENABLE (212) tunes the controllers without a pilot, and reports its progress."""
    can_shut_down = False
    """True if MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN (246) can switch the autopilot off."""
    condition_yaw = False
    """True if MAV_CMD_CONDITION_YAW (115) turns the vehicle in its mode for set-points (GUIDED, OFFBOARD)."""
    reposition_purpose: Purpose = "setpoint"
    """Purpose of the mode that DO_REPOSITION changes to."""
    lands_after_return = False
    """True if the return mode ends with a landing. Depends on the mode if `lands_at_home` is overridden."""
    arrival_radius_m: float = 2.0
    """Default distance in metres within which the vehicle counts as arrived.

    For a fixed wing, this distance includes the circle that the vehicle flies.
    """
    mission_storage = "any"
    """Conversions that the autopilot applies to stored mission items: an :class:`aerokit.missions.ItemStorage`."""
    mission_upload_window = 1
    """Number of mission items that may be sent before they are requested. The standard allows 1."""
    mission_download_window = 1
    """Number of mission items that may be requested at once, in any order. The standard allows 1."""
    writes_partial_missions = False
    """True if MISSION_WRITE_PARTIAL_LIST (38) works."""
    reports_mission_checksum = False
    """True if MISSION_CURRENT has checksums of the stored plans."""
    overwrites_plans_in_place: frozenset[int] = frozenset((0, 1, 2))
    """MAV_MISSION_TYPEs whose old items are overwritten during an upload. For other types, old items stay until the
    upload is complete.
    """
    evaluates_incomplete_files = False
    """True if an incomplete upload of a virtual file, such as ``@PARAM/param.pck``, takes effect when it is closed."""
    hides_fence_at_boot = False
    """True if no fence is reported until the autopilot has started, even if it has stored one."""
    erases_small_fences = False
    """True if a new fence of one or two circles may be erased just after its upload."""
    must_complete_take_off = False
    """True if a vehicle that already moves must complete its take-off, because a hold could make it hit the ground."""
    restarts_mission_by_reset = False
    """True if MISSION_START has no effect in the mission mode. A mission that has ended or was replaced then starts
    only by a reset: param2 of DO_SET_MISSION_CURRENT.
    """
    mission_completes_at_home = False
    """Time at which a mission that ends with a return is reported as complete.

    True: when the vehicle is at home. False: when it starts to return.
    """
    holds_after_mission = False
    """True if the mode changes to the hold mode at the end of a mission."""
    mission_end_text: str | None = None
    """Part of the status text that reports the end of a mission. It is not sent for an invalid mission."""
    no_mission_text: str | None = None
    """Part of the status text of a vehicle that enters its mission mode without a mission to fly."""
    mission_starts_by_command = False
    """True if MAV_CMD_MISSION_START (300) starts the mission even on the ground. The command does not arm."""
    sets_current_by_command = False
    """True if MAV_CMD_DO_SET_MISSION_CURRENT (224) is supported."""
    repeats_item_reached = False
    """True if MISSION_ITEM_REACHED is sent repeatedly for one item."""
    completes_mission_in_other_modes = False
    """True if a take-off or a landing outside of the mission is also reported as the completion of the mission."""
    accepts_ftp_session_ids = False
    """True if the client chooses the number of a MAVFTP session, False if the vehicle chooses it."""
    has_upper_case_parameters = False
    """True if parameters are always reported in upper case."""
    plan_size_parameters: frozenset[str] = frozenset()
    """Parameters with the number of stored plan items. Setting one of them erases items, or makes old ones valid."""
    log_suffix = ".log"
    """Suffix of flight log files: ``.bin`` (dataflash) or ``.ulg``."""
    log_directories: ClassVar[tuple[str, ...]] = ()
    """Directories with flight logs, for MAVFTP. The first directory that exists is used."""
    first_log_id = 0
    """Id of the oldest log in LOG_ENTRY."""
    prefers_log_messages = False
    """True if downloading flight logs by LOG_* messages is faster than by MAVFTP."""
    silent_without_logs = False
    """True if LOG_REQUEST_LIST is not answered when there are no logs."""
    unknown_currents_ca: frozenset[int] = frozenset((-1,))
    """Values of a battery current in 0.01 A that mean unknown. The standard defines −1."""
    stream_groups: ClassVar[Mapping[int, int]] = {}
    """Maps message ids to MAV_DATA_STREAM, for firmware without MAV_CMD_SET_MESSAGE_INTERVAL."""
    gimbals: GimbalRules = GimbalRules()
    is_surface_vehicle = False
    """True for vehicles that drive or float on the surface, so that altitudes are meaningless for them."""
    mission_needs_take_off = False
    """True if the autopilot refuses a mission on the ground unless its first navigation command is a take-off."""
    mode_when_landed: ClassVar[str | None] = None
    """Mode to which the vehicle changes by itself after landing; None if it stays in the landing mode."""
    auto_disarm_parameter: ClassVar[str | None] = None
    """Parameter with the seconds after which an armed vehicle that does not take off disarms; None if it does not."""
    unselectable_modes: frozenset[str] = frozenset()
    """Modes that the autopilot may report, but does not let a ground station select."""
    unarmable_modes: frozenset[str] = frozenset()
    """Modes in which the autopilot refuses to arm, or disarms at once."""
    armable_by_option: Mapping[str, str] = {}
    """Maps the name of a mode to the parameter that must allow arming in this mode."""
    modes_without_position: frozenset[str] = frozenset()
    """Modes in which the autopilot arms without an estimate of the position."""
    prearm_depends_on_mode = False
    """True if the pre-arm bit of SYS_STATUS applies to the current mode only."""
    modes_with_rc: frozenset[str] | None = None
    """Modes in which the health bit of the RC receiver counts, because they need RC or MANUAL_CONTROL.

    None: the bit counts in every mode.
    """
    has_status_text_id_0 = False
    """True if a long status text may have the id 0, which by the standard means that the text is not chunked."""
    camera_by_trigger_only = False
    """True if the autopilot's own camera supports only DO_DIGICAM_CONTROL and DO_TRIGGER_CONTROL."""
    video_addresses_camera = False
    """True if the stream id of VIDEO_START_CAPTURE selects a camera."""
    modes_starting_flight: frozenset[str] = frozenset()
    """Modes in which a vehicle on the ground begins a flight as soon as it is armed."""
    arming_mode: ClassVar[str | None] = None
    """Mode in which to arm if the current mode does not allow arming, or would start a flight.

    A vehicle armed in this mode stays at rest.
    """

    def __init__(self, vehicle_type: int) -> None:
        self.vehicle_type = vehicle_type
        """MAV_TYPE of HEARTBEAT."""

    def __repr__(self) -> str:
        return f"<{self.name}: {self.firmware}>"

    # --------------------------------------------------------------------------------- modes

    def mode_of(self, heartbeat: messages.Heartbeat, reported_names: Mapping[int, str] = NO_MODES) -> Mode:
        """Return the mode of a HEARTBEAT. ``reported_names`` has the names of modes that the vehicle reported by
        AVAILABLE_MODES.
        """
        return self.mode(heartbeat.custom_mode, heartbeat.base_mode, reported_names)

    def mode(self, custom_mode: int, base_mode: int, reported_names: Mapping[int, str] = NO_MODES) -> Mode:
        """Return the mode with these numbers. Without CUSTOM_MODE_ENABLED, base_mode determines the name."""
        if base_mode & CUSTOM_MODE_ENABLED:
            return Mode(self.modes.name_of(custom_mode, reported_names), custom_mode, base_mode)
        return Mode(base_mode_name(base_mode), custom_mode, base_mode)

    def find_mode(self, mode: str | int | Mode, reported_names: Mapping[int, str] = NO_MODES) -> Mode:
        """Find a mode by number, or by name, ignoring case, spaces and underscores.

        Raises:
            InvalidArgument: the name is unknown; the text lists the known names.
        """
        return self.modes.find(mode, reported_names)

    def mode_for(self, purpose: Purpose, *, is_vtol: bool = False) -> Mode | None:
        """Return the mode for a purpose, or None if the vehicle has no such mode.

        ``is_vtol``: the vehicle reports the type of a plane, but can hover.
        """
        name = self._purpose_name(purpose, is_vtol)
        return None if name is None else self.modes.find(name)

    def return_modes(self, *, is_vtol: bool = False) -> tuple[Mode, ...]:
        """Return the modes in which the vehicle may return, also by itself: at the end of a mission."""
        mode = self.mode_for("return", is_vtol=is_vtol)
        return () if mode is None else (mode,)

    def lands_at_home(self, return_mode: Mode) -> bool:
        """Return True if a return in this mode ends with a landing."""
        return self.lands_after_return

    def mode_order(self, mode: Mode) -> ModeOrder:
        """Return the command that changes to a mode."""
        return ModeOrder((CUSTOM_MODE_ENABLED, mode.custom_mode, 0), CUSTOM_MODE_ENABLED, mode.custom_mode)

    def modes_of_command(
        self, command: int, params: Sequence[float], reported_names: Mapping[int, str] = NO_MODES
    ) -> tuple[Mode, ...]:
        """Return the modes to which a command may change; empty if there are none or they are unknown."""
        if command == MavCmd.DO_SET_MODE:
            return self._modes_of_do_set_mode(params, reported_names)
        names = {name for name in NAMES_OF_COMMANDS.get(command, ()) if name in self.modes.names}
        for purpose in PURPOSES_OF_COMMANDS.get(command, ()):
            for is_vtol in (False, True):
                name = self._purpose_name(purpose, is_vtol)
                if name is not None:
                    names.add(name)
        return tuple(self.modes.find(name) for name in sorted(names))

    def _modes_of_do_set_mode(self, params: Sequence[float], reported_names: Mapping[int, str]) -> tuple[Mode, ...]:
        """Return the mode that a DO_SET_MODE with these parameters sets, or nothing."""
        base_mode, custom_mode = mode_numbers((*params, 0.0, 0.0)[:2])  # Missing parameters are 0.
        return (self.mode(custom_mode, base_mode, reported_names),) if base_mode & CUSTOM_MODE_ENABLED else ()

    def mode_to_arm_in(self) -> Mode | None:
        """Return the mode named ``arming_mode``; None if there is none."""
        return None if self.arming_mode is None else self.modes.find(self.arming_mode)

    def learn_mode_name(self, custom_mode: int, name: str) -> str | None:
        """Return the name to store for a mode of AVAILABLE_MODES; None if ``name`` is empty or `modes` has the mode."""
        return name if name and custom_mode not in self.modes.numbers else None

    def _purpose_name(self, purpose: Purpose, is_vtol: bool) -> str | None:
        return self.purposes.get(purpose)

    # ------------------------------------------------------------------------------ take-off

    def take_off(
        self, altitude_relative_m: float, home_altitude_amsl_m: float | None, *, is_vtol: bool
    ) -> TakeOff | None:
        """Return the take-off procedure for this altitude above home; None if the vehicle cannot take off."""
        return None

    def return_altitude_parameters(self, *, is_vtol: bool) -> tuple[tuple[str, float], ...]:
        """Return the names of the return altitude parameter in all firmware versions, newest first.

        Each item is (name, units of the parameter per metre). The result is empty if there is no such parameter.
        """
        return ()

    def take_off_needs_home(self) -> bool:
        """Return True if :meth:`take_off` needs the altitude of home above mean sea level."""
        return False

    def landed_state_of(self, heartbeat: messages.Heartbeat) -> int | None:
        """Return the MAV_LANDED_STATE that HEARTBEAT.system_status implies, or None."""
        return None

    @property
    def repositions_amsl(self) -> bool:
        """True if MAV_CMD_DO_REPOSITION (192) supports only altitudes above mean sea level."""
        return self.reposition is not None and not self.reposition.relative_altitude

    # -------------------------------------------------------------------------------- health

    def failing_sensors(self, present: int, enabled: int, health: int) -> tuple[str, ...]:
        """Return names of failing sensors in SYS_STATUS (https://mavlink.io/en/messages/common.html#SYS_STATUS)."""
        return bit_names(enabled & present & ~health & ~PREARM_CHECK, SENSORS)

    def prearm_checks_pass(self, present: int, enabled: int, health: int) -> bool | None:
        """Return True if the vehicle can be armed according to SYS_STATUS; None if SYS_STATUS does not report this."""
        return bool(health & PREARM_CHECK) if present & enabled & PREARM_CHECK else None

    def missing_estimates(self, flags: int) -> tuple[str, ...]:
        """Return the missing estimates that prevent arming in a mode that needs a position; empty if there are none.

        ``flags`` are the flags in EKF_STATUS_REPORT or ESTIMATOR_STATUS.
        """
        return self._missing_estimates(flags, required=ATTITUDE_AND_HEIGHT, horizontal=POS_HORIZ_ABS)

    def arming_reason(self, text: str) -> str | None:
        """Extract the reason from a status text about failed arming; None for any other text."""
        return None

    def is_refusal(self, text: str) -> bool:
        """Return True if a status text explains a refusal."""
        return self.arming_reason(text) is not None or "denied" in text.lower() or "reject" in text.lower()

    @staticmethod
    def _missing_estimates(flags: int, *, required: int, horizontal: int) -> tuple[str, ...]:
        """Return the names of missing estimates. All bits of ``required`` are needed, and one bit of ``horizontal``."""
        missing = bit_names(required & ~flags, ESTIMATES)
        return missing if flags & horizontal else (*missing, ESTIMATES[POS_HORIZ_ABS])

    # ------------------------------------------------------------------------------- version

    def version_of(self, message: messages.AutopilotVersion) -> AutopilotVersion:
        """Convert an AUTOPILOT_VERSION."""
        text, number = version_text(message.flight_sw_version)
        return AutopilotVersion(
            text,
            number,
            self._git_hash(bytes(message.flight_custom_version)),
            message.capabilities,
            message.vendor_id,
            message.product_id,
            message.board_version,
            message.uid,
        )

    def encodes_parameters_bytewise(self, capabilities: int | None) -> bool:
        """Return True if integer parameters are encoded bytewise, False if they are cast to float."""
        if capabilities is not None and capabilities & (_BYTEWISE | _C_CAST):
            return bool(capabilities & _BYTEWISE)
        return self._bytewise_by_default

    _bytewise_by_default = False
    has_fixed_parameter_encoding = False
    """True if the encoding of integer parameters is known before the capabilities."""
    parameter_interval_s: float | None = None
    """Minimum interval between PARAM_VALUEs in seconds, for MAV_CMD_SET_MESSAGE_INTERVAL; None if the command has no
    effect.
    """
    has_parameter_hash = False
    """True if the parameter ``_HASH_CHECK`` is a checksum of all other parameters."""

    def _git_hash(self, custom_version: bytes) -> str:
        return custom_version.hex().rstrip("0")

    # ------------------------------------------------------------------------------- streams

    def sends(self, message: type[Message]) -> bool:
        """Return False if this autopilot is known not to send the message."""
        return message.NAME not in self.unsupported_messages

    calibration_protocol: str = ""
    """Form in which calibrations are reported: ``"acknowledgements"`` (ArduPilot), status ``"texts"`` (PX4), ``""`` if
    unknown.
    """

    has_vtols: bool = True
    """False if the firmware flies no VTOLs, so that a VTOL state in its EXTENDED_SYS_STATE must be ignored."""
    reports_gripper_by_text: bool = False
    """True if a status text reports the end of a gripper's movement, False if the acknowledgement reports it."""
    highres_imu_field_ut: float = 100.0
    """Microtesla per unit of the magnetic field in HIGHRES_IMU. The unit is gauss, except on ArduPilot."""
    has_shell: bool = False
    """True if SERIAL_CONTROL reaches a system shell."""
    winch_actions: frozenset[int] = frozenset(range(10))
    """WINCH_ACTIONS that the autopilot itself executes (MAV_CMD_DO_WINCH)."""
    unsupported_messages: frozenset[str] = frozenset()
