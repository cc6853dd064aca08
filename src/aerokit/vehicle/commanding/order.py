"""Orders of the program to one vehicle: whether each is still the newest, and whether it may be sent again.

docs/reliability.md has the table of all orders; nothing is sent again that is not in it.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any, Literal

from aerokit.mavlink.enums import MavCmd, MavState

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from typing import TypeAlias

    from aerokit.autopilots import Mode
    from aerokit.mavlink.message import Message

Subject = Literal["mode", "motion", "arm"]
"""What an order to the vehicle itself is about."""
Topic: TypeAlias = Hashable
"""What an order is about: a subject of the vehicle, or any key for a device: a camera's video, a gimbal."""

LOOKING: Topic = "region of interest"
"""What the autopilot's gimbal, or the nose, looks at."""

OVERRULED = "another order was given"
"""Why an older order ends."""

_MODE: tuple[Subject, ...] = ("mode", "motion")
_MOTION: tuple[Subject, ...] = ("motion",)
ARM_ALONE: tuple[Subject, ...] = ("arm",)
CHANGED_BY_COMMAND: Mapping[int, tuple[Subject, ...]] = {
    MavCmd.NAV_RETURN_TO_LAUNCH: _MODE,
    MavCmd.NAV_LAND: _MODE,
    MavCmd.NAV_VTOL_TAKEOFF: _MODE,
    MavCmd.NAV_VTOL_LAND: _MODE,
    MavCmd.DO_SET_MODE: _MODE,
    MavCmd.DO_FLIGHTTERMINATION: _MODE,
    MavCmd.OVERRIDE_GOTO: _MODE,
    MavCmd.MISSION_START: _MODE,
    MavCmd.NAV_WAYPOINT: _MOTION,
    MavCmd.NAV_LOITER_UNLIM: _MOTION,
    MavCmd.NAV_LOITER_TURNS: _MOTION,
    MavCmd.NAV_LOITER_TIME: _MOTION,
    MavCmd.NAV_TAKEOFF: _MOTION,
    MavCmd.DO_ORBIT: _MOTION,
    MavCmd.DO_REPOSITION: _MOTION,
    MavCmd.DO_PAUSE_CONTINUE: _MOTION,
    MavCmd.COMPONENT_ARM_DISARM: ARM_ALONE,
}
"""MAV_CMD → what a program changes that sends it by itself: what an action left to be done must not come after it."""
CHANGED_BY_MESSAGE: Mapping[str, tuple[Subject, ...]] = {
    "SET_MODE": _MODE,
    "SET_ATTITUDE_TARGET": _MOTION,
    "SET_POSITION_TARGET_LOCAL_NED": _MOTION,
    "SET_POSITION_TARGET_GLOBAL_INT": _MOTION,
    "MISSION_SET_CURRENT": _MOTION,
}
FAILSAFE_STATES = (MavState.CRITICAL, MavState.EMERGENCY, MavState.FLIGHT_TERMINATION)
"""HEARTBEAT.system_status while a failsafe is active. PX4 tells it seconds before the failsafe changes the mode
(COM_FAIL_ACT_T), and an order that arrives in that time cancels the failsafe."""
GUIDED_ITEM = (2, 3)
"""MISSION_ITEM.current of one that is flown to at once."""
QUESTIONS = frozenset(
    (
        MavCmd.RUN_PREARM_CHECKS,
        MavCmd.GET_MESSAGE_INTERVAL,
        MavCmd.SET_MESSAGE_INTERVAL,
        MavCmd.REQUEST_MESSAGE,
        MavCmd.REQUEST_PROTOCOL_VERSION,
        MavCmd.REQUEST_AUTOPILOT_CAPABILITIES,
        MavCmd.REQUEST_CAMERA_INFORMATION,
        MavCmd.REQUEST_CAMERA_SETTINGS,
        MavCmd.REQUEST_STORAGE_INFORMATION,
        MavCmd.REQUEST_CAMERA_CAPTURE_STATUS,
        MavCmd.REQUEST_FLIGHT_INFORMATION,
    )
)
"""MAV_CMDs that ask for something and change nothing but streams: they are sent again until they are answered."""


def subjects_of(message: Message) -> tuple[Subject, ...]:
    """What a program changes that sends this message by itself."""
    fields: Any = message
    if message.NAME in ("COMMAND_LONG", "COMMAND_INT"):
        return CHANGED_BY_COMMAND.get(fields.command, ())
    if message.NAME in ("MISSION_ITEM", "MISSION_ITEM_INT"):
        return _MOTION if fields.current in GUIDED_ITEM else ()
    return CHANGED_BY_MESSAGE.get(message.NAME, ())


