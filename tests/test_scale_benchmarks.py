"""The benchmark of many simulated vehicles runs and writes its table; measured values are not checked."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "benchmarks/scale.py", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200, check=False)


@pytest.mark.exhaustive
def test_scale_benchmark_rows_have_figures_and_aims(tmp_path: Path) -> None:
    path = tmp_path / "scale.json"
    done = run("--quick", "--output", str(path))
    assert done.returncode == 0, done.stderr
    rows = {row["name"]: row for row in json.loads(path.read_text())}
    assert list(rows) == [
        "copter_hundred", "px4_hundred", "copter_flight", "px4_flight", "clients_1", "clients_3",
        "fleet_1", "fleet_3", "client_memory",
    ]  # fmt: skip
    for row in rows.values():
        assert row["aerokit"] > 0
        assert row["ratio"] > 0
        assert row["aim"] == (0.0 if row["name"].startswith(("clients_", "fleet_")) else 1.0)
        assert row["note"] in done.stdout
    assert rows["copter_hundred"]["vehicles"] <= rows["copter_hundred"]["aerokit"]


@pytest.mark.exhaustive
def test_scale_benchmark_rejects_unknown_name() -> None:
    wrong = run("copter")
    assert wrong.returncode == 2
    assert "copter_hundred, px4_hundred" in wrong.stderr
