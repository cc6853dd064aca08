"""``CameraDriver``: base class for your program's camera, for which aerokit serves the camera protocol."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from aerokit._internal.rotations import quaternion_from_euler
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CameraCapFlags,
    CameraZoomType,
    MavCmd,
    MavResult,
    ParamAck,
    SetFocusType,
    StorageStatus,
    StorageType,
    StorageUsageFlag,
)
from aerokit.mavlink.messages import CameraImageCaptured
from aerokit.onboard.commands import overrides
from aerokit.parameters import parse_definition
from aerokit.position import Position
from aerokit.protocols.servers.camera import camera_builders, camera_commands, legacy_requests
from aerokit.protocols.servers.camera_device import UNKNOWN_ATTITUDE, CameraDevice
from aerokit.protocols.servers.parameters import DefinedParameterServer

if TYPE_CHECKING:
    from aerokit.onboard.commands import ComponentServices
    from aerokit.onboard.host import ComponentHost
    from aerokit.parameters import CameraDefinition, SettingValue
    from aerokit.protocols.servers.camera import AsyncHandler
    from aerokit.protocols.servers.commands import ReceivedCommand
    from aerokit.protocols.servers.host import ServerHost


class Photo(Snapshot):
    """A picture that a camera has taken.

    ``url`` is the address of the file for other programs: ``mftp:///DCIM/1.jpg`` for a file of `serve_files`, or an
    HTTP address. The angles are those of the camera in degrees, with the yaw from north. They are reported only if all
    three are known. None means unknown.
    """

    url: str = ""
    position: Position | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    yaw_deg: float | None = None


class Storage(Snapshot):
    """Memory of a camera; sizes are in MiB (1,048,576 bytes)."""

    total_mib: float
    used_mib: float
    available_mib: float
    name: str = ""
    is_ready: bool = True


class CameraDriver:
    """Base class for your program's camera; pass an instance to :meth:`OnboardComponent.add_camera`.

    Override the coroutines for the functions that the camera has; aerokit derives the reported capabilities from them.
    An exception of a method becomes the result of the command, and a status text. A method is not called again for the
    same command before its previous call has returned.

    Args:
        vendor: at most 32 bytes.
        model: at most 32 bytes.
        resolution: width and height of a picture, in pixels.
        focal_length_mm: NaN if unknown.
        sensor_mm: width and height of the sensor; NaN if unknown.
        streams: addresses of video streams, such as ``rtsp://192.168.0.10:8554/main``.
        has_modes: True if the camera takes pictures only in image mode and videos only in video mode
            (:meth:`set_mode`).
        definition: camera definition file (XML) with the settings that aerokit serves by PARAM_EXT; None for no
            settings.
        gimbal_id: component id of the gimbal that carries the camera; 0 if there is none.
    """

    def __init__(
        self,
        *,
        vendor: str = "aerokit",
        model: str = "camera",
        resolution: tuple[int, int] = (0, 0),
        focal_length_mm: float = math.nan,
        sensor_mm: tuple[float, float] = (math.nan, math.nan),
        streams: Sequence[str] = (),
        has_modes: bool = False,
        definition: bytes | None = None,
        gimbal_id: int = 0,
    ) -> None:
        for name, text in (("vendor", vendor), ("model", model)):
            if len(text.encode()) > 32:  # the size of the fields in CAMERA_INFORMATION
                raise InvalidArgument(f"{name} = {text!r} is not allowed: it must have at most 32 bytes")
        self.vendor: str = vendor
        self.model: str = model
        self.resolution: tuple[int, int] = resolution
        self.focal_length_mm: float = focal_length_mm
        self.sensor_mm: tuple[float, float] = sensor_mm
        self.streams: tuple[str, ...] = tuple(streams)
        self.has_modes: bool = has_modes
        self.definition: bytes | None = definition
        self.gimbal_id: int = gimbal_id
        self.zoom_percent: float = math.nan
        """Zoom that is reported, in percent. Assign the new value when the zoom changes."""
        self.focus_percent: float = math.nan
        """Focus that is reported, in percent. Assign the new value when the focus changes."""

    async def take_photo(self, index: int) -> Photo:
        """Take a picture and return it. ``index`` is the number of the picture, from 0."""
        raise NotImplementedError

    async def start_video(self) -> None:
        """Begin to record."""
        raise NotImplementedError

    async def stop_video(self) -> None:
        """End the recording."""
        raise NotImplementedError

    async def set_mode(self, mode: int) -> None:
        """Change the CAMERA_MODE: 0 image, 1 video. Called only if ``has_modes`` is true."""

    async def zoom_to(self, percent: float) -> None:
        """Zoom to a percentage of the range, 0 to 100."""
        raise NotImplementedError

    async def zoom_at(self, rate: float) -> None:
        """Zoom at a rate from -1 (towards wide) to 1 (towards tele) until the rate 0 stops the zoom."""
        raise NotImplementedError

    async def focus_to(self, percent: float) -> None:
        """Focus at a percentage of the range, 0 to 100."""
        raise NotImplementedError

    async def focus_at(self, rate: float) -> None:
        """Move the focus at a rate from -1 (towards near) to 1 (towards far) until the rate 0 stops the focus."""
        raise NotImplementedError

    async def focus_distance(self, metres: float) -> None:
        """Focus at a distance in metres, above 0."""
        raise NotImplementedError

    async def autofocus(self) -> None:
        """Focus automatically."""
        raise NotImplementedError

    async def track(self, place: tuple[float, ...]) -> None:
        """Track a point (x, y, radius) or a rectangle (left, top, right, bottom), or stop tracking (empty tuple).

        The numbers are fractions of the image, 0 to 1.
        """
        raise NotImplementedError

    async def switch_stream(self, number: int, on: bool) -> None:
        """Start or stop a video stream; numbers begin at 1."""

    def storage(self) -> Storage | None:
        """Return the state of the camera's memory; None if the camera has no memory."""
        return None

    async def format_storage(self) -> None:
        """Erase all pictures and videos."""
        raise NotImplementedError

    async def reset_settings(self) -> None:
        """Restore the default settings."""

    def on_setting(self, name: str, value: SettingValue) -> None:
        """Called when another program has changed a setting of the definition file."""


