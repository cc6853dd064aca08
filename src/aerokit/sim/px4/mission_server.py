"""Mission protocol of PX4: one transfer per link, with a time-out of five seconds.

An upload is buffered, and replaces the stored list after its last item. Items can be downloaded only in ascending
order. https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame, MavMissionResult, MavMissionType, MavSeverity
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
from aerokit.protocols.servers.missions import AnyItem, AnyRequest, item_from, item_message_float, item_message_int
from aerokit.sim.channel import Channel
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.mission_items import as_downloaded, checksum, stored
from aerokit.sim.vehicle import sender_of

_RETRY_INTERVAL_S, _TRANSFER_TIMEOUT_S = 0.26, 5.0
_R = MavMissionResult
_NO_PARTNER = (0, 0)


class TransferState(Enum):
    IDLE = "idle"
    SENDING = "sending a list"
    GETTING = "getting a list"


class Px4MissionLink:
    """State machine of one link; each ``on_…`` method handles one message. Texts and results are the firmware's."""

    def __init__(self, px4: Px4Host, server: Px4MissionServer, channel: Channel) -> None:
        self._px4, self._server, self._channel = px4, server, channel
        self._state = TransferState.IDLE
        self._partner = _NO_PARTNER
        self._type = 0
        self._seq = self._count = 0
        self._items: list[MissionItem] = []
        self._id = 0
        self._current = -1
        self._sent_at = self._received_at = 0.0
        self._uses_int = not px4.version.startswith("1.16")
        self._watch_number = 0

    @property
    def is_idle(self) -> bool:
        return self._state is TransferState.IDLE

    def _warn(self, text: str) -> None:
        self._px4.send_text(MavSeverity.CRITICAL, text)

    def _acknowledge(self, to: tuple[int, int], result: int, opaque_id: int = 0) -> None:
        self._px4.send(m.MissionAck(*to, result, self._type, opaque_id), self._channel)

    def _send_count(self) -> None:
        self._sent_at = self._px4.now
        count = m.MissionCount(*self._partner, self._count, self._type, self._server.id(self._type))
        self._px4.send(count, self._channel)

    def _request_item(self) -> None:
        self._sent_at = self._px4.now
        kind = m.MissionRequestInt if self._uses_int else m.MissionRequest
        self._px4.send(kind(*self._partner, self._seq, self._type), self._channel)

    def send_changed(self, seq: int) -> None:
        """Send a mission item that the vehicle has changed."""
        if self._state is TransferState.IDLE and self._partner != _NO_PARTNER:
            self._type = 0
            self._send_item(seq)

    def _send_item(self, seq: int) -> None:
        item = self._server.item(self._type, seq)
        assert item is not None
        self._sent_at = self._px4.now
        current = int(self._px4.mission.current == seq)
        given = as_downloaded(item, as_int=self._uses_int)
        if self._uses_int:
            message: Message = item_message_int(given, seq, self._partner, self._type, current=bool(current))
        else:
            scale = 1e-7 if item.frame != MavFrame.MISSION else 1.0
            place = (item.x * scale, item.y * scale)
            message = item_message_float(given, place, seq, self._partner, self._type, current)
        self._px4.send(message, self._channel)

    def _begin(self, state: TransferState, message: Message, mission_type: int, count: int) -> None:
        self._state, self._partner, self._type = state, sender_of(message), mission_type
        self._seq, self._count = 0, count
        self._watch_number += 1
        self._watch(self._watch_number)

    def _end_upload(self) -> None:
        self._state = TransferState.IDLE
        self._server.uploading = None

    def _watch(self, number: int) -> None:
        due = self._received_at + _TRANSFER_TIMEOUT_S
        if self._is_retried:
            due = min(due, max(self._px4.now, self._sent_at) + _RETRY_INTERVAL_S)
        self._px4.call_at(due, lambda: self._check(number))

    @property
    def _is_retried(self) -> bool:
        return self._state is TransferState.GETTING or self._seq == 0

    def _check(self, number: int) -> None:
        if number != self._watch_number or self._state is TransferState.IDLE:
            return
        now = self._px4.now
        if now >= self._received_at + _TRANSFER_TIMEOUT_S:
            self._warn("Mission sync timeout")
            self._end_upload()
            return
        if self._is_retried and now >= self._sent_at + _RETRY_INTERVAL_S:
            if self._state is TransferState.GETTING:
                self._request_item()
            else:
                self._send_count()
        self._watch(number)

    def on_request_list(self, request: m.MissionRequestList) -> None:
        """Start or restart a download.

        A download of which all items were sent counts as complete. The firmware treats an upload in the same way once
        as many items have arrived as are stored: it ends that upload, but refuses other uploads until a download times
        out.
        """
        if self._seq == self._server.count(self._type):
            self._state = TransferState.IDLE
        same = self._partner == sender_of(request) and self._type == request.mission_type
        if not (self._state is TransferState.IDLE or (self._state is TransferState.SENDING and same)):
            self._px4.info("Mission download request ignored, already active")
            return
        self._received_at = self._px4.now
        count = self._server.count(request.mission_type)
        self._begin(TransferState.SENDING, request, request.mission_type, count)
        self._send_count()

    def on_request(self, request: AnyRequest) -> None:
        """Send the next item, or the previous item again; any other index ends the download."""
        self._uses_int = isinstance(request, m.MissionRequestInt)
        if sender_of(request) != self._partner:
            self._warn("WPM: REJ. CMD: partner id mismatch")
            return
        if self._state is TransferState.GETTING:
            self._warn("WPM: REJ. CMD: Busy")
        if self._state is not TransferState.SENDING or request.mission_type != self._type:
            return
        self._received_at = self._px4.now
        if request.seq == self._seq and self._seq < self._count:
            self._seq += 1
        elif request.seq != self._seq - 1:
            self._refuse_request()
            return
        if request.seq < self._server.count(self._type):
            self._send_item(request.seq)
        else:
            self._refuse_request()

    def _refuse_request(self) -> None:
        self._state = TransferState.IDLE
        self._acknowledge(self._partner, _R.ERROR)
        self._warn("WPM: REJ. CMD: Req. WP was unexpected")

    def on_ack(self, ack: m.MissionAck) -> None:
        """End a download; cancel an upload, or change the kind of its requests (UNSUPPORTED)."""
        if sender_of(ack) != self._partner:
            self._warn("REJ. WP CMD: partner id mismatch")
        elif self._state is TransferState.SENDING and ack.mission_type == self._type:
            self._received_at = self._px4.now
            self._state = TransferState.IDLE
        elif self._state is TransferState.GETTING and ack.type == _R.UNSUPPORTED:
            self._uses_int = not self._uses_int
            self._request_item()
        elif self._state is TransferState.GETTING and ack.type == _R.OPERATION_CANCELLED:
            self._end_upload()

    def on_count(self, count: m.MissionCount) -> None:
        sender = sender_of(count)
        if self._state is TransferState.SENDING:
            self._warn("WPM: IGN MISSION_COUNT: Busy")
            self._acknowledge(sender, _R.ERROR)
            return
        self._received_at = self._px4.now
        if self._state is TransferState.IDLE:
            if not self._accept(count):
                return
        elif sender != self._partner:
            self._acknowledge(sender, _R.ERROR)
            return
        elif self._seq > 0:
            self._warn("WPM: REJ. CMD: Busy")
            self._acknowledge(self._partner, _R.ERROR)
            return
        self._request_item()

    def _accept(self, count: m.MissionCount) -> bool:
        """Start an upload and return True; return False after refusing it or storing an empty list."""
        sender, server = sender_of(count), self._server
        if server.uploading is not None:
            self._acknowledge(sender, _R.ERROR)
            return False
        self._partner, self._type = sender, count.mission_type
        self._px4.mission.forget_reached()
        if count.count > server.capacity(self._type):
            self._acknowledge(sender, _R.NO_SPACE)
        elif count.count == 0:
            server.store(self._type, [], 0, 0)
            self._acknowledge(sender, _R.ACCEPTED)
        else:
            self._items, self._id, self._current = [], 0, -1
            server.uploading = self
            self._begin(TransferState.GETTING, count, self._type, count.count)
            return True
        return False

    def on_item(self, message: AnyItem) -> None:
        """Handle an item of an upload; an unexpected item is ignored."""
        is_int = isinstance(message, m.MissionItemInt)
        self._uses_int = is_int
        if sender_of(message) != self._partner:
            self._warn("REJ. MIS ITEM: partner id mismatch")
        elif message.mission_type != self._type:
            self._acknowledge(self._partner, _R.ERROR)
        elif self._state is TransferState.GETTING:
            self._received_at = self._px4.now
            if message.seq == self._seq:
                self._receive_item(message, is_int=is_int)
        elif self._state is TransferState.IDLE and self._seq == message.seq + 1:
            self._acknowledge(self._partner, _R.ACCEPTED, self._id)  # The client missed the acknowledgement.
        else:
            why = "No transfer" if self._state is TransferState.IDLE else "Busy"
            self._warn(f"IGN MISSION_ITEM: {why}")
            self._acknowledge(self._partner, _R.ERROR)

    def _receive_item(self, message: AnyItem, *, is_int: bool) -> None:
        item = item_from(message)
        place = item if is_int else item.replace(x=float(item.x), y=float(item.y))
        whole = item if is_int or item.frame == MavFrame.MISSION else item.replace(x=_e7(item.x), y=_e7(item.y))
        kept = stored(whole, self._type, is_int=is_int)
        if isinstance(kept, int):
            if kept != _R.ERROR:
                self._warn("IGN MISSION_ITEM: Invalid item")
            self._acknowledge(self._partner, kept)
            self._end_upload()
            return
        self._id = checksum([place], self._id)
        self._items.append(kept)
        if message.current:
            self._current = message.seq
        self._seq += 1
        if self._seq < self._count:
            self._request_item()
            return
        self._server.store(self._type, self._items, self._id, self._current)
        self._end_upload()
        self._acknowledge(self._partner, _R.ACCEPTED, self._id)

    def on_clear_all(self, request: m.MissionClearAll) -> None:
        """Clear a list if no transfer is running, otherwise send a text."""
        if self._state is not TransferState.IDLE:
            self._warn("WPM: IGN CLEAR CMD: Busy")
            return
        self._type = request.mission_type
        self._server.clear(self._type)
        self._acknowledge(sender_of(request), _R.ACCEPTED)

    def on_set_current(self, request: m.MissionSetCurrent) -> None:
        if self._state is not TransferState.IDLE:
            self._warn("WPM: IGN WP CURR CMD: Busy")
        elif request.seq >= len(self._server.commands):
            self._warn("WPM: WP CURR CMD: Not in list")
        else:
            self._px4.mission.set_current(request.seq)


