"""Ages after the program was paused: values that arrived during the pause are not reported as younger."""

from __future__ import annotations

import gc
import math
import random
import socket
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from any_message import anything
from flight_harness import Flight, block_loop

import aerokit
from aerokit import LinkState, open_connection
from aerokit import messages as m
from aerokit.connection.cells import StateCell
from aerokit.connection.connection import Connection
from aerokit.connection.loop_watch import MIN_IDLE_ITERATIONS, LoopWatch, suspended_s
from aerokit.errors import LinkLost, StaleValueError
from aerokit.events import ComputerSlept, VehicleRebooted, VehicleSilent
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.transport import Peer
from aerokit.transport.link import BaseLink
from aerokit.vehicle.state.field import MESSAGE_IDS, message_type

pytestmark = pytest.mark.anyio


class Wire(BaseLink):
    """A link that is nothing but its receiver."""

    def __init__(self) -> None:
        super().__init__("wire")
        self._encoder = FrameEncoder(1, 1)

    async def _connect(self) -> None: ...

    def _release(self) -> None: ...

    def write(self, data: bytes, peer: Peer = None) -> None: ...

    def receive(self, number: int = 0) -> None:
        self._deliver(self._encoder.encode(m.Attitude(number, 0, 0, 0, 0, 0, 0)))


async def ages_of(connection: Connection, wire: Wire, receive: int = 1) -> list[float]:
    ages: list[float] = []

    def take(attitude: m.Attitude) -> None:
        assert attitude.received_frame is not None
        ages.append(connection.now() - attitude.received_frame.received_at)

    (detach,) = connection.attach([m.Attitude], take)
    for _ in range(receive):
        wire.receive()
        await anyio.lowlevel.checkpoint()  # as a socket that is read in bursts, one in each turn
    detach()
    return ages


async def test_arrival_after_pause_is_start_of_pause() -> None:
    wire = Wire()
    async with open_connection(wire) as connection:
        await anyio.sleep(5.03)
        assert await ages_of(connection, wire) == [0.0]
        block_loop(3.7)
        assert await ages_of(connection, wire, receive=50) == pytest.approx([3.73] * 50, abs=0.11)


async def test_arrival_stays_old_until_waiting_data_is_read() -> None:
    """The timer that notices the pause may come before the sockets have been read."""
    wire = Wire()
    async with open_connection(wire) as connection:
        await anyio.sleep(1)
        block_loop(3.7)
        await anyio.lowlevel.checkpoint()
        assert all(age > 3.5 for age in await ages_of(connection, wire, receive=50))
        for _ in range(MIN_IDLE_ITERATIONS + 2):
            await anyio.lowlevel.checkpoint()
        for later_s in (0, 0.05, 1):
            await anyio.sleep(later_s)
            assert await ages_of(connection, wire) == [0.0]


@pytest.mark.parametrize("scheme", ["udpin", "tcpin"])
async def test_arrival_stays_old_while_reading_takes_long(scheme: str) -> None:
    """Virtual time with real sockets, which hold more data than one iteration reads."""
    encoder, ages = FrameEncoder(1, 1), list[float]()
    kind = socket.SOCK_DGRAM if scheme == "udpin" else socket.SOCK_STREAM
    async with open_connection(f"{scheme}:127.0.0.1:0") as connection:
        host, port = connection.link.address.removeprefix(f"{scheme}:").split(":")

        def take(attitude: m.Attitude) -> None:
            assert attitude.received_frame is not None
            ages.append(connection.now() - attitude.received_frame.received_at)

        connection.attach([m.Attitude], take)
        with socket.socket(socket.AF_INET, kind) as sender:
            sender.connect((host, int(port)))
            await anyio.sleep(1)
            for number in range(300):
                sender.send(encoder.encode(m.Attitude(number, 0, 0, 0, 0, 0, 0)))
            block_loop(3.7)
            while len(ages) < 300:
                await anyio.lowlevel.checkpoint()
    assert min(ages) > 3.6


async def test_short_pause_bounds_the_error_of_ages() -> None:
    wire = Wire()
    async with open_connection(wire) as connection:
        await anyio.sleep(1)
        block_loop(0.15)
        (age,) = await ages_of(connection, wire)
        assert age <= 0.3


