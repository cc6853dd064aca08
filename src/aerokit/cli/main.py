"""The command line: which command is meant, and how it ends."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from typing import TYPE_CHECKING

from aerokit.cli.commands import COMMANDS
from aerokit.cli.exits import FAILED, describe, exit_code
from aerokit.cli.output import tell_error
from aerokit.cli.parser import Parser
from aerokit.errors import AerokitError
from aerokit.installed import complaint

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]

COMPLETING = "_ARGCOMPLETE"
"""The variable that a shell sets when it asks for completions."""
RUN = "run"
"""Handled apart: what comes behind its program is the program's, and nothing of it is ours to parse."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code (`aerokit.cli.exits`).

    ``aerokit run`` ends as the program does that it runs; what that raises comes out.
    """
    if (mixed := _mixed_files()) is not None:
        print(f"aerokit: {mixed}", file=sys.stderr)
        return FAILED
    if COMPLETING in os.environ:
        from aerokit.cli.completion import complete

        return complete()
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments and arguments[0] == RUN:
        from aerokit.dronekit.runner import main as run_program

        return run_program(arguments[1:], "aerokit run")
    options = make_parser(arguments[0] if arguments else "").parse_args(arguments)
    try:
        code: int = asyncio.run(options.run(options))
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - else the interpreter complains at its exit
        return FAILED
    except KeyboardInterrupt:
        return _failed(KeyboardInterrupt("interrupted"), options)
    except (AerokitError, OSError) as error:
        return _failed(error, options)
    return code


def _mixed_files() -> str | None:
    """Our entry point is called whoever's ``__init__`` it is that is there."""
    import aerokit

    return complaint(aerokit.__path__[0], is_ours="open_connection" in getattr(aerokit, "__all__", ()))


def _failed(error: BaseException, options: argparse.Namespace) -> int:
    code = exit_code(error)
    tell_error(error, code, as_json=getattr(options, "json", False))
    return code


def make_parser(only: str | None = None) -> argparse.ArgumentParser:
    """The parser of all commands.

    Arguments has that command alone that ``only`` names, if it is one: importing all of them takes long. None: all.
    """
    from aerokit import __version__

    parser = Parser(prog="aerokit", description="Control drones over MAVLink.", epilog=describe())
    parser.add_argument("--version", action="version", version=f"aerokit {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")
    for command in COMMANDS:
        its_parser = commands.add_parser(command.name, help=command.help, description=command.description)
        if only in (command.name, None):
            command.add_arguments(its_parser)
    run = commands.add_parser(RUN, help="run a DroneKit program unchanged", add_help=False)
    run.add_argument("program", nargs=argparse.REMAINDER)  # for completion, which offers files
    return parser
