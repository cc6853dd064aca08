"""Files that commands write: none that is there already is replaced unasked."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

__all__ = ["add_force", "check_new", "make_new_recording", "remove_if_empty"]


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


def make_new_recording(path: str) -> None:
    """Make the file now, so that nobody else's is replaced.

    Raises:
        FileExistsError: the file is there.
    """
    try:
        with open(path, "xb"):
            pass
    except FileExistsError as error:
        raise FileExistsError(error.errno, "is there already; nothing was recorded", path) from None


def remove_if_empty(path: str) -> None:
    """Take a recording away that was made a moment ago, when nothing came of it."""
    if not os.path.getsize(path):
        os.unlink(path)
