"""``Logs``: the flight logs on a vehicle, by MAVFTP or by the LOG_* messages."""

from __future__ import annotations

import logging
import re
from datetime import datetime, timedelta, timezone
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.files import PartFile
from aerokit._internal.values import Snapshot
from aerokit.errors import FileError, FileTimeout, InvalidArgument
from aerokit.mavlink.enums import MavFtpErr
from aerokit.mavlink.messages import LogErase
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.exchange import IDLE_TIMEOUT_S, OnProgress
from aerokit.protocols.logs import LOG_BLOCK
from aerokit.vehicle.files.channel import LogChannel
from aerokit.vehicle.files.log_stream import LogStream

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

    from aerokit.mavlink.messages import LogEntry as LogMessage
    from aerokit.protocols.exchange import TransferProgress
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.files.files import FileEntry, Files
    from aerokit.vehicle.session.transfers import Transfers

__all__ = ["LogEntry", "LogMethod", "Logs"]

LogMethod = Literal["auto", "ftp", "log"]
# PX4 does not answer if it has no logs. After this many unanswered requests, its log directory is read by MAVFTP, which
# shows whether there are logs.
MAX_UNANSWERED_REQUESTS = 4
MAX_LOG_ID = 0xFFFF
ERASE_RETRY_INTERVAL_S = 1.0
ERASE_TIMEOUT_S = 60.0
# While a log is being written, its time is that of the vehicle's clock, and later that of its file. The two times may
# differ by this much.
MAX_CLOCK_DIFFERENCE = timedelta(days=1)
ARDUPILOT_NAME = re.compile(r"(\d{8})\.BIN", re.IGNORECASE)
PX4_LIST = "logdata.txt"
PX4_LINE = re.compile(r"(\d+) (\d+) (\S+)")
logger: logging.Logger = logging.getLogger("aerokit")


class LogEntry(Snapshot):
    """One flight log: id for :meth:`Logs.download`, size in bytes, and time of the last write.

    The time is None if unknown to the vehicle; the size of a log that is still being written is a snapshot.
    """

    id: int
    size: int
    time_utc: datetime | None


class _LocatedLog(NamedTuple):
    entry: LogEntry
    path: str | None  # for MAVFTP; None to use LOG_* messages


class GrowthReporter:
    """Forwards the progress of a download, and logs an INFO message if the flight log is larger than listed."""

    def __init__(self, entry: LogEntry, on_progress: OnProgress | None) -> None:
        self._entry, self._on_progress = entry, on_progress
        # Size of the log in bytes, as the vehicle reports it during the download.
        self._present_size = entry.size

    def __call__(self, progress: TransferProgress) -> None:
        if progress.total:
            self._present_size = progress.total
        if self._on_progress is not None:
            self._on_progress(progress)

    def report(self) -> None:
        if self._present_size > self._entry.size:
            logger.info(
                "flight log %d was still being written: listed with %d bytes, downloaded with %d",
                self._entry.id,
                self._entry.size,
                self._present_size,
            )


