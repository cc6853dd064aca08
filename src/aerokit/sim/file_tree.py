"""The files of a simulated vehicle: folders in memory, and places in them whose content is made when it is read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from typing_extensions import Self

ENOENT, EEXIST, ENOTDIR, EISDIR = 2, 17, 20, 21
EINVAL, ENFILE, ENOSPC, EROFS, ENOTEMPTY = 22, 23, 28, 30, 39
"""Linux's numbers, which the firmwares send whatever they run on."""

Entry = tuple[str, int | None]
"""A name and its size in bytes; None for a folder."""


class FileFault(Exception):
    """What the vehicle's file system says no with: ``errno``."""

    def __init__(self, errno: int) -> None:
        super().__init__(f"errno {errno}")
        self.errno = errno


class OpenFile(ABC):
    """A file that a client has opened; every method raises FileFault when it cannot."""

    @abstractmethod
    def read(self, offset: int, size: int) -> bytes:
        """Up to ``size`` bytes; nothing at the end."""

    def write(self, offset: int, data: bytes) -> None:
        raise FileFault(EROFS)

    def close(self) -> None:  # noqa: B027 - most have nothing to do then
        """Nobody reads or writes any more; what takes effect at the end takes effect now."""


class Mount(ABC):
    """Files that are made on the fly, all below one prefix such as ``@PARAM``."""

    is_listed = False
    """Whether it shows up in the root, and tells what is in it."""

    @abstractmethod
    def size(self, path: str) -> int:
        """What an open tells; may be a guess. FileFault when there is no such file."""

    @abstractmethod
    def open(self, path: str, *, writing: bool) -> OpenFile:
        """Open it; FileFault when it cannot be."""

    def entries(self) -> list[Entry]:
        """What is in it; FileFault when it does not tell."""
        raise FileFault(ENOENT)


class TextMount(Mount):
    """Files that can only be read, such as ArduPilot's ``@SYS``: an open tells 100,000 bytes, whatever there is."""

    is_listed = True
    _PLACEHOLDER = 100_000

    def __init__(self, texts: dict[str, str]) -> None:
        self._texts = texts

    def size(self, path: str) -> int:
        if path not in self._texts:
            raise FileFault(ENOENT)
        return self._PLACEHOLDER

    def open(self, path: str, *, writing: bool) -> OpenFile:
        if writing:
            raise FileFault(EROFS)
        if path not in self._texts:
            raise FileFault(ENOENT)
        return _Opened(None, _File(self._texts[path].encode()))

    def entries(self) -> list[Entry]:
        return [(name, self._PLACEHOLDER) for name in self._texts]


class _File:
    """Bytes, or what makes them at the first look."""

    def __init__(self, content: bytes | Callable[[], bytes] = b"", size: int | None = None) -> None:
        self._make = content if callable(content) else None
        self._content = bytearray() if callable(content) else bytearray(content)
        self._size = size

    @property
    def content(self) -> bytearray:
        """The bytes; change them in place."""
        if self._make is not None:
            self._content, self._make = bytearray(self._make()), None
        return self._content

    @property
    def size(self) -> int:
        """Bytes, without making them if the size was told."""
        return self._size if self._make is not None and self._size is not None else len(self.content)


_Folder = dict[str, "_File | _Folder"]


class _Opened(OpenFile):
    def __init__(self, tree: FileTree | None, file: _File) -> None:
        self._tree = tree
        self._file = file

    def read(self, offset: int, size: int) -> bytes:
        return bytes(self._file.content[offset : offset + size])

    def write(self, offset: int, data: bytes) -> None:
        if self._tree is None:
            raise FileFault(EROFS)
        content = self._file.content
        self._tree.claim(max(0, offset + len(data) - len(content)))
        if offset > len(content):
            content.extend(bytes(offset - len(content)))
        content[offset : offset + len(data)] = data


