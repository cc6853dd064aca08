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

from aerokit.apps.serve.api import HttpApi
from aerokit.apps.serve.guard import AccessControl, SecurityMiddleware, content_policy
from aerokit.apps.serve.orders import OrderRunner
from aerokit.apps.serve.requests import HttpProblem, problem_response
from aerokit.apps.serve.served_vehicles import ServedVehicles
from aerokit.apps.serve.stream import StateStream

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from starlette.requests import Request
    from starlette.types import Receive, Scope, Send
    from typing_extensions import Self

    from aerokit.connection.connection import Connection
    from aerokit.parameters import Metadata
    from aerokit.vehicle.vehicle import Vehicle

STATIC = Path(__file__).parent / "static"
MEDIA_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


class ServeApp:
    """The ASGI application. Use it in ``async with app:``, or call ``await app.aclose()`` at the end."""

    def __init__(
        self,
        served: ServedVehicles,
        access: AccessControl,
        token: str,
        settings: dict[str, Any],
        hosts: Collection[str],
        metadata: Metadata | None = None,
    ) -> None:
        self.token = token
        """Token that orders require. Reading also requires it, unless ``open_reading`` is set."""
        self._access = access
        self._served = served
        self._orders = OrderRunner(served)
        api = HttpApi(served, self._orders, access, settings, metadata)
        stream = StateStream(served, self._orders, access)
        operations = api.operations()
        app = Starlette(
            routes=[
                *(
                    Route(operation.path, api.endpoint(operation), methods=[operation.method])
                    for operation in operations
                ),
                WebSocketRoute("/api/stream", stream.endpoint),
                *_static_routes(),
            ],
            exception_handlers={HTTPException: _http_problem, Exception: _server_error},
        )
        app.router.redirect_slashes = False
        self.routes: tuple[BaseRoute, ...] = tuple(app.routes)
        """Routes of the page, the HTTP operations and the stream."""
        self._app = SecurityMiddleware(app, hosts, settings["tiles"])

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        await self._app(scope, receive, send)

    def has_token(self, headers: list[tuple[bytes, bytes]]) -> bool:
        """Return True if ASGI headers contain the token."""
        return self._access.has_token(Headers(raw=headers))

    async def aclose(self) -> None:
        """Close the application. Running orders are cancelled, so that their vehicles hold."""
        await self._orders.aclose()
        await self._served.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exception: object) -> None:
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
    metadata: Metadata | None = None,
) -> ServeApp:
    """Make an ASGI application that serves vehicles, to be mounted or run with uvicorn in the running loop.

    Args:
        source: a connection (its vehicles are served when they appear), one vehicle, or a mapping of system ids to
            vehicles. The application does not close them; close them after the application has ended.
        token: 16 to 256 characters of A-Z, a-z, 0-9, - . _ ~. None creates a random token, which is in ``app.token``.
        read_only: reject all orders.
        open_reading: allow reading without the token; orders always need it.
        hosts: host names that browsers may use, besides ``localhost`` and IP addresses.
        tiles: URL template of a tile server, such as ``https://tiles.example/{z}/{x}/{y}.png``; None for no tiles.
        attribution: attribution of the tiles, shown on the map.
        metadata: units, ranges and descriptions of parameters (:func:`aerokit.parameters.load_metadata`), for vehicles
            that do not provide any.

    Raises:
        InvalidArgument: an argument is invalid.
        ConnectionClosed, LinkLost: the connection has ended.
    """
    token = secrets.token_urlsafe(24) if token is None else token
    access = AccessControl(token, open_reading=open_reading, read_only=read_only)
    content_policy(tiles)  # raises if the URL is invalid
    settings = {"read_only": read_only, "open_reading": open_reading, "tiles": tiles, "attribution": attribution}
    return ServeApp(ServedVehicles(source), access, token, settings, hosts, metadata)


def _static_routes() -> list[Route]:
    # Files are read only here, at the start, so that no request can reach other files.
    routes = []
    for path in sorted(STATIC.rglob("*.*")):
        if path.suffix in MEDIA_TYPES:
            url_path = "/" if path.name == "index.html" else f"/static/{path.relative_to(STATIC).as_posix()}"
            routes.append(Route(url_path, _file(path.read_bytes(), MEDIA_TYPES[path.suffix]), methods=["GET"]))
    return routes


def _file(data: bytes, media_type: str) -> Any:
    async def answer(request: Request) -> Response:
        return Response(data, headers={"Cache-Control": "no-cache"}, media_type=media_type)

    return answer


async def _http_problem(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    problem = HttpProblem(error.status_code, "NotFound" if error.status_code == 404 else "HttpError", error.detail)
    return problem_response(problem)


async def _server_error(request: Request, error: Exception) -> Response:
    return problem_response(error)
