"""``ComponentSession``: commands, rates and transfers of one component. ``fetch``: reads a file by its address."""

from __future__ import annotations

import asyncio
import math
import re
from contextlib import suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import anyio

from aerokit._internal.files import MAX_FILE_SIZE, file_too_large
from aerokit._internal.formatting import short_repr
from aerokit.autopilots import Autopilot, AutopilotVersion
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import FileFormatError, FileTimeout, InvalidArgument, OperationRejected
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.session.rates import MessageRates
from aerokit.vehicle.session.subscriber import ComponentSubscriber
from aerokit.vehicle.session.transfers import Transfers

if TYPE_CHECKING:
    from collections.abc import Callable
    from http.client import HTTPConnection
    from urllib.request import OpenerDirector

    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.protocols.exchange import TransferProgress
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.commands import CommandSender
    from aerokit.vehicle.session.session import VehicleSession


class ComponentSession:
    """Session with a component other than the autopilot. Works like `VehicleSession`, and closes with the vehicle."""

    def __init__(self, session: VehicleSession, component_id: int) -> None:
        self._session = session
        self.component_id: int = component_id
        self.system_id: int = session.system_id
        self.connection: Connection = session.connection
        self.commands: CommandSender = session.commands
        self.on_reboot: list[Callable[[], None]] = session.on_reboot
        self.rates: MessageRates = MessageRates(
            session.connection, session.commands, session.system_id, component_id, stream_groups={}
        )
        self.subscriber: ComponentSubscriber = ComponentSubscriber(
            session.connection,
            session.system_id,
            component_id,
            self.rates,
            register_cell=session.register_cell,
            at_close=session.at_close,
            end=session.end,
        )
        version: StateCell[AutopilotVersion] = session.connection.new_cell(
            "version", f"AUTOPILOT_VERSION of component {component_id}"
        )
        session.register_cell(version)
        self.transfers: Transfers = Transfers(
            session.connection,
            session.system_id,
            component_id,
            autopilot=Autopilot(session.vehicle_type),  # The autopilot's special rules do not apply to a component.
            version=version,
            background=session.background,
            end=session.end,
            describe=self.describe_link,
            round_trip_s=lambda: session.link_watch.round_trip_s,
            request_version=self._request_version,
        )
        autopilot = self.transfers.autopilot
        source = Source(session.system_id, component_id, m.AutopilotVersion.NAME)
        self.subscriber.listen(m.AutopilotVersion, lambda message: version.set(autopilot.version_of(message), source))
        for function in (self.rates.run, self.rates.watch):
            session.background.start(function, f"aerokit {function.__qualname__} of component {component_id}")
        session.on_reboot.append(self.rates.request_again)
        session.at_close(self.rates.close)

    def at_close(self, *functions: Detach) -> None:
        self._session.at_close(*functions)

    async def _request_version(self) -> None:
        message_id = m.AutopilotVersion.ID
        await self.commands.send_long(MavCmd.REQUEST_MESSAGE, message_id, component_id=self.component_id)

    def describe_link(self) -> str:
        received_at = self.connection.last_heartbeat_at(self.system_id, self.component_id)
        if received_at == -math.inf:
            return f"no heartbeat of component {self.component_id} of system {self.system_id} was received"
        age = self.connection.now() - received_at
        signatures = self.connection.describe_signature_problems(self.system_id)
        prefix = f"{signatures}; " if signatures else ""
        return f"{prefix}last heartbeat of component {self.component_id} {age:.1f} s ago"


_MAVFTP = re.compile(r"(?:mftp|mavlinkftp)://(?:\[;comp=([0-9]{1,3})\])?(.+)", re.IGNORECASE)

WEB_SCHEMES = ("http://", "https://")
BLOCK_SIZE = 1 << 16

# Maximum seconds for the download of a whole file from the web.
WEB_TIMEOUT_S = 60.0

# The value of `socket.SHUT_RDWR` on all platforms. It is repeated here, because only `transport` may import `socket`.
SHUT_RDWR = 2


