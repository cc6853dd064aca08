"""``Show``: timed trajectories of many vehicles, on one clock. Values and their files, without anything that flies.

Two formats are read, both with seconds, and metres north, east and up of the show's origin:

- CSV: a line ``name,t_s,north_m,east_m,up_m``, and below it one line for each point, in any order of names;
- JSON: ``{"format": "aerokit show", "version": 1, "tracks": {"name": [[t_s, north_m, east_m, up_m], …], …}}``.
"""

from __future__ import annotations

import csv
import io
import json
import math
from bisect import bisect_right
from collections.abc import Mapping
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Any

from aerokit._internal.files import read_bounded, write_whole
from aerokit._internal.values import Snapshot
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.fleets.paths import Path, PathPoint, Place
from aerokit.fleets.policy import FleetResult
from aerokit.fleets.separation import Conflict, conflicts_of
from aerokit.fleets.shows.clocks import ClockOffset

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

    from typing_extensions import Self

__all__ = ["Show", "ShowReport", "TrackError", "error_between", "state_at", "track_error"]

COLUMNS = ["name", "t_s", "north_m", "east_m", "up_m"]

FORMAT, VERSION = "aerokit show", 1


class Show(Snapshot):
    """Member's name → its path. All times count from the common start of the show."""

    tracks: Mapping[str, Path]

    @property
    def duration_s(self) -> float:
        """Seconds until the last of them is at its last point."""
        return max(each.ends_at_s for each in self.tracks.values())

    def top_speed_m_s(self, name: str) -> float:
        """The fastest of the legs of one track, in m/s."""
        legs = pairwise(self.tracks[name].points)
        return max((_speed(one, other) for one, other in legs), default=0.0)

    def conflicts(self, min_distance_m: float, *, slack_s: float = 0.5) -> tuple[Conflict, ...]:
        """All pairs that come nearer to each other than ``min_distance_m`` metres.

        Args:
            min_distance_m: metres.
            slack_s: by how many seconds one may be early or late compared with another.
        """
        return conflicts_of(list(self.tracks.values()), min_distance_m, slack_s=slack_s)

    def renamed(self, names: Mapping[str, str]) -> Self:
        """The same show by other members: name in the show → member's name.

        Raises:
            InvalidArgument: a name is missing, or two become one.
        """
        missing = [name for name in self.tracks if name not in names]
        if missing or len(set(names.values())) < len(self.tracks):
            raise InvalidArgument(f"names: {missing or 'two names for one member'}: each track needs its own")
        return type(self)(
            {names[name]: track.replace(name=names[name]) for name, track in self.tracks.items()}
        )

    @classmethod
    def from_points(cls, tracks: Mapping[str, Any]) -> Self:
        """Of ``(t_s, north_m, east_m, up_m)`` for each name.

        Raises:
            InvalidArgument: a point is no four numbers, or times go back.
        """
        made: dict[str, Path] = {}
        for name, points in tracks.items():
            try:
                made[name] = Path(name, [PathPoint(*map(float, each)) for each in points])
            except (TypeError, ValueError) as error:
                raise InvalidArgument(f"track {name!r}: {error}") from None
        return cls(made)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """A file, CSV or JSON by what is in it.

        Raises:
            FileFormatError: it is neither, or damaged; the text names the line or the track.
            OSError: it cannot be read.
        """
        text = read_bounded(path).decode("utf-8-sig", errors="replace")
        try:
            return cls.from_json(text) if text.lstrip().startswith("{") else cls.from_csv(text)
        except InvalidArgument as error:
            raise FileFormatError(f"{path}: {error}") from None

    @classmethod
    def from_csv(cls, text: str) -> Self:
        """See the module.

        Raises:
            InvalidArgument: it is not like that; the text names the line.
        """
        rows = csv.reader(io.StringIO(text))
        if [each.strip() for each in next(rows, [])] != COLUMNS:
            raise InvalidArgument(f"line 1 is not {','.join(COLUMNS)}")
        points: dict[str, list[PathPoint]] = {}
        for row in rows:
            if not row:
                continue
            try:
                name, *numbers = row
                t_s, north_m, east_m, up_m = map(float, numbers)
                points.setdefault(name, []).append(PathPoint(t_s, north_m, east_m, up_m))
            except ValueError as error:
                raise InvalidArgument(f"line {rows.line_num}: {error}") from None
        return cls({name: Path(name, each) for name, each in points.items()})

    @classmethod
    def from_json(cls, text: str) -> Self:
        """See the module.

        Raises:
            InvalidArgument: it is not like that; the text names the track.
        """
        try:
            found = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InvalidArgument(f"not JSON: {error}") from None
        tracks = found.get("tracks") if isinstance(found, dict) else None
        if not isinstance(tracks, dict) or (found.get("format"), found.get("version")) != (FORMAT, VERSION):
            raise InvalidArgument(f"not {FORMAT!r} of version {VERSION}")
        return cls.from_points(tracks)

    def to_csv(self) -> str:
        """The text of a CSV file."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(COLUMNS)
        for name, track in self.tracks.items():
            writer.writerows([name, each.t_s, *each.place] for each in track.points)
        return out.getvalue()

    def to_json(self) -> str:
        """The text of a JSON file."""
        tracks = {
            name: [[each.t_s, *each.place] for each in track.points] for name, track in self.tracks.items()
        }
        return json.dumps({"format": FORMAT, "version": VERSION, "tracks": tracks})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file, JSON if its name ends so, else CSV (OSError)."""
        write_whole(path, self.to_json() if str(path).lower().endswith(".json") else self.to_csv())

    def _check(self) -> None:
        object.__setattr__(self, "tracks", dict(self.tracks))
        if not self.tracks:
            raise InvalidArgument("tracks: a show needs one")
        for name, track in self.tracks.items():
            if not isinstance(track, Path) or track.begins_at_s < 0:
                raise InvalidArgument(f"tracks: {name!r} needs a Path that begins at 0 s or later")
            for one, other in pairwise(track.points):
                if not _speed(one, other) < math.inf:
                    raise InvalidArgument(f"tracks: {name!r} is at two places at {other.t_s:g} s")


def state_at(path: Path, at_s: float) -> tuple[Place, Place]:
    """Where somebody is at a time, and how fast: metres and m/s north, east and up."""
    points = path.points
    after = bisect_right(points, at_s, key=_time_of)
    if after == 0 or after == len(points):
        return points[min(after, len(points) - 1)].place, (0.0, 0.0, 0.0)
    one, other = points[after - 1], points[after]
    lasts = other.t_s - one.t_s
    share = (at_s - one.t_s) / lasts
    way = [b - a for a, b in zip(one.place, other.place, strict=True)]
    place = tuple(a + share * d for a, d in zip(one.place, way, strict=True))
    return place, (way[0] / lasts, way[1] / lasts, way[2] / lasts)  # type: ignore[return-value]


def _time_of(point: PathPoint) -> float:
    return point.t_s


def _speed(one: PathPoint, other: PathPoint) -> float:
    way, lasts = math.dist(one.place, other.place), other.t_s - one.t_s
    return way / lasts if lasts > 0 else (math.inf if way > 0 else 0.0)


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
