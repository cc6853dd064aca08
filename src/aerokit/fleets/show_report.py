"""How well a show was flown: errors in place and time, of each and between them. Without IO."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

from aerokit.fleets.clocks import ClockOffset
from aerokit.fleets.results import FleetResult
from aerokit.fleets.show import state_at
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.fleets.paths import Path, Place

__all__ = ["ShowReport", "TrackError", "error_between", "track_error"]

SLOW_M_S = 0.3
"""Slower, nobody can tell late from beside."""
LOOKS = 60


class TrackError(Snapshot):
    """How one member flew its track: greatest and root mean square error in metres, and how late it was, in seconds.

    ``lag_s`` is what explains most of the error by being late (negative: early); None for who hardly moved.
    """

    max_m: float
    rms_m: float
    lag_s: float | None
    samples: int


class ShowReport(Snapshot):
    """How a show was flown. Times are by the vehicles' own clocks, as TIMESYNC has found them (``clocks``).

    ``tracks`` has the error of each; ``spread_s`` is how much later the latest was than the earliest, ``between_m`` how
    much the distance between any two was wrong, at most: None where that is not known. ``result`` says who flew it to
    its end.
    """

    result: FleetResult
    tracks: Mapping[str, TrackError]
    clocks: Mapping[str, ClockOffset]
    spread_s: float | None
    between_m: float | None


Samples = "Sequence[tuple[float, Place]]"


def track_error(path: Path, samples: Sequence[tuple[float, Place]]) -> TrackError:
    """Compare where a vehicle was, by seconds of the show, with its path.

    The lag is the one by which the path has to be shifted so that it fits best: least squares along the way.
    """
    errors: list[float] = []
    along = moved = 0.0
    for at_s, place in samples:
        planned, velocity = state_at(path, at_s)
        error = [p - q for p, q in zip(planned, place, strict=True)]
        errors.append(math.hypot(*error))
        if math.hypot(*velocity) >= SLOW_M_S:
            along += sum(e * v for e, v in zip(error, velocity, strict=True))
            moved += sum(v * v for v in velocity)
    if not errors:
        return TrackError(math.nan, math.nan, None, 0)
    rms = math.sqrt(sum(each * each for each in errors) / len(errors))
    return TrackError(max(errors), rms, along / moved if moved else None, len(errors))


def error_between(
    paths: Mapping[str, Path], samples: Mapping[str, Sequence[tuple[float, Place]]], duration_s: float
) -> float | None:
    """The greatest error in the way from one vehicle to another at the same time, in metres; None for fewer than two.

    Looked at 60 times in the show; where a vehicle was then is taken between two of its samples.
    """
    worst: float | None = None
    for look in range(LOOKS + 1):
        at_s = duration_s * look / LOOKS
        errors: list[Place] = []
        for name, path in paths.items():
            here = _between(samples.get(name, ()), at_s)
            if here is not None:
                planned = state_at(path, at_s)[0]
                errors.append((planned[0] - here[0], planned[1] - here[1], planned[2] - here[2]))
        if len(errors) > 1:
            worst = max(worst or 0.0, max(math.dist(one, other) for one, other in combinations(errors, 2)))
    return worst


def _between(samples: Sequence[tuple[float, Place]], at_s: float) -> Place | None:
    for (then, one), (after, other) in pairwise(samples):
        if then <= at_s <= after:
            share = 0.0 if after == then else (at_s - then) / (after - then)
            return (
                one[0] + share * (other[0] - one[0]),
                one[1] + share * (other[1] - one[1]),
                one[2] + share * (other[2] - one[2]),
            )
    return None
