"""The hub benchmark runs and writes its report; its figures are not tested."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
PEER = os.environ.get("AEROKIT_MAVPROXY_PYTHON")


def run(*arguments: str, peer: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "benchmarks/hub.py", *arguments]
    env = {**os.environ, "AEROKIT_MAVPROXY_PYTHON": peer}
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False, env=env)


@pytest.mark.exhaustive
def test_aerokit_alone_forwards_everything(tmp_path: Path) -> None:
    """Without a competitor the only row is that of the floor; the test checks that no frame was lost."""
    path = tmp_path / "bench.json"
    done = run("--quick", "out_4", "latency_p99", "--output", str(path), peer="/nowhere/python")
    assert done.returncode == 0, done.stderr
    assert "out_4 aerokit: " in done.stderr
    assert [row["name"] for row in json.loads(path.read_text())] == ["out_4_floor"]


def test_wrong_name_is_refused() -> None:
    wrong = run("out_5", peer="")
    assert wrong.returncode == 2
    assert "out_1, out_4" in wrong.stderr


@pytest.mark.skipif(PEER is None, reason="AEROKIT_MAVPROXY_PYTHON names no interpreter that has MAVProxy")
def test_row_compares_with_mavproxy(tmp_path: Path) -> None:
    path = tmp_path / "bench.json"
    assert run("--quick", "out_1", "--output", str(path), peer=PEER or "").returncode == 0
    rows: list[dict[str, Any]] = json.loads(path.read_text())
    assert [(row["name"], row["peer_name"], row["aim"]) for row in rows] == [
        ("out_1", "MAVProxy --out", 10.0),
        ("out_1_floor", "reading and writing", 0.0),
    ]