class FileTree:
    """Paths have slashes; a leading one makes no difference, nor do empty parts and ``.``.

    ``free_bytes`` is how much may still be written; None is without end.
    """

    def __init__(self, *, free_bytes: int | None = None) -> None:
        self.free_bytes = free_bytes
        self.mounts: dict[str, Mount] = {}
        """Prefix (``"@PARAM"``) → the files below it."""
        self._root: _Folder = {}

    def put(self, path: str, content: bytes | Callable[[], bytes], *, size: int | None = None) -> Self:
        """Make a file, and the folders it is in. A function makes the content when it is first read."""
        folder = self._root
        *above, name = _parts(path)
        for part in above:
            inner = folder.setdefault(part, {})
            if not isinstance(inner, dict):
                raise FileFault(ENOTDIR)
            folder = inner
        folder[name] = _File(content, size)
        return self

    def append(self, path: str, data: bytes) -> None:
        """Let a file grow; who has it open reads on."""
        self._file(path).content.extend(data)

    def get(self, path: str) -> bytes:
        """The whole content of a file; FileFault when there is none."""
        return bytes(self._file(path).content)

    def __contains__(self, path: str) -> bool:
        try:
            self._find(path)
        except FileFault:
            return False
        return True

    def mounted(self, path: str) -> tuple[Mount, str] | None:
        """The mount that a path is in, and the rest of the path; None for one in the tree itself."""
        bare = path[1:] if path.startswith("/") else path
        for prefix, mount in self.mounts.items():
            if bare.startswith(prefix):
                return mount, bare[len(prefix) :].removeprefix("/")
        return None

    def size(self, path: str) -> int:
        """Of a file, in bytes; 4096 for a folder."""
        if (inside := self.mounted(path)) is not None:
            return inside[0].size(inside[1])
        node = self._find(path)
        return 4096 if isinstance(node, dict) else node.size

    def open(self, path: str, *, writing: bool = False, create: bool = False) -> OpenFile:
        """Open for reading or writing; ``create`` empties it, or makes it."""
        if (inside := self.mounted(path)) is not None:
            return inside[0].open(inside[1], writing=writing)
        if create:
            self._create(path)
        return _Opened(self, self._file(path))

    def _create(self, path: str) -> None:
        folder, name = self._parent(path)
        node = folder.get(name)
        if isinstance(node, dict):
            raise FileFault(EISDIR)
        if node is None:
            self.claim(0)
            folder[name] = _File()
        else:
            self.claim(-node.size)
            node.content.clear()

    def truncate(self, path: str, size: int) -> None:
        """Make a file this long: cut it, or fill it up with zeros."""
        content = self._file(path).content
        self.claim(size - len(content))
        del content[size:]
        content.extend(bytes(size - len(content)))

    def remove_file(self, path: str) -> None:
        folder, name = self._parent(path)
        self.claim(-self._file(path).size)
        del folder[name]

    def rename(self, path: str, to: str) -> None:
        """Give a file or folder another path; a file that is there is replaced."""
        node = self._find(path)
        folder, name = self._parent(to)
        there = folder.get(name)
        if isinstance(there, dict) and (there or not isinstance(node, dict)):
            raise FileFault(ENOTEMPTY if isinstance(node, dict) else EISDIR)
        if isinstance(there, _File) and isinstance(node, dict):
            raise FileFault(ENOTDIR)
        if isinstance(node, dict) and _contains(node, folder):
            raise FileFault(EINVAL)
        old_folder, old_name = self._parent(path)
        del old_folder[old_name]
        folder[name] = node

    def claim(self, size: int) -> None:
        """Take so many of the free bytes, or give some back; FileFault when there are not so many."""
        if self.free_bytes is None:
            return
        if size >= 0 and (size > self.free_bytes or self.free_bytes == 0):
            raise FileFault(ENOSPC)
        self.free_bytes -= size

    def entries(self, path: str) -> list[Entry]:
        """What is in a folder, in the order it came in."""
        if (inside := self.mounted(path)) is not None:
            if inside[1]:
                raise FileFault(ENOENT)
            return inside[0].entries()
        folder = self._find(path)
        if not isinstance(folder, dict):
            raise FileFault(ENOTDIR)
        return [(name, None if isinstance(node, dict) else node.size) for name, node in folder.items()]

    def make_folder(self, path: str) -> None:
        """Make one folder in one that is there."""
        folder, name = self._parent(path)
        if name in folder:
            raise FileFault(EEXIST)
        self.claim(0)
        folder[name] = {}

    def remove_folder(self, path: str) -> None:
        """Delete an empty folder."""
        folder, name = self._parent(path)
        node = self._find(path)
        if not isinstance(node, dict):
            raise FileFault(ENOTDIR)
        if node:
            raise FileFault(ENOTEMPTY)
        del folder[name]

    def _find(self, path: str) -> _File | _Folder:
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
        parts = _parts(path)
        if not parts:
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
    return folder is other or any(
        _contains(node, other) for node in folder.values() if isinstance(node, dict)
    )
