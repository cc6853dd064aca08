"""``Autopilot``: the interface by which vehicle code asks for everything that differs between autopilots."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

from aerokit._internal.values import Snapshot
from aerokit.autopilots.modes import CUSTOM_MODE_ENABLED, NO_MODES, Mode, ModeTable, base_mode_name
from aerokit.autopilots.telemetry import (
    ATTITUDE_AND_HEIGHT,
    ESTIMATES,
    POS_HORIZ_ABS,
    PREARM_CHECK,
    SENSORS,
    AutopilotVersion,
    names_of,
    version_text,
)
from aerokit.mavlink import messages
from aerokit.mavlink.enums import MavCmd, MavProtocolCapability

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.mavlink.message import Message

NAN = math.nan
_BYTEWISE = MavProtocolCapability.PARAM_ENCODE_BYTEWISE.value
_C_CAST = MavProtocolCapability.PARAM_ENCODE_C_CAST.value

Purpose = Literal["hold", "land", "return", "setpoint", "take_off", "mission"]
"""What a program wants a mode for."""


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
"""MAV_CMD → what the modes are for that it brings about; an autopilot may take several for one."""
NAMES_OF_COMMANDS: Mapping[int, tuple[str, ...]] = {
    MavCmd.NAV_LOITER_UNLIM: ("LOITER",),
    MavCmd.DO_ORBIT: ("ORBIT", "CIRCLE"),
}
"""MAV_CMD → names of further ones, where an autopilot has such a mode."""


class TakeOff(Snapshot):
    """How this vehicle takes off.

    Go to ``mode`` (None: stay), arm, then send the command ``command`` (None: arming in ``mode`` is all) with
    ``params``. ``mode_after`` is where it ends up by itself, None when it stays.
    """

    mode: Mode | None
    command: int | None
    params: tuple[float, ...]
    mode_after: Mode | None


class SetpointRules(Snapshot):
    """Which guided set-points are obeyed, and what the autopilot expects of the stream.

    ``before_mode``: the stream must run before the mode is asked for.
    ``body_yaw_is_relative``: in MAV_FRAME_BODY_NED yaw counts from where the nose points, not from north.
    ``place_restarts_path``: each set-point that is a place begins its path anew, from standing, also the same one.
    """

    local_position: bool = True
    global_position: bool = True
    velocity: bool = True
    acceleration: bool = True
    attitude: bool = True
    before_mode: bool = False
    body_yaw_is_relative: bool = False
    place_restarts_path: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The kinds that are obeyed, in words."""
        kinds = ("local_position", "global_position", "velocity", "acceleration", "attitude")
        return tuple(kind.replace("_", " ") for kind in kinds if getattr(self, kind))


class GimbalRules(Snapshot):
    """How a gimbal manager understands the gimbal protocol v2; the defaults are the standard.

    ``has_secondary``: two may be in control at once. ``retracts``: it carries out an order to retract.
    ``knows_pitchyaw``: rates may come by GIMBAL_MANAGER_SET_PITCHYAW; else by GIMBAL_MANAGER_SET_ATTITUDE.
    ``looks_at_systems``: it knows MAV_CMD_DO_SET_ROI_SYSID. ``looks_with_each``: a region of interest is for the gimbal
    that it names; else always for the first. ``looking_needs_control``: one is denied to who is not in control.
    """

    has_secondary: bool = True
    retracts: bool = True
    knows_pitchyaw: bool = True
    looks_at_systems: bool = True
    looks_with_each: bool = True
    looking_needs_control: bool = True


class Reposition(Snapshot):
    """How MAV_CMD_DO_REPOSITION (192) is understood here.

    ``relative_altitude``: frames relative to home are obeyed; else the altitude must be AMSL. ``yaw``: param4
    turns the vehicle, in radians. ``speed``: param1 sets the ground speed.
    """

    relative_altitude: bool
    yaw: bool
    speed: bool


class ModeOrder(Snapshot):
    """The parameters of MAV_CMD_DO_SET_MODE (176), and the fields of the older SET_MODE message (11)."""

    params: tuple[float, float, float]
    base_mode: int
    custom_mode: int

    def legacy(self, target_system: int) -> messages.SetMode:
        """The same order as a SET_MODE message, which has no acknowledgement of its own."""
        return messages.SetMode(target_system, self.base_mode, self.custom_mode)


