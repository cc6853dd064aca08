"""CONNECTED → SILENT → LOST, of a link and of a vehicle; and a link that is in use already."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import Flight

from aerokit import LinkState, connect, events, open_connection
from aerokit.connection.bus import Bus, Subscription
from aerokit.connection.cells import StateCell
from aerokit.connection.heartbeats import LinkStateTracker
from aerokit.errors import BusyError, ConnectionClosed, LinkLost
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.transport import memory_link_pair

pytestmark = pytest.mark.anyio

CONNECTED, SILENT, LOST = LinkState.CONNECTED, LinkState.SILENT, LinkState.LOST


def transitions(changes: Subscription[events.LinkStateChanged]) -> list[tuple[int, LinkState, LinkState]]:
    found = []
    while (change := changes.get_nowait()) is not None:
        found.append((change.system_id, change.before, change.after))
    return found


async def test_states_from_connected_to_lost_with_events(grounded: Flight) -> None:
    vehicle, connection = grounded.vehicle, grounded.vehicle.connection
    with connection.subscribe(events.LinkStateChanged, capacity=20) as changes:
        assert (vehicle.link_state.value, connection.link_state.value) == (CONNECTED, CONNECTED)
        grounded.copter.faults.silent = True
        await vehicle.link_state.wait_until(lambda state: state is SILENT, timeout=5)
        assert 3.5 < vehicle.heartbeat_age < 4.7
        await connection.link_state.wait_until(lambda state: state is SILENT, timeout=2)
        grounded.copter.faults.silent = False
        await vehicle.link_state.wait_until(lambda state: state is CONNECTED, timeout=2)
        await connection.link_state.wait_until(lambda state: state is CONNECTED, timeout=2)
        connection.link_lost(LinkLost("unplugged"))
        one = vehicle.system_id
        assert sorted(transitions(changes), key=lambda change: change[0]) == [
            (0, CONNECTED, SILENT),
            (0, SILENT, CONNECTED),
            (0, CONNECTED, LOST),
            (one, CONNECTED, SILENT),
            (one, SILENT, CONNECTED),
            (one, CONNECTED, LOST),
        ]


def test_silence_starts_after_three_and_a_half_seconds() -> None:
    bus, now = Bus(), 0.0
    observed: list[events.LinkStateChanged] = []
    bus.attach_event(events.LinkStateChanged, observed.append)
    cell: StateCell[events.LinkState] = StateCell("link_state", lambda: now, "frame")
    tracker, states = LinkStateTracker(cell, bus, system_id=7), []
    for now, frames in ((0.0, 0), (1.0, 0), (9.0, 1), (12.5, 1), (12.6, 1), (99.0, 1), (99.1, 2), (102.6, 2)):
        tracker.update(now, frames)
        states.append(cell.latest)
    assert states == [None, None, CONNECTED, CONNECTED, SILENT, SILENT, CONNECTED, CONNECTED]
    assert observed == [
        events.LinkStateChanged(12.6, 7, CONNECTED, SILENT),
        events.LinkStateChanged(99.1, 7, SILENT, CONNECTED),
    ]


async def test_vehicle_is_silent_after_link_loss(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    vehicle.connection.link_lost(LinkLost("unplugged"))
    assert vehicle.is_silent
    assert (vehicle.link_state.value, vehicle.connection.link_state.value) == (LOST, LOST)
    await anyio.sleep(10)
    assert vehicle.heartbeat_age >= 9.99
    with pytest.raises(LinkLost, match="unplugged"):
        await vehicle.link_state.wait_until(lambda state: state is CONNECTED)


async def test_closed_connection_is_lost_without_event() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, open_connection(link) as connection:
        with connection.subscribe(events.LinkStateChanged, capacity=20) as changes:
            async with connect(connection) as vehicle:
                pass
            assert (vehicle.link_state.value, connection.link_state.value) == (LOST, CONNECTED)
            with pytest.raises(ConnectionClosed):
                await vehicle.link_state.wait_until(lambda state: state is CONNECTED)
        assert transitions(changes) == []


async def test_no_sender_means_silent() -> None:
    near, _ = memory_link_pair()
    async with open_connection(near) as connection:
        assert connection.link_state.value is CONNECTED
        await connection.link_state.wait_until(lambda state: state is SILENT, timeout=5)


async def test_link_in_use_is_not_closed(grounded: Flight) -> None:
    """The second one is refused; the first flies on."""
    vehicle = grounded.vehicle
    with pytest.raises(BusyError, match="a link can be opened only once"):
        async with connect(vehicle.connection.link):
            pytest.fail("it is in use")
    before = vehicle.mode.updated_at
    await anyio.sleep(3)
    assert vehicle.mode.updated_at > before
    await vehicle.set_mode("GUIDED")
