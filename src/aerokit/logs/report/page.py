"""Renders sections as one HTML file. It is self-contained, loads nothing, and all text from logs is escaped."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import import_module, resources
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator


@dataclass(frozen=True)
class Paragraphs:
    """Paragraphs, or a list."""

    lines: Sequence[str]
    is_list: bool = False


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    folded: str = ""
    """Title of the collapsed table; empty: not collapsible."""
    marks: Sequence[str] = ()
    """Class of each row: "", "warning" or "bad"."""


@dataclass(frozen=True)
class Chart:
    """A Plotly chart.

    Names must not come from a log, because Plotly interprets some HTML in texts.
    """

    name: str
    """Unique name in the page."""
    traces: Sequence[dict[str, Any]]
    layout: dict[str, Any] = field(default_factory=dict)
    height: int = 300
    label: str = ""
    """Text alternative for screen readers."""


Part = Paragraphs | Table | Chart


@dataclass(frozen=True)
class Section:
    """A section: title, explanation and parts. ``missing`` is shown if the log lacks the data."""

    title: str
    parts: Sequence[Part] = ()
    explanation: str = ""
    missing: str = ""


def page(title: str, summaries: Sequence[tuple[str, Sequence[str]]], sections: Sequence[Section]) -> str:
    """Return the HTML; ``summaries`` has a heading and sentences for each flight.

    The Content-Security-Policy allows only the two included scripts, and no network access. It is a second
    barrier after escaping, for hostile logs.

    Raises:
        ModuleNotFoundError: plotly is not installed.
    """
    scripts = [import_module("plotly.offline").get_plotlyjs(), _resource("draw.js")]
    hashes = " ".join(f"'sha256-{_hash(script)}'" for script in scripts)
    policy = f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:"
    charts = [part for section in sections for part in section.parts if isinstance(part, Chart)]
    lines = [
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>",
        f"<style>{_resource('page.css')}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
        *_summary(summaries),
        _contents(sections),
        *(line for number, section in enumerate(sections) for line in _section(number, section)),
        f'<script type="application/json" id="charts">{_json(charts)}</script>',
        *(f"<script>{script}</script>" for script in scripts),
        "</body></html>\n",
    ]
    return "\n".join(lines)


def _resource(name: str) -> str:
    return resources.files("aerokit.logs.report").joinpath(name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    """Hash a script as browsers do, with normalized line ends."""
    data = script.replace("\r\n", "\n").replace("\r", "\n").encode()
    return base64.b64encode(hashlib.sha256(data).digest()).decode()


def _json(charts: Sequence[Chart]) -> str:
    """Serialize the charts by name; no text can end the surrounding script element."""
    content = {chart.name: {"traces": chart.traces, "layout": chart.layout, "height": chart.height} for chart in charts}
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _summary(summaries: Sequence[tuple[str, Sequence[str]]]) -> Iterator[str]:
    for heading, sentences in summaries:
        yield f'<p class="soft">{escape(heading)}</p>'
        yield '<div class="summary">'
        yield from (f"<p>{escape(sentence)}</p>" for sentence in sentences)
        yield "</div>"


def _contents(sections: Sequence[Section]) -> str:
    links = (f'<a href="#s{number}">{escape(section.title)}</a>' for number, section in enumerate(sections))
    return f"<nav>{' '.join(links)}</nav>"


def _section(number: int, section: Section) -> Iterator[str]:
    yield f'<section id="s{number}"><h2>{escape(section.title)}</h2>'
    if section.missing:
        yield f'<p class="missing">{escape(section.missing)}</p>'
    elif section.explanation:
        yield f'<p class="soft">{escape(section.explanation)}</p>'
    for part in section.parts:
        yield from _part(part)
    yield "</section>"


def _part(part: Part) -> Iterator[str]:
    if isinstance(part, Chart):
        yield (
            f'<div class="chart" data-chart="{escape(part.name)}" style="min-height:{part.height}px"'
            f' role="img" aria-label="{escape(part.label)}"><noscript>{escape(part.label)}</noscript></div>'
        )
    elif isinstance(part, Paragraphs):
        tag = "li" if part.is_list else "p"
        yield from (f"<{tag}>{escape(line)}</{tag}>" for line in part.lines)
    else:
        yield from _table(part)


def _table(table: Table) -> Iterator[str]:
    if table.folded:
        is_long = ' data-print="no"' if len(table.rows) > 300 else ""
        yield f"<details{is_long}><summary>{escape(table.folded)}</summary>"
    yield '<div class="wide"><table><thead><tr>'
    yield "".join(f"<th>{escape(name)}</th>" for name in table.header)
    yield "</tr></thead><tbody>"
    for number, row in enumerate(table.rows):
        mark = table.marks[number] if number < len(table.marks) else ""
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
        yield f'<tr class="{mark}">{cells}</tr>' if mark else f"<tr>{cells}</tr>"
    yield "</tbody></table></div>"
    if table.folded:
        yield "</details>"
