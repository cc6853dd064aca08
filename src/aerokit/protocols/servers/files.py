"""Files that a MAVFTP server offers: an interface, and a tree of files in memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, Protocol

from typing_extensions import Self

# Error numbers of Linux. Firmware sends the same numbers, whatever platform this program runs on.
ENOENT, EEXIST, ENOTDIR, EISDIR = 2, 17, 20, 21
EINVAL, ENFILE, EFBIG, ENOSPC, EROFS, ENOTEMPTY = 22, 23, 27, 28, 30, 39

_FOLDER_SIZE = 4096  # Linux reports this size for a small folder.


class Entry(NamedTuple):
    """An entry of a folder. The size is in bytes, and None for a folder."""

    name: str
    size: int | None


class FileFault(Exception):
    """Error of a file system; ``errno`` is Linux's number."""

    def __init__(self, errno: int) -> None:
        super().__init__(f"errno {errno}")
        self.errno = errno


class FileHandle(ABC):
    """A file opened by a client. Methods raise FileFault on failure."""

    @abstractmethod
    def read(self, offset: int, size: int) -> bytes:
        """Return up to ``size`` bytes. The result is empty at the end of the file."""

    def write(self, offset: int, data: bytes) -> None:
        raise FileFault(EROFS)

    def close(self) -> None:  # noqa: B027 - most subclasses need no cleanup
        """Close the file. An uploaded file takes effect now."""


class FileSystem(Protocol):
    """The files that a MAVFTP server offers. Paths use ``/``; methods raise FileFault on failure."""

    def __contains__(self, path: str) -> bool: ...

    def size(self, path: str) -> int: ...

    def open(self, path: str, *, writing: bool = False, create: bool = False) -> FileHandle:
        """Open a file. ``create`` creates a missing file and empties an existing one."""
        ...

    def entries(self, path: str) -> list[Entry]: ...

    def truncate(self, path: str, size: int) -> None: ...

    def remove_file(self, path: str) -> None: ...

    def rename(self, path: str, to: str) -> None: ...

    def make_folder(self, path: str) -> None: ...

    def remove_folder(self, path: str) -> None: ...


class UploadedFile(FileHandle):
    """A file that a client writes in blocks, in any order. The file takes effect when it is closed."""

    def __init__(self) -> None:
        self.content: bytearray = bytearray()

    def read(self, offset: int, size: int) -> bytes:
        raise FileFault(EINVAL)

    def write(self, offset: int, data: bytes) -> None:
        end = offset + len(data)
        if offset == 0:
            end = max(end, self.announced_size(data))
        self.content.extend(bytes(max(0, end - len(self.content))))
        self.content[offset : offset + len(data)] = data

    def announced_size(self, data: bytes) -> int:
        """Return the size of the whole file according to its first block. 0 means unknown."""
        return 0


class Mount(ABC):
    """Generated files whose paths begin with a common prefix such as ``@PARAM``. Methods raise FileFault on failure."""

    is_listed = False
    """True if the mount appears in the root folder and its files can be listed."""

    @abstractmethod
    def size(self, path: str) -> int:
        """Return the size to report when a file is opened. It may be an estimate."""

    @abstractmethod
    def open(self, path: str, *, writing: bool) -> FileHandle: ...

    def entries(self) -> list[Entry]:
        raise FileFault(ENOENT)


class TextMount(Mount):
    """Read-only text files, such as ArduPilot's ``@SYS``. The reported size is always 100,000 bytes."""

    is_listed = True
    _REPORTED_SIZE = 100_000

    def __init__(self, texts: dict[str, str]) -> None:
        self._texts = texts

    def size(self, path: str) -> int:
        if path not in self._texts:
            raise FileFault(ENOENT)
        return self._REPORTED_SIZE

    def open(self, path: str, *, writing: bool) -> FileHandle:
        if writing:
            raise FileFault(EROFS)
        if path not in self._texts:
            raise FileFault(ENOENT)
        return _OpenFile(None, _File(self._texts[path].encode()))

    def entries(self) -> list[Entry]:
        return [Entry(name, self._REPORTED_SIZE) for name in self._texts]


