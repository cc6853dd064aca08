"""Orders of this program to one vehicle: whether they are still valid, and whether their commands may be repeated.

docs/reliability.md has the table of all orders. Only commands listed there are sent again.
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
"""The part of the vehicle that an order controls."""
Topic: TypeAlias = Hashable
"""The topic of an order: a subject of the vehicle, or any key for a device such as a camera or a gimbal."""

ROI: Topic = "region of interest"
"""Topic of orders that point the autopilot's gimbal, or the nose, at a place."""
HOME: Topic = "home position"
"""Topic of orders that move the home position."""

SUPERSEDED = "another order was given"
"""Reason for the end of an order that a newer order replaced."""
REBOOTED = "the vehicle rebooted"
"""Reason for the end of an order by a reboot."""

# A new mode also changes how the vehicle moves.
_MODE: tuple[Subject, ...] = ("mode", "motion")
MOTION: tuple[Subject, ...] = ("motion",)
"""Subjects of a command that moves the vehicle and may change its mode."""
ARM_ALONE: tuple[Subject, ...] = ("arm",)
"""Subjects of a command that only arms or disarms."""
CHANGED_BY_COMMAND: Mapping[int, tuple[Subject, ...]] = {
    MavCmd.NAV_RETURN_TO_LAUNCH: _MODE,
    MavCmd.NAV_LAND: _MODE,
    MavCmd.NAV_VTOL_TAKEOFF: _MODE,
    MavCmd.NAV_VTOL_LAND: _MODE,
    MavCmd.DO_SET_MODE: _MODE,
    MavCmd.DO_FLIGHTTERMINATION: _MODE,
    MavCmd.OVERRIDE_GOTO: _MODE,
    MavCmd.MISSION_START: _MODE,
    MavCmd.NAV_WAYPOINT: MOTION,
    MavCmd.NAV_LOITER_UNLIM: MOTION,
    MavCmd.NAV_LOITER_TURNS: MOTION,
    MavCmd.NAV_LOITER_TIME: MOTION,
    MavCmd.NAV_TAKEOFF: MOTION,
    MavCmd.DO_ORBIT: MOTION,
    MavCmd.DO_REPOSITION: MOTION,
    MavCmd.DO_PAUSE_CONTINUE: MOTION,
    MavCmd.COMPONENT_ARM_DISARM: ARM_ALONE,
}
"""Maps MAV_CMD to what it changes (mode, motion, arming). A raw command supersedes orders about any of these."""
CHANGED_BY_MESSAGE: Mapping[str, tuple[Subject, ...]] = {
    "SET_MODE": _MODE,
    "SET_ATTITUDE_TARGET": MOTION,
    "SET_POSITION_TARGET_LOCAL_NED": MOTION,
    "SET_POSITION_TARGET_GLOBAL_INT": MOTION,
    "MISSION_SET_CURRENT": MOTION,
}
"""Maps the name of a message to what it changes. Commands and mission items are not in this table."""
FAILSAFE_STATES = (MavState.CRITICAL, MavState.EMERGENCY, MavState.FLIGHT_TERMINATION)
"""Values of HEARTBEAT.system_status while a failsafe is active.

PX4 reports them seconds before the failsafe changes the mode (COM_FAIL_ACT_T). An order that arrives in between cancels
the failsafe.
"""
# Values of MISSION_ITEM.current for an item that ArduPilot executes at once instead of storing it: 2 is a place to fly
# to, 3 a new altitude (GCS_Common.cpp).
GUIDED_ITEM = (2, 3)
REQUEST_COMMANDS = frozenset(
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
"""MAV_CMDs that only request data. They change only streams, so they may be repeated until acknowledged."""


def subjects_of(message: Message) -> tuple[Subject, ...]:
    """Return what this message changes if the program sends it directly: mode, motion, arming or nothing."""
    fields: Any = message
    if message.NAME in ("COMMAND_LONG", "COMMAND_INT"):
        return CHANGED_BY_COMMAND.get(fields.command, ())
    if message.NAME in ("MISSION_ITEM", "MISSION_ITEM_INT"):
        return MOTION if fields.current in GUIDED_ITEM else ()
    return CHANGED_BY_MESSAGE.get(message.NAME, ())


def is_worse_failsafe(state: int, state_before: int | None) -> bool:
    """Return True if MAV_STATE changed to a failsafe, or to a more severe one."""
    if state not in FAILSAFE_STATES:
        return False
    return state_before is None or state_before not in FAILSAFE_STATES or state > state_before


def failsafe_text(state: int) -> str:
    name = MavState(state).name
    return f"a failsafe became active (MAV_STATE_{name}) and keeps control; no hold was ordered"


class Order:
    """One order of this program, from its creation until it is done, superseded or taken over.

    A newer order about any topic in ``ending_topics`` supersedes this order. The arbiter updates the order with each
    HEARTBEAT: an unexpected mode, a failsafe, disarming or a reboot ends the order. An order that has ended does not
    become valid again, even if its mode is reported again.

    Modes are classified as follows:

    - ``mode_before`` was active when the order was given.
    - ``modes`` are the order's own modes: a report of one of them shows that the order has taken effect. With
      ``requires_mode_change``, only a change to one of them shows this.
    - ``expected`` modes were ordered by the program shortly before. They may appear in any sequence until
      ``settles_at``. After that time, they are accepted only until the order has taken effect.
    - Until ``any_until`` every mode is accepted, because the program sent a raw command with an unknown effect.
    - Any other mode is attributed to the pilot or a failsafe.
    """

    def __init__(
        self,
        given_at: float,
        number: int,
        is_newest: Callable[[Order], bool],
        *,
        ending_topics: Collection[Topic] = (),
        modes: Collection[Mode] = (),
        armed: bool | None = None,
        mode_before: Mode | None = None,
        expected: Collection[int] = (),
        armed_before: bool | None = None,
        state_before: int | None = None,
        settles_at: float = -math.inf,
        any_until: float = -math.inf,
        ends_flight: bool = False,
        ends_on_mode_change: bool = True,
        ends_on_disarm: bool = True,
        requires_mode_change: bool = False,
    ) -> None:
        self.given_at: float = given_at
        self.number: int = number
        """Sequence number: a newer order has a greater number."""
        self.ending_topics: tuple[Topic, ...] = tuple(ending_topics)
        """Topics of the order: a newer order about any of them ends this order."""
        self.modes: tuple[Mode, ...] = tuple(modes)
        self.armed = armed
        """True if the order arms the vehicle, False if it disarms it, None if it does neither."""
        self.may_move: bool = False
        """True once this or an earlier order may move the vehicle, which must hold if this order is abandoned."""
        self.must_complete: bool = False
        """True if the vehicle must complete the order once it moves, because a hold could make it hit the ground."""
        self.command_ended_at: float = -math.inf
        """Time at which the wait for the answer to the order's last command ended."""
        self.was_refused: bool = False
        """True if the vehicle refused the order, and therefore continues its previous task."""
        self.was_flown_before: bool = False
        """True if the vehicle was executing another order of this program before this order."""
        self.previous: Order | None = None
        """The previous order about the same device, which becomes valid again if this order is withdrawn."""
        self.is_withdrawn: bool = False
        self.takeover_reason: str = ""
        """Text about the action of another party that ended the order; empty if there was none."""
        self.impact: str = ""
        """Text about an impact on the ground while a call waited for the order; empty if there was none."""
        self.failsafe: str = ""
        """Text about the failsafe that became active after the order; empty if there was none."""
        self.unexplained: str = ""
        """A clause about a mode change that a raw command or another party may have caused; empty if there was none."""
        self.has_lost_mode: bool = False
        """True if the vehicle has changed to a mode that the order does not explain."""
        self.mode_lost_at: float = -math.inf
        """Time at which the vehicle first reported a mode that the order does not explain.

        CURRENT_MODE may report the mode before the HEARTBEAT that reports the mode and, after a landing, disarming.
        """
        self.arm_command_number: int | None = None
        """Sequence number of the order's arm or disarm command; None until the command was sent."""
        self.was_sent: bool = False
        """True once the first transmission of the order's first command began."""
        self.only_stops: bool = False
        """True once the remaining steps only stop the vehicle, so that they are also sent if the computer slept."""
        self.is_closed: bool = False
        """True once the `with` block of `CommandArbiter.posted_order` was left."""
        self.is_confirmed: bool = False
        """True once a change to one of the order's modes, or to its armed state, was reported."""
        # Sets of modes, by their numbers in HEARTBEAT.custom_mode. The docstring of the class describes the kinds.
        self._own_modes = {mode.custom_mode for mode in modes}
        self._expected_modes = set(expected)
        self._modes_before = set() if mode_before is None else {mode_before.custom_mode} - self._expected_modes
        self._accepted_modes = self._modes_before | self._expected_modes
        # The last reports of the vehicle: mode, arming and MAV_STATE. None before the first report.
        self._mode_now = None if mode_before is None else mode_before.custom_mode
        self._armed_now = armed_before
        self._last_state = state_before
        self.ends_flight: bool = ends_flight
        """True for an order to land, return or disarm, which stays valid during a failsafe."""
        self._ends_on_mode_change = ends_on_mode_change
        self._ends_on_disarm = ends_on_disarm
        self._is_newest = is_newest
        self.settles_at: float = settles_at
        """Until this time, the modes of earlier orders may be reported in any sequence."""
        self.any_mode_until: float = any_until
        """Until this time, every mode may be the effect of a raw command."""
        self._requires_mode_change = requires_mode_change

    @property
    def is_newest(self) -> bool:
        return self._is_newest(self)

    @property
    def end(self) -> str:
        """Text that explains why no command of the order may be sent; empty while commands may be sent."""
        if not self.is_newest:
            return SUPERSEDED
        if self.is_closed and not self.takeover_reason:
            return "its `with` block was left"
        ending_failsafe = "" if self.ends_flight else self.failsafe
        return self.takeover_reason or ending_failsafe

    @property
    def is_effect_due(self) -> bool:
        """True if a later HEARTBEAT may show that the order took effect."""
        return self.was_sent and not (self.is_confirmed or self.was_refused or self.takeover_reason)

    def may_cause(self, mode: Mode) -> bool:
        return mode.custom_mode in self._own_modes

    def accept_as_effects(self, modes: Collection[Mode], *, any_until: float = -math.inf) -> None:
        """Also accept these modes as effects of the order, and every mode until ``any_until``."""
        self._own_modes |= {mode.custom_mode for mode in modes}
        self.any_mode_until = max(self.any_mode_until, any_until)

    def withdraw(self) -> None:
        """Take this order back, for example after a refusal. The device's previous order becomes valid again."""
        self.is_withdrawn = True

    def commit(self) -> None:
        """Make the order final, so that it can no longer be withdrawn."""
        self.previous = None

    # -------------------------------------------------------------------- vehicle reports

    def on_mode(self, mode: Mode, reported_at: float) -> None:
        """Decide whether a reported mode is due to this order, an earlier order, a raw command or another party."""
        number = mode.custom_mode
        is_first_report = self._mode_now is None
        is_change = not is_first_report and number != self._mode_now
        is_settled = reported_at >= self.settles_at  # The modes of all earlier orders must have been reported by now.
        is_of_earlier_order = number in self._expected_modes and number in self._accepted_modes
        is_of_this_order = number in self._own_modes
        is_own_effect = is_of_this_order and self.was_sent
        if is_change and (is_of_earlier_order or is_own_effect):
            self.may_move = True
        if is_of_this_order:
            self._on_own_mode(is_change=is_change, is_settled=is_settled)
        elif is_of_earlier_order and is_settled:
            # An earlier order's mode change has arrived. From now on, only another party can change the mode back.
            self._accepted_modes -= self._modes_before
        elif is_first_report or reported_at < self.any_mode_until:  # The mode may be the effect of a raw command.
            if not is_first_report and number not in self._accepted_modes:
                self.unexplained = f"the mode changed to {mode}"
            self._accepted_modes.add(number)
        elif number not in self._accepted_modes and self._ends_on_mode_change:
            self._on_takeover(mode, reported_at)
        self._mode_now = number

    def _on_own_mode(self, *, is_change: bool, is_settled: bool) -> None:
        self.is_confirmed = self.is_confirmed or is_change
        has_taken_effect = is_change or not self._requires_mode_change
        if has_taken_effect and is_settled:
            self._accepted_modes.clear()  # From now on, only the order's own modes are accepted.
        elif has_taken_effect:  # The modes of the program's earlier orders may still be reported.
            self._accepted_modes -= self._modes_before

    def _on_takeover(self, mode: Mode, reported_at: float) -> None:
        if not self.has_lost_mode:
            self.mode_lost_at = reported_at
        self.has_lost_mode = True
        self.takeover_reason = self.takeover_reason or f"the mode changed to {mode}"

    def on_system_status(self, state: int) -> None:
        # A failsafe that was active before the order does not end the order. With `ends_flight`, `end` ignores all
        # failsafes.
        if is_worse_failsafe(state, self._last_state):
            self.failsafe = self.failsafe or failsafe_text(state)
        self._last_state = state

    def on_armed(self, armed: bool, reported_at: float) -> None:
        armed_before, self._armed_now = self._armed_now, armed
        has_changed = armed_before is not None and armed_before is not armed
        if has_changed and armed is self.armed:  # The order to arm or disarm has taken effect.
            self.is_confirmed = True
        elif armed_before and not armed and self._ends_on_disarm:
            self.takeover_reason = self.takeover_reason or "the vehicle disarmed"


class SentCommand:
    """One command of an order after its first transmission. Decides whether the command may be sent again.

    The command may be sent again while the vehicle has reported neither the command's effect nor an action of another
    party. The effect is a change to one of ``modes`` or to ``armed``; ``is_done`` reports any other effect. ``slept_s``
    returns how many seconds the computer has slept since the first transmission.
    """

    heartbeat_name: str = "HEARTBEAT"

    def __init__(
        self,
        order: Order,
        *,
        mode_now: Mode | None,
        armed_now: bool | None,
        modes: Collection[Mode] = (),
        armed: bool | None = None,
        is_done: Callable[[], bool] = lambda: False,
        slept_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.order = order
        order.was_sent = True
        self.heartbeat_at: float = -math.inf
        """Time of the last HEARTBEAT."""
        self._is_effect_reported = False
        # Modes, by their numbers in HEARTBEAT.custom_mode: the last reported one, and those that the command leads to.
        self._mode_now = None if mode_now is None else mode_now.custom_mode
        self._modes = {mode.custom_mode for mode in modes}
        self._armed_now = armed_now
        self.arms = armed
        """True if the command arms the vehicle, False if it disarms it, None if it does neither."""
        # True if the program has sent a newer command that does the opposite: disarm instead of arm, or the reverse.
        self._is_overruled = False
        self._is_done = is_done
        self._slept_s = slept_s

    @property
    def is_confirmed(self) -> bool:
        self._is_effect_reported = self._is_effect_reported or self._is_done()
        return self._is_effect_reported

    @property
    def end(self) -> str:
        """Error text that explains why the command is not sent again; empty while it may be sent again."""
        if self.is_confirmed:
            return "its effect was reported"
        if self._slept_s() > 0:  # The computer has slept since the command was sent, perhaps for hours.
            return "the computer slept"
        overruled = SUPERSEDED if self._is_overruled else ""
        return self.order.end or overruled or self.order.unexplained

    def on_newer_arm_command(self, armed: bool) -> None:
        if self.arms is not None and armed is not self.arms:
            self._is_overruled = True

    def on_mode(self, mode: Mode, reported_at: float) -> None:
        mode_before, self._mode_now = self._mode_now, mode.custom_mode
        if self._mode_now != mode_before and self._mode_now in self._modes:
            self._is_effect_reported = True

    def on_armed(self, armed: bool, reported_at: float) -> None:
        armed_before, self._armed_now = self._armed_now, armed
        if armed is not armed_before and armed is self.arms:
            self._is_effect_reported = True
        self.heartbeat_at = reported_at
