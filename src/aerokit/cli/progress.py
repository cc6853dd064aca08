"""A progress bar on the terminal for what takes a while; nothing at all when the output is no terminal."""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tqdm import tqdm

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.protocols.transfer import OnProgress, Progress

__all__ = ["file_size", "progress_bar"]


class _Bar(tqdm):  # type: ignore[misc]  # it has no types
    monitor_interval = 0  # else a thread stays behind, which looks after bars that are rarely updated


@contextmanager
def progress_bar(what: str, unit: str) -> Iterator[OnProgress]:
    """Give the callback for ``on_progress``; ``unit`` is ``"B"`` for bytes, else the name of one thing."""
    is_bytes = unit == "B"
    with _Bar(
        desc=what,
        unit=unit if is_bytes else f" {unit}",
        unit_scale=is_bytes,
        unit_divisor=1024 if is_bytes else 1000,
        file=sys.stderr,
        disable=None,  # where standard error is no terminal
        leave=False,
        dynamic_ncols=True,
    ) as bar:

        def show(progress: Progress) -> None:
            if progress.total is not None:
                bar.total = progress.total
            bar.update(progress.done - bar.n)
            if progress.done == progress.total:
                bar.refresh()  # whatever was shown last, and however short ago

        yield show


def file_size(path: str | os.PathLike[str]) -> int:
    """Bytes in a file on this computer; OSError when it is not there."""
    return os.path.getsize(path)
