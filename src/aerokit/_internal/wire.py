"""Selects the code for frames and messages at import: compiled (`aerokit._wire`, from ``_wire.c``) or pure Python.

The Python code is the reference, and is used where the extension is not built, was built from other sources, or is
switched off by the environment variable ``AEROKIT_PURE=1``.
"""

from __future__ import annotations

import os
from importlib import import_module
from types import MemberDescriptorType
from typing import TYPE_CHECKING, Any

_VERSION = 2  # Must equal VERSION in _wire.c, so that an outdated build of the extension is not used.


def _load() -> Any:
    """Return the compiled module; None if it is missing, out of date, or turned off by AEROKIT_PURE."""
    if os.environ.get("AEROKIT_PURE", "") not in ("", "0"):
        return None
    try:
        module = import_module("aerokit._wire")
    except ImportError:
        return None
    return module if getattr(module, "VERSION", None) == _VERSION else None


wire: Any = _load()
"""The module `aerokit._wire`, or None."""

wire_implementation: str = "python" if wire is None else "c"
"""``"c"`` if frames and messages are processed by the compiled extension, ``"python"`` if by Python code."""


# Without the compiled extension, these classes define the slots of frames, of their sources and of counters.
class _FrameFields:
    __slots__ = ("_body", "_raw", "checksum", "component_id", "message_id", "received_at", "system_id")


# In the extension, `body` is computed from `_raw` when it is first read. In Python, it is another name of the slot
# `_body`, which the framer sets for each frame.
_FrameFields.body = _FrameFields._body  # type: ignore[attr-defined]


class _SourceFields:
    __slots__ = ("expected",)


class _CounterFields:
    __slots__ = ("bytes",)


class Copyable:
    """Mixin: supports copying and pickling for classes with fields that the compiled extension defines."""

    __slots__ = ()

    def __getstate__(self) -> tuple[None, dict[str, Any]]:
        # Python's own method does not find compiled fields, because they are not declared in __slots__.
        names = (
            name
            for cls in type(self).__mro__
            for name, value in vars(cls).items()
            if isinstance(value, MemberDescriptorType) and hasattr(self, name)
        )
        return None, {name: getattr(self, name) for name in names}


# Base classes of frames, sources and counters, with the fields that compiled code accesses directly.
if TYPE_CHECKING:

    class FrameFields: ...

    class SourceFields: ...

    class CounterFields: ...
elif wire is None:
    FrameFields, SourceFields, CounterFields = _FrameFields, _SourceFields, _CounterFields
else:
    FrameFields, SourceFields, CounterFields = (
        type(base.__name__, (Copyable, base), {"__slots__": ()})
        for base in (wire.FrameFields, wire.SourceFields, wire.CounterFields)
    )
