"""CommandArbiter: every rule by which an order, or one of its commands, ends; without a vehicle, a loop or a clock."""

from __future__ import annotations

import math
from contextlib import ExitStack, nullcontext, suppress
from types import SimpleNamespace
from typing import Any, cast

import pytest

from aerokit.autopilots import Mode, autopilot_for
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.mavlink.enums import MavCmd, MavState
from aerokit.mavlink.messages import Heartbeat
from aerokit.vehicle.commanding.arbiter import MODE_GRACE_S, MODE_MAX_AGE_S, CommandArbiter
from aerokit.vehicle.commanding.order import CHANGED_BY_COMMAND, REQUEST_COMMANDS, Order, SentCommand
from aerokit.vehicle.state.telemetry import Telemetry

HEARTBEAT = Source(1, 1, "HEARTBEAT")
GUIDED, LOITER, RTL, BRAKE = (
    Mode(name, number) for number, name in ((4, "GUIDED"), (5, "LOITER"), (6, "RTL"), (17, "BRAKE"))
)


COPTER = autopilot_for(Heartbeat(2, 3, 81, 0, 4, 3))


class Stage:
    """An arbiter, and heartbeats on demand."""

    def __init__(self, mode: Mode | None = LOITER, armed: bool | None = True) -> None:
        self.now, self.open = 0.0, ExitStack()
        self.mode = StateCell[Mode]("mode", lambda: self.now, "HEARTBEAT")
        self.armed = StateCell[bool]("armed", lambda: self.now, "HEARTBEAT")
        self.state = StateCell[int]("system_status", lambda: self.now, "HEARTBEAT")
        cells = SimpleNamespace(
            mode=self.mode, armed=self.armed, system_status=self.state, autopilot=COPTER, is_vtol=False
        )
        self.arbiter = CommandArbiter(lambda: self.now, cast("Telemetry", cells))
        if mode is not None and armed is not None:
            self.report(mode, armed)

    def report(self, mode: Mode, armed: bool = True, *, after: float = 1.0, state: int = MavState.ACTIVE) -> None:
        self.now += after
        self.mode.set(mode, HEARTBEAT)
        self.state.set(state, HEARTBEAT)
        self.armed.set(armed, HEARTBEAT)


# -------------------------------------------------------------------------------- the newest


def test_newer_order_supersedes_and_notifies_first() -> None:
    stage, ends = Stage(), list[str]()
    first = stage.arbiter.order(GUIDED)
    stage.arbiter.on_steering(lambda: ends.append(first.end))
    second = stage.arbiter.order(RTL)
    assert ends == [""]  # called before
    assert first.end == "another order was given"
    assert (first.takeover_reason, second.end) == ("", "")
    assert stage.arbiter.newest is second


def test_auxiliary_order_ends_with_steering_order() -> None:
    stage = Stage()
    steering = stage.arbiter.order(GUIDED)
    with stage.arbiter.auxiliary_order() as aside:
        assert (steering.end, aside.end) == ("", "")
        assert aside.modes == steering.modes
        stage.arbiter.order(RTL)
        assert aside.end == "another order was given"


def test_auxiliary_order_ignores_reports_after_block() -> None:
    stage = Stage()
    with stage.arbiter.auxiliary_order() as aside:
        assert aside.modes == ()
        stage.report(LOITER)
    stage.report(RTL)
    assert aside.end == ""
    with pytest.raises(KeyError), stage.arbiter.auxiliary_order() as aside:
        raise KeyError
    stage.report(BRAKE)
    assert aside.end == ""


# ---------------------------------------------------------------------------------- takeovers


@pytest.mark.parametrize("modes", [[LOITER], [GUIDED], [LOITER, LOITER, GUIDED, GUIDED]])
def test_mode_before_and_own_modes_are_no_takeover(modes: list[Mode]) -> None:
    stage = Stage()
    order = stage.arbiter.order(GUIDED)
    for mode in modes:
        stage.report(mode)
    assert order.end == ""


