"""Copters in trouble: lost acks, an outage with a failsafe, another station, a reboot in flight.

The same rules as in `tests/vehicle/commanding/orders`, on any vehicle; see `test_any_vehicle`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from any_vehicle import Choice, served
from disturbed_link import Disturbances, DisturbedLink

from aerokit import Vehicle, connect, fleet
from aerokit import messages as m
from aerokit.errors import AerokitError, FleetError, HeartbeatTimeout, OperationRejected
from aerokit.fleets.members import MemberState
from aerokit.mavlink import Framer
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing import VIRTUAL_BACKEND
from aerokit.transport import Link, create_link

pytestmark = pytest.mark.anyio

DISTANCE_M = 400.0
ANOTHER_STATION = 254
REBOOT_BY_FORCE = 20190226
LANDED_ON_GROUND = 1
STEER = (MavCmd.DO_REPOSITION, MavCmd.DO_SET_MODE)


@pytest.fixture
def anyio_backend(choice: Choice) -> Any:
    return VIRTUAL_BACKEND if choice.is_virtual else "asyncio"


@pytest.fixture(autouse=True)
def _is_a_copter(choice: Choice) -> None:
    if choice.kind.name not in ("copter", "px4"):
        pytest.skip("it is flown by copters of both autopilots")


@asynccontextmanager
async def flying(choice: Choice, *, through_disturbance: bool = True) -> AsyncIterator[tuple[Vehicle, DisturbedLink]]:
    """A vehicle some metres up that accepts orders, over a link without disturbances so far."""
    async with served(choice) as served_at:
        link = served_at if isinstance(served_at, Link) else create_link(served_at)
        path = DisturbedLink(link)
        async with connect(path if through_disturbance else link, timeout=30) as vehicle:
            await vehicle.wait_ready(timeout=choice.seconds(120))
            name = "FS_GCS_ENABLE" if choice.kind.is_ardupilot else "NAV_DLL_ACT"
            async with vehicle.parameters.temporarily({name: 1 if choice.kind.is_ardupilot else 2}):
                if choice.kind.guided is not None:
                    await vehicle.set_mode(choice.kind.guided)
                await vehicle.arm(timeout=choice.seconds(10))
                await vehicle.take_off(choice.kind.altitude_m, timeout=choice.seconds(120))
                await anyio.sleep(choice.seconds(3) if choice.is_virtual else 3.0)
                yield vehicle, path
                if vehicle.is_armed:
                    if vehicle.landed_state.latest != LANDED_ON_GROUND:
                        await vehicle.return_to_launch(timeout=choice.seconds(400))
                    await vehicle.armed.wait_until(lambda armed: not armed, timeout=choice.seconds(60))


def far(vehicle: Vehicle) -> Any:
    return vehicle.position.value.offset(north_m=DISTANCE_M)


def sent(path: DisturbedLink, command: int) -> int:
    return sum(getattr(message.message, "command", None) == command for message in path.sent)


class AnotherStation:
    """Sends commands on the same link, with its own ids."""

    def __init__(self, vehicle: Vehicle, path: DisturbedLink) -> None:
        self._vehicle, self._path = vehicle, path
        self._encoder = FrameEncoder(ANOTHER_STATION, 190)

    def command(self, command: int, *params: float) -> None:
        padded = (*params, *(0.0,) * (7 - len(params)))
        target = (self._vehicle.system_id, self._vehicle.component_id)
        self._path.link.write(self._encoder.encode(m.CommandLong(*target, command, 0, *padded)))

    def return_to_launch(self) -> None:
        mode = self._vehicle.autopilot.mode_for("return")
        assert mode is not None
        self.command(MavCmd.DO_SET_MODE, *self._vehicle.autopilot.mode_order(mode).params)


async def test_lost_acks_send_nothing_twice(choice: Choice) -> None:
    async with flying(choice) as (vehicle, path):
        path.disturbances = Disturbances(command=MavCmd.DO_SET_MODE, lost_acks=9)
        path.begin()
        await vehicle.return_to_launch(timeout=choice.seconds(400))
        assert sent(path, MavCmd.DO_SET_MODE) == 1


async def test_takeover_by_other_station_during_lost_ack_keeps_vehicle(choice: Choice) -> None:
    async with flying(choice) as (vehicle, path):
        path.disturbances = Disturbances(command=MavCmd.DO_REPOSITION, lost_acks=9)
        path.begin()
        async with anyio.create_task_group() as tasks:

            async def take_over() -> None:
                await anyio.sleep(0.3)
                AnotherStation(vehicle, path).return_to_launch()

            tasks.start_soon(take_over)
            with pytest.raises(OperationRejected):
                await vehicle.go_to(far(vehicle))
        await anyio.sleep(5.0)
        assert sent(path, MavCmd.DO_REPOSITION) == 1
        assert sent(path, MavCmd.DO_SET_MODE) == 0
        assert vehicle.mode_name == "RTL"


@pytest.mark.sampled(2)
async def test_failsafe_during_real_outage_keeps_vehicle(choice: Choice) -> None:
    """Twelve seconds, with the failsafe for a lost ground station."""
    async with flying(choice) as (vehicle, path):
        path.begin()
        path.disturbances = Disturbances(outage=(3.0, 15.0))
        with pytest.raises((HeartbeatTimeout, OperationRejected)):
            await vehicle.go_to(far(vehicle))
        await vehicle.armed.wait_until(lambda _: vehicle.heartbeat_age < 1.0, timeout=20)
        back_at = next(heartbeat.at for heartbeat in path.heartbeats if heartbeat.at > path.began_at + 15.0)
        await anyio.sleep(5.0)
        assert sent(path, MavCmd.DO_SET_MODE) == 0
        if choice.kind.is_ardupilot:
            assert vehicle.mode_name == "RTL"
        else:  # When PX4 receives HEARTBEATs again, it returns to its mode, and aerokit commands a hold.
            orders = [
                message.at for message in path.sent if getattr(message.message, "command", 0) == MavCmd.DO_REPOSITION
            ]
            assert not [at for at in orders[1:] if at < back_at]


async def test_blocked_program_leaves_the_failsafe_alone(choice: Choice) -> None:
    """Blocked for 14 s, while HEARTBEATs wait in the socket; the call is cancelled when the program continues."""
    if not choice.is_binary:
        pytest.skip("a simulated vehicle would be blocked, too: tests/vehicle/commanding/orders/test_paused_program.py")
    async with flying(choice, through_disturbance=False) as (vehicle, _):
        orders: list[int] = []
        vehicle.connection.observe_sent_frames(lambda raw: orders.append(command_in(raw)))
        asyncio.get_running_loop().call_later(3.0, time.sleep, 14.0)
        with anyio.move_on_after(6.0), pytest.raises((HeartbeatTimeout, OperationRejected)):
            await vehicle.go_to(far(vehicle))
        await anyio.sleep(3.0)
        assert [order for order in orders if order in STEER] == [MavCmd.DO_REPOSITION]
        assert vehicle.mode_name in ("RTL", "LAND")


def command_in(raw: bytes) -> int:
    """The MAV_CMD of a frame; 0 if it is none."""
    (frame,) = Framer().receive(raw, 0.0)
    return int(getattr(STANDARD.decode(frame), "command", 0))


@pytest.mark.sampled(2)
async def test_fleet_member_taken_by_other_station_is_left_alone(choice: Choice) -> None:
    """It was flying before the fleet was opened; another member does not respond."""
    silent = SimulatedCopter(system_id=77, boot_time_s=0.0)
    async with flying(choice) as (vehicle, path), simulated_link(silent) as link:
        connection = vehicle.connection
        connection.attached.discard(vehicle.system_id)  # The vehicle looks like one that another program controls.
        async with fleet({"real": connection, "other": link}, count=2) as both:
            path.begin()
            before = vehicle.mode_name
            assert both.members[f"real/{vehicle.system_id}"].state is MemberState.TAKEN_OVER
            with pytest.raises(FleetError):
                await both.barrier(lambda _: False, timeout=3.0)
            with anyio.move_on_after(2.0):
                await both.barrier(lambda _: False, timeout=30.0)
            await anyio.sleep(2.0)
            assert sent(path, MavCmd.DO_REPOSITION) == sent(path, MavCmd.DO_SET_MODE) == 0
            assert vehicle.mode_name == before


@pytest.mark.sampled(2)
async def test_reboot_in_flight_ends_orders(choice: Choice) -> None:
    """ArduCopter obeys, by force, and falls; PX4 denies it and flies on."""
    async with flying(choice) as (vehicle, path):
        station = AnotherStation(vehicle, path)
        path.begin()
        error: AerokitError | None = None
        with anyio.move_on_after(30.0):
            async with anyio.create_task_group() as tasks:

                async def reboot() -> None:
                    await anyio.sleep(2.0)
                    station.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1, 0, 0, 0, 0, REBOOT_BY_FORCE)

                tasks.start_soon(reboot)
                try:
                    await vehicle.go_to(far(vehicle), timeout=25.0)
                except AerokitError as caught:
                    error = caught
        assert error is not None
        assert sent(path, MavCmd.DO_REPOSITION) <= 1 + (not choice.kind.is_ardupilot)  # PX4 holds by it
        if choice.kind.is_ardupilot:
            assert isinstance(error, (OperationRejected, HeartbeatTimeout))
            assert sent(path, MavCmd.DO_SET_MODE) == 0
