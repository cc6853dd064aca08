"""The numbers that decide things: constants of all modules, and defaults of functions; `numbers.txt` keeps them.

Times, limits and counts are chosen, many of them by measurements on real firmware. A test that asks for each of them
would say the same twice; what this says is that none changes by accident.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import aerokit
from aerokit._internal.values import Snapshot

KEPT = Path(__file__).with_name("numbers.txt")
ROOMS = ("autopilots", "transport", "mavlink", "protocols", "connection", "vehicle")
LEFT_OUT = ("aerokit.mavlink.messages", "aerokit.mavlink.enums", "aerokit.mavlink.additions")
LONG = 1000
"""Tables that are longer are worked out from others, or have tests of their own."""
SIMPLE = (bool, int, float, str, bytes, type(None))


@pytest.mark.skipif(sys.platform != "linux", reason="some are the system's own")
def test_no_number_changes_unnoticed() -> None:
    """After a change that is meant: write ``now`` into the file, and see to it that tests say what it is for."""
    now = sorted({line for module in modules() for line in lines_of(module)})
    assert now == KEPT.read_text(encoding="utf-8").splitlines()


def modules() -> Iterator[ModuleType]:
    for room in ROOMS:
        package = importlib.import_module(f"{aerokit.__name__}.{room}")
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not found.name.startswith(LEFT_OUT):
                yield importlib.import_module(found.name)


def lines_of(module: ModuleType) -> Iterator[str]:
    for name in assigned_in(module):
        value = getattr(module, name)
        if name.strip("_").isupper() and is_simple(value) and not isinstance(value, (str, bytes)):
            line = f"{module.__name__} {name} = {shown(value)}"
            if len(line) < LONG:
                yield line
    for name, value in vars(module).items():
        if getattr(value, "__module__", "") == module.__name__:
            yield from defaults_in(value, f"{module.__name__} {name}")


def assigned_in(module: ModuleType) -> Iterator[str]:
    """Names that it gives a value, and does not import."""
    for node in ast.parse(inspect.getsource(module)).body:
        for target in getattr(node, "targets", [getattr(node, "target", None)]):
            for each in getattr(target, "elts", [target]):
                if isinstance(each, ast.Name):
                    yield each.id


def defaults_in(value: Any, where: str) -> Iterator[str]:
    if inspect.isclass(value):
        members: dict[str, Any] = dict(vars(value))
        if issubclass(value, Snapshot):  # which writes its constructor when it is first needed
            members.pop("__init__", None)
            yield from (
                f"{where}({name}={shown(each)})"
                for name, each in vars(value)["_defaults"].items()
                if is_simple(each)
            )
        for name, member in members.items():
            if inspect.isfunction(member) or isinstance(member, (classmethod, staticmethod)):
                yield from defaults_in(getattr(value, name), f"{where}.{name}")
    elif inspect.isfunction(value) or inspect.ismethod(value):
        for each in inspect.signature(inspect.unwrap(value)).parameters.values():
            if each.default is not each.empty and is_simple(each.default):
                yield f"{where}({each.name}={shown(each.default)})"


def is_simple(value: Any) -> bool:
    if isinstance(value, (tuple, frozenset)):
        return all(map(is_simple, value))
    if isinstance(value, Mapping):
        return all(is_simple(each) for pair in value.items() for each in pair)
    return isinstance(value, SIMPLE)


def shown(value: Any) -> str:
    """In one order and one spelling, whatever the version of Python."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(sorted(f'{shown(key)}: {shown(each)}' for key, each in value.items()))}}}"
    if isinstance(value, (tuple, frozenset)):
        inside = [shown(each) for each in value]
        return f"({', '.join(inside if isinstance(value, tuple) else sorted(inside))})"
    return repr(int(value)) if isinstance(value, int) and not isinstance(value, bool) else repr(value)
