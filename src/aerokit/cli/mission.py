"""``aerokit mission``: missions, fences and rally points of a vehicle, and the files they are kept in."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit.cli.arguments import writable_file
from aerokit.cli.progress import progress_bar
from aerokit.cli.vehicle_command import add_action, connected

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.missions import MissionItem, Plan
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["add_mission"]

DONE = 0
PARTS = ("mission", "fence", "rally")


def add_mission(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    text = "Upload, download, show, check and clear missions, fences and rally points."
    mission = commands.add_parser("mission", help="missions of a vehicle", description=text)
    actions = mission.add_subparsers(required=True, metavar="ACTION", title="actions")
    _add_parts(add_action(actions, "show", _show, "Show what the vehicle holds."))
    download = add_action(actions, "download", _download, "Save what the vehicle holds to a file.")
    download.add_argument(
        "file", type=writable_file, help=".plan (QGroundControl) or .waypoints, .txt (QGC WPL 110)"
    )
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
    action.add_argument(
        "parts",
        nargs="*",
        type=_part,
        default=["mission"],
        metavar="PART",
        help=f"{', '.join(PARTS)} (mission)",
    )


def _part(text: str) -> str:
    if text not in PARTS:
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(PARTS)}")
    return text


# ---------------------------------------------------------------------------------------- actions


async def _show(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        for part in options.parts:
            _print_items(part, (await _download_part(vehicle, part, options)).to_items())
    return DONE


async def _download(options: argparse.Namespace) -> int:
    from aerokit.missions import Plan, write_plan_file, write_waypoint_file

    async with connected(options) as vehicle:
        mission = await _download_part(vehicle, "mission", options)
        if Path(options.file).suffix == ".plan":
            fence = await _download_part(vehicle, "fence", options)
            rally = await _download_part(vehicle, "rally", options)
            plan = Plan(mission, fence, rally, vehicle_type=vehicle.vehicle_type)
            write_plan_file(options.file, plan)
        else:
            write_waypoint_file(options.file, mission)
    print(f"{len(mission)} mission items in {options.file}")
    return DONE


async def _upload(options: argparse.Namespace) -> int:
    plan = _read(options.file)
    async with connected(options) as vehicle:
        for part in PARTS:
            content = getattr(plan, part)
            count = len(content.to_items())
            if count == 0:
                continue  # what the file does not speak of stays as it is
            with progress_bar(part, "item") as show:
                await getattr(vehicle, part).upload(content, patience_s=options.patience, on_progress=show)
            print(f"{part}: {count} items are on the vehicle")
    return DONE


async def _check(options: argparse.Namespace) -> int:
    plan = _read(options.file)
    for part in PARTS:
        _print_items(part, getattr(plan, part).to_items())
    return DONE


async def _clear(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        for part in options.parts:
            await getattr(vehicle, part).clear(patience_s=options.patience)
            print(f"{part}: cleared")
    return DONE


async def _start(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        await vehicle.mission.start()
    return DONE


async def _pause(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        await vehicle.mission.pause()
    return DONE


async def _resume(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        await vehicle.mission.resume()
    return DONE


# ----------------------------------------------------------------------------------------- inside


async def _download_part(vehicle: Vehicle, part: str, options: argparse.Namespace) -> Any:
    with progress_bar(part, "item") as show:
        return await getattr(vehicle, part).download(patience_s=options.patience, on_progress=show)


def _read(path: str) -> Plan:
    """The plan in a file of either format, checked."""
    from aerokit.missions import Plan, read_plan_file, read_waypoint_file

    with open(path, "rb") as file:
        is_plan = file.read(64).lstrip().startswith(b"{")
    plan = read_plan_file(path) if is_plan else Plan(read_waypoint_file(path))
    for part in PARTS:
        getattr(plan, part).check()
    return plan


def _print_items(part: str, items: Sequence[MissionItem]) -> None:
    print(f"{part}: {len(items)} items")
    for index, item in enumerate(items):
        print(f"{index:>5}  {item.name:32} {_place(item)}".rstrip())


def _place(item: MissionItem) -> str:
    position = item.position
    if position is not None:
        return f"{position.latitude_deg:.7f} {position.longitude_deg:.7f} {item.z:g} m"
    numbers = (item.param1, item.param2, item.param3, item.param4, item.x, item.y, item.z)
    return " ".join(f"{number:g}" for number in numbers) if any(numbers) else ""
