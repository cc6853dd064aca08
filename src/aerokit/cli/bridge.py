"""``aerokit bridge foxglove``: every vehicle on a link, live in the Foxglove viewer."""

from __future__ import annotations

import argparse
import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from aerokit.cli.arguments import address, number
from aerokit.cli.completers import addresses, offer
from aerokit.cli.exits import DONE
from aerokit.cli.extras import need
from aerokit.cli.interrupt import on_interrupt
from aerokit.cli.output import add_json, tell
from aerokit.cli.signing import ENVIRONMENT, add_signing_key, signing_of
from aerokit.cli.vehicle_command import ADDRESS_VARIABLE, default_address

if TYPE_CHECKING:
    from aerokit.foxglove import FoxgloveBridge
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["add_arguments"]


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The actions of the command, and their arguments."""
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    action = actions.add_parser(
        "foxglove",
        help="serve Foxglove's WebSocket protocol",
        description="Show every vehicle on a link to the Foxglove viewer, until Ctrl-C: position on the map, 3D frames,"
        " texts, and each state as a topic. What a viewer does reaches no vehicle.",
    )
    action.set_defaults(run=_foxglove)
    place = action.add_argument(
        "address",
        nargs="?",
        type=address,
        default=default_address(),
        metavar="ADDRESS",
        help=f"where the vehicles are: udpin:0.0.0.0:14550, tcp:127.0.0.1:5760 … (${ADDRESS_VARIABLE})",
    )
    offer(place, addresses)
    action.add_argument(
        "--baud", type=int, default=57600, help="of a serial port whose address says none (57600)"
    )
    action.add_argument(
        "--host", default="127.0.0.1", metavar="IP", help="listen here; 0.0.0.0: everywhere (127.0.0.1)"
    )
    action.add_argument("--port", type=_port, default=8765, help="listen on this port; 0: a free one (8765)")
    action.add_argument(
        "--rate", type=number(0.1, 100), default=10.0, metavar="HZ", help="of each topic at most (10)"
    )
    action.add_argument(
        "--messages",
        action="append",
        default=[],
        metavar="NAME",
        help="show these MAVLink messages as they come, too: 'GPS_*' (repeatable)",
    )
    action.add_argument(
        "--listen-only",
        action="store_true",
        help="ask the vehicles for nothing; else for the rates that every aerokit program asks for",
    )
    add_signing_key(action, f"of vehicles that want signed messages (${ENVIRONMENT})")
    add_json(action)


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError(f"{text} is no port: 0 to 65535")
    return port


async def _foxglove(options: argparse.Namespace) -> int:
    need("foxglove", "foxglove")
    from aerokit.foxglove import foxglove_bridge
    from aerokit.runtime.opening import ONLOOKER, open_connection

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
    return DONE


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