@pytest.mark.parametrize("modes", [[RTL], [GUIDED, LOITER], [GUIDED, RTL, GUIDED], [LOITER, RTL, LOITER]])
def test_other_mode_ends_order_permanently(modes: list[Mode]) -> None:
    """The previous mode also ends the order, once the ordered mode was reported."""
    stage = Stage()
    order = stage.arbiter.order(GUIDED)
    for mode in modes:
        stage.report(mode)
    assert (
        order.end
        == order.takeover_reason
        == f"the mode changed to {next(m for m in modes[1:] or modes if m != GUIDED)}"
    )


def test_first_takeover_is_reported() -> None:
    stage = Stage()
    order = stage.arbiter.order(GUIDED)
    stage.report(RTL)
    stage.report(BRAKE, armed=False)
    stage.arbiter.on_reboot()
    assert order.end == "the mode changed to RTL"


def test_disarming_or_reboot_ends_order() -> None:
    stage = Stage()
    order = stage.arbiter.order(GUIDED)
    stage.report(LOITER, armed=False)
    assert order.end == "the vehicle disarmed"
    order = stage.arbiter.order(GUIDED)
    stage.report(LOITER, armed=False)
    assert order.end == ""  # the vehicle was disarmed before
    stage.arbiter.on_reboot()
    assert order.end == "the vehicle rebooted"


def test_disarming_counts_only_after_arming() -> None:
    stage = Stage(armed=False)
    order = stage.arbiter.order(GUIDED)
    stage.report(LOITER, armed=True)
    assert order.end == ""
    stage.report(LOITER, armed=False)
    assert order.end == "the vehicle disarmed"


def test_first_reported_mode_becomes_mode_before() -> None:
    stage = Stage(mode=None)
    order = stage.arbiter.order(GUIDED)
    stage.report(RTL)
    assert order.end == ""
    stage.report(BRAKE)
    assert order.end == "the mode changed to BRAKE"


# --------------------------------------------------------------------------------- doubts


def test_previous_orders_mode_while_active_is_no_takeover() -> None:
    stage = Stage()
    stage.arbiter.order(GUIDED)
    stage.report(GUIDED)
    order = stage.arbiter.order(BRAKE)
    stage.report(GUIDED)
    assert order.end == ""
    stage.report(BRAKE)
    stage.report(GUIDED)
    assert order.end == "the mode changed to GUIDED"


@pytest.mark.parametrize(("in_doubt", "end"), [(True, ""), (False, "the mode changed to GUIDED")])
def test_unreported_ordered_mode_in_doubt_is_no_takeover(in_doubt: bool, end: str) -> None:
    stage = Stage()
    stage.arbiter.order(GUIDED)
    if in_doubt:
        stage.open.enter_context(stage.arbiter.changing_mode())
    order = stage.arbiter.order(BRAKE)
    stage.report(GUIDED)
    assert order.end == end


@pytest.mark.parametrize(("refused", "end"), [(False, ""), (True, "the mode changed to GUIDED")])
def test_accepted_mode_before_heartbeat_is_no_takeover(refused: bool, end: str) -> None:
    stage = Stage()
    first = stage.arbiter.order(GUIDED)
    with suppress(CommandRejected), stage.arbiter.sending(first, modes=(GUIDED,)):
        if refused:
            raise CommandRejected("no", command=192, result=4)
    order = stage.arbiter.order(BRAKE)
    stage.report(GUIDED)
    assert (order.end, order.may_move) == (end, not refused)


@pytest.mark.parametrize(("after_s", "may_move"), [(MODE_GRACE_S - 0.1, True), (MODE_GRACE_S, False)])
def test_replacement_of_order_that_was_just_sent_may_move(after_s: float, may_move: bool) -> None:
    stage = Stage()
    first = stage.arbiter.order(GUIDED)
    first.may_move = True
    stage.now += 10.0
    with suppress(CommandTimeout), stage.arbiter.sending(first, modes=(GUIDED,)):
        assert stage.arbiter.order(RTL).may_move
        stage.arbiter.newest = first
        raise CommandTimeout("no answer")
    stage.now += after_s
    assert stage.arbiter.order(RTL).may_move is may_move


