"""The exceptions of the DroneKit API, and their conversion from errors of aerokit."""

from __future__ import annotations

import builtins
from collections.abc import Iterator
from contextlib import contextmanager

from aerokit.errors import AerokitError, FileFormatError, InvalidArgument, OperationTimeout


class APIException(Exception):
    """The vehicle or its link failed. The error of aerokit is the ``__cause__`` or ``__context__``."""


class TimeoutError(APIException, builtins.TimeoutError):  # noqa: A001 - the name is DroneKit's
    """An answer or a state did not arrive in time. ``except`` with the built-in ``TimeoutError`` catches it, too."""


@contextmanager
def classic_errors() -> Iterator[None]:
    """Convert errors of aerokit to those of DroneKit."""
    try:
        yield
    except (InvalidArgument, FileFormatError):  # Errors about arguments and files stay ValueErrors.
        raise
    except OperationTimeout as error:
        raise TimeoutError(str(error)) from error
    except AerokitError as error:
        raise APIException(str(error)) from error
