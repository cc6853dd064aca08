"""Numbers as text: the shortest that gives the same 32-bit number again, and strict reading."""

from __future__ import annotations

import math
import re

from aerokit.parameters.parameter import to_float32

__all__ = ["number_text", "parse_number"]

_INTEGER = re.compile(r"[+-]?[0-9]{1,999}")
_HEXADECIMAL = re.compile(r"0[xX][0-9a-fA-F]{1,999}")
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def number_text(value: float) -> str:
    """``0.1`` for the 32-bit number nearest to 0.1, ``3`` for 3.0; all digits of an int.

    Raises OverflowError beyond 32-bit numbers, and ValueError for NaN.
    """
    if isinstance(value, int):
        return str(int(value))
    if value == int(value) and abs(value) < 1e9:
        return "-0.0" if str(value) == "-0.0" else str(int(value))
    number = to_float32(value)
    candidates = (f"{number:.{digits}g}" for digits in range(6, 10))
    return next(text for text in candidates if to_float32(float(text)) == number)


def parse_number(text: str) -> int | float:
    """An int or a float; ValueError for anything else, NaN and infinities included."""
    if _INTEGER.fullmatch(text):
        return int(text)
    if _HEXADECIMAL.fullmatch(text):
        return int(text, 16)
    if not _DECIMAL.fullmatch(text):
        raise ValueError(text)
    number = float(text)
    if math.isinf(number):  # 1e999
        raise ValueError(text)
    return number
