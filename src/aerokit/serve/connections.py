"""``http_protocol``: the connections of ``aerokit serve``; who has not shown the token holds few, and none for long."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Iterable

__all__ = ["MAX_STRANGERS", "REQUEST_TIMEOUT_S", "http_protocol"]

MAX_STRANGERS = 64
"""Connections that have not shown the token. One more ends the oldest one of the address that has most of them."""
REQUEST_TIMEOUT_S = 10.0
"""Seconds from the first byte of a request, or from the connection's beginning, to the end of its headers."""

RawHeaders = list[tuple[bytes, bytes]]


def http_protocol(holds_token: Callable[[RawHeaders], bool]) -> type[H11Protocol]:
    """Make the ``http`` class of a `uvicorn.Config`.

    Connections whose requests hold the token are never ended for others, so that there is always a place for the owner.
    """
    strangers: dict[_HttpConnection, None] = {}

    class HttpConnection(_HttpConnection):
        _strangers = strangers

        def _holds_token(self) -> bool:
            return holds_token(self.headers)

    return HttpConnection


class _HttpConnection(H11Protocol):
    _strangers: dict[_HttpConnection, None]
    _timer: asyncio.TimerHandle | None = None

    def _holds_token(self) -> bool:
        raise NotImplementedError

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._strangers[self] = None
        if len(self._strangers) > MAX_STRANGERS:
            self._end(_oldest_of_the_most_frequent(self._strangers))
        self._await_request()

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._timer is None and (self.cycle is None or self.cycle.response_complete):
            self._await_request()
        super().data_received(data)

    def handle_events(self) -> None:
        before = self.scope
        super().handle_events()
        if self.scope is not before:  # the headers of a request are there
            self._stop_timer()
            if self._holds_token():
                self._strangers.pop(self, None)

    def handle_websocket_upgrade(self, event: Any) -> None:
        self._forget()  # the application counts its sockets
        super().handle_websocket_upgrade(event)

    def _await_request(self) -> None:
        self._timer = self.loop.call_later(REQUEST_TIMEOUT_S, self._end, self)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _forget(self) -> None:
        self._stop_timer()
        self._strangers.pop(self, None)

    @staticmethod
    def _end(connection: _HttpConnection) -> None:
        connection._forget()
        connection.transport.abort()


def _oldest_of_the_most_frequent(connections: Iterable[_HttpConnection]) -> _HttpConnection:
    connections = list(connections)
    counts = Counter(_host(each) for each in connections)
    return max(connections, key=lambda each: counts[_host(each)])  # of equal ones the first


def _host(connection: H11Protocol) -> object:
    return connection.client and connection.client[0]
