"""``wait_ready``: waiting until attributes have values."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.attributes import VehicleAttributes
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["DEFAULT_ATTRIBUTES", "Readiness"]

DEFAULT_ATTRIBUTES = ("parameters", "gps_0", "armed", "mode", "attitude")
"""What ``wait_ready(True)`` waits for."""
LONGEST_WAIT_S = 0.2
"""Waits are cut into slices: Ctrl-C and the end of the link are noticed between them."""


class Readiness(VehicleAttributes):
    """What is ready is what was told at least once."""

    def wait_ready(
        self,
        *types: str | bool,
        timeout: float | None = 30,
        raise_exception: bool = True,
        still_waiting_callback: Callable[[set[str]], object] | None = None,
        still_waiting_interval: float = 1,
        **_: Any,
    ) -> bool:
        """Wait until these attributes have values; without names, or with True, for those that most programs need.

        Args:
            types: names of attributes, your own too; ``wait_ready(True)`` is ``'parameters'``, ``'gps_0'``,
                ``'armed'``, ``'mode'`` and ``'attitude'``.
            timeout: seconds; None waits as long as the link lives.
            raise_exception: whether to raise when the time is over.
            still_waiting_callback: called with the names that are missing.
            still_waiting_interval: how often, in seconds.

        Returns:
            Whether all of them have values.

        Raises:
            TimeoutError: they have not in time, and ``raise_exception`` is true.
            ValueError: a name is no text.
            APIException: the link is down, or what is waited for has failed.
        """
        names = DEFAULT_ATTRIBUTES if not types or types == (True,) else types
        if not all(isinstance(name, str) for name in names):
            raise ValueError("wait_ready expects one or more string arguments.")
        wanted = {str(name) for name in names}
        started = told_at = time.monotonic()
        deadline = math.inf if timeout is None else started + timeout
        while missing := wanted - self._ready_attrs:
            now = time.monotonic()
            if now >= deadline:
                if raise_exception:
                    error = TimeoutError(f"wait_ready experienced a timeout after {timeout} seconds.")
                    raise error from LookupError(f"never told: {', '.join(sorted(missing))}")
                return False
            self._dk_check_link()
            if (failure := self._dk_failure_of(missing)) is not None:
                if raise_exception:
                    raise type(failure)(str(failure)) from failure.__cause__
                return False
            self._dk_seek(missing)
            if still_waiting_callback is not None and now >= told_at + still_waiting_interval:
                told_at = now
                still_waiting_callback(missing)
            self._dk_wait_a_little(wanted, deadline - now)
        return True

    def _dk_seek(self, names: set[str]) -> None:
        """Have what is not coming by itself fetched."""
        for name in self._dk_seekers.keys() & names:
            self._dk_seekers[name]()

    def _dk_failure_of(self, names: set[str]) -> APIException | None:
        return next((self._dk_failures[name] for name in names if name in self._dk_failures), None)

    def _dk_wait_a_little(self, wanted: set[str], at_most_s: float) -> None:
        with self._dk_became_ready:
            missing = wanted - self._ready_attrs
            if missing and self._dk_failure_of(missing) is None:
                self._dk_became_ready.wait(min(LONGEST_WAIT_S, at_most_s))
