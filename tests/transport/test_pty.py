"""Pseudo-terminals: a serial port without hardware."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest

from aerokit.errors import LinkLost, LinkOpenError
from aerokit.transport import Peer, PtyLink, parse_address

posix_only = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")


class RecordingReceiver:
    """The receiver of a test."""

    def __init__(self) -> None:
        self.data = b""
        self.came = asyncio.Event()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.data += data
        self.came.set()

    def link_lost(self, error: LinkLost) -> None:
        raise error


def test_addresses_of_pseudo_terminals() -> None:
    assert str(parse_address("pty")) == "pty"
    assert parse_address("pty:/tmp/ttyV0").path == "/tmp/ttyV0"
    assert str(parse_address("pty:/tmp/ttyV0")) == "pty:/tmp/ttyV0"


@posix_only
def test_bytes_pass_a_pseudo_terminal_unchanged() -> None:
    async def both_ways() -> None:
        link, recorder = PtyLink(), RecordingReceiver()
        await link.open(recorder)
        other = os.open(link.address.removeprefix("pty:"), os.O_RDWR | os.O_NOCTTY)
        every_byte = bytes(range(256))
        os.write(other, every_byte)
        while len(recorder.data) < 256:
            recorder.came.clear()
            await recorder.came.wait()
        link.write(every_byte)
        assert (recorder.data, os.read(other, 1000)) == (every_byte, every_byte)
        os.close(other)
        link.close()
        await link.wait_closed()

    asyncio.run(both_ways())


@posix_only
def test_unread_data_is_dropped_and_files_are_kept(tmp_path: Path) -> None:
    taken, dead = tmp_path / "taken", tmp_path / "dead"
    taken.write_text("precious")
    dead.symlink_to("/dev/pts/no-such")

    async def run() -> None:
        link = PtyLink(str(taken))
        with pytest.raises(LinkOpenError, match="exists"):
            await link.open(RecordingReceiver())
        link.close()
        link = PtyLink(str(dead))
        await link.open(RecordingReceiver())
        for _ in range(100):
            link.write(bytes(1000))
        assert link.dropped_writes > 10
        link.close()
        link.write(b"late")
        await link.wait_closed()

    asyncio.run(run())
    assert taken.read_text() == "precious"
    assert not os.path.lexists(dead)


@posix_only
def test_closed_pty_is_not_polled() -> None:
    """Another file may reuse the file descriptor."""

    async def close() -> None:
        link = PtyLink()
        await link.open(RecordingReceiver())
        ours = link._our_end
        link.close()
        await link.wait_closed()
        assert not asyncio.get_running_loop().remove_reader(ours)

    asyncio.run(close())
