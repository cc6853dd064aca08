"""``Readiness``: which attributes have values, and waiting until they do."""

from __future__ import annotations

import math
import threading
import time
from typing import TYPE_CHECKING

from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Readiness"]

LONGEST_WAIT_S = 0.2
"""Waits are cut into slices: Ctrl-C and the end of the link are noticed between them."""


class Readiness:
    """What is ready is what was told at least once. Any thread may use it.

    ``check`` raises when nothing will come any more, ``review`` is called when something else has become ready.
    """

    def __init__(self, check: Callable[[], object], review: Callable[[], None]) -> None:
        self._check, self._review = check, review
        self.names: set[str] = set()
        """What has values."""
        self.seekers: dict[str, Callable[[], None]] = {}
        """What is called while somebody waits for a name that does not come by itself."""
        self._failures: dict[str, APIException] = {}
        self._changed = threading.Condition()

    def mark(self, name: str) -> None:
        """The attribute has a value: whoever waits for it goes on."""
        with self._changed:
            self._failures.pop(name, None)
            self.names.add(name)
            self._changed.notify_all()
        self._review()

    def note(self, name: str) -> None:
        """The attribute has a value, as it may have had before."""
        if name not in self.names:
            self.mark(name)

    def unmark(self, name: str) -> None:
        """The attribute will get a new value, and is to be waited for."""
        with self._changed:
            self._failures.pop(name, None)
            self.names.discard(name)
        self._review()

    def fail(self, name: str, error: APIException) -> None:
        """The attribute will get no value: whoever waits for it is told why."""
        with self._changed:
            self._failures[name] = error
            self._changed.notify_all()

    def wait(
        self,
        wanted: set[str],
        timeout: float | None,
        raise_exception: bool,
        tell_missing: Callable[[set[str]], object] | None,
        interval: float,
    ) -> bool:
        """See ``Vehicle.wait_ready``."""
        started = told_at = time.monotonic()
        deadline = math.inf if timeout is None else started + timeout
        while missing := wanted - self.names:
            now = time.monotonic()
            if now >= deadline:
                if raise_exception:
                    error = TimeoutError(f"wait_ready experienced a timeout after {timeout} seconds.")
                    raise error from LookupError(f"never told: {', '.join(sorted(missing))}")
                return False
            self._check()
            if (failure := self._failure_of(missing)) is not None:
                if raise_exception:
                    raise type(failure)(str(failure)) from failure.__cause__
                return False
            for name in self.seekers.keys() & missing:
                self.seekers[name]()
            if tell_missing is not None and now >= told_at + interval:
                told_at = now
                tell_missing(missing)
            self._wait_a_little(wanted, deadline - now)
        return True

    def _failure_of(self, names: set[str]) -> APIException | None:
        return next((self._failures[name] for name in names if name in self._failures), None)

    def _wait_a_little(self, wanted: set[str], at_most_s: float) -> None:
        with self._changed:
            missing = wanted - self.names
            if missing and self._failure_of(missing) is None:
                self._changed.wait(min(LONGEST_WAIT_S, at_most_s))
