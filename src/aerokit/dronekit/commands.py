"""``vehicle.commands``: the mission of a vehicle, as DroneKit programs read and write it, and its ``Command``s.

Programs count commands as ArduPilot does, whatever the vehicle: item 0 is home, ``commands[0]`` has ``seq`` 1. Items of
a :class:`aerokit.missions.Mission` are counted from 0 without home, so jumps are one apart.
"""

from __future__ import annotations

import copy
import math
import operator
import threading
from typing import TYPE_CHECKING, Any, overload

from pymavlink.dialects.v20.ardupilotmega import MAVLink_mission_item_message

from aerokit._internal.values import Snapshot
from aerokit.dronekit.core import core_of
from aerokit.dronekit.exceptions import APIException, TimeoutError, classic_errors  # noqa: A004 - DroneKit's name
from aerokit.errors import AerokitError, InvalidArgument, OperationTimeout
from aerokit.mavlink.enums import MavCmd
from aerokit.missions import Mission
from aerokit.missions.item import MissionItem, canonical_frame
from aerokit.missions.wire import from_degrees, in_degrees, shift_jumps, to_wire_float, written_out
from aerokit.sync.reply import reply_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from aerokit.dronekit.attributes import VehicleAttributes
    from aerokit.dronekit.line import BackgroundCall
    from aerokit.dronekit.values import LocationGlobal
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

FIELDS: list[str] = MAVLink_mission_item_message.fieldnames[:14]
"""Those of MAVLink 1: ``mission_type``, which came later, is no part of a command's text."""
PARAMS: list[str] = FIELDS[7:11]
CONTENT: tuple[str, ...] = ("frame", "command", "autocontinue", *FIELDS[7:])
"""The fields that make a mission another one when they are changed."""
ABOVE_SEA = (0, 5)
"""MAV_FRAME_GLOBAL and its _INT twin."""
AT_HOME_DEG, AT_HOME_M = 1e-4, 2.0
"""How near to home the home row of a file may be: about ten metres, two in height."""


if TYPE_CHECKING:  # pymavlink's classes say little to a checker

    class _MissionItem:
        target_system: int
        target_component: int
        seq: int
        frame: int
        command: int
        current: int
        autocontinue: int
        param1: float
        param2: float
        param3: float
        param4: float
        x: float
        y: float
        z: float

        def __init__(self, *values: float) -> None: ...
        def __getattr__(self, name: str) -> Any: ...
else:
    _MissionItem = MAVLink_mission_item_message


class Command(_MissionItem):
    """A waypoint, or another item of a mission, of ``vehicle.commands``: a MISSION_ITEM of pymavlink.

    Args:
        target_system: anything; it is filled in when it is added.
        target_component: so is this.
        seq: and this.
        frame: MAV_FRAME: what ``z`` is above; 0: the sea, 3: home, 10: the terrain.
        command: MAV_CMD.
        current: not used; 1 in the first row of a waypoint file, which is home.
        autocontinue: 0 makes PX4 stay at the item; ArduPilot goes on in any case.
        param1: the command's first parameter.
        param2: its second.
        param3: its third.
        param4: its fourth.
        x: latitude in degrees, or the command's parameter 5; metres in a local frame.
        y: longitude, or its parameter 6.
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
        numbers = (param1, param2, param3, param4, x, y, z)
        super().__init__(
            target_system, target_component, seq, frame, command, current, autocontinue, *numbers
        )
        self._fieldnames = FIELDS


class Held(Snapshot):
    """What the sequence consists of, replaced as a whole."""

    items: tuple[Command, ...] = ()
    home: Command | None = None
    is_changed: bool = False
    """Whether a program has cleared, added or replaced since it was the vehicle's."""


