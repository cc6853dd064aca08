"""Argument types for argparse. They raise ArgumentTypeError, which leads to exit code 2."""

from __future__ import annotations

import argparse
import math
import re
from argparse import ArgumentTypeError
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit._internal import geo
from aerokit.apps.cli.completion import assignments, set_completions
from aerokit.apps.cli.completion import kinds as kind_names
from aerokit.apps.cli.misplaced import is_address, misplaced_file
from aerokit.apps.cli.output import suggestion
from aerokit.errors import AerokitError, InvalidArgument
from aerokit.parameters import ParameterType, check_name, checked_value
from aerokit.parameters.encoding import parse_number
from aerokit.transport import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable

DEFAULT_SIM_ADDRESS = "tcpin:127.0.0.1:{5760+10n}"
"""Default address template of ``aerokit sim``. Its ports are those of SITL instances: 5760, 5770, 5780 …"""
_MAX_WIND_M_S = 50.0
_TEMPLATE_FIELD = re.compile(r"\{(?:(\d{1,5})\+)?(\d{0,3})(n|id)\}")


def is_address_template(address: str) -> bool:
    return _TEMPLATE_FIELD.search(address) is not None


def expand_address(address: str, number: int, system_id: int) -> str:
    """Replace ``{n}`` in an address by ``number``, and ``{id}`` by ``system_id``.

    A placeholder can have a factor and a summand: ``{5760+10n}`` is 5760, 5770, 5780 …
    """

    def expand(match: re.Match[str]) -> str:
        summand, factor, name = match.groups(default="")
        value = number if name == "n" else system_id
        return str(int(summand or 0) + int(factor or 1) * value)

    return _TEMPLATE_FIELD.sub(expand, address)


def address(text: str) -> str:
    if problem := misplaced_file(text):
        raise ArgumentTypeError(problem)
    try:
        parse_address(text)
    except InvalidArgument as error:
        raise ArgumentTypeError(str(error)) from None
    return text


def address_or_template(text: str) -> str:
    address(expand_address(text, number=0, system_id=1))
    return text


def vehicle_kind(text: str) -> str:
    """Parse the kind of a simulated vehicle, or the path of a recording (.tlog)."""
    from aerokit.sim.kinds import kind_class

    if text.endswith(".tlog"):
        if not Path(text).is_file():
            raise ArgumentTypeError(f"recording {text!r} does not exist")
        return text
    try:
        kind_class(text)
    except InvalidArgument as error:
        raise ArgumentTypeError(str(error)) from None
    return text


def integer(low: int, high: int, what: str) -> Callable[[str], int]:
    """Return a parser for integers from ``low`` to ``high``.

    ``what`` describes the integer in the error.
    """

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdigit() and low <= int(text) <= high):
            raise ArgumentTypeError(f"{text!r} is not {what} from {low} to {high}")
        return int(text)

    return parse


count: Callable[[str], int] = integer(1, 250, "a number of vehicles")
port: Callable[[str], int] = integer(0, 65535, "a port number")
system_id: Callable[[str], int] = integer(1, 255, "a system id")


_SHARE_FAULTS = ("loss", "loss_incoming")
FAULTS: tuple[str, ...] = (
    *("gps_lost", "rc_lost", "motor_failed", "silent", "frozen", "heartbeats_stopped", "leak", "no_ftp"),
    *_SHARE_FAULTS,
    "prearm_failures",
)
"""Names of `aerokit.sim.Faults` that ``aerokit sim --fault`` accepts, described in docs/simulator.md."""


TRANSMITTER_ON_S = 1.0
"""Earliest time of the fault ``rc_lost``, because ArduPilot ignores a transmitter that it has never received."""


class FaultOption(NamedTuple):
    """A fault given on the command line. ``at_s`` is its start in simulated seconds."""

    name: str
    value: bool | float | list[str]
    at_s: float


def fault(text: str) -> FaultOption:
    """Parse ``NAME[=VALUE][@SECONDS]``."""
    name_and_value, _, begin_text = text.partition("@")
    name, equals, value = name_and_value.partition("=")
    if name not in FAULTS:
        raise ArgumentTypeError(f"{name!r} is not a fault{suggestion(name, FAULTS)}; faults: {', '.join(FAULTS)}")
    at_s = number(0, 1e6)(begin_text) if begin_text else 0.0
    if name == "rc_lost":  # ArduPilot ignores the loss of a transmitter that it has never received
        at_s = max(at_s, TRANSMITTER_ON_S)
    if name in _SHARE_FAULTS:
        if not value:
            raise ArgumentTypeError(f"{name} needs the share of frames to lose: {name}=0.2")
        return FaultOption(name, number(0, 1)(value), at_s)
    if name == "prearm_failures":
        if not value:
            raise ArgumentTypeError("prearm_failures needs a reason: 'prearm_failures=Compass not healthy'")
        return FaultOption(name, [value], at_s)
    if equals:
        raise ArgumentTypeError(f"{name} takes no value; {name}@5 begins after 5 simulated seconds")
    return FaultOption(name, True, at_s)


