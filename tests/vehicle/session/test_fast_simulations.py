"""A vehicle that lives up to forty times as fast as we do: its reboots are noticed, it waits for us, it never leaps."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import pytest
from flight_harness import block_loop

from aerokit import Vehicle, VelocitySetpoint, connect
from aerokit import messages as m
from aerokit.errors import SetpointStreamStopped
from aerokit.events import VehicleRebooted
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, simulated_link
from aerokit.sim.kinds import scale_timeouts

pytestmark = pytest.mark.anyio

KINDS = {"copter": SimulatedCopter, "px4": SimulatedPx4}


@asynccontextmanager
async def served(vehicle: SimulatedVehicle, speedup: float) -> AsyncIterator[Vehicle]:
    async with simulated_link(vehicle, speedup=speedup, latency_s=0.002) as link, connect(link) as client:
        await client.wait_ready()
        yield client


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("speedup", [1.0, 10.0, 40.0])
async def test_fast_simulation_reboot_is_detected(kind: str, speedup: float) -> None:
    simulated = KINDS[kind](boot_time_s=1.0)
    async with served(simulated, speedup) as vehicle:
        await anyio.sleep(0.3)  # After this time, the vehicle has reported its clock several times.
        with vehicle.subscribe(VehicleRebooted, capacity=5) as events:
            await vehicle.reboot(timeout=10.0)
            assert simulated.uptime < 12.0
            await vehicle.wait_ready(timeout=3.0)
            await anyio.sleep(1.0)
            assert len(list(iter(events.get_nowait, None))) == 1


async def test_rates_requested_during_reboot_are_repeated_immediately() -> None:
    """A request lost in the reboot is not counted as ignored."""
    async with served(SimulatedCopter(boot_time_s=0.0), 20.0) as vehicle, anyio.create_task_group() as tasks:
        tasks.start_soon(vehicle.reboot)
        await anyio.sleep(0.05)  # it is off
        with vehicle.subscribe(m.ScaledImu2, rate_hz=10.0) as asked_meanwhile:
            await asked_meanwhile.get(timeout=2.0)


@pytest.mark.exhaustive
async def test_px4_fast_simulation_obeys_10_hz_setpoints() -> None:
    for is_patient in (True, False):
        px4 = SimulatedPx4(boot_time_s=1.0)
        if is_patient:
            scale_timeouts([px4], 20.0)
        async with served(px4, 20.0) as vehicle:
            await vehicle.arm()
            await vehicle.take_off(10)
            stream = vehicle.guided.velocity()
            if is_patient:
                async with stream:
                    await stream.fly(VelocitySetpoint(north_m_s=1), 2.0)
                assert px4.motion.north > 15
            else:
                with pytest.raises(SetpointStreamStopped, match="left OFFBOARD for RTL"):
                    async with stream:
                        await stream.fly(VelocitySetpoint(north_m_s=1), 2.0)


async def test_message_stream_limits_scale_with_clients() -> None:
    copter, px4 = SimulatedCopter(), SimulatedPx4()
    scale_timeouts([copter, px4], 10.0, leave=["GUID_TIMEOUT"])
    names = ("FS_GCS_TIMEOUT", "GUID_TIMEOUT", "DISARM_DELAY", "RC_OVERRIDE_TIME")
    assert [copter.parameters[name] for name in names] == [50.0, 3.0, 100.0, 30.0]
    assert [px4.parameters[name] for name in ("COM_DL_LOSS_T", "COM_OF_LOSS_T", "COM_RC_LOSS_T")] == [
        100.0,
        10.0,
        5.0,
    ]


async def test_real_time_simulation_keeps_limits() -> None:
    copter = SimulatedCopter()
    scale_timeouts([copter], 0.5)
    assert (copter.parameters["DISARM_DELAY"], copter.parameters["GUID_TIMEOUT"]) == (10.0, 3.0)


@pytest.mark.parametrize(("speedup", "passed"), [(1.0, 3.0), (20.0, 0.5)])
async def test_blocked_time_is_no_silence(speedup: float, passed: float) -> None:
    """In real time the pause is caught up; at higher speeds all but half a simulated second is skipped."""
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter, speedup=speedup):
        await anyio.sleep(1.0)
        before = copter.now
        block_loop(3.0)
        await anyio.sleep(0.001)
        assert copter.now - before == pytest.approx(passed, abs=1.2)
