"""``PartFile``: a file on this computer that gets its name when it is complete."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["PartFile"]


class PartFile:
    """``<to>.part`` until ``finish``; what is in it is always the beginning of what shall be in it.

    ``mark`` goes before ``.part``, so that beginnings of different things are not taken for each other.
    """

    def __init__(self, to: str | os.PathLike[str], mark: str = "") -> None:
        self._to = os.fspath(to)
        self.path: Path = Path(f"{self._to}{mark}.part")
        """Where it is meanwhile."""

    @property
    def size(self) -> int:
        """Bytes that an earlier attempt has left; 0 when there was none."""
        return self.path.stat().st_size if self.path.exists() else 0

    @contextmanager
    def writing(self, start: int) -> Iterator[BinaryIO]:
        """Open it for writing from ``start`` on; what was behind is gone. Nothing stays of
        an attempt that has brought nothing.

        Raises:
            OSError: it cannot be written.
        """
        try:
            with self.path.open("r+b" if start else "wb") as disk:
                disk.seek(start)
                disk.truncate()
                yield disk
        except BaseException:
            if not self.size:
                self.path.unlink(missing_ok=True)
            raise

    def finish(self) -> None:
        """Give it its name, in place of the file that may have it."""
        os.replace(self.path, self._to)
