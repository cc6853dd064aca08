"""``FlownTrack``: where a vehicle was in a show, by its own clock."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.errors import StaleValueError
from aerokit.fleets.nearness import METRES_PER_DEGREE
from aerokit.mavlink.messages import GlobalPositionInt

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.fleets.clocks import ClockOffset
    from aerokit.fleets.paths import Place
    from aerokit.fleets.whereabouts import Around
    from aerokit.runtime.bus import Detach
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["FlownTrack"]

CLOCK_S = 1.0
"""A time since boot that is farther from when it came, by TIMESYNC, is of another clock."""
OLD_S = 2.0


class FlownTrack:
    """In its block each GLOBAL_POSITION_INT becomes a sample: seconds of the show, and metres from its origin.

    The time is the vehicle's own (``time_boot_ms``) by its measured clock, and where that makes no sense, when it came.
    """

    def __init__(
        self, vehicle: Vehicle, clock: ClockOffset, around: Around, begin: float, base_m: float
    ) -> None:
        self._vehicle, self._clock, self._begin, self._base_m = vehicle, clock, begin, base_m
        origin = around.position((0.0, 0.0, base_m))
        self._latitude, self._longitude = origin.latitude_deg, origin.longitude_deg
        self._north_m, self._east_m = _metres_per_degree(around, self._latitude, self._longitude)
        self.samples: list[tuple[float, Place]] = []
        """Seconds of the show, from its start on, and the place then."""
        self._latest: tuple[float, Place, Place] | None = None
        self._detach: Detach | None = None

    def __enter__(self) -> Self:
        bus = self._vehicle.connection.bus
        self._detach = bus.attach(GlobalPositionInt, self._hear, system_id=self._vehicle.system_id)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._detach is not None:
            self._detach()

    @property
    def is_known(self) -> bool:
        """Whether it has told where it is since the block began."""
        return self._latest is not None

    def where_now(self) -> Place:
        """Where it is by now: what it told last, and how far it has flown since.

        Raises:
            StaleValueError: it has not told that for two seconds.
        """
        now = self._vehicle.connection.now()
        if self._latest is None or now - self._latest[0] > OLD_S:
            raise StaleValueError("it does not tell where it is (GLOBAL_POSITION_INT)")
        at, place, velocity = self._latest
        age = now - at
        return place[0] + age * velocity[0], place[1] + age * velocity[1], place[2] + age * velocity[2]

    def _hear(self, message: GlobalPositionInt) -> None:
        frame = message.received_frame
        if frame is None or frame.component_id != self._vehicle.component_id:
            return
        at = self._clock.to_ours(message.time_boot_ms / 1000)
        if abs(at - frame.received_at) > CLOCK_S:
            at = frame.received_at
        place = (
            (message.lat / 1e7 - self._latitude) * self._north_m,
            math.remainder(message.lon / 1e7 - self._longitude, 360.0) * self._east_m,
            message.alt / 1000 - self._base_m,
        )
        self._latest = at, place, (message.vx / 100, message.vy / 100, -message.vz / 100)
        if at >= self._begin:
            self.samples.append((at - self._begin, place))


def _metres_per_degree(around: Around, latitude: float, longitude: float) -> tuple[float, float]:
    """There, to the north and to the east: a show is flown within some hundred metres."""
    from aerokit.position import Position

    step = 1e-3
    north = around.place(Position(min(latitude + step, 90.0), longitude), 0.0)[0] / step
    east = around.place(Position(latitude, longitude + step), 0.0)[1] / step
    return north or METRES_PER_DEGREE, east
