"""Run every block of Python in README.md and docs/; `helpers/pages.py` has the rules."""

from __future__ import annotations

from pathlib import Path

import pages
import pytest
from for_each import for_each

LANGUAGES = {"python", "sh", "text", "json", "json5", "yaml", "toml", "ini", "xml", "powershell", "mermaid"}
READ_FIRST = ("README.md", "docs/index.md", "docs/tutorial.md", "docs/how-to/")
CHAINS = [
    pytest.param(
        chain,
        id=f"{chain[0].page.relative_to(pages.ROOT)}:{chain[0].line}".replace("/", "-"),
        marks=[] if page.relative_to(pages.ROOT).as_posix().startswith(READ_FIRST) else pytest.mark.exhaustive,
    )
    for page in pages.pages()
    for chain in pages.chains(page)
]
WITH_CODE = [page for page in pages.pages() if pages.blocks(page)]


@pytest.mark.sampled(3)
@pytest.mark.parametrize("chain", CHAINS)
def test_block_runs(chain: pages.Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pages.run(chain, tmp_path)


@for_each("page", WITH_CODE)
def test_blocks_of_page_follow_rules(page: Path) -> None:
    given = {"vehicle"} if pages.has_vehicle_rule(page) else set()
    before = None
    for block in pages.blocks(page):
        where = f"{page.name}, line {block.line}"
        assert block.language in LANGUAGES, f"{where}: ```{block.language} (allowed: {', '.join(sorted(LANGUAGES))})"
        if block.language == "python":
            assert block.title in ("", "continued") or block.title.endswith(".py"), f"{where}: title {block.title}"
            if block.title == "continued":
                assert before is not None, f"{where}: nothing to continue"
                assert not before.is_for_pytest, f"{where}: a file for pytest is not continued"
            before = block
    for chain in pages.chains(page):
        missing = pages.free_names(chain) - given
        assert not missing, f"{page.name}, line {chain[0].line}: no import shown of {', '.join(sorted(missing))}"
