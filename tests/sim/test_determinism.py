"""Equal seeds and calls produce equal bytes for every kind of vehicle and any step size."""

from __future__ import annotations

import asyncio
import inspect
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import aerokit.sim
from aerokit.errors import LinkLost
from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavDataStream
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, SimulatedWind, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport import Peer

KINDS = [
    kind
    for _, kind in inspect.getmembers(aerokit.sim, inspect.isclass)
    if issubclass(kind, SimulatedVehicle) and {"seed", "boot_time_s"} <= set(inspect.signature(kind).parameters)
]
END_S = 6.0
FORCE = 21196.0


def command(number: int, *params: float) -> m.CommandLong:
    one, two, three, four, five, six, seven = (*params, *(0.0,) * (7 - len(params)))
    return m.CommandLong(1, 1, number, 0, one, two, three, four, five, six, seven)


HEARTBEAT = m.Heartbeat(6, 8, 0, 0, 4, 3)
STREAMS = m.RequestDataStream(1, 1, MavDataStream.ALL, 4, 1)
ARM = command(MavCmd.COMPONENT_ARM_DISARM, 1.0, FORCE)
TAKE_OFF = command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10.0)
# Messages of a client; not every kind supports all of them.
CALLS: tuple[Message, ...] = (
    HEARTBEAT,
    STREAMS,
    ARM,
    TAKE_OFF,
    command(MavCmd.SET_MESSAGE_INTERVAL, m.Attitude.ID, 20_000.0),
    command(MavCmd.DO_SET_MODE, 1.0, 4.0),
    command(MavCmd.NAV_LAND),
    command(MavCmd.NAV_RETURN_TO_LAUNCH),
    command(MavCmd.COMPONENT_ARM_DISARM, 0.0, FORCE),
    command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1.0),
    m.ParamRequestRead(1, 1, "", 3),
    m.MissionRequestList(1, 1),
    m.Timesync(0, 7),
    m.SetPositionTargetLocalNed(0, 1, 1, 1, 0xDC7, 0, 0, 0, 3.0, -2.0, -0.5, 0, 0, 0, 0, 0),
)

instants = st.floats(0.0, END_S)
scripts = st.lists(st.tuples(instants, st.sampled_from(CALLS)), max_size=8).map(
    lambda calls: sorted(calls, key=lambda call: call[0])
)


@dataclass(frozen=True)
class ChannelOutput:
    """Output of two channels of a vehicle in a run."""

    first: bytes
    second: bytes


def fly(
    kind: type[SimulatedVehicle],
    calls: list[tuple[float, Message]],
    cuts: list[float],
    *,
    seed: int = 5,
    gusts_m_s: float = 1.0,
) -> ChannelOutput:
    """Return the bytes of a run with 10 % loss; ``cuts`` are times of additional steps."""
    vehicle = booting_vehicle(kind, seed, gusts_m_s)
    vehicle.faults.loss = 0.1
    second, encoder = vehicle.open_channel(), FrameEncoder(255, 190)
    vehicle.step(0.0)
    first = b""
    for when, message in sorted([*calls, *((cut, None) for cut in cuts), (END_S, None)], key=lambda entry: entry[0]):
        if message is None:
            vehicle.step(when)
        else:
            vehicle.receive(encoder.encode(message), when)
        first += vehicle.take_outbox()
    return ChannelOutput(first, second.take_outbox())


def booting_vehicle(kind: type[SimulatedVehicle], seed: int, gusts_m_s: float) -> SimulatedVehicle:
    """Return a vehicle that boots in one second, if its kind has that option."""
    wanted: dict[str, object] = {
        "boot_time_s": 1.0,
        "wind": SimulatedWind(3.0, 1.0, gusts_m_s=gusts_m_s),
        "parameter_count": 20,
    }
    known = inspect.signature(kind).parameters
    options: Any = {name: value for name, value in wanted.items() if name in known}
    return kind(seed=seed, **options)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(calls=scripts, cuts=st.lists(instants, max_size=30), gusts_m_s=st.sampled_from([0.0, 1.0]))
def test_step_size_does_not_change_the_bytes(
    kind: type[SimulatedVehicle], calls: list[tuple[float, Message]], cuts: list[float], gusts_m_s: float
) -> None:
    """Without gusts, steady flight has long ticks."""
    assert fly(kind, calls, [], gusts_m_s=gusts_m_s) == fly(kind, calls, cuts, gusts_m_s=gusts_m_s)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", KINDS)
def test_seed_determines_the_bytes(kind: type[SimulatedVehicle]) -> None:
    calls: list[tuple[float, Message]] = [(2.0, STREAMS), (3.0, ARM), (3.1, TAKE_OFF)]
    assert fly(kind, calls, []) == fly(kind, calls, [])
    assert fly(kind, calls, []) != fly(kind, calls, [], seed=6)


class StoringReceiver:
    """Stores received bytes with their times."""

    def __init__(self) -> None:
        self.received: list[tuple[float, bytes]] = []

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.received.append((asyncio.get_running_loop().time(), data))

    def link_lost(self, error: LinkLost) -> None:
        """Called when the owner closes the link."""


async def serve(seed: int) -> list[tuple[float, bytes]]:
    """Run a copter and a PX4 on one link for ten seconds, with streams and a flight."""
    copter = SimulatedCopter(boot_time_s=1.0, seed=seed, parameter_count=20)
    px4 = SimulatedPx4(system_id=2, boot_time_s=1.0, seed=seed, parameter_count=20, wind=SimulatedWind(gusts_m_s=1.0))
    ears, encoder = StoringReceiver(), FrameEncoder(255, 190)
    async with simulated_link([copter, px4], latency_s=0.01) as link:
        await link.open(ears)
        await asyncio.sleep(2.0)
        for message in (STREAMS, ARM, TAKE_OFF):
            link.write(encoder.encode(message))
        await asyncio.sleep(8.0)
    return ears.received


def test_server_sends_equal_bytes_at_equal_times() -> None:
    first = run_virtual(serve(1))
    assert first == run_virtual(serve(1))
    assert first != run_virtual(serve(2))
    assert first[-1][0] > 9.0
