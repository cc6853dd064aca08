"""Arguments, exit codes, and nothing else."""

from __future__ import annotations

import argparse
import asyncio
import sys
from typing import TYPE_CHECKING

from aerokit.errors import AerokitError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]

FAILED, INTERRUPTED = 1, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0 done, 1 failed, 2 wrong arguments, 130 interrupted."""
    options = _parser().parse_args(arguments)
    try:
        return asyncio.run(options.run(options))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except AerokitError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="aerokit", description="Control drones over MAVLink.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_sim(commands)
    return parser


def _add_demo(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    async def run(options: argparse.Namespace) -> int:
        from aerokit.cli.demo import run_demo

        return await run_demo(options)

    text = "Fly a square: on a simulated copter, or on any vehicle with --connect."
    demo = commands.add_parser("demo", help="fly a square", description=text)
    demo.set_defaults(run=run)
    demo.add_argument(
        "--connect", metavar="ADDRESS", help="a vehicle, e.g. udpin:0.0.0.0:14550 or /dev/ttyACM0,57600"
    )
    demo.add_argument("--altitude", type=float, default=10.0, metavar="M", help="metres above home (10)")
    demo.add_argument(
        "--side", type=float, default=20.0, metavar="M", help="side of the square in metres (20)"
    )
    demo.add_argument("--record", default="flight.tlog", metavar="FILE", help="telemetry log (flight.tlog)")
    demo.add_argument("--speedup", type=float, default=5.0, metavar="X", help="of the simulated copter (5)")
    demo.add_argument("--system-id", type=int, metavar="ID", help="of the vehicle (the first that is heard)")
    demo.add_argument("--baud", type=int, default=57600, help="of a serial port (57600)")


def _add_sim(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    async def run(options: argparse.Namespace) -> int:
        from aerokit.cli.sim import run_sim

        return await run_sim(options)

    text = "Simulate a copter for other programs, until interrupted."
    sim = commands.add_parser("sim", help="simulate a copter", description=text)
    sim.set_defaults(run=run)
    sim.add_argument(
        "addresses",
        nargs="*",
        default=["tcpin:127.0.0.1:5760"],
        metavar="ADDRESS",
        help="where to serve it: tcpin:HOST:PORT (tcpin:127.0.0.1:5760), udpout:HOST:PORT, udpin:HOST:PORT, a port",
    )
    sim.add_argument("--speedup", type=float, default=1.0, metavar="X", help="times real time (1)")
    sim.add_argument("--system-id", type=int, default=1, metavar="ID", help="MAVLink system id (1)")
    sim.add_argument(
        "--home", default="47.397742,8.545594,488", metavar="LAT,LON,ALT", help="degrees and metres"
    )
    sim.add_argument("--seed", type=int, default=0, help="of its noise (0)")
