"""Video: recording it, and the streams of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraSource, MavCmd
from aerokit.vehicle.camera.part import CameraBlock, CameraPart
from aerokit.vehicle.camera.values import (
    CameraStatus,
    ThermalRange,
    VideoStream,
    status_of,
    stream_of,
    thermal_range_of,
    with_status,
)

if TYPE_CHECKING:
    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.camera.link import CameraLine
    from aerokit.vehicle.commanding.order import Order

START, STOP = MavCmd.VIDEO_START_CAPTURE, MavCmd.VIDEO_STOP_CAPTURE
START_S = 5.0
STATUS_S, STREAMS_S, THERMAL_S = 2.0, 5.0, 1.0
SourceName = Literal["default", "rgb", "ir", "ndvi"]
SOURCES = {each.name.lower(): int(each) for each in CameraSource}


@checks_arguments
class VideoCalls(CameraPart):
    """Recording, streaming, and what the camera says it does."""

    def __init__(self, line: CameraLine) -> None:
        super().__init__(line)
        self.status: StateCell[CameraStatus] = line.asked_cell(
            "camera.status", m.CameraCaptureStatus, STATUS_S
        )
        """What it does: recording and for how long, pictures taken, storage left (CAMERA_CAPTURE_STATUS). It is asked
        every 2 s while somebody looks at this cell, as far as it does not tell by itself."""
        self.streams: StateCell[tuple[VideoStream, ...]] = line.asked_cell(
            "camera.streams", m.VideoStreamInformation, STREAMS_S
        )
        """Its video streams by their numbers; asked for every 5 s while somebody looks at this cell."""
        self.thermal_range: StateCell[ThermalRange] = line.asked_cell(
            "camera.thermal_range", m.CameraThermalRange, THERMAL_S
        )
        """The coldest and hottest point of the last thermal picture; asked for once a second while somebody looks."""
        self._streams: dict[int, VideoStream] = {}
        line.listen(m.CameraCaptureStatus, self._on_status)
        line.listen(m.VideoStreamInformation, self._on_stream)
        line.listen(m.VideoStreamStatus, self._on_stream_status)
        line.listen(
            m.CameraThermalRange, lambda each: line.tell(self.thermal_range, thermal_range_of(each), each)
        )

    async def start_video(self, *, status_hz: float = 1.0, timeout: float = 5.0) -> None:
        """Begin to record (MAV_CMD_VIDEO_START_CAPTURE); returns when the camera says that it records.

        A camera that does not tell what it does (such as those behind an autopilot) is believed when it accepts.

        Args:
            status_hz: how often it tells its status meanwhile, 0 to 10.
            timeout: seconds until it must be recording.

        Raises:
            InvalidArgument: ``status_hz`` is out of range. Nothing was sent.
            NotSupported: the camera records no video. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or in the wrong mode.
            CommandTimeout: it did not answer; it may be recording.
            OperationTimeout: it accepted and does not record, or no camera was heard.
        """
        check_range("status_hz", status_hz, 0, 10)
        await self._line.able("start_video", "capture_video")
        with self._line.giving("video") as given:
            await self._start(given, status_hz, timeout)

    async def _start(self, given: Order, status_hz: float, timeout: float) -> None:
        order = (START, self._line.video_stream, status_hz, self._line.device)
        await self._line.order_once(
            given, lambda: self._line.order(*order, given=given, attempts=1), self._is_recording
        )
        await self._until_recording(True, timeout)

    async def stop_video(self, *, timeout: float = 5.0) -> None:
        """End the recording (MAV_CMD_VIDEO_STOP_CAPTURE); returns when the camera says that it has.

        Raises:
            NotSupported: the camera records no video. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer.
            OperationTimeout: it accepted and goes on recording, or no camera was heard.
        """
        await self._line.able("stop_video", "capture_video")
        command, *params = self._stop_order()
        with self._line.giving("video") as given:
            await self._line.order(int(command), *params, given=given)
            await self._until_recording(False, timeout)

    def video(self, *, status_hz: float = 1.0) -> CameraBlock:
        """Record for the time of an ``async with`` block; it ends with it, also under cancellation.

        Entering raises what :meth:`start_video` does.

        Raises:
            InvalidArgument: ``status_hz`` is not 0 to 10. Nothing was sent.
        """
        check_range("status_hz", status_hz, 0, 10)
        return CameraBlock(
            self._line,
            "video",
            lambda: self._line.able("video", "capture_video"),
            lambda given: self._start(given, status_hz, START_S),
            self._stop_order,
        )

    def _stop_order(self) -> tuple[float, ...]:
        return (STOP, self._line.video_stream, self._line.device)

    async def _is_recording(self) -> bool | None:
        if self._line.is_behind:  # ArduPilot always says that it does not
            return None
        message = await self._line.ask(m.CameraCaptureStatus, timeout=1.0)
        return None if message is None else message.video_status == 1

    async def _until_recording(self, wanted: bool, timeout: float) -> None:
        with anyio.move_on_after(timeout):
            now = await self._is_recording()
            if now is not None and now is not wanted:
                await self.status.wait_until(lambda told: told.is_recording is wanted)
            return
        does = "does not record" if wanted else "goes on recording"
        raise self._line.timed_out(f"accepted the order, and {does} after {timeout:g} s")

    # ----------------------------------------------------------------------------------------- streams

    async def load_streams(self) -> tuple[VideoStream, ...]:
        """Ask for the video streams (VIDEO_STREAM_INFORMATION), each by its number where they do not all come at once.

        Raises:
            NotSupported: the camera has none. Nothing was sent.
            OperationTimeout: they did not come, or no camera was heard.
        """
        await self._line.able("load_streams", "has_video_stream")
        first = await self._line.ask(m.VideoStreamInformation, 0)
        if first is None:
            first = await self._line.ask(m.VideoStreamInformation, 1)
        if first is None or not self._streams:
            raise self._line.timed_out("told of no video stream")
        for number in range(1, first.count + 1):
            if number not in self._streams and not await self._ask_stream(number):
                raise self._line.timed_out(f"did not tell of its video stream {number}")
        return self.streams.value

    async def _ask_stream(self, number: int) -> bool:
        found = await self._line.ask(
            m.VideoStreamInformation, number, where=lambda each: each.stream_id == number
        )
        return found is not None

    async def start_streaming(self, stream: int = 0) -> None:
        """Have a stream sent (MAV_CMD_VIDEO_START_STREAMING).

        Args:
            stream: its number, 0 (all of them) to 255.

        Raises:
            InvalidArgument: there can be no such stream. Nothing was sent.
            NotSupported: the camera has no streams. Nothing was sent.
            CommandRejected: the camera refused; there is no such stream.
            CommandTimeout: it did not answer.
            OperationTimeout: no camera was heard.
        """
        await self._stream("start_streaming", MavCmd.VIDEO_START_STREAMING, stream)

    async def stop_streaming(self, stream: int = 0) -> None:
        """Have a stream end (MAV_CMD_VIDEO_STOP_STREAMING); errors are those of :meth:`start_streaming`."""
        await self._stream("stop_streaming", MavCmd.VIDEO_STOP_STREAMING, stream)

    async def select_stream(self, stream: int) -> None:
        """Have this stream sent, and the others that run ended; errors are those of :meth:`start_streaming`.

        Args:
            stream: its number, 1 to 255.
        """
        check_range("stream", stream, 1, 255)
        for each in await self.load_streams():
            if each.number != stream and each.is_running:
                await self.stop_streaming(each.number)
        await self.start_streaming(stream)

    async def _stream(self, action: str, command: int, stream: int) -> None:
        check_range("stream", stream, 0, 255)
        await self._line.able(action, "has_video_stream")
        with self._line.giving("streams") as given:
            await self._line.order(command, stream, self._line.device, given=given)
        await self._line.ask(m.VideoStreamStatus, stream, timeout=1.0)

    async def select_source(self, primary: SourceName, secondary: SourceName = "default") -> None:
        """Choose the sensor that is shown (MAV_CMD_SET_CAMERA_SOURCE), and one that is shown within its picture.

        Args:
            primary: ``"default"``, ``"rgb"``, ``"ir"`` or ``"ndvi"``.
            secondary: the same; ``"default"``: no picture within the picture.

        Raises:
            CommandRejected: the camera refused; it has no such sensor.
            CommandTimeout: it did not answer.
            OperationTimeout: no camera was heard.
        """
        await self._line.find()
        order = (MavCmd.SET_CAMERA_SOURCE, self._line.number or 0, SOURCES[primary], SOURCES[secondary])
        with self._line.giving("source") as given:
            await self._line.order(*order, given=given)

    # --------------------------------------------------------------------------------------- receiving

    def _on_status(self, message: m.CameraCaptureStatus) -> None:
        self._line.tell(self.status, status_of(message), message)

    def _on_stream(self, message: m.VideoStreamInformation) -> None:
        if message.stream_id or message.uri:  # ArduPilot tells of one that is none
            stream = stream_of(message)
            self._streams[stream.number] = stream
            self._tell_streams(message)

    def _on_stream_status(self, message: m.VideoStreamStatus) -> None:
        before = self._streams.get(message.stream_id)
        if before is not None:
            self._streams[message.stream_id] = with_status(before, message)
            self._tell_streams(message)

    def _tell_streams(self, message: m.VideoStreamInformation | m.VideoStreamStatus) -> None:
        self._line.tell(self.streams, tuple(self._streams[each] for each in sorted(self._streams)), message)
