"""Execution of a mission by a simulated ArduPilot (AP_Mission).

Navigation commands run one after the other. "Do" and "condition" commands run together with the navigation command
that follows them. The mode that flies the mission starts commands and checks their completion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import MavSeverity, MissionState
from aerokit.mavlink.messages import MissionCurrent
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.camera import ArduPilotCamera
from aerokit.sim.ardupilot.host import ArduPilotHost, ArduPilotMode
from aerokit.sim.ardupilot.mission_items import command_name
from aerokit.sim.motion import Ned

_FIRST = 1
_MAX_JUMPS, _MAX_STEPS, _MAX_LOOK_AHEAD = 64, 255, 16
_UNLIMITED = -1
_WITH_TARGET = frozenset({Cmd.DO_JUMP, Cmd.JUMP_TAG, Cmd.DO_JUMP_TAG})
TAKE_OFFS = frozenset({Cmd.NAV_TAKEOFF, Cmd.NAV_VTOL_TAKEOFF})
_BEFORE_TAKE_OFF = frozenset({Cmd.DO_AUX_FUNCTION, Cmd.NAV_DELAY})
# Navigation commands with a number above NAV_LAST.
_NAVIGATION_ABOVE_LAST = frozenset({Cmd.NAV_SET_YAW_SPEED, Cmd.NAV_SCRIPT_TIME, Cmd.NAV_ATTITUDE_TIME})
# Commands that every vehicle supports, and that are complete as soon as they have started.
_INSTANT = frozenset(
    {
        Cmd.DO_GRIPPER, Cmd.DO_SET_SERVO, Cmd.DO_SET_RELAY, Cmd.DO_REPEAT_SERVO, Cmd.DO_REPEAT_RELAY,
        Cmd.DO_DIGICAM_CONFIGURE, Cmd.DO_DIGICAM_CONTROL, Cmd.DO_SET_CAM_TRIGG_DIST, Cmd.DO_PARACHUTE,
        Cmd.DO_SEND_SCRIPT_MESSAGE, Cmd.DO_SPRAYER, Cmd.DO_AUX_FUNCTION, Cmd.DO_SET_RESUME_REPEAT_DIST,
        Cmd.DO_GIMBAL_MANAGER_PITCHYAW, Cmd.JUMP_TAG, Cmd.IMAGE_START_CAPTURE, Cmd.IMAGE_STOP_CAPTURE,
        Cmd.SET_CAMERA_ZOOM, Cmd.SET_CAMERA_FOCUS, Cmd.SET_CAMERA_SOURCE, Cmd.VIDEO_START_CAPTURE,
        Cmd.VIDEO_STOP_CAPTURE,
    }
)  # fmt: skip


class MissionCommand(NamedTuple):
    """A command of the mission; ``seq`` is its index in the list."""

    seq: int
    item: MissionItem


class SupportedCommand(NamedTuple):
    """How a mode executes a mission command. By default, the command does nothing and is complete at once."""

    start: Callable[[MissionItem], None] = lambda _: None
    is_done: Callable[[int, MissionItem], bool] = lambda _index, _item: True
    """Called at every tick with the index of the command and the command. Returns True once it is complete."""


def never(_index: int, _item: MissionItem) -> bool:
    return False


class MissionMode(ArduPilotMode):
    """Base of the AUTO modes. A subclass adds the mission commands that it supports to ``commands``."""

    needs_mission = True
    can_change_speed = True

    def __init__(self, vehicle: ArduPilotHost) -> None:
        super().__init__(vehicle)
        self.speed: float = 0.0  # Maximum speed in m/s.
        self.may_lift_off: bool = False
        """True once MISSION_START or a raised throttle permits a take-off from the ground."""
        self.is_paused: bool = False
        self.is_waiting_for_origin: bool = False  # True until the mission starts, which needs the estimator's origin
        self._condition_started_at = 0.0
        self.commands: dict[int, SupportedCommand] = {
            Cmd.CONDITION_DELAY: SupportedCommand(self._wait, self._has_waited),
            Cmd.DO_SET_HOME: SupportedCommand(self._set_home),
            Cmd.DO_FENCE_ENABLE: SupportedCommand(),
        }

    def on_disarmed(self) -> None:
        # Disarming has reset the progress. `update` starts the first command, which waits until the vehicle is armed.
        if self.vehicle.mode is self:
            self.vehicle.mission.update()

    def leave(self) -> None:
        self.is_waiting_for_origin = False
        self.vehicle.mission.stop()

    def wait_for_origin(self) -> None:
        """Start the mission as soon as the estimator has an origin."""
        self.is_waiting_for_origin = True
        self.vehicle.call_later(0.0, self.start_if_origin_known)

    def start_if_origin_known(self) -> None:
        vehicle = self.vehicle
        if self.is_waiting_for_origin and vehicle.mode is self and vehicle.navigation.origin is not None:
            self.is_waiting_for_origin = False
            vehicle.mission.start_or_resume()
            self.on_mission_started()

    def on_mission_started(self) -> None: ...

    @property
    def distance_to_destination(self) -> float:
        """Horizontal distance in metres; 0 without a destination."""
        return 0.0 if self.destination is None else self.vehicle.motion.distance_to(self.destination)

    def is_complete(self, index: int, item: MissionItem) -> bool:
        """Return True as soon as the command is complete. Called at every tick."""
        raise NotImplementedError

    def end_mission(self) -> None:
        """Called after the last command."""
        raise NotImplementedError

    def start_command(self, item: MissionItem) -> bool:
        """Start a mission command. Return False to skip a command that is not supported."""
        command = self.commands.get(item.command)
        if command is not None:
            command.start(item)
        return command is not None

    def _is_done(self, index: int, item: MissionItem) -> bool:
        if item.command not in self.commands:
            self.vehicle.send_text(MavSeverity.WARNING, f"Skipping invalid cmd #{item.command}")
            return True
        return self.commands[item.command].is_done(index, item)

    def _wait(self, item: MissionItem) -> None:
        self._condition_started_at = self.vehicle.now

    def _has_waited(self, _index: int, item: MissionItem) -> bool:
        return bool(self.vehicle.now - self._condition_started_at > max(0.0, item.param1))

    def _set_home(self, item: MissionItem) -> None:
        vehicle = self.vehicle
        # On Plane, unlike on the other vehicles, the coordinates 0, 0, 0 are an ordinary position.
        has_no_place = (item.x, item.y, item.z) == (0, 0, 0) and vehicle.KIND != "plane"
        point: Ned | None = vehicle.motion.place
        if item.param1 != 1 and not has_no_place:
            point = vehicle.world_point(int(item.x), int(item.y), item.z, item.frame)
        if point is not None:
            vehicle.navigation.set_home(point, lock=False)


def is_navigation(item: MissionItem) -> bool:
    return item.command <= Cmd.NAV_LAST or item.command in _NAVIGATION_ABOVE_LAST


class MissionRun:
    """Progress in the mission. The first command has the index 1. The index 0 (home) means that there is no command."""

    def __init__(self, vehicle: ArduPilotHost, mode: MissionMode, camera: ArduPilotCamera) -> None:
        self._vehicle, self._mode, self._camera = vehicle, mode, camera
        self._list = vehicle.missions.commands
        self._state = MissionState.NOT_STARTED
        self.nav_index: int = 0  # Index of the navigation command that runs or will be resumed.
        self._running_nav: MissionItem | None = None  # The running navigation command.
        self._running_do: MissionCommand | None = None  # The running "do" or "condition" command.
        self._last_do_index = 0  # Index of the "do" or "condition" command that was started last; 0 if none.
        self._jumps: dict[int, int] = {}  # Number of jumps that each jump command has done, by its index.

    @property
    def is_present(self) -> bool:
        return self._list.count > 1  # Item 0 is home.

    @property
    def is_running(self) -> bool:
        return self._state == MissionState.ACTIVE

    def message(self, seq: int | None = None) -> MissionCurrent:
        seq = self.nav_index if seq is None else seq
        total = max(0, self._list.count - 1)  # Home does not count.
        state = MissionState.PAUSED if self.is_running and self._mode.is_paused else self._state
        if not self.is_present:
            state = MissionState.NO_MISSION
        return MissionCurrent(seq, total, state, int(self._vehicle.mode.needs_mission))

    def starts_with_take_off(self) -> bool:
        is_resumed = self.nav_index != 0 and not self._restarts
        return self.is_take_off(self.nav_index if is_resumed else _FIRST)

    def is_take_off(self, index: int) -> bool:
        """Return True if the first navigation command from ``index`` on is a take-off. Delays are skipped."""
        for _, item in self.navigation_from(index):
            if item.command not in _BEFORE_TAKE_OFF:
                return item.command in TAKE_OFFS
        return False

    def navigation_from(self, index: int) -> Iterator[MissionCommand]:
        """Yield the next navigation commands in the order of execution, with jumps."""
        for _ in range(_MAX_LOOK_AHEAD):  # Jumps may form an endless loop.
            command = self._next_navigation(index)
            if command is None:
                return
            yield command
            index = command.seq + 1

    def _next_navigation(self, index: int) -> MissionCommand | None:
        for _ in range(1 + _MAX_STEPS):
            command = self._next_command(index, count_jumps=False)
            if command is None or is_navigation(command.item):
                return command
            index = command.seq + 1
        return None

    @property
    def _restarts(self) -> bool:
        return self._vehicle.parameters["MIS_RESTART"] == 1

    def start_or_resume(self) -> None:
        """Start the mission again or resume it, as MIS_RESTART selects."""
        can_resume = self._state != MissionState.COMPLETE and self._list.command(self.nav_index) is not None
        self._state = MissionState.ACTIVE
        if self._restarts or not can_resume:
            self.reset()
            self._start_next_navigation()
        else:
            # A running "do" command precedes the navigation command, so the mission resumes at the "do" command.
            resume_index = self.nav_index if self._running_do is None else self._running_do.seq
            self.set_current(resume_index)

    def stop(self) -> None:
        """Stop the mission. `start_or_resume` can resume it."""
        if self.is_running:
            self._state = MissionState.NOT_STARTED

    def reset(self) -> None:
        self.nav_index = 0
        self._forget_running()
        self._jumps.clear()

    def _forget_running(self) -> None:
        self._running_nav = self._running_do = None
        self._last_do_index = 0

    def on_disarmed(self) -> None:
        self.reset()
        self._vehicle.call_later(0.0, self._mode.on_disarmed)

    def on_cleared(self) -> None:
        self.reset()
        self._state = MissionState.NOT_STARTED

    def set_current(self, index: int) -> bool:
        """Continue the mission at the command with this index. Return False if there is no such command."""
        has_only_home = self._list.count == 1
        if index >= self._list.count or has_only_home:
            return False
        self._forget_running()
        if index == 0 or self._state == MissionState.COMPLETE:
            self._jumps.clear()
        index = max(index, _FIRST)
        if self.is_running:
            return self._start_next_navigation(index)
        return self._set_resume_index(index)

    def _set_resume_index(self, index: int) -> bool:
        """Let a stopped mission resume at the first navigation command from ``index`` on.

        Return False if there is no such command.
        """
        for _ in range(_MAX_STEPS):
            command = self._next_command(index, count_jumps=True)
            if command is None:
                break
            if is_navigation(command.item):
                self.nav_index = command.seq
                self._running_nav = command.item
                self._state = MissionState.NOT_STARTED  # A mission that is COMPLETE cannot be resumed.
                return True
            if self._running_do is None:
                # The mission resumes at the first "do" command in front of the navigation command.
                self._running_do = command
                self._last_do_index = command.seq
            index = command.seq + 1
        self.nav_index = 0
        return False

    def update(self) -> None:
        if not self.is_running or not self._list.count:
            return
        if self._running_nav is None or self._is_complete(self.nav_index, self._running_nav):
            self._running_nav = None
            if not self._start_next_navigation():
                return
        if self._running_do is None:
            self._start_next_do()
        elif self._is_complete(*self._running_do):
            self._running_do = None

    def _start_next_navigation(self, start: int = 0) -> bool:
        """Start the next navigation command. If there is none, end the mission and return False.

        The search begins at the index ``start``, or after the current command if ``start`` is 0.
        """
        index_after_current = self.nav_index + 1 if self.nav_index else _FIRST
        index = start or index_after_current
        self._running_do = None
        self._last_do_index = 0
        for _ in range(_MAX_STEPS):
            command = self._next_command(index, count_jumps=True)
            if command is None:
                break
            index = command.seq + 1
            if is_navigation(command.item):
                self.nav_index = command.seq
                is_supported = self._start_command(*command)
                if is_supported:  # An unsupported command is skipped.
                    self._running_nav = command.item
                    return True
            elif self._running_do is None:
                self._start_do(command)
        self._state = MissionState.COMPLETE
        self._mode.end_mission()
        return False

    def _start_next_do(self) -> None:
        if not self._last_do_index:  # No further "do" command belongs to the running navigation command.
            return
        command = self._next_command(self._last_do_index + 1, count_jumps=False)
        if command is None or is_navigation(command.item):
            self._last_do_index = 0
            return
        self._start_do(command)

    def _start_do(self, command: MissionCommand) -> None:
        self._running_do = command
        self._last_do_index = command.seq
        self._start_command(*command)

    def _start_command(self, index: int, item: MissionItem) -> bool:
        """Start a command. Return False if the vehicle does not support it."""
        name = command_name(item.command)
        target = f" {item.param1:.0f}" if item.command in _WITH_TARGET else ""
        self._vehicle.info(f"Mission: {index} {name}{target}")
        self._camera.run(item)
        return item.command in _INSTANT or self._mode.start_command(item)

    def _is_complete(self, index: int, item: MissionItem) -> bool:
        return item.command in _INSTANT or self._mode.is_complete(index, item)

    def _next_command(self, index: int, *, count_jumps: bool) -> MissionCommand | None:
        """Return the first command at or after ``index``. Jump commands are followed, not returned.

        With ``count_jumps``, each followed jump uses up one of its repetitions.
        """
        first_jump = 0  # Index of the first jump command that was followed; 0 before that.
        for _ in range(_MAX_JUMPS):
            item = self._list.command(index)
            if item is None:
                return None
            if item.command not in (Cmd.DO_JUMP, Cmd.DO_JUMP_TAG):
                return MissionCommand(index, item)
            target = self._jump_target(item)
            # Without `count_jumps`, no jump is used up, so the loop is endless if the first jump is reached again.
            is_endless = not count_jumps and first_jump == index
            if self._list.command(target) is None or is_endless:
                return None
            first_jump = first_jump or index
            has_jumps_left = self._use_jump(index, times=int(item.param2), count_jumps=count_jumps)
            index = target if has_jumps_left else index + 1
        return None

    def _jump_target(self, item: MissionItem) -> int:
        """Return the index to which a jump command leads, or 0 if its tag does not exist."""
        if item.command == Cmd.DO_JUMP:
            return int(item.param1)
        for index in range(_FIRST, self._list.count):
            target = self._list.command(index)
            if target is not None and (target.command, target.param1) == (Cmd.JUMP_TAG, item.param1):
                return index
        return 0

    def _use_jump(self, index: int, *, times: int, count_jumps: bool) -> bool:
        """Return True if the jump command at ``index`` has repetitions left.

        With ``count_jumps``, use up one of them.
        """
        jumps_done = self._jumps.get(index, 0)
        if times != _UNLIMITED and jumps_done >= times:
            if count_jumps:
                # Reset the count, because the next execution of this command again jumps ``times`` times.
                self._jumps.pop(index, None)
            return False
        if count_jumps:
            self._jumps[index] = jumps_done + 1
            total = "unlimited" if times == _UNLIMITED else str(times)
            self._vehicle.info(f"Mission: {index} Jump {jumps_done + 1}/{total}")
        return True


def place_of(vehicle: ArduPilotHost, item: MissionItem, current: Ned) -> Ned:
    """Return the place of an item. ``current`` replaces coordinates or an altitude of 0, and an invalid place."""
    north, east, down = vehicle.world_point(int(item.x), int(item.y), item.z, item.frame) or current
    if (item.x, item.y) == (0, 0):
        north, east, _ = current
    if item.z == 0:
        _, _, down = current
    return (north, east, down)
