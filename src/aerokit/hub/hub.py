"""``Hub``: several links joined into one MAVLink network."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checked, checks_arguments
from aerokit._internal.async_block import async_block
from aerokit.connection.frame_observers import Recording
from aerokit.connection.tasks import Background
from aerokit.errors import BusyError, ConnectionClosed, InvalidArgument, LinkError
from aerokit.hub.attachment import Attachment, check_filters
from aerokit.hub.shared_link import SharedLink
from aerokit.hub.switch import Switch
from aerokit.hub.values import Endpoint, HubEvent
from aerokit.mavlink.dialect import STANDARD
from aerokit.transport.link import Link
from aerokit.transport.reconnecting import Delays

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncIterator, Callable, Iterable
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.connection.connection import Connection
    from aerokit.hub.port import Port
    from aerokit.hub.values import EndpointStatistics, HubEventKind
    from aerokit.mavlink.dialect import Dialect

logger: logging.Logger = logging.getLogger("aerokit")

CLOSE_TIMEOUT_S = 2.0

FLUSH_EVERY_S = 1.0

_QUIET_KINDS = ("opened", "removed", "client_joined", "client_left", "drained", "restored")


@checks_arguments
class Hub:
    """Passes MAVLink frames on between its endpoints, by MAVLink's own routing rules, and says nothing of its own.

    ```python
    async with aerokit.Hub(["serial:///dev/ttyACM0:115200", "tcpin:0.0.0.0:5760", "udpout:10.0.0.7:14550"]) as hub:
        await asyncio.sleep(3600)
    ```

    Each client of a listening endpoint is a place of its own to the routing. Links that are lost are opened again.
    An endpoint that fails, stalls or is flooded harms no other one: what waits for it is bounded, newer telemetry
    takes the place of older, and an order that has waited for a second is dropped instead of arriving late.

    A hub runs in the asyncio loop it was entered in, and is entered once.
    """

    def __init__(
        self, endpoints: Iterable[str | Endpoint | Link] = (), *, dialect: Dialect = STANDARD
    ) -> None:
        """Nothing is opened yet.

        Args:
            endpoints: connection strings, links that are not open, or `Endpoint` with what may pass.
            dialect: the messages that are understood; others are passed on to everybody, unchecked.

        Raises:
            InvalidArgument: an address or a name of a message is wrong, or two endpoints have one name.
        """
        if isinstance(endpoints, str):
            raise InvalidArgument(f"endpoints = {endpoints!r} is not allowed: a list of addresses")
        self._given = [_endpoint(each) for each in endpoints]
        for each in self._given:
            check_filters(each, dialect)
        names = [each.name for each in self._given if each.name]
        for name in names:
            if names.count(name) > 1:
                raise InvalidArgument(f"two endpoints are called {name!r}")
        self._dialect = dialect
        self._attachments: dict[str, Attachment] = {}
        self._listeners: list[Callable[[HubEvent], object]] = []
        self._switch: Switch | None = None
        self._background: Background | None = None
        self._is_closed = False

    async def __aenter__(self) -> Self:
        """Open all endpoints.

        Raises:
            LinkOpenError: one of them, which is not ``patient``, could not be opened; none is open then.
            InvalidArgument: two endpoints have one address and no names.
            BusyError: the hub was entered before.
        """
        if self._switch is not None:
            raise BusyError("a hub is entered once: make another one")
        self._switch = Switch(self._dialect, _gate, self._on_mistake)
        self._switch.router.on_change = self._on_change
        self._background = Background(self._on_background_mistake)
        self._background.start(self._flush_recording, "aerokit hub")
        try:
            for endpoint in self._given:
                await self._add(endpoint)
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close all of them."""
        await self._close()

    @property
    def endpoints(self) -> tuple[EndpointStatistics, ...]:
        """What has come and gone by each endpoint until now, in the order they were added."""
        return tuple(attachment.statistics() for attachment in self._attachments.values())

    async def add(self, endpoint: str | Endpoint | Link) -> EndpointStatistics:
        """Open one more endpoint, and say what it is called and where it is.

        Raises:
            LinkOpenError: it could not be opened, and is not ``patient``.
            InvalidArgument: the address, the name or a name of a message is wrong; nothing was opened.
            BusyError: the link given is in use.
            ConnectionClosed: the hub, or the link given, is closed.
        """
        self._raise_unless_open()
        return (await self._add(_endpoint(endpoint))).statistics()

    async def remove(self, name: str) -> None:
        """Close an endpoint and forget who was behind it.

        Raises:
            InvalidArgument: there is none of this name.
            ConnectionClosed: the hub is closed.
        """
        self._raise_unless_open()
        attachment = self._attachments.pop(name, None)
        if attachment is None:
            raise InvalidArgument(f"name = {name!r} is not allowed: {', '.join(self._attachments) or 'none'}")
        attachment.close()
        self._tell(attachment, "removed", f"{name} was removed")
        await _closed([attachment])

    async def share(self, connection: Connection, *, name: str = "program") -> EndpointStatistics:
        """Make an open connection of this program an endpoint: its vehicles, and what it sends itself.

        The connection goes on as before, with all of its events. What it receives and sends goes to the other endpoints
        as it would from a link; what they send to its vehicles goes out by it, signed if it signs. Others should have
        other ids than the program (``source_system``, ``source_component``): what is for these ids is the program's.

        Raises:
            InvalidArgument: there is an endpoint of this name.
            ConnectionClosed, LinkLost: the hub is closed, or the connection has ended.
        """
        self._raise_unless_open()
        connection.raise_if_ended()
        return (await self._add(Endpoint(SharedLink(connection), name=name))).statistics()

    def on_event(self, listener: Callable[[HubEvent], object]) -> Callable[[], None]:
        """Have ``listener(event)`` called for what happens to endpoints; call what is returned to end it.

        It must be quick and must not raise; what it raises is logged.
        """
        self._listeners.append(listener)

        def detach() -> None:
            if listener in self._listeners:
                self._listeners.remove(listener)

        return detach

    def record(self, path: str | os.PathLike[str]) -> None:
        """Write every frame that is passed on, once, to a ``.tlog`` file from now on; an existing file is replaced.

        Signatures that are taken off at an endpoint are not in it, nor is SETUP_SIGNING, which holds a key. A disk that
        is full ends the recording, not the hub.

        Raises:
            LinkOpenError: the file cannot be written.
            BusyError: a recording is under way.
            ConnectionClosed: the hub is closed, or not entered yet.
        """
        switch = self._raise_unless_open()
        if switch.recording is not None:
            raise BusyError("this hub is being recorded already")
        switch.recording = Recording(path, asyncio.get_running_loop().time())

    # ------------------------------------------------------------------------------------ inside

    async def _add(self, endpoint: Endpoint) -> Attachment:
        assert self._switch is not None
        assert self._background is not None
        clock = asyncio.get_running_loop().time
        attachment = Attachment(endpoint, self._switch, self._dialect, clock, self._tell)
        if attachment.name in self._attachments:
            raise InvalidArgument(f"two endpoints are called {attachment.name!r}: give them names")
        self._attachments[attachment.name] = attachment
        try:
            await attachment.open()
        except LinkError as error:
            if not endpoint.patient:
                del self._attachments[attachment.name]
                raise
            self._tell(attachment, "lost", f"{error}; trying until it can be opened")
            self._background.start(lambda: self._open_later(attachment), "aerokit hub opening")
        except BaseException:
            self._attachments.pop(attachment.name, None)
            raise
        return attachment

    async def _open_later(self, attachment: Attachment) -> None:
        delays = Delays()
        while self._attachments.get(attachment.name) is attachment:
            await anyio.sleep(delays.take())
            if self._attachments.get(attachment.name) is not attachment:  # removed meanwhile
                return
            try:
                await attachment.open()
            except LinkError as error:
                logger.debug("not yet: %s", error)
            else:
                if self._attachments.get(attachment.name) is not attachment:  # removed meanwhile
                    attachment.close()
                return

    async def _close(self) -> None:
        self._is_closed = True
        attachments, self._attachments = list(self._attachments.values()), {}
        for attachment in attachments:
            attachment.close()
        if self._switch is not None:
            self._switch.close()
            if self._switch.recording is not None:
                self._switch.recording.close()
        try:
            if self._background is not None:
                await self._background.aclose()
        finally:
            await _closed(attachments)

    async def _flush_recording(self) -> None:
        while True:
            await anyio.sleep(FLUSH_EVERY_S)
            if self._switch is not None and self._switch.recording is not None:
                self._switch.recording.flush()

    def _raise_unless_open(self) -> Switch:
        if self._switch is None or self._is_closed:
            raise ConnectionClosed(
                "the hub is closed" if self._is_closed else "enter the hub first: async with hub:"
            )
        return self._switch

    def _tell(self, attachment: Attachment, kind: HubEventKind, text: str) -> None:
        logger.log(
            logging.INFO if kind in _QUIET_KINDS else logging.WARNING, "hub: %s: %s", attachment.name, text
        )
        event = HubEvent(asyncio.get_running_loop().time(), attachment.name, kind, text)
        for listener in tuple(self._listeners):
            try:
                listener(event)
            except Exception:
                logger.exception("a listener (%r) raised; the others are told all the same", listener)

    def _on_change(self, kind: HubEventKind, source: int, port: Port, before: Port | None) -> None:
        if before is not None and before.endpoint == port.endpoint and kind == "moved":
            return  # its guard has told it
        who = f"{source & 0xFF}/{source >> 8}"
        other = "an endpoint that has gone" if before is None else before.endpoint
        text = {
            "heard_twice": f"{who} is heard here and at {other}, where what is for it goes: two links to one vehicle,"
            " or two vehicles with the same ids",
            "moved": f"what is for {who} goes here now: it is not heard at {other} any more",
            "loop": f"what {who} said at {other} comes back here: both lead to the same network in a circle; what comes"
            " round is dropped",
        }[kind]
        port.report(kind, text)

    def _on_mistake(self, port: Port, error: Exception) -> None:
        port.report("mistake", f"what was to be sent is lost: {error}")

    def _on_background_mistake(self, error: Exception) -> None:
        logger.error("a mistake inside aerokit's hub; its endpoints go on", exc_info=error)


