"""Plans on the command line: reading a file of either format, telling its items, uploading its parts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.cli.output import tell
from aerokit.cli.progress import progress_bar

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from aerokit.missions import MissionItem, Plan
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["PARTS", "read_plan", "tell_items", "tell_part", "upload_parts"]

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
