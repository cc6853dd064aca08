"""Compares aerokit, DroneKit 2.9.2 and dronekit2 3.0 with the same DroneKit script and the same vehicle, in turns.

    python benchmarks/dronekit_compare.py                    # everything, half an hour; writes bench-dronekit.json
    python benchmarks/dronekit_compare.py cpu latency        # these parts only: cpu, reads, latency, connect, import
    python benchmarks/dronekit_compare.py --quick            # a short check that it runs; the figures mean little

Each measurement has a new client process (``client_classic.py``) and a new vehicle process (``dronekit_vehicle.py``).
AEROKIT_DRONEKIT_PYTHON and AEROKIT_DRONEKIT2_PYTHON name the interpreters with the peers, which cannot be
installed together; a peer that is not installed is omitted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import table
from dronekit_runs import LIBRARIES, Library, compile_aerokit, installed
from dronekit_tasks import Plan, connect_rows, cpu_rows, import_rows, latency_rows, read_rows
from table import Row

__all__ = ["main"]

PARTS: dict[str, Callable[[Sequence[Library], Plan], list[Row]]] = {
    "cpu": cpu_rows,
    "reads": read_rows,
    "latency": latency_rows,
    "connect": connect_rows,
    "import": import_rows,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested parts, print and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--only", default="", metavar="TEXT", help="only cases with this in their name")
    parser.add_argument("--rounds", type=int, default=5, help="number of turns of each library (5)")
    parser.add_argument("--peer", action="append", metavar="NAME", help="dronekit, dronekit2; both by default")
    parser.add_argument("--quick", action="store_true", help="measure briefly, to check that everything runs")
    parser.add_argument("--output", type=Path, default=Path("bench-dronekit.json"))
    options = parser.parse_args(arguments)
    if not set(options.parts) <= set(PARTS):
        parser.error(f"the parts are {', '.join(PARTS)}")
    wanted = ["aerokit", *(options.peer or ("dronekit", "dronekit2"))]
    libraries = [library for library in LIBRARIES if library.name in wanted and installed(library)]
    plan = Plan(rounds=1 if options.quick else options.rounds, quick=options.quick, only=options.only)
    rows: list[Row] = []
    compile_aerokit()
    for part in options.parts or PARTS:
        rows += PARTS[part](libraries, plan)
    print(table.printed(rows))
    for name in sorted(set(wanted) - {library.name for library in libraries}):
        print(f"{name}: omitted, because it is not installed")
    missed = [row["name"] for row in rows if table.is_missed(row)]
    print(f"MISSED: {', '.join(missed)}" if missed else "every aim is met")
    table.write(rows, options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
