"""Pictures of tracks from above, with altitude profiles, as SVG or (with Pillow) as PNG."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from importlib import import_module
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

from aerokit._internal.files import write_atomically
from aerokit.errors import AerokitError, InvalidArgument
from aerokit.position import Position
from aerokit.testing.track_points import TrackFailure, TrackPoint, metres_from

__all__ = ["check_picture", "draw_svg", "save_picture"]

_PALETTE = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b", "#e377c2")
_GREY = "#dddddd"
# Sizes and distances are in pixels.
_WIDTH = 800
_MAP_HEIGHT = 520
_PROFILE_HEIGHT = 160
_MARGIN = 60
_HEIGHT = _MAP_HEIGHT + _PROFILE_HEIGHT
_FONT_SIZE = 12
_MAX_NAMES = 8
_NAME_WIDTH = 90
_NAME_BASELINE = 18
_FAILED = "#e00000"
_LABEL_HEIGHT = 13
_LABEL_GAP = 8  # Pixels between a point and its label.
_LABEL_WIDTH = 60
_MAX_LABELS = 40
_CORNERS = 90  # Corners of the polygon that draws a circle.


class Drawable(Protocol):
    """Interface of a track that can be drawn."""

    home: Position
    name: str
    failure: TrackFailure | None

    def __iter__(self) -> Iterator[TrackPoint]: ...

    def __len__(self) -> int: ...

    def local(self, origin: Position | None = None) -> list[tuple[float, float, float]]:
        """Return each point as metres north and east of ``origin`` (default: home), and metres above home."""
        ...

    def snapshot(self) -> Drawable:
        """Return a copy that does not grow."""
        ...


def check_picture(path: str | PathLike[str]) -> None:
    """Check the file name of a picture.

    Raises InvalidArgument unless the suffix is .svg or .png, and AerokitError for a .png if Pillow is not installed.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".svg", ".png"):
        raise InvalidArgument(f"cannot draw {str(path)!r}: the file name must end in .svg or .png")
    if suffix == ".png":
        _pillow("Image")


def save_picture(tracks: Iterable[Drawable], path: str | PathLike[str]) -> None:
    """Draw tracks from above and their altitudes over time, as .svg or as .png (with Pillow).

    Raises the errors of `check_picture`, and OSError if the file cannot be written.
    """
    check_picture(path)
    tracks = list(tracks)
    if Path(path).suffix.lower() == ".svg":
        write_atomically(path, draw_svg(tracks))
    else:
        _save_png(_shapes(tracks), path)


