"""Frames of a locally generated video stream, matched with telemetry."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from free_ports import free_port

import aerokit
from aerokit.errors import BusyError, InvalidArgument, LinkLost, LinkOpenError, NotSupported
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.video import open_video

av: Any = pytest.importorskip("av")
pytestmark = pytest.mark.anyio
RATE = 25


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


def encode(target: str, kind: str, count: int, *, pace: Callable[[], object] = lambda: None) -> None:
    """Write a video whose frames grow brighter."""
    with av.open(target, "w", format=kind) as container:
        stream = container.add_stream("mpeg2video" if kind == "mpegts" else "mpeg4", rate=RATE)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = 64, 48, "yuv420p", 5
        for number in range(count):
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 5 * number % 250, np.uint8), "rgb24")
            picture.pts, picture.time_base = number, Fraction(1, RATE)
            for packet in stream.encode(picture):
                container.mux(packet)
            pace()
        for packet in stream.encode():
            container.mux(packet)


@contextmanager
def streamed(port: int) -> Iterator[threading.Event]:
    """Send MPEG-TS by UDP, as a camera does, until the block ends or the event is set."""
    is_over = threading.Event()

    def pace() -> None:
        if is_over.wait(1 / RATE):
            raise InterruptedError

    def send() -> None:
        with suppress(InterruptedError):
            encode(f"udp://127.0.0.1:{port}?pkt_size=1316", "mpegts", 10_000, pace=pace)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield is_over
    finally:
        is_over.set()
        thread.join()


async def test_live_video_frames_have_vehicle_state() -> None:
    port = free_port()
    async with (
        simulated_link(SimulatedCopter(boot_time_s=0.0), speedup=10.0) as link,
        aerokit.connect(link) as vehicle,
    ):
        await vehicle.wait_ready(timeout=100)
        with streamed(port):
            async with open_video(f"udp://127.0.0.1:{port}", vehicle) as video:
                frames = []
                async for frame in video:
                    frames.append(frame)
                    if len(frames) == 5:
                        break
        times = [frame.received_at for frame in frames]
        assert times == sorted(times)
        assert all(frame.position is not None and frame.attitude is not None for frame in frames)
        assert frames[0].picture.to_ndarray(format="rgb24").shape == (48, 64, 3)
        stamps = [frame.stream_s or 0.0 for frame in frames]
        assert all(later > earlier for earlier, later in pairwise(stamps))
    for thread in threading.enumerate():
        if "video" in thread.name:
            thread.join(100)
            assert not thread.is_alive()


async def test_video_file_is_read_to_end(tmp_path: Path) -> None:
    path = tmp_path / "flight.mp4"
    encode(str(path), "mp4", 10)
    async with open_video(str(path)) as video:
        frames = [frame async for frame in video]
    assert 1 <= len(frames) == 10 - video.missed
    assert frames[-1].position is None
    assert math.isclose(frames[-1].stream_s or 0, 9 / RATE)


async def test_slow_video_reader_gets_latest_frame(tmp_path: Path) -> None:
    path = tmp_path / "flight.mp4"
    encode(str(path), "mp4", 40)
    async with open_video(str(path)) as video:
        with anyio.fail_after(100):
            while video.missed < 39:
                await anyio.lowlevel.checkpoint()
        frame = await video.__anext__()
        assert frame.stream_s == pytest.approx(39 / RATE)
        with pytest.raises(StopAsyncIteration):
            await video.__anext__()


async def test_silent_video_stream_is_lost() -> None:
    port = free_port()
    with streamed(port) as is_over:
        async with open_video(f"udp://127.0.0.1:{port}", idle_timeout_s=0.5) as video:
            await video.__anext__()
            is_over.set()
            with pytest.raises(LinkLost, match="was interrupted"), anyio.fail_after(100):
                async for _ in video:
                    pass


async def test_failed_decoder_loses_video_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "video.mp4"
    encode(str(path), "mp4", 5)

    def fail(*_: object) -> object:
        raise RuntimeError("no memory")

    monkeypatch.setattr("aerokit.video._Reader._read", fail)
    with pytest.raises(LinkLost, match=r"the decoder of .* failed: RuntimeError\('no memory'\)"):
        async with open_video(str(path)):
            pass


async def test_missing_video_stream_cannot_be_opened() -> None:
    with pytest.raises(LinkOpenError, match=r"no-such-file\.mp4 cannot be opened"):
        async with open_video("/no-such-file.mp4"):
            pass
    with pytest.raises(LinkOpenError, match="cannot be opened"):
        async with open_video(f"udp://127.0.0.1:{free_port()}", timeout=0.3):
            pass


@pytest.mark.exhaustive
async def test_video_opening_can_be_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.video.JOIN_TIMEOUT_S", 0.1)
    with anyio.move_on_after(0.2) as scope:
        async with open_video(f"udp://127.0.0.1:{free_port()}", timeout=3.0):
            pass
    assert scope.cancelled_caught
    left = [thread for thread in threading.enumerate() if "video" in thread.name]
    assert len(left) == 1  # until the timeout
    left[0].join(100)
    assert not left[0].is_alive()


async def test_video_stream_has_one_reader(tmp_path: Path) -> None:
    port = free_port()
    with streamed(port):
        async with open_video(f"udp://127.0.0.1:{port}") as video, anyio.create_task_group() as tasks:
            tasks.start_soon(video.__anext__)
            await anyio.lowlevel.checkpoint()
            with pytest.raises(BusyError):
                await video.__anext__()


@pytest.mark.parametrize("wrong", [{"uri": ""}, {"uri": "x", "timeout": 0.0}, {"uri": "x", "idle_timeout_s": -1.0}])
async def test_open_video_rejects_invalid_arguments(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidArgument):
        async with open_video(**wrong):
            pass


async def test_open_video_without_pyav_names_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(NotSupported, match=r"aerokit-mavlink\[video\]"):
        async with open_video("x"):
            pass