class CommandSequence:
    """The commands of a mission, without home: ``commands[0]`` is the first to be flown and has ``seq`` 1.

    Nothing is known of the vehicle's mission before :meth:`download`, and nothing changes there before :meth:`upload`.
    Between the two it is a list: it has a length, indices (negative ones count from the end), slices, iteration and
    assignment; commands may be edited in place. Any thread may use it.
    """

    def __init__(self, vehicle: VehicleAttributes) -> None:
        self._vehicle, self._core = vehicle, core_of(vehicle)
        self._lock = threading.Lock()
        self._held = Held()
        self._uploaded: tuple[tuple[Any, ...], ...] = ()
        """What the commands said when the vehicle had them last."""
        self._downloads = 0
        self._download: BackgroundCall | None = None
        self._current = vehicle._dk_current_command

    # ------------------------------------------------------------------- from and to the vehicle

    def download(self) -> None:
        """Begin to read the vehicle's mission; :meth:`wait_ready` waits until it is there.

        Until then the sequence stays what it was. A download under way is begun anew. When it is there, listeners to
        ``'commands'`` are told; ``vehicle.home_location`` is set if the mission has it. APIException: the link is down.
        """
        self._core.check_link()
        with self._lock:
            self._downloads += 1
            self._core.ready.unmark("commands")
            self._download = self._core.order("commands.download", self._read, self._downloads)

    def wait_ready(self, **kwargs: Any) -> bool:
        """Wait for the end of the download; arguments, result and errors as of :meth:`Vehicle.wait_ready`.

        When the download has failed the APIException says why; the next one may succeed.
        """
        return self._vehicle.wait_ready("commands", **kwargs)

    def upload(self, timeout: float | None = None) -> None:
        """Have the vehicle hold exactly these commands, and return when it has confirmed that.

        Nothing is sent when nothing was changed since the last download or upload. Afterwards, whether or not it
        succeeded, the sequence is what it was, and can be uploaded again.

        Args:
            timeout: seconds for all of it; None: as long as it makes progress (ten seconds without any are the end).

        Raises:
            TimeoutError: the vehicle does not answer, or not in time.
            APIException: it refused: the text names command and reason, commands counted as their indices here.
            InvalidArgument: a ValueError; a command cannot be right. Nothing was sent.
        """
        self._settle()
        with self._lock:
            values = _values_of(self._held.items)
            if not self._held.is_changed and values == self._uploaded:
                return
            held = self._held = self._held.replace(is_changed=True)  # until it is known to be there
        aio = self._core.check_link()
        # DroneKit knows no such limit, and its programs run unchanged.
        options = {"timeout": timeout, "max_distance_m": math.inf}
        self._core.run(aio.mission.upload, _mission_of(held.items, aio), **options)
        with self._lock:
            self._uploaded = values
            if self._held is held:
                self._held = held.replace(is_changed=False)

    @property
    def next(self) -> int:
        """``seq`` of the command that the vehicle flies: ``commands[commands.next - 1]``; 0 before it flies any.

        Setting it has the vehicle go for that command next (0: begin anew), and does not wait.
        """
        return self._current.seq

    @next.setter  # noqa: A003 - DroneKit's name
    def next(self, index: int) -> None:
        self._current.choose(index)

    # ---------------------------------------------------------------------------------- a list

    def clear(self) -> None:
        """Remove all commands; the vehicle is told by :meth:`upload`. Waits for the end of a download under way."""
        self._wait_for_download()
        with self._lock:
            if self._core.ready.failure_of({"commands"}) is not None:
                self._core.ready.mark("commands")
            self._held = Held((), self._held.home, is_changed=True)

    def add(self, cmd: Any) -> None:
        """Append a copy of a command; the vehicle is told by :meth:`upload`. Waits for the end of a download under way.

        ``cmd`` is a :class:`Command` or a MISSION_ITEM of pymavlink (else TypeError); its ``target_system`` becomes the
        vehicle's. The first row of a waypoint file, which is home, is kept apart: vehicles have a home of their own.
        APIException: the download before has failed, so that there is nothing to append to.
        """
        self._settle()
        added = _command_from(cmd)
        cmd.target_system = added.target_system = self._core.target_system
        if self._append(added) == 0:
            self._core.logger.info("the first command is home, as in a waypoint file: %s", added)

    @property
    def count(self) -> int:
        """The number of commands, as ``len()`` has it."""
        return len(self._held.items)

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[Any]:
        return iter(self._held.items)

    @overload
    def __getitem__(self, index: int) -> Any: ...
    @overload
    def __getitem__(self, index: slice) -> list[Any]: ...
    def __getitem__(self, index: int | slice) -> Any:
        items = self._held.items
        if isinstance(index, slice):
            return list(items[index])
        return items[_checked(index, len(items))]

    def __setitem__(self, index: int, value: Any) -> None:
        self._settle()
        command = value if isinstance(value, Command) else _command_from(value)
        with self._lock:
            items = list(self._held.items)
            at = len(items) if index == len(items) else _checked(index, len(items))
            command.seq = at + 1
            items[at : at + 1] = [command]
            self._held = self._held.replace(items=tuple(items), is_changed=True)

    def rows(self) -> tuple[Command, ...]:
        """As a waypoint file has them: home first, all zeros if not known; empty as long as nothing is known."""
        held = self._held
        if not held.items and held.home is None:
            return ()
        return (*(_commands_of(Mission(), (0, 0)) if held.home is None else (held.home,)), *held.items)

    def _append(self, cmd: Command) -> int:
        """Append it, as home if that is what it is; returns its number."""
        with self._lock:
            held = self._held
            if not held.items and _is_home_row(cmd, self._vehicle._home_location):
                cmd.seq = seq = 0
                self._held = held.replace(home=cmd, is_changed=True)
            else:
                cmd.seq = seq = len(held.items) + 1
                self._held = held.replace(items=(*held.items, cmd), is_changed=True)
            return seq

    async def _read(self, number: int) -> None:
        try:
            mission = await self._core.aio.mission.download()
        except AerokitError as error:
            self._note_failure(number, error)
            raise
        self._take(number, mission)

    def _take(self, number: int, mission: Mission) -> None:
        """On the loop thread: what was downloaded is the sequence from now on."""
        home, connection = mission.home, self._core.aio.connection
        own_ids = connection.source_system, connection.source_component
        at_home, *items = _commands_of(mission, own_ids)
        with self._lock:
            if number != self._downloads:
                return
            self._held = Held(tuple(items), at_home)
            self._uploaded = _values_of(items)
        if home is not None and home.altitude_amsl_m is not None:
            self._vehicle._dk_set_home(home.latitude_deg, home.longitude_deg, home.altitude_amsl_m)
        self._core.listeners.tell("commands", self)

    def _note_failure(self, number: int, error: AerokitError) -> None:
        kind = TimeoutError if isinstance(error, OperationTimeout) else APIException
        failure = kind(f"the mission could not be downloaded: {error}")
        failure.__cause__ = error
        with self._lock:
            if number == self._downloads:
                self._core.ready.fail("commands", failure)

    def _settle(self) -> None:
        """Wait until it is known what there is to change."""
        self._wait_for_download()
        if (failure := self._core.ready.failure_of({"commands"})) is not None:
            raise type(failure)(f"{failure}; download() again, or clear()") from failure.__cause__

    def _wait_for_download(self) -> None:
        """As DroneKit does: what is cleared or added after download() comes after it. Its end is bounded."""
        while (download := self._download) is not None and not download.done():
            with classic_errors():
                self._core.handler.loop.wait_for(reply_of(download))


