"""A reconnecting link: times of attempts, callbacks, and release of resources."""

from __future__ import annotations

import asyncio
import errno
import logging
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import anyio
import pytest
from leak_check import CountingLoop, run_and_do
from link_harness import Recorder

from aerokit.errors import (
    BusyError,
    ConnectionClosed,
    InvalidArgument,
    LinkLost,
    LinkOpenError,
    RecordingEnded,
)
from aerokit.transport import Peer, ReconnectingLink, Replay, create_link
from aerokit.transport.link import BaseLink
from aerokit.transport.reconnecting import STABLE_AFTER_S

pytestmark = pytest.mark.anyio


class Plug(BaseLink):
    """One link to a device that may be unplugged."""

    def __init__(self, device: Device) -> None:
        super().__init__("device")
        self.device = device

    async def _connect(self) -> None:
        self.device.tried_at.append(asyncio.get_running_loop().time())
        self._released.clear()
        await anyio.sleep(self.device.opening_takes_s)
        if not self.device.is_present:
            raise OSError(errno.ENODEV, "no such device")
        self.device.plugs.append(self)
        if self.device.greeting:
            self._deliver(self.device.greeting)

    def _release(self) -> None:
        if not self._released.is_set():
            asyncio.get_running_loop().call_later(self.device.releasing_takes_s, self._released.set)

    def write(self, data: bytes, peer: Peer = None) -> None:
        if data == b"too much":
            self.dropped_writes += 1
        else:
            self.device.written.append(data)

    def receive(self, data: bytes) -> None:
        self._deliver(data)

    def pull(self) -> None:
        self._lose("unplugged")


class Device:
    """The other end of the cable."""

    def __init__(self) -> None:
        self.is_present = True
        self.opening_takes_s = self.releasing_takes_s = 0.0
        self.greeting = b""
        self.plugs: list[Plug] = []
        self.written: list[bytes] = []
        self.tried_at: list[float] = []

    def plug(self) -> Plug:
        return Plug(self)

    def unplug(self, *, gone: bool = True) -> None:
        self.is_present = not gone
        self.plugs[-1].pull()


