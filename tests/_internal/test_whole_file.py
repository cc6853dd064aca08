"""`write_atomically` never writes through a symbolic link."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from aerokit._internal.files import write_atomically


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_atomic_write_does_not_follow_link(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "report.html.part").symlink_to(victim)
    write_atomically(tmp_path / "report.html", "text")
    assert victim.read_text() == "precious"
    assert not (tmp_path / "report.html").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "victim"]
