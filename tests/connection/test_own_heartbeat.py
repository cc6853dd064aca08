"""Our own heartbeat: its fields, and its pause when the program makes no calls."""

from __future__ import annotations

import subprocess
import sys
import time
from typing import Any

import anyio
import pytest
from exhaustive import exhaustive
from flight_harness import open_flight
from served_copter import served, served_copter

import aerokit.sync
from aerokit import OwnHeartbeat, dronekit
from aerokit import messages as m
from aerokit.connection.connection import Connection
from aerokit.errors import InvalidArgument
from aerokit.events import HeartbeatPaused, HeartbeatResumed
from aerokit.mavlink.enums import MavType
from aerokit.sim import SimulatedCopter

BLOCKING_MAX_IDLE_S = 60.0


@pytest.mark.exhaustive
@pytest.mark.anyio
@pytest.mark.parametrize("limit_s", [None, exhaustive(float("inf"))])
async def test_heartbeat_in_asyncio_needs_no_feeding(limit_s: float | None) -> None:
    async with open_flight(heartbeat=OwnHeartbeat(fed_within_s=limit_s)) as flight:
        flight.wire.clear()
        await anyio.sleep(600.5)
        assert len(flight.wire.all(m.Heartbeat)) >= 600


@pytest.mark.anyio
async def test_unfed_heartbeat_pauses_and_resumes(caplog: pytest.LogCaptureFixture) -> None:
    async with open_flight(heartbeat=OwnHeartbeat(fed_within_s=5.0)) as flight:
        connection = flight.vehicle.connection
        with connection.subscribe(HeartbeatPaused, HeartbeatResumed, capacity=5) as events:
            for _ in range(4):
                connection.feed()
                await anyio.sleep(4.0)
            assert events.get_nowait() is None
            await anyio.sleep(3.0)
            flight.wire.clear()
            await anyio.sleep(10.0)
            assert flight.wire.all(m.Heartbeat) == []
            paused = events.get_nowait()
            assert isinstance(paused, HeartbeatPaused)
            assert 5.0 < paused.idle_s <= 6.0
            assert "has not called aerokit for 6 s (in asyncio: connection.feed())" in caplog.text
            connection.feed()
            await anyio.sleep(1.5)
            assert flight.wire.all(m.Heartbeat)
            assert isinstance(events.get_nowait(), HeartbeatResumed)


@pytest.mark.anyio
async def test_heartbeat_has_the_configured_type() -> None:
    async with open_flight(heartbeat=OwnHeartbeat(type=MavType.ONBOARD_CONTROLLER)) as flight:
        await anyio.sleep(2.0)
        assert {heartbeat.type for heartbeat in flight.wire.all(m.Heartbeat)} == {MavType.ONBOARD_CONTROLLER}


@pytest.mark.anyio
async def test_no_heartbeat_is_sent_if_disabled() -> None:
    async with open_flight(heartbeat=None) as flight:
        await flight.vehicle.wait_ready()
        flight.vehicle.connection.feed()
        assert flight.wire.all(m.Heartbeat) == []


@pytest.mark.parametrize("values", [{"type": 256}, {"type": "GCS"}, {"fed_within_s": 0.5}, {"fed_within_s": "5"}])
def test_invalid_heartbeat_settings_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InvalidArgument, match=f"{next(iter(values))} = "):
        OwnHeartbeat(**values)


@pytest.mark.anyio
async def test_connect_does_not_change_heartbeat_of_open_connection() -> None:
    async with open_flight() as flight:
        with pytest.raises(InvalidArgument, match="heartbeat = … is not allowed here"):
            async with aerokit.connect(flight.vehicle.connection, heartbeat=None):
                raise AssertionError


# ------------------------------------------------------------------------- blocking programs


class IdleClock:
    """The program's clock, which a test advances as if the program had made no call."""

    def __init__(self, connection: Connection) -> None:
        assert connection._heartbeat is not None
        self._switch = connection._heartbeat

    def __call__(self, seconds: float) -> bool:
        """True if our heartbeat is still sent after this many seconds without a call."""
        self._switch.activity._fed_at -= seconds
        return self._switch.should_send()


def test_heartbeat_of_blocking_program_pauses_until_next_call() -> None:
    with served_copter() as address, aerokit.sync.connect(address) as vehicle:
        idle_for = IdleClock(vehicle.aio.connection)
        assert idle_for(BLOCKING_MAX_IDLE_S - 5.0)
        assert not idle_for(10.0)
        _ = vehicle.position.latest  # a reading is a sign of life
        assert idle_for(0.0)
        assert not idle_for(BLOCKING_MAX_IDLE_S + 1.0)
        vehicle.wait_ready()
        assert idle_for(0.0)
        position = vehicle.position
        assert not idle_for(BLOCKING_MAX_IDLE_S + 1.0)
        _ = position.age  # and so is one of a cell that the program has kept
        assert idle_for(0.0)


def test_heartbeat_continues_during_a_blocking_call() -> None:
    with served_copter() as address, aerokit.sync.connect(address) as vehicle:
        idle_for = IdleClock(vehicle.aio.connection)
        observed: list[bool] = []

        def look(_: object) -> bool:
            observed.append(idle_for(BLOCKING_MAX_IDLE_S + 10.0))
            return True

        vehicle.armed.wait_until(look)
        assert observed == [True]


def test_calls_feed_heartbeat_of_blocking_fleet_and_connection() -> None:
    with served_copter() as address, aerokit.sync.open_connection(address) as connection:
        idle_for = IdleClock(connection.aio)
        assert not idle_for(BLOCKING_MAX_IDLE_S + 1.0)
        with aerokit.sync.fleet(connection, count=1) as fleet:
            assert idle_for(0.0)
            assert not idle_for(BLOCKING_MAX_IDLE_S + 1.0)
            assert len(fleet) == 1
            assert idle_for(0.0)


def test_attribute_reads_feed_heartbeat_of_classic_program() -> None:
    with served_copter() as address:
        vehicle = dronekit.connect(address)
        try:
            idle_for = IdleClock(vehicle.aio.connection)
            for name in ("mode", "armed", "location", "battery", "parameters", "is_armable", "channels"):
                assert not idle_for(BLOCKING_MAX_IDLE_S + 1.0)
                getattr(vehicle, name)
                assert idle_for(0.0), name
            assert idle_for(BLOCKING_MAX_IDLE_S - 5.0)
        finally:
            vehicle.close()


HANGING = """
import sys, time, aerokit.sync
with aerokit.sync.connect(sys.argv[1], heartbeat=aerokit.OwnHeartbeat(fed_within_s=1)) as vehicle:
    print("connected", flush=True)
    while True:
        time.sleep(0.01)
"""


def test_heartbeat_of_program_in_endless_loop_stops() -> None:
    """The vehicle no longer receives a ground station; with real sockets."""
    copter = SimulatedCopter(boot_time_s=0.0)
    received: list[float] = []
    copter.on(m.Heartbeat, lambda beat, _: received.append(time.monotonic()) if beat.type == MavType.GCS else None)
    with (
        served([copter]) as address,
        subprocess.Popen([sys.executable, "-c", HANGING, address], stdout=subprocess.PIPE) as program,
    ):
        try:
            assert program.stdout is not None
            program.stdout.readline()
            give_up_at = time.monotonic() + 200.0
            while not received or time.monotonic() - received[-1] < 4.0:
                assert time.monotonic() < give_up_at, "heartbeats continue"
                time.sleep(0.1)
            assert program.poll() is None
        finally:
            program.kill()
