"""``MissionItem``: one line of a mission, a fence or rally points, as MISSION_ITEM_INT has it."""

from __future__ import annotations

import math
from typing import Any

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavFrame
from aerokit.missions.commands import DEFAULT_XY, canonical_frame, command_name, xy_scale
from aerokit.position import Position
from aerokit.snapshot import Snapshot

__all__ = ["MissionItem"]


class MissionItem(Snapshot):
    """One item, raw: the numbers that go out, for commands that have no builder.

    ``command`` is a MAV_CMD, ``frame`` a MAV_FRAME, ``param1`` to ``param4`` are the command's, NaN where the standard
    allows "not given". ``x`` and ``y`` are integers as in MISSION_ITEM_INT: latitude and longitude in 1e-7 degrees in
    a global frame, 1e-4 m in a local one, for commands without a place their parameters 5 and 6 as they are (a
    fraction there fits only into the float form of the item). ``z`` is in metres, above what the frame says.

    Anything can be put in, because a vehicle or a file may hold anything; ``check`` of the whole plan refuses what
    makes no sense. Items are equal when all their fields are, NaN and NaN included.
    https://mavlink.io/en/messages/common.html#MISSION_ITEM_INT
    """

    command: int
    frame: int
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    x: int | float = 0
    y: int | float = 0
    z: float = 0.0
    autocontinue: bool = True

    @property
    def name(self) -> str:
        """The command's name without its MAV_CMD prefix: ``"NAV_WAYPOINT"``."""
        return command_name(self.command)

    @property
    def position(self) -> Position | None:
        """Where the item is, with the altitude above home or above the sea that its frame says.

        None for commands without a place, for local frames, and for 0°, 0°, which means "where the vehicle is". An
        altitude above the terrain is neither of the two: see ``z`` then.
        """
        if xy_scale(self.command, self.frame) != 10_000_000 or (self.x, self.y) in (
            (0, 0),
            (DEFAULT_XY,) * 2,
        ):
            return None
        altitude = self.z if math.isfinite(self.z) else None
        frame = canonical_frame(self.frame)
        try:
            return Position(
                self.x / 1e7,
                self.y / 1e7,
                altitude_amsl_m=altitude if frame == MavFrame.GLOBAL else None,
                altitude_relative_m=altitude if frame == MavFrame.GLOBAL_RELATIVE_ALT else None,
            )
        except InvalidArgument:
            return None

    def _key(self) -> tuple[Any, ...]:
        values: tuple[Any, ...] = self._values(self)
        return tuple("NaN" if value != value else value for value in values)

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, MissionItem) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())
