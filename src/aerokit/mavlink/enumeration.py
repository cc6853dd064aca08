"""How the generated enum modules and run-time dialects make an enum of a table row."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum, IntFlag
from typing import Any

__all__ = ["make_enum"]


def make_enum(
    module: str, name: str, bitmask: bool, doc: str, members: Iterable[tuple[str, int]]
) -> type[Any]:
    """An ``IntFlag`` for a bitmask, else an ``IntEnum``; two names for one value are aliases."""
    base: Any = IntFlag if bitmask else IntEnum
    enum: type[Any] = base(name, list(members), module=module, qualname=name)
    enum.__doc__ = doc
    return enum
