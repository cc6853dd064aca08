"""The layers in docs/design.md: a file imports only from layers below its own."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

from for_each import for_each

SOURCE = Path(__file__).parent.parent / "src" / "aerokit"

FLOORS = [
    {"errors", "_internal"},
    {"position"},
    {"mavlink"},
    {"parameters", "missions", "autopilots", "transport", "events"},
    {"protocols"},
    {"connection", "sim"},
    {"hub"},
    {"vehicle", "onboard"},
    {"fleets"},
    {"sync", "video", "logs"},
    {"dronekit"},
    {"testing"},
    {"apps"},
]
ROOMS = {
    "vehicle": [
        {"state"},
        {"session"},
        {"commanding"},
        {"devices", "gimbal"},
        {"rtk"},
        {"external"},
        {"files"},
        {"parameters", "missions"},
        {"calibration"},
        {"components"},
        {"camera"},
        {"vehicle"},
        {"connect"},
    ],
}
"""Layers within some packages, lowest first; other files are layers of their own."""
ALLOWED_BESIDE = {
    ("sim", "autopilots"),
    ("sim", "transport"),
    ("errors", "_internal"),
    ("_internal", "errors"),
}
REEXPORTED = {"messages": "mavlink", "enums": "mavlink", "__version__": "errors"}
SANS_IO = ("mavlink", "parameters", "missions", "protocols", "autopilots")
NO_IO = {"asyncio", "anyio", "socket", "threading", "time", "logging", "select", "selectors", "subprocess"}
SOCKETS = {"socket", "serial", "serial_asyncio"}


def floor_of(package: str) -> int:
    return next(i for i, floor in enumerate(FLOORS) if package in floor)


def package_of(path: Path) -> str:
    return path.relative_to(SOURCE).with_suffix("").parts[0]


@functools.cache
def import_statements(path: Path) -> tuple[ast.Import | ast.ImportFrom, ...]:
    """Return all import statements, at any depth. The tree is not kept: collecting garbage among all trees is slow."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return tuple(node for node in statements(tree.body) if isinstance(node, (ast.Import, ast.ImportFrom)))


def statements(body: Iterable[Any]) -> Iterator[ast.stmt]:
    """Yield these statements and all within them."""
    for node in body:
        if isinstance(node, ast.stmt):
            yield node
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            if inner := getattr(node, field, None):
                yield from statements(inner)


@functools.cache
def imports_of(path: Path) -> list[str]:
    """Return absolute names of all imports, type-checking imports included."""
    found: list[str] = []
    for node in import_statements(path):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
            continue
        base = node.module or ""
        if node.level:
            parts = ("aerokit", *path.relative_to(SOURCE).parts)[: -node.level]
            base = ".".join((*parts, *([base] if base else [])))
        if base == "aerokit":
            found += [f"aerokit.{alias.name}" for alias in node.names]
        else:
            found.append(base)
    return found


FILES = sorted(
    path
    for path in SOURCE.rglob("*.py")
    if path.parent != SOURCE or path.stem not in ("__init__", "__main__", "messages", "enums")
)


@for_each("path", FILES)
def test_packages_import_only_lower_layers(path: Path) -> None:
    own = package_of(path)
    for name in imports_of(path):
        if not name.startswith("aerokit."):
            continue
        other = name.split(".")[1]
        if other == own or (own, other) in ALLOWED_BESIDE:
            continue
        other = REEXPORTED.get(other, other)
        assert floor_of(other) < floor_of(own), f"{own} may not import {name}"


@for_each("path", FILES)
def test_only_some_layers_do_io(path: Path) -> None:
    own, tops = package_of(path), {name.split(".")[0] for name in imports_of(path)}
    if own in SANS_IO:
        assert not tops & NO_IO
    if own != "transport":
        assert not tops & SOCKETS
    imported = {name.split(".")[1] for name in imports_of(path) if name.startswith("aerokit.")}
    assert own in ("testing", "apps") or "testing" not in imported


VEHICLE_FILES = [path for path in FILES if package_of(path) == "vehicle"]


@for_each("path", VEHICLE_FILES)
def test_subpackages_import_only_lower_ones(path: Path) -> None:
    rooms = ROOMS["vehicle"]
    own = path.relative_to(SOURCE).with_suffix("").parts[1]

    def height(room: str) -> int:
        return next(i for i, floor in enumerate(rooms) if room in floor)

    for name in imports_of(path):
        parts = name.split(".")
        if parts[:2] == ["aerokit", "vehicle"] and len(parts) > 2 and parts[2] != own:
            assert height(parts[2]) < height(own), f"vehicle/{own} may not import {name}"


def test_imports_have_no_cycles() -> None:
    """Type-checking imports and imports inside functions count as well."""
    trees = {
        ".".join(("aerokit", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__"): path
        for path in SOURCE.rglob("*.py")
        if path.parent.name not in ("messages", "enums")  # generated, checked separately
    }
    graph: dict[str, set[str]] = {}
    for module, path in trees.items():
        graph[module] = set()
        for node in import_statements(path):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = (f"{node.module}.{alias.name}" for alias in node.names)
                graph[module] |= {name if name in trees else node.module for name in names}
            elif isinstance(node, ast.Import):
                graph[module] |= {alias.name for alias in node.names}
        graph[module] &= trees.keys() - {module}
    TopologicalSorter(graph).prepare()
