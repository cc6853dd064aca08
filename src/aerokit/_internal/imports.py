"""Whether what is installed as ``aerokit`` is this library alone.

PyPI has another project of this name, for compressible flow. Its files go to the same folder as ours, so that
installing both leaves a mixture of which neither may work.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module

_OTHERS = ("aero", "engine", "stability")
"""Packages that only the other project has: ``aerokit.aero`` and so on."""


def complaint(folder: str, *, is_ours: bool = True) -> str | None:
    """What is wrong with the files in the folder of the package, and what to do; None: nothing.

    ``is_ours`` says whether the package's ``__init__`` was this library's.
    """
    others = [name for name in _OTHERS if os.path.isfile(os.path.join(folder, name, "__init__.py"))]
    if is_ours and not others:
        return None
    found = f"aerokit.{others[0]}" if others else "its __init__.py"
    return (
        f"files of another project called aerokit ({found}) are mixed into this one in {folder}:"
        " run pip uninstall aerokit aerokit-mavlink, then pip install aerokit-mavlink, the one for drones"
    )


def lazy_exports(
    package: str, exports: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package, whose names are imported when they are first used.

    ``exports`` has the names by module; a name that its module does not have is the module itself. The package repeats
    them as ``import name as name`` under TYPE_CHECKING, because type checkers do not run this.
    """
    homes = {name: module for module, names in exports.items() for name in names}

    def find(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = import_module(homes[name])
        value = getattr(home, name, home)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return find, names, sorted(homes)
