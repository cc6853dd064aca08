"""Lines run by each test: a test file runs once under coverage, again only when it or the sources change."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
SOURCE = ROOT / "src" / "aerokit"
CACHE = ROOT / ".mutants"
PYTEST = ("-n", "0", "-p", "no:cacheprovider", "-q", "-rfE", "-o", "addopts=-p no:asyncio")


AT_IMPORT = ""


@dataclass
class Reach:
    """Lines run by the measured tests, and their durations."""

    seconds: dict[str, float] = field(default_factory=dict)
    by_line: dict[tuple[str, int], set[str]] = field(default_factory=dict)
    by_file: dict[str, set[str]] = field(default_factory=dict)

    def tests_of(self, path: str, lines: Iterable[int]) -> set[str]:
        return set().union(*(self.by_line.get((path, line), set()) for line in lines)) - {AT_IMPORT}

    def add(self, seconds: dict[str, float], lines: dict[str, dict[str, list[int]]]) -> None:
        self.seconds.update(seconds)
        for test, files in lines.items():
            for path, numbers in files.items():
                for number in numbers:
                    self.by_line.setdefault((path, number), set()).add(test)
                if test != AT_IMPORT:
                    self.by_file.setdefault(path, set()).add(test)


def measure(test_files: Iterable[Path]) -> Reach:
    """Run the test files that were not measured yet, each in a process of its own."""
    reach, sources = Reach(), _digest(SOURCE.rglob("*.py"))
    CACHE.mkdir(exist_ok=True)
    for path in test_files:
        name = str(path.relative_to(ROOT)).replace(os.sep, "__")
        result = CACHE / f"{name}.{sources}.{_digest([path])}.json"
        if not result.exists():
            sys.stdout.write(f"measuring {path.relative_to(ROOT)}\n")
            sys.stdout.flush()
            _run(path, result)
        reach.add(**json.loads(result.read_text()))
    return reach


def _run(test_file: Path, result: Path) -> None:
    environment = os.environ | {
        "AEROKIT_REACH_SOURCE": str(SOURCE),
        "AEROKIT_REACH_RESULT": str(result),
        "PYTHONPATH": os.pathsep.join(filter(None, (str(HERE), os.environ.get("PYTHONPATH")))),
    }
    command = [sys.executable, "-m", "pytest", "-p", "reach_plugin", *PYTEST, "--timeout=0", str(test_file)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 5):
        sys.stdout.write(f"some tests fail without any mutant, and are left out:\n{done.stdout[-1500:]}\n")


def _digest(paths: Iterable[Path]) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(paths))).hexdigest()[:12]