class _File:
    """A file in memory. Its content may be given by a function, which is called on first access."""

    def __init__(self, content: bytes | Callable[[], bytes] = b"", size: int | None = None) -> None:
        self._make_content = content if callable(content) else None
        self._content = bytearray() if callable(content) else bytearray(content)
        self._size = size

    @property
    def content(self) -> bytearray:
        if self._make_content is not None:
            self._content = bytearray(self._make_content())
            self._make_content = None
        return self._content

    @property
    def size(self) -> int:
        if self._make_content is not None and self._size is not None:
            return self._size
        return len(self.content)


_Folder = dict[str, "_File | _Folder"]


class _OpenFile(FileHandle):
    """An open file in memory; it is read-only if ``tree`` is None."""

    def __init__(self, tree: FileTree | None, file: _File) -> None:
        self._tree = tree
        self._file = file

    def read(self, offset: int, size: int) -> bytes:
        return bytes(self._file.content[offset : offset + size])

    def write(self, offset: int, data: bytes) -> None:
        if self._tree is None:
            raise FileFault(EROFS)
        content = self._file.content
        self._tree.reserve(max(0, offset + len(data) - len(content)))
        if offset > len(content):  # The gap before the new data is filled with zeros.
            content.extend(bytes(offset - len(content)))
        content[offset : offset + len(data)] = data


