"""An NTRIP caster on 127.0.0.1, with real sockets."""

from __future__ import annotations

import asyncio
from base64 import b64encode
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field

from aerokit.protocols.rtcm import crc24q

__all__ = ["CREDENTIALS", "CasterServer", "open_caster", "rtcm"]

CREDENTIALS = "someone:se:cr@t"


def rtcm(size: int, number: int = 1077) -> bytes:
    """An RTCM message of this size."""
    body = bytes([0xD3, size - 6 >> 8, size - 6 & 0xFF, number >> 4, number << 4 & 0xFF]) + bytes(size - 8)
    return body + crc24q(body).to_bytes(3, "big")


@dataclass
class CasterServer:
    """Settings of the caster, and what it received."""

    version: int = 2
    chunked: bool = True
    needs_position: bool = False
    answer: bytes | None = None
    """An answer to every request for data, instead of the usual one."""
    messages: list[bytes] = field(default_factory=lambda: [rtcm(25, 1005), rtcm(400)])
    closes_after: bool = False
    port: int = 0
    requests: list[str] = field(default_factory=list)
    sentences: list[str] = field(default_factory=list)
    open_connections: int = 0
    serving: set[asyncio.Task[None]] = field(default_factory=set)
    received_sentence: asyncio.Event = field(default_factory=asyncio.Event)

    def url(self, mount: str = "MOUNT", credentials: str = "someone:se%3Acr%40t@") -> str:
        return f"ntrip://{credentials}127.0.0.1:{self.port}/{mount}"

    @property
    def data_requests(self) -> list[str]:
        return [request for request in self.requests if not request.startswith("GET / ")]

    def table(self) -> bytes:
        row = f"STR;MOUNT;Town;RTCM 3.2;;2;GPS;X;CHE;47.0;8.0;{int(self.needs_position)};0;g;none;B;N;500;\r\n"
        rows = f"{row}STR;OTHER;Town;RTCM 3.2;;2;GPS;X;CHE;47.0;8.0;0;0;g;none;B;N;500;\r\nENDSOURCETABLE\r\n"
        if self.version == 1:
            return f"SOURCETABLE 200 OK\r\nContent-Length: {len(rows)}\r\n\r\n{rows}".encode()
        return f"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\n\r\n{rows}".encode()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.open_connections += 1
        task = asyncio.current_task()
        assert task is not None
        self.serving.add(task)
        try:
            request = (await reader.readuntil(b"\r\n\r\n")).decode()
            self.requests.append(request)
            await self._reply(request, reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass
        finally:
            self.open_connections -= 1
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()
            self.serving.discard(task)

    async def _reply(self, request: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        mount = request.split()[1]
        if mount == "/" or (mount != "/MOUNT" and self.version == 1):
            writer.write(self.table())
        elif self.answer is not None:
            writer.write(self.answer)
        elif mount != "/MOUNT":
            writer.write(b"HTTP/1.1 404 Not Found\r\n\r\n")
        elif b64encode(CREDENTIALS.encode()).decode() not in request:
            writer.write(b"ERROR - Bad Password\r\n" if self.version == 1 else b"HTTP/1.1 401 Unauthorized\r\n\r\n")
        else:
            await self._stream(reader, writer)

    async def _stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        is_chunked = self.chunked and self.version == 2
        coding = "Transfer-Encoding: chunked\r\n" if is_chunked else ""
        head = "ICY 200 OK\r\n" if self.version == 1 else f"HTTP/1.1 200 OK\r\nContent-Type: gnss/data\r\n{coding}\r\n"
        writer.write(head.encode())
        for message in self.messages:
            for piece in (message[:10], message[10:]):
                writer.write(b"%x\r\n%s\r\n" % (len(piece), piece) if is_chunked else piece)
                await writer.drain()
        while not self.closes_after and (line := await reader.readline()):
            self.sentences.append(line.decode())
            self.received_sentence.set()


@asynccontextmanager
async def open_caster(**settings: object) -> AsyncIterator[CasterServer]:
    caster = CasterServer(**settings)  # type: ignore[arg-type]
    server = await asyncio.start_server(caster.serve, "127.0.0.1", 0)
    caster.port = server.sockets[0].getsockname()[1]
    try:
        yield caster
    finally:
        server.close()
        serving = list(caster.serving)
        for task in serving:
            task.cancel()
        await asyncio.gather(*serving, return_exceptions=True)
        with suppress(asyncio.CancelledError):
            await server.wait_closed()
