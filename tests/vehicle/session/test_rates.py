"""Message rates: requested by subscriptions, kept, released, requested again, and reported when missing."""

from __future__ import annotations

import itertools
from contextlib import AsyncExitStack

import anyio
import pytest
from flight_harness import Flight, open_flight, open_px4

import aerokit
from aerokit import messages as m
from aerokit.errors import InvalidArgument
from aerokit.events import StreamSlow, StreamUnavailable
from aerokit.mavlink.enums import MavCmd, MavDataStream, MavResult
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCopter, simulated_link

pytestmark = pytest.mark.anyio

SET_INTERVAL = MavCmd.SET_MESSAGE_INTERVAL


def asked(flight: Flight, kind: type[Message]) -> list[float]:
    """Return the requested intervals of this message in seconds."""
    return [command.param2 / 1e6 for command in flight.wire.commands(SET_INTERVAL) if command.param1 == kind.ID]


def interval(flight: Flight, kind: type[Message]) -> float:
    """Seconds between two of these messages, as the vehicle has it."""
    return flight.copter.channels[0].streams.interval(kind.ID)


def group_requests(flight: Flight) -> dict[int, list[tuple[int, int]]]:
    requests: dict[int, list[tuple[int, int]]] = {}
    for message in flight.wire.all(m.RequestDataStream):
        assert (message.target_system, message.target_component) == (1, 1)
        requests.setdefault(message.req_stream_id, []).append((message.req_message_rate, message.start_stop))
    return requests


async def test_default_rates_are_requested_immediately() -> None:
    async with open_flight() as flight:
        await anyio.sleep(1.0)
        for kind, hz in flight.vehicle.telemetry.default_rates.items():
            assert asked(flight, kind) == pytest.approx([1 / hz], rel=1e-5), kind
        assert interval(flight, m.Attitude) == pytest.approx(0.1)
        assert interval(flight, m.GlobalPositionInt) == pytest.approx(0.1)


async def test_connect_rates_custom_and_empty() -> None:
    async with open_flight(rates={m.Attitude: 25.0}) as flight:
        await anyio.sleep(2.0)
        assert asked(flight, m.Attitude) == [0.04]
        assert len(flight.wire.commands(SET_INTERVAL)) == 1
    async with open_flight(rates={}) as flight:
        await anyio.sleep(10.0)
        assert not flight.wire.commands(SET_INTERVAL)
        assert not flight.wire.all(m.RequestDataStream)


