"""The examples of the reference run, and readers can copy each alone."""

from __future__ import annotations

import re
from pathlib import Path

import pages
import pytest

EXAMPLES = pages.ROOT / "docs" / "reference-examples.md"
CHAINS = [pytest.param(chain, id=f"line-{chain[0].line}") for chain in pages.chains(EXAMPLES)]
NAMES = re.findall(r"^## (\S+)$", EXAMPLES.read_text(encoding="utf-8"), re.MULTILINE)
MIN_EXAMPLES = 50
MAX_LINES = 10


@pytest.mark.sampled(2)
@pytest.mark.parametrize("chain", CHAINS)
def test_examples_run(chain: pages.Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pages.run(chain, tmp_path)


def test_examples_are_short_and_one_for_each_name() -> None:
    blocks = pages.blocks(EXAMPLES)
    assert MIN_EXAMPLES <= len(blocks) == len(NAMES) == len(set(NAMES))
    assert all(len(block.body.strip().splitlines()) <= MAX_LINES for block in blocks)


def test_examples_import_what_they_use() -> None:
    """Readers see each example alone, so it has its imports, and no names of other examples except ``vehicle``."""
    for name, block in zip(NAMES, pages.blocks(EXAMPLES), strict=True):
        assert pages.free_names([block]) <= {"vehicle"}, name
