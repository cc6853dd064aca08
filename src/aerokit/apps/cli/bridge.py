"""``aerokit bridge``: every vehicle on a link, live in the Foxglove viewer, or as JSON on a network."""

from __future__ import annotations

import argparse
import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from aerokit.apps.cli.arguments import address, number
from aerokit.apps.cli.output import DONE, add_json, need, tell
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.apps.cli.vehicle_command import ENVIRONMENT, add_place, add_signing_key, signing_of
from aerokit.errors import InvalidArgument
from aerokit.transport.address import parse_address

if TYPE_CHECKING:
    from aerokit.apps.foxglove import FoxgloveBridge
    from aerokit.connection.connection import Connection
    from aerokit.vehicle.vehicle import Vehicle

WHERE = "where the vehicles are: "


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The actions of the command, and their arguments."""
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    foxglove = actions.add_parser(
        "foxglove",
        help="serve Foxglove's WebSocket protocol",
        description="Show every vehicle on a link to the Foxglove viewer, until Ctrl-C: position on the map, 3D frames,"
        " texts, and each state as a topic. What a viewer does reaches no vehicle.",
    )
    foxglove.set_defaults(run=_foxglove)
    add_place(foxglove, what=WHERE)
    foxglove.add_argument(
        "--host", default="127.0.0.1", metavar="IP", help="listen here; 0.0.0.0: everywhere (127.0.0.1)"
    )
    foxglove.add_argument(
        "--port", type=_port, default=8765, help="listen on this port; 0: a free one (8765)"
    )
    foxglove.add_argument(
        "--messages",
        action="append",
        default=[],
        metavar="NAME",
        help="show these MAVLink messages as they come, too: 'GPS_*' (repeatable)",
    )
    _add_common(foxglove, 10.0, "topic")
    for name, where, forms, module, network, shown in (
        (
            "zenoh",
            "on a zenoh network",
            "zenoh://FLEET/NAME, zenoh://FLEET/NAME?connect=tcp/10.0.0.5:7447 …",
            "zenoh",
            _network,
            str,
        ),
        (
            "mqtt",
            "at a broker of MQTT",
            "mqtt://HOST/FLEET/NAME, mqtts://USER:PASSWORD@HOST/FLEET/NAME …",
            "paho",
            _broker,
            _without_password,
        ),
    ):
        action = actions.add_parser(
            name,
            help=f"put states {where}, as JSON",
            description=f"Put each state of every vehicle on a link {where}, as JSON for programs in any"
            " language, until Ctrl-C (docs/network.md). What anybody does there reaches no vehicle.",
        )
        action.set_defaults(run=_publish, needs=(module, name), shown=shown)
        add_place(action, what=WHERE)
        action.add_argument("network", type=network, metavar="NETWORK", help=f"where the states go: {forms}")
        _add_common(action, 5.0, "state")


def _add_common(action: argparse.ArgumentParser, rate_hz: float, what: str) -> None:
    action.add_argument(
        "--rate",
        type=number(0.1, 50 if rate_hz < 10 else 100),
        default=rate_hz,
        metavar="HZ",
        help=f"so many times a second at most, each {what} ({rate_hz:g})",
    )
    action.add_argument(
        "--listen-only",
        action="store_true",
        help="ask the vehicles for nothing; else for the rates that every aerokit program asks for",
    )
    add_signing_key(action, f"of vehicles that want signed messages (${ENVIRONMENT})")
    add_json(action)


def _network(text: str) -> str:
    """Looked at before a link is opened: the two addresses are easily given the other way round."""
    if parse_address(address(text)).kind not in ("zenoh", "zenohin"):
        raise argparse.ArgumentTypeError(f"{text!r} is not on a network, as zenoh://FLEET/NAME is")
    return text


def _broker(text: str) -> str:
    """As :func:`_network`; an error does not show the password."""
    try:
        _without_password(text)
    except InvalidArgument as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _without_password(broker: str) -> str:
    from aerokit.apps.network.broker import parse_broker

    return str(parse_broker(broker, "mqtt", "mqtts"))


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError(f"{text} is no port: 0 to 65535")
    return port


async def _foxglove(options: argparse.Namespace) -> int:
    need("foxglove", "foxglove")
    from aerokit.apps.foxglove import foxglove_bridge
    from aerokit.connection.opening import ONLOOKER, open_connection

    stop = asyncio.Event()
    with on_interrupt(stop.set):
        async with (
            open_connection(
                options.address,
                source_system=ONLOOKER,
                baud=options.baud,
                signing=signing_of(options),
            ) as connection,
            foxglove_bridge(
                connection,
                host=options.host,
                port=options.port,
                rate_hz=options.rate,
                messages=options.messages,
                rates={} if options.listen_only else None,
                on_found=lambda vehicle: _tell_vehicle(options, vehicle),
            ) as bridge,
        ):
            _tell_serving(options, bridge)
            await _until_end(connection, stop)
    return DONE


async def _publish(options: argparse.Namespace) -> int:
    need(*options.needs)
    from aerokit.apps.network import Publishing
    from aerokit.apps.network.publishing import publisher_for
    from aerokit.connection.opening import ONLOOKER, open_connection
    from aerokit.vehicle.connect import vehicles_on

    stop = asyncio.Event()
    signing = signing_of(options)
    network = options.shown(options.network)
    with on_interrupt(stop.set):
        async with (
            open_connection(
                options.address, source_system=ONLOOKER, baud=options.baud, signing=signing
            ) as connection,
            publisher_for(options.network) as publisher,
            vehicles_on(
                connection,
                rates={} if options.listen_only else None,
                on_found=lambda vehicle: _tell_vehicle(options, vehicle),
            ) as vehicles,
        ):
            where = {"network": network, "address": options.address}
            text = f"listening to {options.address}\nputting states on {network}\nuntil Ctrl-C"
            tell(options, "publishing", where, text)
            published: dict[int, Publishing] = {}
            while not stop.is_set():
                connection.raise_if_ended()
                for system_id, vehicle in vehicles.items():
                    if system_id not in published:
                        published[system_id] = Publishing(vehicle, publisher)
                    published[system_id].publish(connection.now())
                with suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(stop.wait(), 1 / options.rate)
    return DONE


async def _until_end(connection: Connection, stop: asyncio.Event) -> None:
    """Until the connection ends, which is raised, or somebody stops it."""
    ended: asyncio.Future[Exception] = asyncio.get_running_loop().create_future()
    connection.on_end(ended.set_result)
    stopped = asyncio.ensure_future(stop.wait())
    waits: set[asyncio.Future[Any]] = {ended, stopped}
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        stopped.cancel()
        with suppress(asyncio.CancelledError):
            await stopped
    if ended.done():
        connection.raise_if_ended()


def _tell_serving(options: argparse.Namespace, bridge: FoxgloveBridge) -> None:
    tell(
        options,
        "bridging",
        {"url": bridge.url, "address": options.address},
        f"listening to {options.address}\nin Foxglove: Open connection > Foxglove WebSocket > {bridge.url}"
        "\nuntil Ctrl-C",
    )


def _tell_vehicle(options: argparse.Namespace, vehicle: Vehicle) -> None:
    record = {"system_id": vehicle.system_id, "firmware": vehicle.autopilot.firmware}
    tell(options, "bridged_vehicle", record, f"vehicle {vehicle.system_id}: {vehicle.autopilot.firmware}")
