"""``NtripClient``: fetches RTCM corrections from an NTRIP caster (version 1 or 2) while its block runs."""

from __future__ import annotations

import asyncio
import logging
import ssl
import time
from asyncio import open_connection
from base64 import b64encode
from contextlib import suppress
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

import anyio

from aerokit._internal.formatting import printable
from aerokit.connection.tasks import Cancellation, run_shielded
from aerokit.errors import (
    BusyError,
    ConnectionClosed,
    InvalidArgument,
    LinkLost,
    LinkOpenError,
    OperationRejected,
    OperationTimeout,
)
from aerokit.protocols.rtcm import MAX_MESSAGE_SIZE, RtcmReader

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from typing_extensions import Self

    from aerokit.vehicle.session.session import VehicleSession

__all__ = ["Caster", "NtripClient"]

logger: logging.Logger = logging.getLogger("aerokit")

DEFAULT_PORT = 2101
MIN_RETRY_S, MAX_RETRY_S = 1.0, 30.0
MAX_SILENCE_S = 30.0
"""Seconds without data after which the client reconnects. Base stations send data every one or two seconds."""
POSITION_INTERVAL_S = 10.0
POSITION_POLL_INTERVAL_S = 1.0
POSITION_MAX_AGE_S = 10.0
# Maps GPS_FIX_TYPE to the quality in GGA. The qualities are: 1 autonomous (the default), 2 differential, 4 RTK fixed, 5
# RTK float.
QUALITIES = {4: 2, 5: 5, 6: 4}
MAX_HEADER_LINES, MAX_CHUNK_SIZE, MAX_TABLE_SIZE = 100, 1 << 20, 4 << 20
TABLE_END = b"ENDSOURCETABLE"
CLOSE_TIMEOUT_S = 1.0


class Caster:
    """Address and credentials of an NTRIP mount point. Its repr does not contain the password."""

    def __init__(self, host: str, port: int, mount: str, credentials: str, is_encrypted: bool) -> None:
        self.host: str = host
        self.port: int = port
        self.mount: str = mount
        self.is_encrypted: bool = is_encrypted
        self._credentials = credentials

    @classmethod
    def parse(cls, url: str) -> Caster:
        """Parse ``ntrip://user:password@host:port/MOUNT``. Error texts do not contain the URL or its password."""
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError:
            # The text of this error may contain the password. Without a host, the check below raises another error.
            parts, host, port = urlsplit(""), None, None
        mount = unquote(parts.path[1:])
        has_only_valid_characters = mount.isascii() and mount.isprintable() and not set(mount) & set("/ ")
        is_mount_valid = mount != "" and has_only_valid_characters
        is_scheme_valid = parts.scheme in ("ntrip", "ntrips")
        if not host or port == 0 or not is_mount_valid or not is_scheme_valid:
            raise InvalidArgument(
                "url is invalid (it is not shown, because it may contain a password): write"
                " ntrip://user:password@host:2101/MOUNT, with %40 for an @ in the password"
            )
        user, password = unquote(parts.username or ""), unquote(parts.password or "")
        credentials = f"{user}:{password}" if user or password else ""
        return cls(host, port or DEFAULT_PORT, mount, credentials, parts.scheme == "ntrips")

    def request(self, mount: str, position: bytes | None = None) -> bytes:
        """Return the HTTP request for a mount point, or for the source table if ``mount`` is empty."""
        lines = [
            f"GET /{mount} HTTP/1.1",
            f"Host: {self.host}:{self.port}",
            "Ntrip-Version: Ntrip/2.0",
            "User-Agent: NTRIP aerokit",
            "Connection: close",
        ]
        if self._credentials:
            lines.append(f"Authorization: Basic {b64encode(self._credentials.encode()).decode()}")
        if position:
            lines.append(f"Ntrip-GGA: {position.decode().strip()}")
        return "\r\n".join((*lines, "", "")).encode()

    def __repr__(self) -> str:
        scheme = "ntrips" if self.is_encrypted else "ntrip"
        return f"{scheme}://{self.host}:{self.port}/{self.mount}"


