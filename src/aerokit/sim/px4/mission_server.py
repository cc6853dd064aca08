"""Mission protocol of PX4: one transfer per link, with a time-out of five seconds.

An upload is buffered, and replaces the stored list after its last item. Items can be downloaded only in ascending
order. https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame, MavMissionType, MavSeverity
from aerokit.mavlink.enums import MavMissionResult as Result
from aerokit.missions import MissionItem
from aerokit.protocols.servers.host import ComponentIds
from aerokit.protocols.servers.missions import (
    AnyItem,
    AnyListMessage,
    AnyRequest,
    ItemRefused,
    ListUpload,
    MissionServer,
    item_from,
    item_message,
)
from aerokit.sim.channel import Channel
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.mission_items import as_downloaded, as_stored, checksum
from aerokit.sim.vehicle import sender_of

_NO_PARTNER = ComponentIds()
_CAPACITIES: dict[int, int] = {MavMissionType.MISSION: 10_000, MavMissionType.FENCE: 64, MavMissionType.RALLY: 32}


class TransferState(Enum):
    IDLE = "idle"
    SENDING = "sending a list"
    GETTING = "getting a list"


@dataclass(eq=False)
class _Link(ListUpload):
    """State of the latest mission transfer on a link. PX4 uses this state even after the transfer has ended."""

    state: TransferState = TransferState.IDLE
    opaque_id: int = 0  # checksum of the items received so far
    current: int = -1  # index of the item that the client marked as current; -1 if there is none

    @property
    def is_retried(self) -> bool:
        """True if the firmware repeats its last message until it is answered."""
        return self.state is TransferState.GETTING or self.next == 0


class Px4MissionServer(MissionServer):
    """PX4's server of missions, fences and rally points. All links share the stored items."""

    retry_interval_s: ClassVar[float] = 0.26

    def __init__(self, px4: Px4Host) -> None:
        super().__init__(px4)
        self._px4 = px4
        self._links: dict[Channel, _Link] = {}
        self.requests_int: bool = not px4.version.startswith("1.16")

    def _link(self, channel: Channel) -> _Link:
        if channel not in self._links:
            self._links[channel] = _Link(
                _NO_PARTNER, channel, mission_type=0, next=0, end=0, received_at=0.0, requested_at=0.0,
                uses_int=self.requests_int,
            )  # fmt: skip
        return self._links[channel]

    def reset(self) -> None:
        super().reset()
        self._links.clear()

    @property
    def transfer_is_open(self) -> bool:
        return super().transfer_is_open or any(link.state is not TransferState.IDLE for link in self._links.values())

    def items(self, mission_type: int) -> list[MissionItem]:
        return [as_downloaded(item, as_int=True) for item in self.lists.get(mission_type, ())]

    def replace(self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True) -> int:
        # PX4 itself does not store lists from files.
        if mission_type not in _CAPACITIES or start or not clear:
            return Result.ERROR
        try:
            stored_items = [as_stored(item, mission_type) for item in items]
        except ItemRefused as refused:
            return refused.result
        self._store_if_changed(mission_type, stored_items, checksum(items))
        return Result.ACCEPTED

    def capacity(self, mission_type: int) -> int:
        return _CAPACITIES.get(mission_type, 0)

    @property
    def commands(self) -> Sequence[MissionItem]:
        return self.lists[MavMissionType.MISSION]

    def _store_if_changed(self, mission_type: int, items: list[MissionItem], opaque_id: int, current: int = -1) -> None:
        is_unchanged = bool(items) and opaque_id == self.opaque_id(mission_type)
        if mission_type not in self.lists or is_unchanged:
            return
        self.store(mission_type, items)
        self._opaque_ids[mission_type] = opaque_id
        if mission_type == MavMissionType.MISSION:
            self._px4.mission.on_replaced(current)
        elif mission_type == MavMissionType.FENCE and items:
            self._px4.failsafes.fence.on_uploaded()

    def on_item_changed(self, seq: int) -> None:
        for link in self._links.values():
            if link.state is TransferState.IDLE and link.client != _NO_PARTNER:
                link.mission_type = 0
                self._send_item(link, seq)

    def _warn(self, text: str) -> None:
        self._px4.send_text(MavSeverity.CRITICAL, text)

    def _answer(self, link: _Link, result: int, to: ComponentIds | None = None) -> None:
        self._acknowledge(to or link.client, link.mission_type, result, link.channel)

    def _begin_transfer(self, state: TransferState, message: AnyListMessage, channel: Channel, count: int) -> _Link:
        client, kind, now = sender_of(message), message.mission_type, self._px4.now
        link = replace(
            self._link(channel), state=state, client=client, mission_type=kind, next=0, end=count, received_at=now
        )
        self._links[channel] = link
        self._schedule_check(link)
        return link

    def _drop(self, upload: ListUpload) -> None:
        super()._drop(upload)
        self._link(upload.channel).state = TransferState.IDLE

    def _send_count(self, link: _Link) -> None:
        link.requested_at = self._px4.now
        kind = link.mission_type
        self._px4.send(m.MissionCount(*link.client, link.end, kind, self.opaque_id(kind)), link.channel)

    def _send_item(self, link: _Link, seq: int) -> None:
        item = self.item(link.mission_type, seq)
        assert item is not None
        link.requested_at = self._px4.now
        client, kind = link.client, link.mission_type
        is_current = self._px4.mission.current == seq
        downloaded = as_downloaded(item, as_int=link.uses_int)
        # In MAV_FRAME_MISSION, x and y are not coordinates. In other frames, they are stored as degrees times 1e7.
        scale = 1.0 if item.frame == MavFrame.MISSION else 1e-7
        place = (item.x * scale, item.y * scale)
        message = item_message(downloaded, seq, client, kind, as_int=link.uses_int, current=is_current, place=place)
        self._px4.send(message, link.channel)

    def _schedule_check(self, upload: ListUpload) -> None:
        due = upload.received_at + self.timeout_s
        if self._link(upload.channel).is_retried:
            due = min(due, self._px4.now + self.retry_interval_s)
        self._px4.call_at(due, lambda: self._check(upload))

    def _may_time_out(self, upload: ListUpload) -> bool:
        link = self._link(upload.channel)
        return link is upload and link.state is not TransferState.IDLE

    def _repeat(self, upload: ListUpload) -> None:
        link = self._link(upload.channel)
        if link.state is TransferState.GETTING:
            self._request_item(link)
        elif link.is_retried:
            self._send_count(link)

    def _time_out(self, upload: ListUpload) -> None:
        self._warn("Mission sync timeout")
        self._drop(upload)

    def _on_request_list(self, request: m.MissionRequestList, channel: Channel) -> None:
        link = self._link(channel)
        # PX4 ends a transfer whose next index equals the number of stored items (mavlink_mission.cpp,
        # handle_mission_request_list). An upload that ends in this way blocks other uploads until a download times out.
        if link.next == self.count(link.mission_type):
            link.state = TransferState.IDLE
        is_same_transfer = link.client == sender_of(request) and link.mission_type == request.mission_type
        if link.state is TransferState.GETTING or (link.state is TransferState.SENDING and not is_same_transfer):
            self._px4.info("Mission download request ignored, already active")
            return
        count = self.count(request.mission_type)
        self._send_count(self._begin_transfer(TransferState.SENDING, request, channel, count))

    def _on_request(self, request: AnyRequest, channel: Channel) -> None:
        link = self._link(channel)
        link.uses_int = isinstance(request, m.MissionRequestInt)  # PX4 sets this even if another client is the sender.
        if sender_of(request) != link.client:
            self._warn("WPM: REJ. CMD: partner id mismatch")
            return
        if link.state is TransferState.GETTING:
            self._warn("WPM: REJ. CMD: Busy")
        if link.state is not TransferState.SENDING or request.mission_type != link.mission_type:
            return
        link.received_at = self._px4.now
        if request.seq == link.next and link.next < link.end:
            link.next += 1
        # `next - 1` is now the index in both valid requests: for the next item, and for the previous item again.
        if request.seq == link.next - 1 and request.seq < self.count(link.mission_type):
            self._send_item(link, request.seq)
        else:
            link.state = TransferState.IDLE
            self._answer(link, Result.ERROR)
            self._warn("WPM: REJ. CMD: Req. WP was unexpected")

    def _on_ack(self, ack: m.MissionAck, channel: Channel) -> None:
        link = self._link(channel)
        if sender_of(ack) != link.client:
            self._warn("REJ. WP CMD: partner id mismatch")
        elif link.state is TransferState.SENDING and ack.mission_type == link.mission_type:
            link.received_at = self._px4.now
            link.state = TransferState.IDLE
        elif link.state is TransferState.GETTING and ack.type == Result.UNSUPPORTED:
            # Continue the upload with MISSION_REQUEST instead of MISSION_REQUEST_INT, or vice versa.
            link.uses_int = not link.uses_int
            self._request_item(link)
        elif link.state is TransferState.GETTING and ack.type == Result.OPERATION_CANCELLED:
            self._drop(link)

    def _on_count(self, message: m.MissionCount, channel: Channel) -> None:
        link, sender = self._link(channel), sender_of(message)
        if link.state is TransferState.SENDING:
            self._warn("WPM: IGN MISSION_COUNT: Busy")
            self._answer(link, Result.ERROR, sender)
            return
        link.received_at = self._px4.now
        if link.state is TransferState.IDLE:
            self._accept(link, message)
        elif sender != link.client:
            self._answer(link, Result.ERROR, sender)
        elif link.next > 0:
            self._warn("WPM: REJ. CMD: Busy")
            self._answer(link, Result.ERROR)
        else:
            self._request_item(link)

    def _accept(self, link: _Link, count: m.MissionCount) -> None:
        if self._uploads:  # PX4 has one upload at a time, on all links.
            self._answer(link, Result.ERROR, sender_of(count))
            return
        link.client = sender_of(count)
        link.mission_type = count.mission_type
        self._px4.mission.forget_reached()
        if count.count > self.capacity(link.mission_type):
            self._answer(link, Result.NO_SPACE)
        elif count.count == 0:
            self._store_if_changed(link.mission_type, [], opaque_id=0, current=0)
            self._answer(link, Result.ACCEPTED)
        else:
            link.items = []
            link.opaque_id = 0
            link.current = -1
            link = self._begin_transfer(TransferState.GETTING, count, link.channel, count.count)
            self._uploads[self._key(link.mission_type)] = link
            self._request_item(link)

    def _on_item(self, message: AnyItem, channel: Channel) -> None:
        link = self._link(channel)
        link.uses_int = isinstance(message, m.MissionItemInt)  # PX4 sets this even if another client is the sender.
        if sender_of(message) != link.client:
            self._warn("REJ. MIS ITEM: partner id mismatch")
        elif message.mission_type != link.mission_type:
            self._answer(link, Result.ERROR)
        elif link.state is TransferState.GETTING:
            link.received_at = self._px4.now
            if message.seq == link.next:
                self._receive_item(link, message)
        elif link.state is TransferState.IDLE and link.next == message.seq + 1:  # The client missed the last answer.
            self._acknowledge(link.client, link.mission_type, Result.ACCEPTED, channel, link.opaque_id)
        else:
            reason = "No transfer" if link.state is TransferState.IDLE else "Busy"
            self._warn(f"IGN MISSION_ITEM: {reason}")
            self._answer(link, Result.ERROR)

    def _store_item(self, upload: ListUpload, message: AnyItem) -> None:
        link = self._link(upload.channel)
        item = item_from(message)
        is_int = isinstance(message, m.MissionItemInt)
        item_in_e7 = item
        # A MISSION_ITEM has latitude and longitude in degrees instead of degrees times 1e7.
        if not is_int and item.frame != MavFrame.MISSION:
            item_in_e7 = item.replace(x=_e7(item.x), y=_e7(item.y))
        try:
            link.items.append(as_stored(item_in_e7, link.mission_type, is_int=is_int))
        except ItemRefused as refused:
            if refused.result != Result.ERROR:
                self._warn("IGN MISSION_ITEM: Invalid item")
            raise
        # The checksum covers the item as received, so x and y of a MISSION_ITEM must be floats.
        received = item if is_int else item.replace(x=float(item.x), y=float(item.y))
        link.opaque_id = checksum([received], link.opaque_id)
        if message.current:
            link.current = message.seq

    def _finish(self, upload: ListUpload) -> None:
        link = self._link(upload.channel)
        self._store_if_changed(link.mission_type, link.items, link.opaque_id, link.current)
        self._end(link, Result.ACCEPTED)

    def _on_clear(self, request: m.MissionClearAll, channel: Channel) -> None:
        link = self._link(channel)
        if link.state is not TransferState.IDLE:
            self._warn("WPM: IGN CLEAR CMD: Busy")
            return
        link.mission_type = request.mission_type
        # PX4 accepts an unknown type, too (mavlink_mission.cpp, handle_mission_clear_all).
        for kind in _CAPACITIES:
            if request.mission_type in (kind, MavMissionType.ALL):
                self._store_if_changed(kind, [], opaque_id=0, current=0)
        self._answer(link, Result.ACCEPTED, sender_of(request))

    def _on_set_current(self, request: m.MissionSetCurrent, channel: Channel) -> None:
        if self._link(channel).state is not TransferState.IDLE:
            self._warn("WPM: IGN WP CURR CMD: Busy")
        elif request.seq >= len(self.commands):
            self._warn("WPM: WP CURR CMD: Not in list")
        else:
            self._px4.mission.set_current(request.seq)


def _e7(degrees: float) -> int:
    """Convert degrees to degrees times 1e7. Return 0 for values that may not fit 32 bits."""
    return round(degrees * 1e7) if abs(degrees) < 200 else 0
