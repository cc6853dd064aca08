"""Modules have docstrings, and so has what the reference of the documentation has: functions, classes, their methods.

Private and nested functions, dunder methods and properties are not asked for one: some names say all.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import runpy
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from for_each import for_each

import aerokit
from aerokit.mavlink.message import Message

ROOT = Path(aerokit.__file__).parents[2]
MODULES = [
    "aerokit",
    *sorted(module.name for module in pkgutil.walk_packages(aerokit.__path__, "aerokit.")),
]
MODULES.remove("aerokit.__main__")  # running it is all it is for
PUBLIC = [
    name
    for page in runpy.run_path(str(ROOT / "docs" / "site_reference.py"))["ROOMS"]
    for name in page.modules
]


@for_each("name", MODULES)
def test_modules_have_docstrings(name: str) -> None:
    assert importlib.import_module(name).__doc__


@for_each("name", PUBLIC)
def test_public_names_have_docstrings(name: str) -> None:
    missing = list(without_docstring(importlib.import_module(name)))
    assert not missing, f"without docstring: {', '.join(missing)}"


def without_docstring(module: ModuleType) -> Iterator[str]:
    """Exported functions and classes, and public methods of these, that have none."""
    for name in module.__all__:
        item = getattr(module, name)
        is_ours = getattr(item, "__module__", "").startswith("aerokit")
        if not is_ours or not (inspect.isclass(item) or inspect.isfunction(item)):
            continue
        if not item.__doc__ or item.__doc__.startswith(f"{name}("):  # what dataclass makes
            yield name
        if inspect.isclass(item) and not issubclass(item, Message):  # their decode and encode: see Message
            yield from (f"{name}.{method}" for method in methods_without_docstring(item))


def methods_without_docstring(cls: type) -> Iterator[str]:
    """Public ones of its own, unless what they override has one."""
    for name, member in vars(cls).items():
        member = member.__func__ if isinstance(member, (classmethod, staticmethod)) else member
        if name.startswith("_") or not inspect.isfunction(member):
            continue
        if not any(vars(base)[name].__doc__ for base in cls.__mro__ if name in vars(base)):
            yield name


def test_generated_messages_and_enums_have_docstrings() -> None:
    from aerokit import enums, messages

    for package, least in ((messages, 300), (enums, 200)):
        names = [name for name in package.__all__ if name[0].isupper()]
        assert len(names) >= least
        undocumented = [name for name in names if not vars(getattr(package, name)).get("__doc__")]
        assert not undocumented
