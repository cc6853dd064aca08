"""``Command``: one item of a mission, as programs write and read it, and as an item of ``vehicle.aio.mission``.

Programs count commands as ArduPilot does, whatever the vehicle: item 0 is home, ``commands[0]`` has ``seq`` 1. Items of
a :class:`aerokit.missions.Mission` are counted from 0 without home, so jumps are one apart.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20.ardupilotmega import MAVLink_mission_item_message

from aerokit.errors import LocalProtocolError
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions import Mission
from aerokit.missions.commands import DEFAULT_XY, DESTINATIONS, GLOBAL_FRAMES, canonical_frame, has_place
from aerokit.missions.item import MissionItem
from aerokit.missions.wire import from_degrees, home_item, in_degrees

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from aerokit.dronekit.values import LocationGlobal
    from aerokit.position import Position
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = [
    "Command",
    "command_from",
    "commands_of",
    "home_command",
    "is_home_row",
    "mission_of",
    "values_of",
]

FIELDS: list[str] = MAVLink_mission_item_message.fieldnames[:14]
"""Those of MAVLink 1: ``mission_type``, which came later, is no part of a command's text."""
CONTENT = ("frame", "command", "autocontinue", *FIELDS[7:])
"""The fields that make a mission another one when they are changed."""
ABOVE_SEA = (0, 5)
"""MAV_FRAME_GLOBAL and its _INT twin."""
DEGREES = 1e7
AT_HOME_DEG, AT_HOME_M = 1e-4, 2.0
"""How near to home the home row of a file may be: about ten metres, two in height."""


class Command(MAVLink_mission_item_message):  # type: ignore[misc]
    """A waypoint, or another item of a mission, of ``vehicle.commands``: a MISSION_ITEM of pymavlink.

    Args:
        target_system, target_component, seq: anything; they are filled in when it is added.
        frame: MAV_FRAME: what ``z`` is above; 0: the sea, 3: home, 10: the terrain.
        command: MAV_CMD.
        current: not used; 1 in the first row of a waypoint file, which is home.
        autocontinue: 0 makes PX4 stay at the item; ArduPilot goes on in any case.
        param1, param2, param3, param4: the command's.
        x, y: latitude and longitude in degrees, or the command's parameters 5 and 6; metres in a local frame.
        z: altitude in metres, or parameter 7.
    """

    def __init__(
        self,
        target_system: int,
        target_component: int,
        seq: int,
        frame: int,
        command: int,
        current: int,
        autocontinue: int,
        param1: float,
        param2: float,
        param3: float,
        param4: float,
        x: float,
        y: float,
        z: float,
    ) -> None:
        place = (x, y, z)
        params = (param1, param2, param3, param4)
        super().__init__(
            target_system, target_component, seq, frame, command, current, autocontinue, *params, *place
        )
        self._fieldnames = FIELDS


def command_from(cmd: Any) -> Command:
    """A copy of a command, or the command that a MISSION_ITEM or MISSION_ITEM_INT of pymavlink stands for.

    Raises:
        TypeError: it is none of these.
    """
    if isinstance(cmd, Command):
        return copy.copy(cmd)
    try:
        fields = {name: getattr(cmd, name) for name in FIELDS}
    except AttributeError:
        raise TypeError(f"{cmd!r} is not allowed: a Command") from None
    if hasattr(cmd, "get_type") and cmd.get_type() == "MISSION_ITEM_INT":
        fields["x"], fields["y"] = in_degrees(MissionItem(cmd.command, cmd.frame, x=cmd.x, y=cmd.y))
    return Command(**fields)


def values_of(commands: Iterable[Command]) -> tuple[tuple[Any, ...], ...]:
    """What the commands say by now, to be compared; NaN is equal to NaN."""
    return tuple(
        tuple("NaN" if value != value else value for value in (getattr(each, name) for name in CONTENT))
        for each in commands
    )


def is_home_row(cmd: Command, home: LocationGlobal | None) -> bool:
    """Whether a command is not to be flown but is the first row of a waypoint file: where home was.

    That is a waypoint above the sea without parameters which has ``current`` set, is all zeros, or is where home is.
    """
    if cmd.command != MavCmd.NAV_WAYPOINT or cmd.frame not in ABOVE_SEA:
        return False
    if any((cmd.param1, cmd.param2, cmd.param3, cmd.param4)):
        return False
    return cmd.current == 1 or not any((cmd.x, cmd.y, cmd.z)) or _is_at(cmd, home)


def _is_at(cmd: Command, home: LocationGlobal | None) -> bool:
    if home is None or home.lat is None or home.lon is None or home.alt is None:
        return False
    try:
        away = max(abs(cmd.x - home.lat), abs(cmd.y - home.lon) * math.cos(math.radians(home.lat)))
        return bool(away <= AT_HOME_DEG and abs(cmd.z - home.alt) <= AT_HOME_M)
    except TypeError:  # no numbers: told when it is uploaded
        return False


# ------------------------------------------------------------------------------- as items of a mission


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
