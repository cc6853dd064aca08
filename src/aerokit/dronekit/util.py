"""``dronekit.util``: printing to stderr, and a logging handler that prints."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable


def errprinter(*args: object) -> None:
    """Print the arguments to stderr, as ``print`` does."""
    print(*args, file=sys.stderr)  # noqa: T201 - it is all it is for
    sys.stderr.flush()


def logger(*args: object) -> None:
    """Print the arguments to stderr: another name of :func:`errprinter`."""
    errprinter(*args)


class ErrprinterHandler(logging.Handler):
    """A logging handler that gives each formatted record to a function, such as :func:`errprinter`."""

    def __init__(self, errprinter: Callable[[str], object]) -> None:
        super().__init__()
        self.errprinter = errprinter

    def emit(self, record: logging.LogRecord) -> None:
        """Hand the formatted record on."""
        try:
            self.errprinter(self.format(record))
        except Exception:
            self.handleError(record)
