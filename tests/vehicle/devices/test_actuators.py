"""``vehicle.actuators``: what is sent, which report ends the call, and what is never repeated."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from device_calls import FITTED, components_of
from flight_harness import Flight, Px4Flight, in_the_air, open_flight, open_px4

from aerokit.errors import CommandTimeout, InvalidArgument, NotSupported, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavCmd as C
from aerokit.sim import SimulatedCopter, SimulatedPx4

pytestmark = pytest.mark.anyio

SPIN: dict[str, Any] = {"throttle_percent": 5, "duration_s": 1.0, "intent": "spin motor"}


def fitted_copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, parameters=dict(FITTED))


@asynccontextmanager
async def on_ground(**options: Any) -> AsyncIterator[Flight]:
    async with open_flight(fitted_copter(), **options) as flight:
        await flight.vehicle.wait_ready()
        flight.wire.clear()
        yield flight


@asynccontextmanager
async def on_px4() -> AsyncIterator[Px4Flight]:
    async with open_px4(SimulatedPx4(boot_time_s=0.0)) as flight:
        await flight.vehicle.wait_ready()
        flight.wire.clear()
        yield flight


def params(flight: Flight | Px4Flight, command: int) -> list[tuple[float, ...]]:
    """Parameters of each copy of a command that was sent."""
    sent: list[Any] = flight.wire.commands(command)
    return [tuple(getattr(each, f"param{number}") for number in range(1, 8)) for each in sent]


async def test_set_servo_returns_when_output_reports_it() -> None:
    async with on_ground() as flight:
        await flight.vehicle.actuators.set_servo(9, 1700)
        assert params(flight, C.DO_SET_SERVO) == [(9, 1700, 0, 0, 0, 0, 0)]
        assert flight.vehicle.servo_outputs.value.outputs_us[8] == 1700


async def test_set_servo_output_stays_times_out() -> None:
    async with on_ground() as flight:
        flight.copter.faults.refuse(C.DO_SET_SERVO, 0)
        with pytest.raises(OperationTimeout, match="set_servo: not done within 5 s; ServoOutputRaw"):
            await flight.vehicle.actuators.set_servo(9, 1700)


async def test_set_servo_message_refused_returns_at_ack() -> None:
    async with on_ground() as flight:
        flight.copter.faults.refuse(C.DO_SET_SERVO, 0)
        flight.copter.faults.refuse(C.REQUEST_MESSAGE, 3)
        await flight.vehicle.actuators.set_servo(9, 1700)


async def test_set_relay_switches_both_ways() -> None:
    async with on_ground() as flight:
        await flight.vehicle.actuators.set_relay(0, True)
        assert flight.copter.devices.relays == 1
        await flight.vehicle.actuators.set_relay(0, False)
        assert flight.copter.devices.relays == 0


@pytest.mark.parametrize("ack_is_lost", [False, True])
async def test_repeat_servo_is_sent_once(ack_is_lost: bool) -> None:
    async with on_ground() as flight:
        if ack_is_lost:
            flight.copter.faults.ignore(C.DO_REPEAT_SERVO)
            with pytest.raises(CommandTimeout):
                await flight.vehicle.actuators.repeat_servo(9, 1600, count=3, period_s=0.5)
        else:
            await flight.vehicle.actuators.repeat_servo(9, 1600, count=3, period_s=0.5)
        assert params(flight, C.DO_REPEAT_SERVO) == [(9, 1600, 3, 0.5, 0, 0, 0)]


async def test_set_actuators_leaves_others_unchanged() -> None:
    async with on_px4() as flight:
        await flight.vehicle.actuators.set_actuators(0.5, None, -1)
        await flight.vehicle.actuators.set_actuator(6, 1)
        shown = [["-" if value != value else value for value in each] for each in params(flight, C.DO_SET_ACTUATOR)]
        assert shown == [[0.5, "-", -1, "-", "-", "-", 0], ["-", "-", "-", "-", "-", 1, 0]]


@pytest.mark.parametrize("values", [(), (None,), (1.1,), (0,) * 7])
async def test_set_actuators_invalid_values_raise(values: tuple[Any, ...]) -> None:
    async with on_px4() as flight:
        with pytest.raises(InvalidArgument, match="values"):
            await flight.vehicle.actuators.set_actuators(*values)
        assert params(flight, C.DO_SET_ACTUATOR) == []


async def test_servo_on_px4_and_actuator_on_ardupilot_are_not_supported() -> None:
    async with on_px4() as flight:
        with pytest.raises(NotSupported, match="PX4 has no MAV_CMD_DO_SET_SERVO; nothing was sent"):
            await flight.vehicle.actuators.set_servo(9, 1500)
    async with on_ground() as flight:
        with pytest.raises(NotSupported, match="ArduCopter has no MAV_CMD_DO_SET_ACTUATOR"):
            await flight.vehicle.actuators.set_actuator(1, 0)


async def test_landing_gear_is_raised_in_flight_only() -> None:
    async with on_ground() as flight:
        with pytest.raises(OperationRejected, match="on the ground; nothing was sent"):
            await flight.vehicle.actuators.raise_landing_gear()
        assert params(flight, C.AIRFRAME_CONFIGURATION) == []
    async with in_the_air(copter=fitted_copter()) as flight:
        await flight.vehicle.actuators.raise_landing_gear()
        assert flight.copter.devices.gear_is_up
        await flight.vehicle.actuators.lower_landing_gear()
        assert not flight.copter.devices.gear_is_up


async def test_lights_switch_component_until_it_reports() -> None:
    async with on_ground() as flight:
        stage: Any = flight
        stage.simulated, stage.is_px4 = flight.copter, False
        light = components_of(stage)[1]
        await flight.vehicle.actuators.set_lights(True)
        assert light.is_on
        assert [sent.target_component for sent in flight.wire.commands(C.ILLUMINATOR_ON_OFF)] == [243]


# ---------------------------------------------------------------------------------- motor test


async def test_motor_test_returns_after_motor_has_stopped() -> None:
    async with on_ground() as flight:
        began = anyio.current_time()
        await flight.vehicle.actuators.test_motor(2, **SPIN)
        assert anyio.current_time() - began >= SPIN["duration_s"]
        assert not flight.copter.motor_test.is_running
        assert params(flight, C.DO_MOTOR_TEST) == [(2, 0, 5, 1.0, 1, 0, 0)]


async def test_motor_test_on_px4_uses_output_function() -> None:
    async with on_px4() as flight:
        await flight.vehicle.actuators.test_motor(2, **SPIN)
        (sent,) = params(flight, C.ACTUATOR_TEST)
        assert sent == pytest.approx((0.05, 1.0, 0, 0, 2, 0, 0))


async def test_motor_test_of_armed_vehicle_sends_nothing() -> None:
    async with on_ground() as flight:
        await flight.vehicle.set_mode("GUIDED")
        await flight.vehicle.arm()
        with pytest.raises(OperationRejected, match="the vehicle is armed; nothing was sent"):
            await flight.vehicle.actuators.test_motor(1, **SPIN)
        assert params(flight, C.DO_MOTOR_TEST) == []


async def test_motor_test_after_silence_sends_nothing() -> None:
    async with on_ground() as flight:
        flight.copter.faults.silent = True
        await anyio.sleep(3.0)
        with pytest.raises(OperationRejected, match="not known to be disarmed"):
            await flight.vehicle.actuators.test_motor(1, **SPIN)
        assert params(flight, C.DO_MOTOR_TEST) == []


async def test_motor_test_without_intent_sends_nothing() -> None:
    async with on_ground() as flight:
        intent: Any = "yes"
        with pytest.raises(InvalidArgument, match="intent"):
            await flight.vehicle.actuators.test_motor(1, throttle_percent=5, duration_s=1, intent=intent)
        assert params(flight, C.DO_MOTOR_TEST) == []


@pytest.mark.parametrize("simulated", ["copter", "px4"])
async def test_cancelled_motor_test_stops_motor_at_once(simulated: str) -> None:
    flight: Any
    async with on_px4() if simulated == "px4" else on_ground() as flight:
        with anyio.move_on_after(0.4):
            await flight.vehicle.actuators.test_motor(1, throttle_percent=5, duration_s=3, intent="spin motor")
        await anyio.sleep(0.2)
        sent = params(flight, C.ACTUATOR_TEST if simulated == "px4" else C.DO_MOTOR_TEST)
        assert len(sent) == 2
        assert sent[1][1 if simulated == "px4" else 3] == 0
        if simulated == "copter":
            assert not flight.copter.motor_test.is_running


async def test_unanswered_motor_test_is_neither_repeated_nor_stopped() -> None:
    """When the wait for the answer ends, the motor has stopped by itself."""
    async with on_ground() as flight:
        flight.copter.faults.ignore(C.DO_MOTOR_TEST)
        with pytest.raises(CommandTimeout):
            await flight.vehicle.actuators.test_motor(1, throttle_percent=5, duration_s=3, intent="spin motor")
        assert len(params(flight, C.DO_MOTOR_TEST)) == 1


async def spin_three_seconds(flight: Px4Flight, number: int) -> None:
    await flight.vehicle.actuators.test_motor(number, throttle_percent=5, duration_s=3, intent="spin motor")


async def test_motor_tests_of_px4_are_stopped_each() -> None:
    async with on_px4() as flight:
        with anyio.move_on_after(0.8):
            async with anyio.create_task_group() as group:
                for number in (1, 2):
                    group.start_soon(spin_three_seconds, flight, number)
                    await anyio.sleep(0.3)
        stops = [sent[4] for sent in params(flight, C.ACTUATOR_TEST) if sent[1] == 0]
        assert sorted(stops) == [1, 2]


async def test_motor_test_over_slow_link_gets_no_late_stop() -> None:
    async with on_ground(latency_s=0.3) as flight:
        with anyio.move_on_after(1.2):
            await flight.vehicle.actuators.test_motor(1, **SPIN)
        assert len(params(flight, C.DO_MOTOR_TEST)) == 1


async def test_motor_test_cancelled_after_its_end_sends_no_stop() -> None:
    """Without a running test, the stop command would start another test, which arms the motors."""
    async with on_ground() as flight:
        with anyio.move_on_after(SPIN["duration_s"] + 0.1):
            await flight.vehicle.actuators.test_motor(1, **SPIN)
        assert len(params(flight, C.DO_MOTOR_TEST)) == 1


# ----------------------------------------------------------------------------------- parachute


async def test_parachute_returns_when_released() -> None:
    async with in_the_air(20.0, copter=fitted_copter()) as flight:
        await flight.vehicle.actuators.release_parachute(intent="release parachute")
        assert flight.copter.devices.chute_is_released
        assert len(params(flight, C.DO_PARACHUTE)) == 1


async def test_parachute_refused_by_text_raises_with_text() -> None:
    async with on_ground() as flight:
        with pytest.raises(OperationRejected, match="Parachute: Landed"):
            await flight.vehicle.actuators.release_parachute(intent="release parachute")
        assert not flight.copter.devices.chute_is_released


async def test_unanswered_parachute_is_not_released_again() -> None:
    async with in_the_air(20.0, copter=fitted_copter()) as flight:
        flight.copter.faults.ignore(C.DO_PARACHUTE)
        with pytest.raises(CommandTimeout):
            await flight.vehicle.actuators.release_parachute(intent="release parachute")
        assert len(params(flight, C.DO_PARACHUTE)) == 1
