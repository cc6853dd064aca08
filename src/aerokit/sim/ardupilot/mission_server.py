"""ArduPilot's side of the mission protocol: it asks for what is uploaded, and answers whoever asks.

One upload at a time of each kind (mission, fence, rally points). Meanwhile nobody else may upload that kind or read it.
A download has no state: any item can be asked for at any time. https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult, MavMissionType, MavSeverity
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
from aerokit.missions.wire import to_wire
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.ardupilot.mission_items import has_location, stored, whole
from aerokit.sim.ardupilot.mission_lists import CommandList, FenceList, ItemList, RallyList
from aerokit.sim.channel import Channel
from aerokit.sim.missions import AnyItem, float32, item_from, item_message_float
from aerokit.sim.vehicle import sender_of

_ASK_AGAIN_S, _GIVE_UP_S = 1.0, 8.0
_DEGREE = 1e7
_COMMANDS_IN_MEMORY, _RALLY_POINTS_IN_MEMORY = 650, 46
_GUIDED_TARGET, _ALTITUDE_CHANGE = 2, 3
_R = MavMissionResult


@dataclass
class _Upload:
    """Items on their way from somebody."""

    items: ItemList
    mission_type: int
    partner: tuple[int, int]
    channel: Channel
    next: int
    last: int
    received_at: float
    asked_at: float
    has_warned: bool = False


class MissionServer:
    """Mission, fence and rally points: kept here, sent and received here."""

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self.commands: CommandList = CommandList(
            _COMMANDS_IN_MEMORY, self._home, lambda: vehicle.mission.is_being_flown, vehicle.KIND
        )
        """The mission, for its execution."""
        self.fence: FenceList = FenceList()
        self.rally: RallyList = RallyList(_RALLY_POINTS_IN_MEMORY)
        self._lists: dict[int, ItemList] = {
            MavMissionType.MISSION: self.commands,
            MavMissionType.FENCE: self.fence,
            MavMissionType.RALLY: self.rally,
        }
        self._uploads: dict[int, _Upload] = {}
        self._has_warned_of_request: set[int] = set()

    def listen(self) -> None:
        """Hear the protocol's messages."""
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
        """All items as they are given back, home first; empty for an unknown type."""
        items = self._lists.get(mission_type)
        return [] if items is None else items.items()

    def replace(
        self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True
    ) -> int:
        """Store items as a file does; the MAV_MISSION_RESULT. Without ``clear`` only commands can be changed."""
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
        """A reboot: uploads are forgotten, items are not."""
        self._uploads.clear()

    def _home(self) -> MissionItem:
        home = self._vehicle.navigation.home
        if home is None:
            return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL)
        place = self._vehicle.frame.to_global(*home)
        altitude = float32(round(place.altitude_m * 100) * float32(0.01))
        return MissionItem(
            MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL, x=place.latitude_e7, y=place.longitude_e7, z=altitude
        )

    def _warn(self, text: str) -> None:
        self._vehicle.send_text(MavSeverity.WARNING, text)

    def _acknowledge(self, message: Message, result: int, mission_type: int, channel: Channel) -> None:
        self._vehicle.send(m.MissionAck(*sender_of(message), result, mission_type), channel)

    def _find(self, message: Message, mission_type: int, channel: Channel) -> ItemList | None:
        """The list of that type, if it can be talked about on this channel; else the refusal is sent."""
        items = self._lists.get(mission_type)
        if items is not None and mission_type != MavMissionType.MISSION and channel.version == 1:
            self._warn("Need mavlink2 for item transfer")
            items = None
        if items is None:
            self._acknowledge(message, _R.UNSUPPORTED, mission_type, channel)
        return items

    def _capacity(self, items: ItemList) -> int:
        """The mission's memory is known only once the vehicle is initialised."""
        return 0 if items is self.commands and not self._vehicle.is_initialised else items.capacity

    def _on_request_list(self, request: m.MissionRequestList, channel: Channel) -> None:
        mission_type = request.mission_type
        items = self._find(request, mission_type, channel)
        if items is None:
            return
        if mission_type in self._uploads:
            self._acknowledge(request, _R.DENIED, mission_type, channel)
            return
        self._vehicle.send(m.MissionCount(*sender_of(request), items.count, mission_type), channel)

    def _on_request_int(self, request: m.MissionRequestInt, channel: Channel) -> None:
        mission_type = request.mission_type
        if mission_type not in self._lists or (items := self._find(request, mission_type, channel)) is None:
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
        message = to_wire(
            item,
            request.seq,
            target_system=to[0],
            target_component=to[1],
            mission_type=mission_type,
            current=current,
        )
        self._vehicle.send(message, channel)

    def _on_request(self, request: m.MissionRequest, channel: Channel) -> None:
        mission_type = request.mission_type
        if mission_type not in self._lists or (items := self._find(request, mission_type, channel)) is None:
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
        """As in the firmware, which compares the item's command with the number of the current item."""
        return mission_type == MavMissionType.MISSION and item.command == self._vehicle.mission.nav_index

    def _on_count(self, count: m.MissionCount, channel: Channel) -> None:
        mission_type = count.mission_type
        items = self._find(count, mission_type, channel)
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
        items = self._find(request, mission_type, channel)
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
        """Whether a new transfer may begin: whoever is uploading may start again, nobody else may."""
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
        self._ask(upload)
        self._watch(upload)

    def _end(self, upload: _Upload) -> None:
        self._uploads.pop(upload.mission_type, None)
        upload.items.abandon()

    def _ask(self, upload: _Upload) -> None:
        upload.asked_at = self._vehicle.now
        if self._vehicle.is_initialised:
            request = m.MissionRequest(*upload.partner, upload.next, upload.mission_type)
            self._vehicle.send(request, upload.channel)

    def _watch(self, upload: _Upload) -> None:
        """Ask again and give up at the right time; one timer for each upload."""
        due = min(upload.asked_at + _ASK_AGAIN_S, upload.received_at + _GIVE_UP_S)
        self._vehicle.call_at(due, lambda: self._check(upload))

    def _check(self, upload: _Upload) -> None:
        if self._uploads.get(upload.mission_type) is not upload:
            return
        now = self._vehicle.now
        if now >= upload.received_at + _GIVE_UP_S:
            self._end(upload)
            self._warn(f"{upload.items.name} upload timeout")
            ack = m.MissionAck(*upload.partner, _R.OPERATION_CANCELLED, upload.mission_type)
            self._vehicle.send(ack, upload.channel)
            return
        if now >= upload.asked_at + _ASK_AGAIN_S:
            self._ask(upload)
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
        self._take(upload, message, item)

    def _take(self, upload: _Upload, message: AnyItem, item: MissionItem) -> None:
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
                self._ask(upload)

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
        """Answered with the number that was asked for, also when another one is flown."""
        if self._vehicle.mission.set_current(request.seq):
            self._vehicle.send(self._vehicle.mission.message(request.seq), channel)

    def _clear(self, items: ItemList) -> bool:
        done = items.clear()
        if done and items is self.commands:
            self._vehicle.mission.clear()
        return done

    def _guide(self, item: MissionItem, current: int) -> int:
        """An item that is no item but a target for GUIDED; `current` says so."""
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
    """MISSION_ITEM's degrees as the integers that they are meant to be, with a float's seven digits."""
    if not has_location(item.command):
        return item.replace(x=whole(item.x), y=whole(item.y))
    if not abs(item.x) <= 90.0:
        return _R.INVALID_PARAM5_X
    if not abs(item.y) <= 180.0:
        return _R.INVALID_PARAM6_Y
    return item.replace(x=int(float32(item.x * _DEGREE)), y=int(float32(item.y * _DEGREE)))
