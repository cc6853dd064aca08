"""``VideoMixin``: recording and streaming video."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraSource, MavCmd
from aerokit.vehicle.camera.link import CameraBlock, CameraMixin
from aerokit.vehicle.camera.values import (
    CameraStatus,
    CameraStream,
    ThermalRange,
    status_of,
    stream_of,
    stream_state,
    thermal_range_of,
)

if TYPE_CHECKING:
    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.camera.link import CameraLink
    from aerokit.vehicle.commanding.order import Order

START, STOP = MavCmd.VIDEO_START_CAPTURE, MavCmd.VIDEO_STOP_CAPTURE
START_TIMEOUT_S = 5.0
STATUS_POLL_INTERVAL_S, STREAMS_POLL_INTERVAL_S, THERMAL_POLL_INTERVAL_S = 2.0, 5.0, 1.0
SourceName = Literal["default", "rgb", "ir", "ndvi"]
SOURCES = {source.name.lower(): int(source) for source in CameraSource}


@checks_arguments
class VideoMixin(CameraMixin):
    """Recording, streaming and status of a camera."""

    def __init__(self, link: CameraLink) -> None:
        super().__init__(link)
        self.status: StateCell[CameraStatus] = link.polled_cell(
            "camera.status", m.CameraCaptureStatus, STATUS_POLL_INTERVAL_S
        )
        """Recording and its duration, pictures taken, free storage (CAMERA_CAPTURE_STATUS). Polled every 2 s while your
        program uses this value, unless the camera sends it by itself."""
        self.streams: StateCell[tuple[CameraStream, ...]] = link.polled_cell(
            "camera.streams", m.VideoStreamInformation, STREAMS_POLL_INTERVAL_S
        )
        """Video streams by number; polled every 5 s while your program uses this value."""
        self.thermal_range: StateCell[ThermalRange] = link.polled_cell(
            "camera.thermal_range", m.CameraThermalRange, THERMAL_POLL_INTERVAL_S
        )
        """Coldest and hottest point of the thermal image; polled every second while your program uses this value."""
        self._streams: dict[int, CameraStream] = {}  # video streams by number
        link.listen(m.CameraCaptureStatus, lambda message: link.set_cell(self.status, status_of(message), message))
        link.listen(m.VideoStreamInformation, self._on_stream)
        link.listen(m.VideoStreamStatus, self._on_stream_status)
        link.listen(
            m.CameraThermalRange,
            lambda message: link.set_cell(self.thermal_range, thermal_range_of(message), message),
        )

    async def start_video(self, *, status_hz: float = 1.0, timeout: float = 5.0) -> None:
        """Start recording (MAV_CMD_VIDEO_START_CAPTURE); returns when the camera reports that it records.

        If the camera does not report its status, the call returns when the camera has accepted the command. This
        applies to all cameras attached to the autopilot. If you cancel the call, the camera may still start to record;
        the block of :meth:`video` stops it in any case.

        Args:
            status_hz: rate at which the camera sends its status while recording, 0 to 10.
            timeout: seconds to wait until the camera records.

        Raises:
            InvalidArgument: ``status_hz`` is out of range. Nothing was sent.
            NotSupported: the camera cannot record video. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or in the wrong mode.
            CommandTimeout: the camera did not answer; it may be recording.
            OperationTimeout: the camera accepted the command but does not record, or no camera was found.
        """
        check_range("status_hz", status_hz, 0, 10)
        await self._link.require_capability("start_video", "capture_video")
        with self._link.new_order("video") as order:
            await self._order_start(order, status_hz)
        await self._wait_recording(timeout, expected=True)

    async def _order_start(self, order: Order, status_hz: float) -> None:
        command = (START, self._link.video_stream, status_hz, self._link.device_id)
        await self._link.order_once(
            order, lambda: self._link.command(*command, order=order, attempts=1), self._is_recording
        )

    async def stop_video(self, *, timeout: float = 5.0) -> None:
        """Stop recording (MAV_CMD_VIDEO_STOP_CAPTURE); returns when the camera reports that it has stopped.

        Raises:
            NotSupported: the camera cannot record video. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: the camera did not answer.
            OperationTimeout: the camera accepted the command but still records, or no camera was found.
        """
        await self._link.require_capability("stop_video", "capture_video")
        command, *params = self._stop_command()
        with self._link.new_order("video") as order:
            await self._link.command(int(command), *params, order=order)
        await self._wait_recording(timeout, expected=False)

    def video(self, *, status_hz: float = 1.0) -> CameraBlock:
        """Record for the duration of an ``async with`` block.

        The end of the block stops recording, also under cancellation. Entering raises as :meth:`start_video`.

        Raises:
            InvalidArgument: ``status_hz`` is not 0 to 10. Nothing was sent.
        """
        check_range("status_hz", status_hz, 0, 10)

        async def start(order: Order) -> None:
            await self._order_start(order, status_hz)
            await self._wait_recording(START_TIMEOUT_S, expected=True)

        return CameraBlock(
            self._link,
            "video",
            check=lambda: self._link.require_capability("video", "capture_video"),
            start=start,
            stop_command=self._stop_command,
        )

    def _stop_command(self) -> tuple[float, ...]:
        return (STOP, self._link.video_stream, self._link.device_id)

    async def _is_recording(self) -> bool | None:
        """Ask the camera whether it records; return None if it does not report that."""
        if self._link.is_autopilot_attached:  # ArduPilot always reports that it is not recording.
            return None
        message = await self._link.request(m.CameraCaptureStatus, timeout=1.0)
        return None if message is None else message.video_status == 1

    async def _wait_recording(self, timeout: float, *, expected: bool) -> None:
        """Wait until the camera reports that recording has started or stopped.

        Returns at once if the camera does not report its status.
        """
        with anyio.move_on_after(timeout):
            is_recording = await self._is_recording()
            is_reported = is_recording is not None
            if is_reported and is_recording is not expected:
                await self.status.wait_until(lambda status: status.is_recording is expected)
            return
        # The time-out has expired.
        outcome = "records" if expected else "has stopped"
        raise self._link.timeout_error(f"accepted the order, but did not report within {timeout:g} s that it {outcome}")

    async def load_streams(self) -> tuple[CameraStream, ...]:
        """Request information about all video streams (VIDEO_STREAM_INFORMATION), one by one if necessary.

        Raises:
            NotSupported: the camera has no video streams. Nothing was sent.
            OperationTimeout: the information about some streams did not arrive, or no camera was found.
        """
        await self._link.require_capability("load_streams", "has_video_stream")
        self._streams.clear()  # Streams that were reported earlier may have changed.
        answer = await self._link.request(m.VideoStreamInformation, 0)  # 0 requests all streams.
        if answer is None:  # Some cameras answer only requests for a single stream.
            answer = await self._link.request(m.VideoStreamInformation, 1)
        if answer is None or not self._streams:
            raise self._link.timeout_error("reported no video stream")
        for number in range(1, answer.count + 1):
            is_reported = number in self._streams or await self._request_stream(number)
            if not is_reported:
                raise self._link.timeout_error(f"did not report its video stream {number}")
        return self.streams.value

    async def _request_stream(self, number: int) -> bool:
        message = await self._link.request(
            m.VideoStreamInformation, number, where=lambda message: message.stream_id == number
        )
        return message is not None

    async def start_streaming(self, stream: int = 0) -> None:
        """Start a video stream (MAV_CMD_VIDEO_START_STREAMING).

        Args:
            stream: number of the stream, 1 to 255, or 0 for all.

        Raises:
            InvalidArgument: the number is out of range. Nothing was sent.
            NotSupported: the camera has no streams. Nothing was sent.
            CommandRejected: the camera refused, or has no such stream.
            CommandTimeout: the camera did not answer.
            OperationTimeout: no camera was found.
        """
        await self._send_stream_command("start_streaming", MavCmd.VIDEO_START_STREAMING, stream)

    async def stop_streaming(self, stream: int = 0) -> None:
        """Stop a video stream (MAV_CMD_VIDEO_STOP_STREAMING); errors as for :meth:`start_streaming`."""
        await self._send_stream_command("stop_streaming", MavCmd.VIDEO_STOP_STREAMING, stream)

    async def select_stream(self, stream: int) -> None:
        """Start one stream and stop all other streams; errors as for :meth:`start_streaming`.

        Args:
            stream: number of the stream, 1 to 255.
        """
        check_range("stream", stream, 1, 255)
        streams = await self.load_streams()
        # If the camera has no such stream, the others continue, and the camera refuses the command below.
        if any(camera_stream.number == stream for camera_stream in streams):
            for camera_stream in streams:
                if camera_stream.number != stream and camera_stream.is_running:
                    await self.stop_streaming(camera_stream.number)
        await self.start_streaming(stream)

    async def _send_stream_command(self, action: str, command: int, stream: int) -> None:
        check_range("stream", stream, 0, 255)
        await self._link.require_capability(action, "has_video_stream")
        with self._link.new_order("streams") as order:
            await self._link.command(command, stream, self._link.device_id, order=order)
        await self._link.request(m.VideoStreamStatus, stream, timeout=1.0)

    async def select_source(self, primary: SourceName, secondary: SourceName = "default") -> None:
        """Select the sensor to show (MAV_CMD_SET_CAMERA_SOURCE), and one to show as picture-in-picture.

        Args:
            primary: ``"default"``, ``"rgb"``, ``"ir"`` or ``"ndvi"``.
            secondary: one of the same names; ``"default"`` shows no second picture.

        Raises:
            CommandRejected: the camera refused, or has no such sensor.
            CommandTimeout: the camera did not answer.
            OperationTimeout: no camera was found.
        """
        await self._link.identify()
        assert self._link.number is not None  # `identify` has found the camera.
        # This command has the component id in param1, not the device id.
        command = (MavCmd.SET_CAMERA_SOURCE, self._link.number, SOURCES[primary], SOURCES[secondary])
        with self._link.new_order("source") as order:
            await self._link.command(*command, order=order)

    def _on_stream(self, message: m.VideoStreamInformation) -> None:
        if message.stream_id or message.uri:  # ArduPilot also sends an empty message without a stream.
            stream = stream_of(message)
            self._streams[stream.number] = stream
            self._publish_streams(message)

    def _on_stream_status(self, message: m.VideoStreamStatus) -> None:
        stream = self._streams.get(message.stream_id)
        if stream is not None:
            self._streams[message.stream_id] = stream.replace(**stream_state(message))
            self._publish_streams(message)

    def _publish_streams(self, message: m.VideoStreamInformation | m.VideoStreamStatus) -> None:
        streams = tuple(self._streams[number] for number in sorted(self._streams))
        self._link.set_cell(self.streams, streams, message)
