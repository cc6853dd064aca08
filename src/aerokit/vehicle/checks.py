"""Checks of arguments, before anything is sent."""

from __future__ import annotations

from aerokit.errors import InvalidArgument
from aerokit.wording import one, shown

__all__ = ["check_kind", "check_range"]


def check_kind(name: str, value: object, kind: type) -> None:
    """Raise InvalidArgument unless ``value`` is of that class: where type hints say "of the same kind" only."""
    if not isinstance(value, kind):
        raise InvalidArgument(f"{name} = {shown(value)} is not allowed: {one(kind.__name__)}")


def check_range(name: str, value: float, lowest: float, highest: float, *, above: bool = False) -> None:
    """Raise InvalidArgument unless ``value`` is from ``lowest`` (with ``above``: above it) to ``highest``."""
    try:
        is_allowed = lowest <= value <= highest and not (above and value == lowest)
    except TypeError:
        is_allowed = False
    if not is_allowed:
        begin = f"above {lowest:g}" if above else f"{lowest:g}"
        raise InvalidArgument(f"{name} = {shown(value)} is not allowed: {begin} to {highest:g}")
