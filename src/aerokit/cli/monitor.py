"""``aerokit monitor``: the vehicles on a link, in the terminal."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING

from aerokit.cli.extras import need
from aerokit.cli.interrupt import on_interrupt
from aerokit.cli.signing import ENVIRONMENT, add_signing_key, signing_of
from aerokit.cli.vehicle_command import add_place
from aerokit.errors import LocalProtocolError

if TYPE_CHECKING:
    import argparse

__all__ = ["add_arguments", "run_monitor"]


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_monitor)
    add_place(command)
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
