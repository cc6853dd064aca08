"""What arguments may look like: functions for argparse, which turns their errors into exit code 2."""

from __future__ import annotations

import argparse
import math
import re
from argparse import ArgumentTypeError
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal import geo
from aerokit.apps.cli.completers import kinds as kind_names
from aerokit.apps.cli.completers import offer
from aerokit.errors import AerokitError, InvalidArgument
from aerokit.parameters import ParameterType, check_name, checked_value
from aerokit.parameters.encoding import parse_number
from aerokit.transport import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable

EACH_ITS_OWN = "tcpin:127.0.0.1:{5760+10n}"
"""As SITL numbers its instances: 5760, 5770, 5780 and so on."""

_FORM = re.compile(r"\{(?:(\d{1,5})\+)?(\d{0,3})(n|id)\}")


def each_with_its_own(address: str) -> bool:
    """Whether the address is a form, which gives each vehicle a link of its own."""
    return _FORM.search(address) is not None


def place_of(address: str, number: int, system_id: int) -> str:
    """The address of one vehicle: ``n`` counts from 0, ``id`` is its system id; ``{5760+10n}`` reckons with them."""

    def value(match: re.Match[str]) -> str:
        start, factor, name = match.groups()
        return str(int(start or 0) + int(factor or 1) * (number if name == "n" else system_id))

    return _FORM.sub(value, address)


def address(text: str) -> str:
    """A connection string."""
    try:
        parse_address(text)
    except InvalidArgument as error:
        raise ArgumentTypeError(str(error)) from None
    return text


def address_or_form(text: str) -> str:
    """A connection string, or a form of one for several vehicles."""
    address(place_of(text, 0, 1))
    return text


def vehicle_kind(text: str) -> str:
    """A kind of simulated vehicle, or a recording of one."""
    from aerokit.sim.kinds import kind_class

    if text.endswith(".tlog"):
        if not Path(text).is_file():
            raise ArgumentTypeError(f"there is no recording {text!r}")
        return text
    try:
        kind_class(text)
    except InvalidArgument as error:
        raise ArgumentTypeError(str(error)) from None
    return text


def count(text: str) -> int:
    """How many vehicles."""
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 250):
        raise ArgumentTypeError(f"{text!r} is not a number of vehicles: 1 to 250")
    return int(text)


def wind(text: str) -> tuple[float, ...]:
    """North, east, and perhaps gusts."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    within = all(abs(value) <= 50 for value in values) and min(values[2:], default=0) >= 0
    if len(values) not in (2, 3) or not within:
        raise ArgumentTypeError(f"{text!r} is not NORTH,EAST or NORTH,EAST,GUSTS in m/s, up to 50")
    return values


def picture(text: str) -> str:
    """A path of a picture."""
    from aerokit.sim.picture import check_picture

    try:
        check_picture(text)
    except AerokitError as error:
        raise ArgumentTypeError(str(error)) from None
    return writable_file(text)


def number(low: float, high: float) -> Callable[[str], float]:
    """A number from ``low`` to ``high``."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
        return value

    return parse


def assignment(text: str) -> tuple[str, int | float]:
    """``NAME=VALUE``, a parameter and what it may be set to; whole numbers also as 0x1F."""
    name, mark, value = text.partition("=")
    try:
        number = parse_number(value if mark else "")
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is not NAME=VALUE with a finite number") from None
    try:
        checked_value(check_name(name), number, ParameterType.REAL32)
    except InvalidArgument as error:
        raise ArgumentTypeError(str(error)) from None
    return name, number


def parameter(text: str) -> tuple[str, float]:
    """The same of a simulated vehicle, whose names are in capitals."""
    name, number = assignment(text)
    return name.upper(), float(number)


def system_id(text: str) -> int:
    """A MAVLink system id."""
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 255):
        raise ArgumentTypeError(f"{text!r} is not a system id: 1 to 255")
    return int(text)


def home(text: str) -> tuple[float, float, float]:
    """Latitude, longitude, altitude."""
    try:
        latitude, longitude, altitude = (float(part) for part in text.split(","))
        geo.check_place(latitude, longitude)
    except InvalidArgument as error:
        raise ArgumentTypeError(str(error)) from None
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is not LAT,LON,ALT in degrees and metres") from None
    if not math.isfinite(altitude):
        raise ArgumentTypeError(f"{text!r} has no altitude in metres")
    return latitude, longitude, altitude


def writable_file(text: str) -> str:
    """A path in a directory that is there."""
    path = Path(text)
    if path.is_dir() or not path.parent.is_dir():
        raise ArgumentTypeError(f"{text!r} cannot be written: it is a directory, or its directory is missing")
    return text


def directory(text: str) -> Path:
    """A directory that is there."""
    path = Path(text)
    if not path.is_dir():
        raise ArgumentTypeError(f"{text!r} is no directory that is there")
    return path


def add_vehicle_kind(command: argparse.ArgumentParser, kinds: str) -> None:
    """Add ``--vehicle KIND``; ``kinds`` lists them."""
    kind = command.add_argument(
        "--vehicle", type=vehicle_kind, default="copter", metavar="KIND", help=f"simulated: {kinds}"
    )
    offer(kind, kind_names)


def add_baud(
    command: argparse._ActionsContainer, whose: str = "a serial port whose address says none"
) -> None:
    """Add ``--baud``."""
    command.add_argument("--baud", type=int, default=57600, help=f"of {whose} (57600)")
