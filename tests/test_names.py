"""Names and docstrings follow CONTRIBUTING's style: unique classes, MAX_ limits, plain first lines, short tests."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "aerokit"

# Names fixed by others: MAVLink's messages, the classic DroneKit API, and the blocking twins of asyncio classes.
FIXED_ELSEWHERE = ("mavlink/messages/", "mavlink/enums/", "dronekit/", "sync/")

MAX_TEST_WORDS = 10
LIMITS = re.compile(
    r"^_?(MOST|LONGEST|SHORTEST|LEAST|SOONEST|LATEST|LOOK|AGAIN|ASK|SAID|TOLD|KNOWN|HEARD)(_|$)|_(AGAIN|TOLD|HEARD|LOOK)_S$"
)
FIRST_WORDS = re.compile(r"^(What|Who|Whom|Whose|Whether|Of|That)\b")


def trees(*folders: str) -> Iterator[tuple[str, ast.Module]]:
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), ast.parse(path.read_text(encoding="utf-8"))


def test_public_class_names_are_unique() -> None:
    places = defaultdict(list)
    for path, tree in trees("src/aerokit"):
        if path.removeprefix("src/aerokit/").startswith(FIXED_ELSEWHERE):
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path)
    assert {name: paths for name, paths in places.items() if len(paths) > 1} == {}


def test_constants_use_standard_words_for_limits() -> None:
    found = [
        f"{path}: {target.id}"
        for path, tree in trees("src/aerokit", "tests", "benchmarks", "examples")
        for node in ast.walk(tree)
        if isinstance(node, (ast.Assign, ast.AnnAssign))
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name) and LIMITS.search(target.id)
    ]
    assert found == []


def test_docstrings_begin_with_plain_statement() -> None:
    found = [
        f"{path}: {docstring.splitlines()[0]}"
        for path, tree in trees("src/aerokit", "examples", "benchmarks", "tests")
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        if (docstring := ast.get_docstring(node)) and FIRST_WORDS.match(docstring)
    ]
    assert found == []


def test_test_names_have_at_most_ten_words() -> None:
    found = [
        f"{path}: {node.name}"
        for path, tree in trees("tests")
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        if node.name.startswith("test_") and len(node.name.split("_")) > MAX_TEST_WORDS + 1
    ]
    assert found == []


@pytest.mark.parametrize("name", ["MOST_ROUTES", "LOOK_S", "SAID_AGAIN_S", "TOLD"])
def test_limits_pattern_finds_private_dialect(name: str) -> None:
    assert LIMITS.search(name)
