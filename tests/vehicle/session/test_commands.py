"""Any command by number, rebooting, and concurrent commands."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable
from contextlib import nullcontext

import anyio
import pytest
from flight_harness import Flight, now, open_flight

from aerokit import messages as m
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    ConnectionClosed,
    InvalidArgument,
    LinkLost,
    OperationRejected,
    OperationTimeout,
)
from aerokit.events import VehicleRebooted
from aerokit.mavlink import FrameEncoder, Message
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult
from aerokit.sim import BootTimeline, ExtraComponent, SimulatedCopter

pytestmark = pytest.mark.anyio

REBOOT = MavCmd.PREFLIGHT_REBOOT_SHUTDOWN
BANNER = MavCmd.DO_SEND_BANNER
SERVO = MavCmd.DO_SET_SERVO


# -------------------------------------------------------------------------------- LONG and INT


async def test_command_long_returns_ack(grounded: Flight) -> None:
    ack = await grounded.vehicle.command(MavCmd.GET_MESSAGE_INTERVAL, m.Attitude.ID)
    assert ack.result == MavResult.ACCEPTED
    assert (ack.target_system, ack.target_component) == (255, 190)
    (sent,) = grounded.wire.commands(MavCmd.GET_MESSAGE_INTERVAL)
    assert isinstance(sent, m.CommandLong)
    assert (sent.target_system, sent.target_component, sent.confirmation) == (1, 1, 0)
    assert (sent.param1, sent.param2, sent.param7) == (m.Attitude.ID, 0.0, 0.0)


async def test_command_int_returns_ack(flying: Flight) -> None:
    ack = await flying.vehicle.command_int(
        MavCmd.DO_REPOSITION, -1, 1, 0, math.nan, frame=6, x=-353632610, y=1491652299, z=12.5
    )
    assert ack.result == MavResult.ACCEPTED
    (sent,) = flying.wire.commands(MavCmd.DO_REPOSITION)
    assert isinstance(sent, m.CommandInt)
    assert (sent.frame, sent.x, sent.y, sent.z) == (6, -353632610, 1491652299, 12.5)
    assert (sent.param1, sent.param2) == (-1.0, 1.0)
    assert math.isnan(sent.param4)


@pytest.mark.parametrize(
    "result",
    [
        MavResult.TEMPORARILY_REJECTED,
        MavResult.DENIED,
        MavResult.UNSUPPORTED,
        MavResult.FAILED,
    ],
)
async def test_every_other_result_is_a_typed_error(grounded: Flight, result: MavResult) -> None:
    grounded.copter.faults.refuse(BANNER, result, "Because I say so")
    with pytest.raises(CommandRejected) as caught:
        await grounded.vehicle.command(BANNER)
    assert (caught.value.command, caught.value.result) == (BANNER, result)
    assert caught.value.reasons == ("Because I say so",)
    assert f"MAV_CMD_DO_SEND_BANNER was refused: {result.name}" in str(caught.value)


async def test_command_unsupported_raises(grounded: Flight) -> None:
    with pytest.raises(CommandRejected, match="does not know the command"):
        await grounded.vehicle.command(31_000)


async def test_command_invalid_parameters_are_not_sent(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    with pytest.raises(InvalidArgument, match="at most 7"):
        await vehicle.command(BANNER, *range(8))
    with pytest.raises(InvalidArgument, match="param2"):
        await vehicle.command(BANNER, 0, math.inf)
    with pytest.raises(InvalidArgument, match="x = "):
        await vehicle.command_int(MavCmd.DO_REPOSITION, frame=6, x=2**31)
    with pytest.raises(InvalidArgument, match="retries"):
        await vehicle.command(BANNER, retries=-1)
    assert not grounded.wire.commands(BANNER)
    assert not grounded.wire.commands(MavCmd.DO_REPOSITION)


# ------------------------------------------------------------------------- retries and progress


async def test_command_retries_increment_confirmation(grounded: Flight) -> None:
    grounded.copter.faults.ignore(BANNER, times=2)
    started = now()
    await grounded.vehicle.command(BANNER, retries=3)
    assert [command.confirmation for command in grounded.wire.commands(BANNER)] == [0, 1, 2]  # type: ignore[union-attr]
    assert 1.5 <= now() - started <= 3.1  # each time right after a heartbeat


async def with_text_during(flight: Flight, call: Awaitable[object]) -> None:
    """Await a call; half a second later the vehicle sends a status text."""
    loop = asyncio.get_running_loop()
    loop.call_later(0.5, flight.copter.send_text, 4, "Terrain data missing")
    await call


async def test_command_timeout_lists_link_state(grounded: Flight) -> None:
    grounded.copter.faults.ignore(BANNER)
    started = now()
    with pytest.raises(CommandTimeout) as caught:
        await with_text_during(grounded, grounded.vehicle.command(BANNER, retries=2, attempt_timeout=1.0))
    assert now() - started == pytest.approx(3.0, abs=0.6)
    text = str(caught.value)
    assert "no COMMAND_ACK for MAV_CMD_DO_SEND_BANNER, sent 3 times within" in text
    assert "last heartbeat 0." in text
    assert "0 % of the vehicle's frames lost" in text
    assert "status texts: Terrain data missing" in text


async def test_progress_extends_the_deadline_and_is_reported(grounded: Flight) -> None:
    grounded.copter.faults.report_progress(BANNER, (10, 50, 90), interval_s=4.0)
    observed: list[int | None] = []
    started = now()
    await grounded.vehicle.command(BANNER, on_progress=observed.append)
    assert observed == [10, 50, 90]
    assert now() - started == pytest.approx(12.0, abs=0.1)
    assert len(grounded.wire.commands(BANNER)) == 1


async def test_command_progress_timeout_is_configurable(grounded: Flight) -> None:
    grounded.copter.faults.report_progress(BANNER, (10, 50), interval_s=25.0)
    with pytest.raises(CommandTimeout, match="no COMMAND_ACK for 10 s"):
        await grounded.vehicle.command(BANNER)
    grounded.copter.faults.report_progress(BANNER, (10, 50), interval_s=25.0)
    assert (await grounded.vehicle.command(BANNER, progress_timeout=30.0)).result == MavResult.ACCEPTED


async def test_progress_that_stops_is_a_timeout(grounded: Flight) -> None:
    grounded.copter.faults.report_progress(BANNER, (10, 50), interval_s=1.0)
    async with anyio.create_task_group() as tasks:

        async def radio_fails() -> None:
            await anyio.sleep(1.5)
            grounded.copter.faults.silent = True

        tasks.start_soon(radio_fails)
        with pytest.raises(CommandTimeout, match="was in progress, then no COMMAND_ACK for 10 s"):
            await grounded.vehicle.command(BANNER)


async def test_command_progress_callback_raises_command_continues(grounded: Flight) -> None:
    grounded.copter.faults.report_progress(BANNER, (10,), interval_s=0.5)

    def fail(percent: int | None) -> None:
        raise ZeroDivisionError

    await grounded.vehicle.command(BANNER, on_progress=fail)


# ----------------------------------------------------------------------------- two at a time


async def test_equal_commands_are_serialized_with_own_acks(grounded: Flight) -> None:
    grounded.copter.faults.delay_ack(MavCmd.GET_MESSAGE_INTERVAL, 0.5)
    finished: list[float] = []

    async def ask() -> None:
        await grounded.vehicle.command(MavCmd.GET_MESSAGE_INTERVAL, m.Attitude.ID)
        finished.append(now())

    started = now()
    async with anyio.create_task_group() as tasks:
        for _ in range(3):
            tasks.start_soon(ask)
    assert [at - started for at in finished] == pytest.approx([0.5, 1.0, 1.5], abs=0.01)
    assert len(grounded.wire.commands(MavCmd.GET_MESSAGE_INTERVAL)) == 3


async def test_equal_commands_to_two_components_keep_own_acks() -> None:
    """A camera does not answer; the autopilot's answer to the same command is not the camera's."""
    camera = ExtraComponent(100, type=30)
    async with open_flight(SimulatedCopter(boot_time_s=0.0, components=[camera])) as flight:
        vehicle = flight.vehicle
        await vehicle.wait_ready()
        async with anyio.create_task_group() as tasks:

            async def ask_the_autopilot() -> None:
                await anyio.sleep(0.2)
                await vehicle.command(MavCmd.REQUEST_MESSAGE, m.AutopilotVersion.ID)

            tasks.start_soon(ask_the_autopilot)
            with pytest.raises(CommandTimeout):
                await vehicle.command(MavCmd.REQUEST_MESSAGE, m.CameraInformation.ID, component_id=100, retries=1)


async def test_command_cancelled_releases_lock_and_ignores_late_ack(grounded: Flight) -> None:
    grounded.copter.faults.ignore(BANNER, times=1)
    with anyio.move_on_after(0.3):
        await grounded.vehicle.command(BANNER)
    started = now()
    await grounded.vehicle.command(BANNER)
    assert now() - started < 2.1  # the first answer may be that to the cancelled one


async def test_ack_for_another_station_leaves_late_ack_expected(grounded: Flight) -> None:
    question = MavCmd.GET_MESSAGE_INTERVAL
    grounded.copter.faults.ignore(question)
    with anyio.move_on_after(0.3):
        await grounded.vehicle.command(question, m.Attitude.ID)
    grounded.copter.send(m.CommandAck(question, MavResult.ACCEPTED, 0, 0, 254, 190))
    await anyio.sleep(0.1)

    async def answer() -> None:
        for result in (MavResult.ACCEPTED, MavResult.DENIED):  # the late answer, and that to the second question
            await anyio.sleep(0.1)
            grounded.copter.send(m.CommandAck(question, result, 0, 0, 255, 190))

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(answer)
        with pytest.raises(CommandRejected):
            await grounded.vehicle.command(question, m.HomePosition.ID)


async def test_copy_of_ack_does_not_acknowledge_next_command(grounded: Flight) -> None:
    ack = await grounded.vehicle.command(SERVO, 9, 1900)
    assert ack.received_frame is not None
    grounded.copter.faults.ignore(SERVO)

    async def deliver_copy() -> None:
        await anyio.sleep(0.1)
        assert ack.received_frame is not None
        grounded.wire.deliver(ack.received_frame.raw)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(deliver_copy)
        with pytest.raises(CommandTimeout):
            await grounded.vehicle.command(SERVO, 9, 1100)


@pytest.mark.parametrize(("frames_between", "is_new"), [(255, True), (150, False)])
async def test_equal_ack_after_256_frames_is_new(grounded: Flight, frames_between: int, is_new: bool) -> None:
    """Sequence numbers repeat after 256 frames, which a fast simulation sends in less than a second."""
    camera = FrameEncoder(1, 100)
    sent = camera.encode(m.CommandAck(MavCmd.IMAGE_START_CAPTURE, MavResult.ACCEPTED))
    grounded.wire.deliver(sent)

    async def answer() -> None:
        await anyio.sleep(0.1)
        for _ in range(frames_between):
            grounded.wire.deliver(camera.encode(m.SystemTime(0, 0)))
        grounded.wire.deliver(sent)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(answer)
        with nullcontext() if is_new else pytest.raises(CommandTimeout):
            await grounded.vehicle.command(MavCmd.IMAGE_START_CAPTURE, component_id=100)


async def test_equal_acks_of_component_with_constant_sequence_count(grounded: Flight) -> None:
    """Its acks of two commands are equal. They are no copies, because its HEARTBEAT has the same sequence number."""

    def send(message: Message) -> None:
        grounded.wire.deliver(FrameEncoder(1, 100).encode(message))

    async def answer() -> None:
        await anyio.sleep(0.1)
        send(m.Heartbeat(30, 8, 0, 0, 4))
        send(m.CommandAck(MavCmd.IMAGE_START_CAPTURE, MavResult.ACCEPTED))

    for _ in range(2):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(answer)
            await grounded.vehicle.command(MavCmd.IMAGE_START_CAPTURE, component_id=100)


async def test_ack_of_component_with_constant_sequence_counts_after_a_second(grounded: Flight) -> None:
    """Its acks are as equal as copies. Its answer to the first or second repetition must count."""
    ack = await grounded.vehicle.command(SERVO, 9, 1900)
    grounded.copter.faults.ignore(SERVO)

    async def answer_each_transmission() -> None:
        assert ack.received_frame is not None
        for _ in range(6):
            await anyio.sleep(0.5)
            grounded.wire.deliver(ack.received_frame.raw)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(answer_each_transmission)
        await grounded.vehicle._session.commands.send_long(SERVO, 9, 1900, attempts=4, attempt_timeout=0.5)


async def test_command_connection_ends_raises(grounded: Flight) -> None:
    grounded.copter.faults.ignore(BANNER)
    async with anyio.create_task_group() as tasks:

        async def pull_the_cable() -> None:
            await anyio.sleep(0.5)
            grounded.wire.lose()

        tasks.start_soon(pull_the_cable)
        with pytest.raises(LinkLost, match="cable"):
            await grounded.vehicle.command(BANNER)
    with pytest.raises(LinkLost):
        await grounded.vehicle.command(BANNER)


async def test_vehicle_after_block_raises_connection_closed() -> None:
    async with open_flight() as flight:
        vehicle = flight.vehicle
    with pytest.raises(ConnectionClosed):
        await vehicle.command(BANNER)
    with pytest.raises(ConnectionClosed):
        await vehicle.set_mode("GUIDED")


# -------------------------------------------------------------------------------------- reboot


async def test_reboot_waits_for_return_and_resets_state(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    with vehicle.subscribe(VehicleRebooted, capacity=10) as events:
        started = now()
        await vehicle.reboot()
        assert now() - started < 10.0
        assert vehicle.position.latest is None or vehicle.position.age < 3.0
        event = await events.get(timeout=1.0)
        assert event.system_id == 1
        assert events.get_nowait() is None
    assert grounded.copter.uptime < 10.0
    await vehicle.wait_ready(timeout=30.0)
    await vehicle.version.wait_until(lambda _: True, timeout=5.0)
    rates = [
        command for command in grounded.wire.commands(MavCmd.SET_MESSAGE_INTERVAL) if command.param1 == m.Attitude.ID
    ]
    assert len(rates) >= 1  # streams are asked for again
    assert vehicle.attitude.fresh(within=0.5)


async def test_reboot_time_is_requested_after_ack(
    grounded: Flight,
) -> None:
    answered_at: list[float] = []
    (detach,) = grounded.vehicle.connection.attach(
        [m.CommandAck], lambda ack: answered_at.append(now()) if ack.command == REBOOT else None
    )
    await grounded.vehicle.reboot()
    detach()
    sent = grounded.wire.sent
    ordered = next(i for i, (_, message) in enumerate(sent) if getattr(message, "command", 0) == REBOOT)
    requested_at = [at for at, message in sent[ordered:] if isinstance(message, m.Timesync)]
    assert requested_at[:1] == answered_at


async def test_reboot_without_streams_is_detected() -> None:
    async with open_flight(rates={}) as flight:
        await anyio.sleep(3.5)
        await flight.vehicle.reboot(timeout=10.0)
        assert flight.copter.uptime < 10.0


async def test_state_before_reboot_is_reset() -> None:
    async with open_flight(SimulatedCopter(boot_time_s=0.0)) as flight:
        await flight.vehicle.wait_ready()
        flight.copter.timeline = BootTimeline().scaled(60.0)
        await anyio.sleep(5.0)
        vehicle = flight.vehicle
        assert (vehicle.position.is_known, vehicle.home.is_known, vehicle.armed.is_known) == (
            True,
            True,
            True,
        )
        await vehicle.reboot()
        await anyio.sleep(2.0)
        assert (vehicle.position.is_known, vehicle.home.is_known, vehicle.armed.is_known) == (
            False,
            False,
            True,
        )
        assert flight.vehicle.missing_for_flight()


async def test_reboot_of_an_armed_vehicle_sends_nothing(flying: Flight) -> None:
    with pytest.raises(OperationRejected, match="armed"):
        await flying.vehicle.reboot()
    assert not flying.wire.commands(REBOOT)


async def test_reboot_forced_while_armed_reboots(flying: Flight) -> None:
    await flying.vehicle.reboot(force=True)
    assert flying.copter.motion.is_on_ground


async def test_reboot_refused(grounded: Flight) -> None:
    grounded.copter.faults.refuse(REBOOT, MavResult.DENIED, "Logging")
    with pytest.raises(CommandRejected, match="Logging"):
        await grounded.vehicle.reboot()


async def test_reboot_vehicle_does_not_return_times_out(grounded: Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def dies() -> None:
            await anyio.sleep(0.05)
            grounded.copter.faults.silent = True

        tasks.start_soon(dies)
        with pytest.raises(OperationTimeout, match=r"reboot: .* did not restart within 8 s; last heartbeat \d"):
            await grounded.vehicle.reboot(timeout=8.0)


async def test_reboot_link_lost_raises(grounded: Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def unplug() -> None:
            await anyio.sleep(0.3)
            grounded.wire.lose()

        tasks.start_soon(unplug)
        with pytest.raises(LinkLost):
            await grounded.vehicle.reboot()


# ----------------------------------------------------------------------------- raw commands


@pytest.mark.parametrize("is_int", [False, True])
async def test_raw_command_ack_lost_is_sent_once(grounded: Flight, is_int: bool) -> None:
    vehicle, command = grounded.vehicle, MavCmd.DO_GRIPPER
    grounded.copter.faults.lose_ack(command)
    with pytest.raises(CommandTimeout, match=r"sent once within 4\.0 s"):
        await (vehicle.command_int(command, 1, frame=0) if is_int else vehicle.command(command, 1))
    assert len(grounded.wire.commands(command)) == 1


async def test_raw_question_ack_lost_is_repeated(grounded: Flight) -> None:
    grounded.copter.faults.ignore(MavCmd.REQUEST_MESSAGE, times=3)
    grounded.wire.clear()
    await grounded.vehicle.command(MavCmd.REQUEST_MESSAGE, m.HomePosition.ID)
    assert len(grounded.wire.commands(MavCmd.REQUEST_MESSAGE)) == 4


@pytest.mark.parametrize(
    ("command", "params", "mode"),
    [
        (MavCmd.NAV_RETURN_TO_LAUNCH, (), "RTL"),
        (MavCmd.NAV_LAND, (), "LAND"),
        (MavCmd.NAV_LOITER_UNLIM, (), "LOITER"),
        (MavCmd.DO_SET_MODE, (1, CopterMode.ALT_HOLD), "ALT_HOLD"),
    ],
)
async def test_raw_command_own_mode_is_no_takeover(
    flying: Flight, command: int, params: tuple[float, ...], mode: str
) -> None:
    await flying.vehicle.command(command, *params)
    await flying.vehicle.mode.wait_until(lambda reported: reported.name == mode, timeout=3)
    await anyio.sleep(5.0)
    assert flying.vehicle.taken_over == ""
    flying.pilot_takes_over(CopterMode.STABILIZE)
    await anyio.sleep(1.5)
    assert "STABILIZE" in flying.vehicle.taken_over


async def test_takeover_after_raw_command_is_reported(flying: Flight) -> None:
    await flying.vehicle.command(MavCmd.NAV_RETURN_TO_LAUNCH)
    await flying.vehicle.mode.wait_until(lambda reported: reported.name == "RTL", timeout=3)
    flying.pilot_takes_over(CopterMode.STABILIZE)
    await anyio.sleep(1.2)
    assert "STABILIZE" in flying.vehicle.taken_over


async def test_raw_arm_does_not_explain_takeover(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    await grounded.vehicle.armed.wait_until(bool, timeout=3)
    assert grounded.vehicle.is_flown_by_program
    grounded.copter.set_mode(CopterMode.STABILIZE)
    await anyio.sleep(1.5)
    assert "STABILIZE" in grounded.vehicle.taken_over
    assert not grounded.vehicle.is_flown_by_program


@pytest.mark.parametrize("name", ["land", "return_to_launch"])
async def test_land_lost_during_failsafe_is_repeated(flying: Flight, name: str) -> None:
    """ArduCopter only warns: without a second order it hovers until the battery is empty."""
    flying.copter.faults.ignore(MavCmd.DO_SET_MODE, times=1)
    flying.copter.parameters["BATT_LOW_MAH"] = flying.copter.parameters["BATT_CAPACITY"]
    await getattr(flying.vehicle, name)()
    assert len(flying.wire.commands(MavCmd.DO_SET_MODE)) == 2


@pytest.mark.parametrize(("fault", "requests"), [("none", 1), ("lost", 2), ("refused", 3)])
async def test_modes_are_requested_until_received(fault: str, requests: int) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    if fault == "lost":  # The request is acknowledged, but the modes do not arrive.
        copter.faults.lose(m.AvailableModes, times=len(copter.available_modes()))
    if fault == "refused":
        copter.faults.refuse(MavCmd.REQUEST_MESSAGE, MavResult.FAILED)
    async with open_flight(copter) as flight:
        await anyio.sleep(60)
        sent = flight.wire.commands(MavCmd.REQUEST_MESSAGE)
        assert len([command for command in sent if command.param1 == m.AvailableModes.ID]) == requests
