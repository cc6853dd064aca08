"""Calibrations of simulated ArduPilot and PX4: steps, results, cancellation, refusals."""

from __future__ import annotations

import asyncio
import gc
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

import anyio
import pytest
from flight_harness import Wire

import aerokit
from aerokit import messages as m
from aerokit.errors import (
    BusyError,
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CopterMode, MavCmd, MavSeverity, MavState
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.vehicle.calibration.calibration import Calibration
from aerokit.vehicle.calibration.values import CalibrationPose as Pose
from aerokit.vehicle.calibration.values import CalibrationResult, CalibrationStep

pytestmark = pytest.mark.anyio
CALIBRATION = MavCmd.PREFLIGHT_CALIBRATION
Stage = tuple[Any, aerokit.Vehicle, Wire]


@asynccontextmanager
async def stage(kind: type[SimulatedCopter | SimulatedPx4], **options: Any) -> AsyncIterator[Stage]:
    simulated = kind(boot_time_s=0.0, **options)
    async with simulated_link(simulated) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            await vehicle.wait_ready()
            yield simulated, vehicle, wire


async def steps_of(calibration: Calibration) -> list[CalibrationStep]:
    return [step async for step in calibration]


def orders(wire: Wire, command: int) -> list[tuple[float, ...]]:
    return [
        (each.param1, each.param2, each.param3, each.param4, each.param5, each.param6, each.param7)
        for each in wire.commands(command)
        if isinstance(each, m.CommandLong)
    ]


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
@pytest.mark.parametrize(
    ("name", "params"),
    [
        ("gyroscope", (1, 0, 0, 0, 0, 0, 0)),
        ("level", (0, 0, 0, 0, 2, 0, 0)),
        ("barometer", (0, 0, 1, 0, 0, 0, 0)),
    ],
)
async def test_calibration_without_person_ends_with_result(
    kind: type[Any], name: str, params: tuple[float, ...]
) -> None:
    async with stage(kind) as (_, vehicle, wire):
        steps = await steps_of(getattr(vehicle.calibrate, name)())
        assert orders(wire, CALIBRATION) == [params]
        assert steps[-1].result is not None
        assert not steps[-1].result.reboot_due
        assert [step.result for step in steps[:-1]] == [None] * (len(steps) - 1)
        assert {step.sensor for step in steps} == {name}


async def test_ardupilot_compass_reports_progress_and_fitness() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        steps = await steps_of(vehicle.calibrate.compass())
        progress = [step.progress or 0.0 for step in steps]
        assert progress == sorted(progress)
        assert progress[0] == 0
        assert len(progress) > 20
        result = steps[-1].result
        assert result is not None
        assert result.reboot_due
        assert [(fit.compass, fit.fitness_mgauss) for fit in result.compasses] == [(0, 5.0), (1, 5.0), (2, 5.0)]
        assert orders(wire, MavCmd.DO_ACCEPT_MAG_CAL) == [(0,) * 7]
        assert orders(wire, MavCmd.DO_CANCEL_MAG_CAL) == []
        assert copter.calibrations.compasses.report() is None


async def test_failed_compass_raises_with_fitness(monkeypatch: pytest.MonkeyPatch) -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        compasses = copter.calibrations.compasses
        whole = compasses.report

        def report() -> m.MagCalReport | None:
            found: m.MagCalReport | None = whole()
            if found is None:
                return None
            fields = {name: getattr(found, name) for name in found.__match_args__}
            return m.MagCalReport(**{**fields, "cal_status": 5, "fitness": 44.0})

        monkeypatch.setattr(compasses, "report", report)
        with pytest.raises(OperationRejected, match=r"compass 0 failed \(fitness 44\.0 mgauss\)"):
            await steps_of(vehicle.calibrate.compass())
        await anyio.sleep(3)
        assert orders(wire, MavCmd.DO_ACCEPT_MAG_CAL) == []
        assert len(orders(wire, MavCmd.DO_CANCEL_MAG_CAL)) == 1


async def test_ardupilot_accelerometer_confirms_each_pose_once() -> None:
    async with stage(SimulatedCopter) as (_, vehicle, wire):
        poses, step = [], None
        async for step in vehicle.calibrate.accelerometer():
            if step.needs_confirmation:
                poses.append(step.pose)
                await anyio.sleep(5)
        assert poses == [
            Pose.LEVEL,
            Pose.LEFT,
            Pose.RIGHT,
            Pose.NOSE_DOWN,
            Pose.NOSE_UP,
            Pose.BACK,
        ]
        assert [params[0] for params in orders(wire, MavCmd.ACCELCAL_VEHICLE_POS)] == [1, 2, 3, 4, 5, 6]
        assert step is not None
        assert step.result is not None
        assert step.result.reboot_due


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("accelerometer", m.CommandLong(255, 0, MavCmd.ACCELCAL_VEHICLE_POS, 0, 16_777_215, 0, 0, 0, 0, 0, 0)),
        ("compass", m.MagCalReport(3, 8, 5, 0, 50.0, 0, 0, 0, 0, 0, 0, 0, 0, 0)),
    ],
)
async def test_result_from_another_component_does_not_count(name: str, message: Message) -> None:
    async with stage(SimulatedCopter) as (_, vehicle, wire):
        frame = FrameEncoder(1, 191).encode(message)
        asyncio.get_running_loop().call_later(1.0, wire.deliver, frame)
        assert len(await steps_of(getattr(vehicle.calibrate, name)())) > 6


