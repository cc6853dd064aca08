"""Streams into a multicopter: sticks, body rates at 400 Hz, and a landing on a target."""

from __future__ import annotations

import math
from typing import Any

import pytest
from any_vehicle import Choice, ready

from aerokit import AttitudeRateSetpoint, StickInput, Vehicle
from aerokit import messages as m
from aerokit.errors import NotSupported
from aerokit.testing import VIRTUAL_BACKEND
from aerokit.vehicle.external.values import TargetMeasurement

pytestmark = pytest.mark.anyio

MULTICOPTERS = ("copter", "px4")
ALTITUDE_M = 10.0
TARGET_NORTH_M, TARGET_EAST_M = 3.0, -2.0
BLIND_BELOW_M = 0.4


@pytest.fixture
def anyio_backend(choice: Choice) -> Any:
    return VIRTUAL_BACKEND if choice.is_virtual else "asyncio"


async def up(vehicle: Vehicle, choice: Choice) -> None:
    if choice.kind.guided is not None:
        await vehicle.set_mode(choice.kind.guided)
    await vehicle.arm(timeout=choice.seconds(10))
    await vehicle.take_off(ALTITUDE_M, timeout=choice.seconds(120))


def limits(choice: Choice) -> dict[str, Any]:
    """Return limits of a stream for a busy machine."""
    return {} if choice.is_virtual else {"valid_for_s": 3.0, "max_lag_s": 3.0}


async def test_sticks_move_multicopter(choice: Choice) -> None:
    """The vehicle flies forward while the stick is forward, and holds at the end of the block."""
    if choice.kind.name not in MULTICOPTERS:
        pytest.skip("no multicopter")
    async with ready(choice) as vehicle:
        await up(vehicle, choice)
        start = vehicle.position.value
        async with vehicle.sticks(**limits(choice)) as sticks:
            await sticks.move(StickInput(forward=0.5), choice.seconds(5) if choice.is_virtual else 5 / choice.speedup)
        assert vehicle.mode_name in ("BRAKE", "LOITER")
        assert vehicle.distance_to(start.replace(altitude_relative_m=None, altitude_amsl_m=None)) > 1.5
        await vehicle.land(timeout=choice.seconds(200))


async def test_body_rates_turn_multicopter(choice: Choice) -> None:
    """The vehicle turns at the rate that is streamed at 400 Hz; ArduPilot's planes and boats do not take rates."""
    if choice.kind.name == "px4_plane":
        pytest.skip("PX4 takes rates in OFFBOARD for planes too; not flown")
    async with ready(choice) as vehicle:
        if choice.kind.name not in MULTICOPTERS:
            with pytest.raises(NotSupported):
                vehicle.guided.attitude_rate()
            return
        await up(vehicle, choice)
        setpoint = AttitudeRateSetpoint(yaw_deg_s=20.0)
        async with vehicle.guided.attitude_rate(setpoint, rate_hz=400, **limits(choice)) as stream:
            await stream.fly(setpoint, 3.0 / choice.speedup)
            rate = vehicle.attitude.value.yaw_rate_deg_s
        assert rate == pytest.approx(20.0, abs=6.0)
        await vehicle.land(timeout=choice.seconds(200))


async def test_precision_landing_ends_on_target(choice: Choice) -> None:
    """The vehicle lands at a place that a simulated camera reports."""
    if choice.kind.name not in MULTICOPTERS:
        pytest.skip("no multicopter")
    async with ready(choice) as vehicle:
        if choice.kind.is_ardupilot:
            await enable_precision_landing(vehicle, choice)
        await up(vehicle, choice)
        start = vehicle.local_position.value
        north_m, east_m = start.north_m + TARGET_NORTH_M, start.east_m + TARGET_EAST_M

        def see() -> TargetMeasurement | None:
            here, yaw = vehicle.local_position.value, math.radians(vehicle.heading_deg.value)
            north, east, height = north_m - here.north_m, east_m - here.east_m, -here.down_m
            if height < BLIND_BELOW_M:
                return None
            forward, right = (
                north * math.cos(yaw) + east * math.sin(yaw),
                east * math.cos(yaw) - north * math.sin(yaw),
            )
            return TargetMeasurement(forward, right, height, is_level=True)

        with vehicle.rate(m.LocalPositionNed, 20.0):
            report = await vehicle.land_on(see, timeout=choice.seconds(300))
            here = vehicle.local_position.value
        assert report.used_target
        assert math.hypot(here.north_m - north_m, here.east_m - east_m) < 1.0


async def enable_precision_landing(vehicle: Vehicle, choice: Choice) -> None:
    await vehicle.parameters.set("PLND_ENABLED", 1)
    await vehicle.parameters.set("PLND_TYPE", 1)
    if choice.is_binary:  # The firmware starts the sensor when it boots.
        await vehicle.reboot(timeout=choice.seconds(60))
        await vehicle.wait_ready(timeout=choice.seconds(120))
