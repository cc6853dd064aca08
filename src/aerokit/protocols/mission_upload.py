"""Upload of a mission, a fence or rally points, complete or in part."""

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
from aerokit.protocols.exchange import format_ranges
from aerokit.protocols.missions import BUSY_RETRY_INTERVAL_S, BUSY_TIMEOUT_S, TRANSFER_EXPIRY_S, MissionExchange

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.missions.item import MissionItem

__all__ = ["MissionUpload", "UploadResult"]

MAX_RESTARTS = 3
# An item is not repeated before this fraction of a round trip has passed, because its answer cannot have arrived yet.
IN_FLIGHT_ROUND_TRIPS = 0.8


class UploadResult(Snapshot):
    """Result of an upload that was not refused.

    ``is_confirmed`` is False if all items were sent, but the vehicle's answers do not prove that it has the plan. The
    caller must then read the plan back. ``item`` is the index of the first item that the vehicle has not confirmed.
    ``opaque_id`` identifies the plan on the vehicle; 0 if the vehicle sends none.
    """

    is_confirmed: bool
    opaque_id: int
    item: int


class MissionUpload(MissionExchange[UploadResult]):
    """Uploads a plan: sends MISSION_COUNT, then the items that the vehicle requests.

    A request for an item confirms all items before it. An unanswered item is repeated.

    ArduPilot and PX4 accept the next item even if their request for it was lost, and request items that they miss.
    ArduPilot answers an item out of sequence, e.g. a repeated one that it already has, with INVALID_SEQUENCE, and
    continues to wait. PX4 ignores such an item, and repeats its request every 0.25 s.

    Args:
        first: index of the first item to replace on the vehicle; None to replace the whole plan. If given, the upload
            begins with MISSION_WRITE_PARTIAL_LIST.
        window: maximum number of unconfirmed items. With more than one, items are sent before they are requested, so
            that one round trip carries several.
        supports_int: False if the vehicle does not accept MISSION_ITEM_INT.
    """

    expects: tuple[type[Message], ...] = (MissionRequestInt, MissionRequest, MissionAck)

    # The first request sets this attribute.
    _sends_floats: bool

    def __init__(
        self,
        target_system: int,
        target_component: int,
        items: Sequence[MissionItem],
        *,
        first: int | None = None,
        window: int,
        supports_int: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._items = items
        self.is_partial: bool = first is not None
        self._first = first or 0
        self._end = self._first + len(items)
        self._window = window
        self._supports_int = supports_int
        self.is_refusal_ambiguous: bool = False
        """True if it is unknown which of several items in flight was refused. To find out, send items one at a time."""
        self.was_started: bool = False
        """True once the vehicle has requested an item. From then on it may have overwritten items."""
        self.was_dropped: bool = False
        """True if the upload failed because the vehicle has dropped the transfer, e.g. in a reboot."""
        self.was_accepted_early: bool = False
        """True if the vehicle accepted a plan before all items were sent; see `_on_request_after_end`."""
        self._is_item_refused = False
        self._restarts = 0
        self._busy_until: float | None = None
        self._is_older_upload_open = False  # True if the vehicle still requests items of an earlier upload
        self._reset()

    def _reset(self) -> None:
        self._vehicle_has_requested = False  # True once the vehicle has requested an item after the latest announcement
        self._confirmed_end = self._first  # The vehicle has all items before this one.
        self._sent_end = self._first  # All items before this one were sent at least once.
        self._sent_at: dict[int, float] = {}
        self._send_counts: dict[int, int] = {}
        self._requested: set[int] = set()  # items that the vehicle has requested at least once
        self._error_at: float | None = None  # time of the first ERROR since the last progress
        self._was_forgotten = False  # True if the vehicle has rebooted since the latest announcement
        self._was_tail_repeated = False  # True if several items at the end were repeated; see `_repeat_unconfirmed`
        self._attempt = 1

    @property
    def may_have_changed_items(self) -> bool:
        """True if the vehicle may have overwritten old items. False until the vehicle has requested an item."""
        # If the vehicle has refused the first item of a partial upload, it has replaced nothing.
        has_sent_only_first = self.is_partial and self._sent_end == self._first + 1
        return self.was_started and not (has_sent_only_first and self._is_item_refused)

    @property
    def was_sent_completely(self) -> bool:
        """True if all items were sent. The vehicle may then have the whole plan even without a confirmation."""
        return self.was_started and self._sent_end == self._end

    # --------------------------------------------------------------------------------- events

    def _begin(self, now: float) -> None:
        self._announce_items(now)

    def receive(self, message: Message, now: float) -> None:
        if not self._is_ours(message):
            is_request = isinstance(message, (MissionRequestInt, MissionRequest))
            self._is_older_upload_open |= is_request and self._is_for_us(message)
            return
        if isinstance(message, MissionAck):
            # After a long time without progress, ERROR means that the vehicle's transfer has expired: our items were
            # lost, even if its requests arrived. The upload then starts again.
            has_expired = self._vehicle_has_requested and now - self._progress_at >= TRANSFER_EXPIRY_S
            if message.type == MavMissionResult.ERROR and has_expired:
                self._restart(message.type, now)
            else:
                self._on_ack(message, now)
        elif isinstance(message, (MissionRequestInt, MissionRequest)) and self._first <= message.seq < self._end:
            self._sends_floats = isinstance(message, MissionRequest) and not self._supports_int
            self._on_request(message.seq, now)
        elif isinstance(message, (MissionRequestInt, MissionRequest)) and message.seq == self._end:
            self._on_request_after_end(now)

    def expire(self, now: float) -> None:
        if self._is_idle(now):
            self._time_out(now)
            return
        self._attempt += 1
        if not self._vehicle_has_requested:
            self._announce_items(now)
        elif self._was_forgotten and now - self._progress_at >= TRANSFER_EXPIRY_S:
            # After a reboot, PX4 does not answer items, so the upload starts again. It starts after a pause, because
            # ArduPilot refuses uploads during its first seconds.
            self._restart(MavMissionResult.ERROR, now)
        elif self._sent_end < self._end:
            may_send_ahead = self._window > 1  # With a window of 1, items are only sent on request.
            self._repeat_unconfirmed(now, ahead=1 if may_send_ahead else 0)
        elif self._attempt % 2 == 0:
            # The vehicle repeats a lost confirmation when it receives the last item again.
            self._send(self._end - 1, now)
        else:
            self._repeat_unconfirmed(now)
        self._wait(now)

    def link_changed(self, now: float) -> None:
        """Announce the items again, because PX4 accepts items only over the port that received MISSION_COUNT."""
        if self._vehicle_has_requested and not self.is_partial and not self.done:
            self._reset()
            self._announce_items(now)

    def vehicle_rebooted(self, now: float) -> None:
        self._was_forgotten = self._vehicle_has_requested and not self.is_partial

    # ------------------------------------------------------------------------------- requests

    def _on_request(self, seq: int, now: float) -> None:
        # The vehicle never skips an item, so a request beyond the next unsent item belongs to another transfer.
        if seq > self._sent_end:
            return
        if not self._vehicle_has_requested:
            self._vehicle_has_requested = True
            self.was_started = True
            self._busy_until = None
            self._report_progress(now, 0, len(self._items))
        if seq > self._confirmed_end:
            self._confirm_items_before(seq, now)
        elif seq < self._confirmed_end:
            # The vehicle has restarted the transfer, or this is a delayed request.
            self._send(seq, now, unless_in_flight=True)
        elif seq in self._requested:
            self._repeat_unconfirmed(now)  # The item was lost, and the vehicle has ignored the items after it.
        self._requested.add(seq)
        while self._sent_end < min(self._end, self._confirmed_end + self._window):
            self._send(self._sent_end, now)
        self._wait(now)

    def _on_request_after_end(self, now: float) -> None:
        # While PX4 waits for the first item of an upload, it does not accept the number of items of another one
        # (mavlink_mission.cpp, handle_mission_count). This happens if the cancellation of an earlier upload was lost.
        may_restart = not self.is_partial and self._restarts < MAX_RESTARTS
        if self._vehicle_has_requested and self._sent_end == self._end and may_restart:
            self._restarts += 1
            self._is_older_upload_open = True
            self._reset()
            self._announce_items(now)

    def _confirm_items_before(self, seq: int, now: float) -> None:
        """Record that the vehicle has all items before ``seq``."""
        if self._send_counts.get(seq - 1) == 1:  # For a repeated item, the round trip is unknown.
            self._measure(now - self._sent_at[seq - 1])
        self._confirmed_end = seq
        self._attempt = 1
        self._error_at = None
        self._report_progress(now, seq - self._first, len(self._items))

    def _measure(self, seconds: float) -> None:
        # A late request may be a repetition by the vehicle, so it does not measure the round trip.
        if self.round_trip.smoothed_s is None or seconds <= self.round_trip.timeout_s():
            self.round_trip.add_sample(seconds)

    # ------------------------------------------------------------------------ acknowledgements

    def _on_ack(self, ack: MissionAck, now: float) -> None:
        result = ack.type
        # Before the vehicle requests an item, ERROR refuses a partial upload. In other cases it has several meanings.
        is_refusal = self.is_partial and not self._vehicle_has_requested
        if result == MavMissionResult.ACCEPTED:
            self._on_accepted(ack.opaque_id, now)
        elif result == MavMissionResult.INVALID_SEQUENCE:
            if self._vehicle_has_requested:
                # This answer means that the vehicle already has the item, or that a preceding item is missing.
                self._repeat_unconfirmed(now, ahead=1)
                if self._outbox:  # If nothing was sent, the present deadline stays.
                    self._wait(now)
        elif result == MavMissionResult.OPERATION_CANCELLED:
            self._restart(result, now)
        elif result == MavMissionResult.ERROR and not is_refusal:
            self._on_error(now)
        elif not self._is_answer_to_copy(result, now):
            self._fail_as_refused(result)

    def _on_accepted(self, opaque_id: int, now: float) -> None:
        # Before all items were sent, an ACCEPTED is about an earlier upload, which our first items may have completed.
        if self._vehicle_has_requested and self._sent_end < self._end:
            self.was_accepted_early = True
        elif self._vehicle_has_requested:
            # We may send the last item before the vehicle requests it. Until the vehicle does, an ACCEPTED may be a
            # delayed answer to an earlier upload.
            was_last_requested = self._confirmed_end == self._end - 1
            is_confirmed = was_last_requested and not self._was_tail_repeated
            self._succeed(now, is_confirmed=is_confirmed, opaque_id=opaque_id)

    def _is_answer_to_copy(self, result: int, now: float) -> bool:
        """Return True if ``result`` answers a second copy of MISSION_WRITE_PARTIAL_LIST. The upload then continues."""
        # ArduPilot answers the copy by DENIED (MissionItemProtocol.cpp, handle_mission_write_partial_list). After
        # TRANSFER_EXPIRY_S, DENIED may instead be about another station's transfer.
        is_recent = now - self._progress_at < TRANSFER_EXPIRY_S
        return result == MavMissionResult.DENIED and self.is_partial and self._vehicle_has_requested and is_recent

    def _on_error(self, now: float) -> None:
        # ERROR need not mean that the upload has failed. PX4 also sends ERROR while it is busy, when MISSION_COUNT
        # arrives twice and, like ArduPilot, for an item after the end.
        if not self._vehicle_has_requested:
            self._wait_while_busy(now)
        elif self._error_at is None:  # Repeat an item. The upload ends only with another ERROR.
            self._error_at = now
            are_all_sent = self._sent_end == self._end
            seq = self._end - 1 if are_all_sent else self._confirmed_end
            self._send(seq, now, unless_in_flight=True)
            self._wait(now)
        elif now - self._error_at >= self._in_flight_s:  # A sooner ERROR may answer what we sent before the repetition.
            if self._sent_end == self._end:
                # All items were sent, so the upload may be complete. The caller must read the plan back.
                self._succeed(now, is_confirmed=False, opaque_id=0)
            else:
                self._fail_as_refused(MavMissionResult.ERROR)

    def _wait_while_busy(self, now: float) -> None:
        if self._busy_until is None:
            self._busy_until = now + BUSY_TIMEOUT_S
        if now + BUSY_RETRY_INTERVAL_S > self._busy_until:
            self._fail_as_refused(MavMissionResult.ERROR)
        else:
            self._progress_at = now  # The vehicle answers, so the transfer must not time out as idle.
            self._wait(now, BUSY_RETRY_INTERVAL_S)

    def _restart(self, result: int, now: float) -> None:
        """Begin again or, if the upload must not begin again, fail with ``result`` (a MAV_MISSION_RESULT)."""
        if not self._vehicle_has_requested:  # The vehicle has cancelled an older transfer, not this one.
            return
        # A partial upload does not begin again, because another station may have changed the vehicle's plan since.
        if self.is_partial or self._restarts >= MAX_RESTARTS:
            self._fail_as_refused(result)
            self._is_item_refused = False
            self.was_dropped = True
            return
        self._restarts += 1
        self._reset()
        self._announce_items(now)

    def _fail_as_refused(self, result: int) -> None:
        self._is_item_refused = result != MavMissionResult.DENIED
        self.is_refusal_ambiguous = self._sent_end - self._confirmed_end > 1
        self._reject(result, seq=self._confirmed_end if self._vehicle_has_requested else None)

    def _succeed(self, now: float, *, is_confirmed: bool, opaque_id: int) -> None:
        self._report_progress(now, len(self._items), len(self._items))
        first_unconfirmed = max(0, self._confirmed_end - self.offset)
        self._finish(UploadResult(is_confirmed, opaque_id, item=first_unconfirmed))

    def _time_out(self, now: float) -> None:
        self._outbox += self.cancellation()
        # The caller's item 0 is the first one after home.
        missing = tuple(range(max(self._confirmed_end - self.offset, 0), self._end - self.offset))
        unconfirmed = f"items not confirmed: {format_ranges(missing) or 'home'}"
        details = unconfirmed if self.was_started else "no item was requested"
        self._fail(
            MissionTimeout(
                f"{self.kind}: the vehicle fell silent during the upload: {details}"
                f"; nothing new for {now - self._progress_at:.1f} s after {self._attempt} attempts",
                missing=missing,
            )
        )

    # -------------------------------------------------------------------------------- sending

    def _announce_items(self, now: float) -> None:
        target = (self.target_system, self.target_component)
        # The vehicle may be busy because our MISSION_ACK to a download, or our cancellation of an upload, was lost.
        if self._busy_until is not None or self._is_older_upload_open:
            self._outbox += self.cancellation()
            self._is_older_upload_open = False
        if self.is_partial:
            partial = MissionWritePartialList(*target, self._first, self._end - 1, self.mission_type)
            self._outbox.append(partial)
        else:
            self._outbox.append(MissionCount(*target, self._end, self.mission_type))
        self._wait(now)

    def _repeat_unconfirmed(self, now: float, *, ahead: int = 0) -> None:
        """Repeat the unconfirmed items, and send up to ``ahead`` further items."""
        if self._sent_end == self._end and self._sent_end - self._confirmed_end > 1:
            # PX4 may take any repeated item near the end for the last item, and confirm the upload although it does
            # not have all items.
            self._was_tail_repeated = True
        # One more than the window, because the vehicle may already have the first unconfirmed item.
        new_end = min(self._sent_end + ahead, self._confirmed_end + self._window + 1, self._end)
        for seq in range(self._confirmed_end, max(self._sent_end, new_end)):
            self._send(seq, now, unless_in_flight=True)

    def _send(self, seq: int, now: float, *, unless_in_flight: bool = False) -> None:
        if unless_in_flight and self._is_in_flight(seq, now):
            return
        make_message = to_wire_float if self._sends_floats else to_wire
        self._outbox.append(
            make_message(
                self._items[seq - self._first],
                seq,
                target_system=self.target_system,
                target_component=self.target_component,
                mission_type=self.mission_type,
            )
        )
        self._sent_at[seq] = now
        self._send_counts[seq] = self._send_counts.get(seq, 0) + 1
        self._sent_end = max(self._sent_end, seq + 1)

    def _is_in_flight(self, seq: int, now: float) -> bool:
        # An item in flight is not repeated. The vehicle would answer the duplicate by another request for the next
        # item, and a repeated request makes us send a whole window again.
        sent_at = self._sent_at.get(seq)
        return sent_at is not None and now - sent_at < self._in_flight_s

    @property
    def _in_flight_s(self) -> float:
        round_trip_s = self.round_trip.smoothed_s
        if round_trip_s is None:
            round_trip_s = self.round_trip.timeout_s()
        return IN_FLIGHT_ROUND_TRIPS * round_trip_s