def draw_svg(tracks: Sequence[Drawable]) -> str:
    """Return the picture as SVG text. North is up, and distances are in metres from the first home."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{_HEIGHT}"'
        f' font-family="sans-serif" font-size="{_FONT_SIZE}">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
        *(shape.svg() for shape in _shapes(tracks)),
    ]
    return "\n".join([*lines, "</svg>\n"])


@dataclass(frozen=True)
class _Line:
    places: Sequence[tuple[float, float]]
    colour: str
    is_dashed: bool = False

    def svg(self) -> str:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in self.places)
        dashes = ' stroke-dasharray="6 4"' if self.is_dashed else ""
        return f'<polyline points="{points}" fill="none" stroke="{self.colour}" stroke-width="1.5"{dashes}/>'

    def draw(self, image: Any, scale: int, font: Any) -> None:
        image.line([(x * scale, y * scale) for x, y in self.places], self.colour, round(1.5 * scale), "curve")


@dataclass(frozen=True)
class _GridLine:
    start: tuple[float, float]
    end: tuple[float, float]

    def svg(self) -> str:
        (x1, y1), (x2, y2) = self.start, self.end
        return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{_GREY}"/>'

    def draw(self, image: Any, scale: int, font: Any) -> None:
        image.line([number * scale for number in (*self.start, *self.end)], _GREY, scale)


@dataclass(frozen=True)
class _Dot:
    x: float
    y: float
    colour: str
    radius: float = 4

    def svg(self) -> str:
        return f'<circle cx="{self.x:.1f}" cy="{self.y:.1f}" r="{self.radius:g}" fill="{self.colour}"/>'

    def draw(self, image: Any, scale: int, font: Any) -> None:
        image.circle((self.x * scale, self.y * scale), self.radius * scale, self.colour)


@dataclass(frozen=True)
class _Text:
    x: float
    y: float
    text: str
    anchor: str
    colour: str = "black"

    def svg(self) -> str:
        place = f'x="{self.x:.1f}" y="{self.y:.1f}" text-anchor="{self.anchor}"'
        return f'<text {place} fill="{self.colour}">{escape(self.text)}</text>'

    def draw(self, image: Any, scale: int, font: Any) -> None:
        anchor = {"start": "ls", "middle": "ms", "end": "rs"}[self.anchor]
        image.text((self.x * scale, self.y * scale), self.text, self.colour, font, anchor=anchor)


_Shape = _Line | _GridLine | _Dot | _Text


def _shapes(tracks: Sequence[Drawable]) -> list[_Shape]:
    drawn = [track.snapshot() for track in tracks if track]
    return _map(drawn) + _profile(drawn) + _legend(drawn) if drawn else []


_MAX_X_INTERVALS = 6
_MAX_Y_INTERVALS = 5
_MAX_Y_INTERVALS_OF_LOW_CHART = 3
_LOW_CHART = 200  # A chart of up to this many pixels is low.


class _Axes:
    """Maps the values of two axes to positions in a rectangle of the picture, with a margin."""

    def __init__(
        self, xs: Sequence[float], ys: Sequence[float], top: float, height: float, *, same_scale: bool
    ) -> None:
        self.left = _MARGIN
        self.top = top
        self.width = _WIDTH - 2 * _MARGIN
        self.height = height
        self.x_range = _with_margin(xs)
        self.y_range = _with_margin(ys)
        if same_scale:
            scale = max(_span(self.x_range) / self.width, _span(self.y_range) / self.height)
            self.x_range = _widened(self.x_range, scale * self.width)
            self.y_range = _widened(self.y_range, scale * self.height)

    def place(self, x: float, y: float) -> tuple[float, float]:
        min_x, _ = self.x_range
        min_y, _ = self.y_range
        from_left = (x - min_x) / _span(self.x_range) * self.width
        from_bottom = (y - min_y) / _span(self.y_range) * self.height
        return self.left + from_left, self.top + self.height - from_bottom

    def grid(self, x_unit: str, y_unit: str) -> list[_Shape]:
        shapes: list[_Shape] = []
        bottom = self.top + self.height
        right = self.left + self.width
        for value in _ticks(self.x_range, _MAX_X_INTERVALS):
            x, _ = self.place(value, 0.0)
            shapes.append(_GridLine((x, self.top), (x, bottom)))
            shapes.append(_Text(x, bottom + 15, f"{value:g} {x_unit}", "middle"))  # 15 pixels below the axis
        max_y_intervals = _MAX_Y_INTERVALS if self.height > _LOW_CHART else _MAX_Y_INTERVALS_OF_LOW_CHART
        for value in _ticks(self.y_range, max_y_intervals):
            _, y = self.place(0.0, value)
            shapes.append(_GridLine((self.left, y), (right, y)))
            # The text ends 5 pixels left of the axis. With its baseline 4 pixels lower, it is centred on the grid line.
            shapes.append(_Text(self.left - 5, y + 4, f"{value:g} {y_unit}", "end"))
        return shapes


def _map(tracks: Sequence[Drawable]) -> list[_Shape]:
    origin = tracks[0].home
    paths = []
    outlines = []
    for track in tracks:
        paths.append([(east, north) for north, east, _ in track.local(origin)])
        outlines += _outlines(track, origin)
    easts, norths = zip(*chain(*paths, *outlines), strict=True)
    axes = _Axes(easts, norths, top=30, height=_MAP_HEIGHT - 60, same_scale=True)
    shapes = axes.grid("m", "m")
    # The circle or polygon of a failed assertion is dashed.
    shapes += [_Line([axes.place(*corner) for corner in outline], _FAILED, is_dashed=True) for outline in outlines]
    labels = _Labels()
    for track, path, colour in zip(tracks, paths, _colours(len(paths)), strict=True):
        places = [axes.place(east, north) for east, north in path]
        start_x, start_y = places[0]
        shapes += [_Line(places, colour), _Dot(start_x, start_y, colour)]
        shapes += labels.modes(track, places, colour)
        shapes += _failed_point(track, places)
    return shapes


def _outlines(track: Drawable, origin: Position) -> list[list[tuple[float, float]]]:
    """Return the circle and the polygon of the failed assertion, in metres east and north."""
    failure = track.failure
    if failure is None:
        return []
    offset_of = metres_from(origin)
    outlines = []
    if failure.circle is not None:
        center, radius = failure.circle
        north, east = offset_of(center)
        angles = [2 * math.pi * number / _CORNERS for number in range(_CORNERS + 1)]
        outlines.append([(east + radius * math.sin(angle), north + radius * math.cos(angle)) for angle in angles])
    if failure.polygon:
        corners = [offset_of(corner) for corner in failure.polygon]
        closed = (*corners, corners[0])  # The last line leads back to the first corner.
        outlines.append([(east, north) for north, east in closed])
    return outlines


def _failed_point(track: Drawable, places: Sequence[tuple[float, float]]) -> list[_Shape]:
    if track.failure is None:
        return []
    x, y = places[_index_of(track, track.failure.point)]
    size = 7  # Pixels from the middle of the cross to its ends.
    strokes = [
        _Line([(x - size, y - size), (x + size, y + size)], _FAILED),
        _Line([(x - size, y + size), (x + size, y - size)], _FAILED),
    ]
    label_y = y + size + 15
    return [*strokes, _Text(x, label_y, "failed here", "middle", _FAILED)]


def _index_of(track: Drawable, point: TrackPoint) -> int:
    distances = [abs(candidate.time_s - point.time_s) for candidate in track]
    return distances.index(min(distances))


class _Labels:
    """Labels with mode names at the points where modes start. Labels that would overlap are left out."""

    def __init__(self) -> None:
        self._label_places: list[tuple[float, float]] = []  # places of the labels so far

    def modes(self, track: Drawable, places: Sequence[tuple[float, float]], colour: str) -> list[_Shape]:
        """Return a dot for each mode change of the track, with the name of the mode if it has room."""
        shapes: list[_Shape] = []
        previous_mode = None
        for point, (x, y) in zip(track, places, strict=True):
            if point.mode == previous_mode:
                continue
            previous_mode = point.mode
            shapes.append(_Dot(x, y, colour, radius=2.5))
            # Place the label above the point or, if another label is there, up to three lines higher.
            label_levels = (y - _LABEL_GAP - step * _LABEL_HEIGHT for step in range(4))
            label_y = next((level for level in label_levels if self._is_free(x, level)), None)
            if label_y is not None and len(self._label_places) < _MAX_LABELS:
                self._label_places.append((x, label_y))
                shapes.append(_Text(x + 4, label_y, point.mode, "start", colour))
        return shapes

    def _is_free(self, x: float, y: float) -> bool:
        return all(
            abs(x - label_x) > _LABEL_WIDTH or abs(y - label_y) >= _LABEL_HEIGHT
            for label_x, label_y in self._label_places
        )


def _profile(tracks: Sequence[Drawable]) -> list[_Shape]:
    paths = [[(point.time_s, point.altitude_m) for point in track] for track in tracks]
    limits = [track.failure.altitude_m for track in tracks if track.failure is not None]
    limit = next((altitude for altitude in limits if altitude is not None), None)
    times, heights = zip(*chain(*paths), strict=True)
    shown_heights = heights if limit is None else (*heights, limit)  # The chart also shows the line of the limit.
    axes = _Axes(times, shown_heights, top=_MAP_HEIGHT, height=_PROFILE_HEIGHT - 40, same_scale=False)
    shapes = axes.grid("s", "m up")
    if limit is not None:
        limit_line = [axes.place(min(times), limit), axes.place(max(times), limit)]
        shapes.append(_Line(limit_line, _FAILED, is_dashed=True))
    labels = _Labels()
    for track, path, colour in zip(tracks, paths, _colours(len(paths)), strict=True):
        places = [axes.place(time, height) for time, height in path]
        shapes.append(_Line(places, colour))
        if len(tracks) == 1:  # The labels of several tracks would overlap.
            shapes += labels.modes(track, places, colour)
        if track.failure is not None:
            failed_x, failed_y = places[_index_of(track, track.failure.point)]
            shapes.append(_Dot(failed_x, failed_y, _FAILED))
    return shapes


def _legend(tracks: Sequence[Drawable]) -> list[_Shape]:
    named = list(zip(tracks, _colours(len(tracks)), strict=True))[:_MAX_NAMES]
    return [
        _Text(_MARGIN + _NAME_WIDTH * number, _NAME_BASELINE, track.name, "start", colour)
        for number, (track, colour) in enumerate(named)
    ]


def _colours(count: int) -> list[str]:
    return [_PALETTE[number % len(_PALETTE)] for number in range(count)]


def _with_margin(values: Sequence[float]) -> tuple[float, float]:
    low = min(values)
    high = max(values)
    return _widened((low, high), max(1.1 * (high - low), 2.0))


def _widened(bounds: tuple[float, float], span: float) -> tuple[float, float]:
    low, high = bounds
    middle = (low + high) / 2
    return middle - span / 2, middle + span / 2


def _span(bounds: tuple[float, float]) -> float:
    low, high = bounds
    return high - low


def _ticks(bounds: tuple[float, float], max_intervals: int) -> list[float]:
    """Return round numbers in a range, as labels of an axis, with at most ``max_intervals`` intervals between them."""
    low, high = bounds
    min_step = (high - low) / max_intervals
    power_of_ten: float = 10.0 ** math.floor(math.log10(min_step))
    step = next(factor * power_of_ten for factor in (1.0, 2.0, 5.0, 10.0) if factor * power_of_ten >= min_step)
    return [round(number * step, 6) for number in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _save_png(shapes: Sequence[_Shape], path: str | PathLike[str]) -> None:
    # Scaling the picture down makes the lines smooth.
    scale = 2
    image = _pillow("Image").new("RGB", (_WIDTH * scale, _HEIGHT * scale), "white")
    drawing = _pillow("ImageDraw").Draw(image)
    font = _pillow("ImageFont").load_default(_FONT_SIZE * scale)
    for shape in shapes:
        shape.draw(drawing, scale, font)
    image.resize((_WIDTH, _HEIGHT), reducing_gap=None).save(path, "PNG")


def _pillow(module: str) -> Any:
    try:
        return import_module(f"PIL.{module}")
    except ImportError:
        raise AerokitError("a .png picture needs Pillow: run `pip install pillow`, or draw an .svg picture") from None
