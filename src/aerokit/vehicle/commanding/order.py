"""Orders: what has been heard since one was given, and so whether it may be sent again or still be meant.

docs/reliability.md has the table of all orders; nothing is sent again that is not in it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

from aerokit.mavlink.enums import MavCmd, MavState

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from aerokit.autopilots import Mode
    from aerokit.mavlink.message import Message

__all__ = [
    "ARM_ALONE",
    "CHANGED_BY_COMMAND",
    "FAILSAFE_STATES",
    "QUESTIONS",
    "Order",
    "Sending",
    "Subject",
    "subjects_of",
]

Subject = Literal["mode", "motion", "arm"]
"""What an order is about."""

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

    ``mode_before`` is the mode that it was given in, ``modes`` are those that it may bring about, ``expected`` others
    that may still be told because the program had ordered them just before, and until ``settles_at`` in any order;
    until ``any_until`` every mode may, since the program had sent an order of its own making. Any other mode is a
    pilot's or a failsafe's doing.
    """

    def __init__(
        self,
        given_at: float,
        *,
        mode_before: Mode | None,
        modes: Collection[Mode],
        expected: Collection[Mode],
        armed_before: bool | None,
        state_before: int | None,
        is_newest: Callable[[Order], bool],
        settles_at: float = -math.inf,
        any_until: float = -math.inf,
        ends_flight: bool = False,
    ) -> None:
        self.given_at = given_at
        self.was_refused: bool = False
        """Whether the vehicle has said no to it: it does what it did before."""
        self.was_flown_before: bool = False
        """Whether the vehicle did what this program had ordered before."""
        self.modes: tuple[Mode, ...] = tuple(modes)
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
        self.is_given = False
        """Whether the vehicle may move by it, or moves by what the program had ordered before: given up, it is held."""
        late = {each.custom_mode for each in expected}
        self._before = set() if mode_before is None else {mode_before.custom_mode} - late
        self._allowed = self._before | late
        self._own = {each.custom_mode for each in modes}
        self._is_mode_known = mode_before is not None
        self._was_armed = armed_before
        self._state_before, self._ends_flight = state_before, ends_flight
        self._is_newest = is_newest
        self._settles_at, self._any_until = settles_at, any_until
        self.is_overruled: bool = False
        """Whether a newer order steers that is not one of an action."""

    @property
    def end(self) -> str:
        """Why nothing of it may be sent any more, as a clause; empty while it may."""
        failsafe = "" if self._ends_flight else self.failsafe
        is_over = self.is_overruled or not self._is_newest(self)
        return self.taken_by or failsafe or ("another order was given" if is_over else "")

    def note_newer(self) -> None:
        """A newer order steers, which is none of these."""
        self.is_overruled = True

    def is_own(self, mode: Mode) -> bool:
        """Whether this mode is one that the order may bring about."""
        return mode.custom_mode in self._own

    def note_mode(self, mode: Mode, at: float) -> None:
        """The vehicle tells its mode. Once it was in one of the order's, the mode before is somebody else's, too."""
        if self.is_own(mode):
            self._allowed -= self._allowed if at >= self._settles_at else self._before
        elif not self._is_mode_known or at < self._any_until:
            if self._is_mode_known and mode.custom_mode not in self._allowed:
                self.unexplained = f"the mode changed to {mode}"
            self._allowed.add(mode.custom_mode)
        elif mode.custom_mode not in self._allowed:
            if not self.has_lost_mode:
                self.mode_lost_at = at
            self.has_lost_mode = True
            self.taken_by = self.taken_by or f"the mode changed to {mode}"
        self._is_mode_known = True

    def note_state(self, state: int) -> None:
        """Take MAV_STATE. A failsafe that was active when the order was given does not end it: the program knew it.

        Nor does any end an order to land, to return or to disarm: it is sent again if need be.
        """
        if is_worse(state, self._state_before):
            self.failsafe = self.failsafe or failsafe_text(state)
        self._state_before = state

    def forgive_failsafe(self) -> None:
        """The program orders the vehicle again, which is still in a mode of this order."""
        self.failsafe = ""

    def expect(self, modes: Collection[Mode]) -> None:
        """The program has posted an order that brings these about."""
        self._own |= {each.custom_mode for each in modes}

    def note_armed(self, armed: bool, at: float) -> None:
        """The vehicle tells whether it is armed."""
        if self._was_armed and not armed:
            self.taken_by = self.taken_by or "the vehicle disarmed"
        self._was_armed = armed

    def note_reboot(self) -> None:
        """The vehicle has rebooted: nothing that was ordered before is meant any more."""
        self.taken_by = self.taken_by or "the vehicle rebooted"


class Sending:
    """One command of an order, from its first sending on: whether it may be sent again.

    It may while what was heard since speaks neither of its effect nor of somebody else's doing. ``modes`` and
    ``armed`` are effects that HEARTBEAT tells, if they are not there already; ``is_done`` tells any other one.
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
        is_there = None if mode_now is None else mode_now.custom_mode
        self._modes = {each.custom_mode for each in modes} - {is_there}
        self._armed = None if armed is armed_now else armed
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
        overruled = "another order was given" if self._is_overruled else ""
        return self.order.end or overruled or self.order.unexplained

    def note_newer(self, armed: bool | None) -> None:
        """Another command is given: one to disarm ends one to arm, and the other way round."""
        if armed is not None and self.arms is not None and armed is not self.arms:
            self._is_overruled = True

    def note_state(self, state: int) -> None:
        """Take MAV_STATE, which is the order's to judge."""

    def note_mode(self, mode: Mode, at: float) -> None:
        """The vehicle tells its mode."""
        self._was_told = self._was_told or mode.custom_mode in self._modes

    def note_armed(self, armed: bool, at: float) -> None:
        """The vehicle tells whether it is armed, which ends a HEARTBEAT."""
        self._was_told = self._was_told or (self._armed is not None and armed is self._armed)
        self.told_at = at
