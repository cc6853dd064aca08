"""The command line: the table of commands, argument parsing, and exit codes."""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import sys
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, NoReturn

from aerokit._internal.imports import installation_problem
from aerokit.apps.cli.misplaced import is_address, misplaced_address
from aerokit.apps.cli.output import (
    DONE,
    FAILED,
    NotInstalled,
    emit_error,
    exit_code,
    exit_codes_help,
    import_extra,
    nonblocking_stderr,
    plain_warnings,
    suggestion,
)
from aerokit.errors import AerokitError

if TYPE_CHECKING:
    from collections.abc import Sequence

ARGCOMPLETE_VARIABLE = "_ARGCOMPLETE"
"""Name of the environment variable that the shell sets when it asks argcomplete for completions."""
# The parser of this module does not parse `aerokit run PROGRAM ARGUMENTS…`, because the arguments are the program's.
RUN = "run"


@dataclass(frozen=True)
class CliCommand:
    """A subcommand, ``aerokit NAME``. Its module is imported only when the command is called.

    ``location`` names a function in `aerokit.apps.cli`: ``"module:function"``, or ``"module"`` for its function
    ``add_arguments``. The function adds the command's arguments to a parser. It also sets ``run``: a coroutine function
    that takes the parsed options and returns the exit code, or None for DONE. The first sentence of ``description``
    appears in the list of commands.
    """

    name: str
    location: str
    description: str

    @property
    def help(self) -> str:
        return self.description[0].lower() + self.description[1:].partition(". ")[0].rstrip(".")

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        module, _, function = self.location.partition(":")
        getattr(import_module(f"aerokit.apps.cli.{module}"), function or "add_arguments")(parser)


COMMANDS = (
    CliCommand(
        "demo",
        "demo",
        "Fly a square, on a simulated vehicle or with --connect on any vehicle. The vehicle takes off,"
        " flies the square, and lands. Ctrl-C lands it where it is; a second Ctrl-C exits without further"
        " commands.",
    ),
    CliCommand("sim", "sim", "Simulate vehicles for other programs, until Ctrl-C."),
    CliCommand(
        "status",
        "status",
        "Show what is on a link. Lists systems and components, firmware, mode, GPS, battery, link"
        " quality, and what is missing for flight. Requests data that a vehicle does not stream; changes"
        " nothing.",
    ),
    CliCommand(
        "events",
        "listening:add_events_arguments",
        "Print the events of a link and the texts of its vehicles, until Ctrl-C.",
    ),
    CliCommand(
        "doctor",
        "doctor",
        "Find problems of installation and connection. Without ADDRESS, checks this computer:"
        " installation, serial ports, permissions, network ports. With ADDRESS, checks a link: baud rate,"
        " protocol version, ids, signing, dialect, packet loss.",
    ),
    CliCommand("record", "listening", "Record a link to a telemetry log (.tlog), until Ctrl-C."),
    CliCommand(
        "hub",
        "hub",
        "Join links into one MAVLink network, until Ctrl-C. Forwards messages between serial, UDP and TCP"
        " links by MAVLink's routing rules, and sends no other messages.",
    ),
    CliCommand(
        "monitor",
        "listening:add_monitor_arguments",
        "Watch vehicles in the terminal. Shows state with ages, texts, message rates, link quality and a"
        " map. Keys command hold, land and return, after a confirmation.",
    ),
    CliCommand("params", "params", "Read, set, save, load and compare the parameters of a vehicle."),
    CliCommand(
        "calibrate",
        "calibrate",
        "Calibrate a sensor, the remote control or the ESCs. Shows what to do and how to place the vehicle, step by"
        " step; Ctrl-C cancels the calibration on the vehicle.",
    ),
    CliCommand("mission", "mission", "Transfer, show and check missions, fences and rally points."),
    CliCommand(
        "fly",
        "fly",
        "Fly a plan from a file. Uploads the plan, asks for confirmation, arms the vehicle, and flies the"
        " mission to its end; --sim flies it on a simulated vehicle. Ctrl-C returns to launch; a second"
        " Ctrl-C exits without further commands.",
    ),
    CliCommand("files", "files", "List, download and change files on a vehicle by MAVFTP."),
    CliCommand("logs", "files:add_logs_arguments", "List, download and erase the flight logs on a vehicle."),
    CliCommand("camera", "devices", "Use the cameras of a vehicle: pictures, video, lens and storage."),
    CliCommand(
        "serve",
        "serve",
        "Serve vehicles to the browser. The page shows map, state, missions and parameters, and sends"
        " orders; there is also an HTTP and WebSocket API. Orders need the token that is printed.",
    ),
    CliCommand("gimbal", "devices:add_gimbal_arguments", "Show where a vehicle's gimbal points, and point it."),
    CliCommand("bridge", "bridge", "Publish the vehicles on a link to Foxglove, zenoh or MQTT."),
    CliCommand(
        "report",
        "flight_logs:add_report_arguments",
        "Write a report on a flight log as HTML. The self-contained file has a summary, map, charts,"
        " failsafes and parameters. With two logs (.tlog, .bin, .ulg) it compares the flights.",
    ),
    CliCommand(
        "convert",
        "flight_logs",
        "Convert a flight log (.tlog, .bin, .ulg) to MCAP for Foxglove, CSV, Parquet, GPX or KML.",
    ),
    CliCommand("completion", "completion", "Print a script that completes commands, options and names in your shell."),
)


