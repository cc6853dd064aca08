"""Decoded video frames, each with the position and attitude of the vehicle.

Needs PyAV (https://pyav.basswood-io.com): ``pip install "aerokit-mavlink[video]"``.
"""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import check_range
from aerokit._internal.async_block import async_block
from aerokit._internal.values import Snapshot
from aerokit.errors import BusyError, InvalidArgument, LinkLost, LinkOpenError, NotSupported

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from typing_extensions import Self

    from aerokit.position import Position
    from aerokit.vehicle.state.movement import Attitude
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["VideoFrame", "VideoStream", "open_video"]

# FFmpeg options for live streams, which turn buffering off (https://ffmpeg.org/ffmpeg-protocols.html).
LIVE_OPTIONS = {"rtsp_transport": "tcp", "fflags": "nobuffer", "flags": "low_delay", "probesize": "500000"}

# Seconds to wait for the decoding thread at the end of the block. FFmpeg may block the thread for longer than that:
# until its next frame or time-out.
JOIN_TIMEOUT_S = 1.0


class VideoFrame(Snapshot):
    """One video frame.

    - ``picture``: a PyAV frame: ``picture.to_ndarray(format="rgb24")`` (height, width, 3), ``picture.to_image()``
    - ``received_at``: time on the loop's clock at which the frame was decoded (when it was received is unknown)
    - ``stream_s``: time in the stream; None if the frame has none
    - ``position``, ``attitude``: the vehicle's latest values at ``received_at``; None without a vehicle, or if unknown
    """

    picture: Any
    received_at: float
    stream_s: float | None
    position: Position | None
    attitude: Attitude | None


@async_block
async def open_video(
    uri: str,
    vehicle: Vehicle | None = None,
    *,
    timeout: float = 10.0,
    idle_timeout_s: float = 5.0,
    options: Mapping[str, str] | None = None,
) -> AsyncIterator[VideoStream]:
    """Open a video stream for the duration of an ``async with`` block.

    ``async with open_video(stream.uri, vehicle) as video: async for frame in video: …``. A slow reader always gets the
    latest frame, and misses earlier ones. A thread decodes the stream until the block ends. A thread that is waiting
    for a frame at that time ends at the next frame or time-out.

    Args:
        uri: anything that FFmpeg reads: ``rtsp://…``, ``udp://0.0.0.0:5600``, the path of a file.
            ``vehicle.camera.streams`` lists the addresses of a camera's streams.
        vehicle: the vehicle whose position and attitude are added to the frames.
        timeout: seconds until the stream must be open, above 0 and at most 3600.
        idle_timeout_s: seconds without data after which the stream counts as lost, above 0 and at most 3600.
        options: further FFmpeg options.

    Raises:
        NotSupported: PyAV is not installed.
        InvalidArgument: the URI is empty, a time is out of range, or an option is not a string.
        LinkOpenError: the stream cannot be opened, or has no video.
    """
    if not uri:
        raise InvalidArgument("uri = '' is not allowed: it must be the address of a stream or the path of a file")
    check_range("timeout", timeout, 0, 3600, above=True)
    check_range("idle_timeout_s", idle_timeout_s, 0, 3600, above=True)
    stream = VideoStream(uri, vehicle)
    for name, value in (options or {}).items():
        if not isinstance(name, str) or not isinstance(value, str):
            raise InvalidArgument(
                f"options: {name!r} = {value!r} is not allowed: names and values of FFmpeg options must be strings"
            )
    defaults = LIVE_OPTIONS if "://" in uri else {}
    thread = _Reader(uri, {**defaults, **(options or {})}, (timeout, idle_timeout_s), stream)
    try:
        thread.start()
        await stream._wait_until_open()
        yield stream
    finally:
        thread.stop()
        with anyio.move_on_after(JOIN_TIMEOUT_S, shield=True):
            await thread.ended.wait()


