"""``aerokit serve``: vehicles in the browser, and an HTTP and WebSocket API."""

from __future__ import annotations

import argparse
import ipaddress
import sys
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any

from aerokit.apps.cli.arguments import add_record, add_repeatable, count, port
from aerokit.apps.cli.connecting import SIGNING_KEY_VARIABLE, add_address, add_signing_key, signing_of
from aerokit.apps.cli.output import DONE, FAILED, add_json, emit, import_extra, new_recording
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.errors import LinkOpenError
from aerokit.parameters import load_metadata

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from aerokit.apps.serve import ServeApp
    from aerokit.connection.connection import Connection
    from aerokit.parameters import Metadata

_LOOPBACK = "127.0.0.1"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=_run)
    add_address(command, what="address of the vehicles: ")
    command.add_argument(
        "--sim", nargs="?", type=count, const=1, metavar="N", help="serve N simulated copters instead (--sim alone: 1)"
    )
    add_signing_key(command, f"signing key of the vehicles (${SIGNING_KEY_VARIABLE})")
    add_record(command)
    _add_web(command)
    add_json(command)


def _add_web(command: argparse.ArgumentParser) -> None:
    web = command.add_argument_group("web")
    web.add_argument(
        "--host",
        default=_LOOPBACK,
        help=f"address to listen on (default: {_LOOPBACK}, for this machine only); on any other address, reading"
        " needs the token, as orders always do",
    )
    web.add_argument("--port", type=port, default=8080, help="TCP port; 0: any free port (default: 8080)")
    web.add_argument("--token-file", metavar="FILE", help="file with the token (default: a random token at each start)")
    web.add_argument("--read-only", action="store_true", help="reject all orders")
    add_repeatable(web, "--allow-host", "NAME", "host name that browsers may use, besides localhost and IP addresses")
    web.add_argument(
        "--metadata",
        metavar="FILE",
        help="parameter metadata of the firmware, for units, ranges and descriptions (apm.pdef.xml or parameters.json)",
    )
    web.add_argument("--tiles", metavar="URL", help="map tiles: https://tiles.example/{z}/{x}/{y}.png (default: none)")
    web.add_argument("--attribution", default="", metavar="TEXT", help="attribution of the tiles, shown on the map")


async def _run(options: argparse.Namespace) -> int:
    uvicorn = import_extra("uvicorn", extra="serve")
    import_extra("websockets", extra="serve")
    metadata = None if options.metadata is None else load_metadata(options.metadata)
    serve = import_extra("aerokit.apps.serve", extra="serve")
    with new_recording(options.record):
        return await _serve_vehicles(uvicorn, serve, options, metadata)


async def _serve_vehicles(uvicorn: Any, serve: Any, options: argparse.Namespace, metadata: Metadata | None) -> int:
    async with _connection(options) as connection:
        if options.record is not None:
            connection.record(options.record)
        app = serve.make_app(
            connection,
            token=_token(options.token_file),
            read_only=options.read_only,
            open_reading=_is_loopback(options.host),
            hosts=[*options.allow_host, options.host],
            tiles=options.tiles,
            attribution=options.attribution,
            metadata=metadata,
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
            signing = signing_of(options)
            connection = open_connection(options.address, baud=options.baud, signing=signing, reconnect=True)
            yield await stack.enter_async_context(connection)


def _token(path: str | None) -> str | None:
    if path is None:
        return None
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        return file.read(1000).strip()  # A token has at most 256 characters.


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def config_of(uvicorn: Any, app: ServeApp, host: str, port: int) -> Any:
    guard = import_extra("aerokit.apps.serve.guard", extra="serve")
    return uvicorn.Config(
        app,
        host=host,
        port=port,
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws=guard.WebSocketConnection,
        ws_max_size=1024,
        ws_max_queue=4,
        http=guard.http_protocol(app.has_token),
        timeout_keep_alive=20,
        timeout_graceful_shutdown=2,
    )


async def _serve(uvicorn: Any, app: ServeApp, options: argparse.Namespace) -> int:
    server = _server_class(uvicorn)(config_of(uvicorn, app, options.host, options.port))
    server.on_started = lambda port: _emit_serving(options, app, port)

    def stop() -> None:
        server.should_exit = True

    with on_interrupt(stop):
        try:
            await server.serve()
        except SystemExit:  # uvicorn exits if it cannot listen
            raise LinkOpenError(
                f"cannot listen on {options.host}, port {options.port}: the port may be in use;"
                " choose another port with --port"
            ) from None
    if not server.started:
        return FAILED
    emit(options, "stopped", {}, "stopped")
    return DONE


def _server_class(uvicorn: Any) -> Any:
    """Return a subclass of uvicorn's Server. It calls ``on_started(port)``, and does not handle signals."""

    class Server(uvicorn.Server):  # type: ignore[misc]
        @contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield  # uvicorn's own method installs signal handlers, which would replace those of `aerokit serve`.

        async def startup(self, sockets: Any = None) -> None:
            await super().startup(sockets=sockets)
            if self.started:
                _, port, *_ = self.servers[0].sockets[0].getsockname()
                self.on_started(port)

    return Server


def _emit_serving(options: argparse.Namespace, app: ServeApp, port: int) -> None:
    # A browser cannot open an address that stands for all interfaces.
    host = {"0.0.0.0": _LOOPBACK, "::": "::1"}.get(str(options.host), str(options.host))
    url = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
    # Browsers do not send the part after the #, so the token never appears in a server log.
    page = url if options.read_only and _is_loopback(options.host) else f"{url}#token={app.token}"
    source = f"simulated vehicles: {options.sim}" if options.sim else options.address
    record = {"url": url, "page": page, "token": app.token, "source": source, "read_only": options.read_only}
    emit(options, "serving", record, f"{source}: open {page} in a browser; Ctrl-C stops")
    if not _is_loopback(options.host):
        print(
            "aerokit: warning: other machines can connect, and the traffic is not encrypted, including the token"
            " (docs/serve.md)",
            file=sys.stderr,
        )
