"""``aerokit serve``: vehicles in the browser, and an HTTP and WebSocket API for other programs."""

from __future__ import annotations

import argparse
import ipaddress
import sys
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any

from aerokit.apps.cli.arguments import count
from aerokit.apps.cli.output import DONE, FAILED, add_json, need, tell
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.apps.cli.vehicle_command import ENVIRONMENT, add_place, add_signing_key, signing_of
from aerokit.errors import LinkOpenError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from aerokit.apps.serve import ServeApp
    from aerokit.connection.connection import Connection

LOOPBACK = "127.0.0.1"


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=_run)
    add_place(command, what="of the vehicles: ")
    command.add_argument(
        "--sim",
        nargs="?",
        type=count,
        const=1,
        metavar="N",
        help="N simulated copters (1) instead, to look at it",
    )
    add_signing_key(command, f"of vehicles that want signed messages (${ENVIRONMENT})")
    _add_web(command)
    add_json(command)


def _add_web(command: argparse.ArgumentParser) -> None:
    web = command.add_argument_group("web")
    web.add_argument(
        "--host",
        default=LOOPBACK,
        help=f"where to listen ({LOOPBACK}: this machine only); elsewhere, reading needs the token, too",
    )
    web.add_argument("--port", type=_port, default=8080, help="TCP port, 0: any free one (8080)")
    web.add_argument("--token-file", metavar="FILE", help="with the token (a random one at each start)")
    web.add_argument("--read-only", action="store_true", help="take no orders, whoever gives them")
    web.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="by which browsers reach it, beside localhost and IP addresses; several times if need be",
    )
    web.add_argument(
        "--tiles", metavar="URL", help="tiles for the map: https://tiles.example/{z}/{x}/{y}.png (none)"
    )
    web.add_argument(
        "--attribution", default="", metavar="TEXT", help="that the tile server wants to be shown"
    )


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port: 0 to 65535")
    return int(text)


async def _run(options: argparse.Namespace) -> int:
    uvicorn = need("uvicorn", "serve")
    need("websockets", "serve")
    serve = need("aerokit.apps.serve", "serve")
    async with _connection(options) as connection:
        app = serve.make_app(
            connection,
            token=_token(options.token_file),
            read_only=options.read_only,
            open_reading=_is_loopback(options.host),
            hosts=[*options.allow_host, options.host],
            tiles=options.tiles,
            attribution=options.attribution,
        )
        async with app:
            return await _serve(uvicorn, app, options)


@asynccontextmanager
async def _connection(options: argparse.Namespace) -> AsyncIterator[Connection]:
    from aerokit.connection.opening import open_connection

    async with AsyncExitStack() as stack:
        if options.sim is not None:
            from aerokit.apps.cli.sim import simulated_fleet
            from aerokit.sim import simulated_link

            fleet = simulated_fleet("copter", options.sim, spacing_m=25.0, boot_time_s=2.0)
            link = await stack.enter_async_context(simulated_link(fleet))
            yield await stack.enter_async_context(open_connection(link))
        else:
            opening = open_connection(
                options.address, baud=options.baud, signing=signing_of(options), reconnect=True
            )
            yield await stack.enter_async_context(opening)


def _token(path: str | None) -> str | None:
    if path is None:
        return None
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        return file.read(1000).strip()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def config_of(uvicorn: Any, app: ServeApp, host: str, port: int) -> Any:
    """How uvicorn serves the application: bounded in what others may send and hold."""
    return uvicorn.Config(
        app,
        host=host,
        port=port,
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws="websockets-sansio",
        ws_max_size=1024,
        ws_max_queue=4,
        http=need("aerokit.apps.serve.guard", "serve").http_protocol(app.holds_token),
        timeout_keep_alive=20,
        timeout_graceful_shutdown=2,
    )


async def _serve(uvicorn: Any, app: ServeApp, options: argparse.Namespace) -> int:
    server = _server_class(uvicorn)(config_of(uvicorn, app, options.host, options.port))
    server.told = lambda port: _tell(options, app, port)

    def stop() -> None:
        server.should_exit = True

    with on_interrupt(stop):
        try:
            await server.serve()
        except SystemExit:  # uvicorn's way of saying that it cannot listen
            raise LinkOpenError(
                f"cannot listen on {options.host} port {options.port}: is it in use?"
            ) from None
    if not server.started:
        return FAILED
    tell(options, "stopped", {}, "stopped")
    return DONE


def _server_class(uvicorn: Any) -> Any:
    class Server(uvicorn.Server):  # type: ignore[misc]
        """Says where it listens; the signals are the command's."""

        @contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield

        async def startup(self, sockets: Any = None) -> None:
            await super().startup(sockets=sockets)
            if self.started:
                self.told(self.servers[0].sockets[0].getsockname()[1])

    return Server


def _tell(options: argparse.Namespace, app: ServeApp, port: int) -> None:
    name: str = LOOPBACK if options.host == "0.0.0.0" else "::1" if options.host == "::" else options.host
    name = f"[{name}]" if ":" in name else name
    url = f"http://{name}:{port}/"
    # behind the # it stays in the browser: no server and no log ever sees it
    page = url if options.read_only and _is_loopback(options.host) else f"{url}#token={app.token}"
    source = f"{options.sim} simulated" if options.sim else options.address
    record = {"url": url, "page": page, "token": app.token, "source": source, "read_only": options.read_only}
    tell(options, "serving", record, f"{source} on {page}")
    if not _is_loopback(options.host):
        print(
            "aerokit: others can reach this, and what goes over the network is not encrypted, the token included:"
            " see docs/serve.md",
            file=sys.stderr,
        )
