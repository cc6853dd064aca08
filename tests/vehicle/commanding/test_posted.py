"""Orders that return before they are answered: when they are repeated, and which orders end them."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest
from flight_harness import Flight, in_the_air, now, open_flight

from aerokit import messages as m
from aerokit.autopilots import Mode, autopilot_for
from aerokit.connection.cells import Source, StateCell
from aerokit.dronekit.flight_orders import arm_or_disarm
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    ConnectionClosed,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult, MavState
from aerokit.mavlink.messages import Heartbeat
from aerokit.vehicle.commanding.arbiter import MODE_GRACE_S, CommandArbiter
from aerokit.vehicle.commanding.order import Order, Subject, subjects_of
from aerokit.vehicle.commanding.posted import MAX_MODE_ATTEMPTS
from aerokit.vehicle.state.telemetry import Telemetry

OWN_MODES_MAX_AGE_S = 10.0

HEARTBEAT = Source(1, 1, "HEARTBEAT")
STABILIZE, GUIDED, LOITER = (Mode(name, number) for number, name in ((0, "STABILIZE"), (4, "GUIDED"), (5, "LOITER")))
ARM, TAKEOFF, SET_MODE = MavCmd.COMPONENT_ARM_DISARM, MavCmd.NAV_TAKEOFF, MavCmd.DO_SET_MODE
TAKEN, NEWER, TOLD = (
    "the mode changed to ",
    "another order was given",
    "its effect was reported",
)


COPTER = autopilot_for(Heartbeat(2, 3, 81, 0, 4, 3))


class Stage:
    """An arbiter, heartbeats on demand, and orders that stay posted."""

    def __init__(self, mode: Mode = STABILIZE, armed: bool = False) -> None:
        self.now, self._open = 0.0, ExitStack()
        self.mode = StateCell[Mode]("mode", lambda: self.now, "HEARTBEAT")
        self.armed = StateCell[bool]("armed", lambda: self.now, "HEARTBEAT")
        self.state = StateCell[int]("system_status", lambda: self.now, "HEARTBEAT")
        cells = SimpleNamespace(
            mode=self.mode, armed=self.armed, system_status=self.state, autopilot=COPTER, is_vtol=False
        )
        reported = cast("Telemetry", cells)
        self.arbiter = CommandArbiter(lambda: self.now, reported)
        self.report(mode, armed)

    def report(self, mode: Mode, armed: bool = False, state: int = MavState.ACTIVE) -> None:
        self.now += 1.0
        self.mode.set(mode, HEARTBEAT)
        self.state.set(state, HEARTBEAT)
        self.armed.set(armed, HEARTBEAT)

    def post(self, *subjects: Subject, mode: Mode | None = None, armed: bool | None = None) -> Order:
        modes = () if mode is None else (mode,)
        return self._open.enter_context(self.arbiter.posted_order(subjects, modes=modes, armed=armed))


def end_of(order: Order) -> str:
    """Return the reason why nothing of an order is sent again."""
    if order.is_confirmed:
        return TOLD
    return TAKEN if order.takeover_reason.startswith(TAKEN) else order.end


# ------------------------------------------------------------------------------------------ the rules


def test_posted_order_failsafe_ends_it() -> None:
    stage = Stage(armed=True)
    mode, arm = stage.post("mode", mode=GUIDED), stage.post("arm", armed=True)
    stage.report(STABILIZE, armed=True, state=MavState.CRITICAL)
    assert "failsafe" in end_of(mode)
    assert "failsafe" in end_of(arm)
    disarm = stage.post("arm", armed=False)
    stage.report(STABILIZE, armed=True)
    stage.report(STABILIZE, armed=True, state=MavState.CRITICAL)
    assert not end_of(disarm)


def test_effect_requires_change() -> None:
    stage = Stage()
    order = stage.post("mode", "motion", mode=GUIDED)
    stage.report(STABILIZE)
    assert end_of(order) == ""
    stage.report(GUIDED)
    stage.report(STABILIZE)
    assert end_of(order) == TOLD
    there = Stage(GUIDED).post("mode", "motion", mode=GUIDED)
    assert end_of(there) == ""
    stage = Stage()
    arm, again = stage.post("arm", armed=True), None
    stage.report(STABILIZE, True)
    again = stage.post("arm", armed=True)
    stage.report(STABILIZE, True)
    assert (end_of(arm), end_of(again)) == (TOLD, "")


def test_posted_mode_reported_keeps_late_mode_of_previous_order() -> None:
    """In GUIDED, the program posts LOITER, then GUIDED: LOITER is reported late, and GUIDED must still be repeated."""
    stage = Stage(GUIDED, True)
    stage.post("mode", "motion", mode=LOITER)
    again = stage.post("mode", "motion", mode=GUIDED)
    stage.report(GUIDED, True)
    stage.report(LOITER, True)
    assert end_of(again) == ""
    stage.report(GUIDED, True)
    assert end_of(again) == TOLD


def test_unordered_mode_is_takeover() -> None:
    stage = Stage(GUIDED, True)
    motion, disarm = stage.post("motion"), stage.post("arm", armed=False)
    stage.report(LOITER, True)
    stage.report(GUIDED, True)
    assert (end_of(motion), end_of(disarm)) == (TAKEN, "")


def test_recently_ordered_mode_is_no_takeover() -> None:
    stage = Stage()
    mode, motion = stage.post("mode", "motion", mode=GUIDED), stage.post("motion")
    assert (end_of(mode), end_of(motion)) == ("", "")
    stage.report(GUIDED)
    assert end_of(motion) == ""
    stage.now += OWN_MODES_MAX_AGE_S
    late = stage.post("motion")
    stage.report(STABILIZE)
    stage.report(GUIDED)
    assert end_of(late) == TAKEN
    stage = Stage()
    stage.arbiter.order(GUIDED)
    of_an_action = stage.post("arm", armed=True)
    stage.report(GUIDED)
    assert end_of(of_an_action) == ""


def test_disarming_ends_posted_motion() -> None:
    stage = Stage(GUIDED, True)
    motion, mode, arm = stage.post("motion"), stage.post("mode"), stage.post("arm", armed=True)
    stage.report(GUIDED, False)
    stage.report(GUIDED, True)
    assert (end_of(motion), end_of(mode), end_of(arm)) == ("the vehicle disarmed", "", TOLD)


def test_newer_order_supersedes_its_subjects() -> None:
    stage = Stage()
    going, mode = stage.post("motion"), stage.post("mode", "motion")
    assert (end_of(going), end_of(mode)) == (NEWER, "")
    again = stage.post("motion")
    assert (end_of(mode), end_of(again)) == ("", "")
    arm = stage.post("arm", armed=True)
    stage.post("arm", "motion", armed=False)
    assert (end_of(arm), end_of(again), end_of(mode)) == (NEWER, NEWER, "")


def test_actions_and_posted_orders_end_each_other() -> None:
    stage, dropped = Stage(), list[str]()
    stage.arbiter.on_steering(lambda: dropped.append("left over"))
    action = stage.arbiter.order(GUIDED)
    assert stage.post("arm", armed=True).end == ""
    assert (end_of(action), len(dropped)) == ("", 1)
    motion = stage.post("motion")
    assert (end_of(action), len(dropped)) == ("another order was given", 2)
    mode = stage.post("mode", mode=LOITER)
    stage.arbiter.order(LOITER)
    assert (end_of(motion), end_of(mode)) == (NEWER, NEWER)


def test_arming_and_posted_arming_supersede_each_other() -> None:
    stage = Stage()
    posted = stage.post("arm", armed=True)
    with stage.arbiter.auxiliary_order() as order, stage.arbiter.sending(order, armed=True) as sending:
        assert end_of(posted) == NEWER
        stage.post("arm", armed=False)
        assert sending.end == NEWER
    assert stage.arbiter.arm_commands_sent == 3


def test_reboot_ends_all_orders() -> None:
    stage = Stage()
    order = stage.post("arm", armed=True)
    stage.arbiter.on_reboot()
    assert end_of(order) == "the vehicle rebooted"


def long(command: int) -> m.CommandLong:
    return m.CommandLong(1, 0, command, *(0,) * 8)


@pytest.mark.parametrize(
    ("message", "subjects"),
    [
        (m.SetMode(1, 1, 5), {"mode", "motion"}),
        *((long(number), {"mode", "motion"}) for number in (SET_MODE, 20, 21, 84, 85, 185, 252, 300)),
        *((long(number), {"motion"}) for number in (16, 17, 18, 19, 22, 34, 192, 193)),
        (long(ARM), {"arm"}),
        (long(178), set()),
        (m.CommandInt(1, 0, 6, 192, *(0,) * 9), {"motion"}),
        (m.SetPositionTargetLocalNed(0, 1, 0, 8, 0x0DC7, *(0,) * 11), {"motion"}),
        (m.MissionSetCurrent(1, 1, 3), {"motion"}),
        (m.MissionItemInt(1, 0, 0, 6, 16, 2, 0, 0, 0, 0, 0, 0, 0, 10), {"motion"}),
        (m.MissionItemInt(1, 0, 0, 6, 16, 0, 1, 0, 0, 0, 0, 0, 0, 10), set()),
        (m.Heartbeat(2, 3, 0, 0, 3, 3), set()),
    ],
)
def test_raw_messages_have_subjects(message: Any, subjects: set[str]) -> None:
    assert set(subjects_of(message)) == subjects


# ------------------------------------------------------------------------------------------ in flight


@pytest.mark.anyio
async def test_posted_mode_arm_take_off_without_waiting(grounded: Flight) -> None:
    """Each is sent at once, before the previous one is acknowledged; lost acks are compensated."""
    vehicle, wire = grounded.vehicle, grounded.wire
    for command in (SET_MODE, ARM):
        grounded.copter.faults.lose_ack(command, times=1)
    guided = vehicle.autopilot.find_mode("GUIDED")

    async def mode() -> None:
        with vehicle.posted("mode", "motion", modes=(guided,)) as order:
            await order.command(SET_MODE, *vehicle.autopilot.mode_order(guided).params)
            await order.wait_confirmed(5)

    async def arm() -> None:
        with vehicle.posted("arm", armed=True) as order:
            await order.command(ARM, 1)
            await order.wait_confirmed(5)

    async def take_off() -> None:
        with vehicle.posted("motion") as order:
            await order.command(TAKEOFF, 0, 0, 0, 0, 0, 0, 5)

    started = now()
    async with anyio.create_task_group() as tasks:
        for action in (mode, arm, take_off):
            tasks.start_soon(action)
    sent = [
        at for command in (SET_MODE, ARM, TAKEOFF) for at, message in wire.sent if message in wire.commands(command)
    ]
    assert sent == [started] * 3  # None is repeated: HEARTBEAT reported the effects of the unacknowledged commands.
    await vehicle.position.wait_until(lambda here: (here.altitude_relative_m or 0) > 4.5, timeout=20)


@pytest.mark.anyio
async def test_posted_order_ends_by_pilot_or_newer_order(flying: Flight) -> None:
    vehicle, faults = flying.vehicle, flying.copter.faults
    faults.ignore(MavCmd.DO_REPOSITION)
    with vehicle.posted("motion") as order:
        flying.pilot_takes_over()
        with pytest.raises(OperationRejected, match=f"not sent again: {TAKEN}"):
            await order.command_int(MavCmd.DO_REPOSITION, -1, frame=6, x=1, y=1, z=20)
        assert order.end.startswith(TAKEN)
    await vehicle.set_mode("GUIDED")
    with vehicle.posted("motion") as order:
        vehicle.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 0x0DC7, *(0,) * 11))
        with pytest.raises(OperationRejected, match=f"{NEWER}; the rest of the order was not sent"):
            await order.command_int(MavCmd.DO_REPOSITION, -1, frame=6, x=1, y=1, z=20)
    assert len(flying.wire.commands(MavCmd.DO_REPOSITION)) == 1


@pytest.mark.anyio
async def test_message_to_other_system_is_no_order(flying: Flight) -> None:
    vehicle = flying.vehicle
    others = (
        m.CommandLong(vehicle.system_id + 1, 1, MavCmd.NAV_LAND, 0, *(0,) * 7),
        m.SetMode(vehicle.system_id + 1, 1, 9),
        m.SetPositionTargetLocalNed(0, vehicle.system_id + 1, 1, 1, 0x0DC7, *(0,) * 11),
    )
    with vehicle.posted("motion") as order:
        for other in others:
            vehicle.send(other)
            assert (other.NAME, order.end) == (other.NAME, "")
        vehicle.send(m.SetPositionTargetLocalNed(0, 0, 0, 1, 0x0DC7, *(0,) * 11))  # to everybody
        assert order.end == NEWER


@pytest.mark.anyio
async def test_set_mode_without_custom_flag_has_no_modes(flying: Flight) -> None:
    vehicle = flying.vehicle
    vehicle.send(m.SetMode(vehicle.system_id, 0, CopterMode.LOITER))
    flying.copter.set_mode(CopterMode.LOITER)
    await vehicle.mode.wait_until(lambda mode: mode.name == "LOITER", timeout=5)
    assert vehicle.taken_over == ""  # the mode may be the effect of the order
    await anyio.sleep(MODE_GRACE_S)
    flying.copter.set_mode(CopterMode.ALT_HOLD)
    await vehicle.mode.wait_until(lambda mode: mode.name == "ALT_HOLD", timeout=5)
    assert vehicle.taken_over == "the mode changed to ALT_HOLD"


@pytest.mark.anyio
async def test_rest_of_superseded_order_is_not_sent(flying: Flight) -> None:
    vehicle = flying.vehicle
    place: dict[str, Any] = {"frame": 6, "x": 1, "y": 1, "z": 20.0}
    with vehicle.posted("motion") as order:
        await order.command(MavCmd.DO_SET_ROI_NONE)
        flying.pilot_takes_over()
        await anyio.sleep(2)
        with pytest.raises(OperationRejected, match=f"{TAKEN}.*; the rest of the order was not sent"):
            await order.command_int(MavCmd.DO_REPOSITION, -1, **place)
    with vehicle.posted("motion") as order:
        await order.command(MavCmd.DO_SET_ROI_NONE)
        await vehicle.set_mode("GUIDED")
        with pytest.raises(OperationRejected, match=f"{NEWER}; the rest of the order was not sent"):
            await order.command_int(MavCmd.DO_REPOSITION, -1, **place)
    assert not flying.wire.commands(MavCmd.DO_REPOSITION)


@pytest.mark.anyio
async def test_posted_order_ends_action_without_hold() -> None:
    async with in_the_air() as flight:
        vehicle, errors = flight.vehicle, list[str]()

        async def fly() -> None:
            try:
                await vehicle.go_to(vehicle.position.value.offset(north_m=200))
            except OperationRejected as error:
                errors.append(str(error))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(fly)
            await anyio.sleep(3)
            with vehicle.posted("motion") as order:
                here = vehicle.position.value
                x, y = round(here.latitude_deg * 1e7), round(here.longitude_deg * 1e7)
                await order.command_int(MavCmd.DO_REPOSITION, -1, frame=6, x=x, y=y, z=20)
        assert len(errors) == 1
        assert "another order was given" in errors[0]
        await anyio.sleep(3)
        assert not flight.wire.mode_orders()


@pytest.mark.anyio
async def test_posted_mode_before_flight_is_no_takeover() -> None:
    """The flight is ordered before HEARTBEAT reports the mode: no takeover, and the flight is monitored."""
    async with in_the_air(latency_s=0.5) as flight:
        vehicle, reported = flight.vehicle, flight.vehicle.telemetry.armed
        loiter = vehicle.autopilot.find_mode("LOITER")

        async def post() -> None:
            with vehicle.posted("mode", "motion", modes=(loiter,)) as order:
                await order.command(SET_MODE, *vehicle.autopilot.mode_order(loiter).params)
                await order.wait_confirmed(5)

        before = reported.updated_at
        await reported.wait_until(lambda _: reported.updated_at > before, timeout=5)
        await anyio.sleep(0.45)
        observed = list[Any]()
        flight.vehicle.telemetry.mode.observe(lambda _, mode: observed.append(str(mode)))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(post)
            await anyio.sleep(0.6)
            await vehicle.go_to(vehicle.position.value.offset(north_m=30))
        assert observed == ["LOITER", "GUIDED"]


@pytest.mark.anyio
async def test_accepted_order_ends_when_newer_one_is_posted(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    loiter, guided = map(vehicle.autopilot.find_mode, ("LOITER", "GUIDED"))
    grounded.copter.faults.refuse(SET_MODE, MavResult.ACCEPTED, times=1)
    with vehicle.posted("mode", modes=(loiter,)) as order:
        await order.command(SET_MODE, *vehicle.autopilot.mode_order(loiter).params)
        with vehicle.posted("mode", modes=(guided,)) as newer_order:
            await newer_order.set_mode(guided)
            with pytest.raises(OperationRejected, match=r"^posted order: another order was given"):
                await order.wait_confirmed(5)


@pytest.mark.anyio
async def test_posted_order_errors_say_why(grounded: Flight) -> None:
    vehicle, faults = grounded.vehicle, grounded.copter.faults
    faults.refuse(ARM, MavResult.FAILED, "PreArm: Compass not healthy")
    with (
        vehicle.posted("arm", armed=True) as order,
        pytest.raises(CommandRejected, match="Compass not healthy"),
    ):
        await order.command(ARM, 1)
    faults.refuse(ARM, MavResult.ACCEPTED)
    with vehicle.posted("arm", armed=True) as order:
        await order.command(ARM, 1)
        with pytest.raises(OperationTimeout, match=r"not done within 2 s; the vehicle is in STABILIZE, not armed"):
            await order.wait_confirmed(2)
        grounded.copter.send(m.CommandAck(ARM, MavResult.DENIED, 0, 0, 255, vehicle.connection.source_component))
        with pytest.raises(CommandRejected, match="DENIED"):  # taken back
            await order.wait_confirmed(2)
    with pytest.raises(InvalidArgument, match="needs at least one subject"), vehicle.posted():
        pass
    grounded.wire.clear()
    with pytest.raises(InvalidArgument, match="requires armed=True or armed=False"), vehicle.posted("arm"):
        pass
    with pytest.raises(InvalidArgument, match="the `with` block of this order was left"):
        await order.command(ARM, 1)
    assert not grounded.wire.commands(ARM)


@pytest.mark.anyio
async def test_command_int_unsupported_falls_back_to_command_long(flying: Flight) -> None:
    flying.copter.faults.refuse(MavCmd.DO_SET_HOME, MavResult.COMMAND_LONG_ONLY)
    place: dict[str, Any] = {"x": 10_000_000, "y": 20_000_000, "z": 30.0}
    with pytest.raises(CommandRejected):
        await flying.vehicle.command_int(MavCmd.DO_SET_HOME, 0, frame=0, **place, or_long=True)
    first, second = flying.wire.commands(MavCmd.DO_SET_HOME)
    assert isinstance(first, m.CommandInt)
    assert isinstance(second, m.CommandLong)
    assert (second.param5, second.param6, second.param7) == (1.0, 2.0, 30.0)
    with pytest.raises(InvalidArgument, match="frame = 6 is not allowed with or_long"):
        await flying.vehicle.command_int(MavCmd.DO_SET_HOME, 0, frame=6, **place, or_long=True)


@pytest.mark.anyio
async def test_posted_arming_is_not_undone_by_abandoned_arm(grounded: Flight) -> None:
    """An abandoned `arm()` is monitored for 15 s; an arming posted in this time is intended."""
    vehicle, faults = grounded.vehicle, grounded.copter.faults
    await vehicle.set_mode("GUIDED")
    faults.ignore(ARM, times=1)
    with pytest.raises(CommandTimeout):
        await vehicle.arm()
    with vehicle.posted("arm", armed=True) as order:
        await order.command(ARM, 1)
    await anyio.sleep(5)
    assert vehicle.is_armed


@pytest.mark.anyio
@pytest.mark.parametrize("is_posted", [True, False])
async def test_disarm_before_armed_report_keeps_pilots_arming(is_posted: bool) -> None:
    """Arming and disarming are reported after the disarm command; its ack is lost, and a pilot arms."""
    async with open_flight(latency_s=0.3) as flight:
        vehicle, armed = flight.vehicle, flight.vehicle.telemetry.armed
        await vehicle.wait_ready()
        await vehicle.set_mode("STABILIZE")
        reported_at = armed.updated_at
        await armed.wait_until(lambda _: armed.updated_at > reported_at)
        flight.copter.faults.lose_ack(ARM, times=2)
        with anyio.move_on_after(0.55):
            await vehicle.arm()
        assert armed.latest is False

        async def disarm() -> None:
            if is_posted:
                with vehicle.posted("arm", armed=False) as order:
                    await order.command(ARM, 0)
            else:
                await vehicle.disarm()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(disarm)
            await armed.wait_until(lambda value: value)
            await armed.wait_until(lambda value: not value)
            flight.copter.arming.arm()
            await anyio.sleep(5)
        assert [command.param1 for command in flight.wire.commands(ARM)] == [1, 0]
        assert vehicle.is_armed


@pytest.mark.anyio
async def test_classic_arming_a_pilot_ends_says_it_may_still_come(grounded: Flight) -> None:
    grounded.copter.faults.ignore(ARM)
    async with anyio.create_task_group() as tasks:

        async def arm() -> None:
            with pytest.raises(OperationRejected, match=r"the mode changed to .*may still execute the command"):
                await arm_or_disarm(grounded.vehicle, True)

        tasks.start_soon(arm)
        await anyio.sleep(0.5)
        grounded.pilot_takes_over()


@pytest.mark.anyio
async def test_set_heading_after_refused_mode_returns_to_guided() -> None:
    """RTL is active but not reported yet, and LAND is refused: the last report, GUIDED, is outdated."""
    async with in_the_air(latency_s=0.1) as flight:
        vehicle, faults, armed = flight.vehicle, flight.copter.faults, flight.vehicle.telemetry.armed
        reported_at = armed.updated_at
        await armed.wait_until(lambda _: armed.updated_at > reported_at)
        faults.lose(m.Heartbeat, times=1)
        with anyio.move_on_after(0.05):
            await vehicle.set_mode("RTL")
        await anyio.sleep(0.1)
        faults.refuse(SET_MODE, times=1)
        with pytest.raises(CommandRejected):
            await vehicle.set_mode("LAND")
        await vehicle.set_heading((vehicle.heading_deg.value + 90) % 360)
        assert flight.wire.mode_orders() == [CopterMode.RTL, CopterMode.LAND, CopterMode.GUIDED]


@pytest.mark.anyio
async def test_set_mode_base_mode_and_temporary_rejection_are_handled(grounded: Flight) -> None:
    vehicle, wire, faults = grounded.vehicle, grounded.wire, grounded.copter.faults
    guided, loiter = map(vehicle.autopilot.find_mode, ("GUIDED", "LOITER"))
    faults.refuse(SET_MODE, MavResult.UNSUPPORTED)
    with vehicle.posted("mode", modes=(guided,)) as order:
        with pytest.raises(InvalidArgument, match="mode = LOITER is not allowed"):
            await order.set_mode(loiter)
        await order.set_mode(guided)
    assert (vehicle.mode_name, len(wire.all(m.SetMode)), len(wire.commands(SET_MODE))) == ("GUIDED", 1, 1)
    faults.refuse(SET_MODE, MavResult.TEMPORARILY_REJECTED, times=2)
    with vehicle.posted("mode", modes=(loiter,)) as order:
        await order.set_mode(loiter)
    assert (vehicle.mode_name, len(wire.commands(SET_MODE))) == ("LOITER", 4)
    faults.refuse(SET_MODE, MavResult.TEMPORARILY_REJECTED)
    with vehicle.posted("mode", modes=(guided,)) as order, pytest.raises(CommandRejected):
        await order.set_mode(guided)
    assert len(wire.commands(SET_MODE)) == 4 + MAX_MODE_ATTEMPTS


@pytest.mark.anyio
@pytest.mark.parametrize("is_back", [False, True])
async def test_posted_mode_is_not_repeated_in_silence_or_after_takeover(is_back: bool) -> None:
    """After a TEMPORARILY_REJECTED, only a HEARTBEAT shows which party is in control."""
    async with in_the_air() as flight:
        vehicle, faults = flight.vehicle, flight.copter.faults
        land = vehicle.autopilot.find_mode("LAND")
        faults.refuse(SET_MODE, MavResult.TEMPORARILY_REJECTED, times=1)
        faults.heartbeats_stopped = True
        await anyio.sleep(8)
        flight.wire.clear()
        flight.pilot_takes_over()
        async with anyio.create_task_group() as tasks:

            async def back() -> None:
                await anyio.sleep(2)
                faults.heartbeats_stopped = False

            if is_back:
                tasks.start_soon(back)
            with vehicle.posted("mode", "motion", modes=(land,)) as order, pytest.raises(CommandRejected):
                await order.set_mode(land)
        assert flight.wire.mode_orders() == [land.custom_mode]


@pytest.mark.anyio
async def test_orders_before_reboot_end(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    guided = vehicle.autopilot.find_mode("GUIDED")
    with vehicle.posted("mode", modes=(guided,)) as order:
        before = order.end
        await anyio.sleep(60)
        grounded.copter.reboot(2.0)
        await anyio.sleep(15)
        assert (before, order.end) == ("", "the vehicle rebooted")


@pytest.mark.anyio
@pytest.mark.parametrize("after_s", [0.1, 0.7])  # before, and during the wait that follows the refusal
async def test_mode_reported_after_refusal_succeeds(grounded: Flight, after_s: float) -> None:
    vehicle, faults = grounded.vehicle, grounded.copter.faults
    guided = vehicle.autopilot.find_mode("GUIDED")
    faults.refuse(SET_MODE, MavResult.TEMPORARILY_REJECTED, times=1)
    async with anyio.create_task_group() as tasks:
        with vehicle.posted("mode", modes=(guided,)) as order:
            tasks.start_soon(order.set_mode, guided)
            await anyio.sleep(after_s)
            grounded.copter.set_mode(guided.custom_mode)
            await anyio.sleep(8)
    assert grounded.wire.mode_orders() == [guided.custom_mode]


@pytest.mark.anyio
async def test_refused_second_mode_of_posted_order_raises(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    guided, loiter = map(vehicle.autopilot.find_mode, ("GUIDED", "LOITER"))
    with vehicle.posted("mode", modes=(guided, loiter)) as order:
        await order.set_mode(guided)
        grounded.copter.faults.refuse(SET_MODE, MavResult.DENIED)
        with pytest.raises(CommandRejected, match="DENIED"):
            await order.set_mode(loiter)
    assert vehicle.mode_name == "GUIDED"


@pytest.mark.anyio
@pytest.mark.parametrize("ends", ["the order", "the vehicle", "silence"])
async def test_legacy_set_mode_is_not_sent_in_silence(grounded: Flight, ends: str) -> None:
    vehicle, faults = grounded.vehicle, grounded.copter.faults
    guided = vehicle.autopilot.find_mode("GUIDED")
    faults.refuse(SET_MODE, MavResult.UNSUPPORTED)
    if ends == "silence":
        faults.heartbeats_stopped = True
        await anyio.sleep(8)
        with pytest.raises(CommandRejected):
            await vehicle.set_mode("GUIDED")
    failed: list[Exception] = []
    posted = ExitStack()
    order = posted.enter_context(vehicle.posted("mode", modes=(guided,)))

    async def set_mode() -> None:
        try:
            await order.set_mode(guided)
        except (OperationRejected, ConnectionClosed) as error:
            failed.append(error)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(set_mode)
        await anyio.sleep(0.1)
        if ends == "the order":
            posted.close()
        elif ends == "the vehicle":
            vehicle._session.close()
        await anyio.sleep(2)
    assert failed
    assert not grounded.wire.all(m.SetMode)


@pytest.mark.anyio
async def test_posted_mode_superseded_is_not_repeated(grounded: Flight) -> None:
    vehicle, wire = grounded.vehicle, grounded.wire
    guided, loiter = map(vehicle.autopilot.find_mode, ("GUIDED", "LOITER"))
    grounded.copter.faults.refuse(SET_MODE, MavResult.TEMPORARILY_REJECTED, times=1)

    async def post() -> None:
        with vehicle.posted("mode", modes=(guided,)) as order, pytest.raises(CommandRejected):
            await order.set_mode(guided)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(post)
        await anyio.sleep(0.3)
        with vehicle.posted("mode", modes=(loiter,)) as newer:
            await newer.set_mode(loiter)
    assert wire.mode_orders() == [guided.custom_mode, loiter.custom_mode]
    assert vehicle.mode_name == "LOITER"


@pytest.mark.parametrize(("waited_s", "end"), [(9.0, ""), (11.0, TAKEN)])
def test_mode_ordered_ten_seconds_ago_is_takeover(waited_s: float, end: str) -> None:
    stage = Stage()
    stage.post("mode", mode=GUIDED)
    stage.now += waited_s
    motion = stage.post("motion")
    stage.report(GUIDED)
    assert end_of(motion) == end


@pytest.mark.anyio
async def test_rejected_mode_that_waits_for_heartbeat_ends_with_vehicle_block() -> None:
    async with open_flight() as flight:
        vehicle = flight.vehicle
        flight.copter.faults.refuse(SET_MODE, MavResult.TEMPORARILY_REJECTED)

        async def change_mode() -> None:
            with vehicle.posted("mode", modes=(GUIDED,)) as posted:
                await posted.set_mode(GUIDED, timeout=30.0)

        changing = asyncio.ensure_future(change_mode())
        await anyio.sleep(0.1)
        flight.copter.faults.heartbeats_stopped = True
        await anyio.sleep(1.0)
    with pytest.raises(ConnectionClosed):
        await changing
