"""``aerokit convert`` and ``aerokit report``: flight logs in other formats, and as an HTML report."""

from __future__ import annotations

import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.formatting import printable
from aerokit.apps.cli.output import add_force, add_json, check_not_existing, emit, import_extra
from aerokit.apps.cli.terminal import progress_bar
from aerokit.logs.flights import check_log_name
from aerokit.logs.report.formatting import clock_text
from aerokit.logs.report.statistics import fall_text

if TYPE_CHECKING:
    import argparse

    from aerokit.logs.report import Report

# Maps the suffix of a converted file to what `Conversion.written` counts. For other suffixes, it counts rows.
_WRITTEN_NOUNS = {".mcap": "message", ".gpx": "point", ".kml": "point"}
_REQUIRED_MODULES = {".mcap": "mcap", ".parquet": "pyarrow", ".gpx": "gpxpy", ".kml": "simplekml"}


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=_convert)
    command.add_argument("log", type=Path, metavar="LOG", help=".tlog, .bin (ArduPilot) or .ulg (PX4)")
    command.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help=".mcap (Foxglove), .csv or .parquet (one table of the flight), .gpx, .kml;"
        " without a suffix: a folder with one table for each message type",
    )
    command.add_argument(
        "--tables", choices=("csv", "parquet"), default="csv", help="format of the tables in a folder (default: csv)"
    )
    command.add_argument("--force", action="store_true", help="replace existing files")
    add_json(command)


async def _convert(options: argparse.Namespace) -> None:
    # Without a suffix, OUT is a folder of tables.
    suffix = options.out.suffix.lower() or f".{options.tables}"
    module = _REQUIRED_MODULES.get(suffix)
    if module is not None:
        import_extra(module, extra="convert")
    if options.log.suffix.lower() == ".ulg":
        import_extra("pyulog", extra="convert")
    from aerokit.logs.convert import convert

    check_log_name(options.log)
    is_empty_folder = options.out.is_dir() and not any(options.out.iterdir())
    if not is_empty_folder:
        check_not_existing(options.out, options)
    with progress_bar(options.log.name, unit="B") as on_progress:
        result = convert(options.log, options.out, tables=options.tables, force=options.force, on_progress=on_progress)
    for note in result.notes:
        print(printable(f"aerokit: {options.log}: {note}"), file=sys.stderr)
    noun = _WRITTEN_NOUNS.get(result.target.suffix.lower(), "row")
    text = (
        f"{result.target}: {_counted_noun(result.written, noun)} from {_counted_noun(result.entries, 'entry')},"
        f" {_size(result.bytes)}, {_utc_text(result.begins_at)} to {_utc_text(result.ends_at)} UTC"
    )
    emit(options, "conversion", {**result.to_dict(), "log": options.log}, text)


def _counted_noun(count: int, singular: str) -> str:
    plural = f"{singular[:-1]}ies" if singular.endswith("y") else f"{singular}s"
    return f"{count:,} {singular if count == 1 else plural}"


def _size(number: int) -> str:
    return f"{number / 1e6:.1f} MB" if number >= 1e6 else f"{number / 1e3:.1f} kB"


def _utc_text(unix_s: float) -> str:
    return f"{datetime.fromtimestamp(unix_s, timezone.utc):%Y-%m-%d %H:%M:%S}"


def add_report_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=_report)
    command.add_argument("log", type=Path, metavar="LOG", help=".tlog, .bin (ArduPilot) or .ulg (PX4)")
    command.add_argument("other", type=Path, nargs="?", metavar="LOG2", help="a second log to compare with")
    command.add_argument(
        "-o", "--output", type=Path, metavar="OUT.html", help="output file (default: the name of the log, with .html)"
    )
    command.add_argument(
        "--system", type=int, metavar="ID", help="system id of the vehicle, if a .tlog has several (default: the first)"
    )
    add_force(command)
    command.add_argument("--open", action="store_true", help="open the report in the browser")
    add_json(command)


async def _report(options: argparse.Namespace) -> None:
    import_extra("plotly", extra="report")
    logs = [options.log] if options.other is None else [options.log, options.other]
    if any(log.suffix.lower() == ".ulg" for log in logs):
        import_extra("pyulog", extra="report")
    from aerokit.logs.report import write_report

    target = options.output or options.log.with_suffix(".html")
    # Check the names of the logs first, because the default name of the report is derived from one of them.
    for log in logs:
        check_log_name(log)
    check_not_existing(target, options)
    with progress_bar(options.log.name, unit="B") as on_progress:
        report = write_report(
            options.log,
            target,
            compare_with=options.other,
            system_id=options.system,
            force=options.force,
            on_progress=on_progress,
        )
    emit(options, "report", {**report.to_dict(), "logs": logs}, _report_text(report))
    if options.open:
        import webbrowser

        webbrowser.open(report.target.resolve().as_uri())


def _report_text(report: Report) -> str:
    lines = []
    # A report covers one log, or two logs called A and B.
    for letter, sentences, failsafes in zip("AB", report.summaries, report.failsafes, strict=False):
        if len(report.summaries) > 1:
            lines.append(f"{letter}:")
        lines += sentences
        for failsafe in failsafes:
            lines.append(f"{clock_text(failsafe.time_s)} {failsafe.title}: {failsafe.reaction}")
            lines += [f"  {fact}" for fact in failsafe.context]
    last_line = f"{report.target}: {report.bytes / 1e6:.1f} MB"
    for falls_of_flight in report.falls:
        for fall in falls_of_flight:
            last_line += f"; {fall_text(fall)}"
    lines.append(last_line)
    return "\n".join(lines)
