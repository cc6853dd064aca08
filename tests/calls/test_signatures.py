"""Names, order, types and defaults of all public calls: `signatures.txt` keeps them."""

from __future__ import annotations

import inspect
from pathlib import Path

from public_surface import members

KEPT = Path(__file__).with_name("signatures.txt")


def test_no_signature_changes_unnoticed() -> None:
    """After a change that is meant: write ``now`` into the file, and a line into CHANGELOG.md."""
    now = [f"{each.qualified}{inspect.signature(inspect.unwrap(each.function))}" for each in members()]
    assert sorted(set(now)) == KEPT.read_text().splitlines()
