"""Any message of the vehicle as a cell."""

from __future__ import annotations

import pytest

from aerokit import Vehicle, connect
from aerokit.errors import ConnectionClosed, InvalidArgument, ValueUnknownError
from aerokit.mavlink.messages import Attitude, Heartbeat, ScaledImu2
from aerokit.sim import SimulatedCopter, simulated_link

pytestmark = pytest.mark.anyio


async def test_message_cell_has_age_and_source() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link, rates={}) as vehicle:
        cell = vehicle.message(Attitude, rate_hz=20)
        assert vehicle.message(Attitude) is cell
        with pytest.raises(ValueUnknownError, match="ATTITUDE"):
            _ = cell.value
        attitude = await cell.wait_until(lambda message: message.time_boot_ms > 0, timeout=5)
        assert isinstance(attitude, Attitude)
        assert cell.source is not None
        assert (cell.source.system_id, cell.source.component_id) == (1, 1)
        assert cell.age < 0.1
        first = await cell.changes().__anext__()
        assert first.received_frame is not None


async def test_stream_ends_with_connection() -> None:
    kept: Vehicle
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:
        kept = vehicle
        heartbeats = vehicle.message(Heartbeat)
        await heartbeats.wait_until(lambda _: True, timeout=3)
    with pytest.raises(ConnectionClosed):
        await kept.message(Heartbeat).wait_until(lambda _: False, timeout=3)
    assert heartbeats.value.type == 2


async def test_rate_out_of_range_raises() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:
        with pytest.raises(InvalidArgument, match="rate_hz"):
            vehicle.message(ScaledImu2, rate_hz=0)