def test_late_modes_of_several_replaced_orders_are_no_takeover() -> None:
    stage = Stage()
    for mode in (GUIDED, RTL):
        with stage.arbiter.sending(stage.arbiter.order(mode), modes=(mode,)):
            pass
    order = stage.arbiter.order(BRAKE)
    for mode in (LOITER, GUIDED, RTL):
        stage.report(mode, after=0.1)
    assert (order.end, stage.arbiter.mode_is_in_doubt) == ("", True)
    stage.arbiter.settle_mode()
    assert not stage.arbiter.mode_is_in_doubt


@pytest.mark.parametrize(("after_s", "end"), [(MODE_GRACE_S - 0.1, ""), (MODE_GRACE_S, "the mode changed to GUIDED")])
def test_accepted_posted_mode_after_its_block_is_no_takeover(after_s: float, end: str) -> None:
    stage = Stage()
    with stage.arbiter.posted_order(("mode", "motion"), modes=(GUIDED,)) as posted, stage.arbiter.sending(posted):
        pass
    stage.now += after_s
    order = stage.arbiter.order(BRAKE)
    stage.report(GUIDED)
    assert order.end == end


@pytest.mark.parametrize(("after_s", "end"), [(MODE_GRACE_S - 0.1, ""), (MODE_GRACE_S, "the mode changed to GUIDED")])
def test_abandoned_mode_within_three_seconds_is_no_takeover(after_s: float, end: str) -> None:
    stage = Stage()
    stage.arbiter.order(GUIDED)
    stage.arbiter.doubt_mode()
    with stage.arbiter.changing_mode():
        pass
    stage.now += after_s
    order = stage.arbiter.order(BRAKE)
    stage.report(GUIDED)
    assert order.end == end


@pytest.mark.parametrize("reported_after_s", [MODE_GRACE_S - 0.1, MODE_GRACE_S])
def test_abandoned_mode_after_report_that_settles_it_is_takeover(reported_after_s: float) -> None:
    """The abandoned order was never confirmed, e.g. because a pilot took over."""
    stage = Stage()
    stage.arbiter.order(GUIDED, BRAKE)
    stage.arbiter.doubt_mode()
    stage.report(LOITER, after=reported_after_s)
    is_settled = reported_after_s >= MODE_GRACE_S
    assert stage.arbiter.mode_is_in_doubt is not is_settled
    stage.now += MODE_GRACE_S
    order = stage.arbiter.order(RTL)
    stage.report(GUIDED)
    assert order.end == ("the mode changed to GUIDED" if is_settled else "")


@pytest.mark.parametrize(("after_s", "end"), [(2.9, ""), (3.0, "the mode changed to RTL")])
def test_raw_order_accepts_any_mode_for_three_seconds(after_s: float, end: str) -> None:
    stage = Stage()
    own = stage.arbiter.raw_order()
    order = stage.arbiter.order(GUIDED)
    assert own.end == "another order was given"
    stage.report(RTL, after=after_s)
    assert order.end == end


def test_raw_order_named_mode_is_no_takeover() -> None:
    stage = Stage()
    own = stage.arbiter.raw_order(modes=[GUIDED])
    stage.report(GUIDED)
    assert (own.end, stage.arbiter.may_be_executing) == ("", True)
    stage.report(RTL)  # within three seconds: nothing is sent again after a pilot's mode
    assert (own.end, stage.arbiter.may_be_executing) == ("the mode changed to RTL", False)


def test_raw_order_ends_with_any_mode_change() -> None:
    stage = Stage()
    own = stage.arbiter.raw_order()
    with stage.arbiter.sending(own) as sending:
        stage.report(RTL, after=0.5)
        assert sending.end == "the mode changed to RTL"