def _implements(camera: CameraDriver, name: str) -> bool:
    return overrides(camera, CameraDriver, name)


def capabilities_of(camera: CameraDriver) -> int:
    flags = CameraCapFlags(0)
    if _implements(camera, "take_photo"):
        flags |= CameraCapFlags.CAPTURE_IMAGE
    if _implements(camera, "start_video"):
        flags |= CameraCapFlags.CAPTURE_VIDEO
    if camera.has_modes:
        flags |= CameraCapFlags.HAS_MODES
    else:  # A camera without modes takes photos and videos at any time.
        flags |= CameraCapFlags.CAN_CAPTURE_IMAGE_IN_VIDEO_MODE | CameraCapFlags.CAN_CAPTURE_VIDEO_IN_IMAGE_MODE
    if _implements(camera, "zoom_to") or _implements(camera, "zoom_at"):
        flags |= CameraCapFlags.HAS_BASIC_ZOOM
    if any(_implements(camera, name) for name in ("focus_to", "focus_at", "focus_distance", "autofocus")):
        flags |= CameraCapFlags.HAS_BASIC_FOCUS
    if camera.streams:
        flags |= CameraCapFlags.HAS_VIDEO_STREAM
    if _implements(camera, "track"):
        flags |= CameraCapFlags.HAS_TRACKING_POINT | CameraCapFlags.HAS_TRACKING_RECTANGLE
    return int(flags)


_STEP_PERCENT = 10.0
_AUTO_FOCUS_TYPES = (SetFocusType.AUTO, SetFocusType.AUTO_SINGLE, SetFocusType.AUTO_CONTINUOUS)


