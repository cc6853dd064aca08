"""The reason for an end, raised in front of everyone who waited for something that will not come any more."""

from __future__ import annotations

import copy
import logging
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.runtime.bus import Detach

    Ender = Callable[[Exception], object]

__all__ = ["Ending", "raisable"]

logger: logging.Logger = logging.getLogger("aerokit")

ErrorT = TypeVar("ErrorT", bound=BaseException)


def raisable(error: ErrorT) -> ErrorT:
    """A copy of a kept error, to be raised once.

    One object raised again and again would gather the tracebacks of all who got it, keep their frames alive and pass
    the context of one task to the next. ``__cause__`` says why, as in the original.
    """
    try:
        fresh = copy.copy(error)
    except Exception:  # its constructor wants more than its args tell
        return error.with_traceback(None)
    fresh.__cause__, fresh.__suppress_context__ = error.__cause__, error.__suppress_context__
    return fresh


class Ending:
    """Whether something has ended, by what, and who is told when it does."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        """What has ended it; None: it goes on."""
        self._enders: list[Ender] = []

    def raise_if_ended(self) -> None:
        """Raise what has ended it, if it has ended."""
        if self.error is not None:
            raise raisable(self.error)

    def on_end(self, ender: Ender) -> Detach:
        """Have ``ender(error)`` called at the end; at once if it has ended already."""
        if self.error is not None:
            ender(self.error)
            return _nothing
        self._enders.append(ender)

        def detach() -> None:
            if ender in self._enders:
                self._enders.remove(ender)

        return detach

    def tell(self, error: Exception) -> None:
        """Tell everybody that it has ended by this error."""
        enders, self._enders = self._enders, []
        for ender in enders:
            try:
                ender(error)
            except Exception:
                logger.exception("a mistake at the end of a connection; the others are told all the same")


def _nothing() -> None:
    pass
