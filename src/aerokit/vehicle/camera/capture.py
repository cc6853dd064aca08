"""``Capture``: the data of one picture, decoded from one of three messages. Also CSV export and geotagging.

Pillow (``pip install aerokit-mavlink[pictures]``) writes the EXIF; the image data of the JPEG stays unchanged.
"""

from __future__ import annotations

import csv
import io
import math
import warnings
from datetime import datetime, timezone
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit._internal.arguments import checked
from aerokit._internal.files import write_atomically
from aerokit._internal.values import Snapshot
from aerokit.errors import AerokitError, FileFormatError, InvalidArgument
from aerokit.position import Position
from aerokit.vehicle.camera.values import finite_or_none, place_of
from aerokit.vehicle.state.movement import Attitude

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Iterator

    from aerokit.mavlink.messages import CameraFeedback, CameraImageCaptured, CameraTrigger
    from aerokit.vehicle.state.telemetry import Telemetry

__all__ = ["Capture", "captures_csv", "geotag_file", "geotagged", "write_captures"]

Quaternion = tuple[float, float, float, float]

# Time stamps below this (the year 1990) are not UTC, but the time since the vehicle was started.
UNIX_TIME_OF_1990_S = 631_152_000

# End of the year 9999, the last year that datetime can represent.
MAX_UTC_S = 253_402_300_799

# A position or an attitude older than this many seconds is not used for a picture that is taken now.
MAX_POSE_AGE_S = 2.0

# CAMERA_FEEDBACK counts pictures in 16 bits.
FEEDBACK_INDEX_RANGE = 1 << 16

# If the sine of the pitch exceeds this, roll and yaw turn about the same axis (gimbal lock).
MAX_PITCH_SINE = 0.99999


class Capture(Snapshot):
    """One picture. Values that the camera did not report are None, or an empty text.

    - ``camera``: 1 to 6 for a camera attached to the autopilot, otherwise its component id; ``index`` counts the
    camera's pictures from 0
    - ``success``: False if the camera failed to take the picture; None if not reported (CAMERA_TRIGGER)
    - ``received_at``: when the message arrived, on the loop's clock; ``taken_at``: seconds since 1970
    - ``place``: position of the camera; ``quaternion`` (w, x, y, z): its attitude, also given as ``roll_deg`` and
    ``pitch_deg`` from the horizon, ``yaw_deg`` from north
    - ``file_url``: ``mftp:///…`` on the camera itself, or ``http://…``
    """

    camera: int
    index: int
    success: bool | None
    received_at: float
    taken_at: float | None
    place: Position | None
    quaternion: tuple[float, float, float, float] | None
    roll_deg: float | None
    pitch_deg: float | None
    yaw_deg: float | None
    file_url: str


def capture_of(message: Any, camera: int, received_at: float, telemetry: Telemetry) -> Capture:
    """Decode a message about a picture. Call it as soon as the message arrives."""
    if message.NAME == "CAMERA_TRIGGER":
        return from_trigger(message, camera, received_at, telemetry)
    if message.NAME == "CAMERA_FEEDBACK":
        return from_feedback(message, camera, received_at)
    return from_image(message, camera, received_at)


def from_image(message: CameraImageCaptured, camera: int, received_at: float) -> Capture:
    w, x, y, z = message.q
    length = math.sqrt(w * w + x * x + y * y + z * z)
    quaternion = (w, x, y, z) if math.isfinite(length) and length > 0 else None
    roll, pitch, yaw = (None, None, None) if quaternion is None else _euler(quaternion)
    return Capture(
        camera=camera,
        index=message.image_index,
        success=message.capture_result == 1,
        received_at=received_at,
        taken_at=_utc(message.time_utc),
        place=place_of(message.lat, message.lon, message.alt / 1000, message.relative_alt / 1000),  # altitudes in mm
        quaternion=quaternion,
        roll_deg=roll,
        pitch_deg=pitch,
        yaw_deg=yaw,
        file_url=message.file_url,
    )


