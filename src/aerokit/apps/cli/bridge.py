"""``aerokit bridge``: shows the vehicles on a link in Foxglove, or publishes them as JSON over zenoh or MQTT."""

from __future__ import annotations

import argparse
import asyncio
from typing import TYPE_CHECKING

import anyio

from aerokit.apps.cli.arguments import add_number, add_repeatable, address, port
from aerokit.apps.cli.connecting import SIGNING_KEY_VARIABLE, add_address, add_signing_key, opened
from aerokit.apps.cli.output import add_json, can_print, emit, import_extra
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.errors import InvalidArgument
from aerokit.transport.address import parse_address

if TYPE_CHECKING:
    from aerokit.apps.foxglove import FoxgloveBridge
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.vehicle import Vehicle

_ADDRESS_HELP = "address of the vehicles: "


def add_arguments(command: argparse.ArgumentParser) -> None:
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    foxglove = actions.add_parser(
        "foxglove",
        help="serve vehicles to Foxglove",
        description="Show every vehicle on a link in Foxglove, until Ctrl-C: position on the map, 3D frames, texts, and"
        " each state as a topic. Viewers cannot send anything to a vehicle.",
    )
    foxglove.set_defaults(run=_foxglove)
    add_address(foxglove, what=_ADDRESS_HELP)
    foxglove.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="IP",
        help="address to listen on; 0.0.0.0: all interfaces (default: 127.0.0.1)",
    )
    foxglove.add_argument(
        "--port", type=port, default=8765, help="TCP port to listen on; 0: any free port (default: 8765)"
    )
    add_repeatable(foxglove, "--messages", "NAME", "show these MAVLink messages too, unconverted: 'GPS_*'")
    _add_common(foxglove, rate_of="topic", default_hz=10.0, max_hz=100.0)
    zenoh = _add_publishing(actions, "zenoh", "to a zenoh network")
    zenoh.set_defaults(required_module="zenoh", extra="zenoh", printable_network=str)
    zenoh.add_argument(
        "network",
        type=_network,
        metavar="NETWORK",
        help="where to publish: zenoh://FLEET/NAME, zenoh://FLEET/NAME?connect=tcp/10.0.0.5:7447 …",
    )
    _add_common(zenoh, rate_of="state", default_hz=5.0, max_hz=50.0)
    mqtt = _add_publishing(actions, "mqtt", "to an MQTT broker")
    mqtt.set_defaults(required_module="paho", extra="mqtt", printable_network=_without_password)
    mqtt.add_argument(
        "network",
        type=_broker,
        metavar="NETWORK",
        help="where to publish: mqtt://HOST/FLEET/NAME, mqtts://USER:PASSWORD@HOST/FLEET/NAME …",
    )
    _add_common(mqtt, rate_of="state", default_hz=5.0, max_hz=50.0)


def _add_publishing(
    actions: argparse._SubParsersAction[argparse.ArgumentParser], name: str, destination: str
) -> argparse.ArgumentParser:
    action = actions.add_parser(
        name,
        help=f"publish states {destination}",
        description=f"Publish each state of every vehicle on a link {destination}, as JSON, until Ctrl-C"
        " (docs/network.md). Subscribers cannot send anything to a vehicle.",
    )
    action.set_defaults(run=_publish)
    add_address(action, what=_ADDRESS_HELP)
    return action


def _add_common(action: argparse.ArgumentParser, *, rate_of: str, default_hz: float, max_hz: float) -> None:
    """Add the options that all bridges have. ``rate_of`` is what ``--rate`` limits: "topic" or "state"."""
    add_number(action, "--rate", 0.1, max_hz, "HZ", f"maximum rate of each {rate_of}", default=default_hz)
    action.add_argument(
        "--listen-only",
        action="store_true",
        help="do not request message rates from the vehicles; by default, request aerokit's usual rates",
    )
    add_signing_key(action, f"signing key of the vehicles (${SIGNING_KEY_VARIABLE})")
    add_json(action)


def _network(text: str) -> str:
    # Users easily swap the two addresses of this command, so they are checked before a link is opened.
    if parse_address(address(text)).kind not in ("zenoh", "zenohin"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a zenoh address; expected zenoh://FLEET/NAME")
    return text


def _broker(text: str) -> str:
    try:
        _without_password(text)  # called only for the errors that it raises, which do not show the password
    except InvalidArgument as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _without_password(broker: str) -> str:
    from aerokit.apps.network.mqtt_publisher import parse_broker

    return str(parse_broker(broker))


async def _foxglove(options: argparse.Namespace) -> None:
    import_extra("foxglove", extra="foxglove")
    from aerokit.apps.foxglove import foxglove_bridge

    stop = asyncio.Event()
    with on_interrupt(stop.set):
        async with (
            opened(options) as connection,
            foxglove_bridge(
                connection,
                host=options.host,
                port=options.port,
                rate_hz=options.rate,
                messages=options.messages,
                rates=_rates(options),
                on_found=lambda vehicle: _emit_vehicle(options, vehicle),
            ) as bridge,
        ):
            _emit_serving(options, bridge)
            await _wait_until_ended(connection, stop)


def _rates(options: argparse.Namespace) -> dict[type[Message], float] | None:
    return {} if options.listen_only else None


async def _publish(options: argparse.Namespace) -> None:
    import_extra(options.required_module, extra=options.extra)
    from aerokit.apps.network import Publishing
    from aerokit.apps.network.publishing import publisher_for
    from aerokit.vehicle.connect import vehicles_on

    stop = asyncio.Event()
    network = options.printable_network(options.network)
    with on_interrupt(stop.set):
        async with (
            opened(options) as connection,
            publisher_for(options.network) as publisher,
            vehicles_on(
                connection, rates=_rates(options), on_found=lambda vehicle: _emit_vehicle(options, vehicle)
            ) as vehicles,
        ):
            record = {"network": network, "address": options.address}
            text = f"listening to {options.address}\npublishing to {network}\nuntil Ctrl-C"
            emit(options, "publishing", record, text)
            publications: dict[int, Publishing] = {}
            while not stop.is_set():
                connection.raise_if_ended()
                for system_id, vehicle in vehicles.items():
                    if system_id not in publications:
                        publications[system_id] = Publishing(vehicle, publisher)
                    publications[system_id].publish(connection.now())
                with anyio.move_on_after(1 / options.rate):
                    await stop.wait()


async def _wait_until_ended(connection: Connection, stop: asyncio.Event) -> None:
    """Wait until ``stop`` is set or the connection ends.

    Raises the error that ended the connection.
    """
    connection.on_end(lambda _: stop.set())
    await stop.wait()
    connection.raise_if_ended()


def _emit_serving(options: argparse.Namespace, bridge: FoxgloveBridge) -> None:
    emit(
        options,
        "bridging",
        {"url": bridge.url, "address": options.address},
        f"listening to {options.address}\nin Foxglove: Open connection > Foxglove WebSocket > {bridge.url}"
        "\nuntil Ctrl-C",
    )


def _emit_vehicle(options: argparse.Namespace, vehicle: Vehicle) -> None:
    record = {"system_id": vehicle.system_id, "firmware": vehicle.autopilot.firmware}
    if can_print():  # Printing to a stopped terminal would block the event loop.
        emit(options, "bridged_vehicle", record, f"vehicle {vehicle.system_id}: {vehicle.autopilot.firmware}")
