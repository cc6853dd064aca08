"""``Show``: timed trajectories of several vehicles, and files that contain them. Without communication.

There are two file formats. Both have times in seconds, and points in metres north, east and up of the show's origin:

- CSV: the header ``name,t_s,north_m,east_m,up_m``, then one line for each point, names in any order;
- JSON: ``{"format": "aerokit show", "version": 1, "tracks": {"name": [[t_s, north_m, east_m, up_m], …], …}}``.
"""

from __future__ import annotations

import csv
import io
import json
import math
from bisect import bisect_right
from collections.abc import Mapping
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit._internal.files import read_bounded, write_atomically
from aerokit._internal.values import Snapshot
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.fleets.paths import LocalPoint, Path, PathPoint, vector_between
from aerokit.fleets.separation import Conflict, find_conflicts

if TYPE_CHECKING:
    import os

    from typing_extensions import Self

__all__ = ["Show", "state_at"]

COLUMNS = ["name", "t_s", "north_m", "east_m", "up_m"]

FORMAT, VERSION = "aerokit show", 1


class Show(Snapshot):
    """A show: trajectories by name. All times are in seconds since the common start."""

    tracks: Mapping[str, Path]

    @property
    def duration_s(self) -> float:
        """Seconds until the last trajectory ends."""
        return max(track.ends_at_s for track in self.tracks.values())

    def top_speed_m_s(self, name: str) -> float:
        """Return the speed of the fastest leg of one track, in m/s."""
        legs = pairwise(self.tracks[name].points)
        return max((_speed_between(start, end) for start, end in legs), default=0.0)

    def conflicts(self, min_distance_m: float, *, slack_s: float = 0.5) -> tuple[Conflict, ...]:
        """Return all pairs of tracks that come closer than ``min_distance_m``.

        Args:
            min_distance_m: minimum distance in metres.
            slack_s: how early or late one vehicle may be relative to another, in seconds.
        """
        return find_conflicts(list(self.tracks.values()), min_distance_m, slack_s=slack_s)

    def renamed(self, names: Mapping[str, str]) -> Self:
        """Return the show with other track names. ``names`` maps the names in the show to names of fleet members.

        Raises:
            InvalidArgument: ``names`` lacks a track, or gives two tracks the same name.
        """
        missing = [track_name for track_name in self.tracks if track_name not in names]
        if missing:
            raise InvalidArgument(f"names has no fleet member for these tracks: {', '.join(missing)}")
        members = [names[track_name] for track_name in self.tracks]
        if len(set(members)) < len(members):
            raise InvalidArgument(f"names has the same fleet member for two tracks: {', '.join(members)}")
        return type(self)({names[name]: track.replace(name=names[name]) for name, track in self.tracks.items()})

    @classmethod
    def from_points(cls, tracks: Mapping[str, Any]) -> Self:
        """Make a show from points ``(t_s, north_m, east_m, up_m)`` for each name.

        Raises:
            InvalidArgument: a point is not four numbers, or the times of a track decrease.
        """
        parsed: dict[str, Path] = {}
        for name, points in tracks.items():
            try:
                parsed[name] = Path(name, [PathPoint(*map(float, point)) for point in points])
            except (TypeError, ValueError, OverflowError) as error:  # A number of 400 digits raises OverflowError.
                raise InvalidArgument(f"track {name!r}: {error}") from None
        return cls(parsed)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a CSV or JSON file. The format is detected from the content.

        Raises:
            FileFormatError: the file is damaged, or neither CSV nor JSON; the text names the line or the track.
            OSError: the file cannot be read.
        """
        text = read_bounded(path).decode("utf-8-sig", errors="replace")
        try:
            return cls.from_json(text) if text.lstrip().startswith("{") else cls.from_csv(text)
        except InvalidArgument as error:
            raise FileFormatError(f"{path}: {error}") from None

    @classmethod
    def from_csv(cls, text: str) -> Self:
        """Parse a show in CSV, in the format that the module describes.

        Raises:
            InvalidArgument: the text is not in this format. The error names the line or the track.
        """
        reader = csv.reader(io.StringIO(text))
        try:
            rows = [(reader.line_num, row) for row in reader]
        except csv.Error as error:  # For example, a quote never ends.
            raise InvalidArgument(f"line {reader.line_num}: {error}") from None
        _, header = rows.pop(0) if rows else (0, [])
        if [cell.strip() for cell in header] != COLUMNS:
            raise InvalidArgument(f"line 1 must be {','.join(COLUMNS)}")
        points: dict[str, list[PathPoint]] = {}
        for line_number, row in rows:
            if not row:
                continue
            try:
                name, *numbers = row
                t_s, north_m, east_m, up_m = map(float, numbers)
                points.setdefault(name, []).append(PathPoint(t_s, north_m, east_m, up_m))
            except ValueError as error:
                raise InvalidArgument(f"line {line_number}: {error}") from None
        return cls({name: Path(name, path) for name, path in points.items()})

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Parse a show in JSON, in the format that the module describes.

        Raises:
            InvalidArgument: the text is not in this format. If a track is wrong, the error names it.
        """
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InvalidArgument(f"the text is not JSON: {error}") from None
        if not isinstance(data, dict) or (data.get("format"), data.get("version")) != (FORMAT, VERSION):
            raise InvalidArgument(
                f'the JSON text is not a show: its "format" must be "{FORMAT}", its "version" {VERSION}'
            )
        tracks = data.get("tracks")
        if not isinstance(tracks, dict):
            raise InvalidArgument('the "tracks" of the show must be a JSON object with track names as keys')
        return cls.from_points(tracks)

    def to_csv(self) -> str:
        """Return the show as CSV text."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(COLUMNS)
        for name, track in self.tracks.items():
            writer.writerows([name, point.t_s, *point.place] for point in track.points)
        return out.getvalue()

    def to_json(self) -> str:
        """Return the show as JSON text."""
        tracks = {name: [[point.t_s, *point.place] for point in track.points] for name, track in self.tracks.items()}
        return json.dumps({"format": FORMAT, "version": VERSION, "tracks": tracks})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file: JSON if its name ends in ``.json``, otherwise CSV. Raises OSError."""
        write_atomically(path, self.to_json() if str(path).lower().endswith(".json") else self.to_csv())

    def _check(self) -> None:
        # A copy, so that the caller may change its own dictionary later. Plain assignment would raise, because the
        # class is immutable.
        object.__setattr__(self, "tracks", dict(self.tracks))
        if not self.tracks:
            raise InvalidArgument("a show needs at least one track")
        for name, track in self.tracks.items():
            if not isinstance(track, Path) or track.begins_at_s < 0:
                raise InvalidArgument(f"tracks[{name!r}] must be a Path that begins at 0 s or later")
            for start, end in pairwise(track.points):
                if not _speed_between(start, end) < math.inf:
                    raise InvalidArgument(f"tracks[{name!r}] has two positions at {end.t_s:g} s")