class WaypointLoader:
    """``vehicle._wploader``, as far as programs read it: commands with home as number 0."""

    def __init__(self, commands: CommandSequence) -> None:
        self._commands = commands

    def count(self) -> int:
        """How many there are, home included; 0 as long as nothing is known."""
        return len(self._commands.rows())

    def wp(self, i: int) -> Command:
        """Command ``i``; 0 is home, all zeros when it is not known. IndexError if there is none."""
        return self._commands.rows()[i]


def _checked(index: Any, count: int) -> int:
    try:
        at = operator.index(index)
    except TypeError:
        raise TypeError("Invalid argument type.") from None
    if not -count <= at < count:
        raise IndexError(f"Index {at} out of range.")
    return at % count


def _command_from(cmd: Any) -> Command:
    """A copy of a command, or what a MISSION_ITEM or MISSION_ITEM_INT of pymavlink stands for; TypeError else."""
    if isinstance(cmd, Command):
        return copy.copy(cmd)
    try:
        fields = {name: getattr(cmd, name) for name in FIELDS}
    except AttributeError:
        raise TypeError(f"{cmd!r} is not allowed: a Command") from None
    if hasattr(cmd, "get_type") and cmd.get_type() == "MISSION_ITEM_INT":
        fields["x"], fields["y"] = in_degrees(MissionItem(cmd.command, cmd.frame, x=cmd.x, y=cmd.y))
    return Command(**fields)


def _values_of(commands: Iterable[Command]) -> tuple[tuple[Any, ...], ...]:
    """What the commands say by now, to be compared; NaN is equal to NaN."""
    return tuple(
        tuple("NaN" if value != value else value for value in (getattr(each, name) for name in CONTENT))
        for each in commands
    )


def _is_home_row(cmd: Command, home: LocationGlobal | None) -> bool:
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


def _mission_of(commands: Sequence[Command], vehicle: AsyncVehicle) -> Mission:
    """The mission of these commands for this vehicle; InvalidArgument names a field that is no number."""
    items: Iterable[MissionItem] = [_item(each, index) for index, each in enumerate(commands)]
    if not vehicle.autopilot.home_is_item_0:
        here = vehicle.telemetry.position.latest or vehicle.telemetry.home.latest
        items = written_out(items, None if here is None else (here.latitude_deg, here.longitude_deg))
    return Mission(shift_jumps(items, -1))


def _commands_of(mission: Mission, own_ids: tuple[int, int]) -> tuple[Command, ...]:
    """Home, all zeros when it is not known, and the commands of a mission, sent to ``own_ids`` (system, component)."""
    items = mission.to_items(home_is_item_0=True)
    return tuple(_command(item, seq, own_ids) for seq, item in enumerate(items))


def _item(cmd: Command, index: int) -> MissionItem:
    try:
        command, frame = int(cmd.command), int(cmd.frame)
        one, two, three, four = (float(getattr(cmd, name)) for name in PARAMS)
        x, y = (_wire_number(value, command, frame) for value in (cmd.x, cmd.y))
        z, autocontinue = float(cmd.z), bool(cmd.autocontinue)
        return MissionItem(command, frame, one, two, three, four, x, y, z, autocontinue)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidArgument(f"commands[{index}] is not allowed: {error}, in {cmd}") from None


def _wire_number(value: Any, command: int, frame: int) -> int | float:
    """What MISSION_ITEM_INT has for x or y. A fraction of what is no place is cut off, as ArduPilot does."""
    number = from_degrees(float(value), command, frame)
    return int(number) if isinstance(number, float) and abs(number) < 1e9 else number


def _command(item: MissionItem, seq: int, own_ids: tuple[int, int]) -> Command:
    # The frames of MISSION_ITEM, which is what a command is.
    item = item.replace(frame=int(canonical_frame(item.frame)))
    message = to_wire_float(item, seq, target_system=own_ids[0], target_component=own_ids[1])
    return Command(*(getattr(message, name) for name in FIELDS))
