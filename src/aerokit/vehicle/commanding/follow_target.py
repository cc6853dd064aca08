"""Targets of :meth:`aerokit.Vehicle.follow`."""

from __future__ import annotations

from collections.abc import AsyncIterable, Callable
from typing import Any, Protocol, runtime_checkable

from aerokit.position import Position


@runtime_checkable
class HasTelemetry(Protocol):
    """A vehicle of the asynchronous or the blocking API."""

    @property
    def telemetry(self) -> Any: ...


FollowTarget = HasTelemetry | AsyncIterable[Position] | Callable[[], Position | None]
"""A vehicle, an asynchronous iterable of positions, or a function that returns the latest position or None."""
