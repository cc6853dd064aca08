"""Names and docstrings follow CONTRIBUTING's style: unique classes, MAX_ limits, plain first lines, short tests."""

from __future__ import annotations

import functools
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Names fixed by others: MAVLink's messages, the classic DroneKit API, and the blocking twins of asyncio classes.
GENERATED = ("src/aerokit/mavlink/messages/", "src/aerokit/mavlink/enums/")
FIXED_ELSEWHERE = (*GENERATED, "src/aerokit/dronekit/", "src/aerokit/sync/")
FOLDERS = ("src/aerokit", "tests", "benchmarks", "examples")

MAX_TEST_WORDS = 10
CLASS = re.compile(r"^ *class ([A-Za-z]\w*)\b", re.MULTILINE)
CONSTANT = re.compile(r"^ *(_?[A-Z][A-Z0-9_]*)(?:, _?[A-Z][A-Z0-9_]*)*(?:: [^=\n]+)? = ", re.MULTILINE)
LIMIT = re.compile(
    r"^_?(MOST|LONGEST|SHORTEST|LEAST|SOONEST|LATEST|LOOK|AGAIN|ASK|SAID|TOLD|KNOWN|HEARD)(_|$)"
    r"|_(AGAIN|TOLD|HEARD|LOOK)_S$"
)
FIRST_WORD = re.compile(r'^ *r?"""((?:What|Who|Whom|Whose|Whether|Of|That)\b.*)$', re.MULTILINE)
TEST = re.compile(r"^(?:async )?def (test_\w+)", re.MULTILINE)


@functools.cache
def sources() -> dict[str, str]:
    paths = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    texts = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in paths}
    return {path: text for path, text in texts.items() if not path.startswith(GENERATED)}


def found(pattern: re.Pattern[str], folder: str = "") -> Iterator[tuple[str, str]]:
    for path, text in sources().items():
        if path.startswith(folder):
            yield from ((path, match[1]) for match in pattern.finditer(text))


def test_public_class_names_are_unique() -> None:
    places = defaultdict(list)
    for path, name in found(CLASS, "src/"):
        if not path.startswith(FIXED_ELSEWHERE):
            places[name].append(path)
    assert {name: paths for name, paths in places.items() if len(paths) > 1} == {}


def test_constants_use_standard_words_for_limits() -> None:
    assert [(path, name) for path, name in found(CONSTANT) if LIMIT.search(name)] == []


def test_docstrings_begin_with_plain_statement() -> None:
    assert list(found(FIRST_WORD)) == []


def test_test_names_have_at_most_ten_words() -> None:
    assert [place for place in found(TEST, "tests/") if len(place[1].split("_")) > MAX_TEST_WORDS + 1] == []


@pytest.mark.parametrize("name", ["MOST_ROUTES", "LOOK_S", "SAID_AGAIN_S", "TOLD"])
def test_private_dialect_in_limit_is_found(name: str) -> None:
    (constant,) = CONSTANT.findall(f"{name} = 1\n")
    assert LIMIT.search(constant)
