"""How the generated enum modules and run-time dialects make an enum of a table row."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import Any

_QUICKLY: Any = getattr(enum, "_simple_enum", None)
"""How the standard library makes its own long enums since Python 3.11: the same enum in half the time."""


class _Flags(enum.IntFlag):
    """Bits in any mix. Python would keep each mix that it has met, and they come off the air."""

    @classmethod
    def _missing_(cls, value: object) -> Any:
        made = super()._missing_(value)
        cls._value2member_map_.pop(value, None)
        return made


def make_enum(
    module: str,
    name: str,
    bitmask: bool,
    doc: str,
    members: Iterable[tuple[str, int]],
    *,
    is_from_outside: bool = False,
) -> type[Any]:
    """An ``IntFlag`` for a bitmask, else an ``IntEnum``; two names for one value are aliases.

    Raises:
        TypeError, ValueError: of one ``is_from_outside``: a name stands there twice, or Python keeps it for itself.
    """
    base: Any = _Flags if bitmask else enum.IntEnum
    made: type[Any]
    if _QUICKLY is not None and not is_from_outside:
        body = {"__module__": module, "__qualname__": name, "__doc__": doc, **dict(members)}
        made = _QUICKLY(base)(type(name, (), body))
    else:
        made = base(name, list(members), module=module, qualname=name)
        made.__doc__ = doc
    return made
