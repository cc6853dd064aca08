"""``Files``: the files on a vehicle by MAVFTP (https://mavlink.io/en/services/ftp.html)."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.files import PartFile
from aerokit._internal.values import Snapshot
from aerokit.errors import FileError, InvalidArgument, RemoteProtocolError, VerificationFailed
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.exchange import PATIENCE_S, OnProgress
from aerokit.protocols.ftp import DATA_SIZE, path_bytes
from aerokit.protocols.ftp_transfer import FtpDownload, FtpUpload, is_virtual
from aerokit.vehicle.files.channel import FileChannel

if TYPE_CHECKING:
    import os

    from aerokit.protocols.ftp import FtpMessage
    from aerokit.vehicle.files.channel import OpenFile
    from aerokit.vehicle.session.transfers import Transfers

__all__ = ["FileEntry", "Files"]

CAPABILITY_FTP = 0x20
NO_CRC = (MavFtpErr.FAIL, MavFtpErr.UNKNOWNCOMMAND)
LARGEST = 0xFFFFFFFF
BLOCK = 1 << 16
MOST_FRUITLESS, MOST_ENTRIES = 50, 1_000_000
"""Answers of a listing in a row that hold nothing new, and entries, before it is taken for endless."""


class FileEntry(Snapshot):
    """One entry of a directory; ``size`` in bytes, None for directories."""

    name: str
    size: int | None
    is_directory: bool


@checks_arguments
class Files:
    """Reads, writes and lists files on the vehicle. Operations follow each other in the order of their calls.

    Paths are the vehicle's: ``/APM/LOGS`` and ``@PARAM/param.pck`` on ArduPilot, ``/fs/microsd/log`` on PX4.

    Every method takes ``patience_s``, the seconds to go on while nothing comes, and ``timeout``, those for all of it
    (None: no limit). Every method may be cancelled at any moment; the file is closed on the vehicle behind it.

    Every method raises:
        InvalidArgument: a path is empty, has a NUL, is not encodable, or is longer than 238 bytes. Nothing was sent.
        FileError: the vehicle refused; ``code`` and ``errno`` say why.
        FileTimeout: it did not end; ``missing`` has the ranges that did not arrive.

    :meth:`is_supported` raises none of them.
    """

    def __init__(self, transfers: Transfers) -> None:
        self._transfers = transfers
        self._channel = FileChannel(transfers)

    async def is_supported(self) -> bool:
        """Whether the vehicle says that it has MAVFTP; False, too, when it says nothing within three seconds."""
        capabilities = await self._transfers.capabilities()
        return capabilities is not None and bool(capabilities & CAPABILITY_FTP)

    # ------------------------------------------------------------------------------- reading

    async def read(
        self,
        path: str,
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> bytes:
        """Return the content of a file.

        Raises:
            RemoteProtocolError: the vehicle's answers make no sense, or its file became shorter while it was read.
        """
        content = bytearray()
        await self._fetch(
            path, Reassembly(content.extend, block_size=DATA_SIZE), patience_s, timeout, on_progress
        )
        return bytes(content)

    async def download(
        self,
        path: str,
        to: str | os.PathLike[str],
        *,
        resume: bool = False,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a file to the disk of this computer. It grows as ``<to>.part``, and gets its name when it is complete.

        With ``resume``, what an interrupted download has left in ``<to>.part`` is kept when the vehicle's file is not
        shorter, and the whole is compared by its CRC-32 afterwards, where the vehicle can compute it; when they differ,
        all of it is fetched again. Files whose names begin with ``@`` are always fetched as a whole.

        Raises:
            RemoteProtocolError: as for :meth:`read`.
            OSError: the file cannot be written here.
        """
        path_bytes(path)
        part = PartFile(to)
        start = part.size if resume and not is_virtual(path) else 0
        try:
            await self._fetch_to(part, path, start, patience_s, timeout, on_progress)
            is_whole = not start or await self._is_same(path, part, patience_s, timeout)
        except _ShorterError:
            is_whole = False
        if not is_whole:
            await self._fetch_to(part, path, 0, patience_s, timeout, on_progress)
        part.finish()

    async def list(
        self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> tuple[FileEntry, ...]:
        """Return what is in a directory, without ``.`` and ``..``, in the vehicle's order.

        Raises:
            RemoteProtocolError: the vehicle's list does not end.
        """
        path_bytes(path)
        entries: dict[str, FileEntry] = {}
        offset = fruitless = 0
        async with self._channel.operation(f"list {path}", timeout=timeout, patience_s=patience_s):
            while (reply := await self._list_from(path, offset, patience_s)) is not None:
                texts = [text for text in reply.data.split(b"\0") if text]
                before = len(entries)
                entries.update((entry.name, entry) for entry in map(_entry, texts) if entry is not None)
                offset += len(texts) or 1  # a name that fits into no message is passed over
                fruitless = fruitless + 1 if len(entries) == before else 0
                if fruitless > MOST_FRUITLESS or offset > MOST_ENTRIES:
                    raise RemoteProtocolError(
                        f"list {path}: the vehicle's list does not end, it is at {offset}"
                    )
        return tuple(entries.values())

    async def crc32(self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None) -> int:
        """Return the CRC-32 that the vehicle computes of a file: polynomial 0x04C11DB7, nothing inverted.

        That is ``zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF``.

        Raises:
            RemoteProtocolError: its answer is no CRC-32.
        """
        reply = await self._request(MavFtpOpcode.CALCFILECRC, path, patience_s, timeout)
        return _crc32_in(path, reply)

    # ------------------------------------------------------------------------------- writing

    async def write(
        self,
        path: str,
        data: bytes,
        *,
        verify: bool = True,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Write a file, in place of the one that may be there; what was in that one is gone with the first message.

        ``verify`` compares its CRC-32 afterwards, where the vehicle can compute it. Of files whose names begin with
        ``@`` it cannot: they are taken over when they are closed, and what became of that is not said.

        Raises:
            VerificationFailed: all was acknowledged, and yet something else is in the file.
            RemoteProtocolError: the CRC-32 that it tells is none.
        """
        path_bytes(path)
        data = bytes(data)
        if len(data) > LARGEST:
            raise InvalidArgument(f"data of {len(data)} bytes is not allowed: at most {LARGEST}")
        channel, missing = self._channel, lambda: ((0, len(data)),)
        async with channel.operation(
            f"write {path}", timeout=timeout, patience_s=patience_s, missing=missing
        ):
            await channel.with_file(
                MavFtpOpcode.CREATEFILE,
                path,
                lambda file: self._put(file, path, data, patience_s, on_progress),
                patience_s=patience_s,
            )
            if verify and not is_virtual(path):
                await self._verify(path, data, patience_s)

    async def upload(
        self,
        source: str | os.PathLike[str],
        path: str,
        *,
        verify: bool = True,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a file of this computer to ``path`` on the vehicle, as :meth:`write` does.

        Raises:
            VerificationFailed, RemoteProtocolError: as for :meth:`write`.
            OSError: the file cannot be read here. Nothing was sent.
        """
        await self.write(
            path,
            _content_of(source),
            verify=verify,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    async def truncate(
        self, path: str, size: int, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Cut a file to ``size`` bytes, or make it as long with zeros. PX4 can, ArduPilot cannot."""
        if not isinstance(size, int) or not 0 <= size <= LARGEST:
            raise InvalidArgument(f"size = {size!r} is not allowed: 0 to {LARGEST}")
        await self._request(MavFtpOpcode.TRUNCATEFILE, path, patience_s, timeout, offset=size)

    # --------------------------------------------------------------------- names and directories

    async def remove(
        self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Remove a file; on ArduPilot an empty directory, too."""
        await self._request(MavFtpOpcode.REMOVEFILE, path, patience_s, timeout)

    async def remove_directory(
        self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Remove an empty directory; on ArduPilot a file, too."""
        await self._request(MavFtpOpcode.REMOVEDIRECTORY, path, patience_s, timeout)

    async def make_directory(
        self, path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Make a directory; the one that it is in must exist."""
        await self._request(MavFtpOpcode.CREATEDIRECTORY, path, patience_s, timeout)

    async def rename(
        self, path: str, new_path: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> None:
        """Give a file or directory another name or place; both paths must fit into one message together."""
        data = path_bytes(path) + b"\0" + path_bytes(new_path) + b"\0"
        if len(data) > DATA_SIZE:
            raise InvalidArgument(
                f"path = {path!r} and new_path = {new_path!r} are not allowed together: {len(data) - 2} bytes,"
                f" one message has room for {DATA_SIZE - 2}"
            )
        await self._request(MavFtpOpcode.RENAME, path, patience_s, timeout, data=data)

    # ------------------------------------------------------------------------------------ inside

    async def _request(
        self,
        opcode: MavFtpOpcode,
        path: str,
        patience_s: float,
        timeout: float | None,
        *,
        offset: int = 0,
        data: bytes | None = None,
    ) -> FtpMessage:
        path_bytes(path)
        async with self._channel.operation(path, timeout=timeout, patience_s=patience_s):
            return await self._channel.request(opcode, path, patience_s=patience_s, offset=offset, data=data)

    async def _list_from(self, path: str, offset: int, patience_s: float) -> FtpMessage | None:
        """One message of a listing; None behind its end."""
        try:
            return await self._channel.request(
                MavFtpOpcode.LISTDIRECTORY, path, patience_s=patience_s, offset=offset
            )
        except FileError as error:
            if error.code == MavFtpErr.EOF:
                return None
            raise

    async def _fetch(
        self,
        path: str,
        into: Reassembly,
        patience_s: float,
        timeout: float | None,
        on_progress: OnProgress | None,
    ) -> None:
        path_bytes(path)
        channel = self._channel

        async def use(file: OpenFile) -> None:
            if file.size < into.start:
                raise _ShorterError
            if file.size < into.position and not is_virtual(path):
                raise RemoteProtocolError(f"read {path}: it became shorter while it was read")
            transfer = FtpDownload(
                channel.client,
                path,
                into,
                session=file.session,
                size=file.size,
                round_trip=self._transfers.round_trip,
                patience_s=patience_s,
                on_progress=on_progress,
            )
            await self._transfers.run(transfer)

        async with channel.operation(
            f"read {path}", timeout=timeout, patience_s=patience_s, missing=into.missing
        ):
            await channel.with_file(MavFtpOpcode.OPENFILERO, path, use, patience_s=patience_s)

    async def _fetch_to(
        self,
        part: PartFile,
        path: str,
        start: int,
        patience_s: float,
        timeout: float | None,
        on_progress: OnProgress | None,
    ) -> None:
        """Append to a file here what is missing from ``start`` on."""
        with part.writing(start) as disk:
            into = Reassembly(disk.write, block_size=DATA_SIZE, start=start)
            await self._fetch(path, into, patience_s, timeout, on_progress)

    async def _is_same(self, path: str, part: PartFile, patience_s: float, timeout: float | None) -> bool:
        try:
            theirs = await self.crc32(path, patience_s=patience_s, timeout=timeout)
        except FileError as error:
            if error.code in NO_CRC:
                return True
            raise
        return theirs == _crc32_of_file(part.path)

    async def _put(
        self, file: OpenFile, path: str, data: bytes, patience_s: float, on_progress: OnProgress | None
    ) -> None:
        transfer = FtpUpload(
            self._channel.client,
            path,
            data,
            session=file.session,
            round_trip=self._transfers.round_trip,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        await self._transfers.run(transfer)

    async def _verify(self, path: str, data: bytes, patience_s: float) -> None:
        ours = _crc32(data)
        try:
            reply = await self._channel.request(MavFtpOpcode.CALCFILECRC, path, patience_s=patience_s)
        except FileError as error:
            if error.code in NO_CRC:
                return
            raise
        theirs = _crc32_in(path, reply)
        if theirs != ours:
            difference = f"CRC-32 0x{theirs:08x} on the vehicle, 0x{ours:08x} here"
            raise VerificationFailed(
                f"{path} was written, and holds something else", differences=(difference,)
            )


class _ShorterError(Exception):
    """The vehicle's file is shorter than what was left of an interrupted download."""


def _content_of(source: str | os.PathLike[str]) -> bytes:
    return Path(source).read_bytes()


def _entry(text: bytes) -> FileEntry | None:
    """One entry of a listing; None for what is to be passed over."""
    kind, rest = text[:1], text[1:].decode("utf-8", "replace")
    if kind == b"D" and rest not in (".", ".."):
        return FileEntry(rest.partition("\t")[0], None, True)
    if kind == b"F":
        name, _, size = rest.partition("\t")
        return FileEntry(name, int(size) if size.isascii() and size.isdigit() else None, False)
    return None


def _crc32_in(path: str, reply: FtpMessage) -> int:
    if len(reply.data) < 4:
        raise RemoteProtocolError(f"{path}: the vehicle's CRC-32 has {len(reply.data)} bytes instead of 4")
    return int.from_bytes(reply.data[:4], "little")


def _crc32(data: bytes, before: int = 0) -> int:
    return zlib.crc32(data, before ^ LARGEST) ^ LARGEST


def _crc32_of_file(path: Path) -> int:
    crc = 0
    with path.open("rb") as disk:
        while data := disk.read(BLOCK):
            crc = _crc32(data, crc)
    return crc
