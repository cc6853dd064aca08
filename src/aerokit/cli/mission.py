"""``aerokit mission``: missions, fences and rally points of a vehicle, and the files they are kept in."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit.cli.arguments import writable_file
from aerokit.cli.completers import offer
from aerokit.cli.exits import DONE
from aerokit.cli.new_file import add_force, check_new
from aerokit.cli.output import tell, tell_done
from aerokit.cli.plans import PARTS, read_plan, tell_items, tell_part, upload_parts
from aerokit.cli.progress import progress_bar
from aerokit.cli.vehicle_command import add_action, connected
from aerokit.wording import did_you_mean

if TYPE_CHECKING:
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["add_arguments"]


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