async def test_value_from_before_pause_is_not_fresh(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    cell = vehicle.message(m.Attitude)
    await anyio.sleep(1)
    assert vehicle.attitude.fresh(within=0.5)
    block_loop(3.7)
    await anyio.lowlevel.checkpoint()
    await anyio.lowlevel.checkpoint()
    for state in (vehicle.attitude, cell):
        with pytest.raises(StaleValueError):
            state.fresh(within=0.5)
    assert vehicle.heartbeat_age > 3.5
    await anyio.sleep(1.2)
    assert vehicle.attitude.fresh(within=0.5)
    assert cell.fresh(within=0.5)
    assert vehicle.heartbeat_age < 1.2


async def test_pause_causes_no_silence_reboot_or_distance(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    await anyio.sleep(3)
    round_trip = vehicle.link_quality.value.round_trip_s
    assert round_trip is not None
    assert round_trip < 0.1
    with vehicle.subscribe(VehicleSilent, VehicleRebooted, capacity=5) as events:
        vehicle._session.link_watch.request_time()
        block_loop(10)
        await anyio.sleep(0.3)
        assert vehicle._session.link_watch.round_trip_s == pytest.approx(round_trip, abs=0.05)
        assert vehicle.link_state.value is LinkState.CONNECTED
        await anyio.sleep(5)
        assert events.get_nowait() is None


async def test_closed_watch_reports_nothing() -> None:
    wire = Wire()
    async with open_connection(wire) as connection:
        connection.link_lost(LinkLost("unplugged"))
        block_loop(5)
        await anyio.sleep(1)


OURS = ("link_state", "link_quality", "links")
"""Cells about the reception itself; no message contains their values."""


def every_cell(vehicle: aerokit.Vehicle) -> list[StateCell[Any]]:
    """Return all cells of a vehicle, its parts and its devices, as created by `make_parts`."""
    gc.collect()
    cells = [thing for thing in gc.get_objects() if isinstance(thing, StateCell)]
    return [cell for cell in cells if cell.name not in OURS and cell._close_error is None]


async def test_cells_after_pause_are_as_old_as_their_message(grounded: Flight) -> None:
    """Each message that any cell comes from has waited in the socket while the loop was blocked."""
    vehicle, wire, dice = grounded.vehicle, grounded.wire, random.Random(7)
    component = vehicle.component(154)
    for part in (vehicle.parameters, vehicle.mission.current, vehicle.gimbal, vehicle.camera):
        assert part is not None
    for kind in (m.Heartbeat, m.Attitude, m.Statustext):
        vehicle.message(kind)
        component.message(kind)
    kinds = [message_type(name) for name in MESSAGE_IDS if not name.startswith(("Timesync", "ParamExt"))]
    encoders = [FrameEncoder(vehicle.system_id, component_id) for component_id in (1, 154, 100)]
    known = {kind: [anything(kind, dice) for _ in range(6)] for kind in kinds if kind is not m.Heartbeat}
    known[m.Heartbeat] = [m.Heartbeat(2, 3, 81, 4, 3, 3), m.Heartbeat(26, 8, 0, 0, 4, 3)]
    known[m.Heartbeat] += [m.Heartbeat(30, 8, 0, 0, 4, 3)]
    frames = [encoder.encode(message) for messages in known.values() for message in messages for encoder in encoders]
    before = {cell: cell._arrivals for cell in every_cell(vehicle)}
    block_loop(3.7)
    for frame in frames:
        wire.deliver(frame)
    updated = [cell for cell in every_cell(vehicle) if cell.is_known and cell._arrivals > before.get(cell, 0)]
    assert {cell.name: round(cell.age, 1) for cell in updated if cell.age < 3.5} == {}
    names = {cell.name for cell in updated}
    assert set(vehicle.telemetry.cells) - names <= {"version"}
    assert {"cameras", "components", "mission.current", "gimbal.attitude", "HEARTBEAT"} <= names


async def test_values_are_older_after_the_computer_slept(grounded: Flight, caplog: pytest.LogCaptureFixture) -> None:
    """The loop's clock stood still meanwhile, and a HEARTBEAT had waited."""
    vehicle, asleep = grounded.vehicle, [0.0]
    watch = vehicle.connection._receiver._loop_watch
    watch._suspended = lambda: asleep[0]
    watch._suspended_before = 0.0
    await anyio.sleep(1.0)
    assert vehicle.armed.age < 1.1
    ages: list[float] = []
    with vehicle.connection.subscribe(ComputerSlept) as events:
        asleep[0] = 600.0
        grounded.copter.faults.silent = True
        await anyio.sleep(0.2)
        ages += [vehicle.armed.age, vehicle.position.age, vehicle.heartbeat_age]
        assert events.get_nowait() is not None
    assert min(ages) > 600.0
    assert not vehicle._arbiter.is_state_recent
    assert "the computer slept for 600 s" in caplog.text
    grounded.copter.faults.silent = False
    await anyio.sleep(1.5)
    assert vehicle.armed.age < 1.5


async def test_sink_of_sleep_may_close_the_watch() -> None:
    asleep, pauses = [0.0], list[float]()

    def close(seconds: float) -> None:
        pauses.append(seconds)
        watch.close()

    watch = LoopWatch(pauses.append, close, lambda: asleep[0])
    watch.start()
    asleep[0] = 600.0
    await anyio.sleep(1.0)
    assert pauses == [600.0]
    assert watch._timer is None
    asleep[0] = 1200.0
    await anyio.sleep(1.0)
    assert pauses == [600.0]


async def test_watch_closed_after_catching_up_stays_closed() -> None:
    watch = LoopWatch(lambda _: None, lambda _: None, on_caught_up=lambda _: watch.close())
    watch.start()
    block_loop(1.0)
    await anyio.sleep(1.0)
    assert watch.late_after == math.inf, "data that is read now would start the timer again"
    assert watch._timer is None


def test_suspended_time_comes_from_a_system_clock() -> None:
    before = suspended_s()
    assert suspended_s() - before == pytest.approx(0.0, abs=0.01)


@pytest.mark.anyio
async def test_preemption_between_two_clocks_is_not_sleep() -> None:
    readings, slept = iter([5.0, 4.5, 5.0, 4.5, 5.0, 5.3]), list[float]()
    watch = LoopWatch(lambda _: None, slept.append, lambda: next(readings))
    for _ in range(2):
        watch.arrival_time(watch._loop.time())
    assert slept == []
    watch.arrival_time(watch._loop.time())
    assert slept == [pytest.approx(0.3)]


@pytest.mark.anyio
async def test_sleep_is_noticed_while_waiting_data_is_read() -> None:
    asleep, slept = [0.0], list[float]()
    watch = LoopWatch(lambda _: None, slept.append, lambda: asleep[0])
    began_at = watch._loop.time()
    assert watch.arrival_time(began_at + 5.0) == began_at
    asleep[0] = 600.0
    for later_s in (5.01, 5.06, 5.07):
        assert watch.arrival_time(began_at + later_s) == began_at
    assert slept == [600.0]
