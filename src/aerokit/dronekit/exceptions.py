"""The two errors of the DroneKit API, and how errors of aerokit become such."""

from __future__ import annotations

import builtins
from collections.abc import Iterator
from contextlib import contextmanager

from aerokit.errors import AerokitError, FileFormatError, InvalidArgument, OperationTimeout


class APIException(Exception):
    """Any failure of the vehicle or its link; an aerokit error behind it is its `__cause__` or `__context__`."""


class TimeoutError(APIException, builtins.TimeoutError):  # noqa: A001 - the name is DroneKit's
    """The awaited answer or state did not come in time; the built-in `TimeoutError` catches it too."""


@contextmanager
def classic_errors() -> Iterator[None]:
    """What aerokit raises in the block becomes one of these; an argument or a file that is wrong stays a ValueError."""
    try:
        yield
    except (InvalidArgument, FileFormatError):
        raise
    except OperationTimeout as error:
        raise TimeoutError(str(error)) from error
    except AerokitError as error:
        raise APIException(str(error)) from error
