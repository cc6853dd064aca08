"""``FileChannel``: one vehicle's MAVFTP server as this program uses it: one operation at a time, every file closed."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import anyio

from aerokit.errors import AerokitError, ConnectionClosed, FileError, FileTimeout, LinkError, OperationTimeout
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.ftp import FtpClient, FtpRequest, FtpSessionLost, path_bytes

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from aerokit.protocols.ftp import FtpMessage
    from aerokit.vehicle.session.transfers import Transfers

T = TypeVar("T")

REOPENINGS = 3
"""How often a file is opened for one transfer; the vehicle may close it at any time."""
TAKEN = (MavFtpErr.FAIL, MavFtpErr.INVALIDSESSION, MavFtpErr.NOSESSIONSAVAILABLE)
"""What opening is answered while a file is open."""
GIVEN_UP_AFTER_S: dict[int, float] = {MavFtpErr.INVALIDSESSION: 3.2, MavFtpErr.NOSESSIONSAVAILABLE: 10.5}
"""So long after the last request of anybody the vehicle closes a file: ArduPilot 3 s, PX4 10 s."""
CLOSE_PATIENCE_S = 3.0


class OpenFile(NamedTuple):
    """A file that the vehicle has opened for us: its session, and its size as the vehicle says it."""

    session: int
    size: int


class FileChannel:
    """Requests of one client, in order. What was read, or left in a hurry, is closed in the background."""

    def __init__(self, transfers: Transfers) -> None:
        connection = transfers.connection
        self.transfers = transfers
        self.client: FtpClient = FtpClient(
            transfers.system_id,
            transfers.component_id,
            source_system=connection.source_system,
            source_component=connection.source_component,
            first_sequence=int(transfers.began_at * 1000.0),
        )
        """Addresses and numbers."""
        self._lock = asyncio.Lock()
        self._closing: dict[int, _Closing] = {}

    @asynccontextmanager
    async def operation(
        self,
        what: str,
        *,
        timeout: float | None,
        patience_s: float,
        missing: Callable[[], tuple[tuple[int, int], ...]] = tuple,
    ) -> AsyncIterator[None]:
        """Wait for one's turn, and have what was left open before closed.

        Raises:
            FileTimeout: all of it has taken more than ``timeout`` seconds; ``missing()`` gives its ranges.
        """
        try:
            with anyio.fail_after(timeout):
                async with self._lock:
                    for session in tuple(self._closing):
                        await self._close_left(session, patience_s)
                    yield
        except OperationTimeout:
            raise
        except TimeoutError:
            raise FileTimeout(f"{what}: not done within {timeout:g} s", missing=missing()) from None

    async def request(
        self,
        opcode: MavFtpOpcode,
        path: str,
        *,
        patience_s: float,
        offset: int = 0,
        data: bytes | None = None,
    ) -> FtpMessage:
        """Ask for something that takes one message (``data``: the path), within an operation."""
        request = FtpRequest(
            self.client,
            opcode,
            path=path,
            offset=offset,
            data=path_bytes(path) if data is None else data,
            round_trip=self.transfers.round_trip,
            patience_s=patience_s,
        )
        return await self.transfers.run(request)

    async def with_file(
        self,
        opcode: MavFtpOpcode,
        path: str,
        use: Callable[[OpenFile], Awaitable[T]],
        *,
        patience_s: float,
    ) -> T:
        """Open a file, use it and close it, within an operation; once more when the vehicle closed it meanwhile."""
        for attempt in range(1, REOPENINGS + 1):
            file = await self._open(opcode, path, patience_s)
            try:
                result = await use(file)
            except FtpSessionLost:
                await self._close(file.session, path, patience_s)
                if attempt == REOPENINGS:
                    raise
            except (OperationTimeout, ConnectionClosed, LinkError):
                self._leave(file.session, path)
                raise
            except Exception:
                with suppress(FileTimeout):
                    await self._close(file.session, path, min(patience_s, CLOSE_PATIENCE_S))
                raise
            except BaseException:
                self._leave(file.session, path)
                raise
            else:
                if opcode == MavFtpOpcode.OPENFILERO:
                    self._leave(file.session, path)  # what was read is here, whatever comes of it
                else:
                    await self._close(file.session, path, patience_s)
                return result
        raise AssertionError("a loop that returns or raises")

    # ------------------------------------------------------------------------------ sessions

    async def _open(self, opcode: MavFtpOpcode, path: str, patience_s: float) -> OpenFile:
        """Open a file. Where another session is in the way, give its owner the time to go, once."""
        may_wait, may_be_ours = True, True
        while True:
            request = self._request(opcode, path, self.client.next_session(), patience_s)
            try:
                reply = await self.transfers.run(request)
            except FileError as error:
                if may_be_ours and request.attempts > 1 and error.code in TAKEN:
                    may_be_ours = (
                        False  # the first sending opened it, its answer and the memory of it are lost
                    )
                    await self._close_unanswered(request, path, patience_s)
                    continue
                pause_s = GIVEN_UP_AFTER_S.get(error.code)
                if not may_wait or pause_s is None or pause_s > patience_s + 1.0:
                    raise
                may_wait = False
                await anyio.sleep(pause_s)
            except BaseException:
                for session in self._possible_sessions(request):
                    self._leave(session, path)
                raise
            else:
                return OpenFile(reply.session, int.from_bytes(reply.data[:4], "little"))

    def _request(self, opcode: MavFtpOpcode, path: str, session: int, patience_s: float) -> FtpRequest:
        return FtpRequest(
            self.client,
            opcode,
            path=path,
            session=session,
            data=b"" if opcode == MavFtpOpcode.TERMINATESESSION else path_bytes(path),
            round_trip=self.transfers.round_trip,
            patience_s=patience_s,
        )

    def _possible_sessions(self, request: FtpRequest) -> tuple[int, ...]:
        """What a session is called that was opened without our having heard of it."""
        return (request.session,) if self.transfers.autopilot.takes_file_sessions else (request.session, 0)

    async def _close_unanswered(self, request: FtpRequest, path: str, patience_s: float) -> None:
        for session in self._possible_sessions(request):
            await self._close(session, path, patience_s)

    async def _close(self, session: int, path: str, patience_s: float) -> None:
        """Close a session and have that confirmed; when that goes wrong, it is left to the background."""
        request = self._request(MavFtpOpcode.TERMINATESESSION, path, session, patience_s)
        try:
            await self.transfers.run(request)
        except BaseException:
            self._leave(session, path)
            raise

    def _leave(self, session: int, path: str) -> None:
        """Close a session at once, and have that confirmed in the background; the next operation waits for it."""
        request = FtpRequest(
            self.client,
            MavFtpOpcode.TERMINATESESSION,
            path=path,
            session=session,
            is_sent=True,
            round_trip=self.transfers.round_trip,
        )
        with suppress(AerokitError):  # when nothing can be sent any more, there is nobody to tell
            self.transfers.connection.send(request.message)
            closing = self._closing[session] = _Closing(request)
            self.transfers.background.start(lambda: closing.confirm(self.transfers), "aerokit close file")

    async def _close_left(self, session: int, patience_s: float) -> None:
        """Make sure that a session is closed that was left before."""
        closing = self._closing[session]
        await closing.ended.wait()
        if not closing.request.is_answered:
            await self._close(session, closing.request.path, patience_s)
        self._closing.pop(session, None)


class _Closing:
    """A session that is being closed with nobody waiting."""

    def __init__(self, request: FtpRequest) -> None:
        self.request, self.ended = request, asyncio.Event()

    async def confirm(self, transfers: Transfers) -> None:
        try:
            with suppress(AerokitError):  # the vehicle closes it by itself after its own time-out
                await transfers.run(self.request)
        finally:
            self.ended.set()
