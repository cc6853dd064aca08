"""`Looking`: where another vehicle is that a gimbal looks at."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.messages import GlobalPositionInt
from aerokit.position import Position
from aerokit.vehicle.gimbal.directions import direction_to

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.runtime.bus import Detach
    from aerokit.vehicle.gimbal.arrival import Wanted
    from aerokit.vehicle.orders.bridge import Bridge

__all__ = ["Looking"]

OLD_S = 5.0
"""A place that was told longer ago is none."""


class Looking:
    """In its block: what that system tells on our connection."""

    def __init__(self, bridge: Bridge, system_id: int) -> None:
        self._bridge, self._system_id = bridge, system_id
        self._there: Position | None = None
        self._at = 0.0
        self._detach: Detach | None = None

    def __enter__(self) -> Self:
        bus = self._bridge.talk.connection.bus
        self._detach = bus.attach(GlobalPositionInt, self._hear, system_id=self._system_id)
        return self

    def __exit__(self, *_: object) -> None:
        if self._detach is not None:
            self._detach()

    def direction(self) -> Wanted | None:
        """The way there from the vehicle; None while that is not known."""
        if self._there is None or self._bridge.talk.connection.now() - self._at > OLD_S:
            return None
        return direction_to(self._bridge, self._there)

    def _hear(self, message: GlobalPositionInt) -> None:
        if message.lat or message.lon:
            self._there = Position(message.lat * 1e-7, message.lon * 1e-7, altitude_amsl_m=message.alt * 1e-3)
            self._at = self._bridge.talk.connection.now()
