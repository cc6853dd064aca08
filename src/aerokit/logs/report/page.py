"""Renders sections as one HTML file. The file is self-contained and loads nothing; all text from logs is escaped."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import import_module, resources
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from aerokit._internal.formatting import printable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


@dataclass(frozen=True)
class Paragraphs:
    """Paragraphs of text."""

    lines: Sequence[str]


@dataclass(frozen=True)
class Table:
    """A table of texts. A long table is collapsed until the reader opens it."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    """Title that stands for the collapsed table; by default the number of rows."""
    marks: Sequence[str] = ()
    """CSS class of each row: "", "warning" or "bad". Rows without a class are plain."""


@dataclass(frozen=True)
class Collapsed:
    """Parts that are hidden until the reader opens them, and that are never printed."""

    title: str
    parts: Sequence[Part]


@dataclass(frozen=True)
class Chart:
    """A Plotly chart.

    Texts must not come from a log, because Plotly interprets some HTML in them. A colour is ``colour:NAME``, with a
    name in `charts.COLOURS`.
    """

    name: str
    """Name of the chart, unique in the page."""
    traces: Sequence[dict[str, Any]]
    layout: dict[str, Any] = field(default_factory=dict)
    height: int = 300
    label: str = ""
    """Description for screen readers and for browsers without scripts."""
    is_timeline: bool = False
    """True for a chart over time. All these charts have the page's shapes as background, and zoom together."""


class Summary(NamedTuple):
    """The sentences about one flight, below a heading."""

    heading: str
    sentences: Sequence[str]
    findings: Sequence[str]
    """The sentences to emphasise."""


Part: TypeAlias = "Paragraphs | Table | Collapsed | Chart"
MAX_OPEN_ROWS = 15
"""Tables with more rows than this are collapsed."""
MAX_PRINTED_ROWS = 60
"""Tables with more rows than this are not printed."""


@dataclass(frozen=True)
class Section:
    """A section of the report: title, explanation and parts.

    ``missing`` replaces the explanation. It says which data the log lacks.
    """

    title: str
    parts: Sequence[Part] = ()
    explanation: str = ""
    missing: str = ""


def page(
    title: str,
    summaries: Sequence[Summary],
    sections: Sequence[Section],
    colours: Mapping[str, Mapping[str, str]],
    shapes: Sequence[dict[str, Any]] = (),
) -> str:
    """Return the HTML of the whole page.

    ``colours`` maps themes ("light", "dark") to colours by name. ``shapes`` are Plotly's shapes for the background of
    all timelines.

    Raises:
        ModuleNotFoundError: plotly is not installed.
    """
    scripts = [import_module("plotly.offline").get_plotlyjs(), _resource("draw.js")]
    hashes = " ".join(f"'sha256-{_hash(script)}'" for script in scripts)
    # The policy allows only the two included scripts, and no network access. It limits what a hostile log can do if its
    # texts are not escaped correctly.
    policy = (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:;"
        " form-action 'none'; base-uri 'none'"
    )
    charts: list[Chart] = []
    for section in sections:
        charts += [part for part in section.parts if isinstance(part, Chart)]
    lines = [
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{_escape(title)}</title>",
        f"<style>{_resource('page.css')}</style></head><body>",
        f"<h1>{_escape(title)}</h1>",
        *_summary(summaries),
        _contents(sections),
        *(line for number, section in enumerate(sections) for line in _section(number, section)),
        f'<script type="application/json" id="charts">{_json(charts, colours, shapes)}</script>',
        *(f"<script>{script}</script>" for script in scripts),
        "</body></html>\n",
    ]
    return "\n".join(lines)


def _resource(name: str) -> str:
    return resources.files("aerokit.logs.report").joinpath(name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    # Browsers normalize line ends before they compute the hash.
    data = script.replace("\r\n", "\n").replace("\r", "\n").encode()
    return base64.b64encode(hashlib.sha256(data).digest()).decode()


def _escape(text: str) -> str:
    """Escape text for HTML, and replace characters that could disguise it."""
    return escape(printable(text.replace("\t", " ").replace("\xa0", " ")))


def _json(charts: Sequence[Chart], colours: Mapping[str, Mapping[str, str]], shapes: Sequence[dict[str, Any]]) -> str:
    by_name = {
        chart.name: {
            "traces": chart.traces,
            "layout": chart.layout,
            "height": chart.height,
            "timeline": chart.is_timeline,
        }
        for chart in charts
    }
    content = {"colours": colours, "shapes": shapes, "charts": by_name}
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    # No character may end the surrounding script element.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _summary(summaries: Sequence[Summary]) -> Iterator[str]:
    for heading, sentences, findings in summaries:
        yield f'<p class="soft">{_escape(heading)}</p>'
        yield '<div class="summary">'
        for sentence in sentences:
            mark = ' class="finding"' if sentence in findings else ""
            yield f"<p{mark}>{_escape(sentence)}</p>"
        yield "</div>"


def _contents(sections: Sequence[Section]) -> str:
    links = (f'<a href="#s{number}">{_escape(section.title)}</a>' for number, section in enumerate(sections))
    return f"<nav>{' '.join(links)}</nav>"


def _section(number: int, section: Section) -> Iterator[str]:
    yield f'<section id="s{number}"><h2>{_escape(section.title)}</h2>'
    if section.missing:
        yield f'<p class="missing">{_escape(section.missing)}</p>'
    elif section.explanation:
        yield f'<p class="soft">{_escape(section.explanation)}</p>'
    for part in section.parts:
        yield from _part(part)
    yield "</section>"


def _part(part: Part) -> Iterator[str]:
    if isinstance(part, Chart):
        size = " large" if part.height > 400 else ""
        yield (
            f'<div class="chart{size}" data-chart="{_escape(part.name)}" style="min-height:{part.height}px"'
            f' role="img" aria-label="{_escape(part.label)}"><noscript>{_escape(part.label)}</noscript></div>'
        )
    elif isinstance(part, Paragraphs):
        yield from (f"<p>{_escape(line)}</p>" for line in part.lines)
    elif isinstance(part, Collapsed):
        yield f'<details data-print="no"><summary>{_escape(part.title)}</summary>'
        for collapsed_part in part.parts:
            yield from _part(collapsed_part)
        yield "</details>"
    else:
        yield from _table(part)


def _table(table: Table) -> Iterator[str]:
    count = len(table.rows)
    if count > MAX_OPEN_ROWS:
        print_attribute = ' data-print="no"' if count > MAX_PRINTED_ROWS else ""
        yield f"<details{print_attribute}><summary>{_escape(table.title or f'{count} rows')}</summary>"
    yield '<div class="wide"><table><thead><tr>'
    yield "".join(f"<th>{_escape(name)}</th>" for name in table.header)
    yield "</tr></thead><tbody>"
    for number, row in enumerate(table.rows):
        mark = table.marks[number] if number < len(table.marks) else ""
        cells = "".join(f"<td>{_escape(cell)}</td>" for cell in row)
        yield f'<tr class="{mark}">{cells}</tr>' if mark else f"<tr>{cells}</tr>"
    yield "</tbody></table></div>"
    if count > MAX_OPEN_ROWS:
        yield "</details>"
