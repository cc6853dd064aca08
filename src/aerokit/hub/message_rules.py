"""Rules that depend on the message: filters of an endpoint, handling in a queue, and the target of a frame."""

from __future__ import annotations

from enum import Enum
from fnmatch import fnmatchcase
from functools import cache
from typing import TYPE_CHECKING

from aerokit._internal.formatting import did_you_mean
from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.frame import HEADER_LENGTH
from aerokit.mavlink.message import offset_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message

# Answers and parts of transfers. None may be lost, so rate limits with wildcards do not apply to them.
ANSWERS = frozenset(
    (
        "COMMAND_ACK", "PARAM_VALUE", "PARAM_EXT_VALUE", "PARAM_EXT_ACK", "MISSION_ACK", "MISSION_COUNT",
        "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_REQUEST", "MISSION_REQUEST_INT", "FILE_TRANSFER_PROTOCOL",
        "LOG_ENTRY", "LOG_DATA", "AUTOPILOT_VERSION", "TIMESYNC", "PING", "STATUSTEXT",
    )
)  # fmt: skip

MAX_RATE_HZ = 1000.0

ORDER_MAX_AGE_S = 1.0
"""Seconds after which a queued command is dropped, because a late command is worse than none."""


class Filters:
    """Selects the messages that an endpoint sends, and limits their rates.

    A message must match ``only``, if ``only`` is not empty, and must not match ``block``.

    Patterns may contain wildcards: ``"GPS_*"``. ``rates`` maps patterns to the maximum rate per sender in Hz; the first
    matching pattern applies. In ``rates``, a pattern with a wildcard does not apply to answers and transfers.

    Raises:
        InvalidArgument: a pattern matches no message of the dialect, or a rate is not above 0 and at most 1000.
    """

    def __init__(
        self,
        dialect: Dialect,
        only: Iterable[str] = (),
        block: Iterable[str] = (),
        rates: Mapping[str, float] | None = None,
    ) -> None:
        self._dialect = dialect
        self._only = tuple(only)
        self._block = tuple(block)
        self._rates = dict(rates or {})
        # Results of `min_interval`, which are computed at the first call.
        self._min_intervals: dict[int, float | None] = {}
        for field, patterns in (("only", self._only), ("block", self._block), ("rates", self._rates)):
            for pattern in patterns:
                self._check(field, pattern)
        for pattern, hz in self._rates.items():
            if not 0 < hz <= MAX_RATE_HZ:
                raise InvalidArgument(
                    f"rates: {pattern} = {hz:g} Hz is not allowed: it must be above 0, at most {MAX_RATE_HZ:g}"
                )

    def min_interval(self, message_id: int) -> float | None:
        """Return the minimum interval of a message in seconds: None if it is not sent, 0 if there is no limit."""
        if not (self._only or self._block or self._rates):
            return 0.0
        if message_id not in self._dialect.rows:  # An unknown message matches no pattern.
            return None if self._only else 0.0
        if message_id not in self._min_intervals:
            self._min_intervals[message_id] = self._min_interval(self._dialect[message_id].NAME)
        return self._min_intervals[message_id]

    def _min_interval(self, name: str) -> float | None:
        if self._only and not any(fnmatchcase(name, pattern) for pattern in self._only):
            return None
        if any(fnmatchcase(name, pattern) for pattern in self._block):
            return None
        if name in ANSWERS:
            # Answers are limited only by a rule with their exact name, not by a rule with a wildcard.
            rate_hz = self._rates.get(name)
        else:
            rate_hz = next((hz for pattern, hz in self._rates.items() if fnmatchcase(name, pattern)), None)
        return 0.0 if rate_hz is None else 1 / rate_hz

    def _check(self, field: str, pattern: str) -> None:
        names = [message_type.NAME for message_type in self._dialect]
        if not any(fnmatchcase(name, pattern) for name in names):
            raise InvalidArgument(
                f"{field} = {pattern!r} matches no message of the dialect {self._dialect.name!r}"
                f"{did_you_mean(pattern, names)}"
            )


class MessageKind(Enum):
    """How a queued message is treated."""

    TELEMETRY = "telemetry"
    """While it waits, newer telemetry with the same message id from the same sender replaces it."""
    TRANSFER = "transfer"
    """Sent in order and never replaced, e.g. part of a transfer, an answer or a STATUSTEXT."""
    ORDER = "order"
    """A command: sent in order, but dropped after a second, so that it never arrives late."""
    MEASUREMENT = "measurement"
    """A measurement for the estimator of a vehicle: treated as a command, but its loss is not reported."""

    @property
    def expires(self) -> bool:
        return self in _EXPIRING


