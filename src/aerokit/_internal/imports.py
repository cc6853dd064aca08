"""Lazy package exports, and detection of files of PyPI's other project called aerokit."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module

# Packages such as ``aerokit.aero``, which only an unrelated PyPI project called aerokit has.
_OTHER_PACKAGES = ("aero", "engine", "stability")

# Modules whose names users often look up in the package: aerokit.LinkLost instead of aerokit.errors.LinkLost.
_NAMED_MODULES = ("aerokit.errors", "aerokit.events")


def installation_problem(folder: str, *, is_ours: bool = True) -> str | None:
    """Describe what is wrong with the installation in ``folder``; None if nothing is wrong.

    ``is_ours`` is True if the ``__init__.py`` there is this library's.
    """
    # PyPI has another project called aerokit, for compressible flow. Both projects install into the same folder, so
    # neither may work if both are installed.
    other_packages = [name for name in _OTHER_PACKAGES if os.path.isfile(os.path.join(folder, name, "__init__.py"))]
    if is_ours and not other_packages:
        return None
    mixed_in = f"aerokit.{other_packages[0]}" if other_packages else "its __init__.py"
    return (
        f"files of another project called aerokit ({mixed_in}) are mixed into this one in {folder}:"
        " run pip uninstall aerokit aerokit-mavlink, then pip install aerokit-mavlink, the one for drones"
    )


def _suggestion(package: str, name: str) -> str:
    if package != "aerokit" or name.startswith("_"):
        return ""
    for module in _NAMED_MODULES:
        if name in import_module(module).__all__:
            return f": did you mean {module}.{name}?"
    return ""


def lazy_exports(
    package: str, exports: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Create ``__getattr__``, ``__dir__`` and ``__all__`` of a package that imports its names on first use.

    ``exports`` maps each module to the names to import from it. A name that the module does not define is
    exported as the module itself.
    """
    # For type checkers, the package repeats the names as `import name as name` under TYPE_CHECKING.
    modules = {name: module for module, names in exports.items() for name in names}

    def get_attribute(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}{_suggestion(package, name)}")
        module = import_module(modules[name])
        value = getattr(module, name, module)
        setattr(sys.modules[package], name, value)  # Later accesses find this attribute first.
        return value

    def list_names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *modules})

    return get_attribute, list_names, sorted(modules)
