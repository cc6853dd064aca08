"""``aerokit monitor``: the vehicles on a link, in the terminal."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING

from aerokit.apps.cli.output import INTERRUPTED, need
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.apps.cli.vehicle_command import ENVIRONMENT, add_place, add_signing_key, signing_of
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    import argparse

END_WITHIN_S = 3.0
"""After a signal: whatever Textual does, the process does not stay and hold its port."""


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_monitor)
    add_place(command)
    add_signing_key(command, f"of vehicles that want signed messages (${ENVIRONMENT})")


async def run_monitor(options: argparse.Namespace) -> int:
    """Show them until the user leaves."""
    need("textual", "monitor")
    from aerokit.apps.monitor.app import run_monitor as run

    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise InvalidArgument("aerokit monitor needs a terminal")
    with ExitStack() as stack:

        def end_soon(number: int) -> None:
            if number == getattr(signal, "SIGHUP", None):
                _let_go_of_the_terminal()
            end = threading.Timer(END_WITHIN_S, os._exit, (INTERRUPTED,))
            end.daemon = True
            end.start()
            stack.callback(end.cancel)

        return await run(
            options.address,
            baud=options.baud,
            signing=signing_of(options),
            show=lambda app: stack.enter_context(on_interrupt(app.exit, end_soon)),
        )


def _let_go_of_the_terminal() -> None:
    """Textual's thread for output dies of a write to a terminal that is gone, and then its writes block the loop."""
    with open(os.devnull, "w") as nothing:
        for stream in (1, 2):
            os.dup2(nothing.fileno(), stream)
