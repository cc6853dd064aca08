"""``FileChannel`` and ``LogChannel``: operations with one vehicle by MAVFTP and LOG_*, one at a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import asynccontextmanager, contextmanager, suppress
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import anyio

from aerokit.errors import AerokitError, ConnectionClosed, FileError, FileTimeout, LinkError, OperationTimeout
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.exchange import IDLE_TIMEOUT_S, OnProgress
from aerokit.protocols.ftp import FtpClient, FtpRequest, FtpSessionLost, path_bytes
from aerokit.protocols.logs import LogDownload, LogList, LogStop

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Iterator

    from aerokit.mavlink.messages import LogEntry
    from aerokit.protocols.blocks import Reassembly
    from aerokit.protocols.ftp import FtpMessage
    from aerokit.vehicle.session.transfers import Transfers

T = TypeVar("T")

# The vehicle may close a file at any time. A transfer opens it at most this many times, including the first time.
MAX_OPEN_ATTEMPTS = 3
# Error codes with which vehicles refuse to open a file while another file is open.
SESSION_IN_USE = (MavFtpErr.FAIL, MavFtpErr.INVALIDSESSION, MavFtpErr.NOSESSIONSAVAILABLE)
# A vehicle closes its open file this many seconds after the last request of any client (ArduPilot 3 s, PX4 10 s, and a
# margin). The keys are the errors with which ArduPilot and PX4 report that a file is open.
SESSION_TIMEOUT_S: dict[int, float] = {MavFtpErr.INVALIDSESSION: 3.2, MavFtpErr.NOSESSIONSAVAILABLE: 10.5}
CLOSE_TIMEOUT_S = 3.0


MissingRanges = Callable[[], tuple[tuple[int, int], ...]]
"""Returns the ranges that have not been transferred, as (offset, size) in bytes."""


class RemoteFile(NamedTuple):
    """A file that the vehicle has opened: its session, and its size in bytes."""

    session: int
    size: int


class _ClosingSession(NamedTuple):
    request: FtpRequest
    task: asyncio.Task[None]


@contextmanager
def _limit(description: str, timeout: float | None, missing: MissingRanges) -> Iterator[None]:
    """Raise FileTimeout with the missing ranges if the block takes more than ``timeout`` seconds."""
    # A TimeoutError that is raised inside the `with` block, for example by the disk, is passed on.
    with anyio.move_on_after(timeout) as scope:
        yield
    if scope.cancelled_caught:
        raise FileTimeout(f"{description}: not done within {timeout:g} s", missing=missing())


class FileChannel:
    """Sends MAVFTP requests to one vehicle, one at a time. Files are closed in the background."""

    def __init__(self, transfers: Transfers) -> None:
        connection = transfers.connection
        self.transfers = transfers
        self.client: FtpClient = FtpClient(
            transfers.system_id,
            transfers.component_id,
            source_system=connection.source_system,
            source_component=connection.source_component,
            # Successive programs should begin with different numbers: a server repeats its last reply if a request has
            # the same number as the request before it.
            first_sequence=int(transfers.began_at * 1000.0),
        )
        self._lock = asyncio.Lock()
        self._closing: dict[int, _ClosingSession] = {}  # by session id

    @asynccontextmanager
    async def operation(
        self,
        description: str,
        *,
        timeout: float | None,
        idle_timeout_s: float,
        missing: MissingRanges = tuple,
    ) -> AsyncIterator[None]:
        """Wait until earlier operations have ended, then run the block as the next operation.

        Raises FileTimeout with the ranges that ``missing()`` returns, if this takes more than ``timeout`` seconds.
        """
        with _limit(description, timeout, missing):
            async with self._lock:
                for session in tuple(self._closing):
                    await self._finish_closing(session, idle_timeout_s)
                yield

    async def request(
        self,
        opcode: MavFtpOpcode,
        path: str,
        *,
        idle_timeout_s: float,
        offset: int = 0,
        data: bytes | None = None,
    ) -> FtpMessage:
        """Send a request with a single reply. Call this only in an `operation` block."""
        request = FtpRequest(
            self.client,
            opcode,
            path=path,
            offset=offset,
            data=path_bytes(path) if data is None else data,
            round_trip=self.transfers.round_trip,
            idle_timeout_s=idle_timeout_s,
        )
        return await self.transfers.run(request)

    async def with_file(
        self,
        opcode: MavFtpOpcode,
        path: str,
        use: Callable[[RemoteFile], Awaitable[T]],
        *,
        idle_timeout_s: float,
    ) -> T:
        """Open a file, await ``use(file)`` and close the file.

        Call this only in an `operation` block. If the vehicle closes the file, it is opened again and ``use`` is
        called again.
        """
        for attempt in range(1, MAX_OPEN_ATTEMPTS + 1):
            file = await self._open(opcode, path, idle_timeout_s)
            try:
                result = await use(file)
            except FtpSessionLost:
                await self._close(file.session, path, idle_timeout_s)
                if attempt == MAX_OPEN_ATTEMPTS:
                    raise
            except (OperationTimeout, ConnectionClosed, LinkError):  # No answer to the request to close will arrive.
                self._close_soon(file.session, path)
                raise
            except Exception:
                # The error of the transfer must reach the caller, not an error of closing.
                with suppress(AerokitError):
                    await self._close(file.session, path, min(idle_timeout_s, CLOSE_TIMEOUT_S))
                raise
            except BaseException:  # A cancelled call must not wait until the file is closed.
                self._close_soon(file.session, path)
                raise
            else:
                if opcode == MavFtpOpcode.OPENFILERO:
                    self._close_soon(file.session, path)  # The caller has its data and need not wait.
                else:
                    await self._close(file.session, path, idle_timeout_s)
                return result
        raise AssertionError("the loop returns or raises")

    async def _open(self, opcode: MavFtpOpcode, path: str, idle_timeout_s: float) -> RemoteFile:
        has_waited = False
        has_closed_own_session = False
        while True:
            request = self._session_request(opcode, path, self.client.next_session(), idle_timeout_s)
            try:
                reply = await self.transfers.run(request)
            except FileError as error:
                may_be_own_session = request.attempts > 1 and error.code in SESSION_IN_USE
                if may_be_own_session and not has_closed_own_session:
                    # If the reply to an earlier request was lost, this program may already have a session. Close it.
                    # PX4 has only one session: if it belongs to another station, that station must open its file again.
                    has_closed_own_session = True
                    for session in self._possible_sessions(request):
                        await self._close(session, path, idle_timeout_s)
                    continue
                # Seconds after which the vehicle closes another station's session; None if the error has another cause.
                session_timeout_s = SESSION_TIMEOUT_S.get(error.code)
                # One second is added, so that the default idle time-out of 10 s suffices for PX4's 10.5 s.
                if has_waited or session_timeout_s is None or session_timeout_s > idle_timeout_s + 1.0:
                    raise
                has_waited = True
                await anyio.sleep(session_timeout_s)
            except BaseException:
                for session in self._possible_sessions(request):
                    self._close_soon(session, path)
                raise
            else:
                return RemoteFile(reply.session, size=int.from_bytes(reply.data[:4], "little"))

    def _session_request(
        self, opcode: MavFtpOpcode, path: str, session: int, idle_timeout_s: float, *, is_sent: bool = False
    ) -> FtpRequest:
        return FtpRequest(
            self.client,
            opcode,
            path=path,
            session=session,
            sent_by_caller=is_sent,
            data=b"" if opcode == MavFtpOpcode.TERMINATESESSION else path_bytes(path),
            round_trip=self.transfers.round_trip,
            idle_timeout_s=idle_timeout_s,
        )

    def _possible_sessions(self, request: FtpRequest) -> tuple[int, ...]:
        """Return the ids that an unanswered request may have opened: its own, or 0 if the vehicle chooses the id."""
        return (request.session,) if self.transfers.autopilot.accepts_ftp_session_ids else (request.session, 0)

    async def _close(self, session: int, path: str, idle_timeout_s: float) -> None:
        request = self._session_request(MavFtpOpcode.TERMINATESESSION, path, session, idle_timeout_s)
        try:
            await self.transfers.run(request)
        except BaseException:
            self._close_soon(session, path)
            raise

    def _close_soon(self, session: int, path: str) -> None:
        """Close a session without waiting. The next operation waits for the confirmation."""
        # The request is sent at once. The background task waits for the reply, and repeats the request if none arrives.
        request = self._session_request(MavFtpOpcode.TERMINATESESSION, path, session, IDLE_TIMEOUT_S, is_sent=True)
        with suppress(AerokitError):  # The connection may be closed.
            self.transfers.connection.send(request.message)
            task = self.transfers.background.start(lambda: self._confirm(request), "aerokit close file")
            if task is not None:
                self._closing[session] = _ClosingSession(request, task)

    async def _confirm(self, request: FtpRequest) -> None:
        with suppress(AerokitError):  # If closing fails, the vehicle closes the session after its own time-out.
            await self.transfers.run(request)

    async def _finish_closing(self, session: int, idle_timeout_s: float) -> None:
        closing = self._closing[session]
        await asyncio.wait((closing.task,))
        if not closing.request.is_answered:
            await self._close(session, closing.request.path, idle_timeout_s)
        self._closing.pop(session, None)


class LogChannel:
    """Runs LOG_* operations one at a time; an interrupted operation is ended in the background."""

    def __init__(self, transfers: Transfers) -> None:
        self._transfers = transfers
        self._lock = asyncio.Lock()
        # Task that repeats LOG_REQUEST_END after a failed operation; None if no operation has failed.
        self._ending: asyncio.Task[None] | None = None

    async def list(
        self, idle_timeout_s: float, only_id: int | None, *, max_unanswered: int | None
    ) -> tuple[LogEntry, ...]:
        """Request the log list, or one entry of it. Call this only in an `operation` block."""
        transfers = self._transfers
        exchange = LogList(
            transfers.system_id,
            transfers.component_id,
            first_id=transfers.autopilot.first_log_id,
            from_id=only_id,
            to_id=only_id,
            max_unanswered=max_unanswered,
            round_trip=transfers.round_trip,
            idle_timeout_s=idle_timeout_s,
        )
        return await transfers.run(exchange)

    async def download(
        self,
        log_id: int,
        size: int,
        into: Reassembly,
        idle_timeout_s: float,
        timeout: float | None,
        on_progress: OnProgress,
    ) -> None:
        transfers = self._transfers
        exchange = LogDownload(
            transfers.system_id,
            transfers.component_id,
            log_id,
            size,
            into,
            round_trip=transfers.round_trip,
            idle_timeout_s=idle_timeout_s,
            on_progress=on_progress,
        )
        async with self.operation(f"log {log_id}", timeout, lambda: into.missing(size)):
            await transfers.run(exchange)

    @asynccontextmanager
    async def operation(
        self,
        description: str,
        timeout: float | None,
        missing: MissingRanges = tuple,
    ) -> AsyncIterator[None]:
        """Wait until earlier operations have ended, then run the block as the next operation.

        Raises FileTimeout with the ranges that ``missing()`` returns, if this takes more than ``timeout`` seconds.
        """
        with _limit(description, timeout, missing):
            async with self._lock:
                if self._ending is not None:
                    await asyncio.wait((self._ending,))
                try:
                    yield
                except BaseException:
                    self._end()
                    raise

    def _end(self) -> None:
        """Tell the vehicle to stop sending. The next operation waits for the confirmation."""
        transfers = self._transfers
        # LOG_REQUEST_END is sent at once. The background task only repeats it.
        exchange = LogStop(transfers.system_id, transfers.component_id, round_trip=transfers.round_trip)

        async def confirm() -> None:
            with suppress(AerokitError):
                await transfers.run(exchange)

        with suppress(AerokitError):  # The connection may be closed.
            transfers.connection.send(exchange.message)
            self._ending = transfers.background.start(confirm, "aerokit end of logs")
