"""``aerokit gimbal``: where the gimbals on board point."""

from __future__ import annotations

import argparse
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit.apps.cli.arguments import number
from aerokit.apps.cli.output import DONE, tell, tell_done
from aerokit.apps.cli.vehicle_command import add_action, connected
from aerokit.errors import AerokitError
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aerokit.vehicle.gimbal.device import GimbalInformation
    from aerokit.vehicle.gimbal.gimbal import Gimbal

TOLD_WITHIN_S = 2.0


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The actions of the command, and their arguments."""
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    info = add_action(actions, "info", _info, "Say what the gimbal is, its limits, and where it points.")
    point = add_action(actions, "point", _point, "Point it and keep it there.")
    point.add_argument(
        "pitch",
        type=number(-360, 360),
        metavar="PITCH",
        help="degrees from the horizon: -90 is straight down",
    )
    point.add_argument(
        "yaw", type=number(-360, 360), nargs="?", default=0.0, metavar="YAW", help="degrees to the right (0)"
    )
    point.add_argument(
        "--frame",
        choices=("earth", "vehicle"),
        default="vehicle",
        help="yaw from north, or from the nose (vehicle)",
    )
    look = add_action(actions, "look", _look, "Have it look at a place.")
    look.add_argument("latitude", type=number(-90, 90), metavar="LATITUDE", help="degrees")
    look.add_argument("longitude", type=number(-180, 180), metavar="LONGITUDE", help="degrees")
    look.add_argument("altitude", type=number(-500, 10_000), metavar="ALTITUDE", help="metres above home")
    neutral = add_action(actions, "neutral", _neutral, "Turn it to its neutral position.")
    release = add_action(actions, "release", _release, "Give it back to the pilot.")
    for action in (info, point, look, neutral, release):
        action.add_argument(
            "--gimbal",
            type=int,
            metavar="ID",
            help="component id, or 1 to 6 behind the autopilot (the first)",
        )


@asynccontextmanager
async def _gimbal(options: argparse.Namespace, *, changes: bool = True) -> AsyncIterator[Gimbal]:
    async with connected(options, changes=changes) as vehicle:
        await vehicle.gimbals.discover()  # until one is heard, orders are the autopilot's
        yield vehicle.gimbal if options.gimbal is None else vehicle.gimbals.get(options.gimbal)


async def _info(options: argparse.Namespace) -> int:
    async with _gimbal(options, changes=False) as gimbal:
        try:
            about = await gimbal.information()
        except AerokitError as error:
            tell(options, "gimbal_silent", {"reason": str(error)}, f"it does not say what it is: {error}")
        else:
            tell(options, "gimbal", about.to_dict(), "\n".join(_lines(about)))
        with anyio.move_on_after(TOLD_WITHIN_S):
            told = await gimbal.attitude.wait_until(lambda _: True)
            angles = {"pitch": told.pitch_deg, "roll": told.roll_deg, "yaw": told.yaw_deg}
            shown = ", ".join(f"{name} {angle:.0f}" for name, angle in angles.items() if angle is not None)
            record = {f"{name}_deg": angle for name, angle in angles.items()}
            tell(options, "gimbal_attitude", record, f"points {shown}")
    return DONE


def _lines(about: GimbalInformation) -> list[str]:
    name = f"{about.vendor} {about.model}".strip() or "a gimbal without a name"
    lines = [f"{about.gimbal_device_id}  {name}, managed by component {about.manager_component_id}"]
    for axis in ("roll", "pitch", "yaw"):
        limits = getattr(about, f"{axis}_deg")
        if limits is not None:
            lines.append(f"{axis:>6}  {limits[0]:.0f} to {limits[1]:.0f} degrees")
    return lines


async def _point(options: argparse.Namespace) -> int:
    async with _gimbal(options) as gimbal:
        await gimbal.point(options.pitch, options.yaw, frame=options.frame, timeout=options.patience)
    tell_done(options, "gimbal point")
    return DONE


async def _look(options: argparse.Namespace) -> int:
    async with _gimbal(options) as gimbal:
        place = Position(options.latitude, options.longitude, altitude_relative_m=options.altitude)
        await gimbal.look_at(place, timeout=options.patience)
    tell_done(options, "gimbal look")
    return DONE


async def _neutral(options: argparse.Namespace) -> int:
    async with _gimbal(options) as gimbal:
        await gimbal.neutral(timeout=options.patience)
    tell_done(options, "gimbal neutral")
    return DONE


async def _release(options: argparse.Namespace) -> int:
    async with _gimbal(options) as gimbal:
        await gimbal.release()
    tell_done(options, "gimbal release")
    return DONE
