"""Where simulated vehicles truly were, whatever they said, and a picture of it.

A track is recorded in simulated time by timers of the vehicle itself; neither its bytes nor its noise change by that.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit.errors import AerokitError, LocalProtocolError
from aerokit.sim.local_frame import GlobalPoint, LocalFrame

if TYPE_CHECKING:
    from os import PathLike

    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["Track", "TrackPoint", "check_picture", "draw_svg", "record_track", "save_picture", "true_place"]

_COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b", "#e377c2")
_WIDTH, _MAP_HEIGHT, _PROFILE_HEIGHT, _MARGIN = 800, 520, 160, 60


class TrackPoint(NamedTuple):
    """One moment of a flight."""

    time_s: float
    """Simulated seconds."""
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Above the place where the vehicle was created; below it is negative."""


@dataclass
class Track:
    """Where one vehicle was, oldest first."""

    name: str
    origin: GlobalPoint
    points: list[TrackPoint] = field(default_factory=list)

    def local(self, origin: GlobalPoint | None = None) -> list[tuple[float, float, float]]:
        """Metres north, east and up of an origin, without one of the vehicle's own; up is always of its own."""
        frame = LocalFrame(self.origin if origin is None else origin)
        places = (
            (round(p.latitude_deg * 1e7), round(p.longitude_deg * 1e7), p.altitude_m) for p in self.points
        )
        return [(*frame.to_local(latitude, longitude), up) for latitude, longitude, up in places]

    @property
    def length_m(self) -> float:
        """The way that was covered, climbs included."""
        places = self.local()
        return sum(math.dist(one, other) for one, other in itertools.pairwise(places))


def true_place(vehicle: SimulatedVehicle) -> GlobalPoint:
    """Where a vehicle really is; LocalProtocolError for one that has no such place."""
    frame, motion = _frame(vehicle), getattr(vehicle, "motion", None)
    if frame is None or motion is None:
        raise LocalProtocolError(f"{type(vehicle).__name__} has no true place")
    return frame.to_global(motion.north, motion.east, motion.down)


def record_track(vehicle: SimulatedVehicle, *, interval_s: float = 0.2) -> Track:
    """Note from now on where a vehicle is, every ``interval_s`` simulated seconds; reboots do not end it."""
    if not interval_s > 0:
        raise LocalProtocolError(f"interval_s = {interval_s!r} must be above 0")
    frame = _frame(vehicle)
    if frame is None:
        raise LocalProtocolError(f"{type(vehicle).__name__} has no true place")
    track = Track(f"system {vehicle.system_id}", frame.origin)

    def note() -> None:
        place = true_place(vehicle)
        height = place.altitude_m - frame.origin.altitude_m
        track.points.append(
            TrackPoint(vehicle.now, place.latitude_e7 / 1e7, place.longitude_e7 / 1e7, height)
        )

    def begin() -> None:
        note()
        vehicle.every(interval_s, note)

    vehicle.when_powered_on(begin)
    return track


def check_picture(path: str | PathLike[str]) -> None:
    """LocalProtocolError when this is no name of a picture; AerokitError when what draws it is not installed."""
    suffix = Path(path).suffix.lower()
    if suffix not in (".svg", ".png"):
        raise LocalProtocolError(f"{str(path)!r} is no picture: its name must end in .svg or .png")
    if suffix == ".png":
        _pyplot_figure()


def save_picture(tracks: Iterable[Track], path: str | PathLike[str]) -> None:
    """Draw tracks from above, and their heights over time: an .svg file, or a .png one (with matplotlib).

    Raises what `check_picture` raises, and OSError when the file cannot be written.
    """
    check_picture(path)
    tracks = list(tracks)
    if Path(path).suffix.lower() == ".svg":
        Path(path).write_text(draw_svg(tracks), encoding="utf-8")
    else:
        _draw_png(tracks, path)


def draw_svg(tracks: Sequence[Track]) -> str:
    """The picture as the text of an SVG file: north is up, metres from the first vehicle's start."""
    drawn = [track for track in tracks if track.points]
    height = _MAP_HEIGHT + _PROFILE_HEIGHT
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{height}"'
        ' font-family="sans-serif" font-size="12">',
        f'<rect width="{_WIDTH}" height="{height}" fill="white"/>',
    ]
    if drawn:
        lines += _map(drawn) + _profile(drawn) + _legend(drawn)
    return "\n".join([*lines, "</svg>\n"])


# ----------------------------------------------------------------------------------------- the drawing