async def test_pose_is_not_confirmed_into_a_silence() -> None:
    loop = asyncio.get_running_loop()
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        steps = aiter(vehicle.calibrate.accelerometer())
        while not (await anext(steps)).needs_confirmation:
            pass
        copter.faults.silent = True
        await anyio.sleep(4.0)
        silent_until = loop.time() + 3.0
        loop.call_at(silent_until, setattr, copter.faults, "silent", False)
        await anext(steps)
        confirmed_at = [at for at, sent in wire.sent if getattr(sent, "command", None) == MavCmd.ACCELCAL_VEHICLE_POS]
        assert confirmed_at[0] > silent_until


async def test_failed_accelerometer_raises_and_can_be_repeated() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, _):
        copter.calibrations.accelerometers.is_held_wrong = True
        with pytest.raises(OperationRejected, match="failed") as caught:
            await steps_of(vehicle.calibrate.accelerometer())
        assert "Calibration FAILED" in caught.value.reasons
        copter.calibrations.accelerometers.is_held_wrong = False
        assert (await steps_of(vehicle.calibrate.accelerometer()))[-1].result is not None


@pytest.mark.parametrize("name", ["compass", "accelerometer"])
async def test_px4_poses_are_reported_until_done(name: str) -> None:
    async with stage(SimulatedPx4) as (px4, vehicle, _):
        px4.calibration.side_s = 2.0
        steps = await steps_of(getattr(vehicle.calibrate, name)())
        assert next(len(step.remaining) for step in steps if step.remaining) == 6
        assert min(len(step.remaining) for step in steps if step.pose) == 1
        seen = list(dict.fromkeys(step.pose for step in steps if step.pose))
        assert set(seen) == set(Pose)
        assert not any(step.needs_confirmation for step in steps)
        assert steps[-1].result is not None
        assert [step.progress for step in steps][-2] == 1.0


CANCELS = {SimulatedCopter: (MavCmd.DO_CANCEL_MAG_CAL, (0,) * 7), SimulatedPx4: (CALIBRATION, (0,) * 7)}


def is_running(simulated: Any) -> bool:
    if isinstance(simulated, SimulatedPx4):
        return simulated.calibration.is_running
    return bool(simulated.calibrations.compasses.is_running)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
@pytest.mark.parametrize("how", ["break", "exception", "cancellation", "cancel"])
async def test_leaving_loop_cancels_on_vehicle(kind: type[Any], how: str) -> None:
    command, params = CANCELS[kind]
    async with stage(kind) as (simulated, vehicle, wire):

        async def leave() -> None:
            calibration = vehicle.calibrate.compass()
            async for _ in calibration:
                assert is_running(simulated)
                if how == "exception":
                    raise ValueError
                if how == "cancel":
                    await calibration.cancel()
                elif how == "cancellation":
                    await asyncio.Event().wait()
                else:
                    break

        with anyio.move_on_after(3), suppress(ValueError):
            await leave()
        gc.collect()
        await anyio.sleep(1.5)
        assert not is_running(simulated)
        assert params in orders(wire, command)
        assert len(orders(wire, command)) <= 2
        await anyio.sleep(30)
        assert (await steps_of(vehicle.calibrate.gyroscope()))[-1].result is not None


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
async def test_leaving_vehicle_block_cancels_on_vehicle(kind: type[Any]) -> None:
    simulated = kind(boot_time_s=0.0)
    async with simulated_link(simulated) as link:
        async with aerokit.connect(link) as vehicle:
            await vehicle.wait_ready()
            calibration = vehicle.calibrate.compass()
            await calibration.__anext__()
            assert is_running(simulated)
        await anyio.sleep(0.5)
        assert not is_running(simulated)


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
async def test_lost_cancel_is_repeated(kind: type[Any]) -> None:
    async with stage(kind) as (simulated, vehicle, wire):
        calibration = vehicle.calibrate.compass()
        await calibration.__anext__()
        simulated.faults.ignore(CANCELS[kind][0])
        asyncio.get_running_loop().call_later(6.0, simulated.faults.clear)
        await calibration.cancel()
        assert not is_running(simulated)
        assert len([params for params in orders(wire, CANCELS[kind][0]) if not any(params)]) >= 3


