"""``aerokit mission``: missions, fences and rally points of a vehicle, and plan files."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit._internal.files import read_text
from aerokit.apps.cli.arguments import add_number, writable_file
from aerokit.apps.cli.completion import set_completions
from aerokit.apps.cli.connecting import add_action, command_action, connected
from aerokit.apps.cli.output import add_force, check_not_existing, emit, suggestion
from aerokit.apps.cli.terminal import progress_bar
from aerokit.apps.plan_text import parse_plan_text
from aerokit.errors import InvalidArgument, OperationRejected
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavFrame, MavType
from aerokit.vehicle.commanding.progress import MAX_DISTANCE_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.missions import MissionItem, Plan
    from aerokit.vehicle.vehicle import Vehicle

PARTS = ("mission", "fence", "rally")
_TAKE_OFFS = (MavCmd.NAV_TAKEOFF, MavCmd.NAV_TAKEOFF_LOCAL, MavCmd.NAV_VTOL_TAKEOFF)
_LANDINGS = (MavCmd.NAV_LAND, MavCmd.NAV_VTOL_LAND)


def read_plan(path: str) -> Plan:
    """Read and check a .plan or QGC WPL 110 file.

    Raises OSError if the file cannot be read, FileFormatError if it has neither format, and InvalidArgument if an item
    cannot be sent to a vehicle.
    """
    return parse_plan_text(read_text(path), Path(path).name)


def begins_with_take_off(items: Sequence[MissionItem]) -> bool:
    for item in items:
        # As in AP_Mission, a delay may precede the take-off.
        if item.command < MavCmd.NAV_LAST and item.command != MavCmd.NAV_DELAY:
            return item.command in _TAKE_OFFS
    return False


def plan_warnings(plan: Plan) -> list[str]:
    from aerokit.autopilots.ardupilot import COPTERS

    standard_commands = frozenset(MavCmd)
    warnings = []
    for part in PARTS:
        for index, item in enumerate(getattr(plan, part).to_items()):
            if item.command not in standard_commands:
                warnings.append(
                    f"{part} item {index}: command {item.command} is not a MAV_CMD; a vehicle that does not know the"
                    " command refuses the item"
                )
    mission = plan.mission.items
    warnings += _altitude_warnings(plan)
    may_be_arducopter = plan.vehicle_type in COPTERS and plan.firmware_type != MavAutopilot.PX4
    if mission and may_be_arducopter and not begins_with_take_off(mission):
        warnings.append("the mission does not begin with a take-off: an ArduCopter on the ground refuses to start it")
    return warnings


def _altitude_warnings(plan: Plan) -> list[str]:
    from aerokit.missions.item import canonical_frame

    if plan.vehicle_type == MavType.SUBMARINE:
        return []
    warnings = []
    for index, item in enumerate(plan.mission.items):
        is_take_off = item.command in _TAKE_OFFS
        is_relative_to_home = canonical_frame(item.frame) == MavFrame.GLOBAL_RELATIVE_ALT
        # A take-off has an altitude even without a position. In other commands without a position, z is no altitude.
        has_altitude = is_relative_to_home and (is_take_off or item.position is not None)
        is_too_low = item.z < 0.0 or (is_take_off and item.z == 0.0)
        # Altitudes below home are usual only for submarines and for landings.
        if has_altitude and is_too_low and item.command not in _LANDINGS:
            warnings.append(f"mission item {index}: {item.name} at {item.z:g} m above home")
    return warnings


def emit_part(options: argparse.Namespace, part: str, items: int, state: str, text: str) -> None:
    emit(options, "plan_part", {"part": part, "items": items, "state": state}, text)


def emit_items(options: argparse.Namespace, part: str, items: Sequence[MissionItem], state: str) -> None:
    emit_part(options, part, len(items), state, f"{part}: {len(items)} items")
    for index, item in enumerate(items):
        position = item.position
        record = {
            "part": part,
            "index": index,
            "name": item.name,
            "latitude_deg": None if position is None else position.latitude_deg,
            "longitude_deg": None if position is None else position.longitude_deg,
            **item.to_dict(),
        }
        emit(options, "plan_item", record, f"{index:>5}  {item.name:32} {_place_text(item)}".rstrip())


async def upload_parts(vehicle: Vehicle, plan: Plan, options: argparse.Namespace) -> None:
    """Upload the parts that the plan contains. Other parts on the vehicle stay unchanged.

    Raises InvalidArgument if a position is farther than ``--max-distance-m`` from the vehicle. The text names the
    item.
    """
    for part in PARTS:
        content = getattr(plan, part)
        count = len(content.to_items())
        if count == 0:
            continue
        with progress_bar(part, unit=None) as on_progress:  # MAVFTP reports progress in bytes instead of items.
            try:
                await getattr(vehicle, part).upload(
                    content,
                    idle_timeout_s=options.patience,
                    max_distance_m=options.max_distance_m,
                    on_progress=on_progress,
                )
            except InvalidArgument as error:
                # Name the option of the command line instead of the argument of `upload`.
                text = str(error).replace("a greater max_distance_m", "a greater --max-distance-m")
                raise InvalidArgument(text.replace("plan, item", f"{part} item")) from None
        text = f"{part}: {count} items uploaded to vehicle {vehicle.system_id}"
        emit_part(options, part, count, state="uploaded", text=text)


def _place_text(item: MissionItem) -> str:
    position = item.position
    if position is not None:
        return f"{position.latitude_deg:.7f} {position.longitude_deg:.7f} {item.z:g} m"
    parameters = (item.param1, item.param2, item.param3, item.param4, item.x, item.y, item.z)
    if not any(parameters):
        return ""
    # In MAVLink, NaN means "not set".
    return " ".join("–" if math.isnan(parameter) else f"{parameter:g}" for parameter in parameters)


def add_arguments(command: argparse.ArgumentParser) -> None:
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    _add_parts(add_action(actions, "show", _show, "Show the vehicle's mission, fence or rally points."))
    download = add_action(actions, "download", _download, "Save the vehicle's plan to a file.")
    download.add_argument(
        "file", type=writable_file, help=".plan (QGroundControl), or .waypoints or .txt (QGC WPL 110, the mission only)"
    )
    add_force(download)
    upload = add_action(
        actions,
        "upload",
        _upload,
        "Upload the mission, fence and rally points in a file. Parts that are not in the file stay unchanged.",
    )
    upload.add_argument("file", help=".plan (QGroundControl), or a file that begins with QGC WPL 110")
    add_max_distance(upload)
    check = add_action(actions, "check", _check, "Check a file without a vehicle.", connects=False)
    check.add_argument("file")
    _add_parts(add_action(actions, "clear", _clear, "Clear the vehicle's mission, fence or rally points."))
    start = command_action("mission start", "mission started", _start_mission)
    pause = command_action("mission pause", "mission paused", lambda vehicle, _: vehicle.mission.pause())
    resume = command_action("mission resume", "mission resumed", lambda vehicle, _: vehicle.mission.resume())
    add_action(actions, "start", start, "Start the mission of an armed vehicle. `aerokit fly` also arms.")
    add_action(actions, "pause", pause, "Pause the mission and hold.")
    add_action(actions, "resume", resume, "Resume the mission.")


def add_max_distance(command: argparse.ArgumentParser) -> None:
    text = "refuse a plan with a position farther than this from the vehicle"
    add_number(command, "--max-distance-m", 1, 1e8, "M", text, default=MAX_DISTANCE_M)


async def _start_mission(vehicle: Vehicle, _: argparse.Namespace) -> None:
    if not vehicle.is_armed:
        raise OperationRejected(
            "mission start: the vehicle is not armed; nothing was sent. `aerokit fly FILE` uploads a mission, arms the"
            " vehicle and starts it"
        )
    await vehicle.mission.start()


def _add_parts(action: argparse.ArgumentParser) -> None:
    parts = action.add_argument(
        "parts",
        nargs="*",
        type=_part,
        default=["mission"],
        metavar="PART",
        help=f"{', '.join(PARTS)} (default: mission)",
    )
    set_completions(parts, lambda: PARTS)


def _part(text: str) -> str:
    if text not in PARTS:
        hint = suggestion(text, PARTS)
        raise argparse.ArgumentTypeError(f"{text!r} is not one of {', '.join(PARTS)}{hint}")
    return text


async def _show(options: argparse.Namespace) -> None:
    async with connected(options) as vehicle:
        for part in options.parts:
            items = (await _download_part(vehicle, part, options)).to_items()
            emit_items(options, part, items, state="on the vehicle")


async def _download(options: argparse.Namespace) -> None:
    from aerokit.missions import Plan, write_plan_file, write_waypoint_file

    check_not_existing(options.file, options)
    async with connected(options) as vehicle:
        mission = await _download_part(vehicle, "mission", options)
        if Path(options.file).suffix == ".plan":
            fence = await _download_part(vehicle, "fence", options)
            rally = await _download_part(vehicle, "rally", options)
            plan = Plan(mission, fence, rally, vehicle_type=vehicle.vehicle_type)
            write_plan_file(options.file, plan)
        else:
            write_waypoint_file(options.file, mission)
    record = {"file": options.file, "what": "mission items", "count": len(mission)}
    emit(options, "saved", record, f"{len(mission)} mission items written to {options.file}")


async def _upload(options: argparse.Namespace) -> None:
    plan = read_plan(options.file)
    if not any(getattr(plan, part).to_items() for part in PARTS):
        raise InvalidArgument(f"{options.file} has no items; nothing was uploaded")
    _emit_warnings(plan, options)
    async with connected(options, changes_vehicle=True) as vehicle:
        await upload_parts(vehicle, plan, options)


async def _check(options: argparse.Namespace) -> None:
    plan = read_plan(options.file)
    has_items = False
    for part in PARTS:
        items = getattr(plan, part).to_items()
        has_items = has_items or bool(items)
        if items or options.json:  # "fence: 0 items" would look as if the upload cleared the fence
            emit_items(options, part, items, state="in the file")
    if not has_items and not options.json:
        print(f"{options.file} has no items")
    warnings = _emit_warnings(plan, options)
    for note in _notes(plan):
        emit(options, "note", {"text": note}, f"note: {note}")
    if not options.json:
        warning_count = f", but {len(warnings)} warning{'' if len(warnings) == 1 else 's'}" if warnings else ""
        print(f"{options.file} has no errors{warning_count}")


def _emit_warnings(plan: Plan, options: argparse.Namespace) -> list[str]:
    warnings = plan_warnings(plan)
    for warning in warnings:
        emit(options, "warning", {"text": warning}, f"warning: {warning}")
    return warnings


def _notes(plan: Plan) -> list[str]:
    """Return a note if only ArduPilot accepts the mission, unless the plan is marked as a plan for ArduPilot."""
    if plan.firmware_type == MavAutopilot.ARDUPILOTMEGA:
        return []
    try:
        plan.mission.check(home_is_item_0=False)
    except InvalidArgument as error:
        return [f"for vehicles other than ArduPilot: {error}"]
    return []


async def _clear(options: argparse.Namespace) -> None:
    async with connected(options, changes_vehicle=True) as vehicle:
        for part in options.parts:
            await getattr(vehicle, part).clear(idle_timeout_s=options.patience)
            emit_part(options, part, items=0, state="cleared", text=f"{part}: cleared")


async def _download_part(vehicle: Vehicle, part: str, options: argparse.Namespace) -> Any:
    with progress_bar(part, unit=None) as on_progress:
        return await getattr(vehicle, part).download(idle_timeout_s=options.patience, on_progress=on_progress)