class _Axes:
    """From values to places in a rectangle of the picture, with some air around them."""

    def __init__(
        self, xs: Sequence[float], ys: Sequence[float], top: float, height: float, *, square: bool
    ) -> None:
        self.left, self.top, self.width, self.height = _MARGIN, top, _WIDTH - 2 * _MARGIN, height
        self.x_range, self.y_range = _with_air(xs), _with_air(ys)
        if square:
            scale = max(_span(self.x_range) / self.width, _span(self.y_range) / self.height)
            self.x_range = _widened(self.x_range, scale * self.width)
            self.y_range = _widened(self.y_range, scale * self.height)

    def place(self, x: float, y: float) -> tuple[float, float]:
        right = (x - self.x_range[0]) / _span(self.x_range) * self.width
        up = (y - self.y_range[0]) / _span(self.y_range) * self.height
        return self.left + right, self.top + self.height - up

    def line(self, xs: Sequence[float], ys: Sequence[float], colour: str) -> str:
        places = (self.place(x, y) for x, y in zip(xs, ys, strict=True))
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>'

    def grid(self, x_unit: str, y_unit: str) -> list[str]:
        lines = []
        for value in _ticks(self.x_range, 6):
            x, _ = self.place(value, 0.0)
            lines.append(_grey(x, self.top, x, self.top + self.height))
            lines.append(_text(x, self.top + self.height + 15, f"{value:g} {x_unit}", "middle"))
        for value in _ticks(self.y_range, 5 if self.height > 200 else 3):
            _, y = self.place(0.0, value)
            lines.append(_grey(self.left, y, self.left + self.width, y))
            lines.append(_text(self.left - 5, y + 4, f"{value:g} {y_unit}", "end"))
        return lines


def _map(tracks: Sequence[Track]) -> list[str]:
    paths = [track.local(tracks[0].origin) for track in tracks]
    norths = [north for path in paths for north, _, _ in path]
    easts = [east for path in paths for _, east, _ in path]
    axes = _Axes(easts, norths, 30, _MAP_HEIGHT - 60, square=True)
    lines = axes.grid("m", "m")
    for path, colour in zip(paths, _colours(len(paths)), strict=True):
        lines.append(axes.line([east for _, east, _ in path], [north for north, _, _ in path], colour))
        x, y = axes.place(path[0][1], path[0][0])
        lines.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>')
    return lines


def _profile(tracks: Sequence[Track]) -> list[str]:
    times = [point.time_s for track in tracks for point in track.points]
    heights = [point.altitude_m for track in tracks for point in track.points]
    axes = _Axes(times, heights, _MAP_HEIGHT, _PROFILE_HEIGHT - 40, square=False)
    lines = axes.grid("s", "m up")
    for track, colour in zip(tracks, _colours(len(tracks)), strict=True):
        points = track.points
        lines.append(axes.line([p.time_s for p in points], [p.altitude_m for p in points], colour))
    return lines


def _legend(tracks: Sequence[Track]) -> list[str]:
    return [
        f'<g fill="{colour}">{_text(_MARGIN + 90 * number, 18, track.name, "start")}</g>'
        for number, (track, colour) in enumerate(zip(tracks, _colours(len(tracks)), strict=True))
        if number < 8
    ]


def _colours(count: int) -> list[str]:
    return [_COLOURS[number % len(_COLOURS)] for number in range(count)]


def _grey(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="#dddddd"/>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _with_air(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    return _widened((low, high), max(1.1 * (high - low), 2.0))


def _widened(bounds: tuple[float, float], span: float) -> tuple[float, float]:
    middle = (bounds[0] + bounds[1]) / 2
    return middle - span / 2, middle + span / 2


def _span(bounds: tuple[float, float]) -> float:
    return bounds[1] - bounds[0]


def _ticks(bounds: tuple[float, float], about: int) -> list[float]:
    """Round numbers in a range, ``about`` so many."""
    rough = _span(bounds) / about
    size: float = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * size for factor in (1.0, 2.0, 5.0, 10.0) if factor * size >= rough)
    first = math.ceil(bounds[0] / step)
    return [round(number * step, 6) for number in range(first, math.floor(bounds[1] / step) + 1)]


# ------------------------------------------------------------------------------------------ matplotlib


def _pyplot_figure() -> Any:
    """The Figure of matplotlib, which needs neither a screen nor pyplot's global state."""
    try:
        return import_module("matplotlib.figure").Figure
    except ImportError:
        raise AerokitError(
            "a .png needs matplotlib: pip install aerokit[pictures], or ask for an .svg"
        ) from None


def _draw_png(tracks: Sequence[Track], path: str | PathLike[str]) -> None:
    figure = _pyplot_figure()(figsize=(8, 7))
    above, profile = figure.subplots(2, 1, height_ratios=(3, 1))
    drawn = [track for track in tracks if track.points]
    for track, colour in zip(drawn, _colours(len(drawn)), strict=True):
        path_ = track.local(drawn[0].origin)
        above.plot([east for _, east, _ in path_], [north for north, _, _ in path_], colour, label=track.name)
        above.plot(path_[0][1], path_[0][0], "o", color=colour)
        profile.plot([p.time_s for p in track.points], [p.altitude_m for p in track.points], colour)
    above.set(xlabel="metres east", ylabel="metres north", aspect="equal", adjustable="datalim")
    profile.set(xlabel="simulated seconds", ylabel="metres up")
    for axes in (above, profile):
        axes.grid(visible=True, color="#dddddd")
    if drawn:
        above.legend()
    figure.savefig(path, format="png")


def _frame(vehicle: SimulatedVehicle) -> LocalFrame | None:
    frame = getattr(vehicle, "frame", None)
    if frame is None:
        frame = getattr(getattr(vehicle, "navigation", None), "frame", None)
    return frame if isinstance(frame, LocalFrame) else None