def is_worse(state: int, before: int | None) -> bool:
    """Whether a failsafe is active in this MAV_STATE that was not in the one before, or a worse one."""
    is_first = before is None or before not in FAILSAFE_STATES
    return state in FAILSAFE_STATES and (is_first or state > (before or 0))


def failsafe_text(state: int) -> str:
    """A clause for error texts."""
    name = MavState(state).name
    return f"a failsafe became active (MAV_STATE_{name}): the vehicle is left to it, and not told to hold"


class Order:
    """One order of the program, from when it is given until it is done, overruled or taken over.

    A newer order about any of the topics in ``ended_by`` overrules it. If the arbiter has it watch the vehicle,
    somebody else's doing ends it, too: a mode that it does not explain, a failsafe, disarming, a reboot. That is for
    good, also if the mode comes back.

    ``mode_before`` is the mode that it was given in, ``modes`` are those that it may bring about, ``expected`` others
    that may still be told because the program had ordered them just before, and until ``settles_at`` in any order;
    until ``any_until`` every mode may, since the program had sent an order of its own making. Any other mode is a
    pilot's or a failsafe's doing. ``settles_by_change``: being in one of its modes already does not say that the
    expected ones are over, only a change to it does.
    """

    def __init__(
        self,
        given_at: float,
        number: int,
        is_newest: Callable[[Order], bool],
        *,
        ended_by: Collection[Topic] = (),
        modes: Collection[Mode] = (),
        armed: bool | None = None,
        mode_before: Mode | None = None,
        expected: Collection[int] = (),
        armed_before: bool | None = None,
        state_before: int | None = None,
        settles_at: float = -math.inf,
        any_until: float = -math.inf,
        ends_flight: bool = False,
        minds_mode: bool = True,
        minds_disarming: bool = True,
        settles_by_change: bool = False,
    ) -> None:
        self.given_at: float = given_at
        self.number: int = number
        self.ended_by: tuple[Topic, ...] = tuple(ended_by)
        self.modes: tuple[Mode, ...] = tuple(modes)
        self.armed = armed
        """Whether it arms or disarms; None: neither."""
        self.is_given = False
        """Whether the vehicle may move by it, or moves by what the program had ordered before: given up, it is held."""
        self.was_refused: bool = False
        """Whether the vehicle has said no to it: it does what it did before."""
        self.was_flown_before: bool = False
        """Whether the vehicle did what this program had ordered before."""
        self.before: Order | None = None
        """The one about the same device that counts again when this one is withdrawn."""
        self.is_withdrawn: bool = False
        self.taken_by: str = ""
        """What somebody else has done, as a clause; empty: nothing that was told."""
        self.failsafe: str = ""
        """Which failsafe has become active since, as a clause; empty: none."""
        self.unexplained: str = ""
        """A change of mode, as a clause: the effect of a command of the program, or a pilot's doing."""
        self.has_lost_mode: bool = False
        """Whether that was another mode."""
        self.mode_lost_at: float = -math.inf
        """When that was told: by CURRENT_MODE sooner than by the HEARTBEAT that may say that it has disarmed, too."""
        self.has_worked: bool = False
        """Whether a change to one of its modes, or to armed or disarmed as it orders, has been told since."""
        self._before = set() if mode_before is None else {mode_before.custom_mode} - set(expected)
        self._mode_now = None if mode_before is None else mode_before.custom_mode
        self._late = set(expected)
        self._allowed = self._before | self._late
        self._own = {mode.custom_mode for mode in modes}
        self._armed_now = armed_before
        self._state_before, self._ends_flight = state_before, ends_flight
        self._minds_mode, self._minds_disarming = minds_mode, minds_disarming
        self._is_newest = is_newest
        self._settles_at, self._any_until = settles_at, any_until
        self._settles_by_change = settles_by_change

    @property
    def is_newest(self) -> bool:
        """Whether no newer order overrules it."""
        return self._is_newest(self)

    @property
    def end(self) -> str:
        """Why nothing of it may be sent any more, as a clause; empty while it may."""
        if not self.is_newest:
            return OVERRULED
        return self.taken_by or ("" if self._ends_flight else self.failsafe)

    def is_own(self, mode: Mode) -> bool:
        """Whether this mode is one that the order may bring about."""
        return mode.custom_mode in self._own

    def expect(self, modes: Collection[Mode]) -> None:
        """The program has given an order beside it that brings these about."""
        self._own |= {mode.custom_mode for mode in modes}

    def withdraw(self) -> None:
        """It was refused, or never accepted: the one before about the same device counts again."""
        self.is_withdrawn = True

    def settle(self) -> None:
        """It was accepted, or is told to end: there is no way back to the one before."""
        self.before = None

    def close(self) -> None:
        """The block in which it was given is left."""
        self.taken_by = self.taken_by or "its block was left"

    def forgive_failsafe(self) -> None:
        """The program orders the vehicle again, which is still in a mode of this order."""
        self.failsafe = ""

    # ------------------------------------------------------------------- what the vehicle tells

    def note_mode(self, mode: Mode, at: float) -> None:
        """The vehicle tells its mode. Once it was in one of the order's, the mode before is somebody else's, too."""
        number, is_known = mode.custom_mode, self._mode_now is not None
        is_change = is_known and number != self._mode_now
        self.has_worked = self.has_worked or (is_change and number in self._own)
        if number in self._own:
            if is_change or not self._settles_by_change:
                self._allowed -= self._allowed if at >= self._settles_at else self._before
        elif number in self._late & self._allowed and at >= self._settles_at:
            self._allowed -= self._before
        elif not is_known or at < self._any_until:
            if is_known and number not in self._allowed:
                self.unexplained = f"the mode changed to {mode}"
            self._allowed.add(number)
        elif number not in self._allowed and self._minds_mode:
            if not self.has_lost_mode:
                self.mode_lost_at = at
            self.has_lost_mode = True
            self.taken_by = self.taken_by or f"the mode changed to {mode}"
        self._mode_now = number

    def note_state(self, state: int) -> None:
        """Take MAV_STATE. A failsafe that was active when the order was given does not end it: the program knew it.

        Nor does any end an order to land, to return or to disarm: it is sent again if need be.
        """
        if is_worse(state, self._state_before):
            self.failsafe = self.failsafe or failsafe_text(state)
        self._state_before = state

    def note_armed(self, armed: bool, at: float) -> None:
        """The vehicle tells whether it is armed."""
        before, self._armed_now = self._armed_now, armed
        if before is not None and before is not armed and armed is self.armed:
            self.has_worked = True
        elif before and not armed and self._minds_disarming:
            self.taken_by = self.taken_by or "the vehicle disarmed"

    def note_reboot(self) -> None:
        """The vehicle has rebooted: nothing that was ordered before is meant any more."""
        self.taken_by = self.taken_by or "the vehicle rebooted"


