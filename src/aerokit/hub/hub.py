"""``Hub``: joins several links into one MAVLink network."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checked, checks_arguments
from aerokit._internal.async_block import async_block
from aerokit.connection.bus import once
from aerokit.connection.frame_observers import Recording
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import BusyError, ConnectionClosed, InvalidArgument, LinkError
from aerokit.hub.running_endpoint import RunningEndpoint, filters_of
from aerokit.hub.shared_link import SharedLink
from aerokit.hub.switch import Switch
from aerokit.hub.values import Endpoint, HubEvent
from aerokit.mavlink.dialect import STANDARD
from aerokit.transport.link import Link
from aerokit.transport.reconnecting import Backoff

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

FLUSH_INTERVAL_S = 1.0

_INFO_KINDS = ("opened", "removed", "client_joined", "client_left", "drained", "restored")


@checks_arguments
class Hub:
    """Forwards MAVLink frames between endpoints by MAVLink's routing rules. A hub sends no messages of its own.

    ```python
    async with aerokit.Hub(["serial:///dev/ttyACM0:115200", "tcpin:0.0.0.0:5760", "udpout:10.0.0.7:14550"]) as hub:
        await asyncio.sleep(3600)
    ```

    Each client of a listening endpoint is routed separately. Lost links are reopened. An endpoint that fails, stalls or
    is flooded does not affect other endpoints: its queue is bounded, newer telemetry replaces older telemetry, and a
    command that has waited for a second is dropped.

    A hub runs in the asyncio loop in which it is entered, and can be entered once.
    """

    def __init__(self, endpoints: Iterable[str | Endpoint | Link] = (), *, dialect: Dialect = STANDARD) -> None:
        """Create a hub without opening it.

        Args:
            endpoints: connection strings, unopened links, or `Endpoint` with filters.
            dialect: message definitions. Messages without a definition are forwarded without a check of
                the checksum, but only from known senders, and only to endpoints whose ``only`` is empty.

        Raises:
            InvalidArgument: an address or a message name is wrong, or two endpoints have the same name.
        """
        if isinstance(endpoints, str):
            raise InvalidArgument(f"endpoints = {endpoints!r} is not allowed: it must be a list of addresses")
        self._endpoints = [_as_endpoint(endpoint) for endpoint in endpoints]
        for endpoint in self._endpoints:
            filters_of(endpoint, dialect)
        names = [endpoint.name for endpoint in self._endpoints if endpoint.name]
        for name in names:
            if names.count(name) > 1:
                raise InvalidArgument(f"two endpoints have the name {name!r}: give each its own name")
        self._dialect = dialect
        self._running_endpoints: dict[str, RunningEndpoint] = {}  # by name
        self._listeners: list[Callable[[HubEvent], object]] = []
        self._switch: Switch | None = None  # None while the hub is not open
        self._background: BackgroundTasks | None = None  # None while the hub is not open
        self._is_closed = False

    async def __aenter__(self) -> Self:
        """Open all endpoints.

        Raises:
            LinkOpenError: an endpoint without ``retry_open`` could not be opened; all are closed again.
            InvalidArgument: two endpoints have the same address and no names.
            BusyError: the hub was entered before.
        """
        if self._switch is not None:
            raise BusyError("a hub can be entered only once; make a new one")
        self._switch = Switch(self._dialect, self._on_port_error)
        self._switch.router.on_change = self._on_change
        self._background = BackgroundTasks(self._on_background_error)
        self._background.start(self._flush_recording, "aerokit hub")
        try:
            for endpoint in self._endpoints:
                await self._add(endpoint)
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close all endpoints."""
        await self._close()

    @property
    def endpoints(self) -> tuple[EndpointStatistics, ...]:
        """Counters of each endpoint, in the order in which they were added."""
        return tuple(endpoint.statistics() for endpoint in self._running_endpoints.values())

    async def add(self, endpoint: str | Endpoint | Link) -> EndpointStatistics:
        """Open another endpoint, and return its name, address and counters.

        Raises:
            LinkOpenError: the endpoint could not be opened and has no ``retry_open``.
            InvalidArgument: the address, the name or a message name is wrong; nothing was opened.
            BusyError: the given link is in use.
            ConnectionClosed: the hub or the given link is closed, or the endpoint was removed meanwhile.
        """
        self._raise_unless_open()
        return (await self._add(_as_endpoint(endpoint))).statistics()

    async def remove(self, name: str) -> None:
        """Close an endpoint and forget its senders.

        Raises:
            InvalidArgument: no endpoint has this name.
            ConnectionClosed: the hub is closed.
        """
        self._raise_unless_open()
        endpoint = self._running_endpoints.pop(name, None)
        if endpoint is None:
            present = ", ".join(self._running_endpoints) or "none"
            raise InvalidArgument(f"no endpoint is named {name!r}; endpoints: {present}")
        endpoint.close()
        self._report(endpoint, "removed", f"{name} was removed")
        await _wait_until_closed([endpoint])

    async def share(self, connection: Connection, *, name: str = "program") -> EndpointStatistics:
        """Add an open connection of this program as an endpoint.

        The connection continues as before. The other endpoints get every frame that the connection receives or sends.
        Frames that they send to a vehicle of the connection go over the connection, signed if the connection signs.
        Other stations must not use the connection's own ids (``source_system``, ``source_component``), because frames
        that are addressed to these ids go to this program.

        Raises:
            InvalidArgument: an endpoint has this name, or this hub shares the connection already.
            ConnectionClosed, LinkLost: the hub is closed, or the connection has ended.
        """
        self._raise_unless_open()
        connection.raise_if_ended()
        links = [endpoint.link for endpoint in self._running_endpoints.values() if endpoint.is_open]
        is_shared = any(isinstance(link, SharedLink) and link.connection is connection for link in links)
        if is_shared and name not in self._running_endpoints:
            # With two endpoints for one connection, the hub would send a vehicle its own frames.
            raise InvalidArgument("connection = … is not allowed: this hub shares it already")
        return (await self._add(Endpoint(SharedLink(connection), name=name))).statistics()

    def on_event(self, listener: Callable[[HubEvent], object]) -> Callable[[], None]:
        """Call ``listener(event)`` for every event; return a function that removes the listener.

        The listener must return quickly; its exceptions are logged.
        """
        self._listeners.append(listener)
        return once(lambda: self._listeners.remove(listener))

    def record(self, path: str | os.PathLike[str]) -> None:
        """Record every forwarded frame once to a ``.tlog`` file.

        When the first frame is forwarded, an existing file is renamed to the next free number: ``flight.1.tlog``.

        Signatures that an endpoint removes are not recorded. Nor is SETUP_SIGNING, because it contains a key. A full
        disk ends the recording, not the hub.

        Raises:
            LinkOpenError: the file cannot be written.
            BusyError: the hub is being recorded already.
            ConnectionClosed: the hub is closed, or not entered yet.
        """
        switch = self._raise_unless_open()
        if switch.recording is not None:
            raise BusyError("this hub is already being recorded")
        switch.recording = Recording(path, asyncio.get_running_loop().time())

    # ------------------------------------------------------------------------------------ internal

    async def _add(self, endpoint: Endpoint) -> RunningEndpoint:
        """Open an endpoint. With ``retry_open``, a failure is retried in the background."""
        assert self._switch is not None
        assert self._background is not None
        clock = asyncio.get_running_loop().time
        running = RunningEndpoint(endpoint, self._switch, self._dialect, clock, self._report)
        if running.name in self._running_endpoints:
            raise InvalidArgument(f"two endpoints have the name {running.name!r}: set Endpoint(name=…)")
        self._running_endpoints[running.name] = running
        try:
            await running.open()
        except BaseException as error:  # A cancellation of this call is included.
            will_retry = endpoint.retry_open and isinstance(error, LinkError)
            if not will_retry:
                if self._has(running):
                    del self._running_endpoints[running.name]
                raise
            self._report(running, "lost", f"{error}; it is retried until it can be opened")
            self._background.start(lambda: self._retry_opening(running), "aerokit hub opening")
        if not self._has(running):
            running.close()
            await _wait_until_closed([running])
            raise ConnectionClosed(f"{running.name} was removed while it was being opened")
        return running

    def _has(self, endpoint: RunningEndpoint) -> bool:
        return self._running_endpoints.get(endpoint.name) is endpoint

    async def _retry_opening(self, endpoint: RunningEndpoint) -> None:
        backoff = Backoff()
        while self._has(endpoint):
            await anyio.sleep(backoff.next_delay())
            if not self._has(endpoint):  # The endpoint was removed meanwhile.
                return
            try:
                await endpoint.open()
            except LinkError as error:
                logger.debug("the link still cannot be opened: %s", error)
            else:
                if not self._has(endpoint):  # The endpoint was removed meanwhile.
                    endpoint.close()
                return

    async def _close(self) -> None:
        self._is_closed = True
        endpoints, self._running_endpoints = list(self._running_endpoints.values()), {}
        for endpoint in endpoints:
            endpoint.close()
        if self._switch is not None:
            self._switch.close()
            if self._switch.recording is not None:
                self._switch.recording.close()
        try:
            if self._background is not None:
                await self._background.aclose()
        finally:
            await _wait_until_closed(endpoints)

    async def _flush_recording(self) -> None:
        while True:
            await anyio.sleep(FLUSH_INTERVAL_S)
            if self._switch is not None and self._switch.recording is not None:
                self._switch.recording.flush()

    def _raise_unless_open(self) -> Switch:
        if self._switch is None or self._is_closed:
            raise ConnectionClosed("the hub is closed" if self._is_closed else "enter the hub first: async with hub:")
        return self._switch

    def _report(self, endpoint: RunningEndpoint, kind: HubEventKind, text: str) -> None:
        logger.log(logging.INFO if kind in _INFO_KINDS else logging.WARNING, "hub: %s: %s", endpoint.name, text)
        event = HubEvent(asyncio.get_running_loop().time(), endpoint.name, kind, text)
        for listener in tuple(self._listeners):
            try:
                listener(event)
            except Exception:
                logger.exception("listener %r raised an exception; the others are still called", listener)

    def _on_change(self, kind: HubEventKind, sender: tuple[int, int], port: Port, other_port: Port | None) -> None:
        is_same_endpoint = other_port is not None and other_port.endpoint == port.endpoint
        if is_same_endpoint and kind == "route_changed":
            return  # The endpoint's IdentityGuard reports a change between two peers of the same endpoint.
        system_id, component_id = sender
        ids = f"{system_id}/{component_id}"
        other = "a removed endpoint" if other_port is None else other_port.endpoint
        text = {
            "duplicate_sender": f"{ids} is received here and at {other}; messages for it go to {other}: two links to"
            " one vehicle, or two vehicles with the same ids",
            "route_changed": f"messages for {ids} are sent here now, because it is no longer received at {other}",
            "loop": f"frames of {ids} from {other} come back here: both endpoints lead to the same network; returning"
            " frames are dropped",
        }[kind]
        port.report(kind, text)

    def _on_port_error(self, port: Port, error: Exception) -> None:
        port.report("internal_error", f"frames could not be sent and were dropped: {error}")

    def _on_background_error(self, error: Exception) -> None:
        logger.error("internal error of aerokit's hub; its endpoints continue", exc_info=error)


def _as_endpoint(endpoint: str | Endpoint | Link) -> Endpoint:
    return endpoint if isinstance(endpoint, Endpoint) else Endpoint(endpoint)


async def _wait_until_closed(endpoints: list[RunningEndpoint]) -> None:
    with anyio.CancelScope(shield=True), anyio.move_on_after(CLOSE_TIMEOUT_S):
        for endpoint in endpoints:
            await endpoint.wait_closed()


@checked
@async_block
async def shared(connection: Connection, endpoints: Iterable[str | Endpoint | Link]) -> AsyncIterator[Hub]:
    """Share an open connection with other programs during an ``async with`` block; ``as`` gives the hub.

    ``aerokit.connect(…, share=[…])`` does the same. See `Hub.share`.

    Args:
        connection: connection of this program; it stays open.
        endpoints: endpoints for the other programs, e.g. ``["tcpin:127.0.0.1:5760"]``.

    Raises:
        InvalidArgument: an address is wrong, or two endpoints have the same name.
        LinkOpenError: an endpoint could not be opened.
        ConnectionClosed, LinkLost: the connection has ended.
    """
    async with Hub(endpoints, dialect=connection.bus.dialect) as hub:
        await hub.share(connection)
        yield hub
