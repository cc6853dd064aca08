"""``dronekit.monotonic``: the clock that programs found there."""

from __future__ import annotations

from time import monotonic

__all__ = ["monotonic"]