def _endpoint(given: str | Endpoint | Link) -> Endpoint:
    return given if isinstance(given, Endpoint) else Endpoint(given)


def _gate(port: Port, message_id: int) -> float | None:
    return port.period(message_id)


async def _closed(attachments: list[Attachment]) -> None:
    """Wait until nothing is left of their links, for a while at most."""
    with anyio.CancelScope(shield=True), anyio.move_on_after(CLOSE_TIMEOUT_S):
        for attachment in attachments:
            await attachment.wait_closed()


@checked
@async_block
async def shared(connection: Connection, endpoints: Iterable[str | Endpoint | Link]) -> AsyncIterator[Hub]:
    """Share an open connection with other programs for the time of the ``async with`` block; gives the hub that does.

    ``aerokit.connect(…, share=[…])`` does the same. See `Hub.share`.

    Args:
        connection: of this program; it stays open.
        endpoints: where the others are, or come: ``["tcpin:127.0.0.1:5760"]``.

    Raises:
        InvalidArgument: an address is wrong, or two endpoints have one name.
        LinkOpenError: an endpoint could not be opened.
        ConnectionClosed, LinkLost: the connection has ended.
    """
    async with Hub(endpoints, dialect=connection.bus.dialect) as hub:
        await hub.share(connection)
        yield hub
