"""A failsafe before its action: PX4 first holds for COM_FAIL_ACT_T, and any order ends the failsafe."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import Flight, Px4Flight, in_the_air, open_px4
from order_flights import mode_of, run_the_battery_down

import aerokit
from aerokit.errors import OperationRejected, SetpointStreamStopped
from aerokit.mavlink.enums import MavCmd, MavState

pytestmark = pytest.mark.anyio

FAILSAFE_DELAY_S = 5.0


async def _in_the_delay(flight: Flight | Px4Flight) -> None:
    """Return a flight whose HEARTBEAT has reported the failsafe of a low battery."""
    run_the_battery_down(flight.px4 if isinstance(flight, Px4Flight) else flight.copter)
    await flight.vehicle.system_status.wait_until(lambda state: state == MavState.CRITICAL, timeout=3)
    flight.wire.clear()


async def test_go_to_cancelled_before_failsafe_action_keeps_failsafe() -> None:
    async with open_px4() as flight, anyio.create_task_group() as tasks:
        await flight.take_off()
        with anyio.CancelScope() as scope:

            async def cancel_in_the_delay() -> None:
                await anyio.sleep(1.0)
                await _in_the_delay(flight)
                scope.cancel()

            tasks.start_soon(cancel_in_the_delay)
            with pytest.raises(OperationRejected, match="failsafe"):
                await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=300))
        await anyio.sleep(FAILSAFE_DELAY_S + 3.0)
        assert flight.wire.commands(MavCmd.DO_REPOSITION) == []
        assert mode_of(flight.px4) in ("RTL", "LAND")


async def test_setpoint_stream_before_failsafe_action_ends_without_hold() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        with pytest.raises(SetpointStreamStopped, match=r"left OFFBOARD for LOITER$"):
            async with flight.vehicle.guided.velocity() as stream:
                await stream.fly(aerokit.VelocitySetpoint(north_m_s=1.0), 2.0)
                run_the_battery_down(flight.px4)
                await stream.fly(aerokit.VelocitySetpoint(north_m_s=1.0), 3.0)
        await anyio.sleep(FAILSAFE_DELAY_S + 3.0)
        assert flight.wire.commands(MavCmd.DO_REPOSITION) == []
        assert mode_of(flight.px4) in ("RTL", "LAND")


@pytest.mark.parametrize("name", ["land", "return_to_launch"])
async def test_land_during_failsafe_continues(name: str) -> None:
    async with in_the_air() as flight, anyio.create_task_group() as tasks:
        tasks.start_soon(getattr(flight.vehicle, name))
        await anyio.sleep(1.5)
        await _in_the_delay(flight)
        assert "failsafe" in flight.vehicle.taken_over
    assert not flight.copter.motors.is_armed or flight.copter.altitude_m < 0.5


async def test_order_during_failsafe_is_executed() -> None:
    async with in_the_air() as flight:
        await _in_the_delay(flight)
        await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=20))
        assert not flight.vehicle.taken_over
