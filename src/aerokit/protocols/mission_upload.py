"""Sends a mission, a fence or rally points item by item, whole or in part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from aerokit._internal.values import Snapshot
from aerokit.errors import MissionTimeout
from aerokit.mavlink.enums import MavMissionResult
from aerokit.mavlink.messages import (
    MissionAck,
    MissionCount,
    MissionRequest,
    MissionRequestInt,
    MissionWritePartialList,
)
from aerokit.missions.wire import to_wire, to_wire_float
from aerokit.protocols.exchange import ranges
from aerokit.protocols.missions import (
    BUSY_AGAIN_S,
    BUSY_S,
    FORGOTTEN_S,
    MissionExchange,
)

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.missions.item import MissionItem

__all__ = ["MissionUpload", "UploadEnd"]

MAX_RESTARTS = 3
STILL_UNDER_WAY = 0.8
"""What was sent less than this part of a round trip ago is not sent again: its answer cannot be here yet."""


class UploadEnd(Snapshot):
    """How an upload ended that was not refused.

    ``is_sure``: the vehicle has confirmed it. Otherwise everything was sent, and the answer does not tell whether
    everything was taken: read it back; ``item`` is then the first one that was not confirmed. ``opaque_id`` is what the
    vehicle calls it, 0 where it gives none.
    """

    is_sure: bool
    opaque_id: int
    item: int


class MissionUpload(MissionExchange[UploadEnd]):
    """MISSION_COUNT (or MISSION_WRITE_PARTIAL_LIST from ``first`` on), then the items the vehicle asks for.

    With a ``window`` above 1 items are sent before they are asked for, so that a round trip carries several: ArduPilot
    and PX4 take each item that is the next one, whether its request has arrived here or not, and ask for what they
    miss. A request confirms all items before it. ArduPilot answers an item out of sequence with INVALID_SEQUENCE and
    goes on waiting; PX4 ignores it and repeats its request every 0.25 s.

    An item that gets no answer is sent again. If the vehicle had it and its next request was lost, ArduPilot says
    INVALID_SEQUENCE, and the following item is sent.
    """

    expects: tuple[type[Message], ...] = (MissionRequestInt, MissionRequest, MissionAck)

    # from start() on
    _heard_at: float
    # from the first request on
    _as_float: bool

    def __init__(
        self,
        target_system: int,
        target_component: int,
        items: Sequence[MissionItem],
        *,
        first: int | None = None,
        window: int,
        takes_int: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._items = items
        self._is_partial = first is not None
        self._first = first or 0
        self._end = self._first + len(items)
        self._window, self._takes_int = window, takes_int
        self.was_vague: bool = False
        """Whether a refusal may mean any of several items that were under way: then send one at a time to find out."""
        self.was_begun: bool = False
        """Whether the vehicle has asked for an item: then it may have overwritten some."""
        self._restarts = 0
        self._busy_until: float | None = None
        self._reset()

    def _reset(self) -> None:
        self._is_asked = False
        self._taken = self._sent = self._first
        """The vehicle has all before ``_taken``; all before ``_sent`` were sent at least once."""
        self._sent_at: dict[int, float] = {}
        self._sendings: dict[int, int] = {}
        self._asked: set[int] = set()
        self._doubt_since: float | None = None
        self._tail_was_repeated = False
        self._attempt = 1

    @property
    def was_changing(self) -> bool:
        """Whether a vehicle that overwrites items as they come may have done so: the whole list is cut before that."""
        return self.was_begun and not (self._is_partial and self._sent == self._first + 1)

    @property
    def was_sent_whole(self) -> bool:
        """Whether the vehicle may have everything, whatever became of its answer."""
        return self.was_begun and self._sent == self._end

    # --------------------------------------------------------------------------------- events

    def start(self, now: float) -> None:
        """Announce it."""
        self._begin(now)
        self._heard_at = now
        self._announce(now)

    def receive(self, message: Message, now: float) -> None:
        """Take a request or the acknowledgement."""
        if not self._is_ours(message):
            return
        silence_s, self._heard_at = now - self._heard_at, now
        if isinstance(message, MissionAck):
            if message.type == MavMissionResult.ERROR and self._is_asked and silence_s >= FORGOTTEN_S:
                self._begin_anew(now)
            else:
                self._take_ack(message, now)
        elif (
            isinstance(message, (MissionRequestInt, MissionRequest))
            and self._first <= message.seq < self._end
        ):
            self._as_float = isinstance(message, MissionRequest) and not self._takes_int
            self._take_request(message.seq, now)

    def expire(self, now: float) -> None:
        """Send again what was not answered, or give up."""
        if self._is_out_of_patience(now):
            self._give_up(now)
            return
        self._attempt += 1
        if not self._is_asked:
            self._announce(now)
        elif self._sent < self._end:
            self._send_window(now, ahead=int(self._window > 1))
        elif self._attempt % 2 == 0:  # a vehicle that has everything confirms it again on its last item
            self._send(self._end - 1, now)
        else:
            self._send_window(now)
        self._wait(now)

    def link_changed(self, now: float) -> None:
        """PX4 takes items over the port that was told their number, and over no other one."""
        if self._is_asked and not self._is_partial and not self.done:
            self._reset()
            self._announce(now)

    # ------------------------------------------------------------------------------- requests

    def _take_request(self, seq: int, now: float) -> None:
        # left over from another transfer: nobody needs an item before he has the one before it
        if seq > self._sent:
            return
        if not self._is_asked:
            self._is_asked = True
            self.was_begun = True
            self._busy_until = None
            self._move(now, 0, len(self._items))
        if seq > self._taken:
            self._advance(seq, now)
        elif seq < self._taken:
            self._send(seq, now, again=True)  # an old request, or it has begun anew
        elif seq in self._asked:
            self._send_window(now)  # lost on the way; what was sent behind it, it has passed over
        self._asked.add(seq)
        while self._sent < min(self._end, self._taken + self._window):
            self._send(self._sent, now)
        self._wait(now)

    def _advance(self, seq: int, now: float) -> None:
        if self._sendings.get(seq - 1) == 1:
            self._measure(now - self._sent_at[seq - 1])
        self._taken = seq
        self._attempt = 1
        self._doubt_since = None
        self._move(now, seq - self._first, len(self._items))

    def _measure(self, seconds: float) -> None:
        """A vehicle repeats its requests: one that is later than it should be may be a second one."""
        if self.round_trip.smoothed_s is None or seconds <= self.round_trip.timeout_s():
            self.round_trip.measured(seconds)

    # ------------------------------------------------------------------------ acknowledgements

    def _take_ack(self, ack: MissionAck, now: float) -> None:
        result = ack.type
        if result == MavMissionResult.ACCEPTED:
            if self._is_asked and self._sent == self._end:
                self._end_well(not self._tail_was_repeated, ack.opaque_id, now)
        elif result == MavMissionResult.INVALID_SEQUENCE:
            if self._is_asked:
                self._send_window(now, ahead=1)
                if self._outbox:
                    self._wait(now)
        elif result == MavMissionResult.OPERATION_CANCELLED:
            self._begin_anew(now)
        elif result == MavMissionResult.ERROR and not self._is_partial_refusal:
            self._take_error(now)
        else:
            self._refuse(result)

    @property
    def _is_partial_refusal(self) -> bool:
        return self._is_partial and not self._is_asked

    def _take_error(self, now: float) -> None:
        """PX4 says ERROR when it is busy, when an item comes after the end, when MISSION_COUNT comes twice; and for
        a real error. ArduPilot says it of an item that comes after the end. So ask again before believing it.
        """
        if not self._is_asked:
            self._wait_while_busy(now)
        elif self._doubt_since is None:
            self._doubt_since = now
            self._send(self._doubted, now, again=True)
            self._wait(now)
        elif now - self._doubt_since >= STILL_UNDER_WAY * (self.round_trip.smoothed_s or 0.0):
            if self._sent == self._end:
                self._end_well(False, 0, now)
            else:
                self._refuse(MavMissionResult.ERROR)

    @property
    def _doubted(self) -> int:
        return self._end - 1 if self._sent == self._end else self._taken

    def _wait_while_busy(self, now: float) -> None:
        if self._busy_until is None:
            self._busy_until = now + BUSY_S
        if now + BUSY_AGAIN_S > self._busy_until:
            self._refuse(MavMissionResult.ERROR)
        else:
            self._moved_at = now  # it answers: that is no silence
            self._wait(now, BUSY_AGAIN_S)

    def _begin_anew(self, now: float) -> None:
        """It has waited in vain and given up. Before the first request it is an older transfer's end."""
        if not self._is_asked:
            return
        if self._is_partial or self._restarts >= MAX_RESTARTS:
            self._refuse(MavMissionResult.OPERATION_CANCELLED)
            return
        self._restarts += 1
        self._reset()
        self._announce(now)

    def _refuse(self, result: int) -> None:
        self.was_vague = self._sent - self._taken > 1
        self._reject(result, seq=self._taken if self._is_asked else None)

    def _end_well(self, is_sure: bool, opaque_id: int, now: float) -> None:
        self._move(now, len(self._items), len(self._items))
        self._finish(UploadEnd(is_sure, opaque_id, max(0, self._taken - self.offset)))

    def _give_up(self, now: float) -> None:
        self._outbox += self.cancellation()
        missing = range(max(self._taken, self.offset), self._end)
        what = (
            f"items {ranges(missing)} were not confirmed" if self._is_asked else "it never asked for an item"
        )
        self._fail(
            MissionTimeout(
                f"{self.kind}: the vehicle fell silent during the upload: {what}"
                f" ({self._attempt} attempts, {now - self._moved_at:.1f} s)",
                missing=tuple(seq - self.offset for seq in missing),
            )
        )

    # -------------------------------------------------------------------------------- sending

    def _announce(self, now: float) -> None:
        target = (self.target_system, self.target_component)
        if self._busy_until is not None:  # its last download to us may have ended without our word
            self._outbox += self.cancellation()
        if self._is_partial:
            partial = MissionWritePartialList(*target, self._first, self._end - 1, self.mission_type)
            self._outbox.append(partial)
        else:
            self._outbox.append(MissionCount(*target, self._end, self.mission_type))
        self._wait(now)

    def _send_window(self, now: float, *, ahead: int = 0) -> None:
        """Send again everything under way, and ``ahead`` items more: its requests may have been lost."""
        if self._sent == self._end and self._sent - self._taken > 1:
            self._tail_was_repeated = (
                True  # PX4 takes a repeated item for the last one, whether or not it was
            )
        upto = max(self._sent, min(self._sent + ahead, self._taken + self._window + 1, self._end))
        for seq in range(self._taken, upto):
            self._send(seq, now, again=True)

    def _send(self, seq: int, now: float, *, again: bool = False) -> None:
        if again and self._is_under_way(seq, now):
            return
        as_message = to_wire_float if self._as_float else to_wire
        self._outbox.append(
            as_message(
                self._items[seq - self._first],
                seq,
                target_system=self.target_system,
                target_component=self.target_component,
                mission_type=self.mission_type,
            )
        )
        self._sent_at[seq] = now
        self._sendings[seq] = self._sendings.get(seq, 0) + 1
        self._sent = max(self._sent, seq + 1)

    def _is_under_way(self, seq: int, now: float) -> bool:
        sent_at, round_trip_s = self._sent_at.get(seq), self.round_trip.smoothed_s
        # without any limit an item sent in vain would bring forth a window of others
        if round_trip_s is None:
            round_trip_s = self.round_trip.timeout_s()
        return sent_at is not None and now - sent_at < STILL_UNDER_WAY * round_trip_s
