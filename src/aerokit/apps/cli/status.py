"""``aerokit status``: systems and components on a link, their state, and what is missing for flight."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.formatting import enum_name
from aerokit.apps.cli.arguments import add_number
from aerokit.apps.cli.connecting import add_link, add_seconds, await_vehicle, opened
from aerokit.apps.cli.output import DONE, FAILED, emit
from aerokit.apps.readiness import Readiness, active_failsafe, readiness, readiness_lines
from aerokit.errors import AerokitError, CommandRejected, CommandTimeout
from aerokit.events import SILENT_AFTER_S
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

_UNKNOWN = "unknown"
_NO_KEY = "; it signs its frames, and without its key (--signing-key FILE) it may ignore this computer"
_FIX_NAMES = ("no receiver", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed", "static", "PPP")
# States that are requested once if the vehicle does not stream them, with the messages that contain them.
_REQUESTED = (
    ("sensors", SysStatus),
    ("gps", GpsRawInt),
    ("batteries", BatteryStatus),
    ("position", GlobalPositionInt),
)
# How long to keep the connection open at the end.
_RESTORE_RATES_S = 0.5
# How long to wait for a requested message after the vehicle has accepted the request.
_MESSAGE_TIMEOUT_S = 0.3


def _vehicle_record(vehicle: Vehicle, checks: Readiness) -> dict[str, Any]:
    version = vehicle.version.latest
    return {
        **overview(vehicle),
        "component_id": vehicle.component_id,
        "version": None if version is None else str(version),
        "mode": vehicle.mode_name,
        "armed": vehicle.armed.latest,
        "failsafe": active_failsafe(vehicle),
        "missing": [*checks.against_arming, *checks.against_flight],
        "against_arming": list(checks.against_arming),
        **_frame_fields(vehicle.connection.heartbeats.get((vehicle.system_id, vehicle.component_id))),
    }


def _vehicle_lines(vehicle: Vehicle, checks: Readiness) -> list[str]:
    version = vehicle.version.latest
    heartbeat = vehicle.connection.heartbeats.get((vehicle.system_id, vehicle.component_id))
    frame = _frame_fields(heartbeat)
    armed = {None: "armed or not: unknown", True: "ARMED", False: "disarmed"}[vehicle.armed.latest]
    landed = vehicle.landed_state.latest
    landed_text = "" if landed is None else f", {_in_words(getattr(landed, 'name', str(landed)))}"
    type_text = "" if heartbeat is None else f", {_in_words(enum_name(MavType, heartbeat.type, str(heartbeat.type)))}"
    lacks_key = frame["signed"] and vehicle.connection.signing is None
    return [
        f"system {vehicle.system_id}: {vehicle.autopilot.firmware} {version or '(unknown version)'}{type_text}"
        f"{_NO_KEY if lacks_key else ''}",
        f"  mode     {vehicle.mode_name}, {armed}{landed_text}",
        f"  position {_position_text(vehicle)}",
        f"  GPS      {'; '.join(map(_gps_text, vehicle.gps.latest or ())) or _UNKNOWN}",
        f"  battery  {'; '.join(map(_battery_text, vehicle.batteries.latest or ())) or _UNKNOWN}",
        f"  link     {_vehicle_link_text(vehicle, frame)}",
        *_aligned("failsafe", active_failsafe(vehicle) or ()),
        *_arming_lines(vehicle, checks),
    ]


def _arming_lines(vehicle: Vehicle, checks: Readiness) -> list[str]:
    lines = readiness_lines(vehicle, checks)
    if lines and vehicle.armed.latest:  # The words of `lines` are for a disarmed vehicle.
        return _aligned("missing", [*checks.against_arming, *checks.against_flight])
    if lines:
        return _aligned("arming", [text.replace("arm() changes to", "aerokit changes to") for text in lines])
    if vehicle.armed.latest:
        return _aligned("ready", ["armed already; arming checks do not apply"])
    return _aligned("ready", ["no reason against arming is reported"])


def _component_record_and_text(heartbeat: Heartbeat, system_id: int, component_id: int) -> tuple[dict[str, Any], str]:
    kind = kind_of(heartbeat, component_id)
    record = {
        "system_id": system_id,
        "component_id": component_id,
        "kind": kind,
        "autopilot": enum_name(MavAutopilot, heartbeat.autopilot, str(heartbeat.autopilot)),
        "vehicle_type": heartbeat.type,
        **_frame_fields(heartbeat),
    }
    name = "ground station" if kind == "gcs" else kind.replace("_", " ")
    return record, f"system {system_id}, component {component_id}: {name}"


def _link_line(record: Mapping[str, Any]) -> str:
    total = record["frames"] + record["frames_lost"]
    is_recording = record["address"].startswith("replay:")
    parts = [
        f"{record['address']}{' (a recording, not a vehicle)' if is_recording else ''}:"
        f" {record['frames']} frames in {record['seconds']:.1f} s",
        f"{_percent(record['frames_lost'], total)} lost",
    ]
    if record["bad_bytes"]:
        parts.append(f"{record['bad_bytes']} of {record['bytes']} bytes are not MAVLink")
    if record["unknown_messages"]:
        parts.append(f"{record['unknown_messages']} frames of unknown messages")
    return ", ".join(parts)


def _vehicle_link_text(vehicle: Vehicle, frame: Mapping[str, Any]) -> str:
    received, lost = vehicle.connection.counts(vehicle.system_id)
    report = vehicle.link_quality.latest
    round_trip_s = None if report is None else report.round_trip_s
    parts = [
        f"MAVLink {frame['mavlink_version'] or '?'}{', signed' if frame['signed'] else ''}",
        f"last heartbeat {vehicle.heartbeat_age:.1f} s ago",
        f"{_percent(lost, received + lost)} of {received + lost} frames lost",
    ]
    if round_trip_s is not None:
        parts.append(f"round trip {round_trip_s * 1000:.0f} ms")
    return ", ".join(parts)


def _frame_fields(heartbeat: Heartbeat | None) -> dict[str, Any]:
    frame = None if heartbeat is None else heartbeat.received_frame
    return {
        "mavlink_version": None if frame is None else frame.version,
        "signed": None if frame is None else is_signed_with_a_key(frame),
    }


def _gps_text(receiver: GpsReceiver) -> str:
    has_name = 0 <= receiver.fix_type < len(_FIX_NAMES)
    parts = [_FIX_NAMES[receiver.fix_type] if has_name else f"fix {receiver.fix_type}"]
    if receiver.satellites is not None:
        parts.append(f"{receiver.satellites} satellites")
    if receiver.hdop is not None:
        parts.append(f"HDOP {receiver.hdop:.1f}")
    return ", ".join(parts)


def _position_text(vehicle: Vehicle) -> str:
    position = vehicle.position.latest
    if position is None:
        return _UNKNOWN
    height = _UNKNOWN
    if position.altitude_relative_m is not None:
        height = f"{round(position.altitude_relative_m, 1) + 0.0:.1f} m"  # + 0.0 converts -0.0 to 0.0
    age_text = f" ({vehicle.position.age:.0f} s ago)" if vehicle.position.age > SILENT_AFTER_S else ""
    return f"{position.latitude_deg:.7f}, {position.longitude_deg:.7f}, height above home {height}{age_text}"


def _battery_text(battery: Battery) -> str:
    values = (
        (battery.remaining_percent, ".0f", "%"),
        (battery.voltage_v, ".1f", "V"),
        (battery.current_a, ".1f", "A"),
    )
    known = [f"{value:{number_format}} {unit}" for value, number_format, unit in values if value is not None]
    return ", ".join(known) or _UNKNOWN


def _aligned(label: str, texts: Sequence[str]) -> list[str]:
    return [f"  {label if index == 0 else '':8} {text}" for index, text in enumerate(texts)]


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole if whole else 0:.1f} %"


def _in_words(name: str) -> str:
    return name.replace("_", " ").lower()


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=run_status)
    add_link(command)
    add_seconds(command, "listen for S seconds after the first heartbeat (default: 3)", default=3.0)
    add_number(command, "--patience", 0.1, 3600, "S", "fail if no vehicle is found within S seconds", default=30.0)


async def run_status(options: argparse.Namespace) -> int:
    from aerokit.vehicle.connect import vehicles_on

    async with opened(options) as connection, vehicles_on(connection, rates={}) as vehicles:
        started_at = connection.now()
        try:
            await await_vehicle(connection, options, options.patience)
        except AerokitError:
            _emit_components(connection, options, vehicles={})
            raise
        await anyio.sleep(options.seconds)
        vehicles_found = dict(vehicles)  # a copy, because more vehicles may be found while messages are requested
        all_checks = await asyncio.gather(*map(_request_readiness, vehicles_found.values()))
        _emit_link(connection, options, connection.now() - started_at)
        for vehicle, checks in zip(vehicles_found.values(), all_checks, strict=True):
            record = _vehicle_record(vehicle, checks)
            emit(options, "status", record, "\n".join(_vehicle_lines(vehicle, checks)))
        _emit_components(connection, options, vehicles_found)
        await anyio.sleep(_RESTORE_RATES_S)  # aerokit restores the stream rates that it has changed
    cannot_arm = any(
        checks.against_arming and checks.is_known and not vehicle.is_armed
        for vehicle, checks in zip(vehicles_found.values(), all_checks, strict=True)
    )
    return FAILED if cannot_arm else DONE


async def _request_readiness(vehicle: Vehicle) -> Readiness:
    """Return what a vehicle lacks for arming and for flight, after requesting missing states."""
    # `why_not_armable()` requests the estimator's messages itself if the vehicle is disarmed.
    needed = vehicle.telemetry.required_messages("estimator") if vehicle.is_armed else ()
    estimator_messages = [("estimator", message) for message in needed]
    for state, message in [*_REQUESTED, *estimator_messages]:
        cell = getattr(vehicle, state)
        if not cell.is_known:
            try:
                await _request(vehicle, message, cell)
            except CommandTimeout as error:
                # A vehicle that does not answer one request would not answer the others either.
                against_arming = (str(error), *vehicle.missing_for_flight())
                return Readiness(against_arming, against_flight=(), is_known=False)
    return readiness(vehicle, await vehicle.why_not_armable())


async def _request(vehicle: Vehicle, message: Any, cell: Any) -> None:
    try:
        await vehicle.command(MavCmd.REQUEST_MESSAGE, message.ID)
    except CommandRejected:
        return
    with anyio.move_on_after(_MESSAGE_TIMEOUT_S):
        await cell.wait_until(lambda _: True)


def _emit_link(connection: Connection, options: argparse.Namespace, seconds: float) -> None:
    statistics = list(connection.statistics())
    record = {
        "address": connection.link.address,
        "seconds": seconds,
        "bytes": sum(peer.bytes for peer in statistics),
        "frames": sum(peer.frames for peer in statistics),
        "frames_lost": sum(source.lost for peer in statistics for source in peer.sources.values()),
        "bad_bytes": sum(peer.bad_bytes for peer in statistics),
        "unknown_messages": sum(peer.unknown_ids for peer in statistics),
        "systems": sorted({system for system, _ in connection.heartbeats}),
    }
    emit(options, "link", record, _link_line(record))


def _emit_components(connection: Connection, options: argparse.Namespace, vehicles: dict[int, Vehicle]) -> None:
    for (system_id, component_id), heartbeat in sorted(connection.heartbeats.items()):
        if system_id in vehicles and vehicles[system_id].component_id == component_id:
            continue
        record, text = _component_record_and_text(heartbeat, system_id, component_id)
        emit(options, "component", record, text)
