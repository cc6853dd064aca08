"""The command line: which command is meant, and how it ends."""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import sys
from typing import TYPE_CHECKING, Any, NoReturn

from aerokit._internal.imports import complaint
from aerokit._internal.wording import did_you_mean
from aerokit.apps.cli.commands import COMMANDS
from aerokit.apps.cli.output import FAILED, NotInstalled, describe, exit_code, need, tell_error
from aerokit.errors import AerokitError

if TYPE_CHECKING:
    from collections.abc import Sequence

COMPLETING = "_ARGCOMPLETE"
"""The variable that a shell sets when it asks for completions."""

RUN = "run"
"""Handled apart: what comes behind its program is the program's, and nothing of it is ours to parse."""


_BELOW_ZERO = re.compile(r"-\.?\d")

_CHOICE = re.compile(r"invalid choice: '(.*)' \(choose from (.*)\)")


class Parser(argparse.ArgumentParser):
    """Its subparsers are of this class, too, and each complains of its own arguments."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # argparse takes "-35.36,149.16,584" for an option, and half of the world is south; a number alone it knows.
        self._negative_number_matcher = _BELOW_ZERO

    def parse_known_args(  # type: ignore[override]  # typeshed has overloads for other namespaces
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """Refuse what is left over here, where the known options and the right usage are known."""
        if args is not None and self._subparsers is None:
            self._refuse_unknown_options(args)
        namespace, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self._refuse(unknown)
        return namespace, unknown

    def _refuse_unknown_options(self, args: Sequence[str]) -> None:
        """Before what stands behind one is taken for an address."""
        options = list(args[: args.index("--")] if "--" in args else args)
        names = [each.partition("=")[0] for each in options if each.startswith("--")]
        for name in names:
            if not any(known.startswith(name) for known in self._option_string_actions):
                self._refuse([name])

    def _refuse(self, unknown: Sequence[str]) -> NoReturn:
        options = [each for each in unknown if each.startswith("-")]
        meant = did_you_mean(options[0].partition("=")[0] if options else None, self._option_string_actions)
        self.error(f"unrecognized arguments: {' '.join(unknown)}{meant}")

    def error(self, message: str) -> NoReturn:
        """Exit code 2."""
        if found := _CHOICE.search(message):
            message += did_you_mean(found[1], re.findall(r"[\w.-]+", found[2]))
        super().error(message)


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


def complete() -> int:
    """Answer the shell, which has said by variables what is typed so far."""
    try:
        argcomplete = need("argcomplete", "completion")
    except NotInstalled:
        return FAILED
    words = os.environ.get("COMP_LINE", "").split()
    argcomplete.autocomplete(make_parser(words[1] if len(words) > 1 else ""))
    return FAILED  # it does not come back
