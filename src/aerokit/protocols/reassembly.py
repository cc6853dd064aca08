"""``Reassembly``: blocks of a file in any order, the same file in its order, and which blocks are missing."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["Reassembly", "WriteBytes"]

WriteBytes = Callable[[bytes], object]
"""Takes the next bytes of a file."""


class Reassembly:
    """Puts the blocks of one file into their order; ``write`` gets them one after the other.

    So what was written is always the beginning of the file, whatever happens next. Blocks begin ``start`` plus a
    multiple of ``block_size`` bytes into the file; only the last one is shorter.
    """

    position: int

    def __init__(self, write: WriteBytes, *, block_size: int, start: int = 0) -> None:
        self.start: int = start
        self.block_size: int = block_size
        self.position = start
        """Everything before this was written."""
        self.tail: int = start
        """The end of the last block that has come."""
        self.end: int | None = None
        """Where the file ends; None while that is not known."""
        self.gaps: dict[int, None] = {}
        """The blocks before ``tail`` that are missing, by their offsets, in order."""
        self._write = write
        self._ahead: dict[int, bytes] = {}
        self._bytes_ahead = 0

    @property
    def done(self) -> int:
        """Bytes that are there, those of the beginning that were there before included."""
        return self.position + self._bytes_ahead

    @property
    def is_complete(self) -> bool:
        """Whether all of the file has come."""
        return self.end is not None and self.position >= self.end

    def add(self, offset: int, data: bytes) -> bool:
        """Take one block; whether it was missing. One that is shorter than the others is the last."""
        if not data or (offset - self.start) % self.block_size or not self._is_missing(offset):
            return False
        if offset >= self.tail:
            self.gaps.update(dict.fromkeys(range(self.tail, offset, self.block_size)))
            self.tail = offset + len(data)
        else:
            del self.gaps[offset]
        if offset == self.position:
            self._advance(data)
        else:
            self._ahead[offset] = data
            self._bytes_ahead += len(data)
        if len(data) < self.block_size:
            self.end_at(offset + len(data))
        return True

    def end_at(self, end: int) -> None:
        """The file is known to end there; of several ends the first one counts."""
        if self.end is not None and self.end <= end:
            return
        self.end = end
        for offset in [each for each in self.gaps if each >= end]:
            del self.gaps[offset]
        for offset in [each for each in self._ahead if each >= end]:
            self._bytes_ahead -= len(self._ahead.pop(offset))
        if self.tail < end:
            self.gaps.update(dict.fromkeys(range(self.tail, end, self.block_size)))
        self.tail = max(end, self.position)

    def missing(self, size: int | None = None) -> tuple[tuple[int, int], ...]:
        """What has not come, as (offset, size); ``size`` is that of the file, as far as it is known.

        A size of 0 means from there to an end that nobody knows.
        """
        ranges: list[tuple[int, int]] = []
        for offset in self.gaps:
            length = self.block_size if self.end is None else min(self.block_size, self.end - offset)
            if ranges and sum(ranges[-1]) == offset:
                ranges[-1] = (ranges[-1][0], ranges[-1][1] + length)
            else:
                ranges.append((offset, length))
        if self.end is None:
            rest = 0 if size is None else max(0, size - self.tail)
            ranges.append((self.tail, rest))
        return tuple(ranges)

    def _is_missing(self, offset: int) -> bool:
        if self.end is not None and offset >= self.end:
            return False
        return offset >= self.tail or offset in self.gaps

    def _advance(self, data: bytes) -> None:
        self._write(data)
        self.position += len(data)
        while (ahead := self._ahead.pop(self.position, None)) is not None:
            self._bytes_ahead -= len(ahead)
            self._write(ahead)
            self.position += len(ahead)
