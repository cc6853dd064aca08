"""``vehicle.commands``: the mission of a vehicle, as DroneKit programs read and write it."""

from __future__ import annotations

import operator
import threading
from typing import TYPE_CHECKING, Any, overload

from aerokit.dronekit.command import (
    Command,
    command_from,
    commands_of,
    home_command,
    is_home_row,
    mission_of,
    values_of,
)
from aerokit.dronekit.core import core_of
from aerokit.dronekit.exceptions import APIException, TimeoutError, classic_errors  # noqa: A004 - DroneKit's name
from aerokit.errors import AerokitError, OperationTimeout
from aerokit.snapshot import Snapshot
from aerokit.sync.reply import reply_of

if TYPE_CHECKING:
    import concurrent.futures
    from collections.abc import Iterator

    from aerokit.dronekit.attributes import VehicleAttributes
    from aerokit.missions import Mission

__all__ = ["Command", "CommandSequence", "WaypointLoader"]


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
        self._download: concurrent.futures.Future[None] | None = None
        self._current = vehicle._dk_current_command

    # ------------------------------------------------------------------- from and to the vehicle

    def download(self) -> None:
        """Begin to read the vehicle's mission; :meth:`wait_ready` waits until it is there.

        Until then the sequence stays what it was. A download under way is begun anew. When it is there, listeners to
        ``'commands'`` are told; ``vehicle.home_location`` is set if the mission has it.

        Raises:
            APIException: the link is down.
        """
        self._core.check_link()
        with self._lock:
            self._downloads += 1
            self._core.ready.unmark("commands")
            self._download = self._core.order("commands.download", self._read, self._downloads)

    def wait_ready(self, **kwargs: Any) -> bool:
        """Wait for the end of the download; arguments and result as of :meth:`Vehicle.wait_ready`.

        Raises:
            APIException: the download failed; the text says why. The next one may succeed.
            TimeoutError: it has not ended in time, 30 seconds by default.
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
            LocalProtocolError: a ValueError; a command cannot be right. Nothing was sent.
        """
        self._settle()
        with self._lock:
            values = values_of(self._held.items)
            if not self._held.is_changed and values == self._uploaded:
                return
            held = self._held = self._held.replace(is_changed=True)  # until it is known to be there
        aio = self._core.check_link()
        self._core.run(aio.mission.upload, mission_of(held.items, aio), timeout=timeout)
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

        The first row of a waypoint file, which is home, is kept apart as such: vehicles have a home of their own.

        Args:
            cmd: a :class:`Command`, or a MISSION_ITEM of pymavlink. Its ``target_system`` becomes the vehicle's.

        Raises:
            TypeError: it is neither.
            APIException: the download before has failed, so that there is nothing to append to.
        """
        self._settle()
        added = command_from(cmd)
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
        command = value if isinstance(value, Command) else command_from(value)
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
        return (held.home or home_command(None, (0, 0)), *held.items)

    # ------------------------------------------------------------------------------- inside

    def _append(self, cmd: Command) -> int:
        """Append it, as home if that is what it is; returns its number."""
        with self._lock:
            held = self._held
            if not held.items and is_home_row(cmd, self._vehicle._home_location):
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
        items = commands_of(mission.items, own_ids)
        with self._lock:
            if number != self._downloads:
                return
            self._held = Held(items, home_command(home, own_ids))
            self._uploaded = values_of(items)
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
        """Command ``i``; 0 is home, all zeros when it is not known.

        Raises:
            IndexError: there is none.
        """
        return self._commands.rows()[i]


def _checked(index: Any, count: int) -> int:
    try:
        at = operator.index(index)
    except TypeError:
        raise TypeError("Invalid argument type.") from None
    if not -count <= at < count:
        raise IndexError(f"Index {at} out of range.")
    return at % count
