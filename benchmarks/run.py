"""The complete table of benchmarks, compared with pymavlink, MAVSDK, mavio and mavkit; writes ``bench.json``.

    python benchmarks/run.py                          # everything, about a minute
    python benchmarks/run.py import decode_skip       # these rows only
    python benchmarks/run.py --quick                  # a short check that it runs; the figures mean little
    AEROKIT_PURE=1 python benchmarks/run.py           # without the compiled wire; the table names the wire

Figures are medians of interleaved rounds. Only the ratios are comparable between machines. A missed target is marked in
the table, but the exit code is 0.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path

import command_rtt
import decode
import deliver
import import_time
import jitter
import logs
import table
from table import Row

from aerokit import wire_implementation

Measure = Callable[[bool], list[Row]]
"""Function that measures rows; the argument True selects few rounds."""

SHORT = "copter_short"
DECODE = tuple(decode.RECORDINGS)
LOGS = ("tlog_typed", "tlog_typed_mavio", "tlog_typed_mavkit", "tlog_typed_mavkit_json")

MEASURES: dict[tuple[str, ...], Measure] = {
    (
        *("decode_skip", "decode_typed", "decode_floor", "decode_floor_typed"),
        *("decode_skip_stream", "decode_typed_stream"),
        *(f"decode_{kind}_{name}" for name in DECODE[1:] for kind in ("skip", "typed")),
    ): lambda quick: decode.rows(1, [SHORT, "quad_short"]) if quick else decode.rows(),
    ("deliver_telemetry", "deliver_async_for"): lambda quick: deliver.rows(1, SHORT) if quick else deliver.rows(),
    LOGS: lambda quick: logs.rows(1, SHORT) if quick else logs.rows(),
    ("command_rtt_pymavlink", "command_rtt_mavsdk"): lambda quick: (
        command_rtt.rows(1, 20) if quick else command_rtt.rows()
    ),
    tuple(f"jitter_{rate_hz}" for rate_hz in jitter.RATES_HZ): lambda quick: (
        jitter.rows(1, 0.3) if quick else jitter.rows()
    ),
    ("import", "import_ready"): lambda quick: (
        import_time.rows(1, fresh_byte_code=False) if quick else import_time.rows()
    ),
}
NAMES = tuple(chain.from_iterable(MEASURES))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested rows, print and write the results."""
    parser = _parser()
    options = parser.parse_args(arguments)
    wanted = options.names or NAMES
    if not set(wanted) <= set(NAMES):
        parser.error(f"the names are {', '.join(NAMES)}")
    rows = [row for row in _measure(wanted, options.quick) if row["name"] in wanted]
    print(f"wire: {wire_implementation}")
    print(table.printed(rows))
    for name in sorted(set(wanted) - {row["name"] for row in rows}):
        print(f"{name}: omitted, because its peer is not installed")
    missed = [row["name"] for row in rows if table.is_missed(row)]
    print(f"MISSED: {', '.join(missed)}" if missed else "every aim is met")
    table.write(rows, options.output)
    return 0


def _measure(wanted: Sequence[str], quick: bool) -> list[Row]:
    rows: list[Row] = []
    for names, measure in MEASURES.items():
        if not set(names).isdisjoint(wanted):
            print(f"measuring {', '.join(names)} …", file=sys.stderr, flush=True)
            rows += measure(quick)
    return rows


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--quick", action="store_true", help="few rounds, to check that everything runs")
    parser.add_argument("--output", type=Path, default=Path("bench.json"), help="default: bench.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