class SentCommand:
    """One command of an order, from its first sending on: whether it may be sent again.

    It may while what was heard since speaks neither of its effect nor of somebody else's doing. A change to one of
    ``modes``, or to ``armed``, is an effect that HEARTBEAT tells; ``is_done`` tells any other one.
    """

    def __init__(
        self,
        order: Order,
        *,
        mode_now: Mode | None,
        armed_now: bool | None,
        modes: Collection[Mode] = (),
        armed: bool | None = None,
        is_done: Callable[[], bool] = lambda: False,
    ) -> None:
        self.order = order
        self.told_at: float = -math.inf
        """When HEARTBEAT came last."""
        self._was_told = False
        self._mode_now = None if mode_now is None else mode_now.custom_mode
        self._modes = {mode.custom_mode for mode in modes}
        self._armed_now = armed_now
        self.arms = armed
        """Whether it arms, or disarms; None: neither."""
        self._is_overruled = False
        self._is_done = is_done

    @property
    def has_worked(self) -> bool:
        """Whether its effect has been told, whatever came after it."""
        self._was_told = self._was_told or self._is_done()
        return self._was_told

    @property
    def end(self) -> str:
        """Why it must not be sent again, as a clause; empty while it may."""
        if self.has_worked:
            return "its effect was told"
        return self.order.end or (OVERRULED if self._is_overruled else "") or self.order.unexplained

    def note_newer(self, armed: bool | None) -> None:
        """Another command is given: one to disarm ends one to arm, and the other way round."""
        if armed is not None and self.arms is not None and armed is not self.arms:
            self._is_overruled = True

    def note_mode(self, mode: Mode, at: float) -> None:
        """The vehicle tells its mode."""
        before, self._mode_now = self._mode_now, mode.custom_mode
        self._was_told = self._was_told or (self._mode_now != before and self._mode_now in self._modes)

    def note_armed(self, armed: bool, at: float) -> None:
        """The vehicle tells whether it is armed, which ends a HEARTBEAT."""
        before, self._armed_now = self._armed_now, armed
        self._was_told = self._was_told or (armed is not before and armed is self.arms)
        self.told_at = at
