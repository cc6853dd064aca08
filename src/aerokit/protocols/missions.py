"""What all transfers of missions, fences and rally points share (https://mavlink.io/en/services/mission.html).

The three kinds differ by ``mission_type`` alone. Items are those on the wire: where a mission's item 0 is home, it is
among them here.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit.errors import MissionRejected, MissionTimeout, OperationTimeout
from aerokit.mavlink.enums import MavMissionResult, MavMissionType
from aerokit.mavlink.messages import MissionAck, MissionClearAll, MissionCurrent
from aerokit.mavlink.messages import MissionSetCurrent as SetCurrentMessage
from aerokit.protocols.exchange import PATIENCE_S, OnProgress, Transfer

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.mavlink.message import Message
    from aerokit.missions.item import MissionItem
    from aerokit.protocols.command import Standing
    from aerokit.protocols.exchange import RoundTrip

__all__ = [
    "BUSY_AGAIN_S",
    "BUSY_S",
    "FORGOTTEN_S",
    "MissionClear",
    "MissionExchange",
    "MissionSetCurrent",
    "mission_checksum",
]

ResultT = TypeVar("ResultT")

BUSY_S = 9.0
"""How long a vehicle may be busy with a transfer that nobody goes on with: ArduPilot waits 8 s, PX4 5 s."""

BUSY_AGAIN_S = 1.0
"""How often a busy vehicle is asked again."""

FEW_ATTEMPTS, SAME_ATTEMPTS = 5, 7

FORGOTTEN_S = 4.5
"""After so long a silence a vehicle may have given the transfer up (PX4 after 5 s, ArduPilot after 8)."""

NAMES: dict[int, str] = {
    MavMissionType.MISSION: "mission",
    MavMissionType.FENCE: "fence",
    MavMissionType.RALLY: "rally points",
}

RESULTS: dict[int, str] = {
    MavMissionResult.ERROR: "an error it does not explain, or it is busy with another transfer",
    MavMissionResult.UNSUPPORTED_FRAME: "the coordinate frame is not supported",
    MavMissionResult.UNSUPPORTED: "the command is not supported",
    MavMissionResult.NO_SPACE: "there is no space for so many items",
    MavMissionResult.INVALID: "a parameter has an invalid value",
    MavMissionResult.INVALID_SEQUENCE: "an item came out of sequence",
    MavMissionResult.DENIED: "denied: another ground station may be transferring",
    MavMissionResult.OPERATION_CANCELLED: "it cancelled the transfer",
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
    """One transfer with one component. Only what is addressed to us, or to nobody, counts, and only this kind.

    Errors count items as the program does: ``offset`` is what its numbers are lower than those on the wire.
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
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__(
            target_system,
            target_component,
            round_trip=round_trip,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        self.mission_type = mission_type
        self.offset = offset
        self._own = (own_system, own_component)
        self._attempt = 1

    @property
    def kind(self) -> str:
        """``"mission"``, ``"fence"`` or ``"rally points"``, for texts."""
        return NAMES.get(MavMissionType(self.mission_type), "items")

    def cancellation(self) -> list[Message]:
        """What tells the vehicle that this transfer is given up; to be sent when it is cancelled from outside."""
        return [self._ack(MavMissionResult.OPERATION_CANCELLED)]

    def _ack(self, result: int) -> MissionAck:
        return MissionAck(self.target_system, self.target_component, result, self.mission_type)

    def _is_ours(self, message: Message) -> bool:
        return (
            self._is_from_target(message)
            and getattr(message, "target_system", 0) in (0, self._own[0])
            and getattr(message, "target_component", 0) in (0, self._own[1])
            and getattr(message, "mission_type", self.mission_type) == self.mission_type
        )

    def _wait(self, now: float, seconds: float | None = None) -> None:
        """Set the deadline: an answer is due by then."""
        self.deadline: float | None = now + (self._timeout_s(self._attempt) if seconds is None else seconds)

    def _timeout_s(self, attempt: int) -> float:
        """Small messages do not choke a link: wait longer after each attempt only while few, or many, were in vain."""
        return self.round_trip.timeout_s(min(attempt, max(FEW_ATTEMPTS, attempt - SAME_ATTEMPTS)))

    def _reject(self, result: int, *, seq: int | None = None) -> None:
        item = None if seq is None or seq < self.offset else seq - self.offset
        where = "" if item is None else f" item {item}"
        meaning = RESULTS.get(MavMissionResult(result), "") if result in RESULTS else f"result {result}"
        self._fail(
            MissionRejected(f"{self.kind}: the vehicle refused{where}: {meaning}", result=result, item=item)
        )


class MissionClear(MissionExchange[None]):
    """MISSION_CLEAR_ALL until it is acknowledged.

    ArduPilot refuses (ERROR) while the mission is being flown. PX4 says nothing while it is busy with a transfer.
    """

    expects: tuple[type[Message], ...] = (MissionAck,)

    def start(self, now: float) -> None:
        """Send it."""
        self._begin(now)
        self._send(now)

    def receive(self, message: Message, now: float) -> None:
        """Take the MISSION_ACK; one of an upload that ran into its time-out says nothing of this."""
        if not isinstance(message, MissionAck) or not self._is_ours(message):
            return
        if message.type == MavMissionResult.ACCEPTED:
            if self._attempt == 1:
                self.round_trip.measured(now - self._sent_at)
            self._finish(None)
        elif message.type not in (MavMissionResult.OPERATION_CANCELLED, MavMissionResult.INVALID_SEQUENCE):
            self._reject(message.type)

    def expire(self, now: float) -> None:
        """Send it again, or give up."""
        if self._is_out_of_patience(now):
            self._fail(self._timeout(now))
            return
        self._attempt += 1
        self._send(now)

    def _send(self, now: float) -> None:
        self._sent_at = now
        self._outbox.append(MissionClearAll(self.target_system, self.target_component, self.mission_type))
        self._wait(now)

    def _timeout(self, now: float) -> MissionTimeout:
        return MissionTimeout(
            f"{self.kind}: no answer to MISSION_CLEAR_ALL, sent {self._attempt} times"
            f" in {now - self._started_at:.1f} s; whether it was cleared is not known"
        )


LOOK_S = 0.1

TOLD_EVERY_S = 1.0
"""MISSION_CURRENT is streamed at 1 Hz, and sent when it changes."""


class MissionSetCurrent(Transfer[None]):
    """There is no acknowledgement: PX4 sends MISSION_CURRENT when the item has changed, else at its next turn.

    ``told`` is the item that the vehicle told last: from the item wanted to the one after it, it flies on by itself.
    With a ``standing``, it is sent again only after a HEARTBEAT that came since, and while that is not against it.
    """

    expects: tuple[type[Message], ...] = (MissionCurrent,)

    # from start() on
    _sent_at: float

    def __init__(
        self,
        target_system: int,
        target_component: int,
        seq: int,
        told: int | None = None,
        *,
        standing: Standing | None = None,
        **options: Any,
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._seq = seq
        self._told = told
        self._standing = standing
        self._attempts = 0

    def start(self, now: float) -> None:
        """Send it."""
        self._begin(now)
        self._send(now)

    def receive(self, message: Message, now: float) -> None:
        """Take a MISSION_CURRENT; one that was under way may come first."""
        if not isinstance(message, MissionCurrent) or not self._is_from_target(message):
            return
        if message.seq == self._seq or self._has_passed(message.seq):
            self._finish(None)
        self._told = message.seq

    def expire(self, now: float) -> None:
        """Send it again, or give up."""
        end = "" if self._standing is None else self._standing.end
        if end or self._is_out_of_patience(now):
            told = "nothing" if self._told is None else f"item {self._told}"
            self._fail(
                OperationTimeout(
                    f"MISSION_SET_CURRENT {self._seq} was not confirmed in {now - self._started_at:.1f} s"
                    f" ({self._attempts} attempts); MISSION_CURRENT told {told} (numbers on the wire)"
                    + (f"; not sent again: {end}" if end else "")
                )
            )
        elif self._standing is not None and self._standing.told_at < self._sent_at:
            self.deadline = now + LOOK_S
        else:
            self._send(now)

    def _has_passed(self, seq: int) -> bool:
        """Whether it has gone to our item and run through it: not what flying on from where it was comes to."""
        told = self._told
        return told is not None and (told <= self._seq < seq or self._seq < seq < told)

    def _send(self, now: float) -> None:
        self._attempts += 1
        self._sent_at = now
        self._outbox.append(SetCurrentMessage(self.target_system, self.target_component, self._seq))
        left = self._started_at + self._patience_s - now
        self.deadline: float | None = now + min(
            max(self.round_trip.timeout_s(), TOLD_EVERY_S), max(left, 0.01)
        )


ITEM = struct.Struct("<BHB4fiif")

INVERT = 0xFFFFFFFF


def mission_checksum(items: Iterable[MissionItem]) -> int:
    """CRC-32, begun with 0 and not inverted, over frame, command, autocontinue and the seven numbers of each item.

    PX4 (since 1.15) tells it as ``opaque_id`` in MISSION_ACK and MISSION_COUNT, and as ``mission_id``, ``fence_id``,
    ``rally_points_id`` in MISSION_CURRENT (https://mavlink.io/en/messages/common.html#MISSION_CURRENT).
    """
    checksum = INVERT
    for item in items:
        numbers = (item.param1, item.param2, item.param3, item.param4, int(item.x), int(item.y), item.z)
        checksum = zlib.crc32(ITEM.pack(item.frame, item.command, item.autocontinue, *numbers), checksum)
    return checksum ^ INVERT
