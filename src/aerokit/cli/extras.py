"""What commands need beyond aerokit itself: packages of an extra, asked for when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from aerokit.cli.exits import NotInstalled

__all__ = ["need"]


def need(module: str, extra: str) -> Any:
    """Import a module of an extra.

    Raises:
        NotInstalled: it is not there; the text says what to install.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise NotInstalled(
            f"this needs {error.name}, which is not installed: pip install 'aerokit-mavlink[{extra}]'"
        ) from None
