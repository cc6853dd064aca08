"""Where an ArduPilot is in its mission: which navigation command and which other command run, and what comes next.

Navigation commands follow each other; the other commands between two of them ("do" and "condition") are started one
after the other while the second of the two runs. The mode that flies the mission starts and verifies.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from aerokit.mavlink.enums import MavCmd, MissionState
from aerokit.mavlink.messages import MissionCurrent
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.ardupilot.mission_items import command_name

_C = MavCmd
_FIRST = 1
_MOST_JUMPS, _MOST_STEPS = 64, 255
_FOREVER = -1
_WITH_TARGET = frozenset({_C.DO_JUMP, _C.JUMP_TAG, _C.DO_JUMP_TAG})
_TAKE_OFFS = frozenset({_C.NAV_TAKEOFF, _C.NAV_VTOL_TAKEOFF})
_BEFORE_TAKE_OFF = frozenset({_C.DO_AUX_FUNCTION, _C.NAV_DELAY})
_NAVIGATION_BEYOND = frozenset({_C.NAV_SET_YAW_SPEED, _C.NAV_SCRIPT_TIME, _C.NAV_ATTITUDE_TIME})
_DONE_AT_ONCE = frozenset(
    {
        _C.DO_GRIPPER,
        _C.DO_SET_SERVO,
        _C.DO_SET_RELAY,
        _C.DO_REPEAT_SERVO,
        _C.DO_REPEAT_RELAY,
        _C.DO_DIGICAM_CONFIGURE,
        _C.DO_DIGICAM_CONTROL,
        _C.DO_SET_CAM_TRIGG_DIST,
        _C.DO_PARACHUTE,
        _C.DO_SEND_SCRIPT_MESSAGE,
        _C.DO_SPRAYER,
        _C.DO_AUX_FUNCTION,
        _C.DO_SET_RESUME_REPEAT_DIST,
        _C.DO_GIMBAL_MANAGER_PITCHYAW,
        _C.JUMP_TAG,
        _C.IMAGE_START_CAPTURE,
        _C.IMAGE_STOP_CAPTURE,
        _C.SET_CAMERA_ZOOM,
        _C.SET_CAMERA_FOCUS,
        _C.SET_CAMERA_SOURCE,
        _C.VIDEO_START_CAPTURE,
        _C.VIDEO_STOP_CAPTURE,
    }
)
"""Commands that every vehicle carries out in passing: nothing is flown, nobody is told."""


class MissionFlyer(Protocol):
    """The mode that carries commands out."""

    is_paused: bool
    """Whether somebody stopped it on its way."""

    def start_command(self, index: int, item: MissionItem) -> bool:
        """Begin; False when this vehicle cannot, and the next one is to be tried."""
        ...

    def is_complete(self, index: int, item: MissionItem) -> bool:
        """Whether it is done; called again and again."""
        ...

    def end_mission(self) -> None:
        """There is nothing more to do."""
        ...


def is_navigation(item: MissionItem) -> bool:
    """Whether a command leads somewhere, and so ends what the one before it did."""
    return item.command <= _C.NAV_LAST or item.command in _NAVIGATION_BEYOND


class MissionRun:
    """The position in the mission. An index counts home, so 1 is the first command and 0 means none."""

    def __init__(self, vehicle: Host, flyer: MissionFlyer) -> None:
        self._vehicle, self._flyer = vehicle, flyer
        self._list = vehicle.missions.commands
        self._state = MissionState.NOT_STARTED
        self.nav_index: int = 0
        """The navigation command that runs, or is to be resumed."""
        self._nav: MissionItem | None = None
        self._do: tuple[int, MissionItem] | None = None
        self._do_index = 0
        self._jumps: dict[int, int] = {}

    @property
    def is_present(self) -> bool:
        """Whether there is more than home."""
        return self._list.count > 1

    @property
    def is_running(self) -> bool:
        """Whether commands are being carried out."""
        return self._state == MissionState.ACTIVE

    @property
    def is_being_flown(self) -> bool:
        """Running with the motors armed: the mission cannot be cleared."""
        return self.is_running and self._vehicle.motors.is_armed

    @property
    def state(self) -> int:
        """MISSION_STATE, as MISSION_CURRENT has it."""
        if not self.is_present:
            return MissionState.NO_MISSION
        return MissionState.PAUSED if self.is_running and self._flyer.is_paused else self._state

    @property
    def count(self) -> int:
        """Commands without home."""
        return max(0, self._list.count - 1)

    def message(self, seq: int | None = None) -> MissionCurrent:
        """MISSION_CURRENT; ``seq`` says another number than that of the command that is flown."""
        seq = self.nav_index if seq is None else seq
        return MissionCurrent(seq, self.count, self.state, int(self._vehicle.mode.needs_mission))

    def starts_with_take_off(self) -> bool:
        begin = _FIRST if self._restarts or not self.nav_index else self.nav_index
        return self.is_take_off(begin)

    def is_take_off(self, index: int) -> bool:
        """Whether a take-off is the first thing from there on, apart from waiting."""
        for _, item in self.navigation_from(index):
            if item.command not in _BEFORE_TAKE_OFF:
                return item.command in _TAKE_OFFS
        return False

    def navigation_from(self, index: int) -> Iterator[tuple[int, MissionItem]]:
        """The next navigation commands, jumps followed; at most sixteen."""
        for _ in range(16):
            found = self._next(index, counts=False)
            while found is not None and not is_navigation(found[1]):
                found = self._next(found[0] + 1, counts=False)
            if found is None:
                return
            yield found
            index = found[0] + 1

    @property
    def _restarts(self) -> bool:
        return self._vehicle.parameters["MIS_RESTART"] == 1

    def start_or_resume(self) -> None:
        """As MIS_RESTART wants it."""
        has_place = self._state != MissionState.COMPLETE and self._list.command(self.nav_index) is not None
        if self._restarts or not has_place:
            self._start()
        else:
            self._state = MissionState.ACTIVE
            self.set_current(self._do[0] if self._do is not None else self.nav_index)

    def _start(self) -> None:
        self._state = MissionState.ACTIVE
        self.reset()
        if not self._advance():
            self._complete()

    def stop(self) -> None:
        """Another mode takes over; the place in the mission is remembered."""
        if self.is_running:
            self._state = MissionState.NOT_STARTED

    def reset(self) -> None:
        """Forget the place and how often was jumped, as disarming does."""
        self.nav_index, self._nav, self._do, self._do_index = 0, None, None, 0
        self._jumps.clear()

    def clear(self) -> None:
        """There is no mission any more."""
        self.reset()
        self._state = MissionState.NOT_STARTED

    def set_current(self, index: int) -> bool:
        """Go on from this command; False when there is none."""
        if index >= self._list.count or self._list.count == 1:
            return False
        self._do, self._do_index, self._nav = None, 0, None
        if index == 0 or self._state == MissionState.COMPLETE:
            self._jumps.clear()
        index = max(index, _FIRST)
        if self.is_running:
            done = self._advance(index)
            if not done:
                self._complete()
            return done
        return self._set_place(index)

    def _set_place(self, index: int) -> bool:
        """Where a stopped mission is to be resumed."""
        while True:
            found = self._next(index, counts=True)
            if found is None:
                self.nav_index = 0
                return False
            if is_navigation(found[1]):
                self.nav_index, self._nav = found
                self._state = MissionState.NOT_STARTED
                return True
            if self._do is None:
                self._do, self._do_index = found, found[0]
            index = found[0] + 1

    def update(self) -> None:
        """Look at what runs and start what comes next."""
        if not self.is_running or not self._list.count:
            return
        if self._nav is None or self._is_complete(self.nav_index, self._nav):
            self._nav = None
            if not self._advance():
                self._complete()
                return
        if self._do is None:
            self._advance_do()
        elif self._is_complete(*self._do):
            self._do = None

    def _advance(self, start: int = 0) -> bool:
        """Start the next navigation command, and the first other command before it."""
        index = start or (self.nav_index + 1 if self.nav_index else _FIRST)
        self._do, self._do_index = None, 0
        for _ in range(_MOST_STEPS):
            found = self._next(index, counts=True)
            if found is None:
                return False
            index = found[0] + 1
            if is_navigation(found[1]):
                self.nav_index = found[0]
                if self._begin(*found):
                    self._nav = found[1]
                    return True
            elif self._do is None:
                self._do, self._do_index = found, found[0]
                self._begin(*found)
        return False

    def _advance_do(self) -> None:
        """Start the next command that is no navigation, of those before the next navigation command."""
        if not self._do_index:
            return
        found = self._next(self._do_index + 1, counts=False)
        if found is None or is_navigation(found[1]):
            self._do_index = 0
            return
        self._do, self._do_index = found, found[0]
        self._begin(*found)

    def _begin(self, index: int, item: MissionItem) -> bool:
        name = command_name(item.command)
        target = f" {item.param1:.0f}" if item.command in _WITH_TARGET else ""
        self._vehicle.info(f"Mission: {index} {name}{target}")
        self._vehicle.camera.run(item)
        return item.command in _DONE_AT_ONCE or self._flyer.start_command(index, item)

    def _is_complete(self, index: int, item: MissionItem) -> bool:
        return item.command in _DONE_AT_ONCE or self._flyer.is_complete(index, item)

    def _complete(self) -> None:
        self._state = MissionState.COMPLETE
        self._flyer.end_mission()

    def _next(self, index: int, *, counts: bool) -> tuple[int, MissionItem] | None:
        """The first command at or after ``index`` that is no jump; jumps are followed, and counted when told so."""
        first_jump = 0
        for _ in range(_MOST_JUMPS):
            while (item := self._list.command(index)) is not None and item.command not in (
                _C.DO_JUMP,
                _C.DO_JUMP_TAG,
            ):
                return index, item
            if item is None:
                return None
            target = self._target(item)
            if self._list.command(target) is None or (not counts and first_jump == index):
                return None
            first_jump = first_jump or index
            index = target if self._jump(index, int(item.param2), counts=counts) else index + 1
        return None

    def _target(self, item: MissionItem) -> int:
        if item.command == _C.DO_JUMP:
            return int(item.param1)
        for index in range(_FIRST, self._list.count):
            tag = self._list.command(index)
            if tag is not None and tag.command == _C.JUMP_TAG and tag.param1 == item.param1:
                return index
        return 0

    def _jump(self, index: int, times: int, *, counts: bool) -> bool:
        """Whether this jump is to be made once more."""
        done = self._jumps.get(index, 0)
        if times != _FOREVER and done >= times:
            if counts:
                self._jumps.pop(index, None)
            return False
        if counts:
            self._jumps[index] = done + 1
            of = "unlimited" if times == _FOREVER else str(times)
            self._vehicle.info(f"Mission: {index} Jump {done + 1}/{of}")
        return True
