"""Every kind of vehicle on the ground: simulated (all kinds, the default), at an address, or a given binary.

``pytest -n 0 tests/integration -k any_ --vehicle path/to/arducopter`` starts the binary and tests it. All assertions
hold for simulated and real vehicles. `test_any_flight` is about flying.
"""

from __future__ import annotations

import math
from typing import Any

import anyio
import pytest
from any_vehicle import Choice, connected, ready

from aerokit import Position, Vehicle
from aerokit import messages as m
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    OperationRejected,
    ParameterRejected,
    ParameterTimeout,
)
from aerokit.missions import Fence, FenceCircle, FencePolygon, Mission, RallyPoints, rally_point, waypoint
from aerokit.testing import VIRTUAL_BACKEND

pytestmark = pytest.mark.anyio

DO_SET_MODE, REQUEST_MESSAGE, SET_MESSAGE_INTERVAL = 176, 512, 511
UNKNOWN_COMMAND, UNKNOWN_MESSAGE, UNKNOWN_MODE = 31999, 65000, 200


@pytest.fixture
def anyio_backend(choice: Choice) -> Any:
    return VIRTUAL_BACKEND if choice.is_virtual else "asyncio"


async def test_boot_until_ready(choice: Choice) -> None:
    """It is disarmed while booting; then it reports position and home, and does not move."""
    async with connected(choice) as vehicle:
        if choice.kind.is_ardupilot and choice.vehicle == "sim":
            with pytest.raises(CommandRejected):
                await vehicle.arm()
        await vehicle.wait_ready(timeout=choice.seconds(120))
        home, here = vehicle.home.value, vehicle.position.fresh(within=5)
        assert here.distance_to(Position(home.latitude_deg, home.longitude_deg)) < 5
        if choice.kind.takes_off:  # a real Rover's home is at sea level, wherever it stands
            assert abs(here.altitude_relative_m or 0.0) < 3
        assert (await vehicle.version.wait_until(lambda _: True)).capabilities & 0x02  # MISSION_INT or PARAM_FLOAT
        assert await vehicle.why_not_armable() == []
        assert not vehicle.is_armed


async def test_parameters(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        assert len(await vehicle.parameters.download()) >= choice.kind.parameters
        name, value = choice.kind.parameter
        before = await vehicle.parameters.get(name)
        await vehicle.parameters.set(name, value)
        assert (await vehicle.parameters.read(name)).value == pytest.approx(value)
        await vehicle.parameters.set(name, float(before))
        with pytest.raises((ParameterTimeout, ParameterRejected)):
            await vehicle.parameters.read("NO_SUCH_NAME")


async def test_plans_upload_and_download(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        mission = around(vehicle, choice)
        await vehicle.mission.upload(mission)
        assert [item.command for item in await vehicle.mission.download()] == [i.command for i in mission]
        here = vehicle.position.value
        fence = Fence(
            (FencePolygon(tuple(here.offset(north_m=n, east_m=e) for n, e in ((-500, -500), (500, -500), (0, 500)))),),
            (FenceCircle(here, 900.0),),
        )
        await vehicle.fence.upload(fence)
        assert fence.matches(await vehicle.fence.download())
        await vehicle.fence.clear()
        if choice.kind.has_rally:
            place = here.offset(north_m=40)
            point = rally_point(place.latitude_deg, place.longitude_deg, altitude_relative_m=30)
            await vehicle.rally.upload(RallyPoints([point]))
            assert len((await vehicle.rally.download()).positions) == 1
            await vehicle.rally.clear()
            assert not (await vehicle.rally.download()).items
        await vehicle.mission.clear()
        assert len(await vehicle.mission.download()) == 0


async def test_modes(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        for mode in choice.kind.modes:
            await vehicle.set_mode(mode)
            assert vehicle.mode_name == mode
        if choice.kind.is_ardupilot:
            with pytest.raises(OperationRejected):
                await vehicle.command(DO_SET_MODE, 1, UNKNOWN_MODE, 0)
        assert vehicle.mode_name == choice.kind.modes[-1]


async def test_unsupported_commands_are_refused(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        for command in (UNKNOWN_COMMAND, REQUEST_MESSAGE, SET_MESSAGE_INTERVAL):
            with pytest.raises(CommandRejected):
                await vehicle.command(command, UNKNOWN_MESSAGE, 100_000)
        with pytest.raises(CommandTimeout):
            await vehicle.command(REQUEST_MESSAGE, 148, component_id=77, retries=0)
        if choice.kind.takes_off:
            with pytest.raises(OperationRejected):
                await vehicle.take_off(choice.kind.altitude_m)
        assert not vehicle.is_armed


async def test_messages_arrive_at_requested_rate(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        with vehicle.subscribe(m.Attitude, rate_hz=20, capacity=1000) as attitudes:
            await attitudes.get(timeout=10)
            await anyio.sleep(1.0)
            while attitudes.get_nowait() is not None:
                pass
            await anyio.sleep(2.0)
            times = [attitude.time_boot_ms for attitude in iter(attitudes.get_nowait, None)]
        seconds = (times[-1] - times[0]) / 1000
        assert 15 < (len(times) - 1) / seconds < 60
        await vehicle.command(REQUEST_MESSAGE, m.SystemTime.ID)
        for cell in (vehicle.attitude, vehicle.gps, vehicle.batteries):
            await cell.wait_until(lambda _: True)
        assert all(map(math.isfinite, (vehicle.attitude.value.roll_deg, vehicle.attitude.value.pitch_deg)))


async def test_files(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        assert len(await vehicle.files.list("/")) > 0
        with pytest.raises(OperationRejected):
            await vehicle.files.read("/no/such/file.txt")


async def test_armed_and_disarmed(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        if choice.kind.guided is not None:
            await vehicle.set_mode(choice.kind.guided)
        await vehicle.arm(timeout=choice.seconds(10))
        with pytest.raises(OperationRejected):
            await vehicle.reboot()
        await vehicle.disarm(timeout=choice.seconds(10))
        assert not vehicle.is_armed


async def test_reboot(choice: Choice) -> None:
    """After the reboot its streams are requested again; PX4's simulation refuses to reboot."""
    async with ready(choice) as vehicle:
        if choice.vehicle != "sim" and not choice.kind.is_ardupilot:
            with pytest.raises(CommandRejected):
                await vehicle.reboot()
            return
        await vehicle.reboot(timeout=choice.seconds(60))
        await vehicle.wait_ready(timeout=choice.seconds(120))
        assert not vehicle.is_armed


def around(vehicle: Vehicle, choice: Choice) -> Mission:
    """Two corners."""
    here, far, up = vehicle.position.value, choice.kind.travel_m, choice.kind.altitude_m
    corners = [here.offset(north_m=far), here.offset(north_m=far, east_m=far)]
    return Mission([waypoint(corner.latitude_deg, corner.longitude_deg, altitude_relative_m=up) for corner in corners])