class CameraAdapter(CameraDevice):
    """Serves the camera protocol for a `CameraDriver`."""

    def __init__(self, camera: CameraDriver, services: ComponentServices) -> None:
        self.vendor: str = camera.vendor
        self.model: str = camera.model
        self.resolution: tuple[int, int] = camera.resolution
        self.focal_length_mm: float = camera.focal_length_mm
        self.sensor_mm: tuple[float, float] = camera.sensor_mm
        self.streams: tuple[str, ...] = camera.streams
        self.capabilities: int = capabilities_of(camera)
        self.host: ServerHost = services.host
        self._camera, self._host, self._tasks = camera, services.host, services.tasks
        self._call = services.commands.call
        self.set_up_captures()
        self.running_streams: set[int] = set(range(1, len(self.streams) + 1))

    @property
    def zoom(self) -> float:
        return self._camera.zoom_percent

    @property
    def focus(self) -> float:
        return self._camera.focus_percent

    @property
    def gimbal_device_id(self) -> int:
        return self._camera.gimbal_id

    @property
    def free_mib(self) -> float:
        storage = self._camera.storage()
        return 0.0 if storage is None else storage.available_mib

    def has_space(self) -> bool:
        storage = self._camera.storage()
        return storage is None or (storage.is_ready and storage.available_mib > 0)

    def expose(self, done: Callable[[CameraImageCaptured | None], None]) -> None:
        # The picture gets the time of the command, because the camera does not report the time of its shutter.
        time_boot_ms, unix_time = self._host.time_boot_ms, self._host.connection.unix_time()

        async def take() -> None:
            taken = None
            try:
                photo = await self._call(self._camera.take_photo, self.captures.image_count)
                image = _image_of(photo, time_boot_ms, unix_time)
                image.encode()  # Raises InvalidArgument if a field does not fit.
                taken = image
            except Exception as error:
                self._host.report_error("take_photo", error)
            finally:
                done(taken)

        self._tasks.start(take, "aerokit photo")

    def store_image(self, image: CameraImageCaptured) -> str | None:
        return image.file_url

    def storage(self, number: int) -> list[m.StorageInformation]:
        storage = self._camera.storage()
        if storage is None or number not in (0, 1):  # 0 requests all media.
            return []
        return [
            m.StorageInformation(
                time_boot_ms=self._host.time_boot_ms,
                storage_id=1,
                storage_count=1,
                # STORAGE_STATUS has no "not ready". With NOT_SUPPORTED, clients at least ignore the sizes.
                status=StorageStatus.READY if storage.is_ready else StorageStatus.NOT_SUPPORTED,
                total_capacity=storage.total_mib,
                used_capacity=storage.used_mib,
                available_capacity=storage.available_mib,
                read_speed=math.nan,
                write_speed=math.nan,
                type=StorageType.OTHER,
                name=storage.name,
                storage_usage=StorageUsageFlag.SET | StorageUsageFlag.PHOTO | StorageUsageFlag.VIDEO,
            )
        ]

    async def start_video(self) -> None:
        await self._call(self._camera.start_video)

    async def stop_video(self) -> None:
        await self._call(self._camera.stop_video)

    async def set_mode(self, mode: int) -> None:
        await self._call(self._camera.set_mode, mode)

    async def set_zoom(self, kind: int, value: float) -> bool:
        camera = self._camera
        return await self._move(kind, value, self.zoom, camera.zoom_to, camera.zoom_at)

    async def set_focus(self, kind: int, value: float) -> bool:
        camera = self._camera
        if kind in _AUTO_FOCUS_TYPES and _implements(camera, "autofocus"):
            await self._call(camera.autofocus)
            return True
        if kind == SetFocusType.METERS and value > 0 and _implements(camera, "focus_distance"):
            await self._call(camera.focus_distance, value)
            return True
        return await self._move(kind, value, self.focus, camera.focus_to, camera.focus_at)

    async def _move(
        self,
        kind: int,
        value: float,
        current_percent: float,
        move_to: Callable[[float], Any],
        move_at: Callable[[float], Any],
    ) -> bool:
        """Move the zoom or the focus. Return False if the camera cannot do that."""
        # `kind` is a CAMERA_ZOOM_TYPE, or a SET_FOCUS_TYPE with the same number.
        if kind == CameraZoomType.STEP and math.isfinite(current_percent) and math.isfinite(value):
            kind = CameraZoomType.RANGE
            value = max(0.0, min(100.0, current_percent + value * _STEP_PERCENT))
        if kind == CameraZoomType.RANGE and 0.0 <= value <= 100.0:
            move = move_to
        elif kind == CameraZoomType.CONTINUOUS and -1.0 <= value <= 1.0:
            move = move_at
        else:
            return False
        is_implemented = _implements(self._camera, move.__name__)  # `move` is a method of the camera driver.
        if not is_implemented:
            return False
        await self._call(move, value)
        return True

    async def switch_stream(self, numbers: set[int], *, on: bool) -> None:
        for number in sorted(numbers):
            await self._call(self._camera.switch_stream, number, on)

    async def track(self, place: tuple[float, ...]) -> None:
        await self._call(self._camera.track, place)

    async def format_storage(self) -> None:
        await self._call(self._camera.format_storage)

    async def reset_settings(self) -> None:
        await self._call(self._camera.reset_settings)


