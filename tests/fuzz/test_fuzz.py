"""Runs each fuzz target on its corpus, and on a limited number of mutations; ``nox -s fuzz`` runs more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from exhaustive import exhaustive
from for_each import for_each
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from targets import TARGETS

HERE = Path(__file__).parent
CORPUS = HERE / "corpus"
RECOGNIZED = {name: [path.read_bytes() for path in sorted((CORPUS / name).iterdir())] for name in TARGETS}

edits = st.tuples(st.floats(0, 1), st.integers(0, 4), st.binary(max_size=4))
"""Position, number of bytes to remove there, and bytes to insert."""


def edited(data: bytes, changes: list[tuple[float, int, bytes]]) -> bytes:
    for place, cut, put in changes:
        at = int(place * len(data))
        data = data[:at] + put + data[at + cut :]
    return data


@pytest.mark.exhaustive
@for_each("path", sorted(CORPUS.glob("*/*")))
def test_known_fuzz_inputs(path: Path) -> None:
    TARGETS[path.parent.name](path.read_bytes())


@pytest.mark.sampled(4)
@pytest.mark.parametrize("examples", [8, exhaustive(40)])
@pytest.mark.parametrize("name", TARGETS)
def test_random_fuzz_inputs(name: str, examples: int) -> None:
    inputs = st.builds(edited, st.sampled_from(RECOGNIZED[name]), st.lists(edits, max_size=6)) | st.binary(max_size=300)

    @settings(max_examples=examples, phases=[Phase.generate], suppress_health_check=[HealthCheck.too_slow])
    @given(inputs)
    def fuzz(data: bytes) -> None:
        TARGETS[name](data)

    fuzz()


def test_corpus_folders_match_targets() -> None:
    assert {path.name for path in CORPUS.iterdir()} == set(TARGETS)


@pytest.mark.exhaustive
def test_fuzz_command_line_reports_crash(tmp_path: Path) -> None:
    command = [sys.executable, str(HERE / "fuzz.py"), "--plain", "--runs", "20", "address", "waypoints"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("all passed\n")
