"""Server for missions, fences and rally points (https://mavlink.io/en/services/mission.html)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavMissionResult, MavMissionType
from aerokit.missions import MissionItem
from aerokit.missions.wire import from_wire, to_wire, to_wire_float
from aerokit.protocols.servers.host import Channel, ComponentIds, ServerHost, sender_of

AnyItem = m.MissionItemInt | m.MissionItem
AnyRequest = m.MissionRequestInt | m.MissionRequest
AnyListMessage = m.MissionRequestList | AnyRequest | m.MissionCount | m.MissionWritePartialList


def item_from(message: AnyItem) -> MissionItem:
    """Convert a message to an item. ``x`` and ``y`` are not scaled."""
    numbers = (message.param1, message.param2, message.param3, message.param4, message.x, message.y, message.z)
    return MissionItem(message.command, message.frame, *numbers, autocontinue=bool(message.autocontinue))


def item_message(
    item: MissionItem,
    seq: int,
    to: ComponentIds,
    mission_type: int,
    *,
    as_int: bool,
    current: bool,
    place: tuple[float, float] | None = None,
) -> AnyItem:
    """Convert an item to a message. ``place`` replaces ``x`` and ``y`` in a MISSION_ITEM (without ``as_int``)."""
    ids = {"target_system": to.system, "target_component": to.component, "mission_type": mission_type}
    if as_int:
        rounded = item.replace(x=round(item.x), y=round(item.y))
        return to_wire(rounded, seq, **ids, current=current)
    return to_wire_float(item, seq, **ids, current=current, place=place)


class ItemRefused(Exception):
    """Raised for a mission item that is not stored. ``result`` is the MAV_MISSION_RESULT."""

    def __init__(self, result: int) -> None:
        super().__init__(f"MAV_MISSION_RESULT {result}")
        self.result = result


MAX_ITEMS = 2000
MAX_CLIENTS = 16
"""Maximum number of clients whose last transfer is remembered."""
_TYPES = (MavMissionType.MISSION, MavMissionType.FENCE, MavMissionType.RALLY)
_Result = MavMissionResult

# Function that accepts or refuses an uploaded list, now or later. Its arguments are the MAV_MISSION_TYPE, the items,
# and a function to call with the MAV_MISSION_RESULT. It raises InvalidArgument or nothing, because any other exception
# would leave the sender without an answer.
Validator = Callable[[int, tuple[MissionItem, ...], Callable[[int], None]], None]


@dataclass(eq=False)
class ListUpload:
    """A list that a client uploads."""

    client: ComponentIds
    channel: Channel
    mission_type: int
    next: int
    """Index of the item that is requested."""
    end: int
    """Index after the last item."""
    received_at: float
    requested_at: float
    uses_int: bool = True
    items: list[MissionItem] = field(default_factory=list)
    is_being_validated: bool = False
    """True from the call of ``validate`` until its answer."""


class MissionServer:
    """Stores missions, fences and rally points. One upload runs at a time; downloads are always answered.

    An upload that ``validate`` has accepted replaces the whole list. A missing item is requested again every
    ``retry_interval_s`` seconds. An upload without progress for ``timeout_s`` seconds ends with OPERATION_CANCELLED.

    During an upload, uploads of other clients and all MISSION_CLEAR_ALL are DENIED. Until ``validate`` has decided on a
    MISSION_CLEAR_ALL, all uploads and further MISSION_CLEAR_ALL are DENIED.

    Subclasses for firmware that behaves differently override methods.
    """

    retry_interval_s: ClassVar[float] = 0.5
    timeout_s: ClassVar[float] = 5.0
    requests_int: bool = True
    """True if the first request of an upload is a MISSION_REQUEST_INT, False if it is a MISSION_REQUEST."""

    def __init__(
        self,
        host: ServerHost,
        validate: Validator = lambda _, __, answer: answer(_Result.ACCEPTED),
        *,
        on_set_current: Callable[[int], bool] = lambda _: False,
        capacity: int = MAX_ITEMS,
    ) -> None:
        self.lists: dict[int, tuple[MissionItem, ...]] = dict.fromkeys(_TYPES, ())
        """Maps MAV_MISSION_TYPE to items. Call `store` to change the items."""
        # Cache of the checksums by mission type, because MISSION_CURRENT contains them and is streamed.
        self._opaque_ids: dict[int, int] = {}
        self.current: int = 0
        """Index of the current item of the mission."""
        self._host = host
        self._validate = validate
        self._may_set_current = on_set_current  # returns False to refuse a MISSION_SET_CURRENT
        self._capacity = capacity
        self._uploads: dict[int, ListUpload] = {}
        # By client, in the order of their ends: the upload that ended last, and its answer.
        self._ended: dict[ComponentIds, tuple[ListUpload, m.MissionAck]] = {}
        self._clearing: m.MissionClearAll | None = None
        """MISSION_CLEAR_ALL on which ``validate`` has not decided yet."""
        on = host.on
        on(m.MissionRequestList, self._on_request_list)
        on(m.MissionRequestInt, self._on_request)
        on(m.MissionRequest, self._on_request)
        on(m.MissionCount, self._on_count)
        on(m.MissionItemInt, self._on_item)
        on(m.MissionItem, self._on_item)
        on(m.MissionAck, self._on_ack)
        on(m.MissionClearAll, self._on_clear)
        on(m.MissionSetCurrent, self._on_set_current)

    @property
    def transfer_is_open(self) -> bool:
        return bool(self._uploads)

    def reset(self) -> None:
        """Drop running transfers, as a reboot does. The stored items are kept."""
        self._uploads.clear()
        self._ended.clear()
        self._clearing = None

    def opaque_id(self, mission_type: int) -> int:
        """Return the opaque id of a list, a checksum of its items. It is 0 for an empty list."""
        items = self.lists.get(mission_type, ())
        if items and mission_type not in self._opaque_ids:
            checksum = 0
            for seq, item in enumerate(items):
                message = item_message(item, seq, ComponentIds(), mission_type, as_int=True, current=False)
                checksum = zlib.crc32(message.encode(), checksum)
            self._opaque_ids[mission_type] = checksum or 1  # In MAVLink, the opaque id 0 means no id.
        return self._opaque_ids[mission_type] if items else 0

    def current_message(self) -> m.MissionCurrent:
        return m.MissionCurrent(
            seq=self.current, total=self.count(MavMissionType.MISSION),
            mission_id=self.opaque_id(MavMissionType.MISSION), fence_id=self.opaque_id(MavMissionType.FENCE),
            rally_points_id=self.opaque_id(MavMissionType.RALLY),
        )  # fmt: skip

    def store(self, mission_type: int, items: Sequence[MissionItem]) -> None:
        self.lists[mission_type] = tuple(items)
        self._opaque_ids.pop(mission_type, None)
        if mission_type == MavMissionType.MISSION:
            self.current = 0

    def set_current(self, seq: int) -> bool:
        """Make the component continue its mission at an item. Return False if it refuses."""
        if not 0 <= seq < self.count(MavMissionType.MISSION) or not self._may_set_current(seq):
            return False
        self.current = seq
        self._host.send(self.current_message())
        return True

    def capacity(self, mission_type: int) -> int:
        return self._capacity

    def count(self, mission_type: int) -> int:
        return len(self.lists.get(mission_type, ()))

    def _refusal(self, message: AnyListMessage, channel: Channel) -> int | None:
        """Return the MAV_MISSION_RESULT that refuses a transfer, or None."""
        return None if message.mission_type in self.lists else _Result.UNSUPPORTED

    def item(self, mission_type: int, seq: int) -> MissionItem | None:
        items = self.lists.get(mission_type, ())
        return items[seq] if 0 <= seq < len(items) else None

    def _requested_item(self, request: AnyRequest) -> MissionItem | None:
        return self.item(request.mission_type, request.seq)

    def _message(self, item: MissionItem, request: AnyRequest) -> AnyItem:
        seq, kind, as_int = request.seq, request.mission_type, isinstance(request, m.MissionRequestInt)
        current = seq == self.current and kind == MavMissionType.MISSION
        return item_message(item, seq, sender_of(request), kind, as_int=as_int, current=current)

    def _store_item(self, upload: ListUpload, message: AnyItem) -> None:
        """Store the expected item of an upload. Raises ItemRefused."""
        upload.uses_int = isinstance(message, m.MissionItemInt)
        upload.items.append(from_wire(message))

    def _key(self, mission_type: int) -> int:
        """Return the key of an upload. Uploads with different keys can run at the same time."""
        return 0

    def _acknowledge(self, to: ComponentIds, kind: int, result: int, channel: Channel, opaque_id: int = 0) -> None:
        self._host.send(m.MissionAck(*to, result, kind, opaque_id=opaque_id), channel)

    def _on_request_list(self, request: m.MissionRequestList, channel: Channel) -> None:
        kind, to = request.mission_type, sender_of(request)
        if (refusal := self._refusal(request, channel)) is not None:
            self._acknowledge(to, kind, refusal, channel)
        else:
            self._host.send(m.MissionCount(*to, self.count(kind), kind, opaque_id=self.opaque_id(kind)), channel)

    def _on_request(self, request: AnyRequest, channel: Channel) -> None:
        if (refusal := self._refusal(request, channel)) is not None:
            self._refuse_item(request, refusal, channel)
        elif (item := self._requested_item(request)) is None:
            self._refuse_item(request, _Result.INVALID_SEQUENCE, channel)
        else:
            self._host.send(self._message(item, request), channel)

    def _refuse_item(self, request: AnyRequest, result: int, channel: Channel) -> None:
        self._acknowledge(sender_of(request), request.mission_type, result, channel)

    def _on_count(self, message: m.MissionCount, channel: Channel) -> None:
        client, kind = sender_of(message), message.mission_type
        running = self._uploads.get(self._key(kind))
        refusal = self._refusal(message, channel)
        is_occupied = running is not None and (running.client != client or running.is_being_validated)
        if refusal is None and (is_occupied or self._clearing is not None):
            refusal = _Result.DENIED
        if refusal is not None:
            self._acknowledge(client, kind, refusal, channel)
            return
        if running is not None:  # The same client starts its upload again.
            self._drop(running)
        if message.count > self.capacity(kind):
            self._refuse_size(message, channel)
            return
        upload = self._register_upload(message, channel, first=0, end=message.count)
        if message.count:
            self._request_first_item(upload)
        else:
            self._finish(upload)

    def _refuse_size(self, message: m.MissionCount, channel: Channel) -> None:
        self._acknowledge(sender_of(message), message.mission_type, _Result.NO_SPACE, channel)

    def _register_upload(self, message: AnyListMessage, channel: Channel, first: int, end: int) -> ListUpload:
        """Register an upload of the items from ``first`` to before ``end``. Nothing is sent."""
        upload = ListUpload(
            client=sender_of(message), channel=channel, mission_type=message.mission_type, next=first, end=end,
            received_at=self._host.now, requested_at=self._host.now, uses_int=self.requests_int,
        )  # fmt: skip
        self._uploads[self._key(upload.mission_type)] = upload
        return upload

    def _request_first_item(self, upload: ListUpload) -> None:
        self._request_item(upload)
        self._schedule_check(upload)

    def _drop(self, upload: ListUpload) -> None:
        """End an upload without an answer to the client."""
        self._uploads.pop(self._key(upload.mission_type), None)

    def _end(self, upload: ListUpload, result: int) -> None:
        self._drop(upload)
        opaque_id = self.opaque_id(upload.mission_type) if result == _Result.ACCEPTED else 0
        answer = m.MissionAck(*upload.client, result, upload.mission_type, opaque_id=opaque_id)
        self._ended.pop(upload.client, None)
        self._ended[upload.client] = upload, answer
        if len(self._ended) > MAX_CLIENTS:
            del self._ended[next(iter(self._ended))]
        self._host.send(answer, upload.channel)

    def _request_item(self, upload: ListUpload) -> None:
        upload.requested_at = self._host.now
        request_class = m.MissionRequestInt if upload.uses_int else m.MissionRequest
        self._host.send(request_class(*upload.client, upload.next, upload.mission_type), upload.channel)

    def _schedule_check(self, upload: ListUpload) -> None:
        """Schedule the next retry or the time-out."""
        due = min(upload.requested_at + self.retry_interval_s, upload.received_at + self.timeout_s)
        self._host.call_at(due, lambda: self._check(upload))

    def _check(self, upload: ListUpload) -> None:
        """End an upload that has timed out, or request the missing item again."""
        if not self._may_time_out(upload):
            return
        if self._host.now >= upload.received_at + self.timeout_s:
            self._time_out(upload)
            return
        if self._host.now >= upload.requested_at + self.retry_interval_s:
            self._repeat(upload)
        self._schedule_check(upload)

    def _is_running(self, upload: ListUpload) -> bool:
        return self._uploads.get(self._key(upload.mission_type)) is upload

    def _may_time_out(self, upload: ListUpload) -> bool:
        return self._is_running(upload) and not upload.is_being_validated

    def _repeat(self, upload: ListUpload) -> None:
        self._request_item(upload)

    def _time_out(self, upload: ListUpload) -> None:
        self._end(upload, _Result.OPERATION_CANCELLED)

    def _on_item(self, message: AnyItem, channel: Channel) -> None:
        # As in ArduPilot (MissionItemProtocol.cpp), another sender's item is DENIED only if its number is the expected
        # one. The answer is sent over the channel of the upload.
        upload = self._uploads.get(self._key(message.mission_type))
        if upload is None or message.mission_type != upload.mission_type:
            self._answer_item(message, _Result.ERROR, channel)
        elif message.seq != upload.next:
            self._answer_item(message, _Result.INVALID_SEQUENCE, upload.channel)
        elif sender_of(message) != upload.client:
            self._answer_item(message, _Result.DENIED, upload.channel)
        elif not upload.is_being_validated:
            self._receive_item(upload, message)

    def _answer_item(self, message: AnyItem, result: int, channel: Channel) -> None:
        """Called for an unexpected item."""
        # Like PX4 (mavlink_mission.cpp, handle_mission_item_both), answer only a repeated last item: its client has
        # missed the answer. An upload in progress requests its expected item again anyway.
        client = sender_of(message)
        if client not in self._ended or any(upload.client == client for upload in self._uploads.values()):
            return
        upload, answer = self._ended[client]
        if (message.mission_type, message.seq) == (upload.mission_type, upload.end - 1):
            self._host.send(answer, upload.channel)

    def _receive_item(self, upload: ListUpload, message: AnyItem) -> None:
        try:
            self._store_item(upload, message)
        except ItemRefused as refused:
            self._end(upload, refused.result)
            return
        upload.received_at = self._host.now
        upload.next += 1
        if upload.next < upload.end:
            self._request_item(upload)
        else:
            self._finish(upload)

    def _finish(self, upload: ListUpload) -> None:
        upload.is_being_validated = True

        def answer(result: int) -> None:  # `validate` may call it now or later.
            if self._is_running(upload):
                if result == _Result.ACCEPTED:
                    self.store(upload.mission_type, upload.items)
                self._end(upload, result)

        try:
            self._validate(upload.mission_type, tuple(upload.items), answer)
        except InvalidArgument:
            answer(_Result.INVALID)

    def _on_ack(self, ack: m.MissionAck, channel: Channel) -> None:
        upload = self._uploads.get(self._key(ack.mission_type))
        if (
            upload is not None
            and sender_of(ack) == upload.client
            and not upload.is_being_validated
            and ack.type != _Result.ACCEPTED  # ACCEPTED ends a download.
        ):
            self._drop(upload)

    def _on_clear(self, request: m.MissionClearAll, channel: Channel) -> None:
        client, kind = sender_of(request), request.mission_type
        if kind not in (*self.lists, MavMissionType.ALL):
            self._acknowledge(client, kind, _Result.UNSUPPORTED, channel)
        elif self._clearing is not None:
            is_repeated = (sender_of(self._clearing), self._clearing.mission_type) == (client, kind)
            if not is_repeated:  # A repeated request is answered together with its first transmission.
                self._acknowledge(client, kind, _Result.DENIED, channel)
        elif self.transfer_is_open:
            self._acknowledge(client, kind, _Result.DENIED, channel)
        else:
            self._clearing = request
            non_empty: list[int] = [mission_type for mission_type in _TYPES if self.lists[mission_type]]
            self._clear(non_empty if kind == MavMissionType.ALL else [kind], request, channel)

    def _clear(self, kinds: list[int], request: m.MissionClearAll, channel: Channel) -> None:
        """Clear these lists one after the other, and acknowledge the request."""
        if not kinds:
            self._end_clearing(_Result.ACCEPTED, request, channel)
            return
        kind, *other_kinds = kinds

        def answer(result: int) -> None:  # `validate` may call it now or later.
            if result == _Result.ACCEPTED and self._clearing is request:
                self.store(kind, ())
                self._clear(other_kinds, request, channel)
            else:
                self._end_clearing(result, request, channel)

        try:
            self._validate(kind, (), answer)
        except InvalidArgument:
            answer(_Result.INVALID)

    def _end_clearing(self, result: int, request: m.MissionClearAll, channel: Channel) -> None:
        if self._clearing is request:  # False if the server was reset before the answer arrived.
            self._clearing = None
            self._acknowledge(sender_of(request), request.mission_type, result, channel)

    def _on_set_current(self, request: m.MissionSetCurrent, channel: Channel) -> None:
        if not self.set_current(request.seq):
            self._host.send(self.current_message(), channel)
