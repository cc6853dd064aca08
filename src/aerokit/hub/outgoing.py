"""``HeldFrames``: what waits for a link that does not take more: bounded, and no order longer than a second."""

from __future__ import annotations

from enum import Enum
from fnmatch import fnmatchcase
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.wording import did_you_mean
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from aerokit.mavlink.dialect import Dialect

ANSWERS = frozenset(
    (
        "COMMAND_ACK", "PARAM_VALUE", "PARAM_EXT_VALUE", "PARAM_EXT_ACK", "MISSION_ACK", "MISSION_COUNT",
        "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_REQUEST", "MISSION_REQUEST_INT", "FILE_TRANSFER_PROTOCOL",
        "LOG_ENTRY", "LOG_DATA", "AUTOPILOT_VERSION", "TIMESYNC", "PING", "STATUSTEXT",
    )
)  # fmt: skip
"""Answers and parts of transfers, of which some name no target: a rate for ``"*"`` does not mean them."""

MOST_HZ = 1000.0
"""The highest rate that can be asked for."""


class Filters:
    """Names of messages as patterns: ``"GPS_*"``; only those of ``only``, if there are any, without those of ``block``.

    ``rates`` are the highest ones, in Hz, for each sender; of several patterns that fit, the first counts. For
    `ANSWERS` only their own names do.

    Raises:
        InvalidArgument: a pattern fits no message of the dialect, or a rate is not in 0…1000.
    """

    def __init__(
        self,
        dialect: Dialect,
        only: Iterable[str] = (),
        block: Iterable[str] = (),
        rates: Mapping[str, float] | None = None,
    ) -> None:
        self._dialect = dialect
        self._only, self._block, self._rates = tuple(only), tuple(block), dict(rates or {})
        self._periods: dict[int, float | None] = {}
        for field, patterns in (("only", self._only), ("block", self._block), ("rates", self._rates)):
            for pattern in patterns:
                self._check(field, pattern)
        for pattern, hz in self._rates.items():
            if not 0 < hz <= MOST_HZ:
                raise InvalidArgument(
                    f"rates: {pattern} = {hz:g} Hz is not allowed: above 0, at most {MOST_HZ:g}"
                )

    def period(self, message_id: int) -> float | None:
        """None: the message does not go out; 0: it does; else once in so many seconds at most."""
        if not (self._only or self._block or self._rates):
            return 0.0
        if message_id not in self._dialect.rows:
            return None if self._only else 0.0
        if message_id not in self._periods:
            self._periods[message_id] = self._period(self._dialect[message_id].NAME)
        return self._periods[message_id]

    def _period(self, name: str) -> float | None:
        if self._only and not any(fnmatchcase(name, each) for each in self._only):
            return None
        if any(fnmatchcase(name, each) for each in self._block):
            return None
        fitting = (hz for each, hz in self._rates.items() if fnmatchcase(name, each))
        hz = self._rates.get(name) if name in ANSWERS else next(fitting, None)
        return 0.0 if hz is None else 1 / hz

    def _check(self, field: str, pattern: str) -> None:
        names = [each.NAME for each in self._dialect]
        if not any(fnmatchcase(name, pattern) for name in names):
            raise InvalidArgument(
                f"{field} = {pattern!r} fits no message of the dialect {self._dialect.name!r}"
                f"{did_you_mean(pattern, names)}"
            )


class Kind(Enum):
    """What may happen to a message that has to wait."""

    TELEMETRY = "telemetry"
    """A newer one of the same sender takes its place."""
    TRANSFER = "transfer"
    """It waits, in order, and is never replaced: a part of something larger, an answer, a text."""
    ORDER = "order"
    """The same, but for a second at most: an order never arrives late."""


# What is sent again and again, whole each time, and of which a sender has one. Messages with an instance in a field
# (batteries, range finders, named values) and whatever is not in here are never replaced.
_SENT_AGAIN_AND_AGAIN = """
    HEARTBEAT SYS_STATUS SYSTEM_TIME GPS_RAW_INT GPS2_RAW GPS_STATUS NAV_CONTROLLER_OUTPUT HIGH_LATENCY2
    SCALED_IMU SCALED_IMU2 SCALED_IMU3 RAW_PRESSURE
    SCALED_PRESSURE SCALED_PRESSURE2 SCALED_PRESSURE3 ATTITUDE ATTITUDE_QUATERNION ATTITUDE_QUATERNION_COV
    ATTITUDE_TARGET LOCAL_POSITION_NED LOCAL_POSITION_NED_COV GLOBAL_POSITION_INT GLOBAL_POSITION_INT_COV
    LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET POSITION_TARGET_LOCAL_NED POSITION_TARGET_GLOBAL_INT RC_CHANNELS
    MISSION_CURRENT VFR_HUD ALTITUDE HOME_POSITION GPS_GLOBAL_ORIGIN EXTENDED_SYS_STATE ESTIMATOR_STATUS
    EKF_STATUS_REPORT VIBRATION WIND WIND_COV AHRS AHRS2 AHRS3 HWSTATUS MEMINFO POWER_STATUS TERRAIN_REPORT
    RANGEFINDER SIMSTATE SIM_STATE AOA_SSA PID_TUNING FENCE_STATUS RADIO_STATUS RADIO EFI_STATUS
    AIRSPEED_AUTOCAL MOUNT_ORIENTATION CONTROL_SYSTEM_STATE HIGH_LATENCY LINK_NODE_STATUS
"""

