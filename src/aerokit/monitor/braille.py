"""A map of dots in a terminal: each character cell has two by four of them, as large in both directions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.text import Text

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["ARROWS", "Canvas"]

ARROWS = "↑↗→↘↓↙←↖"
"""Headings, clockwise from north."""
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_LEAST_SPAN_M = 20.0


class Canvas:
    """``columns`` by ``rows`` characters on which all ``points`` (metres north, east) have a place; north is up."""

    def __init__(self, columns: int, rows: int, points: Iterable[tuple[float, float]]) -> None:
        self._columns, self._rows = max(columns, 2), max(rows, 2)
        norths, easts = zip(*(list(points) or [(0.0, 0.0)]), strict=True)
        self._middle = (max(norths) + min(norths)) / 2, (max(easts) + min(easts)) / 2
        across, up = 2 * (self._columns - 1), 4 * (self._rows - 1)
        self._metres_per_dot: float = max(
            (max(easts) - min(easts)) / across, (max(norths) - min(norths)) / up, _LEAST_SPAN_M / across
        )
        self._dots: dict[tuple[int, int], int] = {}
        self._styles: dict[tuple[int, int], str] = {}
        self._marks: dict[tuple[int, int], tuple[str, str]] = {}

    @property
    def width_m(self) -> float:
        """Metres from the left edge to the right one."""
        return 2 * self._columns * self._metres_per_dot

    def dot(self, point: tuple[float, float], style: str) -> None:
        """Part of a track."""
        across, down = self._place(point)
        cell = down // 4, across // 2
        self._dots[cell] = self._dots.get(cell, 0) | _DOTS[down % 4][across % 2]
        self._styles[cell] = style

    def mark(self, point: tuple[float, float], text: str, style: str) -> None:
        """Characters from this place on, over dots and earlier marks."""
        across, down = self._place(point)
        for number, character in enumerate(text):
            self._marks[down // 4, across // 2 + number] = character, style

    def text(self) -> Text:
        """The lines, top first."""
        text = Text(no_wrap=True)
        for row in range(self._rows):
            for column in range(self._columns):
                cell = row, column
                if cell in self._marks:
                    text.append(*self._marks[cell])
                elif cell in self._dots:
                    text.append(chr(0x2800 + self._dots[cell]), self._styles[cell])
                else:
                    text.append(" ")
            text.append("\n")
        text.right_crop(1)
        return text

    def _place(self, point: tuple[float, float]) -> tuple[int, int]:
        across = self._columns + round((point[1] - self._middle[1]) / self._metres_per_dot)
        down = 2 * self._rows - round((point[0] - self._middle[0]) / self._metres_per_dot)
        return min(max(across, 0), 2 * self._columns - 1), min(max(down, 0), 4 * self._rows - 1)
