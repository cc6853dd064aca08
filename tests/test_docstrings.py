"""Every public name has a docstring: modules, what they export, and the public members of what they export."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import aerokit
from aerokit.mavlink.message import Message

MODULES = [
    "aerokit",
    *sorted(module.name for module in pkgutil.walk_packages(aerokit.__path__, "aerokit.")),
]
MODULES.remove("aerokit.__main__")  # running it is all it is for
FOR_PROGRAMS = (
    "aerokit.transport",
    "aerokit.mavlink",
    "aerokit.connection",
    "aerokit.sync",
    "aerokit.testing",
)
"""Where programs find constants; elsewhere they are the standard's numbers under the standard's names."""


def exported(module: ModuleType) -> list[str]:
    names: list[str] = list(getattr(module, "__all__", []))
    return names or [name for name in vars(module) if not name.startswith("_")]


def own(module: ModuleType) -> Iterator[tuple[str, object]]:
    """The functions and classes that a module exports and that are its own."""
    for name in exported(module):
        item = getattr(module, name)
        if (inspect.isclass(item) or inspect.isfunction(item)) and item.__module__ == module.__name__:
            yield name, item


def members_without_docstring(cls: type) -> Iterator[str]:
    for name, member in vars(cls).items():
        if name.startswith("_"):
            continue
        if isinstance(member, (classmethod, staticmethod)):
            member = member.__func__
        is_property = isinstance(member, property) or type(member).__name__ == "cached_property"
        if (is_property or inspect.isfunction(member)) and not has_docstring(cls, name):
            yield name


def has_docstring(cls: type, name: str) -> bool:
    """Its own, or that of what it overrides."""
    return any(vars(base)[name].__doc__ for base in cls.__mro__ if name in vars(base))


def constants_without_docstring(path: Path, names: set[str]) -> Iterator[str]:
    """Exported constants, in upper case, without a string behind them."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    for statement, after in zip(body, [*body[1:], None], strict=True):
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else []
        if isinstance(statement, ast.Assign):
            targets = [target for target in statement.targets if isinstance(target, ast.Name)]
        for target in targets:
            if not isinstance(target, ast.Name) or target.id not in names or not target.id.isupper():
                continue
            if not (isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)):
                yield target.id


@pytest.mark.parametrize("name", MODULES)
def test_public_names_have_docstrings(name: str) -> None:
    module = importlib.import_module(name)
    missing = [] if module.__doc__ else [name]
    for item_name, item in own(module):
        if not item.__doc__ or (inspect.isclass(item) and item.__doc__.startswith(f"{item_name}(")):
            missing.append(item_name)
        if inspect.isclass(item) and not issubclass(item, Message):  # their decode and encode: see Message
            missing += [f"{item_name}.{member}" for member in members_without_docstring(item)]
    assert module.__file__ is not None
    if name.startswith(FOR_PROGRAMS):
        missing += constants_without_docstring(Path(module.__file__), set(exported(module)))
    assert not missing, f"without docstring in {name}: {', '.join(missing)}"


def test_generated_messages_and_enums_have_docstrings() -> None:
    from aerokit import enums, messages

    for package, least in ((messages, 300), (enums, 200)):
        names = [name for name in package.__all__ if name[0].isupper()]
        assert len(names) >= least
        undocumented = [name for name in names if not vars(getattr(package, name)).get("__doc__")]
        assert not undocumented
