"""Exchanges that people depend on look on the wire as they always did: each is recorded and compared, line by line."""

from __future__ import annotations

import difflib
from pathlib import Path

import pytest
from golden_scenes import SCENES, recorded

HERE = Path(__file__).parent


@pytest.mark.parametrize("name", SCENES)
def test_golden_trace(name: str) -> None:
    path = HERE / f"{name}.txt"
    kept = path.read_text(encoding="utf-8") if path.exists() else ""
    now = recorded(name)
    diff = difflib.unified_diff(kept.splitlines(), now.splitlines(), path.name, "now", lineterm="")
    assert kept == now, "\n".join((*diff, f"if the change is intended: python tests/golden/record.py {name}"))


def test_each_golden_trace_has_a_scene() -> None:
    assert {path.stem for path in HERE.glob("*.txt")} == set(SCENES)
