"""The two errors of the DroneKit API."""

from __future__ import annotations

import builtins

__all__ = ["APIException", "TimeoutError"]


class APIException(Exception):
    """Any failure of the vehicle or its link; an aerokit error behind it is its `__cause__` or `__context__`."""


class TimeoutError(APIException, builtins.TimeoutError):  # noqa: A001 - the name is DroneKit's
    """The awaited answer or state did not come in time; the built-in `TimeoutError` catches it too."""