@checks_arguments
class Logs:
    """Lists, downloads and erases flight logs. Operations run one at a time, in the order of their calls.

    All methods take ``idle_timeout_s`` (fail after this many seconds without progress) and, except ``stream``,
    ``timeout`` (seconds in total; None for no limit). For ``download`` and ``read``, ``timeout`` limits each step:
    finding the log, and reading it. You can cancel any call; the vehicle then stops sending.

    ArduPilot answers LOG_* messages only while disarmed. When such a message requests a log, ArduPilot ends the log
    that it is writing. By MAVFTP, logs can also be read in flight. A log that is still being written is read up to its
    current end. If such a log is larger than its entry says, logger "aerokit" reports that (INFO).
    """

    def __init__(self, transfers: Transfers, files: Files, context: VehicleContext) -> None:
        self._transfers, self._files, self._context = transfers, files, context
        self._channel = LogChannel(transfers)
        # The newest log of the last list. The vehicle may still have been writing this log at that time.
        self._newest: LogEntry | None = None

    async def list(
        self, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> tuple[LogEntry, ...]:
        """Return the logs on the vehicle, oldest first; an empty tuple if there are none.

        Raises:
            FileTimeout: entries are missing; the text names them.
        """
        async with self._channel.operation("list of logs", timeout):
            entries = await self._entries(idle_timeout_s)
        self._newest = entries[-1] if entries else None
        return entries

    async def download(
        self,
        log: LogEntry | int,
        to: str | os.PathLike[str],
        *,
        resume: bool = True,
        method: LogMethod = "auto",
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a log to this computer. A log that is still being written is read up to its current end.

        Until the download is complete, the local file is named ``<to>.part`` (MAVFTP) or ``<to>.log<id>-<time>.part``
        (LOG_*).

        Args:
            log: an entry of :meth:`list`, or its id.
            to: path of the local file.
            resume: continue an interrupted download of this log to this file. By LOG_* this works only if the vehicle
                reports the time of the log.
            method: ``"ftp"``, ``"log"`` (the LOG_* messages), or ``"auto"``: the faster of the two for this autopilot,
                or the slower if the faster is not available. MAVFTP requires that the log's file can be identified.
            idle_timeout_s: fail after this many seconds without progress.
            timeout: seconds for each step: finding the log, and reading it.
            on_progress: called with the bytes so far and in total.

        Raises:
            InvalidArgument: an argument is invalid. Nothing was sent.
            FileError: there is no such log, the logs have changed since :meth:`list`, or ``method`` is ``"ftp"`` and
                the file of the log cannot be identified.
            FileTimeout: the log did not arrive completely; ``missing`` has the missing ranges as (offset, size) in
                bytes.
            OSError: the local file cannot be written, or another download of this program is writing it.
        """
        _check_id(log)
        entry, path = await self._locate(log, method, idle_timeout_s, timeout)
        growth = GrowthReporter(log if isinstance(log, LogEntry) else entry, on_progress)
        if path is not None:
            await self._files.download(
                path, to, resume=resume, idle_timeout_s=idle_timeout_s, timeout=timeout, on_progress=growth
            )
            growth.report()
            return
        with PartFile(to, _part_suffix(entry)) as part:
            # The time of the log is part of the file name's suffix. If the time is unknown, the part file may belong
            # to another flight, so it must not be continued.
            has_time = entry.time_utc is not None
            start = part.size if resume and has_time and part.size <= entry.size else 0
            with part.writing(start) as disk:
                into = Reassembly(disk.write, block_size=LOG_BLOCK, start=start)
                await self._channel.download(entry.id, entry.size, into, idle_timeout_s, timeout, growth)
            part.finish()
        growth.report()

    async def read(
        self,
        log: LogEntry | int,
        *,
        method: LogMethod = "auto",
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> bytes:
        """Return the content of a log; arguments as for :meth:`download`.

        Raises:
            InvalidArgument: an argument is invalid. Nothing was sent.
            FileError: there is no such log, the logs have changed since :meth:`list`, or ``method`` is ``"ftp"`` and
                the file of the log cannot be identified.
            FileTimeout: the log did not arrive completely; ``missing`` has the missing ranges as (offset, size) in
                bytes.
        """
        _check_id(log)
        entry, path = await self._locate(log, method, idle_timeout_s, timeout)
        growth = GrowthReporter(log if isinstance(log, LogEntry) else entry, on_progress)
        if path is not None:
            content = await self._files.read(path, idle_timeout_s=idle_timeout_s, timeout=timeout, on_progress=growth)
        else:
            blocks = bytearray()
            into = Reassembly(blocks.extend, block_size=LOG_BLOCK)
            await self._channel.download(entry.id, entry.size, into, idle_timeout_s, timeout, growth)
            content = bytes(blocks)
        growth.report()
        return content

    async def erase(self, *, idle_timeout_s: float = ERASE_TIMEOUT_S, timeout: float | None = None) -> None:
        """Erase all logs and wait until they are gone, which can take minutes on some boards.

        LOG_ERASE is not acknowledged, so it is repeated until the list of logs shows the effect. A log that was started
        meanwhile may remain.

        Raises:
            FileTimeout: some of the old logs still exist.
        """
        async with self._channel.operation("erase logs", timeout):
            watch = self._context.session.watch
            raise_if_other_boot = partial(
                watch.raise_if_other_boot,
                watch.other_boots,
                "the previous vehicle may have erased its logs",
                action="erase logs",
            )
            remaining = await self._entries(IDLE_TIMEOUT_S)
            raise_if_other_boot()
            progress_at = self._transfers.connection.now()
            while remaining:
                self._transfers.connection.send(LogErase(self._transfers.system_id, self._transfers.component_id))
                await anyio.sleep(ERASE_RETRY_INTERVAL_S)
                count_before = len(remaining)
                # `idle_timeout_s` is long, because some boards do not answer while they erase.
                listed = await self._entries(idle_timeout_s)
                raise_if_other_boot()
                remaining = _still_listed(remaining, listed)
                now = self._transfers.connection.now()
                if len(remaining) < count_before:
                    progress_at = now
                elif now - progress_at >= idle_timeout_s:
                    raise FileTimeout(
                        f"erase logs: {len(remaining)} logs still exist;"
                        f" none was erased in the last {idle_timeout_s:g} s"
                    )

    def stream(self, *, idle_timeout_s: float = IDLE_TIMEOUT_S) -> LogStream:
        """Receive the flight log while PX4 writes it, during an ``async with`` block (MAV_CMD_LOGGING_START).

        Example::

            async with vehicle.logs.stream() as stream:
                async for data in stream:
                    file.write(data)

        Args:
            idle_timeout_s: reading fails after this many seconds without data; above 0, at most 3600.

        Raises:
            InvalidArgument: the time is out of range. Nothing was sent.
        """
        check_range("idle_timeout_s", idle_timeout_s, 0, 3600, above=True)
        return LogStream(self._context, idle_timeout_s)

    async def _locate(
        self, log: LogEntry | int, method: LogMethod, idle_timeout_s: float, timeout: float | None
    ) -> _LocatedLog:
        prefers_messages = method == "log" or (method == "auto" and self._transfers.autopilot.prefers_log_messages)
        if not prefers_messages:
            located = await self._locate_file(log, idle_timeout_s)
            if located is not None:
                return located
        try:
            # With "auto", another method may work, so give up early.
            max_unanswered = MAX_UNANSWERED_REQUESTS if method == "auto" else None
            entry = await self._entry(log, idle_timeout_s, timeout, max_unanswered)
        except FileTimeout:
            # ArduPilot does not answer LOG_* messages while it is armed. MAVFTP can read a log whose entry is known.
            located = await self._locate_file(log, idle_timeout_s) if method == "auto" else None
            if located is None:
                raise
            return located
        if prefers_messages:
            return _LocatedLog(entry, path=None)
        path = await self._path(entry, idle_timeout_s)
        if path is None and method == "ftp":
            raise _no_such_log(entry.id, "its file on the vehicle cannot be identified")
        return _LocatedLog(entry, path)

    async def _locate_file(self, log: LogEntry | int, idle_timeout_s: float) -> _LocatedLog | None:
        if isinstance(log, int):  # The file is identified by its size, which is not known yet.
            return None
        path = await self._path(log, idle_timeout_s)
        return None if path is None else _LocatedLog(log, path)

    async def _path(self, entry: LogEntry, idle_timeout_s: float) -> str | None:
        """Return the path of a log for MAVFTP, or None if MAVFTP cannot be used for it."""
        directories = self._transfers.autopilot.log_directories
        if not directories or not await self._files.is_supported():
            return None
        return await log_path(self._files, directories, entry, idle_timeout_s, may_have_grown=entry == self._newest)

    async def _entry(
        self, log: LogEntry | int, idle_timeout_s: float, timeout: float | None, max_unanswered: int | None
    ) -> LogEntry:
        log_id = log if isinstance(log, int) else log.id
        # For an id, request the whole list, because the log may not exist. ArduPilot answers the request for a single
        # nonexistent log by an endless list of nonexistent logs.
        only_id = None if isinstance(log, int) else log.id
        async with self._channel.operation(f"log {log_id}", timeout):
            entries = await self._entries(idle_timeout_s, only_id, max_unanswered)
        current = next((entry for entry in entries if entry.id == log_id), None)
        if current is None and isinstance(log, int):
            raise _no_such_log(log_id, "there is no such log")
        if current is None or (isinstance(log, LogEntry) and _is_different_log(log, current)):
            raise _no_such_log(log_id, "the logs on the vehicle have changed: call list() again")
        return current

    async def _entries(
        self, idle_timeout_s: float, only_id: int | None = None, max_unanswered: int | None = None
    ) -> tuple[LogEntry, ...]:
        autopilot, request_list = self._transfers.autopilot, self._channel.list
        logs: Sequence[LogMessage | ListedLog] | None = None
        # PX4 does not answer if it has no logs. Its list file shows whether it has some.
        if autopilot.silent_without_logs and await self._files.is_supported():
            try:
                logs = await request_list(idle_timeout_s, only_id, max_unanswered=MAX_UNANSWERED_REQUESTS)
            except FileTimeout:
                logs = await listed_logs(self._files, autopilot.log_directories, idle_timeout_s)
                # If `logs` is None, there are logs but no list file. PX4 then answers sooner or later, so the request
                # is repeated until the time-out.
                max_unanswered = None
        if logs is None:
            logs = await request_list(idle_timeout_s, only_id, max_unanswered=max_unanswered)
        # ArduPilot lists erased logs with a size of 0.
        return tuple(_entry_of(log) for log in logs if log.size)


def _check_id(log: LogEntry | int) -> None:
    log_id = log.id if isinstance(log, LogEntry) else log
    if not isinstance(log_id, int) or not 0 <= log_id <= MAX_LOG_ID:
        raise InvalidArgument(f"log = {log!r} is not allowed: it must be a LogEntry, or an id from 0 to {MAX_LOG_ID}")


def _entry_of(log: LogMessage | ListedLog) -> LogEntry:
    time_utc = datetime.fromtimestamp(log.time_utc, tz=timezone.utc) if log.time_utc else None
    return LogEntry(log.id, log.size, time_utc)


def _is_different_log(old: LogEntry, new: LogEntry) -> bool:
    # A log grows while it is written. If it is smaller or much older than before, it is another log.
    if new.size < old.size:
        return True
    if old.time_utc is None:
        return False
    return new.time_utc is None or new.time_utc < old.time_utc - MAX_CLOCK_DIFFERENCE


def _still_listed(logs: tuple[LogEntry, ...], listed: tuple[LogEntry, ...]) -> tuple[LogEntry, ...]:
    """Return the entries of the newer list ``listed`` whose logs are also in ``logs``."""
    # Logs are compared by time and size, because a new log may get the id of an erased one. The newest log may have
    # grown since, so it is also found by its id.
    newest = logs[-1]
    kinds = {(entry.time_utc, entry.size) for entry in logs}
    return tuple(
        entry
        for entry in listed
        if (entry.time_utc, entry.size) in kinds or (entry.id == newest.id and not _is_different_log(newest, entry))
    )


def _no_such_log(log_id: int, text: str) -> FileError:
    return FileError(f"log {log_id}: {text}", path=f"log {log_id}", code=MavFtpErr.FILENOTFOUND)


def _part_suffix(entry: LogEntry) -> str:
    # The time identifies the log in the name of its ``.part`` file.
    written_at = 0 if entry.time_utc is None else int(entry.time_utc.timestamp())
    return f".log{entry.id}-{written_at}"


class ListedLog(NamedTuple):
    """One line of the list file that PX4 writes when its logs are requested. The line number is the log id."""

    id: int
    time_utc: int
    size: int
    path: str


async def log_path(
    files: Files,
    directories: tuple[str, ...],
    log: LogEntry,
    idle_timeout_s: float,
    *,
    may_have_grown: bool = False,
) -> str | None:
    """Return the path of a log for MAVFTP, or None if the file cannot be identified.

    The file is found by the log's id, and must be as large as ``log`` says. ArduPilot's newest file may be larger; with
    ``may_have_grown``, so may an earlier one. PX4's size is that in its list file.
    """
    for directory in directories:
        try:
            entries = await files.list(directory, idle_timeout_s=idle_timeout_s)
        except FileError:  # The vehicle has no such directory.
            continue
        numbered: dict[int, FileEntry] = {}
        for entry in entries:
            match = ARDUPILOT_NAME.fullmatch(entry.name)
            if match is not None:
                numbered[int(match[1])] = entry
        if numbered:
            # If the numbers began again from 1, the file with the lowest number is not the oldest.
            if await _have_numbers_wrapped(files, directory, max(numbered), idle_timeout_s):
                return None
            return _numbered_path(directory, numbered, log, may_have_grown)
        if any(entry.is_directory for entry in entries):  # PX4 has a directory for each day or session.
            # When its logs are requested, PX4 writes a list file with one path for each log id.
            logs = await _read_list_file(files, directory, idle_timeout_s)
            # PX4 also takes `log.size` from this list, so a different size means a different log.
            has_same_size = log.id < len(logs) and logs[log.id].size == log.size
            return logs[log.id].path if has_same_size else None
    return None


async def listed_logs(
    files: Files, directories: tuple[str, ...], idle_timeout_s: float
) -> tuple[ListedLog, ...] | None:
    """Return the logs in PX4's list file. None means that there are logs but no list file."""
    for directory in directories:
        try:
            entries = await files.list(directory, idle_timeout_s=idle_timeout_s)
        except FileError:  # The vehicle has no such directory.
            continue
        logs = await _read_list_file(files, directory, idle_timeout_s)
        return None if entries and not logs else logs
    return ()


async def _read_list_file(files: Files, directory: str, idle_timeout_s: float) -> tuple[ListedLog, ...]:
    root, _, _ = directory.rpartition("/")
    try:
        text = await files.read(f"{root}/{PX4_LIST}", idle_timeout_s=idle_timeout_s)
    except FileError:
        return ()
    matches = [PX4_LINE.fullmatch(line) for line in text.decode("utf-8", "replace").splitlines()]
    logs = []
    for number, match in enumerate(matches):
        if match is not None:
            time_utc, size, path = match.groups()
            # `directory` is PX4's directory "log", seen from the root of MAVFTP.
            _, _, path_below_directory = path.partition("/log/")
            logs.append(ListedLog(number, int(time_utc), int(size), f"{directory}/{path_below_directory}"))
    if len(logs) < len(matches):  # A file with other lines is not PX4's list.
        return ()
    return tuple(logs)


async def _have_numbers_wrapped(files: Files, directory: str, highest: int, idle_timeout_s: float) -> bool:
    """Return True if ArduPilot has begun to number its files from 1 again."""
    # LASTLOG.TXT contains the number of the newest log.
    try:
        text = await files.read(f"{directory}/LASTLOG.TXT", idle_timeout_s=idle_timeout_s)
    except FileError:
        return False
    match = re.match(rb"\d+", text)
    return match is not None and int(match[0]) < highest


def _numbered_path(directory: str, entries: dict[int, FileEntry], log: LogEntry, may_have_grown: bool) -> str | None:
    # Log 1 is the file with the lowest number, such as ``00000001.BIN``.
    number = min(entries) + log.id - 1
    entry = entries.get(number)
    if entry is None or entry.size is None:
        return None
    may_be_larger = may_have_grown or number == max(entries)  # The vehicle may still be writing the newest log.
    is_size_plausible = entry.size >= log.size if may_be_larger else entry.size == log.size
    return f"{directory}/{entry.name}" if is_size_plausible else None
