"""``write_report``: logs → one HTML file, whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.files import write_whole
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.logs.flights.failsafes import failsafes
from aerokit.logs.flights.reading import check_log_name, read_flight
from aerokit.logs.report.comparing import NAMES, comparison
from aerokit.logs.report.figures import Figures, date, figures, summary
from aerokit.logs.report.page import page
from aerokit.logs.report.sections import SECTIONS

if TYPE_CHECKING:
    from aerokit.logs.flights.failsafes import Failsafe
    from aerokit.logs.flights.flight import Flight
    from aerokit.protocols.exchange import OnProgress


class Report(Snapshot):
    """What was written, and the most important of it."""

    target: Path
    bytes: int
    summaries: tuple[tuple[str, ...], ...]
    """Sentences, of each flight."""
    figures: tuple[Figures, ...]
    """Of each flight."""
    failsafes: tuple[tuple[Failsafe, ...], ...]
    """Of each flight."""


def write_report(
    log: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    compare_with: str | os.PathLike[str] | None = None,
    system_id: int | None = None,
    force: bool = False,
    on_progress: OnProgress | None = None,
) -> Report:
    """Write the report of a flight, or of two compared: one HTML file that loads nothing.

    The file appears when it is whole. Blocks until then; no event loop is needed.

    Args:
        log: a ``.tlog`` of a ground station or of ``record=``, a ``.bin`` of ArduPilot, a ``.ulg`` of PX4.
        target: the file, ``flight.html``.
        compare_with: another log, of any kind.
        system_id: whose flight, where a ``.tlog`` has several vehicles; None: of the first one in it.
        force: whether a file that is there already is replaced.
        on_progress: called now and then with the bytes that were read, of each log in its turn.

    Raises:
        InvalidArgument: the file is there already, or is a log itself.
        FileFormatError: a log is none, or has nothing that can be read.
        OSError: a file cannot be read or written.
        ModuleNotFoundError: a package of the extra ``report`` is not installed.
    """
    to = Path(target)
    if to.suffix.lower() not in (".html", ".htm"):
        raise InvalidArgument(f"{to} is no name of a report: it must end in .html")
    logs = [log] if compare_with is None else [log, compare_with]
    for each in logs:
        check_log_name(Path(each))  # before the target, whose name is made of it
    if to.exists() and not force:
        raise InvalidArgument(f"{to} is there already: it is replaced with force (--force) only")
    flights = [read_flight(each, system_id=system_id, on_progress=on_progress) for each in logs]
    found = [figures(flight) for flight in flights]
    told = [summary(*each) for each in zip(flights, found, strict=True)]
    write_whole(to, _html(flights, found, told))
    return Report(
        to,
        to.stat().st_size,
        tuple(map(tuple, told)),
        tuple(found),
        tuple(tuple(failsafes(flight)) for flight in flights),
    )


def report_html(flight: Flight) -> str:
    """The text of the file, for a flight that was read already; ModuleNotFoundError without plotly."""
    found = figures(flight)
    return _html([flight], [found], [summary(flight, found)])


def _html(flights: list[Flight], found: list[Figures], told: list[list[str]]) -> str:
    if len(flights) == 1:
        flight = flights[0]
        made = (section(flight) for section in SECTIONS)
        sections = [section for section in made if section is not None]
        return page(flight.path.name, [(_heading(flight), told[0])], sections)
    one, other = flights
    summaries = [
        (f"{name}: {flight.path.name}, {_heading(flight)}", sentences)
        for name, flight, sentences in zip(NAMES, flights, told, strict=True)
    ]
    return page(
        f"{one.path.name} and {other.path.name}", summaries, comparison((one, other), (found[0], found[1]))
    )


def _heading(flight: Flight) -> str:
    return f"{flight.vehicle}, system {flight.system_id}, {date(flight.begins_at)}"
