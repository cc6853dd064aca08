"""``Formation``: who flies where, as seen from a leader. Without IO."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Self

__all__ = ["Formation", "Offset", "follow_velocity"]


class Offset(Snapshot):
    """Metres from the leader: north and east, or ahead and right of it, and up."""

    north_m: float = 0.0
    east_m: float = 0.0
    up_m: float = 0.0

    def turned(self, heading_deg: float) -> Offset:
        """The same as north and east, where it was ahead and right of somebody with this heading."""
        angle = math.radians(heading_deg)
        return Offset(
            self.north_m * math.cos(angle) - self.east_m * math.sin(angle),
            self.north_m * math.sin(angle) + self.east_m * math.cos(angle),
            self.up_m,
        )

    def _check(self) -> None:
        for name in self.__match_args__:
            if not math.isfinite(getattr(self, name)):
                raise InvalidArgument(f"{name} = {getattr(self, name)!r} is not a finite number")


class Formation(Snapshot):
    """Member's name → its place; ``frame`` ``"north"``: metres north and east, ``"heading"``: ahead and right."""

    offsets: Mapping[str, Offset]
    frame: Literal["north", "heading"] = "north"

    @classmethod
    def line(
        cls, names: Sequence[str], spacing_m: float, *, frame: Literal["north", "heading"] = "heading"
    ) -> Self:
        """One behind the other, ``spacing_m`` metres apart."""
        return cls({name: Offset(-spacing_m * number, 0.0) for number, name in enumerate(names, 1)}, frame)

    @classmethod
    def wedge(
        cls, names: Sequence[str], spacing_m: float, *, frame: Literal["north", "heading"] = "heading"
    ) -> Self:
        """Behind the leader to the left and the right in turn, as geese fly; ``spacing_m`` back and aside each."""
        places = {
            name: Offset(
                -spacing_m * (number // 2 + 1), spacing_m * (number // 2 + 1) * (1 if number % 2 else -1)
            )
            for number, name in enumerate(names)
        }
        return cls(places, frame)

    def offset_of(self, name: str, heading_deg: float | None) -> Offset:
        """Its place as metres north, east and up of the leader.

        Raises:
            InvalidArgument: the leader's heading is needed and not known.
        """
        offset = self.offsets[name]
        if self.frame == "north":
            return offset
        if heading_deg is None:
            raise InvalidArgument("frame = 'heading' needs the leader's heading, and it is not known")
        return offset.turned(heading_deg)

    def least_distance_m(self) -> float:
        """Between any two places, the leader's among them."""
        places = [(each.north_m, each.east_m, each.up_m) for each in (Offset(), *self.offsets.values())]
        pairs = (math.dist(one, other) for number, one in enumerate(places) for other in places[:number])
        return min(pairs, default=math.inf)

    def _check(self) -> None:
        object.__setattr__(self, "offsets", dict(self.offsets))
        if self.frame not in ("north", "heading"):
            raise InvalidArgument(f"frame = {self.frame!r} is not allowed: 'north' or 'heading'")
        for name, offset in self.offsets.items():
            if not isinstance(offset, Offset):
                raise InvalidArgument(f"offsets: {name} has {offset!r}: an Offset is needed")


def follow_velocity(
    to_go: tuple[float, float, float],
    of_target: tuple[float, float, float],
    *,
    gain: float,
    max_speed_m_s: float,
) -> tuple[float, float, float]:
    """How fast to fly to come to a place that moves: its velocity, and ``gain`` of the way that is left each second.

    Args:
        to_go: metres to the place, each way.
        of_target: its velocity in m/s.
        gain: 1/s.
        max_speed_m_s: of all three together.
    """
    wanted = [v + gain * d for v, d in zip(of_target, to_go, strict=True)]
    speed = math.hypot(*wanted)
    share = 1.0 if speed <= max_speed_m_s else max_speed_m_s / speed
    return wanted[0] * share, wanted[1] * share, wanted[2] * share
