from __future__ import annotations

import asyncio

import pytest
from link_harness import Recorder, each_loop, each_traffic

from aerokit.errors import BusyError, ConnectionClosed
from aerokit.testing import run_virtual
from aerokit.transport import memory_link_pair


@each_loop
@each_traffic
async def test_memory_writes_arrive_unsplit_in_order(pieces: list[bytes]) -> None:
    near, far = memory_link_pair()
    left, right = Recorder(), Recorder()
    await near.open(left)
    await far.open(right)
    for piece in pieces:
        near.write(piece)
        far.write(piece, peer=None)
    assert right.pieces == []  # never from inside write
    await right.until_data(b"".join(pieces))
    assert right.pieces == [(piece, None) for piece in pieces]
    assert left.pieces == right.pieces
    near.close()
    far.close()


@each_loop
async def test_other_end_is_lost_after_receiving_everything() -> None:
    near, far = memory_link_pair()
    left, right = Recorder(), Recorder()
    await near.open(left)
    await far.open(right)
    near.write(b"last words")
    near.close()
    assert "the other end was closed" in str(await right.until_lost())
    assert right.data == b"last words"
    far.write(b"into the void")
    far.close()
    await near.wait_closed()
    await far.wait_closed()
    assert (left.pieces, left.losses, len(right.losses)) == ([], [], 1)


@each_loop
async def test_closing_an_unopened_end_affects_no_other() -> None:
    near, far = memory_link_pair()
    right = Recorder()
    await far.open(right)
    near.close()
    await near.wait_closed()
    for _ in range(5):
        await asyncio.sleep(0)
    assert right.losses == []
    far.close()


@each_loop
async def test_closed_memory_link_delivers_nothing() -> None:
    near, far = memory_link_pair()
    left, right = Recorder(), Recorder()
    await near.open(left)
    await far.open(right)
    right.at_each_piece = lambda data, peer: far.close()
    near.write(b"first")
    near.write(b"second")
    await left.until_lost()
    assert right.data == b"first"
    assert right.losses == []
    near.close()


@each_loop
async def test_writes_to_unopened_end_are_dropped_and_counted() -> None:
    near, far = memory_link_pair()
    near.write(b"not even open")
    await near.open(Recorder())
    near.write(b"nobody there")
    assert near.dropped_writes == 1
    near.close()
    far.close()
    far.close()


@each_loop
async def test_memory_link_is_opened_once() -> None:
    near, far = memory_link_pair()
    await near.open(Recorder())
    with pytest.raises(BusyError, match="is open"):
        await near.open(Recorder())
    near.close()
    with pytest.raises(ConnectionClosed, match="was closed"):
        await near.open(Recorder())
    far.close()


def test_reply_inside_callback_comes_in_later_iteration() -> None:
    async def main() -> None:
        near, far = memory_link_pair()
        left, right = Recorder(), Recorder()
        await near.open(left)
        await far.open(right)
        right.at_each_piece = lambda data, peer: far.write(data + b"!")
        near.write(b"ping")
        await left.until_data(b"ping!")
        near.close()
        far.close()

    run_virtual(main())


def test_latency_delays_both_directions_in_order() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        near, far = memory_link_pair(latency_s=0.25)
        left, right = Recorder(), Recorder()
        times: list[float] = []
        right.at_each_piece = lambda data, peer: times.append(loop.time())
        await near.open(left)
        await far.open(right)
        for piece in (b"a", b"b", b"c"):
            near.write(piece)
        await asyncio.sleep(0.1)
        near.write(b"d")
        await right.until_data(b"abcd")
        assert times == pytest.approx([0.25, 0.25, 0.25, 0.35])
        near.close()
        far.close()

    run_virtual(main())


def test_unopened_pair_can_be_closed_without_loop() -> None:
    near, far = memory_link_pair()
    near.write(b"")
    near.close()
    far.close()