class VideoStream:
    """Asynchronous iterator over the frames of a stream, for a single reader. Created by :func:`open_video`.

    The iteration ends at the end of a file. If a stream fails, the iteration raises LinkLost.
    """

    def __init__(self, uri: str, vehicle: Vehicle | None) -> None:
        self.uri: str = uri
        """Address of the stream."""
        self.missed: int = 0
        """Number of frames dropped because the reader was slow."""
        self._vehicle = vehicle  # source of each frame's position and attitude; None if frames have neither
        self._now = asyncio.get_running_loop().time
        self._latest: VideoFrame | None = None  # the frame to read next; None after it was read
        self._is_open = False
        self._end: Exception | None = None  # why the stream has ended; EOFError at the end of a file
        self._changed = asyncio.Event()  # set when one of the attributes above changes
        self._has_reader = False  # True while a reader waits; a second one is refused

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> VideoFrame:
        """Return the latest frame that was not read yet, or wait for the next one."""
        if self._has_reader:
            raise BusyError("another task already reads this video stream; call open_video() again for a second reader")
        self._has_reader = True
        try:
            await self._wait(lambda: self._latest is not None)
        finally:
            self._has_reader = False
        frame, self._latest = self._latest, None
        if frame is None:
            if isinstance(self._end, LinkLost):
                # Raise a new exception for each read, because a shared exception would collect the tracebacks of all
                # reads.
                raise LinkLost(*self._end.args)
            raise StopAsyncIteration
        return frame

    async def _wait_until_open(self) -> None:
        await self._wait(lambda: self._is_open)
        if not self._is_open and self._end is not None:
            raise self._end

    async def _wait(self, condition: Callable[[], bool]) -> None:
        while not condition() and self._end is None:
            self._changed.clear()
            await self._changed.wait()

    # The reader's thread schedules calls of these methods on the event loop.

    def _on_open(self) -> None:
        self._is_open = True
        self._changed.set()

    def _on_frame(self, picture: object, stream_s: float | None) -> None:
        if self._latest is not None:
            self.missed += 1
        vehicle = self._vehicle
        position = None if vehicle is None else vehicle.position.latest
        attitude = None if vehicle is None else vehicle.attitude.latest
        self._latest = VideoFrame(picture, self._now(), stream_s, position, attitude)
        self._changed.set()

    def _on_end(self, error: Exception) -> None:
        self._end = error
        self._changed.set()


class _Reader(threading.Thread):
    """Decodes a stream in a thread, because PyAV blocks. ``timeouts_s`` are FFmpeg's, for opening and for reading."""

    def __init__(self, uri: str, options: dict[str, str], timeouts_s: tuple[float, float], stream: VideoStream) -> None:
        super().__init__(name=f"aerokit video {uri}", daemon=True)
        self.ended = asyncio.Event()  # set when the thread has ended, or was never started
        self._uri, self._options, self._timeouts_s, self._stream = uri, options, timeouts_s, stream
        self._loop = asyncio.get_running_loop()
        self._is_stopped = False  # set by stop() on the loop's thread, read by this thread

    def start(self) -> None:
        try:
            import av
        except ImportError:
            self.ended.set()
            raise NotSupported('video needs PyAV: run pip install "aerokit-mavlink[video]"') from None
        self._av: Any = av
        super().start()

    def stop(self) -> None:
        self._is_stopped = True

    def run(self) -> None:
        # This error is reported if something other than an Exception, such as SystemExit, ends the thread.
        error: Exception = LinkLost(f"the video of {self._uri} ended")
        try:
            self._read()
            error = EOFError()  # The iteration over the frames then ends without an error.
        except (LinkOpenError, LinkLost) as caught:
            error = caught
        except Exception as caught:
            error = LinkLost(f"the decoder of {self._uri} failed: {caught!r}")
        finally:
            self._call_on_loop(self._stream._on_end, error)
            self._call_on_loop(self.ended.set)

    def _read(self) -> None:
        """Pass frames to the event loop until the stream ends or is stopped.

        Raises LinkOpenError if the stream cannot be opened, and LinkLost if it is interrupted later.
        """
        errors = (self._av.error.FFmpegError, OSError, ValueError, IndexError)
        try:
            container = self._av.open(self._uri, options=self._options, timeout=self._timeouts_s)
        except errors as error:
            raise LinkOpenError(f"the video of {self._uri} cannot be opened: {error}") from None
        with container:
            if not container.streams.video:
                raise LinkOpenError(f"the stream {self._uri} contains no video")
            self._call_on_loop(self._stream._on_open)
            try:
                for picture in container.decode(video=0):
                    if self._is_stopped:
                        return
                    time = None if picture.time is None else float(picture.time)
                    self._call_on_loop(self._stream._on_frame, picture, time)
            except errors as error:
                raise LinkLost(f"the video of {self._uri} was interrupted: {error}") from None

    def _call_on_loop(self, function: Callable[..., object], *args: Any) -> None:
        with suppress(RuntimeError):  # The loop may be closed already.
            self._loop.call_soon_threadsafe(function, *args)