@pytest.mark.parametrize(
    ("error", "in_doubt", "settles_at"),
    [
        (None, False, -math.inf),
        (CommandRejected("no", command=176, result=4), False, -math.inf),
        (CommandTimeout("no answer"), True, 1.0 + MODE_GRACE_S),
    ],
)
def test_mode_is_in_doubt_until_result_is_known(error: Exception | None, in_doubt: bool, settles_at: float) -> None:
    arbiter, observed = Stage().arbiter, list[bool]()
    with nullcontext() if error is None else pytest.raises(type(error)), arbiter.changing_mode():
        observed.append(arbiter.mode_is_in_doubt)
        if error is not None:
            raise error
    assert [*observed, arbiter.mode_is_in_doubt] == [True, in_doubt]
    assert arbiter.mode_settles_at == settles_at


def test_refused_mode_keeps_previous_doubt() -> None:
    arbiter = Stage().arbiter
    arbiter.doubt_mode()
    with pytest.raises(CommandRejected), arbiter.changing_mode():
        raise CommandRejected("no", command=176, result=4)
    assert arbiter.mode_is_in_doubt


def test_mode_stays_in_doubt_until_newer_change_is_answered() -> None:
    """A newer order supersedes a change in progress, and its command is still unanswered."""
    arbiter = Stage().arbiter
    older, newer = arbiter.changing_mode(), arbiter.changing_mode()
    older.__enter__()
    newer.__enter__()
    older.__exit__(None, None, None)
    assert arbiter.mode_is_in_doubt
    newer.__exit__(None, None, None)
    assert not arbiter.mode_is_in_doubt


def test_refused_mode_leaves_no_doubt_about_answered_change() -> None:
    arbiter = Stage().arbiter
    older = arbiter.changing_mode()
    older.__enter__()
    with pytest.raises(CommandRejected), arbiter.changing_mode():
        older.__exit__(None, None, None)
        raise CommandRejected("no", command=176, result=4)
    assert not arbiter.mode_is_in_doubt


def test_answered_mode_keeps_doubt_about_later_change() -> None:
    """A hold was sent without waiting while the change was in progress."""
    arbiter = Stage().arbiter
    with arbiter.changing_mode():
        arbiter.doubt_mode()
    assert arbiter.mode_is_in_doubt


def test_vehicle_is_not_flown_after_takeover_that_follows_refusal() -> None:
    stage = Stage(armed=False)
    with stage.arbiter.auxiliary_order() as arming, stage.arbiter.sending(arming, armed=True):
        stage.report(LOITER)
    refused = stage.arbiter.order(GUIDED)
    refused.was_refused = True
    assert stage.arbiter.is_flown_by_program
    stage.report(RTL)
    assert not stage.arbiter.is_flown_by_program


def test_state_is_known_for_two_and_a_half_seconds() -> None:
    stage = Stage()
    for later, known in ((MODE_MAX_AGE_S, True), (0.1, False)):
        stage.now += later
        assert stage.arbiter.is_state_recent is known
    assert not Stage(mode=None).arbiter.is_state_recent


# --------------------------------------------------------------------------------- sendings


def sending(stage: Stage, **options: Any) -> SentCommand:
    order = stage.arbiter.order(GUIDED)
    return stage.open.enter_context(stage.arbiter.sending(order, **options))


def test_sent_command_mode_reported_ends_permanently() -> None:
    stage = Stage()
    attempt = sending(stage, modes=(GUIDED,))
    stage.report(LOITER)
    assert (attempt.end, attempt.is_confirmed) == ("", False)
    stage.report(GUIDED)
    assert (attempt.end, attempt.is_confirmed) == ("its effect was reported", True)
    stage.report(RTL)
    assert attempt.end == "its effect was reported"


def test_sent_command_armed_as_ordered_ends() -> None:
    for armed in (True, False):
        stage = Stage(armed=not armed)
        attempt = sending(stage, armed=armed)
        stage.report(LOITER, armed=not armed)
        assert attempt.end == ""
        stage.report(LOITER, armed=armed)
        assert attempt.is_confirmed


