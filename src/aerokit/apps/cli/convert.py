"""``aerokit convert``: a flight log in the formats of other programs."""

from __future__ import annotations

import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.plain import printable
from aerokit.apps.cli.output import DONE, add_json, need, tell
from aerokit.apps.cli.terminal import progress_bar

if TYPE_CHECKING:
    import argparse

_WRITTEN = {".mcap": "message", ".gpx": "point", ".kml": "point"}
"""What ``written`` counts; an ``.mcap`` may get several messages of one entry: itself, and states that it changed."""
_NEEDS = {".mcap": "mcap", ".parquet": "pyarrow", ".gpx": "gpxpy", ".kml": "simplekml"}


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=_convert)
    command.add_argument("log", type=Path, metavar="LOG", help=".tlog, .bin (ArduPilot) or .ulg (PX4)")
    command.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help=".mcap (Foxglove), .csv or .parquet (one table of the flight), .gpx, .kml;"
        " a name without a suffix: a folder with a table for each kind of message",
    )
    command.add_argument(
        "--tables", choices=("csv", "parquet"), default="csv", help="what a folder is filled with (csv)"
    )
    command.add_argument("--force", action="store_true", help="replace what is there already")
    add_json(command)


async def _convert(options: argparse.Namespace) -> int:
    needed = _NEEDS.get(options.out.suffix.lower() or f".{options.tables}")
    if needed is not None:
        need(needed, "convert")
    if options.log.suffix.lower() == ".ulg":
        need("pyulog", "convert")
    from aerokit.logs.convert import convert

    with progress_bar(options.log.name, "B") as on_progress:
        done = convert(
            options.log, options.out, tables=options.tables, force=options.force, on_progress=on_progress
        )
    for note in done.notes:
        print(printable(f"aerokit: {options.log}: {note}"), file=sys.stderr)
    tell(
        options,
        "conversion",
        {**done.to_dict(), "log": options.log},
        f"{done.target}: {_number(done.written, _WRITTEN.get(done.target.suffix.lower(), 'row'))}"
        f" from {_number(done.entries, 'entry')}, {_size(done.bytes)},"
        f" {_shown(done.begins_at)} to {_shown(done.ends_at)} UTC",
    )
    return DONE


def _number(count: int, what: str) -> str:
    """``1 row``, ``218,645 entries``."""
    many = f"{what[:-1]}ies" if what.endswith("y") else f"{what}s"
    return f"{count:,} {what if count == 1 else many}"


def _size(number: int) -> str:
    return f"{number / 1e6:.1f} MB" if number >= 1e6 else f"{number / 1e3:.1f} kB"


def _shown(unix_s: float) -> str:
    return f"{datetime.fromtimestamp(unix_s, timezone.utc):%Y-%m-%d %H:%M:%S}"