class FileTree:
    """Folders and files. Leading slashes, empty parts and ``.`` in paths are ignored.

    ``free_bytes`` is the remaining space; None means that it is unlimited.
    """

    def __init__(self, *, free_bytes: int | None = None) -> None:
        self.free_bytes = free_bytes
        self.mounts: dict[str, Mount] = {}
        """Maps a prefix such as ``"@PARAM"`` to its mount."""
        self._root: _Folder = {}

    def put(self, path: str, content: bytes | Callable[[], bytes], *, size: int | None = None) -> Self:
        """Create or replace a file, and create its folders.

        A function as content is called when the content is first needed. Until then, the file is reported with ``size``
        bytes. If ``size`` is None, the function is called for the size, too.
        """
        folder = self._root
        *parents, name = _parts(path)
        for parent in parents:
            subfolder = folder.setdefault(parent, {})
            if not isinstance(subfolder, dict):
                raise FileFault(ENOTDIR)
            folder = subfolder
        folder[name] = _File(content, size)
        return self

    def append(self, path: str, data: bytes) -> None:
        self._file(path).content.extend(data)

    def get(self, path: str) -> bytes:
        return bytes(self._file(path).content)

    def __contains__(self, path: str) -> bool:
        try:
            self._find(path)
        except FileFault:
            return False
        return True

    def mounted(self, path: str) -> tuple[Mount, str] | None:
        """Return the mount of a path and the rest of the path, or None if the path is in no mount."""
        relative_path = path.removeprefix("/")
        for prefix, mount in self.mounts.items():
            if relative_path.startswith(prefix):
                return mount, relative_path[len(prefix) :].removeprefix("/")
        return None

    def size(self, path: str) -> int:
        mounted = self.mounted(path)
        if mounted is not None:
            mount, path_in_mount = mounted
            return mount.size(path_in_mount)
        node = self._find(path)
        return _FOLDER_SIZE if isinstance(node, dict) else node.size

    def open(self, path: str, *, writing: bool = False, create: bool = False) -> FileHandle:
        """Open a file. ``create`` creates a missing file and empties an existing one.

        ``writing`` matters only for files in a mount. Other files can be written without it.
        """
        mounted = self.mounted(path)
        if mounted is not None:
            mount, path_in_mount = mounted
            return mount.open(path_in_mount, writing=writing)
        if create:
            self._create(path)
        return _OpenFile(self, self._file(path))

    def _create(self, path: str) -> None:
        folder, name = self._parent(path)
        node = folder.get(name)
        if isinstance(node, dict):
            raise FileFault(EISDIR)
        if node is None:
            self._check_space_for_entry()
            folder[name] = _File()
        else:
            self.reserve(-node.size)
            node.content.clear()

    def truncate(self, path: str, size: int) -> None:
        """Cut a file to this size, or pad it with zeros."""
        content = self._file(path).content
        self.reserve(size - len(content))
        del content[size:]
        content.extend(bytes(size - len(content)))

    def remove_file(self, path: str) -> None:
        folder, name = self._parent(path)
        self.reserve(-self._file(path).size)
        del folder[name]

    def rename(self, path: str, to: str) -> None:
        node = self._find(path)
        folder, name = self._parent(to)
        existing = folder.get(name)
        is_folder = isinstance(node, dict)
        # A folder can be replaced only if it is empty, and only by another folder.
        if isinstance(existing, dict) and (existing or not is_folder):
            raise FileFault(ENOTEMPTY if is_folder else EISDIR)
        if isinstance(existing, _File) and is_folder:
            raise FileFault(ENOTDIR)
        if isinstance(node, dict) and _contains(node, folder):  # A folder cannot be moved into itself.
            raise FileFault(EINVAL)
        if isinstance(existing, _File) and existing is not node:
            self.reserve(-existing.size)
        old_folder, old_name = self._parent(path)
        del old_folder[old_name]
        folder[name] = node

    def reserve(self, size: int) -> None:
        """Subtract ``size`` from the free bytes. A negative size frees bytes.

        Raises FileFault if too few bytes are free.
        """
        if self.free_bytes is None:
            return
        if size > self.free_bytes:
            raise FileFault(ENOSPC)
        self.free_bytes -= size

    def _check_space_for_entry(self) -> None:
        if self.free_bytes == 0:  # Even an empty file or folder needs space.
            raise FileFault(ENOSPC)

    def entries(self, path: str) -> list[Entry]:
        mounted = self.mounted(path)
        if mounted is not None:
            mount, path_in_mount = mounted
            if path_in_mount:  # A mount has no folders of its own.
                raise FileFault(ENOENT)
            return mount.entries()
        folder = self._find(path)
        if not isinstance(folder, dict):
            raise FileFault(ENOTDIR)
        return [Entry(name, None if isinstance(node, dict) else node.size) for name, node in folder.items()]

    def make_folder(self, path: str) -> None:
        folder, name = self._parent(path)
        if name in folder:
            raise FileFault(EEXIST)
        self._check_space_for_entry()
        folder[name] = {}

    def remove_folder(self, path: str) -> None:
        folder, name = self._parent(path)
        node = self._find(path)
        if not isinstance(node, dict):
            raise FileFault(ENOTDIR)
        if node:
            raise FileFault(ENOTEMPTY)
        del folder[name]

    def clear_folder(self, path: str) -> None:
        """Remove all files and folders in a folder. Do nothing if there is no such folder."""
        try:
            entries = self.entries(path)
        except FileFault:
            return
        for name, size in entries:
            if size is None:
                self.clear_folder(f"{path}/{name}")
                self.remove_folder(f"{path}/{name}")
            else:
                self.remove_file(f"{path}/{name}")

    def _find(self, path: str) -> _File | _Folder:
        """Return the file or folder with this path. Raises FileFault if there is none."""
        node: _File | _Folder = self._root
        for part in _parts(path):
            if not isinstance(node, dict):
                raise FileFault(ENOTDIR)
            if part not in node:
                raise FileFault(ENOENT)
            node = node[part]
        return node

    def _file(self, path: str) -> _File:
        node = self._find(path)
        if isinstance(node, dict):
            raise FileFault(EISDIR)
        return node

    def _parent(self, path: str) -> tuple[_Folder, str]:
        """Return the folder that contains a path, and the last part of the path, which need not exist."""
        parts = _parts(path)
        if not parts:  # the root, which exists and cannot be created, replaced or removed
            raise FileFault(EEXIST)
        folder = self._find("/".join(parts[:-1]))
        if not isinstance(folder, dict):
            raise FileFault(ENOTDIR)
        return folder, parts[-1]


def _parts(path: str) -> list[str]:
    parts: list[str] = []
    for part in path.split("/"):
        if part == "..":
            del parts[-1:]
        elif part not in ("", "."):
            parts.append(part)
    return parts


def _contains(folder: _Folder, other: _Folder) -> bool:
    return folder is other or any(_contains(node, other) for node in folder.values() if isinstance(node, dict))
