"""``aerokit monitor``: the vehicles on a link, in the terminal."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING

from aerokit.cli.arguments import address
from aerokit.cli.completers import addresses, offer
from aerokit.cli.extras import need
from aerokit.cli.interrupt import on_interrupt
from aerokit.cli.signing import ENVIRONMENT, add_signing_key, signing_of
from aerokit.cli.vehicle_command import ADDRESS_VARIABLE, USUAL_ADDRESS, default_address
from aerokit.errors import LocalProtocolError

if TYPE_CHECKING:
    import argparse

__all__ = ["add_arguments", "run_monitor"]


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_monitor)
    place = command.add_argument(
        "address",
        nargs="?",
        type=address,
        default=default_address(),
        metavar="ADDRESS",
        help=f"udpin:0.0.0.0:14550, tcp:127.0.0.1:5760, /dev/ttyACM0,57600 …"
        f" (${ADDRESS_VARIABLE}, else {USUAL_ADDRESS})",
    )
    offer(place, addresses)
    command.add_argument(
        "--baud", type=int, default=57600, help="of a serial port whose address says none (57600)"
    )
    add_signing_key(command, f"of vehicles that want signed messages (${ENVIRONMENT})")


async def run_monitor(options: argparse.Namespace) -> int:
    """Show them until the user leaves."""
    need("textual", "monitor")
    from aerokit.monitor.app import run_monitor as run

    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise LocalProtocolError("aerokit monitor needs a terminal")
    with ExitStack() as stack:
        return await run(
            options.address,
            baud=options.baud,
            signing=signing_of(options),
            show=lambda app: stack.enter_context(on_interrupt(app.exit)),
        )