@pytest.mark.parametrize("is_action_first", [False, True])
async def test_lost_cancel_is_not_repeated_after_takeover(is_action_first: bool) -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        calibration = vehicle.calibrate.compass()
        await calibration.__anext__()
        copter.faults.ignore(MavCmd.DO_CANCEL_MAG_CAL)
        cancelling = asyncio.create_task(calibration.cancel())
        await anyio.sleep(0.1)
        if is_action_first:
            await vehicle.set_mode("LOITER")
        copter.set_mode(CopterMode.ALT_HOLD)  # by the pilot
        with pytest.raises(OperationTimeout):
            await cancelling
        assert len(orders(wire, MavCmd.DO_CANCEL_MAG_CAL)) == 1


@pytest.mark.parametrize("is_raw", [False, True])
async def test_lost_cancel_is_repeated_after_own_mode_change(is_raw: bool) -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, _):
        calibration = vehicle.calibrate.compass()
        await calibration.__anext__()
        copter.faults.ignore(MavCmd.DO_CANCEL_MAG_CAL, times=1)
        cancelling = asyncio.create_task(calibration.cancel())
        await anyio.sleep(0.1)
        if is_raw:
            await vehicle.command(MavCmd.DO_SET_MODE, 1, CopterMode.LOITER)
        else:
            await vehicle.set_mode("LOITER")
        await cancelling
        assert vehicle.mode_name == "LOITER"
        assert not is_running(copter)


async def test_unconfirmed_cancel_is_sent_six_times_and_raises() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        calibration = vehicle.calibrate.compass()
        await calibration.__anext__()
        copter.faults.ignore(MavCmd.DO_CANCEL_MAG_CAL)
        with pytest.raises(OperationTimeout, match="did not confirm the cancellation"):
            await calibration.cancel()
        await anyio.sleep(5)
        assert len(orders(wire, MavCmd.DO_CANCEL_MAG_CAL)) == 6


async def test_calibration_after_unconfirmed_cancel_raises() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, _):
        calibration = vehicle.calibrate.compass()
        await calibration.__anext__()
        copter.faults.ignore(MavCmd.DO_CANCEL_MAG_CAL)
        with anyio.move_on_after(10), suppress(OperationTimeout):
            await calibration.cancel()
        with pytest.raises(OperationTimeout, match="did not confirm the cancellation"):
            await vehicle.calibrate.compass().__anext__()


async def test_two_calibrations_after_cancel_do_not_both_begin() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        calibration = vehicle.calibrate.compass()
        await calibration.__anext__()
        copter.faults.ignore(MavCmd.DO_CANCEL_MAG_CAL, times=1)
        cancelling = asyncio.create_task(calibration.cancel())
        await anyio.sleep(0.5)
        following = [vehicle.calibrate.compass() for _ in range(2)]
        results = await asyncio.gather(*(each.__anext__() for each in following), return_exceptions=True)
        assert [type(result) for result in results] == [CalibrationStep, BusyError]
        await cancelling
        assert len(orders(wire, MavCmd.DO_START_MAG_CAL)) == 2


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
async def test_cancel_by_other_task_ends_waiting_loop(kind: type[Any]) -> None:
    async with stage(kind) as (simulated, vehicle, _):
        calibration = vehicle.calibrate.compass()
        await calibration.__anext__()
        loop = asyncio.create_task(steps_of(calibration))
        await anyio.sleep(0.01)
        await calibration.cancel()
        assert not is_running(simulated)
        await loop


async def test_cancel_is_not_sent_into_silence() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        calibration = vehicle.calibrate.compass()
        await calibration.__anext__()
        copter.faults.silent = True
        await anyio.sleep(5)
        task = asyncio.create_task(calibration.cancel())
        await anyio.sleep(3)
        assert orders(wire, MavCmd.DO_CANCEL_MAG_CAL) == []
        copter.faults.silent = False
        await task
        assert not is_running(copter)


