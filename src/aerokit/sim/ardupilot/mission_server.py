"""Mission protocol of ArduPilot.

The server accepts one upload at a time for each list (mission, fence, rally points). Until an upload ends, other
components can neither upload nor download that list. Downloads are stateless: items can be requested in any order.
https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionType, MavSeverity
from aerokit.mavlink.enums import MavMissionResult as Result
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
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
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.ardupilot.mission_items import as_stored, has_location
from aerokit.sim.ardupilot.mission_lists import CommandList, FenceList, ItemList, RallyList
from aerokit.sim.channel import Channel
from aerokit.sim.commands import to_int
from aerokit.sim.missions import float32
from aerokit.sim.vehicle import sender_of

_DEGREE = 1e7
_GUIDED_TARGET, _ALTITUDE_CHANGE = 2, 3  # values of `current` in items for GUIDED, which are not stored
_FENCE_UPDATE_INTERVAL_S = 0.1


class ArduPilotMissionServer(MissionServer):
    """Stores mission, fence and rally points, and transfers them."""

    retry_interval_s: ClassVar[float] = 1.0
    timeout_s: ClassVar[float] = 8.0
    requests_int: bool = False

    def __init__(self, vehicle: ArduPilotHost) -> None:
        super().__init__(vehicle)
        self._vehicle = vehicle
        self.commands: CommandList = CommandList(self._home, self._is_flying, vehicle.KIND)
        """The mission."""
        self.fence: FenceList = FenceList(self._on_fence_total)
        self._fence_total = 0
        self._was_fence_stored = False  # True once a fence was stored since the boot
        self.rally: RallyList = RallyList()
        self._lists: dict[int, ItemList] = {
            MavMissionType.MISSION: self.commands,
            MavMissionType.FENCE: self.fence,
            MavMissionType.RALLY: self.rally,
        }
        # (message type, list type) of the warnings that were sent.
        self._warnings: set[tuple[type[Message], int]] = set()
        vehicle.on(m.MissionWritePartialList, self._on_write_partial_list)

    def reset(self) -> None:
        super().reset()
        self._was_fence_stored = False

    def items(self, mission_type: int) -> list[MissionItem]:
        items = self._lists.get(mission_type)
        return [] if items is None else items.items()

    def replace(self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True) -> int:
        if mission_type != MavMissionType.MISSION and not clear:
            return Result.ERROR  # A fence and rally points are always replaced as a whole.
        try:
            if mission_type == MavMissionType.FENCE:
                self.fence.replace(items, self._warn)
                return Result.ACCEPTED
            if clear:  # The firmware writes the items even if a running mission prevents the clearing.
                self._clear_list(self._lists[mission_type])
            if mission_type == MavMissionType.MISSION:
                self.commands.write_file(items, start)
            else:
                for seq, item in enumerate(items):
                    self.rally.put(seq, item, len(items) - 1)
        except ItemRefused as refused:
            return refused.result
        return Result.ACCEPTED

    def _is_flying(self) -> bool:
        return self._vehicle.mission.is_running and self._vehicle.motors.is_armed

    def _home(self) -> MissionItem:
        home = self._vehicle.navigation.home
        if home is None:
            return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL)
        place = self._vehicle.frame.to_global(*home)
        altitude = float32(round(place.altitude_m * 100) * float32(0.01))
        return MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL, x=place.latitude_e7, y=place.longitude_e7, z=altitude)

    def _warn(self, text: str) -> None:
        self._vehicle.send_text(MavSeverity.WARNING, text)

    def _warn_once(self, message: AnyItem | AnyRequest, text: str) -> None:
        """Warn about the class of ``message``, at most once in a transfer."""
        warning = (type(message), message.mission_type)
        if warning not in self._warnings:
            self._warnings.add(warning)
            self._warn(text)

    def capacity(self, mission_type: int) -> int:
        if mission_type == MavMissionType.MISSION and not self._vehicle.is_initialised:
            return 0
        return self._lists[mission_type].capacity

    def count(self, mission_type: int) -> int:
        # The firmware counts the items of a fence at the end of its boot, or when it stores a fence.
        is_counted = self._vehicle.is_initialised or self._was_fence_stored
        is_uncounted_fence = mission_type == MavMissionType.FENCE and not is_counted
        return 0 if is_uncounted_fence else self._lists[mission_type].count

    def _key(self, mission_type: int) -> int:
        return mission_type

    def _refusal(self, message: AnyListMessage, channel: Channel) -> int | None:
        kind = message.mission_type
        needs_mavlink2 = kind in self._lists and kind != MavMissionType.MISSION
        if needs_mavlink2 and channel.version == 1:
            self._warn("Need mavlink2 for item transfer")
            return Result.UNSUPPORTED
        # During an upload, only MISSION_REQUEST is served, and even MISSION_REQUEST_INT is denied. The base class
        # decides on MISSION_COUNT.
        if kind in self._uploads and not isinstance(message, (m.MissionCount, m.MissionRequest)):
            return Result.DENIED
        return None if kind in self._lists else Result.UNSUPPORTED

    def _on_request(self, request: AnyRequest, channel: Channel) -> None:
        if request.mission_type in self._lists:
            super()._on_request(request, channel)

    def _refuse_item(self, request: AnyRequest, result: int, channel: Channel) -> None:
        if result == Result.INVALID_SEQUENCE and isinstance(request, m.MissionRequestInt):
            kind = request.mission_type
            self._vehicle.send(m.MissionCount(*sender_of(request), self.count(kind), kind), channel)
        super()._refuse_item(request, result, channel)

    def item(self, mission_type: int, seq: int) -> MissionItem | None:
        return self._lists[mission_type].item(seq)

    def _message(self, item: MissionItem, request: AnyRequest) -> AnyItem:
        client, kind, as_int = sender_of(request), request.mission_type, isinstance(request, m.MissionRequestInt)
        # The firmware has a bug: it compares the command of the item, not its index, with the index of the current
        # item.
        current = kind == MavMissionType.MISSION and item.command == self._vehicle.mission.nav_index
        place: tuple[float, float] = (item.x, item.y)
        if has_location(item.command):
            # The position in degrees, converted in single precision like in the firmware.
            place = (float32(item.x * float32(1e-7)), float32(item.y * float32(1e-7)))
        if not as_int:
            self._warn_once(request, "got MISSION_REQUEST; use MISSION_REQUEST_INT!")
        return item_message(item, request.seq, client, kind, as_int=as_int, current=current, place=place)

    def _refuse_size(self, message: m.MissionCount, channel: Channel) -> None:
        super()._refuse_size(message, channel)
        self._warn(f"Only {self.capacity(message.mission_type)} items are supported")

    def _register_upload(self, message: AnyListMessage, channel: Channel, first: int, end: int) -> ListUpload:
        if isinstance(message, m.MissionCount):
            self._lists[message.mission_type].begin(message.count)
        return super()._register_upload(message, channel, first, end)

    def _on_write_partial_list(self, request: m.MissionWritePartialList, channel: Channel) -> None:
        kind, start, end = request.mission_type, request.start_index, request.end_index
        refusal = self._refusal(request, channel)
        # `end` may be the index after the last item. An item with this index is appended to the list.
        if refusal is None and not 0 <= start <= end <= self.count(kind):
            self._warn("Flight plan update rejected")
            refusal = Result.ERROR
        if refusal is not None:
            self._acknowledge(sender_of(request), kind, refusal, channel)
            return
        self._lists[kind].begin_update()
        first, after_last = start, end + 1
        self._request_first_item(self._register_upload(request, channel, first, after_last))

    def _request_first_item(self, upload: ListUpload) -> None:
        self._warnings -= {(kind, upload.mission_type) for kind in (m.MissionItem, m.MissionRequest)}
        super()._request_first_item(upload)

    def _drop(self, upload: ListUpload) -> None:
        super()._drop(upload)
        self._lists[upload.mission_type].abandon()

    def _request_item(self, upload: ListUpload) -> None:
        upload.requested_at = self._vehicle.now
        if self._vehicle.is_initialised:
            super()._request_item(upload)

    def _time_out(self, upload: ListUpload) -> None:
        self._warn(f"{self._lists[upload.mission_type].name} upload timeout")
        super()._time_out(upload)

    def _on_item(self, message: AnyItem, channel: Channel) -> None:
        kind = message.mission_type
        is_target = kind == MavMissionType.MISSION and message.current in (_GUIDED_TARGET, _ALTITUDE_CHANGE)
        try:
            item = _with_integer_position(message)
            if is_target:  # The item is flown to, and not stored in a list.
                self._guide(item, message.current)
            elif kind not in self._lists:
                raise ItemRefused(Result.UNSUPPORTED)
        except ItemRefused as refused:
            self._answer_item(message, refused.result, channel)
            return
        if is_target:
            self._answer_item(message, Result.ACCEPTED, channel)
            return
        if isinstance(message, m.MissionItem) and kind in self._uploads:
            self._warn_once(message, "got MISSION_ITEM; GCS should send MISSION_ITEM_INT")
        super()._on_item(message, channel)

    def _answer_item(self, message: AnyItem, result: int, channel: Channel) -> None:
        self._acknowledge(sender_of(message), message.mission_type, result, channel)

    def _store_item(self, upload: ListUpload, message: AnyItem) -> None:
        self._lists[upload.mission_type].put(message.seq, _with_integer_position(message), upload.end - 1)

    def _finish(self, upload: ListUpload) -> None:
        result: int = Result.ACCEPTED
        try:
            self._lists[upload.mission_type].finish(self._warn)
        except ItemRefused as refused:
            result = refused.result
        if upload.mission_type == MavMissionType.MISSION:
            self._vehicle.info("Flight plan received")
        self._end(upload, result)

    def _on_ack(self, ack: m.MissionAck, channel: Channel) -> None:
        """Do nothing: ArduPilot ignores this message."""

    def _on_clear(self, request: m.MissionClearAll, channel: Channel) -> None:
        kind, client = request.mission_type, sender_of(request)
        upload = self._uploads.get(kind)
        result: int = Result.UNSUPPORTED
        if upload is not None and upload.client != client:
            # The firmware sends a second acknowledgement (ERROR, below) after this one.
            self._acknowledge(client, kind, Result.DENIED, channel)
            result = Result.ERROR
        elif kind in self._lists:
            if upload is not None:
                self._drop(upload)
            result = Result.ACCEPTED if self._clear_list(self._lists[kind]) else Result.ERROR
        self._acknowledge(client, kind, result, channel)

    def _on_set_current(self, request: m.MissionSetCurrent, channel: Channel) -> None:
        if self._vehicle.mission.set_current(request.seq):
            # The firmware answers with the requested index, even if the mission skips it.
            self._vehicle.send(self._vehicle.mission.message(request.seq), channel)

    def _clear_list(self, items: ItemList) -> bool:
        is_cleared = items.clear()
        if is_cleared and items is self.commands:
            self._vehicle.mission.on_cleared()
        return is_cleared

    def _on_fence_total(self, total: int) -> None:
        """Erase the fence soon if its FENCE_TOTAL changes to 0, as by an old ground station.

        This is an error of the firmware, which also erases a new fence of one or two circles that replaces a larger one
        (AC_PolyFence_loader.cpp, update, which runs at 10 Hz).
        """
        self._was_fence_stored = True
        before, self._fence_total = self._fence_total, total
        if total == 0 and before:
            self._host.call_at(self._host.now + _FENCE_UPDATE_INTERVAL_S, self._erase_fence)

    def _erase_fence(self) -> None:
        if self._fence_total == 0:
            self.fence.clear()

    def _guide(self, item: MissionItem, current: int) -> None:
        """Let GUIDED fly to an item. Raises ItemRefused."""
        stored_item = as_stored(item, self._vehicle.KIND)
        if current == _ALTITUDE_CHANGE:  # The altitude change has no effect in the simulation.
            return
        vehicle = self._vehicle
        point = vehicle.world_point(int(stored_item.x), int(stored_item.y), stored_item.z, stored_item.frame)
        is_waypoint = stored_item.command == MavCmd.NAV_WAYPOINT
        if vehicle.mode is not vehicle.guided or not is_waypoint or point is None:
            raise ItemRefused(Result.ERROR)
        vehicle.guided.go_to(point)


def _with_integer_position(message: AnyItem) -> MissionItem:
    """Return the item with integers x and y. Raises ItemRefused for an invalid position."""
    item = item_from(message)
    if isinstance(message, m.MissionItemInt):
        return item
    if not has_location(item.command):
        return item.replace(x=to_int(item.x), y=to_int(item.y))
    if not abs(item.x) <= 90.0:
        raise ItemRefused(Result.INVALID_PARAM5_X)
    if not abs(item.y) <= 180.0:
        raise ItemRefused(Result.INVALID_PARAM6_Y)
    # Like the firmware, convert the degrees in single precision.
    return item.replace(x=int(float32(item.x * _DEGREE)), y=int(float32(item.y * _DEGREE)))
