"""Waits for something that takes a while, and gives up as soon as it cannot happen any more."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

from aerokit._internal import geo
from aerokit._internal.arguments import check_range
from aerokit.errors import HeartbeatTimeout, InvalidArgument, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavLandedState
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from typing_extensions import Self

    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.session.session import Talk

TICK_S = 0.25
"""Silence brings no message, so it is looked for this often."""

LONGEST_SILENCE_S = 10.0

OLD_POSITION_S = 2.0

STILL_S, MOVED_M = 12.0, 0.3


async def await_progress(
    talk: Talk,
    what: str,
    *,
    is_done: Callable[[], bool],
    trouble: Callable[[], str | None],
    describe: Callable[[], str],
    timeout: float | None,
    max_silence_s: float | None = LONGEST_SILENCE_S,
    held_for: float = 0.0,
    stillness: Callable[[], str | None] | None = None,
) -> None:
    """Return when ``is_done()`` has been true for ``held_for`` seconds; looked at whenever the vehicle's state changes.

    Raises:
        OperationRejected: ``trouble()`` gave a reason: it cannot happen any more.
        HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds (None: that is survived).
        OperationTimeout: ``timeout`` seconds have passed, or ``stillness()`` says that it does not move; ``describe()``
            tells how far it came.
        ConnectionClosed, LinkLost: the connection ended.
    """
    started = reasons_from = talk.connection.now()
    telemetry = talk.telemetry
    cells = (telemetry.mode, telemetry.armed, telemetry.position, telemetry.landed_state)
    done_since: float | None = None
    with Arrivals(talk, *cells) as news:
        while True:
            now = talk.connection.now()
            talk.connection.raise_if_ended()
            done_since = (now if done_since is None else done_since) if is_done() else None
            if done_since is not None and now - done_since >= held_for:
                return
            if done_since is None and (reason := trouble()):
                raise OperationRejected(f"{what}: {reason}", reasons=talk.texts_since(reasons_from))
            if max_silence_s is not None and talk.watch.silent_for_s > max_silence_s:
                raise HeartbeatTimeout(f"{what}: {talk.describe_link()}")
            if timeout is not None and now - started >= timeout:
                raise OperationTimeout(
                    f"{what}: not done within {timeout:g} s; {describe()}; {talk.describe_link()}"
                )
            if stillness is not None and (still := stillness()):
                raise OperationTimeout(f"{what}: {still}; {describe()}; {talk.describe_link()}")
            await news.next(TICK_S)


class Arrivals:
    """In its block: what is heard in any of these cells, and the end of the connection."""

    def __init__(self, talk: Talk, *cells: StateCell[Any], every_arrival: bool = False) -> None:
        self._talk, self._cells, self._every_arrival = talk, cells, every_arrival
        self._news = asyncio.Event()
        self._ends: list[Callable[[], None]] = []

    def __enter__(self) -> Self:
        hear = self._news.set
        self._ends = [
            cell.observe(lambda *_: hear(), every_arrival=self._every_arrival) for cell in self._cells
        ]
        self._ends.append(self._talk.connection.on_end(lambda _: hear()))
        return self

    def __exit__(self, *_: object) -> None:
        for end in self._ends:
            end()

    async def next(self, at_most_s: float) -> None:
        """Wait for news, or for so many seconds: silence brings none."""
        self._news.clear()
        # no cancel scope: on Python 3.10 one that runs out swallows a cancellation of the same turn of the loop
        tick = asyncio.get_running_loop().call_later(at_most_s, self._news.set)
        try:
            await self._news.wait()
        finally:
            tick.cancel()


class Stillness:
    """Notices a vehicle that has accepted an order to go somewhere and stays where it is.

    Nothing is said while its position is not heard, nor before ``STILL_S`` seconds: it turns first, or spools up.
    """

    # together with _from
    _since: float

    def __init__(self, talk: Talk) -> None:
        self._talk = talk
        self._from: Position | None = None

    def __call__(self) -> str | None:
        """How long it has not moved, in words; None: it moves, or that is not known."""
        now, cell = self._talk.connection.now(), self._talk.telemetry.position
        here = cell.latest
        if here is None or cell.age > OLD_POSITION_S:
            self._from = None
        elif self._from is None or _metres(here, self._from) > MOVED_M:
            self._from, self._since = here, now
        elif now - self._since >= STILL_S:
            return f"it has accepted the order and not moved for {now - self._since:.0f} s"
        return None


def _metres(one: Position, other: Position) -> float:
    above = [(each.altitude_relative_m, each.altitude_amsl_m) for each in (one, other)]
    climbed = next((abs(a - b) for a, b in zip(*above, strict=True) if a is not None and b is not None), 0.0)
    return one.distance_to(other) + climbed


METRES_PER_DEGREE = 112_000
"""Of latitude, or of longitude at the equator, at most."""

MAX_DISTANCE_M = 100_000.0
"""Farther away, a place is taken for a mistake (coordinates exchanged, a sign lost) unless the call says so."""


class Whereabouts:
    """By what the vehicle has told."""

    def __init__(self, talk: Talk) -> None:
        self._telemetry, self._autopilot = talk.telemetry, talk.autopilot

    def distance_to(self, target: Position) -> float:
        """Metres from where the vehicle is to ``target``; in three dimensions when ``target`` has an altitude.

        Infinite while the position is unknown.
        """
        here = self._telemetry.position.latest
        if here is None:
            return math.inf
        along = geo.distance_m(
            here.latitude_deg, here.longitude_deg, target.latitude_deg, target.longitude_deg
        )
        return math.hypot(along, self._altitude_difference(here, target))

    def check_reach(self, name: str, places: Iterable[Position], max_distance_m: float) -> None:
        """Raise InvalidArgument for a place that is farther away; none is while the position is unknown."""
        check_range("max_distance_m", max_distance_m, 0, math.inf, above=True)
        here = self._telemetry.position.latest
        if here is None:
            return
        for place in places:
            degrees = abs(place.latitude_deg - here.latitude_deg) + abs(
                place.longitude_deg - here.longitude_deg
            )
            if degrees * METRES_PER_DEGREE < max_distance_m:  # missions have thousands of places nearby
                continue
            distance_m = self.distance_to(place)
            if distance_m > max_distance_m:
                raise InvalidArgument(
                    f"{name} = {place.latitude_deg:.7f}, {place.longitude_deg:.7f} is not allowed: it is"
                    f" {distance_m / 1000:,.0f} km away, more than max_distance_m = {max_distance_m:,.0f}; nothing was"
                    " sent. Pass a greater max_distance_m if that is meant"
                )

    def way_left(self, target: Position) -> float:
        """Along the ground for a vehicle that stays on it; the altitude it tells may count from anywhere."""
        if self._autopilot.stays_on_the_ground:
            return self.distance_to(Position(target.latitude_deg, target.longitude_deg))
        return self.distance_to(target)

    @staticmethod
    def _altitude_difference(here: Position, target: Position) -> float:
        for mine, its in (
            (here.altitude_relative_m, target.altitude_relative_m),
            (here.altitude_amsl_m, target.altitude_amsl_m),
        ):
            if mine is not None and its is not None:
                return mine - its
        return 0.0

    def is_known_since(self, started: float) -> bool:
        """Whether a position has come since then and is not old: nobody arrives by an old one."""
        position = self._telemetry.position
        return position.updated_at >= started and position.age <= OLD_POSITION_S

    def altitude_relative(self) -> float:
        """Metres above home; −inf while that is not known."""
        here = self._telemetry.position.latest
        altitude = None if here is None else here.altitude_relative_m
        return -math.inf if altitude is None else altitude

    def home_altitude(self) -> float:
        """Metres above the sea; ValueUnknownError while home is not known."""
        return self._telemetry.home.value.altitude_amsl_m

    def global_target(self, target: Position) -> tuple[int, int, float, bool]:
        """Latitude and longitude in 1e-7 degrees, altitude in metres, and whether it is above home.

        PX4 reads altitudes above mean sea level only, so home must be known there for one above home.
        """
        relative, amsl = target.altitude_relative_m, target.altitude_amsl_m
        if relative is None and amsl is None:
            relative = self._telemetry.position.fresh(OLD_POSITION_S).altitude_relative_m
        is_relative = relative is not None
        altitude = relative if relative is not None else amsl
        if altitude is None:
            raise InvalidArgument("the target has no altitude, and the vehicle's own is not known")
        check_range("altitude", altitude, -12_000, 100_000)
        if is_relative and not self.takes_relative_altitude:
            altitude, is_relative = altitude + self.home_altitude(), False
        return round(target.latitude_deg * 1e7), round(target.longitude_deg * 1e7), altitude, is_relative

    def stands_on_the_ground(self) -> bool:
        """Whether it was told just now that a vehicle which flies is on the ground."""
        landed = self._telemetry.landed_state
        flies = self._autopilot.mode_for("take_off", is_vtol=self._telemetry.is_vtol) is not None
        return flies and landed.latest == MavLandedState.ON_GROUND and landed.age <= OLD_POSITION_S

    @property
    def takes_relative_altitude(self) -> bool:
        """Whether it understands altitudes above home."""
        return self._autopilot.reposition is None or self._autopilot.reposition.relative_altitude