def test_unchanged_state_is_no_effect() -> None:
    stage = Stage(GUIDED)
    attempt = sending(stage, modes=(GUIDED, LOITER), armed=True)
    stage.report(GUIDED)
    assert not attempt.is_confirmed
    stage.report(LOITER)
    assert attempt.is_confirmed


def test_sent_command_ends_with_order_or_effect() -> None:
    stage, done = Stage(), list[int]()
    attempt = sending(stage, is_done=lambda: bool(done))
    stage.report(RTL)
    assert attempt.end == "the mode changed to RTL"
    done.append(1)
    assert attempt.end == "its effect was reported"
    done.clear()
    assert attempt.end == "its effect was reported"


def test_sent_command_records_heartbeats_within_its_block() -> None:
    stage = Stage()
    with stage.arbiter.sending(stage.arbiter.order(GUIDED)) as attempt:
        assert attempt.heartbeat_at == -math.inf
        stage.report(LOITER)
        assert attempt.heartbeat_at == 2.0
    stage.report(LOITER)
    assert attempt.heartbeat_at == 2.0


def test_commands_are_classified_as_orders_or_questions() -> None:
    assert {MavCmd(number).name for number in CHANGED_BY_COMMAND} == {
        *("NAV_WAYPOINT", "NAV_LOITER_UNLIM", "NAV_LOITER_TURNS", "NAV_LOITER_TIME", "NAV_RETURN_TO_LAUNCH"),
        *("NAV_LAND", "NAV_TAKEOFF", "NAV_VTOL_TAKEOFF", "NAV_VTOL_LAND", "DO_SET_MODE", "DO_REPOSITION"),
        *("DO_FLIGHTTERMINATION", "DO_ORBIT", "DO_PAUSE_CONTINUE", "OVERRIDE_GOTO", "MISSION_START"),
        "COMPONENT_ARM_DISARM",
    }
    for number in REQUEST_COMMANDS - {MavCmd.SET_MESSAGE_INTERVAL, MavCmd.RUN_PREARM_CHECKS}:
        assert MavCmd(number).name.startswith(("REQUEST_", "GET_")), "a command that changes something is not a query"
    assert len(REQUEST_COMMANDS) == 11


def test_order_without_modes_stays_valid() -> None:
    order = Order(0.0, 1, lambda _: True)
    assert order.end == ""


# --------------------------------------------------------------------------------- failsafes


@pytest.mark.parametrize("state", [MavState.CRITICAL, MavState.EMERGENCY, MavState.FLIGHT_TERMINATION])
def test_order_failsafe_ends_it_permanently(state: int) -> None:
    stage = Stage()
    order = stage.arbiter.order(GUIDED)
    with stage.arbiter.sending(order) as sending, stage.arbiter.auxiliary_order() as aside:
        stage.report(GUIDED, state=state)
        assert "failsafe" in order.end
        assert sending.end == aside.end == order.end
        stage.report(GUIDED)
        assert "failsafe" in order.end
    assert not stage.arbiter.order(GUIDED).may_move


def test_order_during_failsafe_is_valid_until_next_failsafe() -> None:
    stage = Stage()
    stage.report(LOITER, state=MavState.CRITICAL)
    order = stage.arbiter.order(GUIDED)
    stage.report(GUIDED, state=MavState.CRITICAL)
    assert not order.end
    stage.report(GUIDED)
    assert not order.end
    stage.report(GUIDED, state=MavState.CRITICAL)
    assert "failsafe" in order.end


def test_order_worse_failsafe_ends_it() -> None:
    stage = Stage()
    stage.report(LOITER, state=MavState.CRITICAL)
    order = stage.arbiter.order(GUIDED)
    stage.report(GUIDED, state=MavState.EMERGENCY)
    assert "MAV_STATE_EMERGENCY" in order.end


