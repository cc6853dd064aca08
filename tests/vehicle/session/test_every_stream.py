"""``vehicle.streams``: all streams of a vehicle, requested again when missing."""

from __future__ import annotations

import itertools

import anyio
import pytest
from flight_harness import Flight, Px4Flight, open_flight, open_px4

from aerokit import messages as m
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message

pytestmark = pytest.mark.anyio


def interval(flight: Flight, kind: type[Message]) -> float:
    """Seconds between two of these messages, as the vehicle has it."""
    return flight.copter.channels[0].streams.interval(kind.ID)


def requests(flight: Flight | Px4Flight) -> list[tuple[int, int, int, int]]:
    return [
        (message.target_component, message.req_stream_id, message.req_message_rate, message.start_stop)
        for message in flight.wire.all(m.RequestDataStream)
    ]


async def test_streams_arrive_at_requested_rate() -> None:
    async with open_flight(rates={}) as flight:
        with flight.vehicle.streams(8):
            await anyio.sleep(30.0)
            assert requests(flight) == [(0, 0, 8, 1)], "requested once: it arrives"
            assert interval(flight, m.Attitude) == pytest.approx(1 / 8, rel=0.1)
            assert interval(flight, m.ServoOutputRaw) == pytest.approx(1 / 8, rel=0.1)


async def test_reboot_requests_streams_again() -> None:
    async with open_flight(rates={}) as flight:
        with flight.vehicle.streams(0.2):
            await anyio.sleep(5.0)
            flight.copter.restart()
            await anyio.sleep(15.0)
            assert requests(flight)[0] == (0, 0, 1, 1)
            assert len(requests(flight)) > 1
        flight.wire.clear()
        flight.copter.restart()
        await anyio.sleep(15.0)
        assert not requests(flight), "they have no subscriber left"


async def test_missing_stream_request_interval_grows() -> None:
    async with open_flight(rates={}) as flight:
        flight.copter.faults.loss_incoming = 1.0
        with flight.vehicle.streams(4):
            await anyio.sleep(100.0)
        times = flight.wire.times(m.RequestDataStream)
        assert [round(later - at) for at, later in itertools.pairwise(times)] == [3, 6, 12, 24, 48]


async def test_streams_of_px4_requests_missing_states() -> None:
    async with open_px4(rates={}) as flight:
        with flight.vehicle.streams(2):
            await anyio.sleep(10.0)
            assert not requests(flight)
            missing = [command.param1 for command in flight.wire.commands(MavCmd.SET_MESSAGE_INTERVAL)]
            assert all(flight.vehicle.telemetry.cells[name].is_known for name in ("attitude", "position", "gps"))
        await anyio.sleep(5.0)
        given_back = [
            command.param1 for command in flight.wire.commands(MavCmd.SET_MESSAGE_INTERVAL) if command.param2 == 0
        ]
        assert sorted(given_back) == sorted(set(missing))


@pytest.mark.parametrize("rate_hz", [0, -1, 1001, float("nan")])
async def test_rates_out_of_range(rate_hz: float) -> None:
    async with open_flight(rates={}) as flight:
        with (
            pytest.raises(InvalidArgument, match="rate_hz"),
            flight.vehicle.streams(rate_hz),
        ):
            pass
        assert not requests(flight)
