"""``vehicle.commands``: the mission of a vehicle in the classic API, and its ``Command`` items.

The ``seq`` of a command is ArduPilot's for every vehicle: home has 0, and ``commands[0]`` has 1. Items of a
:class:`aerokit.missions.Mission` count from 0 without home, so jump targets differ by one.
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
from aerokit.missions.wire import convert_from_ardupilot, scaled_coordinate, shift_jumps, to_wire_float, unscaled_xy
from aerokit.sync.thread_future import when_done

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from aerokit.dronekit.attributes import VehicleAttributes
    from aerokit.dronekit.classic_connection import BackgroundCall
    from aerokit.dronekit.values import LocationGlobal
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

# Fields of MISSION_ITEM in MAVLink 1. DroneKit does not show `mission_type`, which MAVLink 2 added.
FIELDS: list[str] = MAVLink_mission_item_message.fieldnames[:14]
PARAM_FIELDS = ("param1", "param2", "param3", "param4")
# Fields to compare with the vehicle's mission.
CONTENT_FIELDS = ("frame", "command", "autocontinue", *PARAM_FIELDS, "x", "y", "z")
AMSL_FRAMES = (0, 5)  # MAV_FRAME_GLOBAL and MAV_FRAME_GLOBAL_INT
# The first row of a waypoint file is home. A first waypoint this close to home is taken for that row.
HOME_TOLERANCE_DEG, HOME_TOLERANCE_M = 1e-4, 2.0  # 1e-4 degrees are about ten metres


if TYPE_CHECKING:  # The class of pymavlink has no useful annotations.

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
    """A waypoint, or another mission item, of ``vehicle.commands``: a MISSION_ITEM of pymavlink.

    Args:
        target_system: ignored; adding the command sets it.
        target_component: ignored.
        seq: ignored; adding the command sets it.
        frame: MAV_FRAME, which is the reference of ``z``: 0 is sea level, 3 is home, 10 is the terrain.
        command: MAV_CMD.
        current: ignored, except that 1 in the first row of a waypoint file marks home.
        autocontinue: 0 makes PX4 stay at the item; ArduPilot always continues.
        param1: parameter 1 of the command.
        param2: parameter 2.
        param3: parameter 3.
        param4: parameter 4.
        x: latitude in degrees, metres in a local frame, or parameter 5.
        y: longitude in degrees, metres in a local frame, or parameter 6.
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
        super().__init__(target_system, target_component, seq, frame, command, current, autocontinue, *numbers)
        self._fieldnames = FIELDS  # the fields that str(command) shows


class SequenceState(Snapshot):
    """Content of a CommandSequence. A change replaces the whole object."""

    items: tuple[Command, ...] = ()
    home: Command | None = None
    is_changed: bool = False
    """True after a change by the program, until the next upload or download succeeds."""


