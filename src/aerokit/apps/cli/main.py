"""The command line: which command is meant, and how it ends."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from typing import TYPE_CHECKING

from aerokit._internal.imports import complaint
from aerokit.apps.cli.arguments import Parser
from aerokit.apps.cli.commands import COMMANDS
from aerokit.apps.cli.output import DONE, FAILED, NotInstalled, describe, exit_code, need, tell_error
from aerokit.errors import AerokitError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["add_arguments", "complete", "main", "run_completion"]

COMPLETING = "_ARGCOMPLETE"
"""The variable that a shell sets when it asks for completions."""

RUN = "run"
"""Handled apart: what comes behind its program is the program's, and nothing of it is ours to parse."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code (`aerokit.apps.cli.output`).

    ``aerokit run`` ends as the program does that it runs; what that raises comes out.
    """
    if (mixed := _mixed_files()) is not None:
        print(f"aerokit: {mixed}", file=sys.stderr)
        return FAILED
    if COMPLETING in os.environ:
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


SHELLS = ("bash", "zsh", "fish")


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_completion)
    command.add_argument(
        "shell",
        choices=SHELLS,
        help='bash, zsh: eval "$(aerokit completion bash)" in ~/.bashrc or ~/.zshrc; fish: aerokit completion'
        " fish > ~/.config/fish/completions/aerokit.fish",
    )


async def run_completion(options: argparse.Namespace) -> int:
    """Print what the shell has to read."""
    print(need("argcomplete", "completion").shellcode(["aerokit"], shell=options.shell))
    return DONE


def complete() -> int:
    """Answer the shell, which has said by variables what is typed so far."""
    try:
        argcomplete = need("argcomplete", "completion")
    except NotInstalled:
        return FAILED
    words = os.environ.get("COMP_LINE", "").split()
    argcomplete.autocomplete(make_parser(words[1] if len(words) > 1 else ""))
    return FAILED  # it does not come back
