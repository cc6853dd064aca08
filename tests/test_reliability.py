"""docs/reliability.md, verification.md and firmware.md cite only test files and tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PAGES = [TESTS.parent / "docs" / f"{name}.md" for name in ("reliability", "verification", "firmware", "benchmarks")]


def code_spans(page: Path) -> list[str]:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"`([^`\n]+)`", text)


def test_cited_tests_exist() -> None:
    sources = [path.read_text(encoding="utf-8") for path in TESTS.rglob("test_*.py")]
    existing = set(re.findall(r"^ *(?:async )?def (test_\w+)", "\n".join(sources), flags=re.MULTILINE))
    cited = {span for page in PAGES for span in code_spans(page) if re.fullmatch(r"test_\w+", span)}
    assert len(cited) > 100
    assert cited <= existing, f"rename them in the pages: {sorted(cited - existing)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_cited_test_files_exist(page: Path) -> None:
    files = [path.relative_to(TESTS).as_posix() for path in TESTS.rglob("*.py")]
    cited = [
        match["path"]
        for span in code_spans(page)
        for match in re.finditer(r"(?<![\w/])(?P<path>(?:\w+/)*test_\w+\.py)", span)
    ]
    missing = [path for path in cited if not any(f"/tests/{file}".endswith(f"/{path}") for file in files)]
    assert not missing, "these files do not exist below tests/"
