"""``install``: the name ``dronekit`` for :mod:`aerokit.dronekit`, in this process and only when asked for."""

from __future__ import annotations

import importlib
import sys

__all__ = ["install", "uninstall"]

PACKAGE = "aerokit.dronekit"
SUBMODULES = ("lib", "mavlink", "monotonic", "util")
"""Those that programs import."""


def install() -> None:
    """Have ``import dronekit`` and ``from dronekit.lib import …`` mean :mod:`aerokit.dronekit` from now on.

    For test runners (in ``conftest.py``) and embedding programs. A DroneKit that is installed, but was not imported
    yet, is not looked for any more. Calling it again changes nothing.

    Raises:
        ImportError: another ``dronekit`` was imported already.
    """
    package = importlib.import_module(PACKAGE)
    present = sys.modules.get("dronekit")
    if present is not None and present is not package:
        where = getattr(present, "__file__", None) or "somewhere"
        raise ImportError(
            f"another dronekit was imported already, from {where}: call aerokit.dronekit.install() before anything"
            " imports it",
            name="dronekit",
        )
    for name in SUBMODULES:
        sys.modules[f"dronekit.{name}"] = importlib.import_module(f"{PACKAGE}.{name}")
    sys.modules["dronekit"] = package


def uninstall() -> None:
    """Undo :func:`install`; what was imported meanwhile stays as it is. Nothing happens without it."""
    if sys.modules.get("dronekit") is not sys.modules.get(PACKAGE):
        return
    for name in ("dronekit", *(f"dronekit.{each}" for each in SUBMODULES)):
        sys.modules.pop(name, None)