def _e7(degrees: float) -> int:
    return round(degrees * 1e7) if abs(degrees) < 200 else 0


_CAPACITIES: dict[int, int] = {
    MavMissionType.MISSION: 10_000,
    MavMissionType.FENCE: 64,
    MavMissionType.RALLY: 32,
}


class Px4MissionServer:
    """Server of mission, fence and rally points, which all links share."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self._items: dict[int, list[MissionItem]] = {kind: [] for kind in _CAPACITIES}
        self._ids: dict[int, int] = dict.fromkeys(_CAPACITIES, 0)
        self._links: dict[Channel, Px4MissionLink] = {}
        self.uploading: Px4MissionLink | None = None  # The link with an upload.

    def listen(self) -> None:
        on = self._px4.on
        on(m.MissionAck, lambda message, channel: self._link(channel).on_ack(message))
        on(m.MissionSetCurrent, lambda message, channel: self._link(channel).on_set_current(message))
        on(m.MissionRequestList, lambda message, channel: self._link(channel).on_request_list(message))
        on(m.MissionRequest, self._on_request)
        on(m.MissionRequestInt, self._on_request)
        on(m.MissionCount, lambda message, channel: self._link(channel).on_count(message))
        on(m.MissionItem, self._on_item)
        on(m.MissionItemInt, self._on_item)
        on(m.MissionClearAll, lambda message, channel: self._link(channel).on_clear_all(message))

    def _link(self, channel: Channel) -> Px4MissionLink:
        link = self._links.get(channel)
        if link is None:
            link = self._links[channel] = Px4MissionLink(self._px4, self, channel)
        return link

    def _on_request(self, message: AnyRequest, channel: Channel) -> None:
        self._link(channel).on_request(message)

    def _on_item(self, message: AnyItem, channel: Channel) -> None:
        self._link(channel).on_item(message)

    def reset(self) -> None:
        """Drop transfers, as a reboot does; stored items stay."""
        self._links.clear()
        self.uploading = None

    @property
    def transfer_is_open(self) -> bool:
        """True during an upload or download on any link."""
        return self.uploading is not None or any(not link.is_idle for link in self._links.values())

    def items(self, mission_type: int) -> list[MissionItem]:
        """Return the items that a download sends; empty for an unknown type."""
        return [as_downloaded(item, as_int=True) for item in self._items.get(mission_type, ())]

    def replace(self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True) -> int:
        """Store a whole list and return the MAV_MISSION_RESULT. PX4 has no such operation."""
        if mission_type not in _CAPACITIES or start or not clear:
            return MavMissionResult.ERROR
        kept = [stored(item, mission_type) for item in items]
        for item in kept:
            if isinstance(item, int):
                return item
        good = [item for item in kept if not isinstance(item, int)]
        self.store(mission_type, good, checksum(items))
        return MavMissionResult.ACCEPTED

    def capacity(self, mission_type: int) -> int:
        """Return the capacity; 0 for an unknown type."""
        return _CAPACITIES.get(mission_type, 0)

    def count(self, mission_type: int) -> int:
        return len(self._items.get(mission_type, ()))

    def item(self, mission_type: int, seq: int) -> MissionItem | None:
        items = self._items.get(mission_type, [])
        return items[seq] if 0 <= seq < len(items) else None

    def id(self, mission_type: int) -> int:
        """Return the opaque id of a list; 0 if it is empty."""
        return self._ids.get(mission_type, 0)

    @property
    def commands(self) -> Sequence[MissionItem]:
        """The mission."""
        return self._items[MavMissionType.MISSION]

    def store(self, mission_type: int, items: list[MissionItem], opaque_id: int, current: int = -1) -> None:
        """Store a list; an identical list changes nothing."""
        if mission_type not in self._items or (items and opaque_id == self._ids[mission_type]):
            return
        self._items[mission_type], self._ids[mission_type] = items, opaque_id
        if mission_type == MavMissionType.MISSION:
            self._px4.mission.on_replaced(current)
        elif mission_type == MavMissionType.FENCE and items:
            self._px4.failsafes.fence.on_uploaded()

    def on_item_changed(self, seq: int) -> None:
        """Send a changed item to the last partner on each link, except during a transfer."""
        for link in self._links.values():
            link.send_changed(seq)

    def clear(self, mission_type: int) -> None:
        """Clear a list, or all lists for MAV_MISSION_TYPE_ALL."""
        for kind in _CAPACITIES:
            if mission_type in (kind, MavMissionType.ALL):
                self.store(kind, [], 0, 0)
