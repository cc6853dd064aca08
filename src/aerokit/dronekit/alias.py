"""``install``: the name ``dronekit`` for :mod:`aerokit.dronekit`, in this process and only when asked for."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.abc import Loader, MetaPathFinder
    from types import ModuleType
else:
    Loader = MetaPathFinder = object  # importing them would take longer than all the rest of this package

__all__ = ["install", "uninstall"]

ALIAS, PACKAGE = "dronekit", "aerokit.dronekit"
SITL_ALIAS, SITL_MODULE = "dronekit_sitl", "aerokit.dronekit.sitl"


def install() -> None:
    """Have ``import dronekit`` and ``from dronekit.lib import …`` mean :mod:`aerokit.dronekit` from now on.

    ``import dronekit_sitl`` means :mod:`aerokit.dronekit.sitl`, unless another one was imported before.

    For test runners (in ``conftest.py``) and embedding programs. A DroneKit that is installed, but was not imported
    yet, is not looked for any more. Calling it again changes nothing.

    Raises:
        ImportError: another ``dronekit`` was imported already.
    """
    package = importlib.import_module(PACKAGE)
    present = sys.modules.get(ALIAS)
    if present is package:
        return
    if present is not None:
        where = getattr(present, "__file__", None) or "somewhere"
        raise ImportError(
            f"another dronekit was imported already, from {where}: call aerokit.dronekit.install() before anything"
            " imports it",
            name=ALIAS,
        )
    sys.modules[ALIAS] = package
    sys.meta_path.insert(0, _SubmoduleFinder())


def uninstall() -> None:
    """Undo :func:`install`; what was imported meanwhile stays as it is. Nothing happens without it."""
    if sys.modules.get(ALIAS) is not sys.modules.get(PACKAGE):
        return
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _SubmoduleFinder)]
    for name in list(sys.modules):
        if name == ALIAS or (_own_name(name) and sys.modules[name] is sys.modules.get(_own_name(name) or "")):
            del sys.modules[name]


def _own_name(name: str) -> str | None:
    """What a module is called here; None: it is none of ours."""
    if name == SITL_ALIAS:
        return SITL_MODULE
    return PACKAGE + name.removeprefix(ALIAS) if name.startswith(f"{ALIAS}.") else None


class _SubmoduleFinder(MetaPathFinder):
    """``dronekit.mavlink`` is the module ``aerokit.dronekit.mavlink``, not a second one made of the same file."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        own_name = _own_name(fullname)
        if own_name is None:
            return None
        spec = importlib.util.find_spec(own_name)
        return None if spec is None else ModuleSpec(fullname, _SubmoduleLoader(), origin=spec.origin)


class _SubmoduleLoader(Loader):
    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(_own_name(spec.name) or spec.name)
        self._own_spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = (
            self._own_spec
        )  # it was executed under its own name; the import system has changed this
