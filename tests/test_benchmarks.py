"""The benchmarks run and write their tables; measured values are not checked."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import aerokit

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
HAS_MAVSDK = importlib.util.find_spec("mavsdk") is not None
AIMS = {
    "decode_skip": 50.0 if aerokit.wire_implementation == "c" else 10.0,
    "decode_typed": 18.0 if aerokit.wire_implementation == "c" else 6.0,
    "command_rtt_pymavlink": 0.667,
    "command_rtt_mavsdk": 1.667,
    "import": 0.667,
}


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "benchmarks/run.py", *arguments]
    return subprocess.run(command, cwd=BENCHMARKS.parent, capture_output=True, text=True, timeout=200, check=False)


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict[str, Any]], str]:
    """Return rows and table of a run with few rounds."""
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    done = run("--quick", "--output", str(path))
    assert done.returncode == 0, done.stderr
    return json.loads(path.read_text()), done.stdout


@pytest.mark.exhaustive
def test_benchmark_rows_have_names_figures_and_aims(quick: tuple[list[dict[str, Any]], str]) -> None:
    rows = {row["name"]: row for row in quick[0]}
    expected = {name: aim for name, aim in AIMS.items() if name != "command_rtt_mavsdk" or HAS_MAVSDK}
    assert {name: rows[name]["aim"] for name in expected} == expected
    for row in rows.values():
        assert row["aerokit"] > 0
        assert row["peer"] > 0
        assert row["ratio"] > 0
        assert row["peer_name"]


@pytest.mark.exhaustive
def test_benchmark_table_shows_all_rows(quick: tuple[list[dict[str, Any]], str]) -> None:
    rows, table = quick
    lines = table.splitlines()
    for row in rows:
        (line,) = [line for line in lines if line.split()[0] == row["name"]]
        assert ("MISSED" in line) == (row["ratio"] < row["aim"])
    assert ("command_rtt_mavsdk: omitted, because its peer is not installed" in lines) == (not HAS_MAVSDK)


@pytest.mark.exhaustive
def test_benchmark_rows_can_be_selected(tmp_path: Path) -> None:
    done = run("--quick", "--output", str(tmp_path / "bench.json"), "import")
    assert done.returncode == 0
    assert [row["name"] for row in json.loads((tmp_path / "bench.json").read_text())] == ["import"]
    wrong = run("imports")
    assert wrong.returncode == 2
    assert "decode_skip, decode_typed" in wrong.stderr


@pytest.mark.exhaustive
def test_transfer_benchmarks_compare_with_ideal(tmp_path: Path) -> None:
    path = tmp_path / "bench.json"
    done = subprocess.run(
        [sys.executable, "benchmarks/transfers.py", "--quick", "--library", "aerokit", "--library", "pymavlink",
         "--output", str(path), "mission_download"],
        cwd=BENCHMARKS.parent, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "failed" not in done.stdout, done.stderr
    (row,) = json.loads(path.read_text())
    assert row["name"] == "transfer_mission_download_loss_0_pymavlink_items"
    assert row["aerokit"] > 0
    assert row["peer"] > 0
