"""``DirectoryFiles``: the files of one directory, for a MAVFTP server."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from aerokit.protocols.servers.files import EFBIG, EINVAL, EISDIR, ENOENT, ENOSPC, EROFS, Entry, FileFault, FileHandle

if TYPE_CHECKING:
    from aerokit.protocols.servers.files import FileTree

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

MAX_FILE_BYTES = 1 << 30
"""Maximum size of a file that a client writes."""
MAX_ENTRIES = 10_000
"""Maximum number of directory entries that are listed."""
# Flags for `os.open`, if the platform has them: follow no symbolic link, do not convert line ends, do not wait for the
# other end of a pipe.
_SAFE_FLAGS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)
# Linux's error numbers, which MAVFTP clients expect on every platform. ELOOP means a symbolic link, which clients
# must not see.
_ERROR_NUMBERS = {errno.ENOTEMPTY: 39, errno.ELOOP: ENOENT, errno.ENAMETOOLONG: 36}


def _raises_file_fault(function: FunctionT) -> FunctionT:
    """Decorator: turn an OSError into a FileFault with the error number that Linux has for it."""

    @wraps(function)
    def guarded(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except OSError as error:
            number = error.errno or EINVAL
            linux_number = _ERROR_NUMBERS.get(number, number)
            raise FileFault(linux_number & 0xFF) from None  # The answer has one byte for the number.

    return cast("FunctionT", guarded)


class _DiskFile(FileHandle):
    def __init__(self, descriptor: int, *, writing: bool) -> None:
        self._file = os.fdopen(descriptor, "r+b" if writing else "rb", buffering=0)

    @_raises_file_fault
    def read(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size) or b""

    @_raises_file_fault
    def write(self, offset: int, data: bytes) -> None:
        if offset + len(data) > MAX_FILE_BYTES:
            raise FileFault(EFBIG)
        if not self._file.writable():
            raise FileFault(EROFS)
        self._file.seek(offset)
        if self._file.write(data) != len(data):  # The disk became full in the middle of the block.
            raise FileFault(ENOSPC)

    @_raises_file_fault
    def close(self) -> None:
        self._file.close()


class DirectoryFiles:
    """Serves the regular files below one directory, and files that are kept in memory.

    Symbolic links are neither followed nor listed, and ``..`` is refused, so that clients cannot reach anything outside
    the directory. Devices and pipes cannot be opened. ``memory`` has the component's own files, which clients cannot
    change. A file in the directory with the same path is hidden.
    """

    def __init__(self, root: Path | None, memory: FileTree, *, is_writable: bool) -> None:
        self.root: Path | None = None if root is None else root.resolve(strict=True)
        self._memory = memory
        self._is_writable = is_writable

    def __contains__(self, path: str) -> bool:
        try:
            self.size(path)
        except FileFault:
            return False
        return True

    @_raises_file_fault
    def size(self, path: str) -> int:
        """Return the size of a file in bytes; 0 for anything other than a regular file."""
        if path in self._memory:
            return self._memory.size(path)
        status = self._path(path).lstat()
        return status.st_size if stat.S_ISREG(status.st_mode) else 0

    @_raises_file_fault
    def open(self, path: str, *, writing: bool = False, create: bool = False) -> FileHandle:
        if path in self._memory:
            if writing:
                raise FileFault(EROFS)
            return self._memory.open(path)
        target = self._writable(path) if writing else self._path(path)
        if target.is_dir():
            raise FileFault(EISDIR)
        flags = os.O_RDWR if writing else os.O_RDONLY
        if writing and create:
            flags |= os.O_CREAT | os.O_TRUNC
        if target.exists() and not target.is_file():  # A device or a pipe could block the program.
            raise FileFault(ENOENT)
        descriptor = os.open(target, flags | _SAFE_FLAGS, 0o644)
        # Check again, because another program may have replaced the file by a device since the check above.
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise FileFault(ENOENT)
        return _DiskFile(descriptor, writing=writing)

    @_raises_file_fault
    def entries(self, path: str) -> list[Entry]:
        """Return the names and sizes of files and directories, at most `MAX_ENTRIES`."""
        sizes: dict[str, int | None] = {}  # None for directories
        if self.root is not None:
            try:
                with os.scandir(self._path(path)) as entries:
                    for entry in entries:
                        if entry.is_dir(follow_symlinks=False):
                            sizes[entry.name] = None
                        elif entry.is_file(follow_symlinks=False):
                            sizes[entry.name] = entry.stat(follow_symlinks=False).st_size
                        if len(sizes) >= MAX_ENTRIES:
                            break
            except (OSError, FileFault):
                if path not in self._memory:  # A directory in memory need not exist on the disk.
                    raise
        if self.root is None or path in self._memory:
            sizes.update(self._memory.entries(path))  # Without a root, an unknown path raises here.
        return [Entry(name, size) for name, size in sorted(sizes.items())]

    @_raises_file_fault
    def truncate(self, path: str, size: int) -> None:
        target = self._writable(path)
        if size > MAX_FILE_BYTES:
            raise FileFault(EFBIG)
        if not target.is_file():
            raise FileFault(ENOENT)
        os.truncate(target, size)

    @_raises_file_fault
    def remove_file(self, path: str) -> None:
        target = self._writable(path)
        if target.is_dir():
            raise FileFault(EISDIR)
        target.unlink()

    @_raises_file_fault
    def rename(self, path: str, to: str) -> None:
        self._writable(path).rename(self._writable(to))

    @_raises_file_fault
    def make_folder(self, path: str) -> None:
        self._writable(path).mkdir()

    @_raises_file_fault
    def remove_folder(self, path: str) -> None:
        self._writable(path).rmdir()

    def _writable(self, path: str) -> Path:
        if not self._is_writable or path in self._memory:
            raise FileFault(EROFS)
        target = self._path(path)
        if target == self.root:
            raise FileFault(EINVAL)
        return target

    def _path(self, path: str) -> Path:
        """Convert a client's path. Raise FileFault if the path leaves the root or contains a symbolic link."""
        if self.root is None:
            raise FileFault(ENOENT)
        target = self.root
        parts = [part for part in path.split("/") if part not in ("", ".")]
        for part in parts:
            has_windows_colon = os.name == "nt" and ":" in part  # a drive, or a second stream of a file
            is_forbidden = part == ".." or "\0" in part or "\\" in part or has_windows_colon
            if is_forbidden:
                raise FileFault(EINVAL)
            if "\ufffd" in part:  # The name was not valid UTF-8.
                raise FileFault(ENOENT)
            target = target / part
            if target.is_symlink():
                raise FileFault(ENOENT)
        return target