def from_feedback(message: CameraFeedback, camera: int, received_at: float) -> Capture:
    roll, pitch, yaw = _angles(message.roll, message.pitch, message.yaw)
    return Capture(
        camera=camera,
        index=(message.img_idx - 1) % FEEDBACK_INDEX_RANGE,  # `img_idx` counts pictures from 1.
        success=True,  # ArduPilot always sends the flag CAMERA_FEEDBACK_PHOTO (AP_Camera_Backend.cpp).
        received_at=received_at,
        taken_at=_utc(message.time_usec),
        place=place_of(message.lat, message.lng, message.alt_msl, message.alt_rel),
        quaternion=_quaternion_of(roll, pitch, yaw),
        roll_deg=roll,
        pitch_deg=pitch,
        yaw_deg=yaw,
        file_url="",
    )


def from_trigger(message: CameraTrigger, camera: int, received_at: float, telemetry: Telemetry) -> Capture:
    # PX4's message has no position, so the vehicle's present position and attitude are used.
    position = telemetry.position.latest if telemetry.position.age <= MAX_POSE_AGE_S else None
    attitude = telemetry.attitude.latest if telemetry.attitude.age <= MAX_POSE_AGE_S else None
    roll: float | None = None
    pitch: float | None = None
    yaw: float | None = None
    if attitude is not None:
        roll, pitch, yaw = _angles(attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg)
    place = None
    if position is not None:
        place = Position(
            position.latitude_deg,
            position.longitude_deg,
            position.altitude_amsl_m,
            position.altitude_relative_m,
        )
    return Capture(
        camera=camera,
        index=message.seq,
        success=None,  # PX4 reports only that it has triggered the camera.
        received_at=received_at,
        taken_at=_utc(message.time_usec),
        place=place,
        quaternion=_quaternion_of(roll, pitch, yaw),
        roll_deg=roll,
        pitch_deg=pitch,
        yaw_deg=yaw,
        file_url="",
    )


def _utc(microseconds: int) -> float | None:
    seconds = microseconds / 1e6
    return seconds if UNIX_TIME_OF_1990_S <= seconds < MAX_UTC_S else None


def _angles(roll: float, pitch: float, yaw: float) -> tuple[float | None, float | None, float | None]:
    return finite_or_none(roll), finite_or_none(pitch), finite_or_none(yaw % 360.0)


def _quaternion_of(roll: float | None, pitch: float | None, yaw: float | None) -> Quaternion | None:
    if roll is None or pitch is None or yaw is None:
        return None
    return Attitude(roll, pitch, yaw).quaternion


def _euler(quaternion: Quaternion) -> tuple[float, float, float]:
    """Return roll, pitch and yaw in degrees."""
    length = math.sqrt(sum(value * value for value in quaternion))
    w, x, y, z = (value / length for value in quaternion)
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))  # Rounding may exceed 1, which asin() refuses.
    if abs(sine) > MAX_PITCH_SINE:  # In gimbal lock, roll and yaw cannot be distinguished; both count as yaw.
        roll = 0.0
        yaw = -2 * math.copysign(1, sine) * math.atan2(x, w)
    else:
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return (
        _round(math.degrees(roll)),
        _round(math.degrees(math.asin(sine))),
        _round(math.degrees(yaw) % 360.0),
    )


def _round(degrees: float) -> float:
    # Degrees from 32-bit floats have only three exact decimals. Adding 0.0 turns -0.0 into 0.0.
    return round(degrees, 3) + 0.0


COLUMNS = (
    "file", "camera", "index", "success", "taken_at", "latitude_deg", "longitude_deg", "altitude_amsl_m",
    "altitude_relative_m", "roll_deg", "pitch_deg", "yaw_deg",
)  # fmt: skip

START, EXIF, SCAN = 0xD8, 0xE1, 0xDA
EXIF_HEADER = b"Exif\0\0"
MAX_SEGMENT_SIZE = 0xFFFF - 2
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
DATE_TIME_ORIGINAL, OFFSET_TIME_ORIGINAL, CAMERA_ELEVATION_ANGLE = 0x9003, 0x9011, 0x9405


