"""``Command``: one item of a mission, as programs write and read it."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20.ardupilotmega import MAVLink_mission_item_message

from aerokit.mavlink.enums import MavCmd
from aerokit.missions.item import MissionItem
from aerokit.missions.wire import in_degrees

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.dronekit.values import LocationGlobal

__all__ = ["Command", "command_from", "is_home_row", "values_of"]

FIELDS: list[str] = MAVLink_mission_item_message.fieldnames[:14]
"""Those of MAVLink 1: ``mission_type``, which came later, is no part of a command's text."""
CONTENT = ("frame", "command", "autocontinue", *FIELDS[7:])
"""The fields that make a mission another one when they are changed."""
ABOVE_SEA = (0, 5)
"""MAV_FRAME_GLOBAL and its _INT twin."""
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