async def test_subscription_requests_and_releases_rate(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    with vehicle.subscribe(m.Attitude, rate_hz=50.0, capacity=200) as attitudes:
        await anyio.sleep(1.0)
        assert interval(grounded, m.Attitude) == pytest.approx(0.02)
        while attitudes.get_nowait():
            pass
        await anyio.sleep(2.0)
        assert len(list(iter(attitudes.get_nowait, None))) == pytest.approx(100, abs=2)
    await anyio.sleep(1.0)
    assert interval(grounded, m.Attitude) == pytest.approx(0.1)  # the default rate again


async def test_rate_released_without_default_restores_autopilot_rate(grounded: Flight) -> None:
    with grounded.vehicle.subscribe(m.RawImu, rate_hz=20.0):
        await anyio.sleep(1.0)
        assert interval(grounded, m.RawImu) == pytest.approx(0.05)
    await anyio.sleep(1.0)
    assert asked(grounded, m.RawImu) == [0.05, 0.0]
    assert interval(grounded, m.RawImu) == 0.0


async def test_highest_requested_rate_wins(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    with vehicle.rate(m.RawImu, 5.0):
        await anyio.sleep(1.0)
        assert interval(grounded, m.RawImu) == pytest.approx(0.2)
        with vehicle.rate(m.RawImu, 20.0):
            with vehicle.rate(m.RawImu, 10.0):
                await anyio.sleep(1.0)
                assert interval(grounded, m.RawImu) == pytest.approx(0.05)
            await anyio.sleep(1.0)
            assert interval(grounded, m.RawImu) == pytest.approx(0.05)
        await anyio.sleep(1.0)
        assert interval(grounded, m.RawImu) == pytest.approx(0.2)


async def test_slower_rate_request_sends_nothing(grounded: Flight) -> None:
    with grounded.vehicle.rate(m.Attitude, 2.0):
        await anyio.sleep(2.0)
    await anyio.sleep(2.0)
    assert not asked(grounded, m.Attitude)


@pytest.mark.parametrize("hz", [0.0, -1.0, 1001.0, float("nan")])
async def test_rates_out_of_range(grounded: Flight, hz: float) -> None:
    with pytest.raises(InvalidArgument, match="rate_hz"), grounded.vehicle.rate(m.Attitude, hz):
        raise AssertionError
    with (
        pytest.raises(InvalidArgument, match="rate_hz"),
        grounded.vehicle.subscribe(m.Attitude, rate_hz=hz),
    ):
        raise AssertionError
    assert not asked(grounded, m.Attitude)


async def test_message_rate_out_of_range_keeps_earlier_rate(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    with pytest.raises(InvalidArgument, match="rate_hz"):
        vehicle.message(m.RawImu, rate_hz=0.0)
    assert m.RawImu not in vehicle._session.subscriber._cells
    vehicle.message(m.RawImu, rate_hz=20.0)
    with pytest.raises(InvalidArgument, match="rate_hz"):
        vehicle.message(m.RawImu, rate_hz=2000.0)
    vehicle.message(m.RawImu, rate_hz=5.0)
    await anyio.sleep(1.0)
    assert interval(grounded, m.RawImu) == pytest.approx(0.2)


async def test_rate_request_lost_is_sent_again() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.faults.ignore(SET_INTERVAL, times=7)
    async with open_flight(copter) as flight:
        await anyio.sleep(30.0)
        for kind, hz in flight.vehicle.telemetry.default_rates.items():
            if kind not in (m.DistanceSensor,):
                assert interval(flight, kind) == pytest.approx(1 / hz, rel=1e-5), kind


async def test_reboot_requests_all_rates_again(grounded: Flight) -> None:
    with grounded.vehicle.rate(m.RawImu, 20.0):
        await anyio.sleep(10.0)
        grounded.wire.clear()
        grounded.copter.restart()
        await anyio.sleep(10.0)
        assert asked(grounded, m.Attitude) == pytest.approx([0.1])
        assert asked(grounded, m.RawImu) == pytest.approx([0.05])
        assert interval(grounded, m.RawImu) == pytest.approx(0.05)


async def test_stream_disabled_by_other_station_is_requested_again(grounded: Flight) -> None:
    grounded.copter.channels[0].streams.set_interval(m.Attitude.ID, 0.0, grounded.copter.now)
    await anyio.sleep(12.0)
    assert asked(grounded, m.Attitude) == pytest.approx([0.1])
    assert grounded.vehicle.attitude.fresh(within=0.5)


async def test_missing_sensor_is_not_requested_continuously() -> None:
    async with open_flight() as flight:
        await anyio.sleep(120.0)
        assert 2 <= len(asked(flight, m.DistanceSensor)) <= 7


async def test_answered_timesync_is_requested_immediately_again() -> None:
    """Each unanswered request doubles the pause."""
    async with open_flight(rates={}) as flight, AsyncExitStack() as requests:
        await anyio.sleep(3.0)
        for times, hz in ((6, 20.0), (2, 50.0)):
            flight.wire.clear()
            flight.copter.faults.ignore(SET_INTERVAL, times=times)
            requests.enter_context(flight.vehicle.rate(m.RawImu, hz))
            await anyio.sleep(40.0)
            at = [when for when, message in flight.wire.sent if isinstance(message, m.CommandLong)]
            gaps = [later - earlier for earlier, later in itertools.pairwise(at)]
            assert gaps[:times] == pytest.approx([1.0, 3.0, 1.0, 5.0, 1.0, 9.0][:times], abs=1.01)


async def test_rate_refused_before_reboot_is_requested_again() -> None:
    async with open_flight(rates={}, latency_s=0.3) as flight:
        await anyio.sleep(3.0)
        flight.copter.faults.refuse(SET_INTERVAL, MavResult.DENIED, times=1)
        with (
            flight.vehicle.subscribe(StreamUnavailable, capacity=5) as events,
            flight.vehicle.rate(m.RawImu, 20.0),
        ):
            await anyio.sleep(0.4)  # The refusal is under way.
            flight.vehicle._session.rates.request_again()
            await anyio.sleep(2.0)
            assert interval(flight, m.RawImu) == pytest.approx(0.05)
            assert events.get_nowait() is None


async def test_interval_after_failures_is_bounded() -> None:
    """A vehicle may be silent for a day."""
    async with open_flight(rates={}) as flight:
        await anyio.sleep(3.0)
        flight.copter.faults.ignore(SET_INTERVAL)
        with flight.vehicle.rate(m.RawImu, 20.0):
            flight.vehicle._session.rates._streams[m.RawImu.ID].failures = 1100
            await anyio.sleep(70.0)
            assert len(asked(flight, m.RawImu)) == 4  # Each request is sent twice.


async def test_late_refusal_is_not_taken_for_next_stream() -> None:
    """At first, no round trip is known, and the answers arrive after the time-out."""
    async with simulated_link(SimulatedCopter(), latency_s=0.6) as link, aerokit.open_connection(link) as connection:
        with connection.subscribe(StreamUnavailable, capacity=5) as events:
            async with aerokit.connect(connection, rates={m.EstimatorStatus: 2.0, m.Attitude: 10.0}):
                await anyio.sleep(10.0)
            assert [event.message for event in iter(events.get_nowait, None)] == ["ESTIMATOR_STATUS"]


# ------------------------------------------------------------------------------------- events


async def test_slow_stream_publishes_event(grounded: Flight) -> None:
    with grounded.vehicle.subscribe(StreamSlow, capacity=20) as events:
        grounded.copter.channels[0].streams.set_interval(m.Attitude.ID, 0.5, grounded.copter.now)
        event = await events.get(timeout=10.0)
        assert (event.message, event.requested_hz) == ("ATTITUDE", 10.0)
        assert event.achieved_hz < 5.0
        await anyio.sleep(20.0)
        assert events.get_nowait() is None  # Reported once, not every second.


@pytest.mark.parametrize("boot_time_s", [3.0, 7.6, 12.2])
async def test_late_starting_stream_is_not_slow(boot_time_s: float) -> None:
    """The copter sends LOCAL_POSITION_NED once its estimator has a position."""
    async with open_flight(SimulatedCopter(boot_time_s=boot_time_s)) as flight:
        with flight.vehicle.subscribe(StreamSlow, capacity=20) as events:
            await flight.vehicle.wait_ready(timeout=60)
            await anyio.sleep(10.0)
            assert events.get_nowait() is None


@pytest.mark.parametrize(("interval_s", "is_slow"), [(0.54, False), (0.7, True)])
async def test_half_rate_minus_one_message_is_not_slow(interval_s: float, is_slow: bool) -> None:
    async with open_flight(rates={m.RawImu: 4.0}) as flight:
        with flight.vehicle.subscribe(StreamSlow, capacity=20) as events:
            await anyio.sleep(3.0)
            flight.copter.channels[0].streams.set_interval(m.RawImu.ID, interval_s, flight.copter.now)
            await anyio.sleep(20.0)
            assert (events.get_nowait() is not None) is is_slow


async def test_missing_stream_publishes_event() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        with (
            flight.vehicle.subscribe(StreamSlow, capacity=20) as events,
            flight.vehicle.rate(m.DistanceSensor, 5.0),
        ):
            event = await events.get(timeout=30.0)
            assert (event.message, event.achieved_hz) == ("DISTANCE_SENSOR", 0.0)


async def test_optional_stream_missing_publishes_nothing() -> None:
    async with open_flight() as flight:
        with flight.vehicle.subscribe(StreamSlow, StreamUnavailable, capacity=20) as events:
            await anyio.sleep(60.0)
            assert events.get_nowait() is None


async def test_stream_of_ended_subscription_is_optional_again(grounded: Flight) -> None:
    rates = grounded.vehicle._session.rates
    with grounded.vehicle.rate(m.Odometry, 10.0):
        await anyio.sleep(1.0)
    with grounded.vehicle.subscribe(StreamUnavailable, capacity=5) as events:
        rates.request(m.Odometry, 20.0, is_optional=True)
        await anyio.sleep(3.0)
        assert len(asked(grounded, m.Odometry)) == 2
        assert events.get_nowait() is None


async def test_optional_stream_slow_from_its_start_publishes_event() -> None:
    async with open_flight(rates={}) as flight:
        flight.copter.faults.lose(m.RawImu, times=200)
        flight.vehicle._session.rates.request(m.RawImu, 10.0, is_optional=True)
        with flight.vehicle.subscribe(StreamSlow, capacity=20) as events:
            await anyio.sleep(12.0)
            assert events.get_nowait() is None
            flight.copter.faults.lose(m.RawImu, times=0)
            flight.copter.channels[0].streams.set_interval(m.RawImu.ID, 0.5, flight.copter.now)
            event = await events.get(timeout=20.0)
            assert event.achieved_hz == pytest.approx(2.0, abs=0.5)


async def test_unavailable_message_publishes_event(grounded: Flight) -> None:
    with (
        grounded.vehicle.subscribe(StreamUnavailable, capacity=5) as events,
        grounded.vehicle.rate(m.Odometry, 10.0),
    ):
        event = await events.get(timeout=5.0)
        assert (event.system_id, event.message, event.reason) == (1, "ODOMETRY", "DENIED")
        await anyio.sleep(30.0)
        assert events.get_nowait() is None
        assert len(asked(grounded, m.Odometry)) == 1


async def test_refused_rate_is_requested_again_by_next_subscriber(
    grounded: Flight,
) -> None:
    grounded.copter.faults.refuse(SET_INTERVAL, MavResult.DENIED, times=1)
    with grounded.vehicle.rate(m.RawImu, 500.0):
        await anyio.sleep(1.0)
    with grounded.vehicle.rate(m.RawImu, 20.0):
        await anyio.sleep(1.0)
        assert interval(grounded, m.RawImu) == pytest.approx(0.05)


async def test_slower_rate_than_refused_one_is_requested(grounded: Flight) -> None:
    grounded.copter.faults.refuse(SET_INTERVAL, MavResult.DENIED, times=2)
    with grounded.vehicle.rate(m.RawImu, 500.0):
        await anyio.sleep(1.0)
        with grounded.vehicle.rate(m.RawImu, 20.0):
            await anyio.sleep(1.0)
            assert interval(grounded, m.RawImu) == pytest.approx(0.05)


async def test_accepted_rate_is_released_after_refused_one(grounded: Flight) -> None:
    before = interval(grounded, m.RawImu)
    with grounded.vehicle.rate(m.RawImu, 20.0):
        await anyio.sleep(1.0)
        grounded.copter.faults.refuse(SET_INTERVAL, MavResult.DENIED, times=1)
        with grounded.vehicle.rate(m.RawImu, 500.0):
            await anyio.sleep(1.0)
    await anyio.sleep(1.0)
    assert interval(grounded, m.RawImu) == before


# ----------------------------------------------------------------- firmware without the command


def old_copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, unsupported_commands=[SET_INTERVAL])


async def test_rates_old_firmware_gets_request_data_stream() -> None:
    async with open_flight(old_copter()) as flight:
        await anyio.sleep(2.0)
        assert len(flight.wire.commands(SET_INTERVAL)) == 1
        requests = group_requests(flight)
        assert requests[MavDataStream.EXTRA1] == [(10, 1)]
        assert requests[MavDataStream.POSITION] == [(10, 1)]
        assert requests[MavDataStream.EXTRA2] == [(5, 1)]
        assert interval(flight, m.Attitude) == pytest.approx(0.1)
        await flight.vehicle.wait_ready(timeout=10.0)


async def test_rates_old_firmware_group_uses_highest_rate() -> None:
    async with open_flight(old_copter()) as flight:
        await anyio.sleep(2.0)
        flight.wire.clear()
        with flight.vehicle.rate(m.Ahrs2, 30.0):
            await anyio.sleep(1.5)
            assert group_requests(flight) == {MavDataStream.EXTRA1: [(30, 1)]}
        await anyio.sleep(1.5)
        assert group_requests(flight) == {MavDataStream.EXTRA1: [(30, 1), (10, 1)]}


async def test_rates_old_firmware_requested_again_after_reboot() -> None:
    async with open_flight(old_copter()) as flight:
        await anyio.sleep(10.0)
        flight.wire.clear()
        flight.copter.restart()
        await anyio.sleep(10.0)
        assert group_requests(flight)[MavDataStream.EXTRA1]
        assert interval(flight, m.Attitude) == pytest.approx(0.1)


async def test_rates_old_firmware_message_without_group_is_unavailable() -> None:
    async with open_flight(old_copter()) as flight:
        await anyio.sleep(2.0)
        with (
            flight.vehicle.subscribe(StreamUnavailable, capacity=5) as events,
            flight.vehicle.rate(m.AttitudeQuaternion, 10.0),
        ):
            event = await events.get(timeout=5.0)
            assert event.message == "ATTITUDE_QUATERNION"
            await anyio.sleep(120.0)
            assert events.get_nowait() is None


# ------------------------------------------------------------------------------------------ PX4


async def test_px4_streams_are_set_by_interval() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        with flight.vehicle.subscribe(m.Attitude, rate_hz=20.0, capacity=200) as attitudes:
            await anyio.sleep(1.0)
            while attitudes.get_nowait():
                pass
            await anyio.sleep(2.0)
            assert len(list(iter(attitudes.get_nowait, None))) == pytest.approx(40, abs=2)