@checked
def captures_csv(captures: Iterable[Capture]) -> str:
    """Format captures as CSV: a header line, then a line for each capture. Unknown values are empty fields.

    ``file`` is the last part of the URL and ``taken_at`` is UTC in ISO 8601. Angles are in degrees: roll and pitch from
    the horizon, yaw from north.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for capture in captures:
        place = capture.place
        coordinates = (None,) * 4 if place is None else _coordinates(place)
        time = _time_of(capture)
        taken_at = "" if time is None else time.isoformat(timespec="milliseconds")
        success = "" if capture.success is None else int(capture.success)
        _, _, name = capture.file_url.rpartition("/")
        angles = (capture.roll_deg, capture.pitch_deg, capture.yaw_deg)
        row = (name, capture.camera, capture.index, success, taken_at, *coordinates, *angles)
        writer.writerow("" if value is None else value for value in row)
    return text.getvalue()


@checked
def write_captures(path: str | os.PathLike[str], captures: Iterable[Capture]) -> None:
    """Write :func:`captures_csv` to a file, atomically. Raises OSError if that fails."""
    write_atomically(path, captures_csv(captures))


@checked
def geotagged(jpeg: bytes, capture: Capture) -> bytes:
    """Return the JPEG with time, position and direction of the capture in its EXIF; other EXIF tags stay.

    Writes GPSLatitude, GPSLongitude, GPSAltitude (above mean sea level), GPSImgDirection (from true north),
    GPSDateStamp and GPSTimeStamp, DateTimeOriginal, and CameraElevationAngle (from the horizon), where known.

    Raises:
        InvalidArgument: the capture has no position.
        FileFormatError: the bytes are not a JPEG, or its EXIF is unreadable or would become too long.
        AerokitError: Pillow is not installed.
    """
    if capture.place is None:
        raise InvalidArgument(f"capture {capture.index} of camera {capture.camera} has no position")
    segments, image_data = _split(jpeg)
    old_exif = next((segment for segment in segments if _is_exif(segment)), b"")
    image = _pillow("Image")
    exif = image.Exif()
    try:
        with warnings.catch_warnings():
            # Pillow only warns when it drops tags that it cannot parse. The warning becomes an error, so that no tags
            # get lost.
            warnings.simplefilter("error")
            exif.load(old_exif[4:])  # The marker and the length (4 bytes) are left out.
            exif.get_ifd(EXIF_IFD).update(_exif_tags(capture))
            exif.get_ifd(GPS_IFD).update(_gps_tags(capture))
            body: bytes = exif.tobytes()
    except Exception as error:  # Pillow raises many types for malformed EXIF.
        raise FileFormatError(f"cannot read the EXIF of this picture: {error}") from error
    if not body.startswith(EXIF_HEADER):  # The segment needs the header, whether or not Pillow has written it.
        body = EXIF_HEADER + body
    if len(body) > MAX_SEGMENT_SIZE:
        raise FileFormatError(
            f"cannot add the position: the EXIF would have {len(body)} bytes, more than {MAX_SEGMENT_SIZE}"
        )
    new_exif = bytes((0xFF, EXIF)) + (len(body) + 2).to_bytes(2, "big") + body  # The length includes its own 2 bytes.
    other_segments = b"".join(segment for segment in segments if not _is_exif(segment))
    return bytes((0xFF, START)) + new_exif + other_segments + image_data


@checked
def geotag_file(path: str | os.PathLike[str], capture: Capture, *, to: str | os.PathLike[str] | None = None) -> None:
    """Write time, position and direction of a capture into a JPEG file, or into a copy of it.

    Raises as :func:`geotagged`, and OSError if a file cannot be read or written.

    Args:
        path: the picture.
        capture: its capture.
        to: path of the copy; None replaces the file itself, atomically.
    """
    source = Path(path)
    target = source if to is None else Path(to)
    data = geotagged(source.read_bytes(), capture)
    temporary = target.with_name(target.name + ".part")
    try:
        temporary.write_bytes(data)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _split(jpeg: bytes) -> tuple[list[bytes], bytes]:
    """Return the segments in front of the image data, and the image data."""
    if jpeg[:3] != bytes((0xFF, START, 0xFF)):
        raise FileFormatError("the picture is not a JPEG: its bytes do not begin with FF D8 FF")
    segments = list(_segments(jpeg))
    image_start = 2 + sum(map(len, segments))  # The segments follow the bytes FF D8.
    return segments, jpeg[image_start:]


def _segments(jpeg: bytes) -> Iterator[bytes]:
    """Yield each segment before the image data."""
    start = 2  # after the two bytes FF D8, with which every JPEG begins
    # A segment consists of FF, its marker, its length in 2 bytes, and its content. The length includes these 2 bytes.
    while jpeg[start + 1 : start + 2] != bytes((SCAN,)):
        length = int.from_bytes(jpeg[start + 2 : start + 4], "big")
        segment = jpeg[start : start + 2 + length]
        if segment[:1] != b"\xff" or length < 2 or len(segment) < 2 + length:
            raise FileFormatError(f"the JPEG is incomplete or malformed: no segment begins at byte {start}")
        yield segment
        start += len(segment)


def _is_exif(segment: bytes) -> bool:
    marker, content = segment[1], segment[4:]  # See `_segments`.
    return marker == EXIF and content.startswith(EXIF_HEADER)


def _pillow(module: str) -> Any:
    try:
        return import_module(f"PIL.{module}")
    except ImportError:
        raise AerokitError("geotagging needs Pillow: pip install aerokit-mavlink[pictures]") from None


def _exif_tags(capture: Capture) -> dict[int, Any]:
    tags: dict[int, Any] = {}
    time = _time_of(capture)
    if time is not None:
        tags[DATE_TIME_ORIGINAL] = time.strftime("%Y:%m:%d %H:%M:%S")
        tags[OFFSET_TIME_ORIGINAL] = "+00:00"
    if capture.pitch_deg is not None:
        tags[CAMERA_ELEVATION_ANGLE] = capture.pitch_deg
    return tags


def _gps_tags(capture: Capture) -> dict[int, Any]:
    place = capture.place
    assert place is not None
    tags: dict[int, Any] = {
        0: b"\2\3\0\0",  # GPSVersionID
        1: "N" if place.latitude_deg >= 0 else "S",  # GPSLatitudeRef
        2: _sexagesimal(place.latitude_deg),  # GPSLatitude
        3: "E" if place.longitude_deg >= 0 else "W",  # GPSLongitudeRef
        4: _sexagesimal(place.longitude_deg),  # GPSLongitude
        18: "WGS-84",  # GPSMapDatum
    }
    if place.altitude_amsl_m is not None:  # GPSAltitudeRef (1: below sea level) and GPSAltitude
        tags |= {5: bytes((place.altitude_amsl_m < 0,)), 6: round(abs(place.altitude_amsl_m), 3)}
    if capture.yaw_deg is not None:  # GPSImgDirectionRef (T: from true north) and GPSImgDirection
        tags |= {16: "T", 17: round(capture.yaw_deg % 360.0, 2)}
    time = _time_of(capture)
    if time is not None:  # GPSTimeStamp and GPSDateStamp
        seconds = time.second + time.microsecond / 1e6
        tags |= {7: (float(time.hour), float(time.minute), seconds), 29: time.strftime("%Y:%m:%d")}
    return tags


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Return degrees, minutes and seconds, without the sign."""
    units_per_second = 10_000  # A unit of 1/10,000 arc second is 3 mm.
    total_minutes, units = divmod(round(abs(degrees) * 3600 * units_per_second), 60 * units_per_second)
    whole_degrees, minutes = divmod(total_minutes, 60)
    return float(whole_degrees), float(minutes), units / units_per_second


def _time_of(capture: Capture) -> datetime | None:
    if capture.taken_at is None or not 0 <= capture.taken_at < MAX_UTC_S:
        return None
    # Round down to milliseconds. EXIF stores whole seconds, and rounding up could reach the next second.
    return datetime.fromtimestamp(math.floor(capture.taken_at * 1000) / 1000, timezone.utc)


def _coordinates(place: Any) -> tuple[float | None, ...]:
    return (
        round(place.latitude_deg, 7),
        round(place.longitude_deg, 7),
        None if place.altitude_amsl_m is None else round(place.altitude_amsl_m, 3),
        None if place.altitude_relative_m is None else round(place.altitude_relative_m, 3),
    )