async def fetch(uri: str, files_of: Callable[[int], Files], component_id: int, idle_timeout_s: float) -> bytes:
    """Return the content of a file. Raises the errors of `Component.fetch`."""
    match = _MAVFTP.fullmatch(uri)
    if match is not None:
        id_text, path = match.groups()
        owner = int(id_text) if id_text else component_id  # id of the component that stores the file
        if not 1 <= owner <= 255:
            raise InvalidArgument(f"uri = {short_repr(uri)} is not allowed: its component id must be 1 to 255")
        return await _read_limited(files_of(owner), unquote(path), idle_timeout_s)
    if uri.lower().startswith(WEB_SCHEMES):
        return await _WebDownload(uri, idle_timeout_s).content()
    raise InvalidArgument(f"uri = {short_repr(uri)} is not allowed: it must begin with mftp://, http:// or https://")


async def _read_limited(files: Files, path: str, idle_timeout_s: float) -> bytes:
    with anyio.CancelScope() as scope:

        def check_size(progress: TransferProgress) -> None:
            if max(progress.done, progress.total or 0) > MAX_FILE_SIZE:
                scope.cancel()

        return await files.read(path, idle_timeout_s=idle_timeout_s, on_progress=check_size)
    raise file_too_large(path)  # `check_size` has cancelled the download.


class _WebDownload:
    """Downloads one file from the web in a thread, and aborts the download if the caller stops waiting."""

    def __init__(self, uri: str, idle_timeout_s: float) -> None:
        self._uri = uri
        self._idle_timeout_s = min(idle_timeout_s, WEB_TIMEOUT_S)
        # `_abort` closes the connections of the download thread, and sets the flag that ends the thread.
        self._connections: list[HTTPConnection] = []
        self._is_aborted = False

    async def content(self) -> bytes:
        try:
            with anyio.move_on_after(WEB_TIMEOUT_S):
                return await asyncio.to_thread(self._download)
        finally:
            self._abort()
        # The time-out has expired.
        raise FileTimeout(f"{self._uri} did not arrive within {WEB_TIMEOUT_S:g} s")

    def _abort(self) -> None:
        self._is_aborted = True
        for connection in self._connections:
            if connection.sock is not None:
                with suppress(OSError):  # The connection may have ended already.
                    connection.sock.shutdown(SHUT_RDWR)

    def _connect_with(self, connection_type: type[HTTPConnection]) -> Callable[..., HTTPConnection]:
        """Return a factory of connections that `_abort` can close."""

        def connect(host: str, **options: Any) -> HTTPConnection:
            if self._is_aborted:
                raise OSError("the download was aborted")
            connection = connection_type(host, **options)
            self._connections.append(connection)
            return connection

        return connect

    def _opener(self) -> OpenerDirector:
        from http.client import HTTPConnection, HTTPSConnection
        from urllib import request

        connect_with = self._connect_with

        class Plain(request.HTTPHandler):
            def http_open(self, req: request.Request) -> Any:
                return self.do_open(connect_with(HTTPConnection), req)

        class Secure(request.HTTPSHandler):
            def https_open(self, req: request.Request) -> Any:
                return self.do_open(connect_with(HTTPSConnection), req)

        # The default opener of urllib also has handlers for file: and ftp:. An address could then make aerokit read a
        # local file.
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
        """Return the content of the file. Blocks, so it runs in a thread."""
        from http.client import HTTPException

        try:
            answer = self._opener().open(self._uri, timeout=self._idle_timeout_s)
            if answer is None:
                raise OSError("no response")
            with answer:
                content = bytearray()
                while not self._is_aborted:
                    block = answer.read1(BLOCK_SIZE)
                    if not block:
                        break
                    content += block
                    if len(content) > MAX_FILE_SIZE:
                        raise file_too_large(self._uri)
                if missing := answer.length:  # number of bytes that Content-Length announced, but that did not arrive
                    raise OSError(f"the server closed the connection {missing} bytes before the end of the file")
                return bytes(content)
        except (InvalidArgument, FileFormatError):  # Both are ValueErrors. The next clause must not catch them.
            raise
        except (OSError, HTTPException, ValueError) as error:
            # urllib wraps a time-out of the connection in a URLError, as its `reason`.
            if isinstance(getattr(error, "reason", error), TimeoutError):
                raise FileTimeout(f"{self._uri} stalled: no data for {self._idle_timeout_s:g} s") from None
            raise OperationRejected(f"{self._uri} could not be fetched: {error}") from None
