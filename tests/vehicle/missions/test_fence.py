"""vehicle.fence: upload, download, clear, enable."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from flight_harness import open_flight, open_px4
from plan_flights import near_home, sent_for_plans

from aerokit import messages as m
from aerokit.errors import CommandRejected, InvalidArgument, MissionRejected, NotSupported
from aerokit.mavlink.enums import MavCmd
from aerokit.missions import Fence, FenceCircle, FencePolygon, Mission, waypoint
from aerokit.missions.compare import ItemStorage
from aerokit.position import Position
from aerokit.sim import SimulatedCopter

pytestmark = pytest.mark.anyio


def place(north_m: float, east_m: float) -> Position:
    return Position(*near_home(north_m, east_m))


FENCE = Fence(
    [
        FencePolygon([place(500, 500), place(500, -500), place(-500, -500), place(-500, 500)]),
        FencePolygon([place(100, 100), place(100, 120), place(120, 120)], inclusion=False),
    ],
    [FenceCircle(place(0, 0), 400.0), FenceCircle(place(200, 0), 20.5, inclusion=False)],
)


@pytest.mark.parametrize("opened", [open_flight, open_px4])
@pytest.mark.parametrize("method", ["auto", "items"])
async def test_upload_download_round_trip(opened: Any, method: Any) -> None:
    async with opened() as flight:
        fence = flight.vehicle.fence
        await fence.upload(FENCE, method=method)
        assert FENCE.matches(await fence.download(method=method))
        await fence.clear()
        assert await fence.download(method=method) == Fence()


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_fence_over_mavlink_1_is_not_supported(opened: Any) -> None:
    """Its mission type is an extension field, which MAVLink 1 cuts off: the vehicle would clear its mission."""
    async with opened() as flight:
        vehicle = flight.vehicle
        mission = Mission([waypoint(*near_home(100, 0), altitude_relative_m=20)] * 3)
        await vehicle.mission.upload(mission)
        vehicle.connection.mavlink_version = 1
        with pytest.raises(NotSupported, match="MAVLink 1"):
            await vehicle.fence.upload(FENCE, method="items")
        with pytest.raises(NotSupported, match="MAVLink 1"):
            await vehicle.fence.download(method="items")
        for plan in (vehicle.fence, vehicle.rally):
            with pytest.raises(NotSupported, match="MAVLink 1"):
                await plan.clear()
        assert mission.matches(await vehicle.mission.download(method="items"))


async def test_ardupilot_counts_an_extra_circle() -> None:
    """ArduPilot writes a fence only when it has all of it, also in parts."""
    wider = FENCE.replace(circles=[FenceCircle(place(0, 0), 450.0), FENCE.circles[1]])
    async with open_flight() as flight:
        await flight.vehicle.fence.upload(FENCE, method="items")
        flight.wire.clear()
        await flight.vehicle.fence.upload(wider, method="items")
        assert len(flight.wire.all(m.MissionItemInt)) == 1
        assert wider.matches(await flight.vehicle.fence.download(), ItemStorage.ARDUPILOT)


@pytest.mark.parametrize("method", ["auto", "items"])
@pytest.mark.parametrize("verify", [True, False])
@pytest.mark.parametrize("latency_s", [0.0, 0.03, 0.2])  # With 0.03 s, the fence is erased while it is read back.
async def test_small_fence_after_larger_one_remains(method: Any, verify: bool, latency_s: float) -> None:
    """ArduCopter erases a fence of one or two circles that replaces a larger one, just after it has confirmed it."""
    circle = Fence(circles=[FenceCircle(place(0, 0), 100.0)])
    async with open_flight(latency_s=latency_s) as flight:
        await flight.vehicle.fence.upload(FENCE, method=method)
        await flight.vehicle.fence.upload(circle, method=method, verify=verify)
        await anyio.sleep(2)
        assert len(flight.copter.missions.items(1)) == 1


async def test_erased_fence_after_cancelled_upload_is_sent_again() -> None:
    circle = Fence(circles=[FenceCircle(place(0, 0), 100.0)])
    async with open_flight() as flight:
        await flight.vehicle.fence.upload(FENCE)
        with anyio.move_on_after(0.3):
            await flight.vehicle.fence.upload(circle)
        assert flight.copter.missions.items(1) == []
        await flight.vehicle.fence.upload(circle)
        assert len(flight.copter.missions.items(1)) == 1


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_refused_fence_keeps_the_old_one(opened: Any) -> None:
    async with opened() as flight:
        await flight.vehicle.fence.upload(FENCE)
        many = Fence([FencePolygon([place(i, i % 2) for i in range(70)])] * 200)
        with pytest.raises(MissionRejected, match="the vehicle still has its previous items"):
            await flight.vehicle.fence.upload(many, method="items")
        assert FENCE.matches(await flight.vehicle.fence.download())


@pytest.mark.parametrize("method", ["items", "auto"])
async def test_download_from_starting_vehicle_waits_for_fence(method: Any) -> None:
    """ArduCopter and Rover report no fence until they have started, although they have stored one."""
    copter = SimulatedCopter(boot_time_s=4.0)
    copter.missions.replace(1, FENCE.to_items())
    copter.missions.reset()
    async with open_flight(copter) as flight:
        assert not copter.is_initialised
        assert FENCE.matches(await flight.vehicle.fence.download(method=method))
        assert copter.is_initialised or method == "auto"


async def test_fence_enable_and_disable() -> None:
    async with open_flight() as flight:
        await flight.vehicle.fence.upload(FENCE)
        await flight.vehicle.fence.enable()
        await flight.vehicle.fence.enable(False)
        orders = flight.wire.commands(MavCmd.DO_FENCE_ENABLE)
        assert [order.param1 for order in orders] == [1, 0]
    async with open_px4() as other:
        with pytest.raises(CommandRejected, match="does not know"):
            await other.vehicle.fence.enable()


async def test_uploading_a_mission_as_fence_is_refused() -> None:
    async with open_flight() as flight:
        plan: Any = Mission()
        with pytest.raises(InvalidArgument, match="a Fence"):
            await flight.vehicle.fence.upload(plan)
        assert sent_for_plans(flight.wire) == []