def whole_numbers(params: Sequence[float]) -> list[int]:
    """Parameters of a command that are numbers of modes; what is no number counts as 0."""
    return [int(each) if 0 <= each < 2**32 else 0 for each in params]


class Autopilot:
    """Everything that differs between autopilots and vehicle types; this base answers for unknown ones.

    One object describes one vehicle as its HEARTBEAT introduced it. It holds no state, does no IO and sends
    nothing.
    """

    name = "unknown autopilot"
    """The autopilot's name."""
    firmware = "unknown"
    """The firmware for this vehicle type, ``"ArduCopter"``."""
    modes: ModeTable = ModeTable({})
    modes_are_numbered = True
    """Whether users know a mode by its plain number, too."""
    purposes: ClassVar[Mapping[str, str]] = {}
    """Purpose → name of the mode that serves it."""
    setpoints: SetpointRules = SetpointRules(*[False] * 5)
    reposition: Reposition | None = None
    """None: DO_REPOSITION is not known to work."""
    home_is_item_0 = False
    """Whether a mission's item 0 is home."""
    acks_per_command: ClassVar[Mapping[int, int]] = {}
    """MAV_CMD to the number of COMMAND_ACKs for one sending, where it is not one."""
    keys_are_taken = ""
    """Where SETUP_SIGNING is obeyed, in words, if that is not everywhere."""
    runs_prearm_checks = False
    """Whether MAV_CMD_RUN_PREARM_CHECKS (401) repeats the failing checks as status texts."""
    calibrates_compasses_by_command = False
    """Whether MAV_CMD_DO_START_MAG_CAL (42424) calibrates the compasses; else it is a pre-flight calibration."""
    condition_yaw = False
    """Whether MAV_CMD_CONDITION_YAW (115) turns the vehicle in its mode for set-points."""
    reposition_purpose: Purpose = "setpoint"
    """Which mode DO_REPOSITION puts the vehicle into."""
    lands_after_return = False
    """Whether the mode for returning ends on the ground."""
    arrival_radius_m: float = 2.0
    """How near it comes to a place that it was sent to, or circles it, by default."""
    mission_storage = "any"
    """What it keeps of a mission item: a value of :class:`aerokit.missions.Storage`."""
    mission_upload_window = 1
    """How many mission items may be sent before they are asked for: 1 is the standard."""
    mission_download_window = 1
    """How many mission items may be asked for before they come, in any order: 1 is the standard."""
    writes_partial_missions = False
    """Whether MISSION_WRITE_PARTIAL_LIST (38) works."""
    tells_mission_checksum = False
    """Whether MISSION_CURRENT tells the checksum of the items it holds."""
    replaced_as_they_come: frozenset[int] = frozenset((0, 1, 2))
    """MAV_MISSION_TYPEs whose old items are overwritten while new ones come; the others keep theirs until the end."""
    completes_at_home = False
    """Whether it calls a mission that ends with a return complete when it is back, not when the return begins."""
    mission_starts_by_command = False
    """Whether MAV_CMD_MISSION_START (300) starts the mission, also on the ground, and arms nothing."""
    sets_current_by_command = False
    """Whether MAV_CMD_DO_SET_MISSION_CURRENT (224) is known."""
    repeats_item_reached = False
    """Whether MISSION_ITEM_REACHED is sent again and again for one item."""
    takes_file_sessions = False
    """Whether a MAVFTP session has the number that the client gave it, not one that the vehicle answers."""
    has_upper_case_parameters = False
    """Whether it confirms a parameter in capitals, however it was asked for."""
    log_suffix = ".log"
    """What files with its flight logs are called: ``.bin`` (dataflash) or ``.ulg``."""
    log_directories: ClassVar[tuple[str, ...]] = ()
    """Where MAVFTP finds the flight logs, or the directories with them: the first of these that exists."""
    first_log_id = 0
    """The id of the oldest log in LOG_ENTRY."""
    logs_by_messages = False
    """Whether flight logs come faster by the LOG_* messages than by MAVFTP."""
    silent_without_logs = False
    """Whether LOG_REQUEST_LIST is not answered when there are no logs."""
    unknown_currents_ca: frozenset[int] = frozenset((-1,))
    """What a battery's current in 0.01 A says when it is not known; the standard says −1."""
    stream_groups: ClassVar[Mapping[int, int]] = {}
    """Message id → MAV_DATA_STREAM, for firmware that knows no MAV_CMD_SET_MESSAGE_INTERVAL."""
    gimbals: GimbalRules = GimbalRules()
    """What its gimbal manager makes of the protocol."""
    stays_on_the_ground = False
    """Whether it drives or swims on the surface: altitudes mean nothing to it."""
    landing_ends_in: ClassVar[str | None] = None
    """The mode that it goes to by itself when its mode for landing is done; None: it stays there."""
    unarmable_modes: frozenset[str] = frozenset()
    """Modes in which the autopilot refuses to arm, or disarms by itself at once."""
    judges_by_mode = False
    """Whether SYS_STATUS tells if it could be armed in its present mode, not if it could be armed at all."""
    cameras_by_trigger = False
    """Whether a camera of its own is driven by its trigger alone: DO_DIGICAM_CONTROL and DO_TRIGGER_CONTROL."""
    video_by_camera = False
    """Whether VIDEO_START_CAPTURE names the camera behind it where the standard has a stream."""
    arming_mode: ClassVar[str | None] = None
    """The mode to arm in where the present one cannot be armed: one in which nothing begins to move by itself."""

    def __init__(self, vehicle_type: int) -> None:
        self.vehicle_type = vehicle_type
        """MAV_TYPE, as HEARTBEAT says it."""

    def __repr__(self) -> str:
        return f"<{self.name}: {self.firmware}>"

    # --------------------------------------------------------------------------------- modes

    def mode_of(self, heartbeat: messages.Heartbeat, extra: Mapping[int, str] = NO_MODES) -> Mode:
        """The mode that a HEARTBEAT tells; ``extra`` are names the vehicle told by AVAILABLE_MODES."""
        return self.mode(heartbeat.custom_mode, heartbeat.base_mode, extra)

    def mode(self, custom_mode: int, base_mode: int, extra: Mapping[int, str] = NO_MODES) -> Mode:
        """The mode of these numbers; without the flag for custom modes, base_mode gives the name."""
        if base_mode & CUSTOM_MODE_ENABLED:
            return Mode(self.modes.name_of(custom_mode, extra), custom_mode, base_mode)
        return Mode(base_mode_name(base_mode), custom_mode, base_mode)

    def find_mode(self, mode: str | int | Mode, extra: Mapping[int, str] = NO_MODES) -> Mode:
        """The mode of this name (any case, with or without spaces and underscores) or number.

        Raises :class:`InvalidArgument`, which lists the known names.
        """
        return self.modes.find(mode, extra)

    def mode_for(self, purpose: Purpose, *, is_vtol: bool = False) -> Mode | None:
        """The mode in which this vehicle holds its place, lands, returns, obeys set-points …; None: none.

        ``is_vtol`` says that a vehicle which calls itself a plane can hover.
        """
        name = self._purpose_name(purpose, is_vtol)
        return None if name is None else self.modes.find(name)

    def mode_order(self, mode: Mode) -> ModeOrder:
        """How to ask for a mode."""
        return ModeOrder((CUSTOM_MODE_ENABLED, mode.custom_mode, 0), CUSTOM_MODE_ENABLED, mode.custom_mode)

    def modes_of_command(
        self, command: int, params: Sequence[float], extra: Mapping[int, str] = NO_MODES
    ) -> tuple[Mode, ...]:
        """The modes that a MAV_CMD may bring about when a program sends it; empty: not known, or none."""
        if command == MavCmd.DO_SET_MODE:
            return self._modes_of_order(params, extra)
        purposes = PURPOSES_OF_COMMANDS.get(command, ())
        names = {self._purpose_name(each, is_vtol) for each in purposes for is_vtol in (False, True)}
        names |= {each for each in NAMES_OF_COMMANDS.get(command, ()) if each in self.modes.names}
        return tuple(self.modes.find(name) for name in sorted(filter(None, names)))

    def _modes_of_order(self, params: Sequence[float], extra: Mapping[int, str]) -> tuple[Mode, ...]:
        """The mode of the parameters of DO_SET_MODE."""
        base, custom = whole_numbers((*params, 0.0, 0.0)[:2])
        return (self.mode(custom, base, extra),) if base & CUSTOM_MODE_ENABLED else ()

    def mode_to_arm_in(self) -> Mode | None:
        """Where to arm a vehicle that stands in a mode in which it does not arm; None: not known."""
        return None if self.arming_mode is None else self.modes.find(self.arming_mode)

    def learn_mode_name(self, custom_mode: int, name: str) -> str | None:
        """The name to remember for an entry of AVAILABLE_MODES; None when it tells nothing new."""
        return name if name and custom_mode not in self.modes.numbers else None

    def _purpose_name(self, purpose: Purpose, is_vtol: bool) -> str | None:
        return self.purposes.get(purpose)

    # ------------------------------------------------------------------------------ take-off

    def take_off(
        self, altitude_relative_m: float, home_altitude_amsl_m: float | None, *, is_vtol: bool
    ) -> TakeOff | None:
        """How to take off to this altitude above home; None: this vehicle cannot."""
        return None

    def take_off_needs_home(self) -> bool:
        """Whether :meth:`take_off` must be told the altitude of home above the sea."""
        return False

    def landed_state_of(self, heartbeat: messages.Heartbeat) -> int | None:
        """MAV_LANDED_STATE as far as HEARTBEAT.system_status alone tells it; None when it does not."""
        return None

    @property
    def repositions_amsl(self) -> bool:
        """Whether MAV_CMD_DO_REPOSITION (192) takes altitudes above the sea only."""
        return self.reposition is not None and not self.reposition.relative_altitude

    # -------------------------------------------------------------------------------- health

    def failing_sensors(self, present: int, enabled: int, health: int) -> tuple[str, ...]:
        """What SYS_STATUS calls failing, in words (https://mavlink.io/en/messages/common.html#SYS_STATUS)."""
        return names_of(enabled & present & ~health & ~PREARM_CHECK, SENSORS)

    def prearm_checks_pass(self, present: int, enabled: int, health: int) -> bool | None:
        """Whether SYS_STATUS says that it could be armed; None when it does not say."""
        return bool(health & PREARM_CHECK) if present & enabled & PREARM_CHECK else None

    def missing_estimates(self, flags: int) -> tuple[str, ...]:
        """What the estimator lacks for arming in a mode that needs a position; empty when it is good enough.

        ``flags`` are those of EKF_STATUS_REPORT or ESTIMATOR_STATUS.
        """
        return self._missing_estimates(flags, required=ATTITUDE_AND_HEIGHT, horizontal=POS_HORIZ_ABS)

    def arming_reason(self, text: str) -> str | None:
        """The reason in a status text about why the vehicle cannot be armed, or None for any other text."""
        return None

    def is_refusal(self, text: str) -> bool:
        """Whether a status text explains why something was refused."""
        return self.arming_reason(text) is not None or "denied" in text.lower() or "reject" in text.lower()

    @staticmethod
    def _missing_estimates(flags: int, *, required: int, horizontal: int) -> tuple[str, ...]:
        missing = names_of(required & ~flags, ESTIMATES)
        return missing if flags & horizontal else (*missing, ESTIMATES[POS_HORIZ_ABS])

    # ------------------------------------------------------------------------------- version

    def version_of(self, message: messages.AutopilotVersion) -> AutopilotVersion:
        """What AUTOPILOT_VERSION says, in words."""
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
        """Whether integer parameters travel as their bytes instead of as a number in a float."""
        if capabilities is not None and capabilities & (_BYTEWISE | _C_CAST):
            return bool(capabilities & _BYTEWISE)
        return self._bytewise_by_default

    _bytewise_by_default = False
    parameter_interval_s: float | None = None
    """How often it may be made to see to parameters for the time of a transfer, by MAV_CMD_SET_MESSAGE_INTERVAL of
    PARAM_VALUE; None where that changes nothing."""
    has_parameter_hash = False
    """Whether the parameter ``_HASH_CHECK`` is a checksum over all others."""

    def _git_hash(self, custom_version: bytes) -> str:
        return custom_version.hex().rstrip("0")

    # ------------------------------------------------------------------------------- streams

    def sends(self, message: type[Message]) -> bool:
        """Whether this autopilot is known to have the message; True when in doubt."""
        return message.NAME not in self.never_sent

    never_sent: frozenset[str] = frozenset()
