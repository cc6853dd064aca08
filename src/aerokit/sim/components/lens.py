"""The lens of a simulated camera: zoom and focus, which take their time where they are moved and not set."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import CameraZoomType, SetFocusType

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["FOCAL_LENGTH_MM", "Axis", "Lens"]

FOCAL_LENGTH_MM = 4.5
"""Zoomed out."""
_TIMES = 10.0
_STEP_PERCENT, _PERCENT_S = 10.0, 20.0
_HALF_WAY_M = 10.0
_SHARP_PERCENT = 50.0
_AUTO = (SetFocusType.AUTO, SetFocusType.AUTO_SINGLE, SetFocusType.AUTO_CONTINUOUS)


class Axis:
    """Something from 0 to 100 percent that stands, or moves until it is stopped or at its end."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._from, self._since, self._speed = 0.0, 0.0, 0.0

    @property
    def percent(self) -> float:
        """Where it is."""
        moved = (self._now() - self._since) * self._speed if self._speed else 0.0
        return max(0.0, min(100.0, self._from + moved))

    def set(self, percent: float) -> None:
        """Stand there, as far as it goes."""
        self._from, self._speed = max(0.0, min(100.0, percent)), 0.0

    def move(self, speed: float) -> None:
        """Go on at this speed, -1 to 1; 0 stops."""
        self._from, self._since = self.percent, self._now()
        self._speed = max(-1.0, min(1.0, speed)) * _PERCENT_S

    def step(self, steps: float) -> None:
        """So many tenths of the range."""
        self.set(self.percent + steps * _STEP_PERCENT)


class Lens:
    """Ten times zoom, and a focus that by itself is right in the middle."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.zoom: Axis = Axis(now)
        self.focus: Axis = Axis(now)

    @property
    def focal_length_mm(self) -> float:
        """As it is zoomed now."""
        return FOCAL_LENGTH_MM * (1.0 + (_TIMES - 1.0) * self.zoom.percent / 100.0)

    def set_zoom(self, kind: int, value: float) -> bool:
        """SET_CAMERA_ZOOM; False when it is not known so, or out of range."""
        if kind == CameraZoomType.STEP:
            self.zoom.step(value)
        elif kind == CameraZoomType.CONTINUOUS:
            self.zoom.move(value)
        elif kind == CameraZoomType.RANGE and 0.0 <= value <= 100.0:
            self.zoom.set(value)
        elif kind == CameraZoomType.FOCAL_LENGTH and 1.0 <= value / FOCAL_LENGTH_MM <= _TIMES:
            self.zoom.set((value / FOCAL_LENGTH_MM - 1.0) / (_TIMES - 1.0) * 100.0)
        else:
            return False
        return True

    def set_focus(self, kind: int, value: float) -> bool:
        """SET_CAMERA_FOCUS; False when it is not known so, or out of range."""
        if kind == SetFocusType.STEP:
            self.focus.step(value)
        elif kind == SetFocusType.CONTINUOUS:
            self.focus.move(value)
        elif kind == SetFocusType.RANGE and 0.0 <= value <= 100.0:
            self.focus.set(value)
        elif kind == SetFocusType.METERS and value > 0.0:
            self.focus.set(100.0 * value / (value + _HALF_WAY_M))
        elif kind in _AUTO:
            self.focus.set(_SHARP_PERCENT)
        else:
            return False
        return True
