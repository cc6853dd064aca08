"""``Logs``: the flight logs on a vehicle, by MAVFTP or by the LOG_* messages."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, suppress
from datetime import datetime, timedelta, timezone
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.files import PartFile
from aerokit.errors import AerokitError, FileError, FileTimeout, InvalidArgument, OperationTimeout
from aerokit.mavlink.enums import MavFtpErr
from aerokit.mavlink.messages import LogErase
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.exchange import PATIENCE_S, OnProgress
from aerokit.protocols.logs import LOG_BLOCK, LogDownload, LogEnd, LogList
from aerokit.vehicle.files.log_paths import GrowthWatch, LogEntry, listed_logs, log_path

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncIterator, Callable

    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.transfers import Transfers

__all__ = ["LogEntry", "LogMethod", "Logs"]

LogMethod = Literal["auto", "ftp", "log"]
SILENT_REQUESTS = 4
"""So many unanswered requests for the list, and a PX4 is asked by MAVFTP whether it has any logs."""
LARGEST_ID = 0xFFFF
ERASE_PERIOD_S = 1.0
ERASE_PATIENCE_S = 60.0
CLOCKS_APART = timedelta(days=1)
"""The time of a log that is being written is the vehicle's clock, afterwards it is that of the file."""


@checks_arguments
class Logs:
    """Lists, downloads and erases flight logs. Operations follow each other in the order of their calls.

    Every method takes ``patience_s``, the seconds to go on while nothing comes, and ``timeout``, those for all of it
    (None: no limit). Every method may be cancelled at any moment; the vehicle is told to stop sending.

    ArduPilot answers to the LOG_* messages only while it is disarmed, and ends the log that it is writing when one is
    read by them; by MAVFTP its logs can be read in flight, too. Of a log that is being written comes what it has when
    it is asked for; if that is more than its entry says, logger "aerokit" tells so (INFO).
    """

    def __init__(self, transfers: Transfers, files: Files) -> None:
        self._transfers, self._files = transfers, files
        self._lock = asyncio.Lock()
        self._ending: asyncio.Event | None = None
        self._newest: LogEntry | None = None
        """In the last list: it may have been growing then."""

    async def list(
        self, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> tuple[LogEntry, ...]:
        """Return the logs that the vehicle has, the oldest first; an empty tuple when it has none.

        Raises:
            FileTimeout: not all entries came; the text names the missing ones.
        """
        async with self._operation("list of logs", timeout, patience_s):
            entries = await self._entries(patience_s)
        self._newest = entries[-1] if entries else None
        return entries

    async def download(
        self,
        log: LogEntry | int,
        to: str | os.PathLike[str],
        *,
        resume: bool = True,
        method: LogMethod = "auto",
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a log to the disk of this computer. It gets its name when it is complete.

        Of one that is being written, that is as far as it goes when it is asked for. Until then it is ``<to>.part`` by
        MAVFTP, ``<to>.log<id>-<time>.part`` by the LOG_* messages.

        Args:
            log: an entry of :meth:`list`, or its id.
            to: the file here.
            resume: go on where an interrupted download of this log to this file has ended; by LOG_* only when the
                vehicle tells its time.
            method: ``"ftp"``, ``"log"`` (the LOG_* messages), or ``"auto"``: what is faster with this autopilot, and
                the other one where that does not work. By MAVFTP it must be certain which file the log is.
            patience_s: see above.
            timeout: see above.
            on_progress: called with bytes, and the bytes there will be.

        Raises:
            InvalidArgument: an argument that cannot be right. Nothing was sent.
            FileError: there is no such log, or it cannot be reached by MAVFTP when that was asked for.
            FileTimeout: it did not arrive; ``missing`` has the ranges.
            OSError: the file cannot be written here.
        """
        _check(log)
        path, entry = await self._find(log, method, patience_s, timeout)
        growth = GrowthWatch(entry if isinstance(log, int) else log, on_progress)
        if path is not None:
            await self._files.download(
                path, to, resume=resume, patience_s=patience_s, timeout=timeout, on_progress=growth
            )
            growth.tell()
            return
        part = PartFile(to, _mark(entry))
        is_known = entry.time_utc is not None  # without a time, another flight's log may have the same mark
        start = part.size if resume and is_known and part.size <= entry.size else 0
        with part.writing(start) as disk:
            into = Reassembly(disk.write, block_size=LOG_BLOCK, start=start)
            await self._fetch(entry, into, patience_s, timeout, growth)
        part.finish()
        growth.tell()

    async def read(
        self,
        log: LogEntry | int,
        *,
        method: LogMethod = "auto",
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> bytes:
        """Return the content of a log; arguments as for :meth:`download`.

        Raises:
            InvalidArgument: an argument that cannot be right. Nothing was sent.
            FileError: there is no such log, or it cannot be reached by MAVFTP when that was asked for.
            FileTimeout: it did not arrive; ``missing`` has the ranges.
        """
        _check(log)
        path, entry = await self._find(log, method, patience_s, timeout)
        growth = GrowthWatch(entry if isinstance(log, int) else log, on_progress)
        if path is not None:
            content = await self._files.read(path, patience_s=patience_s, timeout=timeout, on_progress=growth)
        else:
            blocks = bytearray()
            into = Reassembly(blocks.extend, block_size=LOG_BLOCK)
            await self._fetch(entry, into, patience_s, timeout, growth)
            content = bytes(blocks)
        growth.tell()
        return content

    async def erase(self, *, patience_s: float = ERASE_PATIENCE_S, timeout: float | None = None) -> None:
        """Erase all logs, and wait until they are gone; that can take minutes on some boards.

        LOG_ERASE is not acknowledged: the list tells. A log that the vehicle has begun meanwhile may be there.

        Raises:
            FileTimeout: there are still logs of before.
        """
        async with self._operation("erase logs", timeout, patience_s):
            before = {(entry.time_utc, entry.size) for entry in await self._entries(PATIENCE_S)}
            until = self._transfers.connection.now() + patience_s
            while before:
                self._transfers.connection.send(
                    LogErase(self._transfers.system_id, self._transfers.component_id)
                )
                await anyio.sleep(ERASE_PERIOD_S)
                now_there = {(entry.time_utc, entry.size) for entry in await self._entries(PATIENCE_S)}
                before &= now_there
                if before and self._transfers.connection.now() >= until:
                    raise FileTimeout(f"erase logs: {len(before)} are still there after {patience_s:g} s")

    # ----------------------------------------------------------------------------- finding

    async def _find(
        self, log: LogEntry | int, method: LogMethod, patience_s: float, timeout: float | None
    ) -> tuple[str | None, LogEntry]:
        """Where it is for MAVFTP (None: by LOG_*), and its entry, which LOG_* needs to be fresh."""
        prefers_messages = method == "log" or (
            method == "auto" and self._transfers.autopilot.logs_by_messages
        )
        if isinstance(log, LogEntry) and not prefers_messages:
            path = await self._path(log, patience_s)
            if path is not None:
                return path, log
        try:
            entry = await self._entry(log, patience_s, timeout, may_be_silent=method == "auto")
        except FileTimeout:  # ArduPilot while it is armed
            path = (
                await self._path(log, patience_s) if isinstance(log, LogEntry) and method == "auto" else None
            )
            if path is None or not isinstance(log, LogEntry):
                raise
            return path, log
        if prefers_messages:
            return None, entry
        path = await self._path(entry, patience_s)
        if path is None and method == "ftp":
            raise _no_such_log(entry.id, "it is not certain which file on the vehicle it is")
        return path, entry

    async def _path(self, entry: LogEntry, patience_s: float) -> str | None:
        directories = self._transfers.autopilot.log_directories
        if not directories or not await self._files.is_supported():
            return None
        return await log_path(self._files, directories, entry, patience_s, has_grown=entry == self._newest)

    async def _entry(
        self, log: LogEntry | int, patience_s: float, timeout: float | None, *, may_be_silent: bool
    ) -> LogEntry:
        """The fresh entry of a log. Asked for one that it has not, ArduPilot lists what it has not without an end."""
        log_id, only = (log, None) if isinstance(log, int) else (log.id, log.id)
        async with self._operation(f"log {log_id}", timeout, patience_s):
            entries = await self._entries(patience_s, only, SILENT_REQUESTS if may_be_silent else None)
        for entry in entries:
            if entry.id == log_id:
                if isinstance(log, LogEntry) and _is_other(log, entry):
                    break
                return entry
        text = (
            "there is no such log"
            if isinstance(log, int)
            else "the vehicle's logs are others now, list them again"
        )
        raise _no_such_log(log_id, text)

    async def _entries(
        self, patience_s: float, only: int | None = None, most_unanswered: int | None = None
    ) -> tuple[LogEntry, ...]:
        """What the vehicle lists. ArduPilot also lists logs that were erased, with nothing in them."""
        entries = await self._listed_somehow(patience_s, only, most_unanswered)
        return tuple(entry for entry in entries if entry.size)

    async def _listed_somehow(
        self, patience_s: float, only: int | None, most_unanswered: int | None
    ) -> tuple[LogEntry, ...]:
        autopilot = self._transfers.autopilot
        if not autopilot.silent_without_logs or not await self._files.is_supported():
            return await self._listed(patience_s, only, most_unanswered=most_unanswered)
        with suppress(FileTimeout):
            return await self._listed(patience_s, only, most_unanswered=SILENT_REQUESTS)
        logs = await listed_logs(self._files, autopilot.log_directories, patience_s)
        if logs is None:
            return await self._listed(patience_s, only, most_unanswered=None)
        return tuple(_make_entry(number, log.size, log.time_utc) for number, log in enumerate(logs))

    async def _listed(
        self, patience_s: float, only: int | None, *, most_unanswered: int | None
    ) -> tuple[LogEntry, ...]:
        exchange = LogList(
            self._transfers.system_id,
            self._transfers.component_id,
            first_id=self._transfers.autopilot.first_log_id,
            start=only,
            end=only,
            most_unanswered=most_unanswered,
            round_trip=self._transfers.round_trip,
            patience_s=patience_s,
        )
        entries = await self._transfers.run(exchange)
        return tuple(_make_entry(each.id, each.size, each.time_utc) for each in entries)

    # --------------------------------------------------------------------------- transfer

    async def _fetch(
        self,
        entry: LogEntry,
        into: Reassembly,
        patience_s: float,
        timeout: float | None,
        on_progress: OnProgress,
    ) -> None:
        exchange = LogDownload(
            self._transfers.system_id,
            self._transfers.component_id,
            entry.id,
            entry.size,
            into,
            round_trip=self._transfers.round_trip,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        missing = lambda: into.missing(entry.size)  # noqa: E731
        async with self._operation(f"log {entry.id}", timeout, patience_s, missing):
            await self._transfers.run(exchange)

    @asynccontextmanager
    async def _operation(
        self,
        what: str,
        timeout: float | None,
        patience_s: float,
        missing: Callable[[], tuple[tuple[int, int], ...]] = tuple,
    ) -> AsyncIterator[None]:
        """Wait for one's turn; tell the vehicle to stop when it ends before its end."""
        try:
            with anyio.fail_after(timeout):
                async with self._lock:
                    if self._ending is not None:
                        await self._ending.wait()
                    try:
                        yield
                    except BaseException:
                        self._end()
                        raise
        except OperationTimeout:
            raise
        except TimeoutError:
            raise FileTimeout(f"{what}: not done within {timeout:g} s", missing=missing()) from None

    def _end(self) -> None:
        """Have the vehicle stop sending at once, and make sure of it in the background before the next operation."""
        exchange = LogEnd(
            self._transfers.system_id,
            self._transfers.component_id,
            is_sent=True,
            round_trip=self._transfers.round_trip,
        )
        ended = asyncio.Event()

        async def confirm() -> None:
            try:
                with suppress(AerokitError):
                    await self._transfers.run(exchange)
            finally:
                ended.set()

        with suppress(AerokitError):  # when nothing can be sent any more, there is nobody to tell
            self._transfers.connection.send(exchange.message)
            self._ending = ended
            self._transfers.background.start(confirm, "aerokit end of logs")


def _check(log: LogEntry | int) -> None:
    log_id = log.id if isinstance(log, LogEntry) else log
    if not isinstance(log_id, int) or not 0 <= log_id <= LARGEST_ID:
        raise InvalidArgument(f"log = {log!r} is not allowed: an entry, or an id from 0 to {LARGEST_ID}")


def _make_entry(log_id: int, size: int, time_utc: int) -> LogEntry:
    return LogEntry(log_id, size, datetime.fromtimestamp(time_utc, tz=timezone.utc) if time_utc else None)


def _is_other(before: LogEntry, now: LogEntry) -> bool:
    """Logs grow while they are written; they do not shrink, and do not become much older."""
    if now.size < before.size:
        return True
    if before.time_utc is None:
        return False
    return now.time_utc is None or now.time_utc < before.time_utc - CLOCKS_APART


def _no_such_log(log_id: int, text: str) -> FileError:
    return FileError(f"log {log_id}: {text}", path=f"log {log_id}", code=MavFtpErr.FILENOTFOUND)


def _mark(entry: LogEntry) -> str:
    """What tells this log from others, for the name of its beginning on the disk."""
    written_at = 0 if entry.time_utc is None else int(entry.time_utc.timestamp())
    return f".log{entry.id}-{written_at}"
