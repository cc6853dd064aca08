"""Writes a report on one flight, or a comparison of two, as a self-contained HTML file; see docs/report.md."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.files import write_atomically
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.logs.flights import check_log_name, read_flight
from aerokit.logs.flights.failsafes import failsafes
from aerokit.logs.flights.falls import falls
from aerokit.logs.report.charts import COLOURS, timeline_shapes
from aerokit.logs.report.comparing import NAMES, comparison
from aerokit.logs.report.formatting import date_text
from aerokit.logs.report.page import Summary, page
from aerokit.logs.report.sections import SECTIONS
from aerokit.logs.report.statistics import FlightStatistics, findings, statistics_of, summary

if TYPE_CHECKING:
    from aerokit.logs.flights.failsafes import Failsafe
    from aerokit.logs.flights.falls import Fall
    from aerokit.logs.flights.flight import FlightLog
    from aerokit.protocols.exchange import OnProgress

__all__ = ["Report", "write_report"]


class Report(Snapshot):
    """A written report: its file and its main content."""

    target: Path
    bytes: int
    summaries: tuple[tuple[str, ...], ...]
    """For each flight, the sentences of its summary."""
    statistics: tuple[FlightStatistics, ...]
    """Statistics of each flight."""
    failsafes: tuple[tuple[Failsafe, ...], ...]
    """Failsafes of each flight."""
    falls: tuple[tuple[Fall, ...], ...]
    """Falls and hard landings of each flight."""


def write_report(
    log: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    compare_with: str | os.PathLike[str] | None = None,
    system_id: int | None = None,
    force: bool = False,
    on_progress: OnProgress | None = None,
) -> Report:
    """Write a report on a flight, or a comparison of two flights, as one HTML file without external resources.

    The file gets its name only when it is complete. The function blocks; it needs no event loop.

    Args:
        log: a ``.tlog`` of a ground station or of ``record=``, a ``.bin`` of ArduPilot, or a ``.ulg`` of PX4.
        target: the file to write, such as ``flight.html``.
        compare_with: a second log, of any of these formats, to compare the flight with.
        system_id: system id of the vehicle, if a ``.tlog`` contains several vehicles; None selects the first vehicle.
        force: replace an existing file.
        on_progress: called from time to time with the number of bytes read so far; for two logs, it starts again at 0.

    Raises:
        InvalidArgument: the file exists and ``force`` is False, or its name does not end in .html or .htm.
        FileFormatError: a file is not a flight log, or nothing in it can be read.
        OSError: a file cannot be read or written.
        ModuleNotFoundError: a package of the extra ``report`` is not installed.
    """
    target_path = Path(target)
    if target_path.suffix.lower() not in (".html", ".htm"):
        raise InvalidArgument(f"target = {str(target_path)!r} is not allowed: the name of a report must end in .html")
    logs = [log] if compare_with is None else [log, compare_with]
    # Check the logs before the target, because the default name of the target is derived from a log's.
    for path in logs:
        check_log_name(Path(path))
    if target_path.exists() and not force:
        raise InvalidArgument(f"{target_path} exists; use force (--force) to replace it")
    flights = [read_flight(path, system_id=system_id, on_progress=on_progress) for path in logs]
    statistics = [statistics_of(flight) for flight in flights]
    summaries = [summary(flight, values) for flight, values in zip(flights, statistics, strict=True)]
    write_atomically(target_path, _render(flights, statistics, summaries))
    return Report(
        target_path,
        bytes=target_path.stat().st_size,
        summaries=tuple(map(tuple, summaries)),
        statistics=tuple(statistics),
        failsafes=tuple(tuple(failsafes(flight)) for flight in flights),
        falls=tuple(tuple(falls(flight)) for flight in flights),
    )


def report_html(flight: FlightLog) -> str:
    """Return the HTML of a report on one flight; raises ModuleNotFoundError without plotly."""
    statistics = statistics_of(flight)
    return _render([flight], [statistics], [summary(flight, statistics)])


def _render(flights: list[FlightLog], statistics: list[FlightStatistics], summaries: list[list[str]]) -> str:
    if len(flights) == 1:
        (flight,) = flights
        optional_sections = [make_section(flight) for make_section in SECTIONS]
        sections = [section for section in optional_sections if section is not None]
        page_summary = Summary(_heading(flight), summaries[0], findings(flight))
        return page(flight.path.name, [page_summary], sections, COLOURS, shapes=timeline_shapes(flight))
    first, second = flights
    page_summaries = [
        Summary(f"{name}: {flight.path.name}, {_heading(flight)}", sentences, findings(flight))
        for name, flight, sentences in zip(NAMES, flights, summaries, strict=True)
    ]
    first_statistics, second_statistics = statistics
    sections = comparison((first, second), (first_statistics, second_statistics))
    return page(f"{first.path.name} and {second.path.name}", page_summaries, sections, COLOURS)


def _heading(flight: FlightLog) -> str:
    return f"{flight.vehicle}, system {flight.system_id}, {date_text(flight.begins_at)}"
