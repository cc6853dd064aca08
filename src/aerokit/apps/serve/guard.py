"""Who may ask: host and origin of a request, the token, and what browsers are told to forbid themselves."""

from __future__ import annotations

import hmac
import ipaddress
from collections import Counter
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from uvicorn.protocols.http.h11_impl import H11Protocol

from aerokit.apps.serve.requests import Problem, problem_response
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Collection, Iterable

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

PROTOCOL = "aerokit.v1"
"""The WebSocket subprotocol that is spoken."""

_TOKEN_PREFIX = "bearer."

SHORTEST_TOKEN = 16

_TOKEN_CHARACTERS = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-._~")


def check_token(token: str) -> str:
    """Raise InvalidArgument unless it can stand in headers and is not short; its value is in no text."""
    if not (SHORTEST_TOKEN <= len(token) <= 256 and set(token) <= _TOKEN_CHARACTERS):
        raise InvalidArgument(
            f"a token has {SHORTEST_TOKEN} to 256 characters of A-Z, a-z, 0-9 and - . _ ~; this one has {len(token)},"
            " or others"
        )
    return token


class Keys:
    """Checks the token of a request: ``Authorization: Bearer …``, or for WebSockets a subprotocol ``bearer.…``."""

    def __init__(self, token: str, *, open_reading: bool, read_only: bool) -> None:
        self._token = check_token(token).encode()
        self._open_reading = open_reading
        self.read_only: bool = read_only

    def holds_token(self, headers: Headers) -> bool:
        """Whether the token is in these headers."""
        given = _token_of(headers)
        return given is not None and hmac.compare_digest(
            given.encode("utf-8", "surrogateescape"), self._token
        )

    def check(self, headers: Headers, *, is_order: bool = False, needs_token: bool = False) -> None:
        """Raise Problem, 401 or 403, unless this may be asked."""
        if is_order and self.read_only:
            raise Problem(403, "ReadOnly", "this server takes no orders; nothing was sent")
        given = _token_of(headers)
        if given is None and self._open_reading and not (is_order or needs_token):
            return
        if not self.holds_token(headers):
            what = "the token is missing" if given is None else "the token is wrong"
            headers_back = {"WWW-Authenticate": 'Bearer realm="aerokit"'}
            raise Problem(401, "Unauthorized", f"{what}; nothing was sent", headers_back)


def _token_of(headers: Headers) -> str | None:
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    for each in headers.get("sec-websocket-protocol", "").split(","):
        if each.strip().startswith(_TOKEN_PREFIX):
            return each.strip()[len(_TOKEN_PREFIX) :]
    return None


def content_policy(tiles: str | None) -> str:
    """The Content-Security-Policy of all answers; pictures of a tile server are let in by its origin."""
    pictures = "'self'"
    if tiles is not None:
        place = urlsplit(tiles)
        is_place = place.scheme in ("http", "https") and place.hostname and "@" not in place.netloc
        if (
            not is_place
            or any(f"{{{each}}}" not in tiles for each in "xyz")
            or set(tiles) & set(" \t\n\"';,<>\\")
        ):
            raise InvalidArgument(
                f"tiles = {tiles!r} is no URL of tiles: https://tiles.example/{{z}}/{{x}}/{{y}}.png"
            )
        pictures += f" {place.scheme}://{place.netloc}"
    return (
        f"default-src 'none'; script-src 'self'; style-src 'self'; img-src {pictures}; connect-src 'self';"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class Guard:
    """ASGI middleware: refuses other hosts and origins, and adds the headers that every answer has.

    A Host that is an IP address or ``localhost`` cannot be a name that somebody else points here (DNS rebinding);
    other names have to be in ``hosts``. A request that a browser makes for another site says so by its Origin.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], tiles: str | None) -> None:
        self._app = app
        self._hosts = {"localhost", *(host.lower() for host in hosts)}
        self._headers = {
            "Content-Security-Policy": content_policy(tiles),
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer" if tiles is None else "strict-origin-when-cross-origin",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or hand it on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        async def sending(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                MutableHeaders(scope=message).update(self._headers)
            await send(message)

        try:
            self._check(Headers(scope=scope))
        except Problem as problem:
            if scope["type"] == "websocket":
                await receive()
                await send({"type": "websocket.close", "code": 1008})
            else:
                await problem_response(problem)(scope, receive, sending)
            return
        await self._app(scope, receive, sending)

    def _check(self, headers: Headers) -> None:
        host = headers.get("host", "")
        if not self._is_own(host):
            raise Problem(421, "WrongHost", "this server is not known by that name (--allow-host)")
        origins = headers.getlist("origin")
        if any(urlsplit(origin).netloc.lower() != host.lower() for origin in origins):
            raise Problem(403, "WrongOrigin", "pages of other sites may not ask here")
        if (
            headers.get("sec-fetch-site", "none") == "cross-site"
            and headers.get("sec-fetch-mode") != "navigate"
        ):
            raise Problem(403, "WrongOrigin", "pages of other sites may not ask here")

    def _is_own(self, host: str) -> bool:
        try:
            name = (urlsplit(f"//{host}").hostname or "").lower()
            if name in self._hosts:
                return True
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


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
