"""PX4's MISSION_SET_CURRENT, which is not acknowledged, follows the rules of all orders."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import Px4Flight, open_px4

from aerokit import messages as m
from aerokit import missions
from aerokit.errors import OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavCmd
from aerokit.sim.px4.modes import POSITION

pytestmark = pytest.mark.anyio


async def _start_mission(flight: Px4Flight) -> None:
    await flight.take_off()
    here = flight.vehicle.position.value
    places = [here.offset(north_m=50.0 * number) for number in (1, 2, 3)]
    items = [missions.waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=10) for place in places]
    await flight.vehicle.mission.upload(missions.Mission(items))
    await flight.vehicle.mission.start()
    await anyio.sleep(1.5)
    flight.wire.clear()


@pytest.mark.parametrize("item", [0, 2], ids=["the current item", "another item"])
@pytest.mark.parametrize("party", ["a pilot", "the program"])
async def test_set_current_is_not_resent_after_takeover(party: str, item: int) -> None:
    async with open_px4() as flight:
        await _start_mission(flight)
        flight.px4.faults.lose(m.MissionCurrent, times=100)
        async with anyio.create_task_group() as tasks:

            async def interfere() -> None:
                await anyio.sleep(0.3)
                if party == "a pilot":
                    flight.px4.switch_to(POSITION)
                else:
                    await flight.vehicle.command(MavCmd.NAV_RETURN_TO_LAUNCH)

            tasks.start_soon(interfere)
            with pytest.raises(OperationRejected, match=r"not sent again: (the mode|another order)"):
                await flight.vehicle.mission.set_current(item)
        assert len(flight.wire.all(m.MissionSetCurrent)) == 1


async def test_set_current_of_return_that_changes_the_mode_succeeds() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        place = flight.vehicle.position.value.offset(north_m=100.0)
        items = [missions.waypoint(place, altitude_relative_m=10), missions.return_to_launch()]
        await flight.vehicle.mission.upload(missions.Mission(items))
        await flight.vehicle.mission.start()
        await anyio.sleep(1.1)
        flight.px4.faults.lose(m.MissionCurrent, times=2)  # HEARTBEAT reports RTL before any MISSION_CURRENT arrives.
        await flight.vehicle.mission.set_current(1)
        assert flight.vehicle.mode.value.name == "RTL"
        assert flight.vehicle.mission.current.value == 1


async def test_set_current_is_not_resent_into_silence() -> None:
    async with open_px4() as flight:
        await _start_mission(flight)
        flight.px4.faults.silent = True
        with pytest.raises(OperationTimeout, match="1 attempts"):
            await flight.vehicle.mission.set_current(2)
        assert len(flight.wire.all(m.MissionSetCurrent)) == 1


async def test_start_waits_for_running_transfer_until_timeout() -> None:
    """The transfer of another task uses the vehicle's state machine for plans."""
    async with open_px4() as flight:
        await _start_mission(flight)
        mission, began = flight.vehicle.mission, anyio.current_time()
        async with mission._context.lock:
            with anyio.fail_after(60), pytest.raises(OperationTimeout, match="not done within 3 s"):
                await mission.start(1, timeout=3.0)
        assert anyio.current_time() - began == pytest.approx(3.0, abs=0.5)
        assert not flight.wire.all(m.MissionSetCurrent)
        await mission.set_current(2)
