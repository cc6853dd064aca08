"""``fetch``: a file that a component names by its address: on a component, by MAVFTP, or on a server of the web."""

from __future__ import annotations

import asyncio
import re
from contextlib import suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import anyio

from aerokit.errors import FileTimeout, InvalidArgument, OperationRejected
from aerokit.whole_file import LARGEST_FILE, too_large
from aerokit.wording import shown

if TYPE_CHECKING:
    from collections.abc import Callable
    from http.client import HTTPConnection
    from urllib.request import OpenerDirector

    from aerokit.protocols.transfer import Progress
    from aerokit.vehicle.files.files import Files

__all__ = ["WEB", "fetch"]

_MAVFTP = re.compile(r"(?:mftp|mavlinkftp)://(?:\[;comp=([0-9]{1,3})\])?(.+)", re.IGNORECASE)
WEB = ("http://", "https://")
BLOCK = 1 << 16
WEB_S = 60.0
"""Seconds for all of a file from the web."""
READING_AND_WRITING = 2
"""SHUT_RDWR of every system."""


async def fetch(uri: str, files_of: Callable[[int], Files], component_id: int, patience_s: float) -> bytes:
    """The content of a file, at most 16 MB.

    Raises:
        InvalidArgument: the address is neither ``mftp://`` nor ``http://``, ``https://``.
        FileFormatError: it has more than 16 MB.
        FileError, FileTimeout, RemoteProtocolError: MAVFTP did not give it.
        OperationRejected: the server of the web did not give it.
        FileTimeout: it did not come in time.
    """
    found = _MAVFTP.fullmatch(uri)
    if found is not None:
        owner = int(found[1]) if found[1] else component_id
        if not 1 <= owner <= 255:
            raise InvalidArgument(f"uri = {shown(uri)} is not allowed: components are 1 to 255")
        return await _read(files_of(owner), unquote(found[2]), patience_s)
    if uri.lower().startswith(WEB):
        return await _Web(uri, patience_s).content()
    raise InvalidArgument(f"uri = {shown(uri)} is not allowed: mftp://…, http://… or https://…")


async def _read(files: Files, path: str, patience_s: float) -> bytes:
    """Given up as soon as the component says, or shows, that the file is too large."""
    with anyio.CancelScope() as scope:

        def look(progress: Progress) -> None:
            if max(progress.done, progress.total or 0) > LARGEST_FILE:
                scope.cancel()

        return await files.read(path, patience_s=patience_s, on_progress=look)
    raise too_large(path)


class _Web:
    """One download in a thread, which is ended from outside when nobody waits for it, whatever the server does."""

    def __init__(self, uri: str, patience_s: float) -> None:
        self._uri, self._patience_s = uri, min(patience_s, WEB_S)
        self._connections: list[HTTPConnection] = []
        self._is_aborted = False

    async def content(self) -> bytes:
        """All of it; see :func:`fetch`."""
        try:
            with anyio.move_on_after(WEB_S):
                return await asyncio.to_thread(self._download)
        finally:
            self._abort()
        raise FileTimeout(f"{self._uri} did not come within {WEB_S:g} s")

    def _abort(self) -> None:
        self._is_aborted = True
        for connection in self._connections:
            if connection.sock is not None:
                with suppress(OSError):
                    connection.sock.shutdown(READING_AND_WRITING)

    def _connect(self, kind: type[HTTPConnection]) -> Callable[..., HTTPConnection]:
        def connect(host: str, **options: Any) -> HTTPConnection:
            if self._is_aborted:
                raise OSError("given up")
            connection = kind(host, **options)
            self._connections.append(connection)
            return connection

        return connect

    def _opener(self) -> OpenerDirector:
        """No handlers but those of the web: an address must not lead to a file of this computer."""
        from http.client import HTTPConnection, HTTPSConnection
        from urllib import request

        connect = self._connect

        class Plain(request.HTTPHandler):
            def http_open(self, req: request.Request) -> Any:
                return self.do_open(connect(HTTPConnection), req)

        class Secure(request.HTTPSHandler):
            def https_open(self, req: request.Request) -> Any:
                return self.do_open(connect(HTTPSConnection), req)

        opener = request.OpenerDirector()
        for handler in (
            request.ProxyHandler(),
            Plain(),
            Secure(),
            request.HTTPDefaultErrorHandler(),
            request.HTTPRedirectHandler(),
            request.HTTPErrorProcessor(),
        ):
            opener.add_handler(handler)
        return opener

    def _download(self) -> bytes:
        from http.client import HTTPException

        try:
            answer = self._opener().open(self._uri, timeout=self._patience_s)
            if answer is None:
                raise OSError("nothing came")
            with answer:
                content = bytearray()
                while not self._is_aborted and (block := answer.read1(BLOCK)):
                    content += block
                    if len(content) > LARGEST_FILE:
                        raise too_large(self._uri)
                if answer.length:  # of a server that says how much there is
                    raise OSError(f"{answer.length} bytes did not come")
                return bytes(content)
        except InvalidArgument:
            raise
        except (OSError, HTTPException, ValueError) as error:
            if isinstance(getattr(error, "reason", error), TimeoutError):
                raise FileTimeout(f"{self._uri} did not come: nothing for {self._patience_s:g} s") from None
            raise OperationRejected(f"{self._uri} was not given: {error}") from None