_TELEMETRY = frozenset(_SENT_AGAIN_AND_AGAIN.split())

_ANSWERS = """
    COMMAND_ACK MISSION_ACK MISSION_REQUEST MISSION_REQUEST_INT MISSION_REQUEST_LIST MISSION_REQUEST_PARTIAL_LIST
    MISSION_CURRENT MISSION_ITEM_REACHED MISSION_CHECKSUM
"""

_NO_ORDERS = frozenset(_ANSWERS.split())

_ORDERS = (
    "COMMAND_*", "SET_*", "MANUAL_*", "RC_CHANNELS_OVERRIDE", "MISSION_*", "PARAM_SET", "PARAM_EXT_SET", "*_SET_*",
    "LOG_ERASE", "FENCE_POINT", "RALLY_POINT", "MOUNT_CONTROL", "MOUNT_CONFIGURE", "DIGICAM_CONTROL",
    "DIGICAM_CONFIGURE", "CHANGE_OPERATOR_CONTROL", "LED_CONTROL", "PLAY_TUNE*", "SERIAL_CONTROL", "HIL_CONTROLS",
    "HIL_ACTUATOR_CONTROLS", "LANDING_TARGET", "FOLLOW_TARGET",
)  # fmt: skip


@cache  # of each message of the dialects in use: a frame that has to wait costs no search
def kind_of(name: str, *, is_for_one: bool) -> Kind:
    """What a message of the standard's ``name`` is; ``is_for_one``: this frame names a target, and is no telemetry."""
    if name not in _NO_ORDERS and any(fnmatchcase(name, pattern) for pattern in _ORDERS):
        return Kind.ORDER
    if name in _TELEMETRY and not is_for_one:
        return Kind.TELEMETRY
    return Kind.TRANSFER


ORDERS_WAIT_S = 1.0
"""An order that has waited longer is dropped: it would come when nobody reckons with it any more."""

MOST_FRAMES = 1024
"""So many wait at most."""

MOST_BYTES = 128 * 1024
"""So many bytes wait at most: some seconds of a mission or of parameters on a slow radio."""


class Held(NamedTuple):
    """One frame that waits."""

    raw: bytes
    kind: Kind
    message_id: int
    target: tuple[int, int]
    since: float


class HeldFrames:
    """A queue in which a newer telemetry message takes the place of the older one, and nothing else is replaced.

    What does not fit is dropped whole; telemetry makes room for the rest. Time is an argument.
    """

    def __init__(self) -> None:
        self._frames: dict[
            int, Held
        ] = {}  # telemetry by sender and message, others by numbers below 0; in order
        self._bytes = 0
        self._count = 0
        self._orders = self._telemetry = 0  # how many of them: none need not be searched for

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, held: Held, key: int) -> list[tuple[str, Held]]:
        """Have a frame wait; ``key`` is that of its sender and message. What is dropped for it, and why."""
        dropped: list[tuple[str, Held]] = []
        if held.kind is Kind.TELEMETRY:
            before = self._frames.get(key)
            if before is not None:
                self._bytes += len(held.raw) - len(before.raw)
                self._frames[key] = held
                return [("superseded", before)]
        else:
            self._count -= 1
            key = self._count
        while self._is_full(len(held.raw)):
            if not self._telemetry:
                return [*dropped, ("queue_full", held)]
            oldest = next(each for each, frame in self._frames.items() if frame.kind is Kind.TELEMETRY)
            dropped.append(("queue_full", self._take(oldest)))
        self._frames[key] = held
        self._bytes += len(held.raw)
        self._orders += held.kind is Kind.ORDER
        self._telemetry += held.kind is Kind.TELEMETRY
        return dropped

    def expire(self, now: float) -> list[tuple[str, Held]]:
        """Drop the orders that have waited too long."""
        if not self._orders:
            return []
        late = [
            key
            for key, frame in self._frames.items()
            if frame.kind is Kind.ORDER and now - frame.since > ORDERS_WAIT_S
        ]
        return [("late", self._take(key)) for key in late]

    def next(self) -> bytes | None:
        """Take the first one out; call :meth:`expire` before. None: nothing waits."""
        return self._take(next(iter(self._frames))).raw if self._frames else None

    def clear(self) -> list[tuple[str, Held]]:
        """Drop everything: the link has gone."""
        dropped = [("away", held) for held in self._frames.values()]
        self._frames.clear()
        self._bytes = self._orders = self._telemetry = 0
        return dropped

    def _is_full(self, size: int) -> bool:
        return len(self._frames) >= MOST_FRAMES or self._bytes + size > MOST_BYTES

    def _take(self, key: int) -> Held:
        held = self._frames.pop(key)
        self._bytes -= len(held.raw)
        self._orders -= held.kind is Kind.ORDER
        self._telemetry -= held.kind is Kind.TELEMETRY
        return held
