"""Arming and disarming, and the reasons for a refusal: status texts, sensors, estimator."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import Flight, now, open_flight, open_px4

from aerokit.errors import CommandRejected, CommandTimeout, LinkLost, OperationTimeout
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavResult, MavSeverity
from aerokit.mavlink.messages import Statustext, SysStatus
from aerokit.sim import SimulatedCopter, SimulatedPx4
from aerokit.sim.px4.modes import POSITION

pytestmark = pytest.mark.anyio

ARM = MavCmd.COMPONENT_ARM_DISARM


async def test_arm_and_disarm_wait_for_heartbeat(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    await vehicle.arm()
    assert (vehicle.is_armed, vehicle.armed.value, grounded.copter.is_armed) == (True, True, True)
    await vehicle.disarm()
    assert (vehicle.is_armed, vehicle.armed.value, grounded.copter.is_armed) == (False, False, False)
    arm, disarm = grounded.wire.commands(ARM)
    assert (arm.param1, arm.param2) == (1.0, 0.0)
    assert (disarm.param1, disarm.param2) == (0.0, 0.0)


async def test_arm_already_armed_succeeds(grounded: Flight) -> None:
    await grounded.vehicle.arm()
    await grounded.vehicle.arm()
    assert grounded.vehicle.is_armed


async def test_command_ack_lost_effect_reported_succeeds(grounded: Flight) -> None:
    grounded.copter.faults.lose_ack(ARM)
    await grounded.vehicle.arm()
    assert len(grounded.wire.commands(ARM)) == 1  # HEARTBEAT has confirmed the command.


async def test_arm_command_lost_is_not_repeated(grounded: Flight) -> None:
    grounded.copter.faults.ignore(ARM, times=1)
    with pytest.raises(CommandTimeout, match=r"not sent again, because a repetition arms a vehicle that a pilot"):
        await grounded.vehicle.arm()
    assert len(grounded.wire.commands(ARM)) == 1
    await grounded.vehicle.arm()  # the program decides


async def test_disarm_order_is_lost_is_repeated(grounded: Flight) -> None:
    await grounded.vehicle.arm()
    grounded.wire.clear()
    grounded.copter.faults.ignore(ARM, times=1)
    await grounded.vehicle.disarm()
    first, second = grounded.wire.commands(ARM)
    assert (first.confirmation, second.confirmation) == (0, 1)  # type: ignore[union-attr]


async def test_arm_refused_has_status_texts(grounded: Flight) -> None:
    grounded.copter.faults.prearm_failures += ["Compass not healthy", "Gyros inconsistent"]
    with pytest.raises(CommandRejected) as caught:
        await grounded.vehicle.arm()
    assert caught.value.result == MavResult.FAILED
    assert "Arm: Compass not healthy" in caught.value.reasons
    assert "Arm: Gyros inconsistent" in caught.value.reasons
    assert "\n  - Arm: Compass not healthy" in str(caught.value)
    assert not grounded.wire.commands(MavCmd.RUN_PREARM_CHECKS)  # The vehicle has sent a status text already.


async def test_arm_refused_without_text_requests_checks(grounded: Flight) -> None:
    grounded.copter.faults.refuse(ARM, MavResult.FAILED)
    grounded.copter.faults.prearm_failures.append("Compass not healthy")
    with pytest.raises(CommandRejected) as caught:
        await grounded.vehicle.arm()
    assert "PreArm: Compass not healthy" in caught.value.reasons
    assert len(grounded.wire.commands(MavCmd.RUN_PREARM_CHECKS)) == 1


async def test_duplicate_reasons_are_removed(grounded: Flight) -> None:
    grounded.copter.faults.prearm_failures.append("Compass not healthy")
    with pytest.raises(CommandRejected) as caught:
        await grounded.vehicle.arm()
    assert len(set(caught.value.reasons)) == len(caught.value.reasons)


async def test_informational_texts_are_no_reason(grounded: Flight) -> None:
    copter, refuse = grounded.copter, grounded.copter.faults.prearm_failures
    refuse.append("Compass not healthy")
    say_more = copter.send_text

    def say(severity: int, text: str) -> None:
        for other in ("ArduPilot Ready", "Barometer 1 calibration complete"):
            say_more(MavSeverity.INFO, other)
        say_more(MavSeverity.CRITICAL, "PreArm: Compass not healthy")
        say_more(MavSeverity.WARNING, "EKF3 IMU0 stopped aiding")
        for _ in range(2):
            say_more(severity, text)

    copter.send_text = say  # type: ignore[method-assign]
    with pytest.raises(CommandRejected) as caught:
        await grounded.vehicle.arm()
    assert caught.value.reasons[:2] == ("PreArm: Compass not healthy", "EKF3 IMU0 stopped aiding")
    assert str(caught.value).count("Compass not healthy") == 1
    assert "Ready" not in str(caught.value)
    assert "Barometer" not in str(caught.value)


async def test_arm_too_early_names_estimator_and_failing_sensors() -> None:
    async with open_flight(SimulatedCopter(boot_time_s=60.0)) as flight:
        await anyio.sleep(12.0)
        await flight.vehicle.set_mode("GUIDED")
        with pytest.raises(CommandRejected) as caught:
            await flight.vehicle.arm()
        reasons = "; ".join(caught.value.reasons)
        assert "the estimator has no absolute horizontal position (EKF_STATUS_REPORT)" in reasons
        assert "pre-arm checks do not pass (SYS_STATUS)" not in reasons
        assert "Arm: " in reasons


async def test_force_skips_the_checks(grounded: Flight) -> None:
    grounded.copter.faults.prearm_failures.append("Compass not healthy")
    await grounded.vehicle.arm(force=True)
    assert grounded.vehicle.is_armed
    assert grounded.wire.commands(ARM)[0].param2 == 21196.0


async def test_arm_accepted_not_executed_times_out(grounded: Flight) -> None:
    grounded.copter.arming.arm = lambda **_: True  # type: ignore[method-assign]
    started = now()
    with pytest.raises(OperationTimeout, match=r"arm\(\): not done within 3 s; the vehicle sent no status text"):
        await grounded.vehicle.arm(timeout=3.0)
    assert 3.0 <= now() - started < 4.0


async def test_set_mode_silent_vehicle_times_out(grounded: Flight) -> None:
    grounded.copter.faults.silent = True
    with pytest.raises(
        CommandTimeout,
        match=r"COMPONENT_ARM_DISARM, sent once within 4\.0 s; not sent again, because .*; last heartbeat 4",
    ):
        await grounded.vehicle.arm()


async def test_disarm_in_the_air_is_refused_and_forced(flying: Flight) -> None:
    with pytest.raises(CommandRejected) as caught:
        await flying.vehicle.disarm()
    assert caught.value.reasons == ("the vehicle is not on the ground (landed state IN_AIR)",)
    assert flying.vehicle.is_armed
    await flying.vehicle.disarm(force=True)
    assert not flying.copter.is_armed
    assert [command.param2 for command in flying.wire.commands(ARM)] == [0.0, 21196.0]


async def test_late_ack_of_cancelled_command_is_ignored() -> None:
    """arm() is cancelled before its refusal arrives; disarm() must not take that for its own ack."""
    async with open_flight(latency_s=0.2) as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.refuse(ARM, MavResult.FAILED, times=1)
        with anyio.move_on_after(0.1):
            await flight.vehicle.arm()
        await flight.vehicle.disarm()


# ---------------------------------------------------------------------------- beforehand


async def test_why_not_armable_ready_vehicle_returns_nothing(grounded: Flight) -> None:
    assert await grounded.vehicle.why_not_armable() == []
    await grounded.vehicle.arm()
    assert await grounded.vehicle.why_not_armable() == []
    assert len(grounded.wire.commands(MavCmd.RUN_PREARM_CHECKS)) == 1


async def test_why_not_armable_names_failing_checks_without_arming(grounded: Flight) -> None:
    grounded.copter.faults.prearm_failures.append("Compass not healthy")
    reasons = await grounded.vehicle.why_not_armable()
    assert reasons == ["PreArm: Compass not healthy"]
    assert grounded.vehicle.missing_for_flight() == ["Compass not healthy"]
    assert not grounded.wire.commands(ARM)
    assert not grounded.copter.is_armed


async def test_why_not_armable_names_unarmable_mode(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("LAND")
    assert any("cannot arm in LAND" in reason for reason in await grounded.vehicle.why_not_armable())


async def test_why_not_armable_without_check_command_works(grounded: Flight) -> None:
    grounded.copter.faults.refuse(MavCmd.RUN_PREARM_CHECKS, MavResult.UNSUPPORTED)
    grounded.copter.faults.prearm_failures.append("Compass not healthy")
    await anyio.sleep(3.0)
    assert await grounded.vehicle.why_not_armable() == ["the vehicle's pre-arm checks do not pass (SYS_STATUS)"]


async def test_why_not_armable_unanswered_request_is_repeated(grounded: Flight) -> None:
    grounded.copter.faults.ignore(MavCmd.RUN_PREARM_CHECKS)
    assert await grounded.vehicle.why_not_armable() == []
    assert len(grounded.wire.commands(MavCmd.RUN_PREARM_CHECKS)) == 2


async def test_why_not_armable_waits_for_status_texts(grounded: Flight) -> None:
    async with anyio.create_task_group() as tasks:

        async def report_late() -> None:
            await anyio.sleep(0.9)
            grounded.wire.deliver(FrameEncoder(1, 1).encode(Statustext(2, "PreArm: Gyros inconsistent")))

        tasks.start_soon(report_late)
        assert await grounded.vehicle.why_not_armable() == ["PreArm: Gyros inconsistent"]


async def test_why_not_armable_works_without_default_streams() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.faults.refuse(MavCmd.RUN_PREARM_CHECKS, MavResult.UNSUPPORTED)
    copter.faults.prearm_failures.append("Compass not healthy")
    async with open_flight(copter, rates={}) as flight:
        await anyio.sleep(3.0)
        assert await flight.vehicle.why_not_armable() == ["the vehicle's pre-arm checks do not pass (SYS_STATUS)"]


async def test_old_status_text_is_no_reason(grounded: Flight) -> None:
    grounded.copter.faults.prearm_failures.append("Compass not healthy")
    assert await grounded.vehicle.why_not_armable()
    grounded.copter.faults.prearm_failures.clear()
    await anyio.sleep(3.0)
    assert await grounded.vehicle.why_not_armable() == []


# ------------------------------------------------------------------------------------------ PX4


async def test_px4_arm_refused_says_why() -> None:
    async with open_px4(SimulatedPx4(boot_time_s=30.0)) as flight:
        await anyio.sleep(3.0)
        reasons = await flight.vehicle.why_not_armable()
        assert reasons
        with pytest.raises(CommandRejected) as caught:
            await flight.vehicle.arm()
        assert caught.value.result == MavResult.TEMPORARILY_REJECTED
        assert caught.value.reasons


async def test_px4_arms_when_ready_and_disarms() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        assert await flight.vehicle.why_not_armable() == []
        await flight.vehicle.arm()
        await flight.vehicle.disarm()
        assert not flight.px4.is_armed


async def test_px4_disarm_in_the_air_says_why_not() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        with pytest.raises(CommandRejected, match=r"(?i)disarming denied|not landed"):
            await flight.vehicle.disarm()
        assert flight.px4.is_armed


async def test_values_before_link_restored_are_discarded(grounded: Flight) -> None:
    """The vehicle may have rebooted while the link was away for a moment."""
    vehicle, connection = grounded.vehicle, grounded.vehicle.connection
    assert vehicle.missing_for_flight() == []
    connection.link_interrupted(LinkLost("unplugged"))
    grounded.copter.faults.silent = True
    await anyio.sleep(0.2)
    connection.link_restored(0.2)
    grounded.copter.faults.silent = False
    assert vehicle.missing_for_flight()[1:] == [
        "sensors (no SYS_STATUS since the link was restored)",
        "estimator (no EKF_STATUS_REPORT since the link was restored)",
        "position (no GLOBAL_POSITION_INT with a fix since the link was restored)",
    ]
    await vehicle.wait_ready()
    await vehicle.arm()


async def test_ready_after_the_link_was_restored_without_a_reboot(grounded: Flight) -> None:
    connection = grounded.vehicle.connection
    connection.link_interrupted(LinkLost("unplugged"))
    connection.link_restored(0.2)
    restored_at = now()
    await grounded.vehicle.wait_ready()
    assert grounded.vehicle.position.updated_at >= restored_at
    assert now() - restored_at < 2.0


async def test_state_older_than_five_seconds_is_missing_for_flight(grounded: Flight) -> None:
    grounded.copter.faults.lose(SysStatus, times=1_000_000)
    await anyio.sleep(4.5)
    assert grounded.vehicle.missing_for_flight() == []
    await anyio.sleep(1.5)
    assert any("no SYS_STATUS for" in reason for reason in grounded.vehicle.missing_for_flight())


async def test_px4_why_not_armable_names_failing_check_and_not_rc() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        flight.px4.faults.prearm_failures.append("Compass not healthy")
        await anyio.sleep(2.0)
        assert await flight.vehicle.why_not_armable() == ["Preflight Fail: Compass not healthy"]
        assert len(flight.wire.commands(MavCmd.RUN_PREARM_CHECKS)) == 1
        assert not flight.wire.commands(ARM)


async def test_px4_mode_with_sticks_names_missing_rc_receiver() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        flight.px4.switch_to(POSITION)
        await anyio.sleep(2.0)
        assert "RC receiver (missing) is not healthy (SYS_STATUS)" in await flight.vehicle.why_not_armable()


async def test_lost_gps_is_named_where_it_prevents_arming() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.gps_lost = True
        await anyio.sleep(20)
        assert "no GPS receiver has a 3D fix (GPS_RAW_INT)" in flight.vehicle.missing_for_flight()
        assert await flight.vehicle.why_not_armable() == []
        await flight.vehicle.arm()  # in STABILIZE
        await flight.vehicle.disarm()


async def test_lost_gps_prevents_arming_in_guided() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("GUIDED")
        flight.copter.faults.gps_lost = True
        await anyio.sleep(20)
        assert "no GPS receiver has a 3D fix (GPS_RAW_INT)" in await flight.vehicle.why_not_armable()
        with pytest.raises(CommandRejected, match="no GPS receiver has a 3D fix"):
            await flight.vehicle.arm()


@pytest.mark.parametrize("timeout", [2.0, 10.0])
async def test_wait_ready_timeout_names_failing_check(timeout: float) -> None:
    """ArduPilot repeats its reasons every 30 s only."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.prearm_failures.append("Compass not healthy")
        await anyio.sleep(3.0)
        started = now()
        with pytest.raises(OperationTimeout, match="PreArm: Compass not healthy"):
            await flight.vehicle.wait_ready(timeout=timeout)
        assert now() - started == pytest.approx(timeout, abs=0.01)
        assert len(flight.wire.commands(MavCmd.RUN_PREARM_CHECKS)) <= 1  # the vehicle may report it by itself


async def test_low_battery_is_reason_if_vehicle_names_none() -> None:
    """PX4 sends a text about the battery only when it refuses to arm."""
    async with open_px4(SimulatedPx4(boot_time_s=1.0, battery_percent=4)) as flight:
        await anyio.sleep(40.0)
        reason = "battery 1 reports the charge state emergency (4 %)"
        assert await flight.vehicle.why_not_armable() == [reason]
        assert flight.vehicle.missing_for_flight() == [reason]


async def test_newest_prearm_report_replaces_older_one(grounded: Flight) -> None:
    faults = grounded.copter.faults
    faults.prearm_failures = ["Compass not healthy", "Gyros not healthy"]
    await anyio.sleep(35.0)
    assert "Gyros not healthy" in grounded.vehicle.missing_for_flight()
    faults.prearm_failures = ["Compass not healthy"]
    await anyio.sleep(29.0)
    reasons = grounded.vehicle.missing_for_flight()
    assert "Compass not healthy" in reasons
    assert "Gyros not healthy" not in reasons
