"""What arguments may look like: functions for argparse, which turns their errors into exit code 2."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit import geo
from aerokit.errors import LocalProtocolError
from aerokit.links import parse_address
from aerokit.parameters import check_name

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["address", "directory", "home", "number", "parameter", "system_id", "writable_file"]


def address(text: str) -> str:
    """A connection string."""
    try:
        parse_address(text)
    except LocalProtocolError as error:
        raise ArgumentTypeError(str(error)) from None
    return text


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


def parameter(text: str) -> tuple[str, float]:
    """``NAME=VALUE``."""
    name, _, value = text.partition("=")
    try:
        return check_name(name.upper()), float(value)
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is not NAME=VALUE, a parameter and a number") from None


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
    except LocalProtocolError as error:
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
