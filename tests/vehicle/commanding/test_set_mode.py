"""Mode changes: by name and number, refused, revoked, not executed, and on firmware without the command."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import Flight, in_the_air, now, open_flight, open_px4

from aerokit import messages as m
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult
from aerokit.sim import SimulatedCopter

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("mode", ["GUIDED", "guided", "Alt Hold", "ALT_HOLD", "althold", 4, CopterMode.LAND])
async def test_set_mode_by_name_and_number(grounded: Flight, mode: str | int) -> None:
    await grounded.vehicle.set_mode(mode)
    wanted = grounded.vehicle.autopilot.find_mode(mode)
    assert grounded.copter.mode.number == wanted.custom_mode
    assert grounded.vehicle.mode.value == wanted
    (command,) = grounded.wire.commands(MavCmd.DO_SET_MODE)
    assert isinstance(command, m.CommandLong)
    assert (command.target_system, command.param1, command.param2) == (1, 1.0, wanted.custom_mode)


async def test_set_mode_unknown_name_lists_modes_and_sends_nothing(grounded: Flight) -> None:
    with pytest.raises(InvalidArgument) as caught:
        await grounded.vehicle.set_mode("GIUDED")
    text = str(caught.value)
    assert "'GIUDED' is not known (did you mean 'GUIDED'?)" in text
    assert all(name in text for name in ("STABILIZE", "LOITER", "RTL", "SMART_RTL", "BRAKE"))
    assert not grounded.wire.commands(MavCmd.DO_SET_MODE)


async def test_set_mode_refused_says_why(flying: Flight) -> None:
    with pytest.raises(CommandRejected) as caught:
        await flying.vehicle.set_mode("AUTO")
    assert caught.value.result == MavResult.FAILED
    assert caught.value.command == MavCmd.DO_SET_MODE
    assert caught.value.reasons == ("Mode change to AUTO failed: init failed",)
    assert flying.vehicle.mode_name == "GUIDED"


async def test_set_mode_unsupported_sends_legacy_message() -> None:
    copter = SimulatedCopter(boot_time_s=0.0, unsupported_commands=[MavCmd.DO_SET_MODE])
    async with open_flight(copter) as flight:
        await flight.vehicle.set_mode("GUIDED")
        assert copter.mode.number == CopterMode.GUIDED
        assert flight.wire.all(m.SetMode) == [m.SetMode(1, 1, CopterMode.GUIDED)]


async def test_posted_mode_silent_vehicle_times_out_without_repeat(grounded: Flight) -> None:
    grounded.copter.faults.silent = True
    with pytest.raises(
        CommandTimeout, match=r"MAV_CMD_DO_SET_MODE, sent once within 4\.0 s; not sent again: no HEARTBEAT received"
    ):
        await grounded.vehicle.set_mode("GUIDED")


@pytest.mark.parametrize(("timeout", "waited_s"), [(2.0, 2.0), (4.0, 4.0), (6.0, 4.0), (12.0, 4.0)])
async def test_set_mode_attempt_timeout_depends_on_timeout(grounded: Flight, timeout: float, waited_s: float) -> None:
    grounded.copter.faults.silent = True
    started = now()
    with pytest.raises(CommandTimeout, match=f"within {waited_s:.1f} s"):
        await grounded.vehicle.set_mode("GUIDED", timeout=timeout)
    assert now() - started == pytest.approx(waited_s)


async def test_set_mode_accepted_not_executed_times_out(grounded: Flight) -> None:
    grounded.copter.set_mode_from = lambda *_: MavResult.ACCEPTED  # type: ignore[method-assign]
    started = now()
    with pytest.raises(
        OperationTimeout, match=r"set_mode\(GUIDED\): not done within \d.* s; the vehicle is in STABILIZE"
    ):
        await grounded.vehicle.set_mode("GUIDED", timeout=4.0)
    assert now() - started == pytest.approx(4.0, abs=0.6)


async def test_set_mode_unknown_number_is_sent(grounded: Flight) -> None:
    with pytest.raises(CommandRejected, match="No such mode 99"):
        await grounded.vehicle.set_mode(99)


class CopterWithAScript(SimulatedCopter):
    """Reports a mode that the tables lack, such as one that a Lua script has added."""

    def available_modes(self) -> list[m.AvailableModes]:
        return [*super().available_modes(), m.AvailableModes(12, 12, 0, 118, 0, "Follow Boat")]


async def test_available_modes_name_is_accepted() -> None:
    async with open_flight(CopterWithAScript(boot_time_s=0.0)) as flight:
        await anyio.sleep(3.0)
        assert flight.vehicle.autopilot.find_mode("follow boat", flight.vehicle.telemetry.mode_names).custom_mode == 118
        with pytest.raises(CommandRejected, match="No such mode 118"):
            await flight.vehicle.set_mode("FOLLOW_BOAT")
        with pytest.raises(InvalidArgument, match="Follow Boat"):
            await flight.vehicle.set_mode("FOLLOW_TRAIN")


async def test_available_modes_are_requested_until_received() -> None:
    """The link is bad when the vehicle connects: its list of modes is requested again."""
    copter = CopterWithAScript(boot_time_s=0.0)
    copter.faults.ignore(MavCmd.REQUEST_MESSAGE)
    async with open_flight(copter) as flight:
        await anyio.sleep(20.0)
        copter.faults.clear()
        await anyio.sleep(20.0)
        assert flight.vehicle.telemetry.mode_names == {118: "Follow Boat"}


async def test_ack_to_other_station_is_ignored(grounded: Flight) -> None:
    grounded.copter.faults.ignore(MavCmd.DO_SET_MODE, times=1)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(grounded.vehicle.set_mode, "GUIDED")
        await anyio.sleep(0.1)
        grounded.copter.send(m.CommandAck(MavCmd.DO_SET_MODE, MavResult.DENIED, 0, 0, 254, 190))
    assert len(grounded.wire.commands(MavCmd.DO_SET_MODE)) == 2


# ------------------------------------------------------------------------------------------ PX4


@pytest.mark.parametrize(
    ("mode", "params"),
    [("POSCTL", (1, 3, 0)), ("LOITER", (1, 4, 3)), ("Hold", (1, 4, 3)), (3 << 16, (1, 3, 0))],
)
async def test_px4_mode_has_main_and_sub_mode(mode: str | int, params: tuple[float, ...]) -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("ALTCTL")
        flight.wire.clear()
        await flight.vehicle.set_mode(mode)
        (command,) = flight.wire.commands(MavCmd.DO_SET_MODE)
        assert (command.param1, command.param2, command.param3) == params


async def test_px4_refusal_after_acceptance_raises() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        before = flight.px4.mode
        started = now()
        with pytest.raises(
            OperationRejected,
            match=r"set_mode\(OFFBOARD\): the vehicle accepted the command and then refused it",
        ):
            await flight.vehicle.set_mode("OFFBOARD")
        assert now() - started < 2.0
        assert flight.px4.mode == before


async def test_px4_heartbeats_lag_behind() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        for mode in ("POSCTL", "ALTCTL", "LOITER"):
            await flight.vehicle.set_mode(mode)
            assert flight.vehicle.mode_name == mode


@pytest.mark.parametrize("result", [MavResult.TEMPORARILY_REJECTED, MavResult.DENIED, MavResult.FAILED])
async def test_refusal_after_acceptance_raises(grounded: Flight, result: MavResult) -> None:
    """Like a PX4, which acks twice."""
    grounded.copter.set_mode_from = lambda *_: MavResult.ACCEPTED  # type: ignore[method-assign]
    async with anyio.create_task_group() as tasks:

        async def answer_again() -> None:
            await anyio.sleep(1.0)
            again = m.CommandAck(MavCmd.DO_SET_MODE, result, target_system=255, target_component=190)
            grounded.wire.deliver(FrameEncoder(1, 1).encode(again))

        tasks.start_soon(answer_again)
        with pytest.raises(OperationRejected, match="the vehicle accepted the command and then refused it"):
            await grounded.vehicle.set_mode("GUIDED")


async def test_legacy_mode_counts_as_flown_by_program() -> None:
    async with in_the_air() as flight:
        arbiter = flight.vehicle._arbiter
        arbiter.newest = arbiter._arming_order = None  # as if another party had armed the vehicle
        flight.copter.faults.refuse(MavCmd.DO_SET_MODE, MavResult.UNSUPPORTED)
        await flight.vehicle.set_mode("LOITER")
        assert flight.vehicle.is_flown_by_program