_EXPIRING = (MessageKind.ORDER, MessageKind.MEASUREMENT)


# Periodic messages of which only the newest matters: a sender has a single instance of each. Messages with an instance
# field (batteries, range finders, named values), and all messages that are not listed, are never replaced.
_TELEMETRY = frozenset(
    (
        "HEARTBEAT", "SYS_STATUS", "SYSTEM_TIME", "GPS_RAW_INT", "GPS2_RAW", "GPS_STATUS",
        "NAV_CONTROLLER_OUTPUT", "HIGH_LATENCY2", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_PRESSURE",
        "SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3", "ATTITUDE", "ATTITUDE_QUATERNION",
        "ATTITUDE_QUATERNION_COV", "ATTITUDE_TARGET", "LOCAL_POSITION_NED", "LOCAL_POSITION_NED_COV",
        "GLOBAL_POSITION_INT", "GLOBAL_POSITION_INT_COV", "LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET",
        "POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT", "RC_CHANNELS", "MISSION_CURRENT", "VFR_HUD",
        "ALTITUDE", "HOME_POSITION", "GPS_GLOBAL_ORIGIN", "EXTENDED_SYS_STATE", "ESTIMATOR_STATUS",
        "EKF_STATUS_REPORT", "VIBRATION", "WIND", "WIND_COV", "AHRS", "AHRS2", "AHRS3", "HWSTATUS", "MEMINFO",
        "POWER_STATUS", "TERRAIN_REPORT", "RANGEFINDER", "SIMSTATE", "SIM_STATE", "AOA_SSA", "PID_TUNING",
        "FENCE_STATUS", "RADIO_STATUS", "RADIO", "EFI_STATUS", "AIRSPEED_AUTOCAL", "MOUNT_ORIENTATION",
        "CONTROL_SYSTEM_STATE", "HIGH_LATENCY", "LINK_NODE_STATUS",
    )
)  # fmt: skip

# Messages that match a pattern of `_ORDERS` although they are only answers, requests or reports.
_NOT_ORDERS = frozenset(
    (
        "COMMAND_ACK", "MISSION_ACK", "MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_REQUEST_LIST",
        "MISSION_REQUEST_PARTIAL_LIST", "MISSION_CURRENT", "MISSION_ITEM_REACHED", "MISSION_CHECKSUM",
    )
)  # fmt: skip

_ORDERS = (
    "COMMAND_*", "SET_*", "MANUAL_*", "RC_CHANNELS_OVERRIDE", "MISSION_*", "PARAM_SET", "PARAM_EXT_SET", "*_SET_*",
    "LOG_ERASE", "FENCE_POINT", "RALLY_POINT", "MOUNT_CONTROL", "MOUNT_CONFIGURE", "DIGICAM_CONTROL",
    "DIGICAM_CONFIGURE", "CHANGE_OPERATOR_CONTROL", "LED_CONTROL", "PLAY_TUNE*", "SERIAL_CONTROL", "HIL_CONTROLS",
    "HIL_ACTUATOR_CONTROLS", "LANDING_TARGET", "FOLLOW_TARGET",
)  # fmt: skip


# Old measurements are dropped, because the estimator would misplace the vehicle. Vehicles send some of these messages
# as telemetry, too.
_MEASUREMENTS = frozenset(
    (
        "GPS_INPUT", "ODOMETRY", "VISION_POSITION_ESTIMATE", "VISION_SPEED_ESTIMATE", "GLOBAL_VISION_POSITION_ESTIMATE",
        "VICON_POSITION_ESTIMATE", "ATT_POS_MOCAP", "OPTICAL_FLOW", "OPTICAL_FLOW_RAD", "DISTANCE_SENSOR",
        "OBSTACLE_DISTANCE", "OBSTACLE_DISTANCE_3D", "VISION_POSITION_DELTA", "GLOBAL_POSITION_SENSOR", "HIL_GPS",
    )
)  # fmt: skip


@cache
def kind_of(name: str, *, has_target: bool) -> MessageKind:
    if name not in _NOT_ORDERS and any(fnmatchcase(name, pattern) for pattern in _ORDERS):
        return MessageKind.ORDER
    if name in _MEASUREMENTS:
        return MessageKind.MEASUREMENT
    if name in _TELEMETRY and not has_target:
        return MessageKind.TELEMETRY
    return MessageKind.TRANSFER


