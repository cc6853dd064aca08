"""Modules have docstrings, and so has what the reference of the documentation has: functions, classes, their methods.

Private and nested functions, dunder methods and properties are not asked for one: some names say all.
"""

from __future__ import annotations

import ast
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
    module = importlib.import_module(name)
    missing = [*without_docstring(module), *constants_without_docstring(module)]
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


def constants_without_docstring(module: ModuleType) -> Iterator[str]:
    """Exported constants, in upper case, that are made in this module, without a string behind them."""
    assert module.__file__ is not None
    body = ast.parse(Path(module.__file__).read_text(encoding="utf-8")).body
    for statement, after in zip(body, [*body[1:], None], strict=True):
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else []
        if isinstance(statement, ast.Assign):
            targets = [target for target in statement.targets if isinstance(target, ast.Name)]
        for target in targets:
            if not isinstance(target, ast.Name) or target.id not in module.__all__ or not target.id.isupper():
                continue
            if not (isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)):
                yield target.id


def test_generated_messages_and_enums_have_docstrings() -> None:
    from aerokit import enums, messages

    for package, least in ((messages, 300), (enums, 200)):
        names = [name for name in package.__all__ if name[0].isupper()]
        assert len(names) >= least
        undocumented = [name for name in names if not vars(getattr(package, name)).get("__doc__")]
        assert not undocumented
