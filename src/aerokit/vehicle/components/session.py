"""``ComponentTalk``: what is sent to one component beside the autopilot, and heard of it."""

from __future__ import annotations

import asyncio
import math
import re
from contextlib import suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import anyio

from aerokit._internal.files import LARGEST_FILE, too_large
from aerokit._internal.wording import shown
from aerokit.autopilots import Autopilot, AutopilotVersion
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import FileFormatError, FileTimeout, InvalidArgument, OperationRejected
from aerokit.mavlink import messages as m
from aerokit.vehicle.session.rates import Hearing, MessageRates
from aerokit.vehicle.session.transfers import Transfers

if TYPE_CHECKING:
    from collections.abc import Callable
    from http.client import HTTPConnection
    from urllib.request import OpenerDirector

    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.protocols.exchange import Progress
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.commands import CommandSender
    from aerokit.vehicle.session.session import Talk


class ComponentTalk:
    """The same as the vehicle's talk has for its autopilot, under another component id, and for as long as that."""

    def __init__(self, talk: Talk, component_id: int) -> None:
        self._talk = talk
        self.component_id: int = component_id
        self.system_id: int = talk.system_id
        self.connection: Connection = talk.connection
        self.commands: CommandSender = talk.commands
        self.on_reboot: list[Callable[[], None]] = talk.on_reboot
        self.rates: MessageRates = MessageRates(
            talk.connection, talk.commands, talk.system_id, component_id, {}
        )
        self.hearing: Hearing = Hearing(
            talk.connection, talk.system_id, component_id, self.rates, keep=talk.keep, at_close=talk.at_close
        )
        version: StateCell[AutopilotVersion] = talk.connection.new_cell(
            "version", f"AUTOPILOT_VERSION of component {component_id}"
        )
        talk.keep(version)
        self.transfers: Transfers = Transfers(
            talk.connection,
            talk.system_id,
            component_id,
            autopilot=Autopilot(talk.vehicle_type),
            version=version,
            background=talk.background,
            describe=self.describe_link,
            round_trip_s=lambda: talk.link_watch.round_trip_s,
        )
        autopilot, source = (
            self.transfers.autopilot,
            Source(talk.system_id, component_id, m.AutopilotVersion.NAME),
        )
        self.hearing.listen(
            m.AutopilotVersion, lambda message: version.set(autopilot.version_of(message), source)
        )
        for function in (self.rates.run, self.rates.watch):
            talk.background.start(function, f"aerokit {function.__qualname__} of component {component_id}")
        talk.on_reboot.append(self.rates.ask_again)
        talk.at_close(self._close)

    def at_close(self, *functions: Detach) -> None:
        """Have these called when the vehicle is let go."""
        self._talk.at_close(*functions)

    def describe_link(self) -> str:
        """One line on how well it is heard, for error texts."""
        heard_at = self.connection.heard_at(self.system_id, self.component_id)
        if heard_at == -math.inf:
            return f"component {self.component_id} of system {self.system_id} was never heard"
        age = self.connection.now() - heard_at
        signatures = self.connection.describe_signatures(self.system_id)
        why = f"{signatures}; " if signatures else ""
        return f"{why}last heartbeat of component {self.component_id} {age:.1f} s ago"

    def _close(self) -> None:
        self.transfers.is_closed = True
        self.rates.close()


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
        return await _read_response(files_of(owner), unquote(found[2]), patience_s)
    if uri.lower().startswith(WEB):
        return await _Web(uri, patience_s).content()
    raise InvalidArgument(f"uri = {shown(uri)} is not allowed: mftp://…, http://… or https://…")


async def _read_response(files: Files, path: str, patience_s: float) -> bytes:
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
        except (InvalidArgument, FileFormatError):
            raise
        except (OSError, HTTPException, ValueError) as error:
            if isinstance(getattr(error, "reason", error), TimeoutError):
                raise FileTimeout(f"{self._uri} did not come: nothing for {self._patience_s:g} s") from None
            raise OperationRejected(f"{self._uri} was not given: {error}") from None
