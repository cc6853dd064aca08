"""Items compared with tolerance: what the wire and the vehicle's memory change is no difference."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.commands import (
    FENCE_COMMANDS,
    GLOBAL_FRAMES,
    RALLY_COMMANDS,
    canonical_frame,
    has_place,
    xy_scale,
)
from aerokit.missions.storage import Storage, kept

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from aerokit.missions.item import MissionItem

__all__ = ["changed_items", "item_differences", "items_differences"]

ALTITUDE_TOLERANCE_M = 0.011  # ArduPilot cuts altitudes to whole centimetres
HEADING_TOLERANCE_DEG = 0.001  # PX4 keeps radians
_HEADING_IS_PARAM4 = frozenset(
    {
        MavCmd.NAV_WAYPOINT,
        MavCmd.NAV_LOITER_UNLIM,
        MavCmd.NAV_LAND,
        MavCmd.NAV_TAKEOFF,
        MavCmd.NAV_VTOL_TAKEOFF,
        MavCmd.NAV_VTOL_LAND,
    }
)


def items_differences(
    wanted: Sequence[MissionItem], found: Sequence[MissionItem], storage: Storage = Storage.ANY
) -> tuple[str, ...]:
    """One text for each difference: ``"item 3 (NAV_WAYPOINT): z is 20.0 instead of 30.0"``; empty: alike."""
    texts = [f"there are {len(found)} items instead of {len(wanted)}"] if len(wanted) != len(found) else []
    for index, (item, other) in enumerate(zip(wanted, found)):  # noqa: B905 - of different length, see above
        texts += [f"item {index} ({item.name}): {text}" for text in item_differences(item, other, storage)]
    return tuple(texts)


def changed_items(
    wanted: Sequence[MissionItem], found: Sequence[MissionItem], storage: Storage = Storage.WIRE
) -> tuple[int, ...]:
    """Which of the wanted items (from 0) the other plan does not have at the same index.

    What is to be sent in a partial change: with the default only what the wire itself loses counts as the same.
    """
    common = min(len(wanted), len(found))
    changed = [i for i in range(common) if item_differences(wanted[i], found[i], storage)]
    return (*changed, *range(common, len(wanted)))


def item_differences(
    wanted: MissionItem,
    found: MissionItem,
    storage: Storage = Storage.ANY,
    *,
    single_precision: bool = False,
) -> tuple[str, ...]:
    """One text for each field in which they differ: ``"z is 20.0 instead of 30.0"``.

    ``single_precision``: places went through 32-bit floats (MISSION_ITEM), which are up to 1.7 m apart.
    """
    if wanted.command != found.command:
        return (f"the command is {found.name} instead of {wanted.name}",)
    return tuple(
        f"{field} is {getattr(found, field)!r} instead of {getattr(wanted, field)!r}"
        for field in _different_fields(wanted, found, storage, single_precision)
    )


def _different_fields(
    wanted: MissionItem, found: MissionItem, storage: Storage, single_precision: bool
) -> Iterator[str]:
    if not _frames_alike(wanted, found, storage):
        yield "frame"
    for field in ("param1", "param2", "param3", "param4"):
        if not _same_number(wanted, found, field, storage):
            yield field
    for field in ("x", "y"):
        if not _same_place(wanted, found, field, storage, single_precision):
            yield field
    if not _same_altitude(wanted, found, storage):
        yield "z"
    if bool(wanted.autocontinue) != bool(found.autocontinue) and not _forgets_autocontinue(found, storage):
        yield "autocontinue"


def _forgets_autocontinue(found: MissionItem, storage: Storage) -> bool:
    """ArduPilot gives back True for items of missions, False for those of fences and rally points."""
    if found.command in FENCE_COMMANDS | RALLY_COMMANDS:
        return True
    return storage in (Storage.ARDUPILOT, Storage.ANY) and found.autocontinue


def _frames_alike(wanted: MissionItem, found: MissionItem, storage: Storage) -> bool:
    one, other = canonical_frame(wanted.frame), canonical_frame(found.frame)
    if one == other or (wanted.command in FENCE_COMMANDS and {wanted.frame, found.frame} <= GLOBAL_FRAMES):
        return True
    if storage not in (Storage.ARDUPILOT, Storage.ANY) or other != MavFrame.GLOBAL:
        return False
    return not has_place(wanted.command) or one == MavFrame.MISSION


def _same_number(wanted: MissionItem, found: MissionItem, field: str, storage: Storage) -> bool:
    value, other = getattr(wanted, field), getattr(found, field)
    if _close(value, other):
        return True
    if field == "param4" and wanted.command in _HEADING_IS_PARAM4 and storage in (Storage.PX4, Storage.ANY):
        turn = abs(value - other) % 360.0
        if min(turn, 360.0 - turn) <= HEADING_TOLERANCE_DEG:
            return True
    return any(_close(one, other) for one in kept(wanted, field, storage))


def _same_place(
    wanted: MissionItem, found: MissionItem, field: str, storage: Storage, single_precision: bool
) -> bool:
    value, other = getattr(wanted, field), getattr(found, field)
    scale = xy_scale(wanted.command, wanted.frame)
    if scale != 1:
        return bool(abs(value - other) <= 1 + (_float_step(value / scale) * scale if single_precision else 0))
    if has_place(wanted.command):  # a place in the frame MISSION: no number of its own
        return bool(value == other)
    return value == other or any(_close(one, other) for one in kept(wanted, field, storage))


def _float_step(value: float) -> float:
    """How far the 32-bit floats around a number are apart."""
    return math.ldexp(1.0, math.frexp(value)[1] - 24)


def _same_altitude(wanted: MissionItem, found: MissionItem, storage: Storage) -> bool:
    if wanted.command in FENCE_COMMANDS or _close(wanted.z, found.z):
        return True
    if not has_place(wanted.command):
        return any(_close(one, found.z) for one in kept(wanted, "z", storage))
    if storage not in (Storage.ARDUPILOT, Storage.ANY):
        return False
    if wanted.command in RALLY_COMMANDS:  # ArduPilot keeps whole metres there
        return math.isfinite(wanted.z) and _close(math.trunc(wanted.z), found.z)
    return abs(wanted.z - found.z) <= ALTITUDE_TOLERANCE_M


def _close(one: float, other: float) -> bool:
    """Equal as 32-bit floats, and somewhat less than that after arithmetic with them."""
    if one == other or (one != one and other != other):
        return True
    return abs(one - other) <= max(1e-6 * max(abs(one), abs(other)), 1e-9)