async def test_accelerometer_left_says_what_remains(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    async with stage(SimulatedCopter) as (copter, vehicle, _):
        calibration = vehicle.calibrate.accelerometer()
        await calibration.__anext__()
        with pytest.raises(NotSupported, match="cannot cancel"):
            await calibration.cancel()
        assert "waits for the next pose" in caplog.text
        assert copter.calibrations.accelerometers.is_waiting
        steps = await steps_of(vehicle.calibrate.accelerometer())  # The first calibration continues.
        assert steps[-1].result is not None


NAMES = ("compass", "accelerometer", "gyroscope", "level", "barometer", "radio")


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
async def test_armed_vehicle_is_refused_before_anything_is_sent(kind: type[Any]) -> None:
    async with stage(kind) as (_, vehicle, wire):
        await vehicle.arm()
        wire.clear()
        for name in NAMES:
            with pytest.raises(OperationRejected, match="the vehicle is armed; nothing was sent"):
                await steps_of(getattr(vehicle.calibrate, name)())
        with pytest.raises(OperationRejected, match="the vehicle is armed"):
            await steps_of(vehicle.calibrate.escs(intent="propellers are removed"))
        assert wire.commands(CALIBRATION) == []
        assert wire.all(m.ParamSet) == []


async def test_armed_during_calibration_ends_it() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, _):
        with pytest.raises(OperationRejected, match="the vehicle was armed"):
            async for _ in vehicle.calibrate.compass():
                copter.motors.set_armed(armed=True)


async def test_reboot_during_calibration_ends_it() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        await anyio.sleep(10.0)  # A reboot in the first seconds hardly sets back the vehicle's clock.
        with pytest.raises(OperationRejected, match="the vehicle rebooted"):
            async for _ in vehicle.calibrate.compass():
                copter.reboot(2.0)
        assert orders(wire, MavCmd.DO_CANCEL_MAG_CAL) == []


@pytest.mark.parametrize("name", ["compass", "accelerometer", "gyroscope"])
async def test_refused_start_raises_and_frees_vehicle(name: str) -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        command = MavCmd.DO_START_MAG_CAL if name == "compass" else CALIBRATION
        copter.faults.refuse(command)
        with pytest.raises(CommandRejected):
            await steps_of(getattr(vehicle.calibrate, name)())
        copter.faults.clear()
        await vehicle.calibrate.level().__anext__()
        assert orders(wire, MavCmd.DO_CANCEL_MAG_CAL) == []


async def test_unanswered_start_is_cancelled() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        copter.faults.ignore(MavCmd.DO_START_MAG_CAL)
        with pytest.raises(CommandTimeout):
            await steps_of(vehicle.calibrate.compass())
        assert len(orders(wire, MavCmd.DO_START_MAG_CAL)) == 1
        await anyio.sleep(2)
        assert len(orders(wire, MavCmd.DO_CANCEL_MAG_CAL)) == 1


async def test_second_calibration_is_busy() -> None:
    async with stage(SimulatedCopter) as (_, vehicle, _):
        first = vehicle.calibrate.compass()
        await first.__anext__()
        with pytest.raises(BusyError, match=r"calibrate\.compass is in progress"):
            await steps_of(vehicle.calibrate.accelerometer())
        await first.cancel()


async def test_calibration_cancelled_by_other_station_raises() -> None:
    async with stage(SimulatedPx4) as (_, vehicle, _):
        with pytest.raises(OperationRejected, match="calibration cancelled"):
            async for _ in vehicle.calibrate.compass():
                vehicle.send(m.CommandLong(1, 1, CALIBRATION, 0, 0, 0, 0, 0, 0, 0, 0))


async def test_px4_failure_raises_with_its_texts() -> None:
    async with stage(SimulatedPx4) as (px4, vehicle, _):
        with pytest.raises(OperationRejected, match="calibration failed: mag") as caught:
            async for _ in vehicle.calibrate.compass():
                px4.send_text(MavSeverity.CRITICAL, "Failed: This calibration requires rotation.")
                px4.send_text(MavSeverity.CRITICAL, "[cal] calibration failed: mag")
        assert "Failed: This calibration requires rotation." in caught.value.reasons


async def test_lost_result_of_px4_is_reported_as_unknown() -> None:
    async with stage(SimulatedPx4) as (px4, vehicle, _):
        with pytest.raises(OperationTimeout, match="its status text with the result was lost"):
            async for step in vehicle.calibrate.gyroscope():
                if step.progress:
                    px4.send_text = lambda *_: None