class CommandSequence:
    """The commands of a mission, without home: ``commands[0]`` is the first to be flown and has ``seq`` 1.

    The sequence is empty before :meth:`download`, and the vehicle's mission changes only with :meth:`upload`. The
    sequence works like a list: length, indices (also negative), slices, iteration and assignment. Commands can be
    edited in place. The sequence can be used from any thread.
    """

    def __init__(self, vehicle: VehicleAttributes) -> None:
        self._vehicle, self._core = vehicle, core_of(vehicle)
        self._lock = threading.Lock()  # protects `_state`, `_vehicle_content` and the download
        self._state = SequenceState()
        # Content of the vehicle's mission after the last download or upload.
        self._vehicle_content: tuple[tuple[Any, ...], ...] = ()
        # Number of the latest download. The result of an earlier download, which may arrive later, is ignored.
        self._download_number = 0
        self._download: BackgroundCall | None = None  # the latest download; None before the first
        self._current = vehicle._dk_current_command

    # ------------------------------------------------------------------- from and to the vehicle

    def download(self) -> None:
        """Start reading the vehicle's mission; :meth:`wait_ready` waits for it.

        A running download is restarted. When the download is complete, the sequence is replaced, listeners of
        ``'commands'`` are called, and ``vehicle.home_location`` is set if the mission has home. Raises APIException
        while the link is down.
        """
        self._core.check_link()
        with self._lock:
            self._download_number += 1
            self._core.ready.unmark("commands")
            self._download = self._core.order("commands.download", self._run_download, self._download_number)

    def wait_ready(self, **kwargs: Any) -> bool:
        """Wait for the download. Arguments and result are those of :meth:`Vehicle.wait_ready`.

        Raises APIException with the reason if the download fails. The download can then be repeated.
        """
        return self._vehicle.wait_ready("commands", **kwargs)

    def upload(self, timeout: float | None = None) -> None:
        """Upload the commands, and return when the vehicle has confirmed them.

        Sends nothing if the commands have not changed since the last download or upload. A failed upload does not
        change the sequence, and can be repeated.

        Args:
            timeout: seconds in total. None means no limit, but ten seconds without progress raise TimeoutError.

        Raises:
            TimeoutError: the vehicle did not answer in time.
            APIException: the vehicle refused; the text has the command's index in this sequence, and the reason.
            InvalidArgument: a command is invalid; nothing was sent. The error is also a ValueError.
        """
        self._require_downloaded()
        with self._lock:
            content = _content_of(self._state.items)
            if not self._state.is_changed and content == self._vehicle_content:
                return
            uploaded = self._state = self._state.replace(is_changed=True)  # stays True if the upload fails
        aio = self._core.check_link()
        # DroneKit does not limit the distance of waypoints, and its programs must run unchanged.
        options = {"timeout": timeout, "max_distance_m": math.inf}
        self._core.run(aio.mission.upload, _mission_of(uploaded.items, aio), **options)
        with self._lock:
            self._vehicle_content = content
            if self._state is uploaded:  # The program has not changed the sequence meanwhile.
                self._state = uploaded.replace(is_changed=False)

    @property
    def next(self) -> int:
        """``seq`` of the current command; 0 before the mission starts.

        The command is ``commands[commands.next - 1]``, because the list begins with ``seq`` 1. Set ``next`` to change
        the current command; 0 restarts the mission. Setting ``next`` does not wait.
        """
        return self._current.seq

    @next.setter  # noqa: A003 - DroneKit's name
    def next(self, index: int) -> None:
        self._current.set_next(index)

    # ---------------------------------------------------------------------------------- a list

    def clear(self) -> None:
        """Remove all commands from the sequence; :meth:`upload` sends the change. Waits for a running download."""
        self._wait_for_download()
        with self._lock:
            # After a failed download, the program can continue with an empty sequence.
            if self._core.ready.failure_of({"commands"}) is not None:
                self._core.ready.mark("commands")
            self._state = SequenceState((), self._state.home, is_changed=True)

    def add(self, cmd: Any) -> None:
        """Append a copy of a command; :meth:`upload` sends the change. Waits for a running download.

        ``cmd`` is a :class:`Command` or a MISSION_ITEM of pymavlink (else TypeError); its ``target_system`` is set. If
        the sequence is empty, a command that looks like the home row of a waypoint file is stored as home instead.
        Raises APIException if the last download has failed.
        """
        self._require_downloaded()
        added = _command_from(cmd)
        added.target_system = self._core.target_system
        cmd.target_system = added.target_system
        is_home = self._append(added)
        if is_home:
            self._core.logger.info("the first command is home, as in a waypoint file: %s", added)

    @property
    def count(self) -> int:
        return len(self._state.items)

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[Any]:
        return iter(self._state.items)

    @overload
    def __getitem__(self, index: int) -> Any: ...
    @overload
    def __getitem__(self, index: slice) -> list[Any]: ...
    def __getitem__(self, index: int | slice) -> Any:
        items = self._state.items
        if isinstance(index, slice):
            return list(items[index])
        return items[_checked_index(index, len(items))]

    def __setitem__(self, index: int, value: Any) -> None:
        self._require_downloaded()
        # Unlike add(), store the object itself, as DroneKit does, so that the program can continue to edit it.
        command = value if isinstance(value, Command) else _command_from(value)
        with self._lock:
            items = list(self._state.items)
            position = len(items) if index == len(items) else _checked_index(index, len(items))
            command.seq = position + 1
            items[position : position + 1] = [command]  # The index after the last item appends, as in pymavlink.
            self._state = self._state.replace(items=tuple(items), is_changed=True)

    def rows(self) -> tuple[Command, ...]:
        """Return the rows of a waypoint file: home and the commands.

        The row of an unknown home is all zeros. There are no rows if there is neither home nor a command.
        """
        state = self._state
        if state.home is not None:
            return (state.home, *state.items)
        if not state.items:
            return ()
        unknown_home = _commands_of(Mission(), (0, 0))  # only the home row, with zeros
        return (*unknown_home, *state.items)

    def _append(self, cmd: Command) -> bool:
        """Append a command, or store it as home. Return True if it is home."""
        with self._lock:
            state = self._state
            is_home = not state.items and _is_home_row(cmd, self._vehicle._home_location)
            if is_home:
                cmd.seq = 0
                self._state = state.replace(home=cmd, is_changed=True)
            else:
                cmd.seq = len(state.items) + 1
                self._state = state.replace(items=(*state.items, cmd), is_changed=True)
            return is_home

    async def _run_download(self, number: int) -> None:
        try:
            mission = await self._core.aio.mission.download()
        except AerokitError as error:
            self._on_download_failed(number, error)
            raise
        self._store_download(number, mission)

    def _store_download(self, number: int, mission: Mission) -> None:
        home, connection = mission.home, self._core.aio.connection
        own_ids = connection.source_system, connection.source_component
        home_command, *items = _commands_of(mission, own_ids)
        with self._lock:
            if number != self._download_number:  # A newer download has started.
                return
            self._state = SequenceState(tuple(items), home_command)
            self._vehicle_content = _content_of(items)
        if home is not None and home.altitude_amsl_m is not None:
            self._vehicle._dk_set_home(home.latitude_deg, home.longitude_deg, home.altitude_amsl_m)
        self._core.listeners.notify("commands", self)

    def _on_download_failed(self, number: int, error: AerokitError) -> None:
        error_class = TimeoutError if isinstance(error, OperationTimeout) else APIException
        failure = error_class(f"the mission could not be downloaded: {error}")
        failure.__cause__ = error
        with self._lock:
            if number == self._download_number:
                self._core.ready.fail("commands", failure)

    def _require_downloaded(self) -> None:
        """Wait for a running download. Raise APIException if the last download has failed."""
        self._wait_for_download()
        if (failure := self._core.ready.failure_of({"commands"})) is not None:
            raise type(failure)(f"{failure}; call download() again, or clear()") from failure.__cause__

    def _wait_for_download(self) -> None:
        # As in DroneKit, clear() and add() change the downloaded mission, so they wait for a running download.
        while (download := self._download) is not None and not download.done():
            with classic_errors():
                self._core.handler.loop.wait_for(when_done(download))


