"""Orders to devices that wait before they are sent, or that are cancelled while they are being delivered."""

from __future__ import annotations

import asyncio

import anyio
import pytest
from flight_harness import open_flight
from test_actuators import fitted_copter, on_px4, params

from aerokit import messages as m
from aerokit.errors import OperationRejected
from aerokit.mavlink.enums import MavCmd as C

pytestmark = pytest.mark.anyio


async def test_winch_stop_before_pay_out_was_sent_stands() -> None:
    async with open_flight(fitted_copter(), latency_s=0.3) as flight, anyio.create_task_group() as tasks:
        await flight.vehicle.wait_ready()
        flight.wire.clear()

        async def stop() -> None:
            await anyio.sleep(0.2)
            await flight.vehicle.winch().set_rate(0)

        tasks.start_soon(stop)
        with pytest.raises(OperationRejected, match="another order was given"):
            await flight.vehicle.winch().pay_out(50)
        await anyio.sleep(5)
        assert flight.copter.devices.line_rate_m_s == 0
        assert [each[1] for each in params(flight, C.DO_WINCH)] == [2]


@pytest.mark.parametrize("is_posted", [False, True])
async def test_unrepeated_order_awaits_late_acknowledgement_despite_flight_order(is_posted: bool) -> None:
    async with open_flight(fitted_copter()) as flight, anyio.create_task_group() as tasks:
        await flight.vehicle.wait_ready()
        flight.copter.faults.delay_ack(C.DO_GRIPPER, 2.0)

        async def steer() -> None:
            await anyio.sleep(0.3)
            if is_posted:
                loiter = flight.vehicle.autopilot.find_mode("LOITER")
                with flight.vehicle.posted("mode", "motion", modes=(loiter,)) as order:
                    await order.set_mode(loiter)
            else:
                await flight.vehicle.set_mode("LOITER")

        tasks.start_soon(steer)
        await flight.vehicle.gripper().release()


async def test_winch_order_replaced_before_acknowledgement_is_rejected() -> None:
    async with open_flight(fitted_copter()) as flight, anyio.create_task_group() as tasks:
        await flight.vehicle.wait_ready()
        flight.copter.faults.ignore(C.DO_WINCH, times=1)

        async def stop() -> None:
            await anyio.sleep(0.5)
            await flight.vehicle.winch().set_rate(0)

        tasks.start_soon(stop)
        with pytest.raises(OperationRejected, match=r"no COMMAND_ACK for MAV_CMD_DO_WINCH.*another order was given"):
            await flight.vehicle.winch().set_rate(0.3)


@pytest.mark.parametrize("after_s", [0.01, 0.35, 0.55])
async def test_escs_cancelled_do_not_calibrate_at_next_boot(after_s: float) -> None:
    async with open_flight(fitted_copter(), latency_s=0.3) as flight:
        await flight.vehicle.wait_ready()

        async def calibrate() -> None:
            async for _ in flight.vehicle.calibrate.escs(intent="propellers are removed"):
                pass

        before = flight.copter.parameters["ESC_CALIBRATION"]
        task = asyncio.ensure_future(calibrate())
        flight.wire.clear()
        while not flight.wire.all(m.ParamSet):  # noqa: ASYNC110
            await anyio.sleep(0.01)
        await anyio.sleep(after_s)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await anyio.sleep(10)
        assert flight.copter.parameters["ESC_CALIBRATION"] == before


async def test_gear_on_ground_is_not_retracted_in_silence() -> None:
    async with open_flight(fitted_copter()) as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        await anyio.sleep(3)
        flight.copter.faults.drop_outgoing = 1_000_000
        await anyio.sleep(3)
        with pytest.raises(OperationRejected, match="on the ground"):
            await flight.vehicle.actuators.raise_landing_gear()
        assert not flight.wire.commands(C.AIRFRAME_CONFIGURATION)


async def test_escs_of_silent_vehicle_are_not_calibrated() -> None:
    """PX4 gives the motors full throttle at once."""
    async with on_px4() as flight:
        flight.px4.faults.drop_outgoing = 1_000_000
        await anyio.sleep(30)
        with pytest.raises(OperationRejected, match="not known to be disarmed"):
            async for _ in flight.vehicle.calibrate.escs(intent="propellers are removed"):
                pass
        assert not flight.wire.commands(C.PREFLIGHT_CALIBRATION)
