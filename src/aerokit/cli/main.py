"""The commands, their arguments and exit codes."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from typing import TYPE_CHECKING

from aerokit.cli.arguments import (
    address,
    address_or_form,
    count,
    home,
    number,
    parameter,
    picture,
    system_id,
    vehicle_kind,
    wind,
    writable_file,
)
from aerokit.cli.files import add_files
from aerokit.cli.logs import add_logs
from aerokit.cli.mission import add_mission
from aerokit.cli.params import add_params
from aerokit.cli.parser import Parser
from aerokit.cli.places import EACH_ITS_OWN
from aerokit.cli.signing import ENVIRONMENT, add_signing_key
from aerokit.cli.vehicles import HOME
from aerokit.errors import AerokitError, LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]

FAILED, WRONG_ARGUMENTS, INTERRUPTED = 1, 2, 130
RUN = "run"
"""Handled apart: what comes behind its program is the program's, and nothing of it is ours to parse."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0 done, 1 failed, 2 wrong arguments, 130 interrupted.

    ``aerokit run`` ends as the program does that it runs; what that raises comes out.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments and arguments[0] == RUN:
        from aerokit.dronekit.runner import main as run_program

        return run_program(arguments[1:], "aerokit run")
    options = _parser().parse_args(arguments)
    try:
        code: int = asyncio.run(options.run(options))
    except KeyboardInterrupt:
        return _failed("interrupted", INTERRUPTED)
    except LocalProtocolError as error:
        return _failed(str(error), WRONG_ARGUMENTS)
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - else the interpreter complains at its exit
        return FAILED
    except (AerokitError, OSError) as error:
        return _failed(str(error), FAILED)
    return code


def _failed(text: str, code: int) -> int:
    print(f"aerokit: {text}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    from aerokit import __version__

    parser = _plain_parser()
    parser.add_argument("--version", action="version", version=f"aerokit {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")
    _add_demo(commands)
    _add_sim(commands)
    for add in (add_params, add_mission, add_files, add_logs):
        add(commands)
    commands.add_parser(RUN, help="run a DroneKit program unchanged", add_help=False)
    return parser


def _plain_parser() -> argparse.ArgumentParser:
    return Parser(
        prog="aerokit",
        description="Control drones over MAVLink.",
        epilog="Exit codes: 0 done, 1 failed, 2 wrong arguments, 130 interrupted.",
    )


def _add_demo(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    async def run(options: argparse.Namespace) -> int:
        from aerokit.cli.demo import run_demo

        return await run_demo(options)

    text = (
        "Take off, fly a square, come back and land: on a simulated vehicle, or on any vehicle with --connect."
        " Ctrl-C lands it where it is, a second Ctrl-C leaves it to itself."
    )
    demo = commands.add_parser("demo", help="fly a square", description=text)
    demo.set_defaults(run=run)
    demo.add_argument(
        "--connect",
        type=address,
        metavar="ADDRESS",
        help="a vehicle: udpin:0.0.0.0:14550, tcp:127.0.0.1:5760, /dev/ttyACM0,57600 …",
    )
    _add_vehicle(demo, "copter, plane (ArduPilot), px4, px4_plane (copter)")
    demo.add_argument(
        "--altitude", type=number(1, 500), default=10.0, metavar="M", help="metres above home (10)"
    )
    demo.add_argument(
        "--side", type=number(1, 5000), default=20.0, metavar="M", help="side of the square in metres (20)"
    )
    demo.add_argument(
        "--record",
        type=writable_file,
        default="flight.tlog",
        metavar="FILE",
        help="telemetry log; one that is there is replaced (flight.tlog)",
    )
    demo.add_argument(
        "--speedup", type=number(0.1, 100), default=5.0, metavar="X", help="of the simulated vehicle (5)"
    )
    demo.add_argument(
        "--system-id", type=system_id, metavar="ID", help="of the vehicle (the first that is heard)"
    )
    demo.add_argument(
        "--baud", type=int, default=57600, help="of a serial port whose address says none (57600)"
    )
    add_signing_key(demo, f"of the vehicle of --connect (${ENVIRONMENT})")


def _add_sim(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    async def run(options: argparse.Namespace) -> int:
        from aerokit.cli.sim import run_sim

        return await run_sim(options)

    text = "Simulate vehicles for other programs, until interrupted."
    sim = commands.add_parser("sim", help="simulate vehicles", description=text)
    sim.set_defaults(run=run)
    kinds = "copter, plane, rover, sub (ArduPilot), px4, px4_plane; or a recording, flight.tlog (copter)"
    _add_vehicle(sim, kinds)
    sim.add_argument(
        "addresses",
        nargs="*",
        type=address_or_form,
        default=[EACH_ITS_OWN],
        metavar="ADDRESS",
        help="where to serve them, one or several: udpout:127.0.0.1:14550, udpin:0.0.0.0:14550, tcpin:0.0.0.0:5760,"
        " /dev/ttyUSB0,57600, pty (a pseudo-terminal), pty:/tmp/ttyV0. All vehicles are on each address; but a form"
        " gives each its own: pty:/tmp/ttyV{n}, udpout:127.0.0.1:{14550+n}; n counts from 0, id is the system id"
        f" ({EACH_ITS_OWN})",
    )
    sim.add_argument("--count", type=count, default=1, metavar="N", help="so many, 1 to 250 (1)")
    sim.add_argument("--speedup", type=number(0.1, 100), default=1.0, metavar="X", help="times real time (1)")
    sim.add_argument(
        "--system-id", type=system_id, default=1, metavar="ID", help="MAVLink system id of the first (1)"
    )
    sim.add_argument(
        "--home",
        type=home,
        default=HOME,
        metavar="LAT,LON,ALT",
        help="of the first, degrees and metres above the sea (47.397742,8.545594,488)",
    )
    sim.add_argument(
        "--spacing", type=number(0, 1000), default=5.0, metavar="M", help="metres between them, eastwards (5)"
    )
    sim.add_argument("--seed", type=int, default=0, help="of the noise of the first (0)")
    _add_sim_conditions(sim)


def _add_sim_conditions(sim: argparse.ArgumentParser) -> None:
    sim.add_argument(
        "--parameter",
        action="append",
        type=parameter,
        default=[],
        dest="parameters",
        metavar="NAME=VALUE",
        help="other than its default, several times if need be: MNT1_TYPE=1 fits a gimbal to the copter",
    )
    sim.add_argument(
        "--wind",
        type=wind,
        metavar="NORTH,EAST[,GUSTS]",
        help="where the air goes in m/s, and how much it changes (no wind); --wind=-3,0 for the first below 0",
    )
    sim.add_argument("--battery", type=number(0, 100), metavar="PERCENT", help="charge at the start (100)")
    sim.add_argument(
        "--boot-time", type=number(0, 600), metavar="S", help="simulated seconds until it is ready to arm"
    )
    add_signing_key(sim, "has been set up on them before; ArduPilot's first port needs no signatures")
    sim.add_argument(
        "--duration",
        type=number(0.1, 1e6),
        metavar="S",
        help="simulated seconds, then it ends (until Ctrl-C)",
    )
    sim.add_argument(
        "--picture",
        type=picture,
        metavar="FILE",
        help="of the true tracks, at the end: .svg, or .png with Pillow",
    )


def _add_vehicle(command: argparse.ArgumentParser, kinds: str) -> None:
    command.add_argument(
        "--vehicle",
        type=vehicle_kind,
        default="copter",
        metavar="KIND",
        help=f"simulated: {kinds}",
    )
