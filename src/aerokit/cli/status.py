"""``aerokit status``: everything on a link: systems, components, what they are and do, and what is missing."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.cli.arguments import number
from aerokit.cli.exits import DONE
from aerokit.cli.link_command import add_link, add_seconds, await_vehicle, opened
from aerokit.cli.output import tell
from aerokit.cli.status_lines import about_vehicle, component_line, link_line, vehicle_lines
from aerokit.errors import AerokitError, CommandRejected, CommandTimeout
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import BatteryStatus, GlobalPositionInt, GpsRawInt, SysStatus

if TYPE_CHECKING:
    import argparse

    from aerokit.runtime.connection import Connection
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["add_arguments", "run_status"]

ASKED_FOR = (
    ("sensors", SysStatus),
    ("gps", GpsRawInt),
    ("batteries", BatteryStatus),
    ("position", GlobalPositionInt),
)
"""What is asked for, once, if it has not come by itself: state and the message that tells it."""
RELEASE_S = 0.5
"""The streams that were wanted for a moment are given up before we leave: the vehicle would go on with them."""
ANSWER_S = 0.3
"""How long a message is waited for that the vehicle has accepted to send."""


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_status)
    add_link(command)
    add_seconds(command, "listen for so long after the first vehicle was heard (3)", 3.0)
    command.add_argument(
        "--patience",
        type=number(0.1, 3600),
        default=30.0,
        metavar="S",
        help="give up when no vehicle is heard for so many seconds (30)",
    )


async def run_status(options: argparse.Namespace) -> int:
    """Listen, ask each vehicle for what it has not told, and tell."""
    from aerokit.vehicle.vehicles import vehicles_on

    async with opened(options) as connection, vehicles_on(connection, rates={}) as vehicles:
        try:
            await await_vehicle(connection, options, options.patience)
        except AerokitError:
            _tell_others(connection, options, {})
            raise
        started = connection.now()
        await anyio.sleep(options.seconds)
        found = dict(vehicles)
        reasons = await asyncio.gather(*map(_what_is_missing, found.values()))
        _tell_link(connection, options, connection.now() - started)
        for vehicle, missing in zip(found.values(), reasons, strict=True):
            record = about_vehicle(vehicle, missing)
            tell(options, "status", record, "\n".join(vehicle_lines(vehicle, missing)))
        _tell_others(connection, options, found)
        await anyio.sleep(RELEASE_S)
    return DONE


async def _what_is_missing(vehicle: Vehicle) -> list[str]:
    """What it lacks to fly, after it was asked for what it does not send by itself."""
    for state, message in ASKED_FOR:
        cell = getattr(vehicle, state)
        if not cell.is_known:
            try:
                await _ask(vehicle, message, cell)
            except CommandTimeout as error:
                return [str(error), *vehicle.missing_for_flight()]  # it answers nothing: to ask on takes long
    return list(dict.fromkeys([*await vehicle.why_not_armable(), *vehicle.missing_for_flight()]))


async def _ask(vehicle: Vehicle, message: Any, cell: Any) -> None:
    try:
        await vehicle.command(MavCmd.REQUEST_MESSAGE, message.ID)
    except CommandRejected:
        return
    with anyio.move_on_after(ANSWER_S):
        await cell.wait_until(lambda _: True)


def _tell_link(connection: Connection, options: argparse.Namespace, seconds: float) -> None:
    statistics = list(connection.statistics())
    record = {
        "address": connection.link.address,
        "seconds": seconds,
        "bytes": sum(each.bytes for each in statistics),
        "frames": sum(each.frames for each in statistics),
        "frames_lost": sum(source.lost for each in statistics for source in each.sources.values()),
        "bad_bytes": sum(each.bad_bytes for each in statistics),
        "unknown_messages": sum(each.unknown_ids for each in statistics),
        "systems": sorted({system for system, _ in connection.heard}),
    }
    tell(options, "link", record, link_line(record))


def _tell_others(connection: Connection, options: argparse.Namespace, vehicles: dict[int, Vehicle]) -> None:
    """What is no autopilot that was told of already: components of vehicles, ground stations."""
    for source, heartbeat in sorted(connection.heard.items()):
        system_id, component_id = source
        if system_id in vehicles and vehicles[system_id].component_id == component_id:
            continue
        record, text = component_line(heartbeat, system_id, component_id)
        tell(options, "component", record, text)
