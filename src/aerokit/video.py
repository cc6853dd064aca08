"""``open_video``: the pictures of a video stream, each beside what the vehicle told when it came.

Needs PyAV: ``pip install "aerokit-mavlink[video]"``. https://pyav.basswood-io.com
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

LIVE = {"rtsp_transport": "tcp", "fflags": "nobuffer", "flags": "low_delay", "probesize": "500000"}
"""What FFmpeg is told of what is no file: no frame waits for later ones. https://ffmpeg.org/ffmpeg-protocols.html"""

ENDS_WITHIN_S = 1.0
"""How long the end of a block waits for the thread, which FFmpeg holds until the next frame, or its time-out."""


class VideoFrame(Snapshot):
    """One picture of a stream.

    - ``picture``: PyAV's frame: ``picture.to_ndarray(format="rgb24")`` (height, width, 3), ``picture.to_image()``
    - ``received_at``: when it was decoded, on the loop's clock; ``stream_s``: the stream's own time, None: not told
    - ``position``, ``attitude``: what the vehicle had told by then; None without a vehicle, or before it told
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
    silence_s: float = 5.0,
    options: Mapping[str, str] | None = None,
) -> AsyncIterator[VideoStream]:
    """Read a video stream for the time of an ``async with`` block; the latest frame wins.

    ``async with open_video(stream.uri, vehicle) as video: async for frame in video: …``. Decoding takes a thread of its
    own. It ends with the block; where nothing comes from the stream just then, at its time-out, by itself.

    Args:
        uri: what FFmpeg reads: ``rtsp://…``, ``udp://0.0.0.0:5600``, a file's path …; ``vehicle.camera.streams`` has
            those of a camera.
        vehicle: whose position and attitude stand beside the frames.
        timeout: seconds until the stream must be open, above 0 to 3600.
        silence_s: a stream that brings nothing for so long is lost, above 0 to 3600.
        options: more for FFmpeg, in its words.

    Raises:
        NotSupported: PyAV is not installed.
        InvalidArgument: the URI is empty, a time is out of range, or an option is no text.
        LinkOpenError: the stream cannot be opened, or has no video.
    """
    if not uri:
        raise InvalidArgument("uri = '' is not allowed: the address of a stream, or the path of a file")
    check_range("timeout", timeout, 0, 3600, above=True)
    check_range("silence_s", silence_s, 0, 3600, above=True)
    stream = VideoStream(uri, vehicle)
    for name, value in (options or {}).items():
        if not isinstance(name, str) or not isinstance(value, str):
            raise InvalidArgument(f"options: {name!r} = {value!r} is not allowed: texts")
    own = LIVE if "://" in uri else {}
    thread = _Reader(uri, {**own, **(options or {})}, (timeout, silence_s), stream)
    try:
        thread.start()
        await stream._opened()
        yield stream
    finally:
        thread.stop()
        with anyio.move_on_after(ENDS_WITHIN_S, shield=True):
            await thread.ended.wait()


class VideoStream:
    """Frames as they come, for one reader; made by :func:`open_video`.

    The iteration ends with the stream (a file's), and raises LinkLost when a stream breaks off.
    """

    def __init__(self, uri: str, vehicle: Vehicle | None) -> None:
        self.uri: str = uri
        """Where it comes from."""
        self.missed: int = 0
        """How many frames were dropped because the reader was slow: it always gets the latest."""
        self._vehicle = vehicle
        self._now = asyncio.get_running_loop().time
        self._latest: VideoFrame | None = None
        self._is_open = False
        self._end: Exception | None = None
        self._news = asyncio.Event()
        self._is_read = False

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> VideoFrame:
        if self._is_read:
            raise BusyError("a video stream has one reader; open it twice for a second one")
        self._is_read = True
        try:
            await self._wait(lambda: self._latest is not None)
        finally:
            self._is_read = False
        frame, self._latest = self._latest, None
        if frame is None:
            if isinstance(self._end, LinkLost):
                raise LinkLost(*self._end.args)
            raise StopAsyncIteration
        return frame

    async def _opened(self) -> None:
        await self._wait(lambda: self._is_open)
        if not self._is_open and self._end is not None:
            raise self._end

    async def _wait(self, is_there: Callable[[], bool]) -> None:
        while not is_there() and self._end is None:
            self._news.clear()
            await self._news.wait()

    # The reader's thread has the loop call these.

    def open(self) -> None:
        """The first bytes were understood."""
        self._is_open = True
        self._news.set()

    def take(self, picture: object, stream_s: float | None) -> None:
        """A frame was decoded."""
        if self._latest is not None:
            self.missed += 1
        vehicle = self._vehicle
        position = None if vehicle is None else vehicle.position.latest
        attitude = None if vehicle is None else vehicle.attitude.latest
        self._latest = VideoFrame(picture, self._now(), stream_s, position, attitude)
        self._news.set()

    def end(self, error: Exception) -> None:
        """Nothing more will come."""
        self._end = error
        self._news.set()


class _Reader(threading.Thread):
    def __init__(
        self, uri: str, options: dict[str, str], limits_s: tuple[float, float], stream: VideoStream
    ) -> None:
        super().__init__(name=f"aerokit video {uri}", daemon=True)
        self.ended = asyncio.Event()
        self._uri, self._options, self._limits_s, self._stream = uri, options, limits_s, stream
        self._loop = asyncio.get_running_loop()
        self._is_stopped = False

    def start(self) -> None:
        """NotSupported: PyAV is missing."""
        try:
            import av
        except ImportError:
            self.ended.set()
            raise NotSupported('video needs PyAV: pip install "aerokit-mavlink[video]"') from None
        self._av: Any = av
        super().start()

    def stop(self) -> None:
        self._is_stopped = True

    def run(self) -> None:
        error: Exception = LinkLost(f"the video of {self._uri} has ended")
        try:
            self._read()
            error = EOFError()
        except Exception as caught:
            error = caught
        finally:
            self._tell(self._stream.end, error)
            self._tell(self.ended.set)

    def _read(self) -> None:
        errors = (self._av.error.FFmpegError, OSError, ValueError, IndexError)
        try:
            container = self._av.open(self._uri, options=self._options, timeout=self._limits_s)
        except errors as error:
            raise LinkOpenError(f"the video of {self._uri} cannot be opened: {error}") from None
        with container:
            if not container.streams.video:
                raise LinkOpenError(f"{self._uri} has no video")
            self._tell(self._stream.open)
            try:
                for picture in container.decode(video=0):
                    if self._is_stopped:
                        return
                    time = None if picture.time is None else float(picture.time)
                    self._tell(self._stream.take, picture, time)
            except errors as error:
                raise LinkLost(f"the video of {self._uri} broke off: {error}") from None

    def _tell(self, function: Callable[..., object], *args: Any) -> None:
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(function, *args)
