"""Commands as the items of ``vehicle.aio.mission``, and items as commands.

Scripts count commands as ArduPilot does, whatever the vehicle: item 0 is home, ``commands[0]`` has ``seq`` 1. Items of
a :class:`aerokit.missions.Mission` are counted from 0 without home, so jumps are one apart.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.dronekit.command import Command
from aerokit.errors import LocalProtocolError
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions import Mission
from aerokit.missions.commands import DEFAULT_XY, DESTINATIONS, GLOBAL_FRAMES, canonical_frame, has_place
from aerokit.missions.item import MissionItem
from aerokit.missions.wire import from_degrees, home_item, in_degrees

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from aerokit.position import Position
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["commands_of", "home_command", "mission_of"]

DEGREES = 1e7


def mission_of(commands: Sequence[Command], vehicle: AsyncVehicle) -> Mission:
    """The mission of these commands for this vehicle.

    Raises:
        LocalProtocolError: a field is no number; the text says which, of ``commands[…]``.
    """
    items: Iterable[MissionItem] = [_item(each, index) for index, each in enumerate(commands)]
    if not vehicle.autopilot.home_is_item_0:
        items = _places_known(map(_without_frame, items), _whereabouts(vehicle))
    return Mission(tuple(items))


def commands_of(items: Sequence[MissionItem], own_ids: tuple[int, int]) -> tuple[Command, ...]:
    """The commands of a mission from a vehicle, as if they had been sent to ``own_ids`` (system, component)."""
    return tuple(_command(item, seq, own_ids) for seq, item in enumerate(items, 1))


def home_command(home: Position | None, own_ids: tuple[int, int]) -> Command:
    """Home as command 0, all zeros when it is not known."""
    return _command(home_item(home), 0, own_ids)


def _item(cmd: Command, index: int) -> MissionItem:
    try:
        command, frame = int(cmd.command), int(cmd.frame)
        x, y = (_wire_number(value, command, frame) for value in (cmd.x, cmd.y))
        return MissionItem(
            command,
            frame,
            float(cmd.param1) - (command == MavCmd.DO_JUMP),
            float(cmd.param2),
            float(cmd.param3),
            float(cmd.param4),
            x,
            y,
            float(cmd.z),
            bool(cmd.autocontinue),
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise LocalProtocolError(f"commands[{index}] is not allowed: {error}, in {cmd}") from None


def _wire_number(value: Any, command: int, frame: int) -> int | float:
    """What MISSION_ITEM_INT has for x or y. A fraction of what is no place is cut off, as ArduPilot does."""
    number = from_degrees(float(value), command, frame)
    return int(number) if isinstance(number, float) and abs(number) < 1e9 else number


def _command(item: MissionItem, seq: int, own_ids: tuple[int, int]) -> Command:
    param1 = item.param1 + (item.command == MavCmd.DO_JUMP)
    frame = int(canonical_frame(item.frame))  # those of MISSION_ITEM, which is what a command is
    x, y = in_degrees(item)
    params = (param1, item.param2, item.param3, item.param4)
    return Command(*own_ids, seq, frame, int(item.command), 0, int(item.autocontinue), *params, x, y, item.z)


# ------------------------------------------------------------------ what ArduPilot does by itself


def _without_frame(item: MissionItem) -> MissionItem:
    """Commands without a place are taken in any frame by ArduPilot, in MAV_FRAME_MISSION alone by PX4."""
    if has_place(item.command) or item.frame not in GLOBAL_FRAMES:
        return item
    return item.replace(frame=int(MavFrame.MISSION))


def _places_known(items: Iterable[MissionItem], place: tuple[int, int] | None) -> Iterator[MissionItem]:
    """0°, 0° is "where the vehicle is" for ArduPilot: where the item before leads, at first ``place``."""
    for item in items:
        if item.command in DESTINATIONS and item.frame in GLOBAL_FRAMES:
            if place is not None and item.x == item.y == 0:
                item = item.replace(x=place[0], y=place[1])
            elif DEFAULT_XY not in (item.x, item.y):
                place = round(item.x), round(item.y)
        yield item


def _whereabouts(vehicle: AsyncVehicle) -> tuple[int, int] | None:
    position = vehicle.telemetry.position.latest or vehicle.telemetry.home.latest
    if position is None:
        return None
    return round(position.latitude_deg * DEGREES), round(position.longitude_deg * DEGREES)