class PathState(NamedTuple):
    """Position and velocity on a path, in metres and m/s north, east and up."""

    place: LocalPoint
    velocity: LocalPoint


def state_at(path: Path, at_s: float) -> PathState:
    """Return the position and the velocity on a path at a time."""
    points = path.points
    next_index = bisect_right(points, at_s, key=attrgetter("t_s"))
    if next_index == 0:
        return PathState(points[0].place, (0.0, 0.0, 0.0))
    if next_index == len(points):
        return PathState(points[-1].place, (0.0, 0.0, 0.0))
    start, end = points[next_index - 1], points[next_index]  # The end is later than `at_s`, so the duration is not 0.
    duration_s = end.t_s - start.t_s
    fraction = (at_s - start.t_s) / duration_s
    vector = vector_between(start.place, end.place)
    place = tuple(a + fraction * d for a, d in zip(start.place, vector, strict=True))
    velocity = tuple(d / duration_s for d in vector)
    return PathState(place, velocity)  # type: ignore[arg-type]


def _speed_between(start: PathPoint, end: PathPoint) -> float:
    distance_m, duration_s = math.dist(start.place, end.place), end.t_s - start.t_s
    if duration_s > 0:
        return distance_m / duration_s
    return math.inf if distance_m > 0 else 0.0
