"""The reason for an end, raised in front of everyone who waited for something that will not come any more."""

from __future__ import annotations

import copy
from typing import TypeVar

__all__ = ["raisable"]

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
