"""Recorded traffic of real firmwares: the long recordings beside the project if they are there, else its own."""

from __future__ import annotations

from pathlib import Path

import pytest

__all__ = ["LONG", "SHORT", "headline", "path_of", "recording"]

ROOT = Path(__file__).parents[2]
LONG = ROOT.parent / "shared" / "traces"
"""Whole flights; not part of the project."""
SHORT = ROOT / "tests" / "recordings"
"""The telling parts of two of them, and of a serial port at boot; see ``cut.py`` there."""


def path_of(file: str) -> Path | None:
    """Where this file is, the long one if it is there; None when there is neither."""
    return next((folder / file for folder in (LONG, SHORT) if (folder / file).is_file()), None)


def recording(file: str) -> Path:
    """Where this file is; the test is skipped when it is nowhere."""
    path = path_of(file)
    if path is None:
        pytest.skip(f"no recording {file}: neither in {LONG} nor in {SHORT}")
    return path


def headline() -> str:
    """Which recordings the tests use."""
    folder, what = (LONG, "whole flights") if LONG.is_dir() else (SHORT, "the project's own short ones")
    files = sorted(path.name for path in folder.iterdir() if path.suffix in (".tlog", ".raw"))
    return f"recordings: {what} in {folder}: {', '.join(files)}"
