"""Access control: token, Host and Origin of requests, security headers, and limits on connections."""

from __future__ import annotations

import hmac
import ipaddress
from collections import Counter
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import h11
from starlette.datastructures import Headers, MutableHeaders
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from aerokit.apps.serve.requests import HttpProblem, problem_response
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Collection, Iterable

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

PROTOCOL = "aerokit.v1"
"""The WebSocket subprotocol."""
_TOKEN_PREFIX = "bearer."
MIN_TOKEN_LENGTH = 16
_TOKEN_CHARACTERS = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-._~")
MAX_ANONYMOUS_CONNECTIONS = 64
"""Maximum number of connections that have not sent the token.

If there are more, the server closes the oldest connection of the address that has the most connections.
"""
REQUEST_TIMEOUT_S = 10.0
"""Seconds from the first byte of a request, or from the start of the connection, to the end of its headers."""


def check_token(token: str) -> str:
    if not (MIN_TOKEN_LENGTH <= len(token) <= 256 and set(token) <= _TOKEN_CHARACTERS):
        # The error may be logged, so its text does not contain the token.
        raise InvalidArgument(
            f"a token must have {MIN_TOKEN_LENGTH} to 256 characters of A-Z, a-z, 0-9 and - . _ ~; this token has"
            f" {len(token)}{'' if set(token) <= _TOKEN_CHARACTERS else ', some of which are not allowed'}"
        )
    return token


class AccessControl:
    """Checks the token of requests: ``Authorization: Bearer …``, or for WebSockets a subprotocol ``bearer.…``."""

    def __init__(self, token: str, *, open_reading: bool, read_only: bool) -> None:
        self._token = check_token(token).encode()
        self._open_reading = open_reading
        self.read_only: bool = read_only

    def has_token(self, headers: Headers) -> bool:
        token = _token_of(headers)
        return token is not None and hmac.compare_digest(token.encode("utf-8", "surrogateescape"), self._token)

    def check(self, headers: Headers, *, is_order: bool = False, needs_token: bool = False) -> None:
        """Raise HttpProblem 401 or 403 if the request is not allowed.

        With ``needs_token``, a request needs the token even if reading is open to all. Orders always need it.
        """
        if is_order and self.read_only:
            raise HttpProblem(403, "ReadOnly", "this server is read-only and accepts no orders; nothing was sent")
        token = _token_of(headers)
        if token is None and self._open_reading and not (is_order or needs_token):
            return
        if not self.has_token(headers):
            reason = "the token is missing" if token is None else "the token is wrong"
            response_headers = {"WWW-Authenticate": 'Bearer realm="aerokit"'}
            raise HttpProblem(401, "Unauthorized", f"{reason}; nothing was sent", response_headers)


def _token_of(headers: Headers) -> str | None:
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    for protocol in headers.get("sec-websocket-protocol", "").split(","):
        if protocol.strip().startswith(_TOKEN_PREFIX):
            return protocol.strip()[len(_TOKEN_PREFIX) :]
    return None


