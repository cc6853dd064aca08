"""Files on a vehicle for programs without ``async``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.protocols.transfer import PATIENCE_S

if TYPE_CHECKING:
    import os

    from aerokit.protocols.transfer import OnProgress
    from aerokit.sync.loop_thread import LoopThread
    from aerokit.vehicle.files import FileEntry
    from aerokit.vehicle.files import Files as AsyncFiles

__all__ = ["Files"]


class Files:
    """Reads, writes and lists files on the vehicle; arguments and errors are those of
    :class:`aerokit.vehicle.files.Files`. ``on_progress`` is called on the loop's thread.
    """

    def __init__(self, loop: LoopThread, files: AsyncFiles) -> None:
        self._loop, self._files = loop, files

    def is_supported(self) -> bool:
        """Whether the vehicle says that it has MAVFTP."""
        return self._loop.run(self._files.is_supported)

    def read(
        self,
        path: str,
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> bytes:
        """Return the content of a file."""
        return self._loop.run(
            self._files.read, path, patience_s=patience_s, timeout=timeout, on_progress=on_progress
        )

    def download(
        self,
        path: str,
        to: str | os.PathLike[str],
        *,
        resume: bool = False,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a file to the disk of this computer, with ``resume`` from where an earlier download was interrupted."""
        self._loop.run(
            self._files.download,
            path,
            to,
            resume=resume,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def list(
        self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> tuple[FileEntry, ...]:
        """Return what is in a directory, without ``.`` and ``..``, in the vehicle's order."""
        return self._loop.run(self._files.list, path, patience_s=patience_s, timeout=timeout)

    def crc32(self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None) -> int:
        """Return the CRC-32 that the vehicle computes of a file: ``zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF``."""
        return self._loop.run(self._files.crc32, path, patience_s=patience_s, timeout=timeout)

    def write(
        self,
        path: str,
        data: bytes,
        *,
        verify: bool = True,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Write a file, in place of the one that may be there."""
        self._loop.run(
            self._files.write,
            path,
            data,
            verify=verify,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def upload(
        self,
        source: str | os.PathLike[str],
        path: str,
        *,
        verify: bool = True,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a file of this computer to the vehicle."""
        self._loop.run(
            self._files.upload,
            source,
            path,
            verify=verify,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def truncate(
        self, path: str, size: int, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Cut a file to ``size`` bytes, or make it as long with zeros. PX4 can, ArduPilot cannot."""
        self._loop.run(self._files.truncate, path, size, patience_s=patience_s, timeout=timeout)

    def remove(self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None) -> None:
        """Remove a file."""
        self._loop.run(self._files.remove, path, patience_s=patience_s, timeout=timeout)

    def remove_directory(
        self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Remove an empty directory."""
        self._loop.run(self._files.remove_directory, path, patience_s=patience_s, timeout=timeout)

    def make_directory(
        self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Make a directory; the one that it is in must exist."""
        self._loop.run(self._files.make_directory, path, patience_s=patience_s, timeout=timeout)

    def rename(
        self, path: str, new_path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Give a file or directory another name or place."""
        self._loop.run(self._files.rename, path, new_path, patience_s=patience_s, timeout=timeout)
