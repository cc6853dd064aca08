"""``dronekit.monotonic``: the clock that programs found there."""

from __future__ import annotations
