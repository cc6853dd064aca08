"""``make_app``: vehicles as an ASGI application."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from aerokit.apps.serve.api import Api
from aerokit.apps.serve.guard import Guard, Keys, content_policy
from aerokit.apps.serve.orders import Orders
from aerokit.apps.serve.requests import Problem, problem_response
from aerokit.apps.serve.stream import Stream
from aerokit.apps.serve.watch import Watch

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from types import TracebackType

    from starlette.requests import Request
    from starlette.types import Receive, Scope, Send
    from typing_extensions import Self

    from aerokit.connection.connection import Connection
    from aerokit.vehicle.vehicle import Vehicle

STATIC = Path(__file__).parent / "static"
KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


class ServeApp:
    """An ASGI application. ``async with app:`` ends what it does at the end of the block, or ``await app.aclose()``."""

    def __init__(
        self, watch: Watch, keys: Keys, token: str, settings: dict[str, Any], hosts: Collection[str]
    ) -> None:
        self.token = token
        """What orders, and reading where it is not open, have to be given."""
        self._keys = keys
        self._watch, self._orders = watch, Orders(watch)
        api = Api(watch, self._orders, keys, settings)
        stream = Stream(watch, self._orders, keys)
        operations = api.operations()
        app = Starlette(
            routes=[
                *(Route(each.path, api.endpoint(each), methods=[each.method]) for each in operations),
                WebSocketRoute("/api/stream", stream.endpoint),
                *_static_routes(),
            ],
            exception_handlers={HTTPException: _problem, Exception: _mistake},
        )
        app.router.redirect_slashes = False
        self.routes: tuple[BaseRoute, ...] = tuple(app.routes)
        """Of the page, the HTTP operations and the stream."""
        self._app = Guard(app, hosts, settings["tiles"])

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, as ASGI has it."""
        await self._app(scope, receive, send)

    def holds_token(self, headers: list[tuple[bytes, bytes]]) -> bool:
        """Whether a request with these headers, as ASGI has them, holds the token."""
        return self._keys.holds_token(Headers(raw=headers))

    async def aclose(self) -> None:
        """End it: orders that are under way are cancelled as actions of the library are, which ends in holding."""
        await self._orders.aclose()
        await self._watch.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.aclose()


def make_app(
    source: Connection | Vehicle | Mapping[int, Vehicle],
    *,
    token: str | None = None,
    read_only: bool = False,
    open_reading: bool = False,
    hosts: Collection[str] = (),
    tiles: str | None = None,
    attribution: str = "",
) -> ServeApp:
    """Serve vehicles to browsers and other programs, in the loop that is running: to be mounted, or run by uvicorn.

    Args:
        source: a connection, all of whose vehicles are served as they are heard; one vehicle; or system id → vehicle.
            What opened them closes them, after the application.
        token: 16 to 256 characters of A-Z, a-z, 0-9, - . _ ~; None: a random one, which is in ``app.token``.
        read_only: take no orders, whoever gives them.
        open_reading: let everyone read who can reach it; orders need the token all the same.
        hosts: names under which browsers may reach it, beside ``localhost`` and IP addresses.
        tiles: template of a tile server's URL, ``https://tiles.example/{z}/{x}/{y}.png``; None: no tiles are fetched.
        attribution: text that the tile server wants to be shown.

    Raises:
        InvalidArgument: an argument that cannot be right.
        ConnectionClosed, LinkLost: the connection has ended.
    """
    token = secrets.token_urlsafe(24) if token is None else token
    keys = Keys(token, open_reading=open_reading, read_only=read_only)
    content_policy(tiles)
    settings = {
        "read_only": read_only,
        "open_reading": open_reading,
        "tiles": tiles,
        "attribution": attribution,
    }
    return ServeApp(Watch(source), keys, token, settings, hosts)


def _static_routes() -> list[Route]:
    """The files of the page, read once: nothing else can be asked for."""
    routes = []
    for path in sorted(STATIC.iterdir()):
        if path.suffix in KINDS:
            where = "/" if path.name == "index.html" else f"/static/{path.name}"
            routes.append(Route(where, _file(path.read_bytes(), KINDS[path.suffix]), methods=["GET"]))
    return routes


def _file(data: bytes, kind: str) -> Any:
    async def answer(request: Request) -> Response:
        return Response(data, headers={"Cache-Control": "no-cache"}, media_type=kind)

    return answer


async def _problem(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    problem = Problem(
        error.status_code, "NotFound" if error.status_code == 404 else "HttpError", error.detail
    )
    return problem_response(problem)


async def _mistake(request: Request, error: Exception) -> Response:
    return problem_response(error)
