"""All vehicles of a connection, and their state as plain values."""

from __future__ import annotations

import json

import anyio
import pytest

import aerokit
from aerokit.connection.opening import open_connection
from aerokit.errors import BusyError, ConnectionClosed, InvalidArgument, NotSupported
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.vehicle.connect import vehicles_on
from aerokit.vehicle.vehicle import overview

pytestmark = pytest.mark.anyio


async def test_vehicles_on_connects_each_and_closes_at_end() -> None:
    simulated = [SimulatedCopter(system_id=1, boot_time_s=0.0), SimulatedPx4(system_id=7, boot_time_s=0.0)]
    found: list[int] = []
    both = anyio.Event()

    def on_found(vehicle: aerokit.Vehicle) -> None:
        found.append(vehicle.system_id)
        if len(found) == 2:
            both.set()

    async with simulated_link(simulated) as link, open_connection(link) as connection:
        async with vehicles_on(connection, on_found=on_found) as vehicles:
            with anyio.fail_after(10):
                await both.wait()
            assert sorted(found) == [1, 7]
            await vehicles[7].position.wait_until(lambda place: True, timeout=10)
            reported = overview(vehicles[7])
            assert (reported["system_id"], reported["autopilot"], reported["link"]["state"]) == (7, "PX4", "connected")
            assert reported["states"]["position"]["value"]["latitude_deg"] == pytest.approx(
                vehicles[7].position.value.latitude_deg
            )
            assert 0 <= reported["states"]["position"]["age_s"] < 5
            assert reported["states"]["armed"]["value"] is False
            json.dumps(reported, allow_nan=False)
            with pytest.raises(BusyError):
                async with aerokit.connect(connection, system_id=1):
                    raise AssertionError
        async with aerokit.connect(connection, system_id=1) as again:
            assert again.system_id == 1


async def test_vehicles_on_skips_connected_vehicle() -> None:
    simulated = [SimulatedCopter(system_id=number, boot_time_s=0.0) for number in (1, 2)]
    async with (
        simulated_link(simulated) as link,
        open_connection(link) as connection,
        aerokit.connect(connection, system_id=1) as own,
        vehicles_on(connection) as vehicles,
    ):
        await anyio.sleep(5)
        assert list(vehicles) == [2]
        await own.mode.wait_until(lambda mode: True, timeout=5)


@pytest.mark.parametrize("error", [NotSupported("no camera"), ZeroDivisionError()])
async def test_vehicles_on_logs_error_of_callback(error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    def on_found(vehicle: aerokit.Vehicle) -> None:
        raise error

    async with (
        simulated_link(SimulatedCopter()) as link,
        open_connection(link) as connection,
        vehicles_on(connection, on_found=on_found) as vehicles,
    ):
        await anyio.sleep(5)
        await vehicles[1].mode.wait_until(lambda mode: True, timeout=5)
        assert "on_found failed for vehicle 1" in caplog.text


async def test_vehicles_on_closed_connection_raises() -> None:
    async with simulated_link(SimulatedCopter()) as link:
        async with open_connection(link) as connection:
            pass
        with pytest.raises(ConnectionClosed):
            async with vehicles_on(connection):
                raise AssertionError


async def test_vehicles_on_refuses_invalid_rate() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link, open_connection(link) as connection:
        with pytest.raises(InvalidArgument, match="ATTITUDE"):
            async with vehicles_on(connection, rates={aerokit.messages.Attitude: -1.0}):
                pass
