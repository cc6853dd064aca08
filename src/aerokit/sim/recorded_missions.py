"""The plans of a recorded vehicle: what was on it then."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame, MavMissionResult
from aerokit.sim.missions import AnyItem, AnyRequest, item_from, item_message_float
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.channel import Channel
    from aerokit.sim.recorded import RecordedVehicle

__all__ = ["RecordedMissions"]

_PATIENCE_S, _ATTEMPTS = 1.0, 5


@dataclass
class _Upload:
    mission_type: int
    count: int
    sender: tuple[int, int]
    channel: Channel
    items: list[AnyItem] = field(default_factory=list)
    attempts: int = 0


class RecordedMissions:
    """Gives plans as they were; takes plans with the result that uploads had then."""

    def __init__(self, vehicle: RecordedVehicle) -> None:
        self._vehicle = vehicle
        self._written: dict[int, tuple[AnyItem, ...]] = {}
        self._upload: _Upload | None = None
        self._done: dict[tuple[str, int], int] = {}
        for kind, handler in (
            (m.MissionRequestList, self._on_list),
            (m.MissionRequest, self._on_request),
            (m.MissionRequestInt, self._on_request),
            (m.MissionCount, self._on_count),
            (m.MissionItem, self._on_item),
            (m.MissionItemInt, self._on_item),
            (m.MissionClearAll, self._on_clear),
        ):
            vehicle.on(kind, handler)

    def items(self, mission_type: int) -> tuple[AnyItem, ...] | None:
        """The plan at present, or the first one that will be; None when the recording tells of none."""
        if mission_type in self._written:
            return self._written[mission_type]
        position, found = self._vehicle.position_s, None
        for plan in self._vehicle.recording.plans:
            if plan.mission_type == mission_type and (found is None or plan.since <= position):
                found = plan.items
        return found

    # ---------------------------------------------------------------------------------------- download

    def _on_list(self, request: m.MissionRequestList, channel: Channel) -> None:
        items = self.items(request.mission_type)
        if items is None:
            self._acknowledge(request, request.mission_type, MavMissionResult.UNSUPPORTED, channel)
            return
        count = m.MissionCount(*sender_of(request), len(items), request.mission_type)
        self._vehicle.send(count, channel)

    def _on_request(self, request: AnyRequest, channel: Channel) -> None:
        items = self.items(request.mission_type) or ()
        if request.seq >= len(items):
            self._acknowledge(request, request.mission_type, MavMissionResult.INVALID_SEQUENCE, channel)
            return
        as_float = isinstance(request, m.MissionRequest)
        self._vehicle.send(
            _item_message(items[request.seq], request.seq, sender_of(request), as_float), channel
        )

    # ------------------------------------------------------------------------------------------ upload

    def _on_count(self, message: m.MissionCount, channel: Channel) -> None:
        if message.mission_type not in self._vehicle.recording.uploads:
            self._acknowledge(message, message.mission_type, MavMissionResult.UNSUPPORTED, channel)
            return
        self._upload = upload = _Upload(message.mission_type, message.count, sender_of(message), channel)
        self._continue(upload)

    def _on_item(self, message: AnyItem, channel: Channel) -> None:
        upload = self._upload
        if (
            upload is None
            or message.mission_type != upload.mission_type
            or sender_of(message) != upload.sender
        ):
            return
        if message.seq == len(upload.items):
            upload.items.append(message)
            upload.attempts = 0
            self._continue(upload)

    def _continue(self, upload: _Upload) -> None:
        if len(upload.items) < upload.count:
            self._ask(upload, len(upload.items))
            return
        self._upload = None
        result = self._result(
            "upload", self._vehicle.recording.uploads[upload.mission_type], upload.mission_type
        )
        if result == MavMissionResult.ACCEPTED:
            self._written[upload.mission_type] = tuple(upload.items)
        ack = m.MissionAck(*upload.sender, result, upload.mission_type)
        self._vehicle.send(ack, upload.channel)

    def _ask(self, upload: _Upload, seq: int) -> None:
        if self._upload is not upload or len(upload.items) != seq:
            return
        if upload.attempts >= _ATTEMPTS:
            self._upload = None
            return
        upload.attempts += 1
        kind = m.MissionRequestInt if self._vehicle.recording.asks_by_int else m.MissionRequest
        self._vehicle.send(kind(*upload.sender, seq, upload.mission_type), upload.channel)
        self._vehicle.call_later(_PATIENCE_S, lambda: self._ask(upload, seq))

    def _on_clear(self, message: m.MissionClearAll, channel: Channel) -> None:
        clears = self._vehicle.recording.clears.get(message.mission_type)
        result = MavMissionResult.UNSUPPORTED
        if clears is not None:
            result = MavMissionResult(self._result("clear", clears, message.mission_type))
        if result == MavMissionResult.ACCEPTED:
            self._written[message.mission_type] = ()
        self._acknowledge(message, message.mission_type, result, channel)

    def _result(self, what: str, results: list[int], mission_type: int) -> int:
        """The results of the recording one after the other, the last one again and again."""
        number = self._done.get((what, mission_type), 0)
        self._done[what, mission_type] = number + 1
        return results[min(number, len(results) - 1)]

    def _acknowledge(self, to: Message, mission_type: int, result: int, channel: Channel) -> None:
        self._vehicle.send(m.MissionAck(*sender_of(to), result, mission_type), channel)


def _item_message(item: AnyItem, seq: int, to: tuple[int, int], as_float: bool) -> AnyItem:
    scale = 1.0 if item.frame == MavFrame.MISSION else 1e7
    is_float = isinstance(item, m.MissionItem)
    if as_float:
        place = (item.x, item.y) if is_float else (item.x / scale, item.y / scale)
        return item_message_float(item_from(item), place, seq, to, item.mission_type, item.current)
    x, y = (round(item.x * scale), round(item.y * scale)) if is_float else (int(item.x), int(item.y))
    numbers = (item.param1, item.param2, item.param3, item.param4)
    head = (*to, seq, item.frame, item.command, item.current, item.autocontinue)
    return m.MissionItemInt(*head, *numbers, x, y, item.z, item.mission_type)