async def test_late_result_of_px4_is_received_after_a_long_step() -> None:
    """The vehicle ends the calibration while the program handles a step."""
    texts: list[tuple[Any, ...]] = []
    calibrating = 0  # number of steps in the state CALIBRATING
    results: list[CalibrationResult | None] = []
    async with stage(SimulatedPx4) as (px4, vehicle, _):
        send_text = px4.send_text

        def send_all() -> None:
            for arguments in texts:
                send_text(*arguments)

        async for step in vehicle.calibrate.gyroscope():
            results.append(step.result)
            calibrating += vehicle.system_status.latest == MavState.CALIBRATING
            if calibrating == 2 and not texts:
                px4.send_text = lambda *arguments: texts.append(arguments)
                await vehicle.system_status.wait_until(lambda status: status != MavState.CALIBRATING)
                await anyio.sleep(2.0)
                asyncio.get_running_loop().call_later(0.5, send_all)
    assert results[-1] is not None


async def test_silent_vehicle_raises_heartbeat_timeout() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, _):
        with pytest.raises(HeartbeatTimeout):
            async for _ in vehicle.calibrate.compass():
                copter.faults.silent = True


async def test_airspeed_without_sensor_is_refused_before_sending() -> None:
    async with stage(SimulatedCopter) as (_, vehicle, wire):
        with pytest.raises(NotSupported, match="ARSPD_TYPE"):
            await steps_of(vehicle.calibrate.airspeed())
        assert wire.commands(CALIBRATION) == []


async def test_escs_of_copter_are_calibrated_at_next_boot() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        steps = await steps_of(vehicle.calibrate.escs(intent="propellers are removed"))
        assert copter.parameters["ESC_CALIBRATION"] == 3
        assert steps[-1].result is not None
        assert steps[-1].result.reboot_due
        assert wire.commands(CALIBRATION) == []


async def test_escs_of_px4_with_battery_are_refused() -> None:
    async with stage(SimulatedPx4) as (_, vehicle, wire):
        with pytest.raises(CommandRejected, match="Disconnect battery"):
            await steps_of(vehicle.calibrate.escs(intent="propellers are removed"))
        assert orders(wire, CALIBRATION) == [(0, 0, 0, 0, 0, 0, 1)]


async def calibrate_radio(copter: Any, vehicle: aerokit.Vehicle, move: Callable[[], object]) -> list[CalibrationStep]:
    steps = []
    async for step in vehicle.calibrate.radio():
        steps.append(step)
        if step.progress == 0.0:
            move()
            await anyio.sleep(2)
    return steps


async def test_radio_writes_travel_of_moved_channels() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, _):
        loop = asyncio.get_running_loop()

        def set_channels(pulse: int) -> None:
            for index in range(4):
                copter.rc[index] = pulse

        def move() -> None:
            for delay, pulse in ((0.0, 1100), (1.0, 1900)):
                loop.call_later(delay, set_channels, pulse)
            loop.call_later(1.8, set_channels, 1500)

        steps = await calibrate_radio(copter, vehicle, move)
        assert steps[-1].result is not None
        for number in range(1, 5):
            found = [copter.parameters[f"RC{number}_{name}"] for name in ("MIN", "MAX", "TRIM")]
            assert found == [1100, 1900, 1500]


async def test_radio_that_was_not_moved_writes_nothing() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        with pytest.raises(OperationRejected, match="nothing was written"):
            await calibrate_radio(copter, vehicle, lambda: None)
        await anyio.sleep(2)
        assert wire.all(m.ParamSet) == []
        assert orders(wire, CALIBRATION)[-1] == (0,) * 7


async def test_lost_end_of_ardupilot_radio_calibration_is_repeated() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        calibration = vehicle.calibrate.radio()
        await calibration.__anext__()
        copter.faults.ignore(CALIBRATION)
        asyncio.get_running_loop().call_later(6.0, copter.faults.clear)
        await calibration.cancel()
        assert orders(wire, CALIBRATION)[1:] == [(0,) * 7] * 4


async def test_radio_takes_no_trim_from_old_channels() -> None:
    async with stage(SimulatedCopter) as (copter, vehicle, wire):
        with pytest.raises(OperationTimeout, match="no RC_CHANNELS was received"):
            async for step in vehicle.calibrate.radio():
                if step.progress == 0.5:
                    copter.faults.lost_messages[m.RcChannels.ID] = 1000
        assert wire.all(m.ParamSet) == []


async def test_unknown_autopilot_is_not_supported(monkeypatch: pytest.MonkeyPatch) -> None:
    async with stage(SimulatedCopter) as (_, vehicle, wire):
        monkeypatch.setattr(vehicle.autopilot, "calibration_protocol", "", raising=False)
        for name in NAMES:
            with pytest.raises(NotSupported, match="nothing was sent"):
                await steps_of(getattr(vehicle.calibrate, name)())
        assert wire.commands(CALIBRATION) == []
