"""PX4's side of the mission protocol: one transfer at a time on a link, step by step, given up after five seconds.

A new list is put together aside and takes the place of the old one when its last item has come. A download is a
conversation, too: items can only be asked for one after the other. https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavMissionResult, MavMissionType
from aerokit.sim.missions import AnyItem, AnyRequest
from aerokit.sim.px4.mission_items import checksum, given_back, stored
from aerokit.sim.px4.mission_link import MissionLink

if TYPE_CHECKING:
    from aerokit.missions import MissionItem
    from aerokit.sim.channel import Channel
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["MissionServer"]

_CAPACITIES: dict[int, int] = {
    MavMissionType.MISSION: 10_000,
    MavMissionType.FENCE: 64,
    MavMissionType.RALLY: 32,
}


class MissionServer:
    """Mission, fence and rally points: kept here, and shared by all links."""

    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4
        self._items: dict[int, list[MissionItem]] = {kind: [] for kind in _CAPACITIES}
        self._ids: dict[int, int] = dict.fromkeys(_CAPACITIES, 0)
        self._links: dict[Channel, MissionLink] = {}
        self.uploading: MissionLink | None = None
        """The link on which a new list is coming."""

    def listen(self) -> None:
        """Hear the protocol's messages."""
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

    def _link(self, channel: Channel) -> MissionLink:
        link = self._links.get(channel)
        if link is None:
            link = self._links[channel] = MissionLink(self._px4, self, channel)
        return link

    def _on_request(self, message: AnyRequest, channel: Channel) -> None:
        self._link(channel).on_request(message)

    def _on_item(self, message: AnyItem, channel: Channel) -> None:
        self._link(channel).on_item(message)

    def reset(self) -> None:
        """A reboot: transfers are forgotten, items are not."""
        self._links.clear()
        self.uploading = None

    # ---------------------------------------------------------------------- for others in the vehicle

    @property
    def transfer_is_open(self) -> bool:
        """Whether an upload or a download is going on, on any link."""
        return self.uploading is not None or any(not link.is_idle for link in self._links.values())

    def items(self, mission_type: int) -> list[MissionItem]:
        """All items as they are given back; empty for an unknown type."""
        return [given_back(item, as_int=True) for item in self._items.get(mission_type, ())]

    def replace(
        self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True
    ) -> int:
        """Store a whole list at once; the MAV_MISSION_RESULT. PX4 itself has no way to do so."""
        if mission_type not in _CAPACITIES or start or not clear:
            return MavMissionResult.ERROR
        kept = [stored(item, mission_type) for item in items]
        for item in kept:
            if isinstance(item, int):
                return item
        good = [item for item in kept if not isinstance(item, int)]
        self.store(mission_type, good, checksum(items))
        return MavMissionResult.ACCEPTED

    # ----------------------------------------------------------------------------------- for the links

    def capacity(self, mission_type: int) -> int:
        """How many fit; 0 of an unknown type."""
        return _CAPACITIES.get(mission_type, 0)

    def count(self, mission_type: int) -> int:
        """How many there are."""
        return len(self._items.get(mission_type, ()))

    def item(self, mission_type: int, seq: int) -> MissionItem | None:
        """One as it is kept."""
        items = self._items.get(mission_type, [])
        return items[seq] if 0 <= seq < len(items) else None

    def id(self, mission_type: int) -> int:
        """The opaque id of a list; 0 while it is empty."""
        return self._ids.get(mission_type, 0)

    @property
    def commands(self) -> Sequence[MissionItem]:
        """The mission, for its execution."""
        return self._items[MavMissionType.MISSION]

    def store(self, mission_type: int, items: list[MissionItem], opaque_id: int, current: int = -1) -> None:
        """A list has come; the same list again changes nothing."""
        if mission_type not in self._items or (items and opaque_id == self._ids[mission_type]):
            return
        self._items[mission_type], self._ids[mission_type] = items, opaque_id
        if mission_type == MavMissionType.MISSION:
            self._px4.mission.replaced(current)
        elif mission_type == MavMissionType.FENCE and items:
            self._px4.failsafes.fence.uploaded()

    def item_changed(self, seq: int) -> None:
        """Whoever spoke last on each link gets the item once more, unless a transfer goes on."""
        for link in self._links.values():
            link.send_changed(seq)

    def clear(self, mission_type: int) -> None:
        """Forget a list, or with MAV_MISSION_TYPE_ALL all of them."""
        for kind in _CAPACITIES:
            if mission_type in (kind, MavMissionType.ALL):
                self.store(kind, [], 0, 0)
