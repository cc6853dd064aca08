"""Speeds, the altitude of returns, and the reason of an arming."""

from __future__ import annotations

import logging

import pytest
from flight_harness import Wire, in_the_air, open_flight

import aerokit
from aerokit import messages as m
from aerokit.errors import CommandRejected, InvalidArgument, NotSupported
from aerokit.mavlink.enums import MavCmd
from aerokit.sim import (
    SimulatedPlane,
    SimulatedPx4,
    SimulatedPx4Plane,
    SimulatedRover,
    SimulatedVehicle,
    simulated_link,
)

pytestmark = pytest.mark.anyio

SPEED = MavCmd.DO_CHANGE_SPEED


async def test_set_climb_speed_changes_the_copter() -> None:
    async with in_the_air() as flight:
        await flight.vehicle.set_climb_speed(1.25)
        await flight.vehicle.set_descent_speed(0.75)
        assert (flight.copter.guided.climb, flight.copter.guided.descent) == (1.25, 0.75)


async def test_set_airspeed_of_plane_outside_guided_is_refused() -> None:
    async with simulated_link(SimulatedPlane(boot_time_s=0.0)) as link, aerokit.connect(link) as vehicle:
        with pytest.raises(CommandRejected):
            await vehicle.set_airspeed(20)


@pytest.mark.parametrize(
    ("name", "simulated"),
    [("set_airspeed", SimulatedPx4), ("set_climb_speed", SimulatedPx4Plane), ("set_climb_speed", SimulatedPlane)],
)
async def test_speed_of_other_kind_is_not_supported(name: str, simulated: type[SimulatedVehicle]) -> None:
    """PX4 would take a climb speed for its cruise speed."""
    async with simulated_link(simulated()) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            with pytest.raises(NotSupported, match=vehicle.autopilot.firmware):
                await getattr(vehicle, name)(5)
            assert wire.commands(SPEED) == []


@pytest.mark.parametrize(
    ("simulated", "name", "value"),
    [
        (SimulatedPlane, "RTL_ALTITUDE", 45.5),
        (SimulatedPx4, "RTL_RETURN_ALT", 45.5),
        (SimulatedPx4Plane, "RTL_RETURN_ALT", 45.5),
    ],
)
async def test_return_altitude_is_in_metres(simulated: type[SimulatedVehicle], name: str, value: float) -> None:
    vehicle_end = simulated()
    async with simulated_link(vehicle_end) as link, aerokit.connect(link) as vehicle:
        await vehicle.set_return_altitude(value)
        assert vehicle_end.parameters[name] == value  # type: ignore[attr-defined]
        assert await vehicle.return_altitude() == value


async def test_return_altitude_of_old_copter_is_in_centimetres_there() -> None:
    async with open_flight() as flight:
        await flight.vehicle.set_return_altitude(45.5)
        assert flight.copter.parameters["RTL_ALT"] == 4550
        assert await flight.vehicle.return_altitude() == 45.5


async def test_return_altitude_of_rover_is_not_supported() -> None:
    async with simulated_link(SimulatedRover()) as link, aerokit.connect(link) as vehicle:
        with pytest.raises(NotSupported, match="Rover does not climb"):
            await vehicle.set_return_altitude(20)


async def test_arm_with_reason_sends_it_before_the_command(caplog: pytest.LogCaptureFixture) -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        with caplog.at_level(logging.INFO, "aerokit"):
            await flight.vehicle.arm(mode="GUIDED", reason="survey of field 7")
        assert flight.wire.last(m.Statustext).text == "survey of field 7"
        (text_at,) = flight.wire.times(m.Statustext)
        command_at = next(at for at, sent in flight.wire.sent if getattr(sent, "command", 0) == 400)
        assert text_at <= command_at
        assert "arming vehicle 1: survey of field 7" in caplog.text


async def test_arm_with_long_reason_sends_nothing() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        with pytest.raises(InvalidArgument, match="at most 50 bytes"):
            await flight.vehicle.arm(reason="ä" * 26)
        assert flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM) == []