GROUPS: dict[str, tuple[str, ...]] = {
    "without a vehicle": ("sim", "demo", "doctor", "report", "convert", "completion"),
    "watch vehicles": ("status", "monitor", "serve", "events", "record"),
    "fly": ("fly", "mission", RUN),
    "parameters, files, devices": ("params", "calibrate", "files", "logs", "camera", "gimbal"),
    "connect programs": ("hub", "bridge"),
}
"""All commands, grouped by task for the help."""


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that accepts negative coordinates and suggests corrections. Subparsers have the same class."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # With argparse's own pattern, coordinates such as "-35.36,149.16,584" would be options, not values.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def parse_known_args(  # type: ignore[override]  # typeshed has overloads for other namespaces
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        if args is not None and not isinstance(self, _TopParser):
            if self._subparsers is None:  # otherwise, some of these options belong to an action's own parser
                self._check_option_names(args)
            if problem := misplaced_address(self, args):
                self.error(problem)
        namespace, unknown = super().parse_known_args(args, namespace)
        # argparse would print the usage of the top-level parser, which does not show the options of the subcommand.
        if unknown:
            self._exit_unrecognized(unknown)
        return namespace, unknown

    def _check_option_names(self, args: Sequence[str]) -> None:
        # Report unknown options before argparse does, because argparse would take the value after an unknown option for
        # a positional argument. --connect is left to misplaced_address(), which prints the right command line.
        options = list(args[: args.index("--")] if "--" in args else args)
        names = [option.partition("=")[0] for option in options if option.startswith("--")]
        for name in names:
            if name != "--connect" and not any(option.startswith(name) for option in self._option_string_actions):
                self._exit_unrecognized([name])

    def _exit_unrecognized(self, unknown: Sequence[str]) -> NoReturn:
        options = [argument for argument in unknown if argument.startswith("-")]
        hint = suggestion(options[0].partition("=")[0], self._option_string_actions) if options else ""
        self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")

    def error(self, message: str) -> NoReturn:
        # Add a suggestion to argparse's message about an unknown choice.
        match = re.search(r"invalid choice: '(.*)' \(choose from (.*)\)", message)
        if match is not None:
            choice, choices = match.groups()
            hint = suggestion(choice, re.findall(r"[\w.-]+", choices))
            is_command = message.startswith("argument COMMAND:")
            if is_command and is_address(choice):
                hint = f"; to see the vehicle there: aerokit status {choice}"
            if choice.lower() in _ARMING_WORDS:
                hint = "; `aerokit fly PLAN`, the web page of `aerokit serve` and Python programs arm and fly a vehicle"
            message = (
                f"unknown command {choice!r}{hint}; `aerokit` lists the commands" if is_command else message + hint
            )
        super().error(message)


