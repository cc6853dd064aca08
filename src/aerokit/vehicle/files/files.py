"""``Files``: the files on a vehicle by MAVFTP (https://mavlink.io/en/services/ftp.html)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.files import PartFile
from aerokit._internal.values import Snapshot
from aerokit.errors import FileError, InvalidArgument, RemoteProtocolError, VerificationFailed
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.exchange import IDLE_TIMEOUT_S, OnProgress
from aerokit.protocols.ftp import DATA_SIZE, crc32, path_bytes
from aerokit.protocols.ftp_transfer import FtpDownload, FtpUpload, is_virtual
from aerokit.vehicle.files.channel import FileChannel

if TYPE_CHECKING:
    import os

    from aerokit.protocols.ftp import FtpMessage
    from aerokit.vehicle.files.channel import RemoteFile
    from aerokit.vehicle.session.transfers import Transfers

__all__ = ["FileEntry", "Files"]

CAPABILITY_FTP = 0x20
CRC_UNSUPPORTED = (MavFtpErr.FAIL, MavFtpErr.UNKNOWNCOMMAND)
MAX_FILE_SIZE = 0xFFFFFFFF
BLOCK_SIZE = 1 << 16
# A directory listing counts as endless after this many consecutive replies without a new entry, or this many entries.
MAX_REPLIES_WITHOUT_NEW_ENTRY, MAX_ENTRIES = 50, 1_000_000


class FileEntry(Snapshot):
    """One entry of a directory.

    ``size`` is in bytes. It is None for a directory, and for a file whose size the vehicle does not report.
    """

    name: str
    size: int | None
    is_directory: bool


@checks_arguments
class Files:
    """Reads, writes and lists files on the vehicle. Operations run one at a time, in the order of their calls.

    Paths are the vehicle's: ``/APM/LOGS`` and ``@PARAM/param.pck`` on ArduPilot, ``/fs/microsd/log`` on PX4.

    All methods but ``is_supported`` take ``idle_timeout_s`` (fail after this many seconds without progress) and
    ``timeout`` (seconds in total, including the wait for earlier operations; None for no limit). For a resumed
    download, ``timeout`` limits each step: reading, comparing the CRC-32, and reading again. ``on_progress`` is called
    with the progress in bytes. You can cancel any call; the file is then closed on the vehicle.

    Every method but ``is_supported`` raises:
        InvalidArgument: a path is empty, contains NUL, cannot be encoded, or has more than 238 bytes. Nothing was sent.
        FileError: the vehicle refused; see ``code`` and ``errno``.
        FileTimeout: the operation did not finish; ``missing`` has the missing ranges as (offset, size) in bytes.
    """

    def __init__(self, transfers: Transfers) -> None:
        self._transfers = transfers
        self._channel = FileChannel(transfers)

    async def is_supported(self) -> bool:
        """Return True if the vehicle reports support for MAVFTP.

        Without an answer within three seconds, the result is False.
        """
        capabilities = await self._transfers.capabilities()
        return capabilities is not None and bool(capabilities & CAPABILITY_FTP)

    async def read(
        self,
        path: str,
        *,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> bytes:
        """Return the content of a file.

        Raises:
            RemoteProtocolError: the vehicle's answers are invalid, or its file became shorter during the read.
        """
        content = bytearray()
        await self._fetch(path, Reassembly(content.extend, block_size=DATA_SIZE), idle_timeout_s, timeout, on_progress)
        return bytes(content)

    async def download(
        self,
        path: str,
        to: str | os.PathLike[str],
        *,
        resume: bool = False,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a file to this computer. The copy is written to ``<to>.part`` and replaces ``to`` when it is complete.

        An interrupted download leaves ``<to>.part`` for a later one. With ``resume``, the download continues this file,
        unless the vehicle's file is shorter. After a resumed download, aerokit compares the CRC-32 of both files, if
        the vehicle can compute it. If they differ, the whole file is read again. Files whose names begin with ``@`` are
        always read completely.

        Raises:
            RemoteProtocolError: as for :meth:`read`.
            OSError: the local file cannot be written, or another download of this program is writing it.
        """
        path_bytes(path)  # Raises InvalidArgument before anything is written or sent.
        with PartFile(to) as part:
            start = part.size if resume and not is_virtual(path) else 0
            try:
                await self._fetch_to(part, path, start, idle_timeout_s, timeout, on_progress)
                # A resumed copy may consist of parts of two different files, so its checksum is compared with that of
                # the vehicle's file.
                is_correct = not start or await self._has_same_crc(path, part, idle_timeout_s, timeout)
            except _ShorterError:  # The vehicle's file is shorter than the part, so the download starts again.
                is_correct = False
            if not is_correct:
                await self._fetch_to(part, path, 0, idle_timeout_s, timeout, on_progress)
            part.finish()

    async def list(
        self, path: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> tuple[FileEntry, ...]:
        """List a directory, without ``.`` and ``..``, in the vehicle's order.

        Raises:
            RemoteProtocolError: the listing does not end.
        """
        path_bytes(path)  # Raises InvalidArgument before anything is sent.
        entries: dict[str, FileEntry] = {}
        offset = 0  # number of entries that were listed or skipped so far
        replies_without_new_entry = 0
        async with self._channel.operation(f"list {path}", timeout=timeout, idle_timeout_s=idle_timeout_s):
            while (reply := await self._list_from(path, offset, idle_timeout_s)) is not None:
                listed = [text for text in reply.data.split(b"\0") if text]
                count_before = len(entries)
                for text in listed:
                    entry = _parse_entry(text)
                    if entry is not None:
                        entries[entry.name] = entry
                # A reply is empty if the name of the next entry is too long for a message. That entry is skipped.
                offset += max(len(listed), 1)
                has_new_entry = len(entries) > count_before
                replies_without_new_entry = 0 if has_new_entry else replies_without_new_entry + 1
                if replies_without_new_entry > MAX_REPLIES_WITHOUT_NEW_ENTRY or offset > MAX_ENTRIES:
                    raise RemoteProtocolError(
                        f"list {path}: the vehicle's listing does not end; the last entry was number {offset}"
                    )
        return tuple(entries.values())

    async def crc32(self, path: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None) -> int:
        """Return the CRC-32 of a file, computed by the vehicle: polynomial 0x04C11DB7, initial value 0, no final XOR.

        ``zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF`` computes the same value.

        Raises:
            RemoteProtocolError: the vehicle's answer has no CRC-32.
        """
        reply = await self._request(MavFtpOpcode.CALCFILECRC, path, idle_timeout_s, timeout)
        return _crc32_in(path, reply)

    async def write(
        self,
        path: str,
        data: bytes,
        *,
        verify: bool = True,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Write a file. An existing file is replaced; its old content is lost as soon as the write begins.

        ``verify`` compares the CRC-32 afterwards, if the vehicle can compute it. Files whose names begin with ``@`` are
        not verified: the vehicle evaluates them when they are closed, and does not report the result.

        Raises:
            VerificationFailed: the vehicle acknowledged everything, but the file has other content.
            RemoteProtocolError: the vehicle's answer has no CRC-32.
        """
        path_bytes(path)  # Raises InvalidArgument before anything is sent.
        data = bytes(data)
        if len(data) > MAX_FILE_SIZE:
            raise InvalidArgument(f"data of {len(data)} bytes is not allowed: it must have at most {MAX_FILE_SIZE}")
        channel = self._channel
        async with channel.operation(
            f"write {path}",
            timeout=timeout,
            idle_timeout_s=idle_timeout_s,
            missing=lambda: ((0, len(data)),),  # After a failure, the whole file must be written again.
        ):
            await channel.with_file(
                MavFtpOpcode.CREATEFILE,
                path,
                lambda file: self._upload_to(file, path, data, idle_timeout_s, on_progress),
                idle_timeout_s=idle_timeout_s,
            )
            if verify and not is_virtual(path):
                await self._verify(path, data, idle_timeout_s)

    async def upload(
        self,
        source: str | os.PathLike[str],
        path: str,
        *,
        verify: bool = True,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a local file to ``path`` on the vehicle. ``verify`` is as for :meth:`write`.

        Raises:
            VerificationFailed, RemoteProtocolError: as for :meth:`write`.
            OSError: the local file cannot be read. Nothing was sent.
        """
        await self.write(
            path,
            _content_of(source),
            verify=verify,
            idle_timeout_s=idle_timeout_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    async def truncate(
        self, path: str, size: int, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> None:
        """Cut a file to ``size`` bytes, or extend it with zeros. Supported by PX4, not by ArduPilot."""
        if not isinstance(size, int) or not 0 <= size <= MAX_FILE_SIZE:
            raise InvalidArgument(f"size = {size!r} is not allowed: it must be 0 to {MAX_FILE_SIZE}")
        await self._request(MavFtpOpcode.TRUNCATEFILE, path, idle_timeout_s, timeout, offset=size)

    async def remove(self, path: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None) -> None:
        """Remove a file; on ArduPilot also an empty directory."""
        await self._request(MavFtpOpcode.REMOVEFILE, path, idle_timeout_s, timeout)

    async def remove_directory(
        self, path: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> None:
        """Remove an empty directory; on ArduPilot also a file."""
        await self._request(MavFtpOpcode.REMOVEDIRECTORY, path, idle_timeout_s, timeout)

    async def make_directory(
        self, path: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> None:
        """Create a directory; its parent must exist."""
        await self._request(MavFtpOpcode.CREATEDIRECTORY, path, idle_timeout_s, timeout)

    async def rename(
        self, path: str, new_path: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> None:
        """Rename or move a file or directory. Both paths together may have at most 237 bytes (one message)."""
        data = path_bytes(path) + b"\0" + path_bytes(new_path) + b"\0"
        if len(data) > DATA_SIZE:
            raise InvalidArgument(
                f"path = {path!r} and new_path = {new_path!r} are not allowed together: they have"
                f" {len(data) - 2} bytes, but one message holds {DATA_SIZE - 2}"
            )
        await self._request(MavFtpOpcode.RENAME, path, idle_timeout_s, timeout, data=data)

    async def _request(
        self,
        opcode: MavFtpOpcode,
        path: str,
        idle_timeout_s: float,
        timeout: float | None,
        *,
        offset: int = 0,
        data: bytes | None = None,
    ) -> FtpMessage:
        path_bytes(path)  # Raises InvalidArgument before anything is sent.
        async with self._channel.operation(path, timeout=timeout, idle_timeout_s=idle_timeout_s):
            return await self._channel.request(opcode, path, idle_timeout_s=idle_timeout_s, offset=offset, data=data)

    async def _list_from(self, path: str, offset: int, idle_timeout_s: float) -> FtpMessage | None:
        """Return one message of a listing, or None after its end."""
        try:
            return await self._channel.request(
                MavFtpOpcode.LISTDIRECTORY, path, idle_timeout_s=idle_timeout_s, offset=offset
            )
        except FileError as error:
            if error.code == MavFtpErr.EOF:
                return None
            raise

    async def _fetch(
        self,
        path: str,
        into: Reassembly,
        idle_timeout_s: float,
        timeout: float | None,
        on_progress: OnProgress | None,
    ) -> None:
        path_bytes(path)  # Raises InvalidArgument before anything is sent.
        channel = self._channel

        async def read_file(file: RemoteFile) -> None:
            if file.size < into.start:  # The file is shorter than what an interrupted download has already read.
                raise _ShorterError
            # A file that the vehicle closes during the read is opened again, so its size may have changed.
            if file.size < into.position and not is_virtual(path):
                raise RemoteProtocolError(f"read {path}: the file became shorter during the read")
            transfer = FtpDownload(
                channel.client,
                path,
                into,
                session=file.session,
                size=file.size,
                round_trip=self._transfers.round_trip,
                idle_timeout_s=idle_timeout_s,
                on_progress=on_progress,
            )
            await self._transfers.run(transfer)

        async with channel.operation(
            f"read {path}", timeout=timeout, idle_timeout_s=idle_timeout_s, missing=into.missing
        ):
            await channel.with_file(MavFtpOpcode.OPENFILERO, path, read_file, idle_timeout_s=idle_timeout_s)

    async def _fetch_to(
        self,
        part: PartFile,
        path: str,
        start: int,
        idle_timeout_s: float,
        timeout: float | None,
        on_progress: OnProgress | None,
    ) -> None:
        with part.writing(start) as disk:
            into = Reassembly(disk.write, block_size=DATA_SIZE, start=start)
            await self._fetch(path, into, idle_timeout_s, timeout, on_progress)

    async def _has_same_crc(self, path: str, part: PartFile, idle_timeout_s: float, timeout: float | None) -> bool:
        """Return True if both files have the same CRC-32, or if the vehicle cannot compute it."""
        try:
            vehicle_crc = await self.crc32(path, idle_timeout_s=idle_timeout_s, timeout=timeout)
        except FileError as error:
            if error.code in CRC_UNSUPPORTED:
                return True
            raise
        return vehicle_crc == _crc32_of_file(part.path)

    async def _upload_to(
        self, file: RemoteFile, path: str, data: bytes, idle_timeout_s: float, on_progress: OnProgress | None
    ) -> None:
        transfer = FtpUpload(
            self._channel.client,
            path,
            data,
            session=file.session,
            first_block_last=is_virtual(path) and self._transfers.autopilot.evaluates_incomplete_files,
            round_trip=self._transfers.round_trip,
            idle_timeout_s=idle_timeout_s,
            on_progress=on_progress,
        )
        await self._transfers.run(transfer)

    async def _verify(self, path: str, data: bytes, idle_timeout_s: float) -> None:
        own_crc = crc32(data)
        try:
            reply = await self._channel.request(MavFtpOpcode.CALCFILECRC, path, idle_timeout_s=idle_timeout_s)
        except FileError as error:
            if error.code in CRC_UNSUPPORTED:
                return
            raise
        vehicle_crc = _crc32_in(path, reply)
        if vehicle_crc != own_crc:
            difference = f"CRC-32 0x{vehicle_crc:08x} on the vehicle, 0x{own_crc:08x} here"
            raise VerificationFailed(
                f"{path} was written, but has other content on the vehicle", differences=(difference,)
            )


class _ShorterError(Exception):
    """The vehicle's file is shorter than what an interrupted download has already received."""


def _content_of(source: str | os.PathLike[str]) -> bytes:
    return Path(source).read_bytes()


def _parse_entry(text: bytes) -> FileEntry | None:
    """Parse one entry of a listing. Return None for an entry to skip."""
    # The kind is D for a directory and F for a file. MAVFTP also has S for an entry to skip.
    kind, name_and_size = text[:1], text[1:].decode("utf-8", "replace")
    name, _, size_text = name_and_size.partition("\t")
    if kind == b"D" and name_and_size not in (".", ".."):
        return FileEntry(name, size=None, is_directory=True)
    if kind == b"F":
        size = int(size_text) if size_text.isascii() and size_text.isdigit() else None
        return FileEntry(name, size=size, is_directory=False)
    return None


def _crc32_in(path: str, reply: FtpMessage) -> int:
    if len(reply.data) < 4:
        raise RemoteProtocolError(f"{path}: the vehicle's CRC-32 has {len(reply.data)} bytes instead of 4")
    return int.from_bytes(reply.data[:4], "little")


def _crc32_of_file(path: Path) -> int:
    crc = 0
    with path.open("rb") as disk:
        while data := disk.read(BLOCK_SIZE):
            crc = crc32(data, crc)
    return crc