class InterruptionRecorder(Recorder):
    """A receiver with interruption callbacks."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[str] = []

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.events.append(data.decode())
        super().bytes_received(data, peer)

    def link_interrupted(self, error: LinkLost) -> None:
        self.events.append(f"away: {error}")

    def link_restored(self, away_s: float) -> None:
        self.events.append(f"back after {away_s:.1f} s")

    def link_lost(self, error: LinkLost) -> None:
        self.events.append(f"lost: {error}")
        super().link_lost(error)


def lines(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    return [(record.levelname, record.getMessage()) for record in caplog.records if record.name == "aerokit"]


# ------------------------------------------------------------------------------------------ first opening


async def test_first_opening_behaves_as_the_link() -> None:
    device, recorder = Device(), InterruptionRecorder()
    device.is_present = False
    link = ReconnectingLink(device.plug)
    assert link.address == "device"
    for _ in range(2):
        with pytest.raises(LinkOpenError, match="cannot open device: no such device"):
            await link.open(recorder)
    link.write(b"before")
    await anyio.sleep(60)
    assert len(device.tried_at) == 2
    device.is_present = True
    await link.open(recorder)
    link.write(b"after")
    device.plugs[0].receive(b"hello")
    with pytest.raises(BusyError):
        await link.open(recorder)
    link.close()
    link.close()
    await link.wait_closed()
    with pytest.raises(ConnectionClosed):
        await link.open(recorder)
    assert (recorder.events, device.written, link.dropped_writes) == (["hello"], [b"after"], 0)


async def test_wrong_address_is_refused_before_opening() -> None:
    with pytest.raises(InvalidArgument):
        ReconnectingLink(lambda: create_link("nonsense"))


# -------------------------------------------------------------------------------------- losing it


async def test_retry_delays_grow_until_restored(caplog: pytest.LogCaptureFixture) -> None:
    device, recorder = Device(), InterruptionRecorder()
    link = ReconnectingLink(device.plug)
    await link.open(recorder)
    device.tried_at[:] = [asyncio.get_running_loop().time()]
    with caplog.at_level(logging.INFO, "aerokit"):
        device.unplug()
        link.write(b"into the void")
        await anyio.sleep(25.9)
        assert [later - sooner for sooner, later in pairwise(device.tried_at)] == pytest.approx(
            [0.2, 0.4, 0.8, 1.6, 3.2, 5, 5, 5]
        )
        device.is_present = True
        await anyio.sleep(0.5)
        assert len(device.plugs) == 2
        link.write(b"is anybody there?")
        assert link.is_away
        device.plugs[1].receive(b"yes")
        device.unplug()
        await anyio.sleep(0.3)
        assert device.tried_at[-1] - device.tried_at[-2] == pytest.approx(0.5, abs=0.11)
    assert recorder.events == ["away: device: unplugged", "back after 26.4 s", "yes", "away: device: unplugged"]
    assert device.written == [b"is anybody there?"]
    assert link.dropped_writes == 1
    lost, back = (
        ("WARNING", "device: unplugged; reopening it"),
        ("INFO", "device is back after 26.4 s"),
    )
    assert lines(caplog) == [lost, back, lost]
    link.close()
    await link.wait_closed()


async def test_dropped_writes_of_all_links_are_added() -> None:
    device = Device()
    link = ReconnectingLink(device.plug)
    await link.open(Recorder())
    for _ in range(2):
        link.write(b"too much")
        device.unplug(gone=False)
        link.write(b"into the void")
        assert link.unsent_bytes == 0
        await anyio.sleep(5)
    assert link.dropped_writes == 4
    link.close()
    link.write(b"after the end")
    assert link.dropped_writes == 4
    await link.wait_closed()


async def test_silent_open_link_is_restored_after_a_while() -> None:
    device, recorder = Device(), InterruptionRecorder()
    link = ReconnectingLink(device.plug)
    await link.open(recorder)
    device.unplug(gone=False)
    await anyio.sleep(0.2 + STABLE_AFTER_S - 0.01)
    assert link.is_away
    await anyio.sleep(0.02)
    assert recorder.events[1:] == ["back after 1.2 s"]
    link.close()
    await link.wait_closed()


async def test_server_that_closes_connections_stays_lost(
    caplog: pytest.LogCaptureFixture,
) -> None:
    device, recorder = Device(), InterruptionRecorder()
    link = ReconnectingLink(device.plug)
    await link.open(recorder)
    with caplog.at_level(logging.INFO, "aerokit"):
        device.unplug(gone=False)
        for _ in range(200):
            await anyio.sleep(0.1)
            if len(device.plugs) > 1 and link._is_up:
                device.unplug(gone=False)
    assert recorder.events == ["away: device: unplugged"]
    assert len(lines(caplog)) == 1
    assert len(device.plugs) < 12
    link.close()
    await link.wait_closed()


async def test_data_and_loss_before_open_returns() -> None:
    device, recorder = Device(), InterruptionRecorder()
    device.greeting = b"hello"
    link = ReconnectingLink(device.plug)
    recorder.at_each_piece = lambda data, peer: device.plugs[-1].pull() if len(device.plugs) in (1, 2) else None
    await link.open(recorder)
    await anyio.sleep(2)
    assert recorder.events == [
        "hello",
        "away: device: unplugged",
        "back after 0.2 s",
        "hello",
        "away: device: unplugged",
        "back after 0.2 s",
        "hello",
    ]
    assert len(device.tried_at) == 3  # by one opening task, which was still running at the second loss
    link.close()
    await link.wait_closed()


async def test_link_closed_in_interruption_callback_stays_closed() -> None:
    class ClosingRecorder(InterruptionRecorder):
        def link_interrupted(self, error: LinkLost) -> None:
            super().link_interrupted(error)
            link.close()

    device, recorder = Device(), ClosingRecorder()
    link = ReconnectingLink(device.plug)
    await link.open(recorder)
    device.unplug(gone=False)
    await link.wait_closed()
    await anyio.sleep(60)
    assert len(device.tried_at) == 1
    assert recorder.events == ["away: device: unplugged"]


async def test_lost_link_is_released_before_the_next_opens() -> None:
    """A serial port is exclusive, even against the previous link of the same program."""
    device = Device()
    device.releasing_takes_s = 0.7
    link = ReconnectingLink(device.plug)
    await link.open(Recorder())
    device.unplug(gone=False)
    lost = device.plugs[0]
    await anyio.sleep(0.69)
    assert not lost._released.is_set()
    assert len(device.tried_at) == 1
    await anyio.sleep(0.5)
    assert len(device.tried_at) == 2
    link.close()
    await link.wait_closed()


async def test_receiver_without_interruption_callbacks() -> None:
    device, recorder = Device(), Recorder()
    link = ReconnectingLink(device.plug, min_delay_s=1, max_delay_s=1)
    await link.open(recorder)
    device.unplug(gone=False)
    await anyio.sleep(1.1)
    device.plugs[1].receive(b"again")
    assert (recorder.data, recorder.losses) == (b"again", [])
    link.close()
    await link.wait_closed()


async def test_peers_are_of_the_current_link() -> None:
    device = Device()
    link = ReconnectingLink(device.plug)
    assert not link.has_peer(None)
    await link.open(Recorder())
    assert link.has_peer(None)
    device.unplug()
    assert not link.has_peer(None)
    link.close()
    await link.wait_closed()


# ---------------------------------------------------------------------------------- permanent errors


async def test_end_of_recording_ends_the_link(tmp_path: Path) -> None:
    path = tmp_path / "empty.tlog"
    path.write_bytes(b"")
    recorder = InterruptionRecorder()
    link = ReconnectingLink(lambda: Replay(path))
    await link.open(recorder)
    error = await recorder.until_lost()
    assert isinstance(error, RecordingEnded)
    await anyio.sleep(60)
    assert len(recorder.events) == 1
    with pytest.raises(BusyError):
        await link.open(recorder)
    await link.wait_closed()


async def test_failing_factory_ends_the_link() -> None:
    device, recorder = Device(), InterruptionRecorder()
    links: list[Callable[[], Plug]] = [device.plug]
    link = ReconnectingLink(lambda: links.pop()())
    await link.open(recorder)
    device.unplug()
    error = await recorder.until_lost()
    assert str(error) == "device cannot be reopened: pop from empty list"
    assert isinstance(error.__cause__, IndexError)
    link.close()
    await link.wait_closed()


# ----------------------------------------------------------------------------------------- leaks


async def lose_it_twice(recorder: InterruptionRecorder) -> None:
    """Opens a link to a device that is unplugged, away for a while, back, and unplugged again."""
    device = Device()
    device.opening_takes_s = device.releasing_takes_s = 0.05
    link = ReconnectingLink(device.plug)
    try:
        await link.open(recorder)
        device.unplug()
        await anyio.sleep(0.5)
        device.is_present = True
        await anyio.sleep(2)
        device.plugs[1].receive(b"again")
        device.unplug()
        await anyio.sleep(1)
    finally:
        events = list(recorder.events)
        link.close()
        with anyio.CancelScope(shield=True):
            await link.wait_closed()
        assert recorder.events == events
        assert not device.plugs or not device.plugs[-1]._receiver


def test_cancelled_reconnect_leaves_nothing_behind() -> None:
    for turns in range(60):
        run_and_do(lambda: lose_it_twice(InterruptionRecorder()), turns, lambda task: task.cancel())


def test_closed_reconnect_leaves_nothing_behind() -> None:
    made: list[ReconnectingLink] = []

    async def program() -> None:
        device = Device()
        device.opening_takes_s = device.releasing_takes_s = 0.05
        made.append(ReconnectingLink(device.plug))
        link, recorder = made[-1], InterruptionRecorder()
        try:
            await link.open(recorder)
            device.unplug()
            await anyio.sleep(0.5)
            device.is_present = True
            await anyio.sleep(2)
        except (ConnectionClosed, LinkOpenError):
            pass
        finally:
            link.close()
            await link.wait_closed()

    for turns in range(60):
        run_and_do(program, turns, lambda _: made[-1].close() if made else None)


def test_closed_after_its_loop() -> None:
    device = Device()

    async def open_and_lose() -> ReconnectingLink:
        link = ReconnectingLink(device.plug)
        await link.open(Recorder())
        device.unplug()
        return link

    loop = CountingLoop()
    link = loop.run_until_complete(open_and_lose())
    for task in asyncio.all_tasks(loop):
        task.cancel()
    loop.run_until_complete(asyncio.sleep(0))
    loop.close()
    link.close()


async def test_reopen_on_request() -> None:
    device, recorder = Device(), InterruptionRecorder()
    link = ReconnectingLink(device.plug)
    link.reopen()  # it is not open yet
    await link.open(recorder)
    link.reopen()
    link.reopen()
    assert link.is_away
    await anyio.sleep(0.3)
    device.plugs[0].receive(b"too late")
    device.plugs[1].receive(b"hello")
    link.close()
    await link.wait_closed()
    assert len(device.plugs) == 2
    assert recorder.events == [
        "away: device was closed to be reopened",
        "back after 0.3 s",
        "hello",
    ]
