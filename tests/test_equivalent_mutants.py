"""``tests/mutants/equivalent.json`` explains changes of lines that exist."""

from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).parent.parent
MAX_LINES = 8  # of one statement


def test_explained_changes_are_of_existing_lines() -> None:
    entries = json.loads((ROOT / "tests" / "mutants" / "equivalent.json").read_text())
    lines = {
        path: [line.strip() for line in (ROOT / "src" / "aerokit" / path).read_text().splitlines()]
        for path in {entry["path"] for entry in entries}
    }
    statements = {
        (path, " ".join(stripped[begin : begin + count]))
        for path, stripped in lines.items()
        for begin in range(len(stripped))
        for count in range(1, MAX_LINES)
    }
    assert [entry for entry in entries if (entry["path"], entry["old"]) not in statements] == []
