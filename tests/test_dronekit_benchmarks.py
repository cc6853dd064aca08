"""The comparison with DroneKit runs and writes its rows; the tests do not check the figures."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
PEER = os.environ.get("AEROKIT_DRONEKIT_PYTHON")


def rows_of(path: Path, *arguments: str) -> list[dict[str, Any]]:
    command = [sys.executable, "benchmarks/dronekit_compare.py", "--quick", "--output", str(path), *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    rows: list[dict[str, Any]] = json.loads(path.read_text())
    return rows


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("part", "case"), [("connect", "mavftp_0ms"), ("latency", "v2_500"), ("cpu", "usual_udp_v2_100")]
)
def test_benchmark_tasks_run_with_aerokit(part: str, case: str, tmp_path: Path) -> None:
    """Without DroneKit there are no rows; the tasks must run without errors."""
    assert rows_of(tmp_path / "bench.json", part, "--only", case, "--peer", "none") == []


@pytest.mark.skipif(PEER is None, reason="AEROKIT_DRONEKIT_PYTHON names no interpreter that has DroneKit")
def test_benchmark_row_compares_with_dronekit(tmp_path: Path) -> None:
    (row,) = rows_of(tmp_path / "bench.json", "cpu", "--only", "usual_udp_v2_100", "--peer", "dronekit")
    assert (row["name"], row["peer_name"], row["aim"]) == (
        "dronekit_cpu_usual_udp_v2_100",
        "DroneKit 2.9.2",
        4.0,
    )
    assert row["aerokit"] > 0
    assert row["peer"] > 0
