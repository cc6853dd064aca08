"""README.md: programs, commands, links and pictures."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from for_each import for_each
from served_copter import served_copter

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
ADDRESS = "udpin:0.0.0.0:14550"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("number", [0, 1], ids=["async", "blocking"])
def test_readme_program_flies(number: int) -> None:
    program = blocks("python")[number]
    assert program.count(ADDRESS) == 1
    assert len([line for line in program.splitlines() if line.strip()]) <= 15
    with served_copter(speedup=40.0) as address:
        exec(compile(program.replace(ADDRESS, address), "README.md", "exec"), {"__name__": "__main__"})


def test_readme_has_two_programs() -> None:
    assert len(blocks("python")) == 2


def test_readme_commands_are_single_lines() -> None:
    install, *commands = [block.strip() for block in blocks("sh")]
    assert install == 'pip install "aerokit-mavlink @ file:///path/to/clone"'
    assert len(commands) == 2
    for command, last in zip(commands, ("aerokit demo", "pytest"), strict=True):
        assert "\n" not in command
        assert command.startswith("python3 -m venv .venv && .venv/bin/pip install ")
        assert command.endswith(f"&& .venv/bin/{last}")


def test_first_line_ending_in_pytest_is_test_command() -> None:
    # .ci/run takes this line.
    found = next(line for line in README.splitlines() if line.endswith("pytest"))
    assert found == blocks("sh")[2].strip()


DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def test_readme_and_changelog_are_short() -> None:
    assert len(README.splitlines()) <= 150
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) <= 120


@for_each("path", DOCUMENTS)
def test_link_target_exists(path: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{path.name} links to {target}"


@for_each("path", DOCUMENTS)
def test_picture_exists(path: Path) -> None:
    for source in re.findall(r'<img src="([^"]+)"', path.read_text(encoding="utf-8")):
        assert (path.parent / source).exists(), f"{path.name} shows {source}"


def test_first_screen_shows_flight_and_terminal() -> None:
    first = README.partition("```python")[0]
    assert len(first.splitlines()) < 20
    for name in ("demo", "terminal"):
        assert f'<img src="docs/images/{name}.svg"' in first
        assert (ROOT / "docs" / "images" / f"{name}.svg").stat().st_size < 60_000