class _Response:
    """Response of a caster: its status line, and its body without the chunk headers."""

    def __init__(self, reader: asyncio.StreamReader, status: str, headers: dict[str, str]) -> None:
        self._reader = reader
        self.status = status
        self._headers = headers
        words = status.split()  # "HTTP/1.1 200 OK", or in NTRIP 1 "ICY 200 OK", "SOURCETABLE 200 OK", "ERROR - text"
        # The status code; empty if the caster has sent none.
        self.code = words[1] if len(words) > 1 and words[0] != "ERROR" else ""
        self.is_table = words[:1] == ["SOURCETABLE"] or "sourcetable" in headers.get("content-type", "")
        self.is_stream = self.code == "200" and not self.is_table

    @classmethod
    async def read(cls, reader: asyncio.StreamReader) -> _Response:
        status = (await reader.readline()).decode("latin-1").strip()
        headers: dict[str, str] = {}
        # In NTRIP 1, the data follow "ICY 200 OK" at once or after an empty line. RtcmReader skips that line.
        if not status.startswith(("ICY", "ERROR")):
            for _ in range(MAX_HEADER_LINES):
                name, _, value = (await reader.readline()).decode("latin-1").strip().partition(":")
                if not name:
                    break
                headers[name.lower()] = value.strip().lower()
        return cls(reader, status, headers)

    async def body(self) -> AsyncIterator[bytes]:
        """Yield the data until the caster ends them. Raises ValueError for an invalid chunk."""
        if self._headers.get("transfer-encoding") != "chunked":
            while data := await self._reader.read(4096):
                yield data
            return
        while line := await self._reader.readline():
            size_text, _, _ = line.partition(b";")  # Extensions of the chunk may follow the size.
            chunk_size = int(size_text or b"0", 16)
            if chunk_size == 0:  # The end of the body.
                return
            if not 0 < chunk_size <= MAX_CHUNK_SIZE:
                raise ValueError("invalid chunk size")
            yield await self._reader.readexactly(chunk_size)
            await self._reader.readline()  # Skip the line break after the chunk.


