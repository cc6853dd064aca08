"""Download of a mission, a fence or rally points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.values import Snapshot
from aerokit.errors import MissionTimeout
from aerokit.mavlink.enums import MavMissionResult
from aerokit.mavlink.messages import (
    MissionAck,
    MissionCount,
    MissionItem,
    MissionItemInt,
    MissionRequest,
    MissionRequestInt,
    MissionRequestList,
)
from aerokit.missions.wire import from_wire
from aerokit.protocols.exchange import format_ranges
from aerokit.protocols.missions import BUSY_RETRY_INTERVAL_S, BUSY_TIMEOUT_S, TRANSFER_EXPIRY_S, MissionExchange

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.mavlink.message import Message
    from aerokit.missions.item import MissionItem as Item

__all__ = ["DownloadResult", "MissionDownload"]

# Maximum number of restarts without a new item.
MAX_RESTARTS = 8


class DownloadResult(Snapshot):
    """Result of a download.

    ``count`` is the number of items on the vehicle. If only some items were requested, ``items`` has fewer.
    ``opaque_id`` identifies the plan on the vehicle; 0 if the vehicle sends none.
    """

    items: tuple[Item, ...]
    count: int
    opaque_id: int


class MissionDownload(MissionExchange[DownloadResult]):
    """Downloads a plan: sends MISSION_REQUEST_LIST, then a request for every item, then MISSION_ACK.

    If the vehicle reports an id of the plan, MISSION_REQUEST_LIST is sent again before MISSION_ACK. Another id means
    that another station has replaced the plan meanwhile, so that the items are of two plans. The download then starts
    again.

    Args:
        window: the number of requests in flight. It must be 1 for PX4, which answers a request out of sequence with
            ERROR and aborts.
        only: the indices of the items to download; None for all.
        supports_int: False if the vehicle has no MISSION_ITEM_INT.
    """

    expects: tuple[type[Message], ...] = (MissionCount, MissionItemInt, MissionItem, MissionAck)

    # start() sets these attributes.
    _list_requested_at: float
    _received_at: float

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        window: int,
        only: Sequence[int] | None = None,
        supports_int: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._window = window
        self._supports_int = supports_int
        self._only = only
        self._indices: Sequence[int] = ()
        self._items: dict[int, Item] = {}
        self._count: int | None = None
        self._opaque_id = 0
        self._next_position = 0  # position in `_indices` of the item to request next
        self._requested_at: dict[int, float] = {}
        self._request_counts: dict[int, int] = {}
        self._busy_until: float | None = None
        self._restarts = 0
        self._has_error = False  # True if the vehicle has sent ERROR since the last answer to a request
        self._is_id_requested_again = False  # True if all items had arrived when the list was last requested

    def _begin(self, now: float) -> None:
        self._received_at = now
        self._request_list(now)

    def receive(self, message: Message, now: float) -> None:
        if not self._is_ours(message):
            return
        if isinstance(message, MissionCount):
            self._received_at = now
            self._on_count(message, now)
        elif isinstance(message, (MissionItemInt, MissionItem)):
            self._received_at = now
            self._on_item(message, now)
        elif isinstance(message, MissionAck):
            self._on_ack(message.type, now)

    def expire(self, now: float) -> None:
        if self._is_idle(now):
            self._time_out(now)
        elif self._has_error and self._window == 1:
            self._restart_after_error(now)
        elif self._count is None:
            self._attempt += 1
            self._request_list(now)
        elif now - self._received_at >= TRANSFER_EXPIRY_S:  # The vehicle may have dropped the transfer.
            self._restart_after_error(now)
        else:
            overdue = [seq for seq in self._requested_at if self._due_at(seq) <= now]
            for seq in overdue:
                self._request(seq, now)
            self._wait_for_items(now)

    def link_changed(self, now: float) -> None:
        """Request the list again, because PX4 sends items only over the port on which the list was requested."""
        if self._count is not None and not self.done:  # Before the count arrives, `expire` repeats the request anyway.
            self._restart(now)

    # --------------------------------------------------------------------------------- answers

    def _on_count(self, message: MissionCount, now: float) -> None:
        opaque_id = message.opaque_id
        if self._count is None:
            # PX4, whose window is 1, repeats MISSION_COUNT by itself, so its arrival does not measure the round trip.
            if self._attempt == 1 and not self._restarts and self._window > 1:
                self.round_trip.add_sample(now - self._list_requested_at)
            # After a restart, the items received before stay valid only if the plan has the same id.
            if not opaque_id or opaque_id != self._opaque_id:
                self._discard_items()
        elif message.count == self._count and opaque_id == self._opaque_id:
            return  # PX4 repeats MISSION_COUNT until the first item is requested
        else:  # The plan has changed since the download began.
            self._discard_items()
            self._discard_requests()
        self._count = message.count
        self._opaque_id = opaque_id
        self._busy_until = None
        self._has_error = False
        self._indices = range(self._count) if self._only is None else [seq for seq in self._only if seq < self._count]
        self._report_progress(now, len(self._items), len(self._indices))
        self._proceed(now)

    def _on_item(self, item: MissionItemInt | MissionItem, now: float) -> None:
        if self._count is None or item.seq not in self._requested_at:
            return  # The item is late or a copy.
        if self._request_counts[item.seq] == 1:  # For a repeated request, the round trip is unknown.
            self.round_trip.add_sample(now - self._requested_at[item.seq])
        del self._requested_at[item.seq]
        self._has_error = False
        if item.seq not in self._items:
            self._restarts = 0
        self._items[item.seq] = from_wire(item)
        self._report_progress(now, len(self._items), len(self._indices))
        self._proceed(now)

    def _on_ack(self, result: int, now: float) -> None:
        if result == MavMissionResult.DENIED:
            self._wait_while_busy(result, now)
        elif result == MavMissionResult.ERROR:
            # ERROR may answer a late copy of an item that an earlier upload has sent, so ERROR counts only if the
            # request is not answered in time. ArduPilot (window above 1) sends an ERROR for each copy. The request is
            # then only repeated, because ArduPilot has no transfer that it could have dropped
            # (MissionItemProtocol.cpp, handle_mission_request_int).
            self._has_error = True
        elif result not in (
            MavMissionResult.ACCEPTED,
            MavMissionResult.INVALID_SEQUENCE,  # A MISSION_COUNT with the new number of items follows.
            MavMissionResult.OPERATION_CANCELLED,  # The vehicle acknowledges the end of an earlier upload.
        ):
            self._reject(result)

    def _wait_while_busy(self, result: int, now: float) -> None:
        # ArduPilot refuses a download while it waits for items of an upload. It drops the upload after 8 s of silence.
        if self._busy_until is None:
            self._busy_until = now + BUSY_TIMEOUT_S
        if now + BUSY_RETRY_INTERVAL_S > self._busy_until:
            self._reject(result)
            return
        self._discard_requests()
        self._count = None
        self._progress_at = now  # The vehicle answers, so the transfer must not time out as idle.
        self.deadline = now + BUSY_RETRY_INTERVAL_S

    def _restart_after_error(self, now: float) -> None:
        # PX4 has dropped the transfer, so each item must be requested again, in sequence.
        if self._restarts >= MAX_RESTARTS:
            self._reject(MavMissionResult.ERROR)
            return
        self._restarts += 1
        self._restart(now)

    def _restart(self, now: float) -> None:
        self._discard_requests()
        self._count = None
        self._has_error = False
        self._attempt = 1
        self._received_at = now
        self._request_list(now)

    def _discard_items(self) -> None:
        self._items.clear()
        self._is_id_requested_again = False

    def _discard_requests(self) -> None:
        self._requested_at.clear()
        self._request_counts.clear()
        self._next_position = 0

    # -------------------------------------------------------------------------------- requests

    def _proceed(self, now: float) -> None:
        if self._has_all_items:
            # While PX4 sends items over one link, it accepts another plan over another link, and then sends the items
            # of the new plan (mavlink_mission.cpp, send_mission_item).
            if self._opaque_id and self._items and not self._is_id_requested_again:
                self._restart(now)
            else:
                self._acknowledge_and_finish()
            return
        while self._next_position < len(self._indices) and len(self._requested_at) < self._window:
            seq = self._indices[self._next_position]
            needs_sequence = self._window == 1  # PX4 requires a request for each item, even if we already have it.
            if needs_sequence or seq not in self._items:
                self._request(seq, now)
            self._next_position += 1
        self._wait_for_items(now)

    def _request(self, seq: int, now: float) -> None:
        request_type = MissionRequestInt if self._supports_int else MissionRequest
        self._outbox.append(request_type(self.target_system, self.target_component, seq, self.mission_type))
        self._requested_at[seq] = now
        self._request_counts[seq] = self._request_counts.get(seq, 0) + 1

    def _request_list(self, now: float) -> None:
        self._outbox.append(MissionRequestList(self.target_system, self.target_component, self.mission_type))
        self._list_requested_at = now
        self._is_id_requested_again = bool(self._items) and self._has_all_items
        self._wait(now)

    @property
    def _has_all_items(self) -> bool:
        return len(self._items) >= len(self._indices)

    def _due_at(self, seq: int) -> float:
        return self._requested_at[seq] + self._timeout_s(self._request_counts[seq])

    def _wait_for_items(self, now: float) -> None:
        if self._requested_at:
            self.deadline: float | None = max(now, min(self._due_at(seq) for seq in self._requested_at))

    # ------------------------------------------------------------------------------------ end

    def _acknowledge_and_finish(self) -> None:
        # PX4 (window 1) gets the acknowledgement twice, because after missing it, PX4 accepts no upload for 5 s.
        transmissions = 2 if self._window == 1 else 1
        self._outbox += [self._ack(MavMissionResult.ACCEPTED)] * transmissions
        items = tuple(self._items[seq] for seq in self._indices)
        self._finish(DownloadResult(items, count=self._count or 0, opaque_id=self._opaque_id))

    def _time_out(self, now: float) -> None:
        if self._has_error:
            self._reject(MavMissionResult.ERROR)
            return
        self._outbox += self.cancellation()
        # The caller's item 0 is the first one after home.
        missing = tuple(seq - self.offset for seq in self._indices if seq not in self._items and seq >= self.offset)
        if not self._indices:  # Not `_count`, which a restart resets to None.
            details = "no MISSION_COUNT was received"
        elif self._has_all_items:
            details = "all items were received, but not whether another station has replaced the plan meanwhile"
        else:
            details = f"missing: {format_ranges(missing) or 'home'}"
        self._fail(
            MissionTimeout(
                f"{self.kind}: the vehicle fell silent during the download:"
                f" {details}; nothing new for {now - self._progress_at:.1f} s",
                missing=missing,
            )
        )
