"""``dronekit.util``: printing to stderr, and a logging handler that prints."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable


def errprinter(*args: object) -> None:
    """Print to stderr."""
    print(*args, file=sys.stderr)  # noqa: T201
    sys.stderr.flush()


def logger(*args: object) -> None:
    """Alias of :func:`errprinter`."""
    errprinter(*args)


class ErrprinterHandler(logging.Handler):
    """Logging handler that passes each formatted record to a function, such as :func:`errprinter`."""

    def __init__(self, errprinter: Callable[[str], object]) -> None:
        super().__init__()
        self.errprinter = errprinter

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self.errprinter(self.format(record))
        except Exception:
            self.handleError(record)