@pytest.mark.parametrize("mode", [RTL, Mode("LAND", 9)])
def test_land_and_return_orders_survive_failsafe(mode: Mode) -> None:
    stage = Stage()
    order = stage.arbiter.order(mode)
    with (
        stage.arbiter.sending(order, modes=[mode]) as sending,
        stage.arbiter.auxiliary_order(ends_flight=True) as disarm,
    ):
        stage.report(LOITER, state=MavState.CRITICAL)
        assert (order.end, sending.end, disarm.end) == ("", "", "")
        assert "failsafe" in order.failsafe


# ----------------------------------------------------------------------- control of the vehicle


def arm(stage: Stage, *, is_refused: bool = False) -> None:
    """An order to arm, until its answer."""
    error = CommandRejected("no", command=400, result=4)
    with (
        pytest.raises(CommandRejected) if is_refused else nullcontext(),
        stage.arbiter.auxiliary_order() as order,
        stage.arbiter.sending(order, armed=True),
    ):
        if is_refused:
            raise error


def test_vehicle_armed_by_program_is_flown_until_takeover() -> None:
    stage = Stage(armed=False)
    arm(stage)
    stage.report(LOITER, True, after=0.8)
    assert stage.arbiter.is_flown_by_program
    stage.report(RTL)
    assert not stage.arbiter.is_flown_by_program


def test_late_armed_report_is_programs_without_other_report() -> None:
    stage = Stage(armed=False)
    arm(stage)
    stage.report(LOITER, True, after=6.0)  # HEARTBEATs were lost
    assert stage.arbiter.is_flown_by_program


def test_vehicle_armed_by_pilot_is_not_flown_by_program() -> None:
    stage = Stage(armed=False)
    arm(stage, is_refused=True)
    stage.report(LOITER, True, after=1.0)
    assert not stage.arbiter.is_flown_by_program
    stage = Stage(armed=False)
    arm(stage)
    for _ in range(4):
        stage.report(LOITER, False)  # the pilot disarms at once
    stage.report(LOITER, True)
    assert not stage.arbiter.is_flown_by_program


def test_vehicle_armed_after_reboot_is_not_flown_by_program() -> None:
    """The link was silent after the reboot, so the first HEARTBEAT reports that the pilot has armed the vehicle."""
    stage = Stage(armed=False)
    arm(stage)
    stage.report(LOITER, True, after=0.8)
    for cell in (stage.mode, stage.armed, stage.state):
        cell.forget()
    stage.arbiter.on_reboot()
    stage.report(LOITER, True, after=60.0)
    assert not stage.arbiter.is_flown_by_program


def flies(stage: Stage) -> bool:
    return stage.arbiter.is_flown_by_program


def test_refused_order_does_not_change_flown_by_program() -> None:
    stage = Stage()
    refused = stage.arbiter.order(GUIDED)
    refused.was_refused = True
    assert not flies(stage)
    stage.arbiter.order(GUIDED)
    assert flies(stage)
    refused = stage.arbiter.order(BRAKE)
    refused.was_refused = True
    assert flies(stage)


def test_failsafe_is_cleared_by_new_order() -> None:
    stage = Stage()
    stage.arbiter.order(GUIDED)
    stage.report(GUIDED)
    stage.report(GUIDED, state=MavState.CRITICAL)
    stage.report(GUIDED)
    assert not flies(stage)
    stage.arbiter.clear_failsafe()
    assert flies(stage)


def test_posted_mode_after_order_is_no_takeover() -> None:
    stage = Stage()
    order = stage.arbiter.order(GUIDED)
    stage.report(GUIDED)
    with stage.arbiter.posted_order(["mode"], modes=[RTL]):
        stage.report(RTL)
    assert not order.has_lost_mode
    stage.report(LOITER)
    assert order.has_lost_mode


# -------------------------------------------------------------------------------- of devices


def test_device_order_withdrawn_is_not_the_newest() -> None:
    """Then only the previous order is the newest again."""
    arbiter = Stage().arbiter
    first = arbiter.device_order("video", may_be_withdrawn=True)
    second = arbiter.device_order("video", may_be_withdrawn=True)
    assert (first.is_newest, second.is_newest) == (False, True)
    second.withdraw()
    assert (first.is_newest, second.is_newest) == (True, False)
