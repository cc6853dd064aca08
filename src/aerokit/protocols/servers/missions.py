"""Server for missions, fences and rally points (https://mavlink.io/en/services/mission.html)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavMissionResult, MavMissionType
from aerokit.missions import MissionItem
from aerokit.missions.wire import from_wire, to_wire, to_wire_float
from aerokit.protocols.servers.host import Channel, ServerHost, sender_of

AnyItem = m.MissionItemInt | m.MissionItem
AnyRequest = m.MissionRequestInt | m.MissionRequest


def item_from(message: AnyItem) -> MissionItem:
    """Convert a MISSION_ITEM_INT or MISSION_ITEM to an item; does not scale ``x`` and ``y``."""
    numbers = (message.param1, message.param2, message.param3, message.param4, message.x, message.y, message.z)
    return MissionItem(message.command, message.frame, *numbers, autocontinue=bool(message.autocontinue))


def item_message_int(
    item: MissionItem, seq: int, to: tuple[int, int], mission_type: int, *, current: bool
) -> m.MissionItemInt:
    system, component = to
    return to_wire(
        item, seq, target_system=system, target_component=component, mission_type=mission_type, current=current
    )


def item_message_float(
    item: MissionItem, place: tuple[float, float], seq: int, to: tuple[int, int], mission_type: int, current: int = 0
) -> m.MissionItem:
    """Create a MISSION_ITEM; ``place`` becomes ``x`` and ``y``."""
    head = (*to, seq, item.frame, item.command, current, int(item.autocontinue))
    numbers = (item.param1, item.param2, item.param3, item.param4)
    return m.MissionItem(*head, *numbers, *place, item.z, mission_type)


ITEM_RETRY_INTERVAL_S = 0.5
TRANSFER_TIMEOUT_S = 5.0
MAX_ITEMS = 2000
_TYPES = (MavMissionType.MISSION, MavMissionType.FENCE, MavMissionType.RALLY)
_R = MavMissionResult

# Accepts or refuses an uploaded list: called with MAV_MISSION_TYPE, items, and a function that takes the
# MAV_MISSION_RESULT.
Judge = Callable[[int, tuple[MissionItem, ...], Callable[[int], None]], None]


@dataclass(eq=False)
class _Upload:
    client: tuple[int, int]
    channel: Channel
    mission_type: int
    count: int
    received_at: float
    items: list[MissionItem] = field(default_factory=list)
    uses_int: bool = True
    is_judged: bool = False
    """True from the call of ``judge`` until its answer."""


class MissionServer:
    """Stores missions, fences and rally points. Downloads have no state; one upload runs at a time.

    When ``judge`` has accepted an upload, it replaces the whole list. A missing item is requested again every half
    second. An upload without progress for five seconds ends with OPERATION_CANCELLED. During an upload, other clients
    are DENIED.
    """

    def __init__(
        self,
        host: ServerHost,
        judge: Judge,
        *,
        on_set_current: Callable[[int], bool] = lambda _: False,
        capacity: int = MAX_ITEMS,
    ) -> None:
        self.lists: dict[int, tuple[MissionItem, ...]] = dict.fromkeys(_TYPES, ())
        """Maps MAV_MISSION_TYPE to items; call `replace` to change them."""
        self._opaque_ids: dict[int, int] = {}  # Cached, because MISSION_CURRENT reports them at its stream rate.
        self.current: int = 0
        """Index of the current item of the mission."""
        self._host = host
        self._judge = judge
        self._on_set_current = on_set_current
        self._capacity = capacity
        self._upload: _Upload | None = None
        host.on(m.MissionRequestList, self._on_request_list)
        host.on(m.MissionRequestInt, self._on_request)
        host.on(m.MissionRequest, self._on_request)
        host.on(m.MissionCount, self._on_count)
        host.on(m.MissionItemInt, self._on_item)
        host.on(m.MissionItem, self._on_item)
        host.on(m.MissionAck, self._on_ack)
        host.on(m.MissionClearAll, self._on_clear)
        host.on(m.MissionSetCurrent, self._on_set_current_message)

    @property
    def transfer_is_open(self) -> bool:
        """True during an upload."""
        return self._upload is not None

    def opaque_id(self, mission_type: int) -> int:
        """Return a checksum of a list, or 0 for an empty list. The current item does not change it."""
        items = self.lists.get(mission_type, ())
        if items and mission_type not in self._opaque_ids:
            messages = (_item_message(item, seq, (0, 0), mission_type, current=False) for seq, item in enumerate(items))
            self._opaque_ids[mission_type] = zlib.crc32(b"".join(message.encode() for message in messages)) or 1
        return self._opaque_ids[mission_type] if items else 0

    def current_message(self) -> m.MissionCurrent:
        mission = self.lists[MavMissionType.MISSION]
        fence, rally = self.opaque_id(MavMissionType.FENCE), self.opaque_id(MavMissionType.RALLY)
        total = len(mission)
        return m.MissionCurrent(
            self.current, total, mission_id=self.opaque_id(0), fence_id=fence, rally_points_id=rally
        )

    def replace(self, mission_type: int, items: Sequence[MissionItem]) -> None:
        """Replace a list."""
        self.lists[mission_type] = tuple(items)
        self._opaque_ids.pop(mission_type, None)
        if mission_type == MavMissionType.MISSION:
            self.current = 0

    def set_current(self, seq: int) -> bool:
        """Let the component continue at an item, and announce the item; return False if the component refuses."""
        if not 0 <= seq < len(self.lists[MavMissionType.MISSION]) or not self._on_set_current(seq):
            return False
        self.current = seq
        self._host.send(self.current_message())
        return True

    def _is_current(self, seq: int, mission_type: int) -> bool:
        return seq == self.current and mission_type == MavMissionType.MISSION

    def _acknowledge(self, to: tuple[int, int], kind: int, result: int, channel: Channel, opaque_id: int = 0) -> None:
        self._host.send(m.MissionAck(*to, result, kind, opaque_id), channel)

    def _on_request_list(self, request: m.MissionRequestList, channel: Channel) -> None:
        kind, to = request.mission_type, sender_of(request)
        if kind not in self.lists:
            self._acknowledge(to, kind, _R.UNSUPPORTED, channel)
            return
        self._host.send(m.MissionCount(*to, len(self.lists[kind]), kind, self.opaque_id(kind)), channel)

    def _on_request(self, request: AnyRequest, channel: Channel) -> None:
        kind, to, seq = request.mission_type, sender_of(request), request.seq
        items = self.lists.get(kind, ())
        if not 0 <= seq < len(items):
            self._acknowledge(to, kind, _R.INVALID_SEQUENCE, channel)
        elif isinstance(request, m.MissionRequestInt):
            message = _item_message(items[seq], seq, to, kind, current=self._is_current(seq, kind))
            self._host.send(message, channel)
        else:
            system, component = to
            self._host.send(
                to_wire_float(
                    items[seq],
                    seq,
                    target_system=system,
                    target_component=component,
                    mission_type=kind,
                    current=self._is_current(seq, kind),
                ),
                channel,
            )

    def _on_count(self, count: m.MissionCount, channel: Channel) -> None:
        client, kind = sender_of(count), count.mission_type
        before = self._upload
        if kind not in self.lists:
            self._acknowledge(client, kind, _R.UNSUPPORTED, channel)
        elif before is not None and (before.client != client or before.is_judged):
            self._acknowledge(client, kind, _R.DENIED, channel)
        elif count.count > self._capacity:
            self._upload = None
            self._acknowledge(client, kind, _R.NO_SPACE, channel)
        else:
            self._upload = upload = _Upload(client, channel, kind, count.count, self._host.now)
            if count.count:
                self._request_item(upload)
            else:
                self._finish(upload)

    def _request_item(self, upload: _Upload) -> None:
        """Request the next item until it arrives."""
        seq = len(upload.items)
        request = m.MissionRequestInt if upload.uses_int else m.MissionRequest
        self._host.send(request(*upload.client, seq, upload.mission_type), upload.channel)

        def check() -> None:
            if self._upload is not upload or len(upload.items) != seq:
                return
            if self._host.now - upload.received_at >= TRANSFER_TIMEOUT_S:
                self._end(upload, _R.OPERATION_CANCELLED)
            else:
                self._request_item(upload)

        self._host.call_later(ITEM_RETRY_INTERVAL_S, check)

    def _on_item(self, message: AnyItem, channel: Channel) -> None:
        upload = self._upload
        if upload is None or sender_of(message) != upload.client or upload.is_judged:
            return
        if message.mission_type != upload.mission_type or message.seq != len(upload.items):
            return  # A late copy of an earlier item; the expected item is requested again.
        upload.received_at, upload.uses_int = self._host.now, isinstance(message, m.MissionItemInt)
        upload.items.append(from_wire(message))
        if len(upload.items) < upload.count:
            self._request_item(upload)
        else:
            self._finish(upload)

    def _finish(self, upload: _Upload) -> None:
        upload.is_judged = True

        def answer(result: int) -> None:
            if self._upload is upload:
                if result == _R.ACCEPTED:
                    self.replace(upload.mission_type, upload.items)
                self._end(upload, result)

        try:
            self._judge(upload.mission_type, tuple(upload.items), answer)
        except InvalidArgument:
            answer(_R.INVALID)

    def _end(self, upload: _Upload, result: int) -> None:
        self._upload = None
        kind = upload.mission_type
        opaque_id = self.opaque_id(kind) if result == _R.ACCEPTED else 0
        self._acknowledge(upload.client, kind, result, upload.channel, opaque_id)

    def _on_ack(self, ack: m.MissionAck, channel: Channel) -> None:
        """End the client's own upload. At the end of a download there is nothing to do."""
        upload = self._upload
        if upload is not None and sender_of(ack) == upload.client and not upload.is_judged and ack.type != _R.ACCEPTED:
            self._upload = None

    def _on_clear(self, request: m.MissionClearAll, channel: Channel) -> None:
        client, kind = sender_of(request), request.mission_type
        if kind not in (*self.lists, MavMissionType.ALL):
            self._acknowledge(client, kind, _R.UNSUPPORTED, channel)
        elif self._upload is not None:
            self._acknowledge(client, kind, _R.DENIED, channel)
        elif kind == MavMissionType.ALL:
            self._clear([each for each in _TYPES if self.lists[each]], client, kind, channel)
        else:
            self._clear([kind], client, kind, channel)

    def _clear(self, kinds: list[int], client: tuple[int, int], answered: int, channel: Channel) -> None:
        """Clear these lists one after the other, each if ``judge`` accepts it."""
        if not kinds:
            self._acknowledge(client, answered, _R.ACCEPTED, channel)
            return

        def answer(result: int) -> None:
            if result != _R.ACCEPTED:
                self._acknowledge(client, answered, result, channel)
                return
            self.replace(kinds[0], ())
            self._clear(kinds[1:], client, answered, channel)

        self._judge(kinds[0], (), answer)

    def _on_set_current_message(self, request: m.MissionSetCurrent, channel: Channel) -> None:
        if not self.set_current(request.seq):
            self._host.send(self.current_message(), channel)


def _item_message(
    item: MissionItem, seq: int, to: tuple[int, int], mission_type: int, *, current: bool
) -> m.MissionItemInt:
    whole = item.replace(x=round(item.x), y=round(item.y))
    return item_message_int(whole, seq, to, mission_type, current=current)