def _image_of(photo: Photo, time_boot_ms: int, unix_time: float) -> CameraImageCaptured:
    if not isinstance(photo, Photo):
        raise InvalidArgument(f"take_photo returned {photo!r}, not a Photo")
    position = photo.position
    amsl_m = None if position is None else position.altitude_amsl_m
    relative_m = None if position is None else position.altitude_relative_m
    angles = (photo.roll_deg, photo.pitch_deg, photo.yaw_deg)
    known_angles = [math.radians(angle) for angle in angles if angle is not None]
    return CameraImageCaptured(
        time_boot_ms=time_boot_ms,
        time_utc=round(unix_time * 1e6),
        camera_id=0,
        lat=0 if position is None else round(position.latitude_deg * 1e7),
        lon=0 if position is None else round(position.longitude_deg * 1e7),
        alt=0 if amsl_m is None else round(amsl_m * 1000),
        relative_alt=0 if relative_m is None else round(relative_m * 1000),
        q=UNKNOWN_ATTITUDE if len(known_angles) < 3 else quaternion_from_euler(*known_angles),
        image_index=0,
        capture_result=1,
        file_url=photo.url,
    )


DEFINITION_PATH = "/camera_definition.xml"


class DefinedSettings(DefinedParameterServer):
    """Settings of a `CameraDriver` with a definition file."""

    _host: ComponentHost  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self, host: ComponentHost, definition: CameraDefinition, on_change: Callable[[str, SettingValue], Any]
    ):
        self._on_change = on_change
        super().__init__(host, definition)

    def set(self, name: str, data: bytes, kind: int) -> int:
        old_value = self.values[name]
        try:
            return super().set(name, data, kind)
        except Exception as error:  # The program's function has refused the new value.
            self.values[name] = old_value
            self._host.report_error(name, error)
            return ParamAck.FAILED

    def on_set(self, name: str, value: SettingValue) -> None:
        self._on_change(name, value)


def add_camera(services: ComponentServices, camera: CameraDriver) -> None:
    host, streams = services.host, services.streams
    adapter = CameraAdapter(camera, services)
    if m.CameraInformation.ID in streams.builders:
        raise InvalidArgument("this component already has a camera: open another component for the second one")
    if camera.definition is not None:
        definition = parse_definition(camera.definition)
        services.parameters._forbid_parameters()  # The camera's settings use the same messages.
        DefinedSettings(host, definition, camera.on_setting)
        services.memory.put(DEFINITION_PATH, camera.definition)
        adapter.definition_version = definition.version
        adapter.definition_uri = f"mftp://{DEFINITION_PATH}"
    streams.builders.update(camera_builders(adapter))
    for command, handler in camera_commands(adapter).items():
        if command == MavCmd.STORAGE_FORMAT and not _implements(camera, "format_storage"):
            continue  # The command stays UNSUPPORTED.
        services.commands.add_raw(command, partial(_run_if_implemented, handler))
    services.commands.add_guarded(legacy_requests(streams))


async def _run_if_implemented(handler: AsyncHandler, command: ReceivedCommand) -> int:
    try:
        return await handler(command)
    except NotImplementedError:  # The program's class does not override the method.
        return MavResult.UNSUPPORTED
