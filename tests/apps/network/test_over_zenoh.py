"""The API over a zenoh network, and published state, in real time on real sockets."""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncIterator
from typing import Any

import pytest
from free_ports import free_port
from zenoh_network import HoldingProxy, eventually, router

import aerokit
from aerokit import VelocitySetpoint, events
from aerokit.apps.network import discover, publishing
from aerokit.errors import CommandRejected, LinkOpenError
from aerokit.missions import Mission, return_to_launch, take_off, waypoint
from aerokit.sim import SimulatedCopter, open_simulator
from aerokit.sim.kinds import scale_timeouts

zenoh: Any = pytest.importorskip("zenoh")
pytestmark = pytest.mark.anyio

SPEEDUP = 20.0


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@contextlib.asynccontextmanager
async def copter_at(port: int) -> AsyncIterator[SimulatedCopter]:
    """A simulated copter, which a router has as ``alpha``."""
    copter = SimulatedCopter(boot_time_s=0.0)
    scale_timeouts([copter], SPEEDUP)
    address = f"zenohin://north/alpha?connect=tcp/127.0.0.1:{port}"
    with router(port):
        async with open_simulator(copter, address, speedup=SPEEDUP):
            yield copter


@pytest.mark.exhaustive
@pytest.mark.usefixtures("any_delay")
async def test_zenoh_link_supports_whole_api() -> None:
    port = free_port()
    address = f"zenoh://north/alpha?connect=tcp/127.0.0.1:{port}&client=ground-1&timeout=100"
    async with copter_at(port), aerokit.connect(address, timeout=100) as vehicle:
        await vehicle.wait_ready()
        parameters = await vehicle.parameters.download()
        assert len(parameters) > 100
        await vehicle.parameters.set("RTL_ALT", 1600)
        here = vehicle.position.value.offset(north_m=20)
        mission = Mission([
            take_off(altitude_relative_m=5),
            waypoint(here.latitude_deg, here.longitude_deg, altitude_relative_m=5),
            return_to_launch(),
        ])  # fmt: skip
        await vehicle.mission.upload(mission)
        assert mission.matches(await vehicle.mission.download())
        await vehicle.files.make_directory("/work")
        await vehicle.files.write("/work/note", bytes(range(256)) * 20)
        assert await vehicle.files.read("/work/note") == bytes(range(256)) * 20
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(5)
        async with vehicle.guided.velocity(valid_for_s=60.0, max_lag_s=60.0) as stream:
            await stream.fly(VelocitySetpoint(north_m_s=2), 0.3)
        await vehicle.land()
        link: Any = vehicle.connection.link
        assert link.lease_holder == "ground-1"
        assert link.dropped_writes == 0


@pytest.mark.exhaustive
@pytest.mark.usefixtures("any_delay")
async def test_zenoh_client_without_control_is_refused() -> None:
    port = free_port()
    address = f"zenoh://north/alpha?connect=tcp/127.0.0.1:{port}&timeout=100&client="
    async with (
        copter_at(port),
        aerokit.connect(address + "one", timeout=100) as one,
        aerokit.connect(address + "two", source_system=254, timeout=100) as two,
    ):
        await one.wait_ready()
        await one.set_mode("GUIDED")
        with two.subscribe(events.OrderRefused, capacity=8) as refusals:
            with pytest.raises(CommandRejected) as refused:  # reasons are waited for; not a time-out
                await two.arm(timeout=100)
            assert "network: one has control" in refused.value.reasons
            refusal = await refusals.get(timeout=100)
            assert (refusal.message, refusal.reason, refusal.lease_holder) == (
                "COMMAND_LONG",
                "one has control",
                "one",
            )
        assert len(await two.parameters.download()) > 100  # anybody reads
        assert not one.armed.value
        await one.arm()


@pytest.mark.exhaustive
async def test_zenoh_reconnect_survives_partition() -> None:
    port = free_port()
    async with copter_at(port), HoldingProxy(port) as line:
        address = f"zenoh://north/alpha?connect=tcp/127.0.0.1:{line.port}"
        async with aerokit.connect(address, reconnect=True) as vehicle:
            await vehicle.wait_ready()
            line.hold()
            await vehicle.link_state.wait_until(lambda state: state is not aerokit.LinkState.CONNECTED, timeout=100)
            line.release()
            await vehicle.link_state.wait_until(lambda state: state is aerokit.LinkState.CONNECTED, timeout=100)
            await vehicle.set_mode("GUIDED")
            await vehicle.arm()


@pytest.mark.usefixtures("any_delay")
async def test_zenoh_publishes_states() -> None:
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    received: dict[str, dict[str, Any]] = {}

    def hear(sample: Any) -> None:
        received[str(sample.key_expr)] = json.loads(sample.payload.to_bytes())

    async with (
        copter_at(port),
        aerokit.connect(f"zenoh://north/alpha?connect={endpoint}&timeout=100", timeout=100) as vehicle,
    ):
        config = zenoh.Config()
        for key, value in (
            ("mode", "client"),
            ("connect/endpoints", [endpoint]),
            ("scouting/multicast/enabled", False),
        ):
            config.insert_json5(key, json.dumps(value))
        other = zenoh.open(config)
        subscriber: Any = other.declare_subscriber("aerokit/north/*/state/**", hear)
        async with publishing(vehicle, f"zenoh://north/alpha?connect={endpoint}", rate_hz=20):
            await eventually(lambda: "aerokit/north/alpha/state/1/position" in received)
            position = received["aerokit/north/alpha/state/1/position"]
            assert position["value"]["latitude_deg"] == pytest.approx(vehicle.position.value.latitude_deg, abs=1e-4)
            for wait_s in (0.2, 2.0, 20.0):  # the router may need long to answer
                if found := await discover("north", connect=[endpoint], wait=wait_s):
                    break
            assert found == ["alpha"]
        del subscriber
        other.close()


async def test_zenoh_without_network_raises() -> None:
    with pytest.raises(LinkOpenError):
        await discover("north", connect=[f"tcp/127.0.0.1:{free_port()}"])
