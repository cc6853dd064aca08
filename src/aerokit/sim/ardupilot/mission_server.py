"""Mission protocol of ArduPilot.

The server accepts one upload at a time for each list (mission, fence, rally points). Until an upload ends, other
components can neither upload nor download that list. Downloads are stateless: items can be requested in any order.
https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult, MavMissionType, MavSeverity
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
from aerokit.protocols.servers.missions import AnyItem, item_from, item_message_float, item_message_int
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.ardupilot.mission_items import has_location, stored, whole
from aerokit.sim.ardupilot.mission_lists import CommandList, FenceList, ItemList, RallyList
from aerokit.sim.channel import Channel
from aerokit.sim.missions import float32
from aerokit.sim.vehicle import sender_of

_RETRY_INTERVAL_S, _UPLOAD_TIMEOUT_S = 1.0, 8.0
_DEGREE = 1e7
_MAX_COMMANDS, _MAX_RALLY_POINTS = 650, 46
_GUIDED_TARGET, _ALTITUDE_CHANGE = 2, 3
_R = MavMissionResult


@dataclass
class _Upload:
    items: ItemList
    mission_type: int
    partner: tuple[int, int]
    channel: Channel
    next: int
    last: int
    received_at: float
    requested_at: float
    has_warned: bool = False


class ArduPilotMissionServer:
    """Stores mission, fence and rally points, and transfers them."""

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle = vehicle
        self.commands: CommandList = CommandList(
            _MAX_COMMANDS, self._home, lambda: vehicle.mission.is_being_flown, vehicle.KIND
        )
        """The mission."""
        self.fence: FenceList = FenceList()
        self.rally: RallyList = RallyList(_MAX_RALLY_POINTS)
        self._lists: dict[int, ItemList] = {
            MavMissionType.MISSION: self.commands,
            MavMissionType.FENCE: self.fence,
            MavMissionType.RALLY: self.rally,
        }
        self._uploads: dict[int, _Upload] = {}
        self._has_warned_of_request: set[int] = set()

    def listen(self) -> None:
        on = self._vehicle.on
        on(m.MissionRequestList, self._on_request_list)
        on(m.MissionRequestInt, self._on_request_int)
        on(m.MissionRequest, self._on_request)
        on(m.MissionCount, self._on_count)
        on(m.MissionWritePartialList, self._on_write_partial_list)
        on(m.MissionItemInt, self._on_item)
        on(m.MissionItem, self._on_item)
        on(m.MissionClearAll, self._on_clear_all)
        on(m.MissionSetCurrent, self._on_set_current)

    @property
    def transfer_is_open(self) -> bool:
        return bool(self._uploads)

    def items(self, mission_type: int) -> list[MissionItem]:
        """Return the items that a download sends, home first; empty for an unknown type."""
        items = self._lists.get(mission_type)
        return [] if items is None else items.items()

    def replace(self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True) -> int:
        """Store items like a file upload; return the MAV_MISSION_RESULT. Only missions support ``clear=False``."""
        if mission_type == MavMissionType.MISSION:
            if clear:
                self._clear(self.commands)
            return self.commands.write_file(list(items), start)
        if not clear:
            return _R.ERROR
        if mission_type == MavMissionType.FENCE:
            return self.fence.replace(items, self._warn)
        self.rally.clear()
        for seq, item in enumerate(items):
            result = self.rally.put(seq, item, len(items) - 1)
            if result != _R.ACCEPTED:
                return result
        return _R.ACCEPTED

    def reset(self) -> None:
        """Drop uploads because of a reboot; stored items stay."""
        self._uploads.clear()

    def _home(self) -> MissionItem:
        home = self._vehicle.navigation.home
        if home is None:
            return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL)
        place = self._vehicle.frame.to_global(*home)
        altitude = float32(round(place.altitude_m * 100) * float32(0.01))
        return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL, x=place.latitude_e7, y=place.longitude_e7, z=altitude)

    def _warn(self, text: str) -> None:
        self._vehicle.send_text(MavSeverity.WARNING, text)

    def _acknowledge(self, message: Message, result: int, mission_type: int, channel: Channel) -> None:
        self._vehicle.send(m.MissionAck(*sender_of(message), result, mission_type), channel)

    def _list_for(self, message: Message, mission_type: int, channel: Channel) -> ItemList | None:
        """Return the list of this type; if it is not supported, refuse the request and return None."""
        items = self._lists.get(mission_type)
        if items is not None and mission_type != MavMissionType.MISSION and channel.version == 1:
            self._warn("Need mavlink2 for item transfer")
            items = None
        if items is None:
            self._acknowledge(message, _R.UNSUPPORTED, mission_type, channel)
        return items

    def _capacity(self, items: ItemList) -> int:
        """Return the capacity; that of the mission is 0 until the vehicle is initialised."""
        return 0 if items is self.commands and not self._vehicle.is_initialised else items.capacity

    def _on_request_list(self, request: m.MissionRequestList, channel: Channel) -> None:
        mission_type = request.mission_type
        items = self._list_for(request, mission_type, channel)
        if items is None:
            return
        if mission_type in self._uploads:
            self._acknowledge(request, _R.DENIED, mission_type, channel)
            return
        self._vehicle.send(m.MissionCount(*sender_of(request), items.count, mission_type), channel)

    def _on_request_int(self, request: m.MissionRequestInt, channel: Channel) -> None:
        mission_type = request.mission_type
        if mission_type not in self._lists or (items := self._list_for(request, mission_type, channel)) is None:
            return
        if mission_type in self._uploads:
            self._acknowledge(request, _R.DENIED, mission_type, channel)
            return
        item = items.item(request.seq)
        to = sender_of(request)
        if isinstance(item, int):
            if item == _R.INVALID_SEQUENCE:
                self._vehicle.send(m.MissionCount(*to, items.count, mission_type), channel)
            self._acknowledge(request, item, mission_type, channel)
            return
        current = self._is_current(item, mission_type)
        message = item_message_int(item, request.seq, to, mission_type, current=current)
        self._vehicle.send(message, channel)

    def _on_request(self, request: m.MissionRequest, channel: Channel) -> None:
        mission_type = request.mission_type
        if mission_type not in self._lists or (items := self._list_for(request, mission_type, channel)) is None:
            return
        item = items.item(request.seq)
        if isinstance(item, int):
            self._acknowledge(request, item, mission_type, channel)
            return
        place: tuple[float, float] = (item.x, item.y)
        if has_location(item.command):
            place = (float32(item.x * float32(1e-7)), float32(item.y * float32(1e-7)))
        if mission_type not in self._has_warned_of_request:
            self._has_warned_of_request.add(mission_type)
            self._warn("got MISSION_REQUEST; use MISSION_REQUEST_INT!")
        current = int(self._is_current(item, mission_type))
        to = sender_of(request)
        self._vehicle.send(item_message_float(item, place, request.seq, to, mission_type, current), channel)

    def _is_current(self, item: MissionItem, mission_type: int) -> bool:
        """Return True if the firmware marks the item as current.

        The firmware compares the item's command, instead of its index, with the index of the current item.
        """
        return mission_type == MavMissionType.MISSION and item.command == self._vehicle.mission.nav_index

    def _on_count(self, count: m.MissionCount, channel: Channel) -> None:
        mission_type = count.mission_type
        items = self._list_for(count, mission_type, channel)
        if items is None or not self._cancel(count, mission_type, channel):
            return
        if count.count > self._capacity(items):
            self._acknowledge(count, _R.NO_SPACE, mission_type, channel)
            self._warn(f"Only {self._capacity(items)} items are supported")
            return
        items.begin(count.count)
        upload = self._upload(items, count, mission_type, channel, 0, count.count - 1)
        if count.count == 0:
            self._complete(upload)
        else:
            self._start(upload)

    def _on_write_partial_list(self, request: m.MissionWritePartialList, channel: Channel) -> None:
        mission_type, start, end = request.mission_type, request.start_index, request.end_index
        items = self._list_for(request, mission_type, channel)
        if items is None:
            return
        if mission_type in self._uploads:
            self._acknowledge(request, _R.DENIED, mission_type, channel)
        elif not 0 <= start <= end <= items.count:
            self._warn("Flight plan update rejected")
            self._acknowledge(request, _R.ERROR, mission_type, channel)
        else:
            items.begin_update()
            self._start(self._upload(items, request, mission_type, channel, start, end))

    def _cancel(self, message: Message, mission_type: int, channel: Channel) -> bool:
        """Cancel the sender's upload; return False if another component is uploading."""
        upload = self._uploads.get(mission_type)
        if upload is None:
            return True
        if upload.partner != sender_of(message):
            self._acknowledge(message, _R.DENIED, mission_type, channel)
            return False
        self._end(upload)
        return True

    def _upload(
        self, items: ItemList, message: Message, mission_type: int, channel: Channel, first: int, last: int
    ) -> _Upload:
        now = self._vehicle.now
        return _Upload(items, mission_type, sender_of(message), channel, first, last, now, now)

    def _start(self, upload: _Upload) -> None:
        self._uploads[upload.mission_type] = upload
        self._has_warned_of_request.discard(upload.mission_type)
        self._request_item(upload)
        self._watch(upload)

    def _end(self, upload: _Upload) -> None:
        self._uploads.pop(upload.mission_type, None)
        upload.items.abandon()

    def _request_item(self, upload: _Upload) -> None:
        upload.requested_at = self._vehicle.now
        if self._vehicle.is_initialised:
            request = m.MissionRequest(*upload.partner, upload.next, upload.mission_type)
            self._vehicle.send(request, upload.channel)

    def _watch(self, upload: _Upload) -> None:
        """Schedule the next retry or the time-out."""
        due = min(upload.requested_at + _RETRY_INTERVAL_S, upload.received_at + _UPLOAD_TIMEOUT_S)
        self._vehicle.call_at(due, lambda: self._check(upload))

    def _check(self, upload: _Upload) -> None:
        if self._uploads.get(upload.mission_type) is not upload:
            return
        now = self._vehicle.now
        if now >= upload.received_at + _UPLOAD_TIMEOUT_S:
            self._end(upload)
            self._warn(f"{upload.items.name} upload timeout")
            ack = m.MissionAck(*upload.partner, _R.OPERATION_CANCELLED, upload.mission_type)
            self._vehicle.send(ack, upload.channel)
            return
        if now >= upload.requested_at + _RETRY_INTERVAL_S:
            self._request_item(upload)
        self._watch(upload)

    def _on_item(self, message: AnyItem, channel: Channel) -> None:
        mission_type = message.mission_type
        item = item_from(message)
        if isinstance(message, m.MissionItem):
            converted = _without_floats(item)
            if isinstance(converted, int):
                self._acknowledge(message, converted, mission_type, channel)
                return
            item = converted
        if mission_type == MavMissionType.MISSION and message.current in (_GUIDED_TARGET, _ALTITUDE_CHANGE):
            self._acknowledge(message, self._guide(item, message.current), mission_type, channel)
            return
        if mission_type not in self._lists:
            self._acknowledge(message, _R.UNSUPPORTED, mission_type, channel)
            return
        upload = self._uploads.get(mission_type)
        if upload is None:
            self._acknowledge(message, _R.ERROR, mission_type, channel)
            return
        if isinstance(message, m.MissionItem) and not upload.has_warned:
            upload.has_warned = True
            self._warn("got MISSION_ITEM; GCS should send MISSION_ITEM_INT")
        self._receive_item(upload, message, item)

    def _receive_item(self, upload: _Upload, message: AnyItem, item: MissionItem) -> None:
        def refuse(result: int) -> None:
            self._acknowledge(message, result, upload.mission_type, upload.channel)

        if message.seq != upload.next:
            refuse(_R.INVALID_SEQUENCE)
        elif sender_of(message) != upload.partner:
            refuse(_R.DENIED)
        elif (result := upload.items.put(message.seq, item, upload.last)) != _R.ACCEPTED:
            refuse(result)
            self._end(upload)
        else:
            upload.received_at = self._vehicle.now
            upload.next += 1
            if upload.next > upload.last:
                self._complete(upload)
            else:
                self._request_item(upload)

    def _complete(self, upload: _Upload) -> None:
        result = upload.items.finish(self._warn)
        if upload.items is self.commands:
            self._vehicle.info("Flight plan received")
        self._vehicle.send(m.MissionAck(*upload.partner, result, upload.mission_type), upload.channel)
        self._end(upload)

    def _on_clear_all(self, request: m.MissionClearAll, channel: Channel) -> None:
        mission_type = request.mission_type
        items = self._lists.get(mission_type)
        if items is None:
            self._acknowledge(request, _R.UNSUPPORTED, mission_type, channel)
            return
        done = self._cancel(request, mission_type, channel) and self._clear(items)
        self._acknowledge(request, _R.ACCEPTED if done else _R.ERROR, mission_type, channel)

    def _on_set_current(self, request: m.MissionSetCurrent, channel: Channel) -> None:
        """Set the current item; MISSION_CURRENT has the requested index, even if another item runs."""
        if self._vehicle.mission.set_current(request.seq):
            self._vehicle.send(self._vehicle.mission.message(request.seq), channel)

    def _clear(self, items: ItemList) -> bool:
        done = items.clear()
        if done and items is self.commands:
            self._vehicle.mission.clear()
        return done

    def _guide(self, item: MissionItem, current: int) -> int:
        """Handle an item whose ``current`` field makes it a target for GUIDED."""
        kept = stored(item, self._vehicle.KIND)
        if isinstance(kept, int):
            return kept
        if current == _ALTITUDE_CHANGE:
            return _R.ACCEPTED
        vehicle = self._vehicle
        point = vehicle.point(int(kept.x), int(kept.y), kept.z, kept.frame)
        if vehicle.mode is not vehicle.guided or kept.command != MavCmd.NAV_WAYPOINT or point is None:
            return _R.ERROR
        vehicle.guided.go_to(point)
        return _R.ACCEPTED


def _without_floats(item: MissionItem) -> MissionItem | int:
    """Convert the degrees of a MISSION_ITEM to integers, in single precision."""
    if not has_location(item.command):
        return item.replace(x=whole(item.x), y=whole(item.y))
    if not abs(item.x) <= 90.0:
        return _R.INVALID_PARAM5_X
    if not abs(item.y) <= 180.0:
        return _R.INVALID_PARAM6_Y
    return item.replace(x=int(float32(item.x * _DEGREE)), y=int(float32(item.y * _DEGREE)))
