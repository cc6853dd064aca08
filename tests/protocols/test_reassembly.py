"""Reassembly of a file from blocks in any order."""

from __future__ import annotations

from aerokit.protocols.blocks import Reassembly


def blocks(start: int = 0, **options: int) -> tuple[Reassembly, bytearray]:
    written = bytearray()
    return Reassembly(written.extend, block_size=4, start=start, **options), written


def test_reassembly_orders_blocks() -> None:
    into, written = blocks()
    assert into.add(4, b"efgh")
    assert (into.missing(12), bytes(written)) == (((0, 4), (8, 4)), b"")
    assert not into.add(4, b"efgh")
    assert into.add(0, b"abcd")
    assert (bytes(written), into.position, into.received_bytes) == (b"abcdefgh", 8, 8)
    assert into.missing() == ((8, 0),)


def test_reassembly_ends_at_short_block() -> None:
    into, written = blocks()
    into.add(12, b"mnop")
    into.add(8, b"ijkl")
    assert into.received_bytes == 8
    into.add(4, b"ef")
    assert (into.end, into.received_bytes, into.missing()) == (6, 2, ((0, 4),))
    assert not into.add(8, b"ijkl")
    assert not into.add(6, b"")
    into.add(0, b"abcd")
    assert (bytes(written), into.missing()) == (b"abcdef", ())


def test_reassembly_first_end_counts() -> None:
    into, _ = blocks()
    into.end_at(10)
    assert into.missing() == ((0, 10),)
    into.end_at(12)
    assert into.end == 10
    into.end_at(4)
    assert (into.end, into.missing()) == (4, ((0, 4),))


def test_reassembly_resumes() -> None:
    into, written = blocks(start=4)
    assert not into.add(0, b"abcd")
    into.add(4, b"efgh")
    into.end_at(8)
    assert (bytes(written), into.missing(), into.received_bytes) == (b"efgh", (), 8)