# Actions that users may try as commands. The command line does not have them.
_ARMING_WORDS = ("arm", "disarm", "takeoff", "take_off", "take-off", "land", "goto", "go_to", "rtl")


class _TopParser(Parser):
    """The parser of ``aerokit`` itself. Its help lists the commands by task."""

    def format_help(self) -> str:
        *options, subparsers = self._actions
        assert isinstance(subparsers, argparse._SubParsersAction)
        commands = {action.dest: action for action in subparsers._get_subactions()}
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        for title, names in GROUPS.items():
            formatter.start_section(title)
            formatter.add_arguments(commands[name] for name in names)
            formatter.end_section()
        formatter.start_section("options")
        formatter.add_arguments(options)
        formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, as listed in `aerokit.apps.cli.output`.

    ``aerokit run PROGRAM`` returns the exit code of the program, or raises its exception.
    """
    if (problem := _installation_problem()) is not None:
        print(f"aerokit: {problem}", file=sys.stderr)
        return FAILED
    if ARGCOMPLETE_VARIABLE in os.environ:
        return complete()
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments and arguments[0] == RUN:
        from aerokit.dronekit.runner import main as run_program

        return run_program(arguments[1:], "aerokit run")
    if not arguments:
        print(make_parser("").format_help(), end="")
        return DONE
    options = make_parser(arguments[0]).parse_args(arguments)
    try:
        with plain_warnings(), nonblocking_stderr():
            code: int | None = asyncio.run(options.run(options))
    except BrokenPipeError:
        # At exit, the interpreter flushes stdout. With the old stdout, it would report another BrokenPipeError.
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        return FAILED
    except KeyboardInterrupt:
        return _report_error(KeyboardInterrupt("interrupted"), options)
    except (AerokitError, OSError) as error:
        return _report_error(error, options)
    return DONE if code is None else code


def _installation_problem() -> str | None:
    # Another distribution named `aerokit` may have overwritten our files, `__init__.py` included.
    import aerokit

    return installation_problem(aerokit.__path__[0], is_ours="open_connection" in getattr(aerokit, "__all__", ()))


def _report_error(error: BaseException, options: argparse.Namespace) -> int:
    code = exit_code(error)
    emit_error(error, code, as_json=getattr(options, "json", False))
    return code


def make_parser(only: str | None = None) -> argparse.ArgumentParser:
    """Make the parser for the command line.

    Only the arguments of the command ``only`` are added, because importing all modules is slow. ``only`` is "" for no
    command, and None for all commands.
    """
    from aerokit import __version__

    parser = _TopParser(
        prog="aerokit",
        description="Control drones over MAVLink. First flight: aerokit demo",
        epilog=f"aerokit COMMAND --help explains a command. {exit_codes_help()}",
    )
    parser.add_argument("--version", action="version", version=f"aerokit {__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND", title="commands", parser_class=Parser)
    for command in COMMANDS:
        subparser = subparsers.add_parser(command.name, help=command.help, description=command.description)
        if only in (command.name, None):
            command.add_arguments(subparser)
    run = subparsers.add_parser(RUN, help="run a DroneKit program unchanged", add_help=False)
    run.add_argument("program", nargs=argparse.REMAINDER)  # only for the completion of file names
    return parser


def complete() -> int:
    try:
        argcomplete = import_extra("argcomplete", extra="completion")
    except NotInstalled:
        return FAILED
    words = os.environ.get("COMP_LINE", "").split()
    argcomplete.autocomplete(make_parser(words[1] if len(words) > 1 else ""))  # exits the process
    return FAILED
