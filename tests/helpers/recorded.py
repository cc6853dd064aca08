"""Recorded traffic of real firmware: long recordings outside the repository if available, else short ones in it."""

from __future__ import annotations

from pathlib import Path

import pytest

__all__ = ["LONG", "SHORT", "headline", "path_of", "recording"]

ROOT = Path(__file__).parents[2]
LONG = ROOT.parent / "shared" / "traces"
"""Complete flights, which are not part of the repository."""
SHORT = ROOT / "tests" / "recordings"
"""Excerpts of two of these flights, and of a serial port at boot; see ``cut.py`` in this folder."""


def path_of(file: str) -> Path | None:
    """Return the path of a recording, the long one if available; None if there is no such recording."""
    return next((folder / file for folder in (LONG, SHORT) if (folder / file).is_file()), None)


def recording(file: str) -> Path:
    """Return the path of a recording, or skip the test if there is none."""
    path = path_of(file)
    if path is None:
        pytest.skip(f"no recording {file}: neither in {LONG} nor in {SHORT}")
    return path


def headline() -> str:
    """Return a line about the recordings that the tests use."""
    folder, what = (LONG, "complete flights") if LONG.is_dir() else (SHORT, "short excerpts")
    files = sorted(path.name for path in folder.iterdir() if path.suffix in (".tlog", ".raw"))
    return f"recordings: {what} in {folder}: {', '.join(files)}"
