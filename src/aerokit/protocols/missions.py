"""Base class of mission, fence and rally transfers, and the exchanges that transfer no items.

See https://mavlink.io/en/services/mission.html. The three kinds of plans differ only in ``mission_type``. Items are
numbered as in the messages, which includes item 0 if it is home.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit.errors import MissionRejected, MissionTimeout, OperationTimeout
from aerokit.mavlink.enums import MavMissionResult, MavMissionType
from aerokit.mavlink.messages import MissionAck, MissionClearAll, MissionCurrent, MissionSetCurrent
from aerokit.protocols.command import MAX_HEARTBEAT_AGE_S
from aerokit.protocols.exchange import Transfer, TransferOptions

if TYPE_CHECKING:
    from collections.abc import Iterable

    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.missions.item import MissionItem
    from aerokit.protocols.command import OrderStatus

__all__ = [
    "BUSY_RETRY_INTERVAL_S",
    "BUSY_TIMEOUT_S",
    "TRANSFER_EXPIRY_S",
    "MissionClear",
    "MissionExchange",
    "SetCurrentItem",
    "mission_checksum",
]

ResultT = TypeVar("ResultT")

# A vehicle is busy for at most this many seconds with a transfer that another station has abandoned. ArduPilot drops
# it after 8 s, PX4 after 5 s.
BUSY_TIMEOUT_S = 9.0

BUSY_RETRY_INTERVAL_S = 1.0

# Seconds after a MISSION_CLEAR_ALL in which an ERROR may answer items of an earlier upload.
LATE_ERRORS_S = 1.5

# The time-out grows during the first GROWING_ATTEMPTS attempts, stays the same during the next CONSTANT_ATTEMPTS
# attempts, and then grows again.
GROWING_ATTEMPTS, CONSTANT_ATTEMPTS = 5, 7

# PX4 drops a transfer after 5 s without messages, ArduPilot after 8 s. After this slightly shorter time, we treat it as
# dropped.
TRANSFER_EXPIRY_S = 4.5

NAMES: dict[int, str] = {
    MavMissionType.MISSION: "mission",
    MavMissionType.FENCE: "fence",
    MavMissionType.RALLY: "rally points",
}

RESULTS: dict[int, str] = {
    MavMissionResult.ERROR: "an error without explanation; it may be busy with another transfer",
    MavMissionResult.UNSUPPORTED_FRAME: "the coordinate frame is not supported",
    MavMissionResult.UNSUPPORTED: "the command is not supported",
    MavMissionResult.NO_SPACE: "there is not enough space for all items",
    MavMissionResult.INVALID: "a parameter has an invalid value",
    MavMissionResult.INVALID_SEQUENCE: "an item came out of sequence",
    MavMissionResult.DENIED: "denied: another ground station may be transferring",
    MavMissionResult.OPERATION_CANCELLED: "the vehicle cancelled the transfer",
    **{
        result: f"{name} has an invalid value"
        for result, name in zip(
            range(MavMissionResult.INVALID_PARAM1, MavMissionResult.INVALID_PARAM7 + 1),
            ("param1", "param2", "param3", "param4", "x", "y", "z"),
            strict=True,
        )
    },
}


class MissionExchange(Transfer[ResultT]):
    """A transfer with one component. It ignores messages to other systems and of other mission types.

    Error texts have the item numbers of the caller: the index in the messages minus ``offset``.
    """

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        mission_type: int = MavMissionType.MISSION,
        offset: int = 0,
        own_system: int = 255,
        own_component: int = 190,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self.mission_type = mission_type
        self.offset = offset
        self._own_system, self._own_component = own_system, own_component
        self._attempt = 1

    @property
    def kind(self) -> str:
        """Name of the mission type for errors: ``"mission"``, ``"fence"``, ``"rally points"``, or else ``"items"``."""
        return NAMES.get(MavMissionType(self.mission_type), "items")

    def cancellation(self) -> list[Message]:
        """Return the messages that cancel this transfer on the vehicle."""
        return [self._ack(MavMissionResult.OPERATION_CANCELLED)]

    def _ack(self, result: int) -> MissionAck:
        return MissionAck(self.target_system, self.target_component, result, self.mission_type)

    def _is_ours(self, message: Message) -> bool:
        return self._is_for_us(message) and getattr(message, "mission_type", self.mission_type) == self.mission_type

    def _is_for_us(self, message: Message) -> bool:
        return (
            self._is_from_target(message)
            and getattr(message, "target_system", 0) in (0, self._own_system)
            and getattr(message, "target_component", 0) in (0, self._own_component)
        )

    def _wait(self, now: float, seconds: float | None = None) -> None:
        self.deadline: float | None = now + (self._timeout_s(self._attempt) if seconds is None else seconds)

    def _timeout_s(self, attempt: int) -> float:
        # After a few attempts, the time-out stays the same for a while. Longer waits only help on a congested link, and
        # the small messages of a mission do not congest a link.
        backoff_attempt = min(attempt, max(GROWING_ATTEMPTS, attempt - CONSTANT_ATTEMPTS))
        return self.round_trip.timeout_s(backoff_attempt)

    def _reject(self, result: int, *, seq: int | None = None) -> None:
        # An index before the offset is the home position, which is no item of the caller.
        item = None if seq is None or seq < self.offset else seq - self.offset
        subject = "" if item is None else f" item {item}"
        reason = RESULTS.get(result, f"result {result}")
        self._fail(MissionRejected(f"{self.kind}: the vehicle refused{subject}: {reason}", result=result, item=item))


class MissionClear(MissionExchange[None]):
    """Sends MISSION_CLEAR_ALL until it is acknowledged.

    ArduPilot refuses with ERROR while it flies the mission. PX4 does not answer while busy with a transfer.
    """

    expects: tuple[type[Message], ...] = (MissionAck,)
    _has_error = False  # True once ERROR was received and the request was repeated

    def _begin(self, now: float) -> None:
        self._send(now)

    def receive(self, message: Message, now: float) -> None:
        """Process the MISSION_ACK.

        A late ACCEPTED of an earlier upload looks like the answer to this request and is accepted. The caller therefore
        reads the number of items afterwards.
        """
        if not isinstance(message, MissionAck) or not self._is_ours(message):
            return
        if message.type == MavMissionResult.ACCEPTED:
            if self._attempt == 1:  # For a repeated request, the round trip is unknown.
                self.round_trip.add_sample(now - self._sent_at)
            self._finish(None)
        elif message.type == MavMissionResult.ERROR and not self._has_error:
            # This ERROR may answer a late item of an earlier upload, so the request is repeated once.
            self._has_error = True
            self._repeat(now)
        elif message.type == MavMissionResult.ERROR and self._may_be_late_error(now):
            return  # The request is repeated when its answer is overdue.
        # OPERATION_CANCELLED and INVALID_SEQUENCE answer an earlier upload, so they are ignored.
        elif message.type not in (MavMissionResult.OPERATION_CANCELLED, MavMissionResult.INVALID_SEQUENCE):
            self._reject(message.type)

    def _may_be_late_error(self, now: float) -> bool:
        # Each late copy of an item of an earlier upload is answered by an ERROR.
        is_too_early = now - self._sent_at < (self.round_trip.fastest_s or 0.0) / 2
        return is_too_early or now - self._started_at < min(LATE_ERRORS_S, self._idle_timeout_s / 2)

    def expire(self, now: float) -> None:
        if self._is_idle(now):
            self._fail(self._timed_out(now))
            return
        self._repeat(now)

    def _repeat(self, now: float) -> None:
        self._attempt += 1
        self._send(now)

    def _send(self, now: float) -> None:
        self._sent_at = now
        self._outbox.append(MissionClearAll(self.target_system, self.target_component, self.mission_type))
        self._wait(now)

    def _timed_out(self, now: float) -> MissionTimeout:
        return MissionTimeout(
            f"{self.kind}: no answer to MISSION_CLEAR_ALL, sent {self._attempt} times"
            f" in {now - self._started_at:.1f} s; the vehicle may have cleared it"
        )


POLL_INTERVAL_S = 0.1

# Vehicles stream MISSION_CURRENT at this interval, and also send it when the current item changes.
MISSION_CURRENT_INTERVAL_S = 1.0


class SetCurrentItem(Transfer[None]):
    """Sends MISSION_SET_CURRENT until MISSION_CURRENT confirms it, because there is no acknowledgement.

    ``reported`` is the item last reported by the vehicle. If the vehicle has passed the requested item since then, this
    also counts as confirmation.

    With an ``order_status``, a retry waits for a HEARTBEAT that is newer than the last transmission. Retries stop once
    ``order_status.end`` has a text.
    """

    expects: tuple[type[Message], ...] = (MissionCurrent,)

    # start() sets this attribute.
    _sent_at: float

    def __init__(
        self,
        target_system: int,
        target_component: int,
        seq: int,
        reported: int | None = None,
        *,
        order_status: OrderStatus | None = None,
        **options: Any,
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._seq = seq
        self._reported = reported
        self._order_status = order_status
        self._attempts = 0

    def _begin(self, now: float) -> None:
        self._send(now)

    def receive(self, message: Message, now: float) -> None:
        """Finish if MISSION_CURRENT shows that the vehicle has reached our item, or already passed it."""
        if not isinstance(message, MissionCurrent) or not self._is_from_target(message):
            return
        if message.seq == self._seq or self._has_passed(message.seq):
            self._finish(None)
        self._reported = message.seq

    def expire(self, now: float) -> None:
        status = self._order_status
        end_reason = "" if status is None else status.end
        min_heartbeat_at = max(self._sent_at, now - MAX_HEARTBEAT_AGE_S)
        if end_reason or self._is_idle(now):  # The order is no longer valid, or was not confirmed in time.
            reported = "nothing" if self._reported is None else f"item {self._reported}"
            self._fail(
                OperationTimeout(
                    f"MISSION_SET_CURRENT {self._seq} was not confirmed in {now - self._started_at:.1f} s"
                    f" ({self._attempts} attempts); MISSION_CURRENT reported {reported} (items are numbered from 0)"
                    + (f"; not sent again: {end_reason}" if end_reason else "")
                )
            )
        elif status is not None and status.heartbeat_at < min_heartbeat_at:
            self.deadline = now + POLL_INTERVAL_S  # Wait for a recent HEARTBEAT after the last transmission.
        else:
            self._send(now)

    def _has_passed(self, seq: int) -> bool:
        """Return True if the vehicle has reached our item and left it for ``seq``."""
        previous_seq = self._reported
        if previous_seq is None:
            return False
        has_moved_on = previous_seq <= self._seq < seq
        has_jumped_back = self._seq < seq < previous_seq  # The vehicle went back, reached our item and left it.
        return has_moved_on or has_jumped_back

    def _send(self, now: float) -> None:
        self._attempts += 1
        self._sent_at = now
        self._outbox.append(MissionSetCurrent(self.target_system, self.target_component, self._seq))
        timeout_s = max(self.round_trip.timeout_s(), MISSION_CURRENT_INTERVAL_S)
        remaining_s = max(self._started_at + self._idle_timeout_s - now, 0.01)
        self.deadline: float | None = now + min(timeout_s, remaining_s)


_CHECKSUM_ITEM = struct.Struct("<BHB4fiif")
_INVERT = 0xFFFFFFFF


def mission_checksum(items: Iterable[MissionItem]) -> int:
    """Compute the checksum with which PX4 identifies a plan.

    The checksum is a CRC-32 with initial value 0 and without final inversion. It covers frame, command, autocontinue
    and the seven numbers of each item. x and y must be whole numbers, as in MISSION_ITEM_INT.

    PX4 (since 1.15) reports it as ``opaque_id`` in MISSION_ACK and MISSION_COUNT, and as ``mission_id``, ``fence_id``
    and ``rally_points_id`` in MISSION_CURRENT (https://mavlink.io/en/messages/common.html#MISSION_CURRENT).
    """
    # zlib.crc32 inverts its start value and its result, so both are inverted once more.
    checksum = _INVERT
    for item in items:
        numbers = (item.param1, item.param2, item.param3, item.param4, int(item.x), int(item.y), item.z)
        checksum = zlib.crc32(_CHECKSUM_ITEM.pack(item.frame, item.command, item.autocontinue, *numbers), checksum)
    return checksum ^ _INVERT