class WaypointLoader:
    """``vehicle._wploader``, read only: the commands of the mission, with home as number 0."""

    def __init__(self, commands: CommandSequence) -> None:
        self._commands = commands

    def count(self) -> int:
        return len(self._commands.rows())

    def wp(self, i: int) -> Command:
        return self._commands.rows()[i]


def _checked_index(index: Any, count: int) -> int:
    try:
        position = operator.index(index)
    except TypeError:
        raise TypeError("Invalid argument type.") from None
    if not -count <= position < count:
        raise IndexError(f"Index {position} out of range.")
    return position % count  # A negative index counts from the end.


def _command_from(cmd: Any) -> Command:
    """Copy a command, or convert pymavlink's MISSION_ITEM or MISSION_ITEM_INT."""
    if isinstance(cmd, Command):
        return copy.copy(cmd)
    try:
        fields = {name: getattr(cmd, name) for name in FIELDS}
    except AttributeError:
        raise TypeError(f"{cmd!r} is not a Command") from None
    if hasattr(cmd, "get_type") and cmd.get_type() == "MISSION_ITEM_INT":
        fields["x"], fields["y"] = unscaled_xy(MissionItem(cmd.command, cmd.frame, x=cmd.x, y=cmd.y))
    return Command(**fields)


def _content_of(commands: Iterable[Command]) -> tuple[tuple[Any, ...], ...]:
    """Return the values of commands for comparison, in which NaN equals NaN."""
    return tuple(tuple(_comparable(getattr(command, name)) for name in CONTENT_FIELDS) for command in commands)


