"""``aerokit status``: everything on a link: systems, components, what they are and do, and what is missing."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.apps.cli.arguments import number
from aerokit.apps.cli.link_command import add_link, add_seconds, await_vehicle, opened
from aerokit.apps.cli.output import DONE, tell
from aerokit.errors import AerokitError, CommandRejected, CommandTimeout
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavType
from aerokit.mavlink.messages import BatteryStatus, GlobalPositionInt, GpsRawInt, SysStatus
from aerokit.mavlink.signing import is_signed_with_a_key
from aerokit.vehicle.components.component import kind_of
from aerokit.vehicle.vehicle import overview

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping, Sequence

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.messages import Heartbeat
    from aerokit.vehicle.state.equipment import Battery, GpsReceiver
    from aerokit.vehicle.vehicle import Vehicle

UNKNOWN = "not told"

NO_KEY = "; its frames are signed and no key was given (--signing-key FILE): it may not listen to us"

FIXES = ("no receiver", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed", "static", "PPP")


def about_vehicle(vehicle: Vehicle, missing: Sequence[str]) -> dict[str, Any]:
    """The record of one vehicle."""
    version = vehicle.version.latest
    return {
        **overview(vehicle),
        "component_id": vehicle.component_id,
        "version": None if version is None else str(version),
        "mode": vehicle.mode_name,
        "armed": vehicle.armed.latest,
        "missing": list(missing),
        **_frame_of(vehicle.connection.heard.get((vehicle.system_id, vehicle.component_id))),
    }


def vehicle_lines(vehicle: Vehicle, missing: Sequence[str]) -> list[str]:
    """The same for people."""
    version = vehicle.version.latest
    heartbeat = vehicle.connection.heard.get((vehicle.system_id, vehicle.component_id))
    frame = _frame_of(heartbeat)
    armed = {None: "armed or not: unknown", True: "ARMED", False: "disarmed"}[vehicle.armed.latest]
    landed = vehicle.landed_state.latest
    place = "" if landed is None else f", {_words(getattr(landed, 'name', str(landed)))}"
    kind = "" if heartbeat is None else f", {_words(_name(MavType, heartbeat.type))}"
    is_locked = frame["signed"] and vehicle.connection.signing is None
    return [
        f"system {vehicle.system_id}: {vehicle.autopilot.firmware} {version or 'of unknown version'}{kind}"
        f"{NO_KEY if is_locked else ''}",
        f"  mode     {vehicle.mode_name}, {armed}{place}",
        f"  GPS      {'; '.join(map(_gps, vehicle.gps.latest or ())) or UNKNOWN}",
        f"  battery  {'; '.join(map(_battery, vehicle.batteries.latest or ())) or UNKNOWN}",
        f"  link     {_link(vehicle, frame)}",
        *_aligned("missing", missing or ["nothing that is known"]),
    ]


def component_line(heartbeat: Heartbeat, system_id: int, component_id: int) -> tuple[dict[str, Any], str]:
    """Record and line of another component."""
    kind = kind_of(heartbeat, component_id)
    record = {
        "system_id": system_id,
        "component_id": component_id,
        "kind": kind,
        "autopilot": _name(MavAutopilot, heartbeat.autopilot),
        "vehicle_type": heartbeat.type,
        **_frame_of(heartbeat),
    }
    name = "ground station" if kind == "gcs" else kind.replace("_", " ")
    return record, f"system {system_id}, component {component_id}: {name}"


def link_line(record: Mapping[str, Any]) -> str:
    """The link as a whole."""
    total = record["frames"] + record["frames_lost"]
    parts = [
        f"{record['address']}: {record['frames']} frames in {record['seconds']:.1f} s",
        f"{_percent(record['frames_lost'], total)} lost",
    ]
    if record["bad_bytes"]:
        parts.append(f"{record['bad_bytes']} of {record['bytes']} bytes are no frame")
    if record["unknown_messages"]:
        parts.append(f"{record['unknown_messages']} frames of unknown messages")
    return ", ".join(parts)


def _link(vehicle: Vehicle, frame: Mapping[str, Any]) -> str:
    received, lost = vehicle.connection.counts(vehicle.system_id)
    report = vehicle.link_quality.latest
    trip = None if report is None else report.round_trip_s
    parts = [
        f"MAVLink {frame['mavlink_version'] or '?'}{', signed' if frame['signed'] else ''}",
        f"last heartbeat {vehicle.heartbeat_age:.1f} s ago",
        f"{_percent(lost, received + lost)} of {received + lost} frames lost",
    ]
    return ", ".join(parts if trip is None else [*parts, f"{trip * 1000:.0f} ms there and back"])


def _frame_of(heartbeat: Heartbeat | None) -> dict[str, Any]:
    frame = None if heartbeat is None else heartbeat.received_frame
    return {
        "mavlink_version": None if frame is None else frame.version,
        "signed": None if frame is None else is_signed_with_a_key(frame),
    }


def _gps(receiver: GpsReceiver) -> str:
    known = 0 <= receiver.fix_type < len(FIXES)
    parts = [FIXES[receiver.fix_type] if known else f"fix {receiver.fix_type}"]
    if receiver.satellites is not None:
        parts.append(f"{receiver.satellites} satellites")
    if receiver.hdop is not None:
        parts.append(f"HDOP {receiver.hdop:.1f}")
    return ", ".join(parts)


def _battery(battery: Battery) -> str:
    values = (
        (battery.remaining_percent, ".0f", "%"),
        (battery.voltage_v, ".1f", "V"),
        (battery.current_a, ".1f", "A"),
    )
    return ", ".join(f"{value:{form}} {unit}" for value, form, unit in values if value is not None) or UNKNOWN


def _aligned(label: str, texts: Sequence[str]) -> list[str]:
    return [f"  {label if place == 0 else '':8} {text}" for place, text in enumerate(texts)]


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole if whole else 0:.1f} %"


def _words(name: str) -> str:
    return name.replace("_", " ").lower()


def _name(enum: type[MavType | MavAutopilot], number: int) -> str:
    try:
        return enum(number).name
    except ValueError:
        return str(number)


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
    from aerokit.vehicle.connect import vehicles_on

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
