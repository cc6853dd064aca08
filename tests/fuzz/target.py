"""`Target`: a function that takes bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["FuzzOne", "Target"]

FuzzOne = Callable[[bytes], None]


@dataclass(frozen=True)
class Target:
    """``fuzz_one`` raises AssertionError, or any other error, for a fault. ``longest`` is the maximum input size."""

    name: str
    fuzz_one: FuzzOne
    longest: int = 1024

    def __call__(self, data: bytes) -> None:
        self.fuzz_one(data[: self.longest])