def _comparable(value: Any) -> Any:
    is_nan = value != value  # Only NaN differs from itself; math.isnan() would refuse values of other types.
    return "NaN" if is_nan else value


def _is_home_row(cmd: Command, home: LocationGlobal | None) -> bool:
    """Return True if a command looks like the home row of a waypoint file."""
    if cmd.command != MavCmd.NAV_WAYPOINT or cmd.frame not in AMSL_FRAMES:
        return False
    if any((cmd.param1, cmd.param2, cmd.param3, cmd.param4)):
        return False
    is_marked = cmd.current == 1
    is_unknown_home = not any((cmd.x, cmd.y, cmd.z))
    return is_marked or is_unknown_home or _is_at_home(cmd, home)


def _is_at_home(cmd: Command, home: LocationGlobal | None) -> bool:
    if home is None or home.lat is None or home.lon is None or home.alt is None:
        return False
    try:
        distance_deg = max(abs(cmd.x - home.lat), abs(cmd.y - home.lon) * math.cos(math.radians(home.lat)))
        return bool(distance_deg <= HOME_TOLERANCE_DEG and abs(cmd.z - home.alt) <= HOME_TOLERANCE_M)
    except TypeError:  # A value is not a number. The upload will raise an error for it.
        return False


def _mission_of(commands: Sequence[Command], vehicle: AsyncVehicle) -> Mission:
    items: Iterable[MissionItem] = [_item_of(command, index) for index, command in enumerate(commands)]
    if not vehicle.autopilot.home_is_item_0:
        # For ArduPilot, coordinates 0, 0 mean the current position. Other autopilots need the actual coordinates.
        place = vehicle.telemetry.position.latest or vehicle.telemetry.home.latest
        items = convert_from_ardupilot(items, None if place is None else (place.latitude_deg, place.longitude_deg))
    return Mission(shift_jumps(items, -1))


def _commands_of(mission: Mission, own_ids: tuple[int, int]) -> tuple[Command, ...]:
    """Convert a mission to commands. The first is home, with zeros if home is unknown."""
    items = mission.to_items(home_is_item_0=True)
    return tuple(_command_of(item, seq, own_ids) for seq, item in enumerate(items))


def _item_of(cmd: Command, index: int) -> MissionItem:
    try:
        command, frame = int(cmd.command), int(cmd.frame)
        param1, param2, param3, param4 = (float(getattr(cmd, name)) for name in PARAM_FIELDS)
        x, y = (_wire_number(value, command, frame) for value in (cmd.x, cmd.y))
        z, autocontinue = float(cmd.z), bool(cmd.autocontinue)
        return MissionItem(command, frame, param1, param2, param3, param4, x, y, z, autocontinue)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidArgument(f"commands[{index}] is not allowed: {error}; the command is {cmd}") from None


def _wire_number(value: Any, command: int, frame: int) -> int | float:
    """Convert x or y for MISSION_ITEM_INT."""
    number = scaled_coordinate(float(value), command, frame)
    # Like ArduPilot, drop the fraction of parameters 5 and 6.
    # Infinity and numbers that are much too large stay floats, which the check of the plan refuses.
    return int(number) if isinstance(number, float) and abs(number) < 1e9 else number


def _command_of(item: MissionItem, seq: int, own_ids: tuple[int, int]) -> Command:
    # DroneKit's commands have the frames of MISSION_ITEM, which differ from those of MISSION_ITEM_INT.
    item = item.replace(frame=int(canonical_frame(item.frame)))
    own_system, own_component = own_ids
    message = to_wire_float(item, seq, target_system=own_system, target_component=own_component)
    return Command(*(getattr(message, name) for name in FIELDS))
