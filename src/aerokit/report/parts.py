"""What a section of a report is made of. Nothing here is HTML yet: `aerokit.report.page` escapes and writes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

__all__ = ["Chart", "Part", "Section", "Table", "Words"]


@dataclass(frozen=True)
class Words:
    """Paragraphs, or a list."""

    lines: Sequence[str]
    is_list: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of texts below a header."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    folded: str = ""
    """Not empty: what it is called while it is folded away."""
    marks: Sequence[str] = ()
    """For each row "", "warning" or "bad"."""


@dataclass(frozen=True)
class Chart:
    """Lines that Plotly draws.

    Names that are drawn come from aerokit, never from a log: Plotly reads some of HTML in texts.
    """

    name: str
    """Where it is in the page, once."""
    traces: Sequence[dict[str, Any]]
    layout: dict[str, Any] = field(default_factory=dict)
    height: int = 300
    label: str = ""
    """What it shows, for who cannot see it."""


Part = Words | Table | Chart


@dataclass(frozen=True)
class Section:
    """A heading, what it means, and its parts; ``missing`` says what the log does not have."""

    title: str
    parts: Sequence[Part] = ()
    means: str = ""
    missing: str = ""