def wind(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    gusts_m_s = values[2] if len(values) == 3 else 0.0
    is_in_range = gusts_m_s >= 0 and all(abs(value) <= _MAX_WIND_M_S for value in values)
    if len(values) not in (2, 3) or not is_in_range:
        raise ArgumentTypeError(
            f"{text!r} is not NORTH,EAST or NORTH,EAST,GUSTS with numbers in m/s up to {_MAX_WIND_M_S:g}"
        )
    return values


def picture(text: str) -> str:
    from aerokit.testing.picture import check_picture

    try:
        check_picture(text)
    except AerokitError as error:
        raise ArgumentTypeError(str(error)) from None
    return writable_file(text)


def number(low: float, high: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan  # NaN is in no range
        if not low <= value <= high:
            raise ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
        return value

    return parse


def add_number(
    command: argparse._ActionsContainer,
    name: str,
    low: float,
    high: float,
    metavar: str,
    text: str,
    *,
    default: float | None = None,
) -> None:
    """Add an option or argument for a number from ``low`` to ``high``. The help text ends with the default, if any."""
    shown_default = "" if default is None else f" (default: {default:g})"
    command.add_argument(name, type=number(low, high), default=default, metavar=metavar, help=f"{text}{shown_default}")


def add_repeatable(command: argparse._ActionsContainer, name: str, metavar: str, text: str, **keywords: Any) -> None:
    """Add an option that can be given several times. Its value is a list."""
    command.add_argument(name, action="append", default=[], metavar=metavar, help=f"{text} (repeatable)", **keywords)


def add_system_id(command: argparse._ActionsContainer) -> None:
    command.add_argument(
        "--system-id", type=system_id, metavar="ID", help="system id of the vehicle (default: the only one)"
    )


def assignment(text: str) -> tuple[str, int | float]:
    """Parse ``NAME=VALUE`` for a parameter.

    Integers may be hexadecimal (0x1F).
    """
    name, equals, value = text.partition("=")
    if not equals:
        raise ArgumentTypeError(f"{text!r} has no value; expected NAME=VALUE, without spaces")
    try:
        number = parse_number(value)
    except ValueError:
        raise ArgumentTypeError(f"the value in {text!r} is not a finite number; expected NAME=VALUE") from None
    try:
        checked_value(check_name(name), number, ParameterType.REAL32)  # called only for the errors that it raises
    except InvalidArgument as error:
        raise ArgumentTypeError(str(error)) from None
    return name, number


def parameter(text: str) -> tuple[str, float]:
    name, number = assignment(text)
    return name.upper(), float(number)


def home(text: str) -> tuple[float, float, float]:
    try:
        latitude, longitude, altitude = (float(part) for part in text.split(","))
        geo.check_place(latitude, longitude)
    except InvalidArgument as error:
        raise ArgumentTypeError(str(error)) from None
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is not LAT,LON,ALT in degrees and metres") from None
    if not math.isfinite(altitude):
        raise ArgumentTypeError(f"{text!r} has no finite altitude in metres")
    return latitude, longitude, altitude


def writable_file(text: str) -> str:
    path = Path(text)
    if path.is_dir() or not path.parent.is_dir():
        reason = "the path is a directory" if path.is_dir() else f"directory {str(path.parent)!r} does not exist"
        raise ArgumentTypeError(f"{text!r} cannot be written: {reason}")
    return text


def log_file(text: str) -> str:
    if is_address(text):
        raise ArgumentTypeError(f"{text!r} is an address; the recording must follow the address: ADDRESS flight.tlog")
    if not text.lower().endswith(".tlog"):
        raise ArgumentTypeError(f"{text!r} is not a name for a recording, because it does not end in .tlog")
    return writable_file(text)


def directory(text: str) -> Path:
    """Parse the path of a directory, which need not exist yet."""
    path = Path(text)
    for directory_path in (path, *path.parents):
        if directory_path.exists() and not directory_path.is_dir():
            raise ArgumentTypeError(f"{text!r} cannot be created: {str(directory_path)!r} is a file")
    return path


def add_vehicle_kind(command: argparse.ArgumentParser, kinds: str) -> None:
    kind = command.add_argument(
        "--vehicle", type=vehicle_kind, default="copter", metavar="KIND", help=f"simulated vehicle: {kinds}"
    )
    set_completions(kind, kind_names)


def add_baud(command: argparse._ActionsContainer) -> None:
    help_text = "baud rate of serial ports whose address has none (default: 57600)"
    command.add_argument("--baud", type=int, default=57600, help=help_text)


def add_record(command: argparse._ActionsContainer) -> None:
    command.add_argument(
        "--record",
        type=log_file,
        metavar="FILE",
        help="record all messages: flight.tlog (an existing file is kept as flight.1.tlog)",
    )


def add_faults(command: argparse._ActionsContainer) -> None:
    faults = command.add_argument(
        "--fault",
        action="append",
        type=fault,
        default=[],
        dest="faults",
        metavar="NAME[=VALUE][@S]",
        help="fault of every simulated vehicle, from the start or after S simulated seconds (repeatable):"
        f" {', '.join(FAULTS)}; loss=0.2 loses a fifth of the frames, 'prearm_failures=TEXT' refuses to arm",
    )
    set_completions(faults, lambda: FAULTS)


def add_conditions(command: argparse._ActionsContainer) -> None:
    parameters = command.add_argument(
        "--parameter",
        action="append",
        type=parameter,
        default=[],
        dest="parameters",
        metavar="NAME=VALUE",
        help="parameter value instead of its default (repeatable): MNT1_TYPE=1 gives the copter's autopilot a gimbal",
    )
    set_completions(parameters, assignments)
    command.add_argument(
        "--wind",
        type=wind,
        metavar="NORTH,EAST[,GUSTS]",
        help="velocity of the air and of gusts in m/s: -3,0 (default: no wind)",
    )
    command.add_argument("--battery", type=number(0, 100), metavar="PERCENT", help="charge at the start (default: 100)")
    add_faults(command)


def conditions(options: argparse.Namespace) -> dict[str, Any]:
    """Convert the options of `add_conditions` to arguments of a simulated vehicle."""
    from aerokit.sim import SimulatedWind

    arguments: dict[str, Any] = {}
    if options.battery is not None:
        arguments["battery_percent"] = options.battery
    if options.wind is not None:
        arguments["wind"] = SimulatedWind(*options.wind)
    if options.parameters:
        arguments["parameters"] = dict(options.parameters)
    return arguments
