"""Files that commands write: none that is there already is replaced unasked."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

__all__ = ["add_force", "check_new"]


def add_force(command: argparse.ArgumentParser) -> None:
    """Add ``--force``."""
    command.add_argument("--force", action="store_true", help="replace a file that is there already")


def check_new(file: str, options: argparse.Namespace) -> None:
    """Look before anything is sent.

    Raises:
        FileExistsError: the file is there, and ``--force`` is not given.
    """
    if not options.force and Path(file).exists():
        raise FileExistsError(errno.EEXIST, "is there already; --force replaces it", file)
