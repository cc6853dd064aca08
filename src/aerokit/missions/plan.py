"""``Plan``: what one QGroundControl file holds: mission, fence and rally points, and for which vehicle."""

from __future__ import annotations

from typing import Any

from aerokit.missions.fence import Fence
from aerokit.missions.mission import Mission
from aerokit.missions.rally import RallyPoints
from aerokit.snapshot import Snapshot

__all__ = ["Plan"]


class Plan(Snapshot):
    """A mission with its fence and its rally points, as QGroundControl keeps them in one ``.plan`` file.

    ``mission.home`` is the planned home position. ``firmware_type`` is a MAV_AUTOPILOT and ``vehicle_type`` a
    MAV_TYPE, for which it was planned; ``cruise_speed_m_s`` (planes) and ``hover_speed_m_s`` (copters) are what the
    planner reckons with. ``source`` is the text of the file it was read from: writing changes in it only what has
    become different, so that surveys and whatever else stands there stay. It is not compared.
    """

    mission: Mission = Mission()
    fence: Fence = Fence()
    rally: RallyPoints = RallyPoints()
    firmware_type: int = 0
    vehicle_type: int = 2
    cruise_speed_m_s: float = 15.0
    hover_speed_m_s: float = 5.0
    source: str = ""

    def _key(self) -> tuple[Any, ...]:
        return tuple(self.to_dict().values())[:-1]

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, Plan) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={value!r}" for name, value in self.to_dict().items() if name != "source")
        return f"Plan({fields})"
