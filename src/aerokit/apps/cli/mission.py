"""``aerokit mission``: missions, fences and rally points of a vehicle, and the files they are kept in."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit._internal.wording import did_you_mean
from aerokit.apps.cli.arguments import writable_file
from aerokit.apps.cli.completers import offer
from aerokit.apps.cli.output import DONE, add_force, check_new, tell, tell_done
from aerokit.apps.cli.terminal import progress_bar
from aerokit.apps.cli.vehicle_command import add_action, connected

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.missions import MissionItem, Plan
    from aerokit.vehicle.vehicle import Vehicle

PARTS = ("mission", "fence", "rally")


def read_plan(path: str) -> Plan:
    """The plan in a file of either format, checked.

    Raises:
        OSError: the file cannot be read.
        FileFormatError: it is neither of the two; the text says where.
        InvalidArgument: an item cannot be sent.
    """
    from aerokit.missions import Plan, read_plan_file, read_waypoint_file

    with open(path, "rb") as file:
        is_plan = file.read(64).lstrip().startswith(b"{")
    plan = read_plan_file(path) if is_plan else Plan(read_waypoint_file(path))
    for part in PARTS:
        getattr(plan, part).check()
    return plan


def tell_part(options: argparse.Namespace, part: str, items: int, state: str, text: str) -> None:
    """One part of a plan: how many items it has, and what became of it."""
    tell(options, "plan_part", {"part": part, "items": items, "state": state}, text)


def tell_items(options: argparse.Namespace, part: str, items: Sequence[MissionItem], state: str) -> None:
    """A part of a plan, item by item."""
    tell_part(options, part, len(items), state, f"{part}: {len(items)} items")
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
        tell(options, "plan_item", record, f"{index:>5}  {item.name:32} {_place(item)}".rstrip())


async def upload_parts(vehicle: Vehicle, plan: Plan, options: argparse.Namespace) -> None:
    """Send what the file has; what it does not speak of stays as it is on the vehicle."""
    for part in PARTS:
        content = getattr(plan, part)
        count = len(content.to_items())
        if count == 0:
            continue
        with progress_bar(part, "item") as show:
            await getattr(vehicle, part).upload(content, patience_s=options.patience, on_progress=show)
        tell_part(
            options, part, count, "uploaded", f"{part}: {count} items are on vehicle {vehicle.system_id}"
        )


def _place(item: MissionItem) -> str:
    position = item.position
    if position is not None:
        return f"{position.latitude_deg:.7f} {position.longitude_deg:.7f} {item.z:g} m"
    numbers = (item.param1, item.param2, item.param3, item.param4, item.x, item.y, item.z)
    return " ".join(f"{number:g}" for number in numbers) if any(numbers) else ""


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The actions of the command, and their arguments."""
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    _add_parts(add_action(actions, "show", _show, "Show what the vehicle holds."))
    download = add_action(actions, "download", _download, "Save what the vehicle holds to a file.")
    download.add_argument(
        "file", type=writable_file, help=".plan (QGroundControl) or .waypoints, .txt (QGC WPL 110)"
    )
    add_force(download)
    upload = add_action(
        actions,
        "upload",
        _upload,
        "Send the mission, fence and rally points of a file; what it does not have stays as it is.",
    )
    upload.add_argument("file", help=".plan (QGroundControl), or a file that begins with QGC WPL 110")
    check = add_action(actions, "check", _check, "Check a file without a vehicle.", talks=False)
    check.add_argument("file")
    _add_parts(add_action(actions, "clear", _clear, "Remove what the vehicle holds."))
    for name, run, text in (
        ("start", _start, "Start the mission."),
        ("pause", _pause, "Hold, and keep the place in the mission."),
        ("resume", _resume, "Go on with the mission."),
    ):
        add_action(actions, name, run, text)


def _add_parts(action: argparse.ArgumentParser) -> None:
    parts = action.add_argument(
        "parts",
        nargs="*",
        type=_part,
        default=["mission"],
        metavar="PART",
        help=f"{', '.join(PARTS)} (mission)",
    )
    offer(parts, lambda: PARTS)


def _part(text: str) -> str:
    if text not in PARTS:
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(PARTS)}{did_you_mean(text, PARTS)}")
    return text


# ---------------------------------------------------------------------------------------- actions
async def _show(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        for part in options.parts:
            items = (await _download_part(vehicle, part, options)).to_items()
            tell_items(options, part, items, "on the vehicle")
    return DONE


async def _download(options: argparse.Namespace) -> int:
    from aerokit.missions import Plan, write_plan_file, write_waypoint_file

    check_new(options.file, options)
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
    tell(options, "saved", record, f"{len(mission)} mission items in {options.file}")
    return DONE


async def _upload(options: argparse.Namespace) -> int:
    plan = read_plan(options.file)
    async with connected(options, changes=True) as vehicle:
        await upload_parts(vehicle, plan, options)
    return DONE


async def _check(options: argparse.Namespace) -> int:
    plan = read_plan(options.file)
    for part in PARTS:
        tell_items(options, part, getattr(plan, part).to_items(), "in the file")
    return DONE


async def _clear(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        for part in options.parts:
            await getattr(vehicle, part).clear(patience_s=options.patience)
            tell_part(options, part, 0, "cleared", f"{part}: cleared")
    return DONE


async def _start(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        await vehicle.mission.start()
    tell_done(options, "mission start")
    return DONE


async def _pause(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        await vehicle.mission.pause()
    tell_done(options, "mission pause")
    return DONE


async def _resume(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        await vehicle.mission.resume()
    tell_done(options, "mission resume")
    return DONE


async def _download_part(vehicle: Vehicle, part: str, options: argparse.Namespace) -> Any:
    with progress_bar(part, "item") as show:
        return await getattr(vehicle, part).download(patience_s=options.patience, on_progress=show)