class NtripClient:
    """Fetches corrections from an NTRIP caster while its ``async with`` block runs, and sends them to the vehicle.

    Entering returns when the caster has accepted the request. If the connection ends or is silent for 30 s, the client
    reconnects after 1 to 30 s, as often as necessary, and logs this (logger ``aerokit``). Messages of more than 720
    bytes, which GPS_RTCM_DATA cannot carry, are dropped. Leaving the block closes the connection.

    Entering raises:
        OperationRejected: the caster refused the user or the password, or has no such mount point. The error text lists
            the caster's mount points.
        LinkOpenError: the caster could not be reached, or the connection failed before its answer.
        OperationTimeout: the caster did not answer in time.
        BusyError: the client was entered before; call ``ntrip()`` again.
    """

    def __init__(
        self,
        session: VehicleSession,
        send: Callable[[bytes], None],
        caster: Caster,
        send_position: bool | None,
        timeout: float,
    ) -> None:
        self._session = session
        # Sends one RTCM message to the vehicle.
        self._send = send
        self._caster = caster
        self._timeout = timeout
        # True if the vehicle's position is sent to the caster; None until the caster's source table has decided.
        self._sends_position = send_position
        self._name = f"NTRIP {caster!r}"
        # Ends the background task; `_ended` is set when the task has ended.
        self._cancellation = Cancellation()
        self._ended = asyncio.Event()
        self._was_entered = False
        # The open connection to the caster; None while there is none.
        self._writer: asyncio.StreamWriter | None = None
        self._problem = ""  # the last problem, as a text for the user
        self._oversized = 0  # number of messages that are too long to be sent
        self._reconnects = 0

    @property
    def is_connected(self) -> bool:
        """True while the caster's connection is open."""
        return self._writer is not None

    @property
    def problem(self) -> str:
        """Reason why the client is not connected; empty while it is connected."""
        return "" if self.is_connected else self._problem

    @property
    def reconnects(self) -> int:
        """Number of times that the client has reconnected."""
        return self._reconnects

    @property
    def oversized(self) -> int:
        """Number of messages that were dropped because they have more than 720 bytes."""
        return self._oversized

    def __repr__(self) -> str:
        return f"<NtripClient {self._caster!r}, {'connected' if self.is_connected else 'not connected'}>"

    async def __aenter__(self) -> Self:
        """Open the connection, and forward corrections in the background."""
        if self._was_entered:
            raise BusyError("this NtripClient was entered before: call ntrip() again")
        self._was_entered = True
        try:
            if self._sends_position is None:
                self._sends_position = await self._asks_for_position()
            response = await self._open(self._caster.mount)
        except BaseException:
            self._close()
            raise
        self._session.background.start(lambda: self._run(response), "aerokit ntrip")
        return self

    async def __aexit__(self, *_: object) -> None:
        self._cancellation.cancel()
        writer = self._writer
        self._close()
        await run_shielded(self._wait_closed(writer))

    async def _wait_closed(self, writer: asyncio.StreamWriter | None) -> None:
        with anyio.move_on_after(CLOSE_TIMEOUT_S):
            if not self._session.is_closed:
                await self._ended.wait()
            if writer is not None:
                with suppress(OSError):  # The connection may have failed before it was closed.
                    await writer.wait_closed()

    async def _run(self, response: _Response) -> None:
        try:
            with self._cancellation:
                await self._forward(response)
                pause_s = MIN_RETRY_S
                while True:
                    await anyio.sleep(pause_s)
                    pause_s = min(2 * pause_s, MAX_RETRY_S)
                    try:
                        response = await self._open(self._caster.mount)
                    # A refusal is retried too, because casters limit the connections of a user and may still count the
                    # lost connection.
                    except (OperationRejected, OperationTimeout, LinkOpenError) as error:
                        self._report(str(error))
                        continue
                    self._reconnects += 1
                    logger.info("%s: connected again", self._name)
                    message_count = await self._forward(response)
                    if message_count > 0:  # The connection was useful, so the next attempt may follow soon.
                        pause_s = MIN_RETRY_S
        except (ConnectionClosed, LinkLost) as error:
            self._problem = f"the vehicle's connection has ended: {error}"
        finally:
            self._close()
            self._ended.set()

    async def _forward(self, response: _Response) -> int:
        """Send the corrections from one connection to the vehicle. Return the number of messages."""
        reader = RtcmReader()
        message_count = 0
        reason = "the caster closed the connection"
        position_task = asyncio.ensure_future(self._report_position()) if self._sends_position else None
        body = response.body()
        try:
            while True:
                # Until Python 3.12, asyncio.wait_for() loses a cancellation that coincides with the data.
                with anyio.fail_after(MAX_SILENCE_S):
                    data = await body.__anext__()
                for message in reader.feed(data):
                    message_count += 1
                    if len(message) <= MAX_MESSAGE_SIZE:
                        self._send(message)
                    else:
                        self._oversized += 1
        except TimeoutError:
            reason = f"no data for {MAX_SILENCE_S:g} s"
        except StopAsyncIteration:  # The body has ended.
            pass
        except (OSError, ValueError, EOFError) as error:
            reason = f"the connection failed ({type(error).__name__})"
        finally:
            if position_task is not None:
                position_task.cancel()
                # Ignore the task's exception. If the task cannot send the position, reading fails too, and `reason` is
                # set from that failure.
                await asyncio.gather(position_task, return_exceptions=True)
            self._close()
        self._report(f"{self._name}: {reason} after {message_count} messages")
        return message_count

    def _report(self, problem: str) -> None:
        self._problem = problem
        logger.warning("%s; trying again", problem)

    # -------------------------------------------------------------------------------------- caster

    async def _open(self, mount: str) -> _Response:
        response = await self._request(mount)
        if response.is_stream:
            return response
        # A caster answers with its source table if it has no such mount point.
        names = await self._read_source_table(response) if response.is_table else {}
        self._close()
        status = printable(response.status[:80]) or "an empty answer"
        reason = f"the caster answered {status!r}"
        if response.is_table or response.code == "404":
            available = f"; it has {', '.join(sorted(names)[:20])}" if names else ""
            reason = f"the caster has no mount point {mount!r}{available}"
        elif response.code in ("401", "403") or "password" in status.lower():
            reason = f"the caster refused the user or the password ({status})"
        raise OperationRejected(f"{self._name}: {reason}")

    async def _request(self, mount: str) -> _Response:
        """Request a mount point, or the source table if ``mount`` is empty."""
        caster = self._caster
        context = ssl.create_default_context() if caster.is_encrypted else None

        try:
            with anyio.fail_after(self._timeout):
                reader, self._writer = await open_connection(caster.host, caster.port, ssl=context)
                position = gga_sentence(self._session) if mount and self._sends_position else None
                self._writer.write(caster.request(mount, position))
                return await _Response.read(reader)
        except TimeoutError:
            self._close()
            raise OperationTimeout(f"{self._name}: the caster did not answer within {self._timeout:g} s") from None
        except (OSError, ValueError) as error:
            self._close()
            reason = getattr(error, "strerror", None) or type(error).__name__
            raise LinkOpenError(f"{self._name}: the connection to the caster failed: {reason}") from None

    async def _asks_for_position(self) -> bool:
        """Return True if the source table says that the mount point needs the position (GGA)."""
        try:
            response = await self._request("")
            needs_position = await self._read_source_table(response)
            return needs_position.get(self._caster.mount, False)
        finally:
            self._close()

    async def _read_source_table(self, response: _Response) -> dict[str, bool]:
        """Map each mount point to True if it needs the position."""
        text = b""
        # If the table does not arrive completely in time, use the rows that have arrived.
        with anyio.move_on_after(self._timeout), suppress(OSError, ValueError, EOFError):
            async for data in response.body():
                text += data
                # The last row may arrive in two pieces, so look at the end of the earlier data, too.
                has_ended = TABLE_END in text[-len(data) - len(TABLE_END) :]
                if has_ended or len(text) > MAX_TABLE_SIZE:
                    break
        # In a row, column 1 is the name of the mount point. Column 11 is 1 if the caster needs the position.
        rows = [line.split(";") for line in text.decode("latin-1").splitlines() if line.startswith("STR;")]
        needs_position: dict[str, bool] = {}
        for row in rows:
            if len(row) > 1:
                needs_position[printable(row[1])] = len(row) > 11 and row[11] == "1"
        return needs_position

    async def _report_position(self) -> None:
        with self._session.streaming("position", "gps"):
            while self._writer is not None:
                sentence = gga_sentence(self._session)
                if sentence:
                    self._writer.write(sentence)
                await anyio.sleep(POSITION_INTERVAL_S if sentence else POSITION_POLL_INTERVAL_S)

    def _close(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()


def gga_sentence(session: VehicleSession) -> bytes | None:
    """Return the vehicle's position as ``$GPGGA,…``, or None while no recent one is known."""
    position = session.telemetry.position
    place = position.latest
    if place is None or position.age > POSITION_MAX_AGE_S or place.altitude_amsl_m is None:
        return None
    receivers = session.telemetry.cells["gps"].latest
    quality, satellites = 1, 4  # A position needs four satellites at least.
    if receivers:
        quality = QUALITIES.get(receivers[0].fix_type, quality)
        satellites = receivers[0].satellites or satellites
    utc = time.strftime("%H%M%S", time.gmtime(session.connection.unix_time()))
    latitude = f"{_format_angle(place.latitude_deg, degree_digits=2)},{'S' if place.latitude_deg < 0 else 'N'}"
    longitude = f"{_format_angle(place.longitude_deg, degree_digits=3)},{'W' if place.longitude_deg < 0 else 'E'}"
    # HDOP (1.0) and the height of the geoid (0.0) are mandatory but made up, because casters use only the position.
    fields = (
        f"GPGGA,{utc}.00,{latitude},{longitude},{quality},{satellites:02d},1.0,{place.altitude_amsl_m:.1f},M,0.0,M,,"
    )
    checksum = reduce(xor, fields.encode())
    return f"${fields}*{checksum:02X}\r\n".encode()


def _format_angle(degrees: float, *, degree_digits: int) -> str:
    """Format an angle as degrees and minutes: 4723.86456 is 47° 23.86456'."""
    units_per_minute = 100_000  # for five decimal places
    whole_degrees, units = divmod(round(abs(degrees) * 60 * units_per_minute), 60 * units_per_minute)
    minutes, fraction = divmod(units, units_per_minute)
    return f"{whole_degrees:0{degree_digits}d}{minutes:02d}.{fraction:05d}"