def content_policy(tiles: str | None) -> str:
    """Return the Content-Security-Policy. It allows images from the tile server.

    Raises InvalidArgument if ``tiles`` is not a tile URL.
    """
    image_sources = "'self'"
    if tiles is not None:
        url = urlsplit(tiles)
        is_url = url.scheme in ("http", "https") and url.hostname and "@" not in url.netloc
        lacks_placeholder = any(f"{{{axis}}}" not in tiles for axis in "xyz")
        # With these characters, the URL could end its entry of the Content-Security-Policy and add another entry.
        has_separator = set(tiles) & set(" \t\n\"';,<>\\")
        if not is_url or lacks_placeholder or has_separator:
            raise InvalidArgument(
                f"tiles = {tiles!r} is not a tile URL, such as https://tiles.example/{{z}}/{{x}}/{{y}}.png"
            )
        # To end the download of a tile that is no longer needed, Leaflet replaces the tile's URL with a data URL.
        image_sources += f" {url.scheme}://{url.netloc} data:"
    return (
        f"default-src 'none'; script-src 'self'; style-src 'self'; img-src {image_sources}; connect-src 'self';"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class SecurityMiddleware:
    """ASGI middleware that rejects foreign hosts and origins, and adds security headers to every response.

    The Host of a request must be an IP address, ``localhost`` or one of ``hosts``. This prevents DNS rebinding. An
    Origin header must name this server, so pages of other sites cannot make requests.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], tile_url: str | None) -> None:
        self._app = app
        # Public servers of map tiles refuse requests without a Referer header.
        referrer_policy = "no-referrer" if tile_url is None else "strict-origin-when-cross-origin"
        self._hosts = {"localhost", *(host.lower() for host in hosts)}
        self._headers = {
            "Content-Security-Policy": content_policy(tile_url),
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Referrer-Policy": referrer_policy,
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                MutableHeaders(scope=message).update(self._headers)
            await send(message)

        try:
            self._check_host_and_origin(Headers(scope=scope))
        except HttpProblem as problem:
            if scope["type"] == "websocket":
                await receive()  # websocket.connect, which ASGI requires to be received before an answer
                await send({"type": "websocket.close", "code": 1008})  # "policy violation"
            else:
                await problem_response(problem)(scope, receive, send_with_headers)
            return
        await self._app(scope, receive, send_with_headers)

    def _check_host_and_origin(self, headers: Headers) -> None:
        """Raise HttpProblem if the request is for another host, or comes from a page of another site."""
        host = headers.get("host", "")
        if not self._is_own_host(host):
            raise HttpProblem(421, "WrongHost", f"host name {host[:100]!r} is not allowed; --allow-host allows it")
        # An origin is a scheme, "://" and a host. Anything else, such as "null", is not this server.
        if any(origin.partition("://")[2].lower() != host.lower() for origin in headers.getlist("origin")):
            raise HttpProblem(403, "WrongOrigin", "requests from pages of other sites are not allowed")
        # Links on other sites may open the page, but scripts and images of other sites must not request anything.
        if headers.get("sec-fetch-site", "none") == "cross-site" and headers.get("sec-fetch-mode") != "navigate":
            raise HttpProblem(403, "WrongOrigin", "requests from pages of other sites are not allowed")

    def _is_own_host(self, host: str) -> bool:
        try:
            name = (urlsplit(f"//{host}").hostname or "").lower()
            if name in self._hosts:
                return True
            ipaddress.ip_address(name)
        except ValueError:  # neither an allowed name nor an IP address
            return False
        return True


RawHeaders = list[tuple[bytes, bytes]]


def http_protocol(has_token: Callable[[RawHeaders], bool]) -> type[H11Protocol]:
    """Return a connection class for the argument ``http`` of `uvicorn.Config`. It limits anonymous connections.

    A connection is anonymous until one of its requests has the token. If there are too many anonymous connections, one
    of them is closed.
    """
    anonymous: dict[_HttpConnection, None] = {}  # an ordered set, the oldest connection first

    class HttpConnection(_HttpConnection):
        _anonymous = anonymous

        def _has_token(self) -> bool:
            return has_token(self.headers)

    return HttpConnection


class _HttpConnection(H11Protocol):
    _anonymous: dict[_HttpConnection, None]
    _timer: asyncio.TimerHandle | None = None

    def _has_token(self) -> bool:
        raise NotImplementedError

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._anonymous[self] = None
        if len(self._anonymous) > MAX_ANONYMOUS_CONNECTIONS:
            self._abort(_oldest_of_busiest_host(self._anonymous))
        self._start_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        self._remove_from_anonymous()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._timer is None and (self.cycle is None or self.cycle.response_complete):
            self._start_timer()
        super().data_received(data)

    def handle_events(self) -> None:
        previous_scope = self.scope
        super().handle_events()
        if self.scope is not previous_scope:  # a new request has begun, and its headers are complete
            self._stop_timer()
            if self._has_token():
                self._anonymous.pop(self, None)

    def handle_websocket_upgrade(self, event: Any) -> None:
        self._remove_from_anonymous()  # WebSockets are not counted here: the application limits their number.
        super().handle_websocket_upgrade(event)

    def send_400_response(self, msg: str) -> None:
        # A response that the application sends later would be the second one, and uvicorn would log an exception.
        if self.cycle is not None:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        try:
            super().send_400_response(msg)
        except h11.LocalProtocolError:  # A response was begun before, or the request is a HEAD.
            self._abort(self)

    def _start_timer(self) -> None:
        self._timer = self.loop.call_later(REQUEST_TIMEOUT_S, self._abort, self)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _remove_from_anonymous(self) -> None:
        self._stop_timer()
        self._anonymous.pop(self, None)

    @staticmethod
    def _abort(connection: _HttpConnection) -> None:
        connection._remove_from_anonymous()
        connection.transport.abort()


class WebSocketConnection(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket connection without a false log message. Pass the class as ``ws`` to `uvicorn.Config`.

    After the app has refused a handshake, uvicorn 0.35 to 0.54 log the error "ASGI callable returned without completing
    handshake".
    """

    async def send(self, message: Any) -> None:
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
            self.handshake_complete = True


def _oldest_of_busiest_host(connections: Iterable[_HttpConnection]) -> _HttpConnection:
    connections = list(connections)
    counts = Counter(_host(connection) for connection in connections)
    # Among equal counts, max() returns the first connection, which is the oldest.
    return max(connections, key=lambda connection: counts[_host(connection)])


def _host(connection: H11Protocol) -> object:
    if connection.client is None:
        return None
    host, _port = connection.client
    return host
