"""``DirectoryFiles``: the files of one directory, for a MAVFTP server."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from aerokit.protocols.servers.files import EFBIG, EINVAL, EISDIR, ENOENT, EROFS, Entry, FileFault, FileHandle

if TYPE_CHECKING:
    from aerokit.protocols.servers.files import FileTree

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

MAX_FILE_BYTES = 1 << 30
"""Maximum size of a file that a client writes."""
MAX_ENTRIES = 10_000
"""Maximum number of directory entries that are listed."""
_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)
# Linux's error numbers, which MAVFTP clients expect on every platform.
_NUMBERS = {errno.ENOTEMPTY: 39, errno.ELOOP: ENOENT, errno.ENAMETOOLONG: 36}


def _guarded(function: FunctionT) -> FunctionT:
    """Turn OSError into FileFault."""

    @wraps(function)
    def guarded(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except OSError as error:
            number = error.errno or EINVAL
            raise FileFault(_NUMBERS.get(number, number) & 0xFF) from None

    return cast("FunctionT", guarded)


class _DiskFile(FileHandle):
    def __init__(self, descriptor: int, *, writing: bool) -> None:
        self._file = os.fdopen(descriptor, "r+b" if writing else "rb", buffering=0)

    @_guarded
    def read(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size) or b""

    @_guarded
    def write(self, offset: int, data: bytes) -> None:
        if offset + len(data) > MAX_FILE_BYTES:
            raise FileFault(EFBIG)
        if not self._file.writable():
            raise FileFault(EROFS)
        self._file.seek(offset)
        self._file.write(data)

    @_guarded
    def close(self) -> None:
        self._file.close()


class DirectoryFiles:
    """Serves the regular files below one directory, and files in memory.

    Symbolic links are neither followed nor listed, and ``..`` is refused, so that clients cannot reach anything outside
    the directory. Devices and pipes cannot be opened. ``memory`` has the component's own files; they hide files with
    the same path, and clients cannot change them.
    """

    def __init__(self, root: Path | None, memory: FileTree, *, is_writable: bool) -> None:
        self._root = None if root is None else root.resolve(strict=True)
        self._memory = memory
        self._is_writable = is_writable

    @property
    def has_root(self) -> bool:
        """True if a directory is served in addition to the files in memory."""
        return self._root is not None

    def __contains__(self, path: str) -> bool:
        try:
            self.size(path)
        except FileFault:
            return False
        return True

    @_guarded
    def size(self, path: str) -> int:
        """Return the size of a file in bytes."""
        if path in self._memory:
            return self._memory.size(path)
        found = self._path(path).lstat()
        return found.st_size if stat.S_ISREG(found.st_mode) else 0

    @_guarded
    def open(self, path: str, *, writing: bool = False, create: bool = False) -> FileHandle:
        """Open a regular file."""
        if path in self._memory:
            if writing:
                raise FileFault(EROFS)
            return self._memory.open(path)
        target = self._writable(path) if writing else self._path(path)
        if target.is_dir():
            raise FileFault(EISDIR)
        flags = (os.O_RDWR | (os.O_CREAT | os.O_TRUNC if create else 0)) if writing else os.O_RDONLY
        if target.exists() and not target.is_file():
            raise FileFault(ENOENT)
        descriptor = os.open(target, flags | _NO_LINK, 0o644)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise FileFault(ENOENT)
        return _DiskFile(descriptor, writing=writing)

    @_guarded
    def entries(self, path: str) -> list[Entry]:
        """Return files and directories, by name."""
        found: dict[str, int | None] = {}
        if self._root is not None:
            try:
                with os.scandir(self._path(path)) as entries:
                    for entry in entries:
                        if entry.is_dir(follow_symlinks=False):
                            found[entry.name] = None
                        elif entry.is_file(follow_symlinks=False):
                            found[entry.name] = entry.stat(follow_symlinks=False).st_size
                        if len(found) >= MAX_ENTRIES:
                            break
            except (OSError, FileFault):
                if path not in self._memory:
                    raise
        if self._root is None or path in self._memory:
            found.update(self._memory.entries(path))
        return sorted(found.items())

    @_guarded
    def truncate(self, path: str, size: int) -> None:
        target = self._writable(path)
        if size > MAX_FILE_BYTES:
            raise FileFault(EFBIG)
        if not target.is_file():
            raise FileFault(ENOENT)
        os.truncate(target, size)

    @_guarded
    def remove_file(self, path: str) -> None:
        target = self._writable(path)
        if target.is_dir():
            raise FileFault(EISDIR)
        target.unlink()

    @_guarded
    def rename(self, path: str, to: str) -> None:
        self._writable(path).rename(self._writable(to))

    @_guarded
    def make_folder(self, path: str) -> None:
        self._writable(path).mkdir()

    @_guarded
    def remove_folder(self, path: str) -> None:
        self._writable(path).rmdir()

    def _writable(self, path: str) -> Path:
        if not self._is_writable or path in self._memory:
            raise FileFault(EROFS)
        target = self._path(path)
        if target == self._root:
            raise FileFault(EINVAL)
        return target

    def _path(self, path: str) -> Path:
        """Return the path below the root; raise FileFault if it leaves the root or contains a symbolic link."""
        if self._root is None:
            raise FileFault(ENOENT)
        target = self._root
        parts = [part for part in path.split("/") if part not in ("", ".")]
        for part in parts:
            if part == ".." or "\0" in part or "\\" in part or (os.name == "nt" and ":" in part):
                raise FileFault(EINVAL)
            if "\ufffd" in part:  # the name was not UTF-8
                raise FileFault(ENOENT)
            target = target / part
            if target.is_symlink():
                raise FileFault(ENOENT)
        return target
