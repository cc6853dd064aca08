"""``needed``: the module of an extra that a link cannot do without."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from aerokit.errors import LinkOpenError

__all__ = ["needed"]


def needed(address: str, module: str, package: str, extra: str) -> Any:
    """Import it; LinkOpenError with what to install when it is not there."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise LinkOpenError(
            f"cannot open {address}: this needs {package}, which is not installed:"
            f" pip install 'aerokit-mavlink[{extra}]'"
        ) from error