# Maps the payload offsets of the target's system id and component id (None if there is no such field) to message ids.
# The table is not computed from the message classes, because importing them would block the loop for a third of a
# second.
STANDARD_OFFSETS: dict[tuple[int, int | None], tuple[int, ...]] = {
    (0, None): (5,),
    (0, 1): (21, 43, 45, 47, 121, 122, 123, 156, 161, 176, 183, 186, 216, 218, 258, 321, 323, 12900, 12903, 12905,
        12915),
    (1, 2): (110,),
    (2, 3): (20, 40, 41, 44, 51, 66, 80, 266, 267, 268, 320, 345, 385),
    (3, 4): (248,),
    (4, None): (11,),
    (4, 5): (23, 37, 38, 117, 155, 184, 185, 386, 387, 400, 401, 412, 413, 421, 11000, 11002, 11035, 12902, 50005),
    (6, 7): (151, 154, 214, 420),
    (8, 9): (77, 160, 256, 11004, 50004),
    (10, None): (69,),
    (10, 11): (119,),
    (12, None): (48,),
    (12, 13): (4, 157, 158, 201, 354),
    (14, 15): (175,),
    (16, 17): (70, 111, 11033, 12919),
    (18, 19): (50,),
    (20, 21): (287, 288),
    (24, 25): (54, 292),
    (26, None): (179,),
    (28, 29): (12904,),
    (30, 31): (75, 76, 284, 12901),
    (32, 33): (39, 73, 282, 388),
    (36, 37): (82, 296),
    (38, 39): (285,),
    (40, 41): (200, 513),
    (41, 42): (139,),
    (42, None): (180,),
    (50, 51): (84, 86, 286),
    (52, None): (243,),
    (79, 80): (126,),
}  # fmt: skip

# Offset of a field that does not exist. It is beyond the end of every frame.
NO_FIELD = 1 << 16

# Offsets in `Frame.body` of the target's system id and component id.
FieldOffsets = tuple[int, int]

_SYSTEM_FIELDS = {"MANUAL_CONTROL": "target"}  # In all other messages, the field is called target_system.


class TargetFields:
    """Reads the target of a frame from its bytes, without decoding the message."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self.offsets: dict[int, FieldOffsets | None] = {}
        """Maps message ids to offsets; None means no target. Messages of other dialects are added on demand."""
        if dialect is STANDARD:
            # A message that is not in the table has no target (None).
            self.offsets.update(dict.fromkeys(dialect.rows))
            for (system, component), message_ids in STANDARD_OFFSETS.items():
                component_offset = NO_FIELD if component is None else HEADER_LENGTH + component
                self.offsets.update(dict.fromkeys(message_ids, (HEADER_LENGTH + system, component_offset)))

    def look_up(self, message_id: int) -> FieldOffsets | None:
        """Return the offsets of a message's target ids; None if it has no target."""
        if message_id not in self._dialect.rows:
            return None  # An unknown id is not stored, because noise may contain millions of ids.
        offsets = self.offsets[message_id] = _field_offsets(self._dialect[message_id])
        return offsets

    def is_unknown(self, message_id: int) -> bool:
        return message_id not in self._dialect.rows

    def is_command(self, message_id: int) -> bool:
        """Return True for a command, with or without a target (LANDING_TARGET has none)."""
        return self._kind_of(message_id) is MessageKind.ORDER

    def expires(self, message_id: int) -> bool:
        """Return True for a message that must not be forwarded late."""
        return self._kind_of(message_id).expires

    def _kind_of(self, message_id: int) -> MessageKind:
        if self.is_unknown(message_id):
            return MessageKind.TRANSFER
        return kind_of(self._dialect[message_id].NAME, has_target=True)

    def target_of(self, frame: Frame) -> tuple[int, int]:
        """Return the system id and component id of a frame's target; 0 means all."""
        message_id = frame.message_id
        offsets = self.offsets[message_id] if message_id in self.offsets else self.look_up(message_id)
        if offsets is None:
            return 0, 0
        # A byte beyond the end is 0: MAVLink 2 truncates trailing zeros, and MAVLink 1 has no extension fields.
        body, size = frame.body, len(frame.body)
        system_offset, component_offset = offsets
        system_id = body[system_offset] if system_offset < size else 0
        component_id = body[component_offset] if component_offset < size else 0
        return system_id, component_id


def _field_offsets(message_type: type[Message]) -> FieldOffsets | None:
    names = {field.name for field in message_type.FIELDS}
    system = _SYSTEM_FIELDS.get(message_type.NAME, "target_system")
    if system not in names:
        return None
    component = NO_FIELD
    if "target_component" in names:
        component = HEADER_LENGTH + offset_of(message_type, "target_component")
    return HEADER_LENGTH + offset_of(message_type, system), component
