"""Frames of one read are delivered together, and yet one after the other: sinks may change anything in between."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from aerokit import Signing, SigningKey, open_connection
from aerokit.connection.bus import Detach
from aerokit.connection.connection import Connection
from aerokit.events import VehicleFound
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, Heartbeat, SystemTime
from aerokit.mavlink.tlog import read_tlog
from aerokit.transport import memory_link_pair

pytestmark = pytest.mark.anyio

COPTER = Heartbeat(2, 3, 81, 0, 3)


def attitude(number: int) -> Attitude:
    return Attitude(number, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def joined(*messages: Message, system_id: int = 1) -> bytes:
    encoder = FrameEncoder(system_id, 1)
    return b"".join(encoder.encode(message) for message in messages)


@pytest.fixture
async def connection() -> AsyncIterator[Connection]:
    async with open_connection(memory_link_pair()[0]) as connection:
        yield connection


@pytest.fixture
def received(connection: Connection) -> list[int]:
    """Numbers of the ATTITUDE messages that the first of all sinks got."""
    numbers: list[int] = []
    connection.attach([Attitude], lambda message: numbers.append(message.time_boot_ms))
    return numbers


def at_second(connection: Connection, action: Callable[[], object]) -> None:
    """Call ``action()`` while the second ATTITUDE is delivered, between the other sinks."""
    count = 0

    def sink(_: Attitude) -> None:
        nonlocal count
        count += 1
        if count == 2:
            action()

    connection.attach([Attitude], sink)


FOUR = joined(*map(attitude, range(4)))


async def test_sinks_are_called_frame_by_frame_in_order(connection: Connection) -> None:
    calls: list[str] = []
    connection.attach([Attitude], lambda message: calls.append(f"a{message.time_boot_ms}"))
    connection.attach([Attitude], lambda message: calls.append(f"b{message.time_boot_ms}"))
    connection.attach([SystemTime], lambda _: calls.append("time"))
    connection.bytes_received(joined(attitude(1), SystemTime(0, 0), attitude(2)), None)
    assert calls == ["a1", "b1", "time", "a2", "b2"]


async def test_heartbeat_is_recorded_before_its_delivery(connection: Connection) -> None:
    known: list[tuple[str, bool]] = []
    connection.attach([Attitude, Heartbeat], lambda x: known.append((x.NAME, (1, 1) in connection.heartbeats)))
    connection.attach([VehicleFound], lambda _: known.append(("found", True)))
    connection.bytes_received(joined(attitude(1), COPTER, attitude(2)), None)
    assert known == [("ATTITUDE", False), ("found", True), ("HEARTBEAT", True), ("ATTITUDE", True)]


async def test_closing_sink_ends_delivery_after_its_frame(connection: Connection, received: list[int]) -> None:
    later: list[int] = []
    at_second(connection, connection.close)
    connection.attach([Attitude], lambda message: later.append(message.time_boot_ms))
    connection.bytes_received(FOUR, None)
    assert received == later == [0, 1]


async def test_sink_attached_amid_frames_gets_the_next(connection: Connection, received: list[int]) -> None:
    late: list[int] = []
    at_second(connection, lambda: connection.attach([Attitude], lambda message: late.append(message.time_boot_ms)))
    connection.bytes_received(FOUR, None)
    assert (received, late) == ([0, 1, 2, 3], [2, 3])


async def test_sink_detached_amid_frames_gets_no_more(connection: Connection, received: list[int]) -> None:
    detached: list[int] = []
    ends: list[Detach] = []
    at_second(connection, lambda: ends[0]())
    ends += connection.attach([Attitude], lambda message: detached.append(message.time_boot_ms))
    connection.bytes_received(FOUR, None)
    assert (received, detached) == ([0, 1, 2, 3], [0, 1])


async def test_last_sink_detached_amid_frames_leaves_rest_undelivered(connection: Connection) -> None:
    numbers: list[int] = []
    ends: list[Detach] = []

    def once(message: Attitude) -> None:
        numbers.append(message.time_boot_ms)
        ends[0]()

    ends += connection.attach([Attitude], once)
    connection.bytes_received(FOUR, None)
    assert numbers == [0]


async def test_raising_sink_is_logged_and_frames_continue(
    connection: Connection, received: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    later: list[int] = []
    at_second(connection, lambda: 1 / 0)
    connection.attach([Attitude], lambda message: later.append(message.time_boot_ms))
    with caplog.at_level(logging.CRITICAL, "aerokit"):
        connection.bytes_received(FOUR, None)
    assert received == later == [0, 1, 2, 3]
    assert connection.is_open


async def test_observer_added_amid_frames_gets_the_rest(connection: Connection, received: list[int]) -> None:
    observed: list[int] = []
    at_second(connection, lambda: connection.observe_frames(lambda frame, _: observed.append(frame.sequence)))
    connection.bytes_received(FOUR, None)
    assert (received, observed) == ([0, 1, 2, 3], [1, 2, 3])


async def test_recording_started_amid_frames_has_the_rest(
    connection: Connection, received: list[int], tmp_path: Path
) -> None:
    path = tmp_path / "flight.tlog"
    at_second(connection, lambda: connection.record(path))
    connection.bytes_received(FOUR, None)
    connection.close()
    frames = [Frame.parse(raw) for _, raw in read_tlog(path)]
    assert received == [0, 1, 2, 3]
    assert [frame.sequence for frame in frames if frame.system_id == 1] == [2, 3]


async def test_key_set_amid_frames_refuses_the_rest(connection: Connection, received: list[int]) -> None:
    at_second(connection, lambda: setattr(connection, "signing", Signing(SigningKey.from_passphrase("mine"))))
    connection.bytes_received(FOUR, None)
    assert received == [0, 1]
    connection.signing = None
    connection.bytes_received(joined(attitude(9)), None)
    assert received == [0, 1, 9]


async def test_route_taken_amid_frames_drops_the_rest(connection: Connection, received: list[int]) -> None:
    """A sink feeds the HEARTBEAT of the same component from a second peer."""
    at_second(connection, lambda: connection.bytes_received(joined(COPTER), "second"))
    connection.bytes_received(FOUR, "first")
    assert received == [0, 1]


async def test_subscription_gets_all_frames_of_one_read(connection: Connection) -> None:
    with connection.subscribe(Attitude, capacity=3) as attitudes:
        connection.bytes_received(FOUR, None)
        assert [(await attitudes.get(timeout=1)).time_boot_ms for _ in range(3)] == [1, 2, 3]
        assert attitudes.missed == 1
