"""``Capture``: one picture that was taken, from the three messages that tell of one.

EXIF is made by Pillow (``pip install aerokit-mavlink[pictures]``); the picture itself stays byte for byte what it was.
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
from aerokit._internal.files import write_whole
from aerokit._internal.values import Snapshot
from aerokit.errors import AerokitError, FileFormatError, InvalidArgument
from aerokit.position import Position
from aerokit.vehicle.camera.values import known, place_of

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Iterator

    from aerokit.mavlink.messages import CameraFeedback, CameraImageCaptured, CameraTrigger
    from aerokit.vehicle.state.telemetry import Telemetry

__all__ = [
    "LAST_SECOND",
    "SECONDS_IN_1990",
    "WRAPS",
    "Capture",
    "captures_csv",
    "from_feedback",
    "from_image",
    "from_trigger",
    "geotag_file",
    "geotagged",
    "write_captures",
]

Quaternion = tuple[float, float, float, float]

SECONDS_IN_1990 = 631_152_000
"""A time stamp below this counts from the vehicle's boot."""

LAST_SECOND = 253_402_300_799
"""The last one of the year 9999, with which calendars end."""

WRAPS = 1 << 16
"""CAMERA_FEEDBACK counts in 16 bits."""

STRAIGHT = 0.99999
"""Sine of a pitch at which roll and yaw turn about the same axis."""


class Capture(Snapshot):
    """One picture. None, or an empty text, is what was not told.

    - ``camera``: 1 to 6 behind the autopilot, otherwise the camera's component id; ``index`` counts from 0
    - ``success``: False when the camera could not take it; None when nobody said (CAMERA_TRIGGER)
    - ``heard_at``: when we heard of it, on the loop's clock; ``taken_at``: seconds since 1970
    - ``place``, and how the camera lay: ``quaternion`` (w, x, y, z), angles from the horizon and from north
    - ``file_url``: where the file is: ``mftp:///…`` on the camera itself, or ``http://…``
    """

    camera: int
    index: int
    success: bool | None
    heard_at: float
    taken_at: float | None
    place: Position | None
    quaternion: tuple[float, float, float, float] | None
    roll_deg: float | None
    pitch_deg: float | None
    yaw_deg: float | None
    file_url: str


def from_image(message: CameraImageCaptured, camera: int, heard_at: float) -> Capture:
    """Of CAMERA_IMAGE_CAPTURED, the standard's."""
    q = message.q
    length = math.sqrt(sum(each * each for each in q))
    quaternion = (q[0], q[1], q[2], q[3]) if math.isfinite(length) and length > 0 else None
    roll, pitch, yaw = (None, None, None) if quaternion is None else _euler(quaternion)
    place = place_of(message.lat, message.lon, message.alt / 1000, message.relative_alt / 1000)
    taken_at = _utc(message.time_utc)
    success = message.capture_result == 1
    return Capture(
        camera,
        message.image_index,
        success,
        heard_at,
        taken_at,
        place,
        quaternion,
        roll,
        pitch,
        yaw,
        message.file_url,
    )


def from_feedback(message: CameraFeedback, camera: int, heard_at: float) -> Capture:
    """Of CAMERA_FEEDBACK, ArduPilot's, which counts from 1."""
    roll, pitch, yaw = _angles(message.roll, message.pitch, message.yaw)
    return Capture(
        camera,
        (message.img_idx - 1) % WRAPS,
        True,
        heard_at,
        _utc(message.time_usec),
        place_of(message.lat, message.lng, message.alt_msl, message.alt_rel),
        _quaternion_of(roll, pitch, yaw),
        roll,
        pitch,
        yaw,
        "",
    )


def from_trigger(message: CameraTrigger, camera: int, heard_at: float, telemetry: Telemetry) -> Capture:
    """Of CAMERA_TRIGGER, PX4's, which tells no place: the vehicle's own is taken."""
    position, attitude = telemetry.position.latest, telemetry.attitude.latest
    roll, pitch, yaw = (
        (None, None, None)
        if attitude is None
        else _angles(attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg)
    )
    return Capture(
        camera,
        message.seq,
        None,
        heard_at,
        _utc(message.time_usec),
        None
        if position is None
        else Position(
            position.latitude_deg,
            position.longitude_deg,
            position.altitude_amsl_m,
            position.altitude_relative_m,
        ),
        _quaternion_of(roll, pitch, yaw),
        roll,
        pitch,
        yaw,
        "",
    )


def _utc(microseconds: int) -> float | None:
    seconds = microseconds / 1e6
    return seconds if SECONDS_IN_1990 <= seconds < LAST_SECOND else None


def _angles(roll: float, pitch: float, yaw: float) -> tuple[float | None, float | None, float | None]:
    """Those that are numbers."""
    return known(roll), known(pitch), known(yaw % 360.0)


def _quaternion_of(roll: float | None, pitch: float | None, yaw: float | None) -> Quaternion | None:
    """Of angles in degrees, if all are known."""
    if roll is None or pitch is None or yaw is None:
        return None
    return _quaternion(math.radians(roll), math.radians(pitch), math.radians(yaw))


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(each / 2), math.sin(each / 2)) for each in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _euler(quaternion: Quaternion) -> tuple[float, float, float]:
    """Roll, pitch, yaw in degrees; of a camera that looks straight up or down all turning is yaw."""
    length = math.sqrt(sum(each * each for each in quaternion))
    w, x, y, z = (each / length for each in quaternion)
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    if abs(sine) > STRAIGHT:
        roll, yaw = 0.0, -2 * math.copysign(1, sine) * math.atan2(x, w)
    else:
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return (
        _round(math.degrees(roll)),
        _round(math.degrees(math.asin(sine))),
        _round(math.degrees(yaw) % 360.0),
    )


def _round(degrees: float) -> float:
    """The noise of 32 bits is not worth showing."""
    return round(degrees, 3) + 0.0


COLUMNS = (
    "file", "camera", "index", "success", "taken_at", "latitude_deg", "longitude_deg", "altitude_amsl_m",
    "altitude_relative_m", "roll_deg", "pitch_deg", "yaw_deg",
)  # fmt: skip

START, EXIF, SCAN = 0xD8, 0xE1, 0xDA

EXIF_HEADER = b"Exif\0\0"

LONGEST_SEGMENT = 0xFFFF - 2

EXIF_IFD, GPS_IFD = 0x8769, 0x8825

DATE_TIME_ORIGINAL, OFFSET_TIME_ORIGINAL, CAMERA_ELEVATION_ANGLE = 0x9003, 0x9011, 0x9405


@checked
def captures_csv(captures: Iterable[Capture]) -> str:
    """A line for each picture under a line with the names of the columns; what is not known is empty.

    ``file`` is the last part of its URL, ``taken_at`` in UTC (ISO 8601), angles in degrees from horizon and north.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for each in captures:
        place = each.place
        told = (None,) * 4 if place is None else _numbers(place)
        time = _time_of(each)
        taken_at = "" if time is None else time.isoformat(timespec="milliseconds")
        success = "" if each.success is None else int(each.success)
        name = each.file_url.rpartition("/")[2]
        angles = (each.roll_deg, each.pitch_deg, each.yaw_deg)
        row = (name, each.camera, each.index, success, taken_at, *told, *angles)
        writer.writerow("" if value is None else value for value in row)
    return text.getvalue()


@checked
def write_captures(path: str | os.PathLike[str], captures: Iterable[Capture]) -> None:
    """Write :func:`captures_csv` into a file, whole or not at all; OSError when that cannot be done."""
    write_whole(path, captures_csv(captures))


@checked
def geotagged(jpeg: bytes, capture: Capture) -> bytes:
    """A JPEG with the capture's time, place and direction in its EXIF; what else is in there stays.

    Writes GPSLatitude, GPSLongitude, GPSAltitude (above the sea), GPSImgDirection (from true north), GPSDateStamp and
    GPSTimeStamp, DateTimeOriginal, and CameraElevationAngle (from the horizon), as far as the capture knows them.

    Raises:
        InvalidArgument: the capture has no place.
        FileFormatError: these bytes are no JPEG, or their EXIF cannot be read.
        AerokitError: Pillow is not installed.
    """
    if capture.place is None:
        raise InvalidArgument(f"capture {capture.index} of camera {capture.camera} has no place")
    segments, rest = _split(jpeg)
    before = next((each for each in segments if _is_exif(each)), b"")
    image = _pillow("Image")
    exif = image.Exif()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # by which Pillow tells that it leaves out what it cannot read
            exif.load(before[4:])
            exif.get_ifd(EXIF_IFD).update(_exif_tags(capture))
            exif.get_ifd(GPS_IFD).update(_gps_tags(capture))
            body: bytes = exif.tobytes()
    except Exception as error:  # whatever Pillow says of bytes that somebody else has written
        raise FileFormatError(f"the EXIF of this picture cannot be read: {error}") from error
    if not body.startswith(EXIF_HEADER):
        body = EXIF_HEADER + body
    if len(body) > LONGEST_SEGMENT:
        raise FileFormatError("the EXIF of this picture is too long to add a place to")
    tagged = bytes((0xFF, EXIF)) + (len(body) + 2).to_bytes(2, "big") + body
    others = b"".join(each for each in segments if not _is_exif(each))
    return bytes((0xFF, START)) + tagged + others + rest


@checked
def geotag_file(
    path: str | os.PathLike[str], capture: Capture, *, to: str | os.PathLike[str] | None = None
) -> None:
    """Write a capture's place into a JPEG file, or into a copy of it; errors as :func:`geotagged`, and OSError.

    Args:
        path: the picture.
        capture: which one it is.
        to: the copy; None: the file itself is replaced, whole or not at all.
    """
    source = Path(path)
    target = source if to is None else Path(to)
    data = geotagged(source.read_bytes(), capture)
    part = target.with_name(target.name + ".part")
    try:
        part.write_bytes(data)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


# ---------------------------------------------------------------------------------------------- JPEG
def _split(jpeg: bytes) -> tuple[list[bytes], bytes]:
    """The segments in front of the picture itself, and that."""
    if jpeg[:3] != bytes((0xFF, START, 0xFF)):
        raise FileFormatError("these bytes are no JPEG: they do not begin as one")
    segments = list(_walk(jpeg))
    return segments, jpeg[2 + sum(map(len, segments)) :]


def _walk(jpeg: bytes) -> Iterator[bytes]:
    at = 2
    while jpeg[at + 1 : at + 2] != bytes((SCAN,)):
        length = int.from_bytes(jpeg[at + 2 : at + 4], "big")
        segment = jpeg[at : at + 2 + length]
        if segment[:1] != b"\xff" or length < 2 or len(segment) < 2 + length:
            raise FileFormatError("these bytes are no whole JPEG: they end before the picture begins")
        yield segment
        at += len(segment)


def _is_exif(segment: bytes) -> bool:
    return segment[1] == EXIF and segment[4:10] == EXIF_HEADER


def _pillow(module: str) -> Any:
    try:
        return import_module(f"PIL.{module}")
    except ImportError:
        raise AerokitError("geotagging needs Pillow: pip install aerokit-mavlink[pictures]") from None


# ---------------------------------------------------------------------------------------------- tags
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
    """By their numbers in the EXIF standard."""
    place = capture.place
    assert place is not None
    tags: dict[int, Any] = {
        0: b"\2\3\0\0",  # GPSVersionID
        1: "N" if place.latitude_deg >= 0 else "S",
        2: _sexagesimal(place.latitude_deg),
        3: "E" if place.longitude_deg >= 0 else "W",
        4: _sexagesimal(place.longitude_deg),
        18: "WGS-84",
    }
    if place.altitude_amsl_m is not None:
        tags |= {5: bytes((place.altitude_amsl_m < 0,)), 6: round(abs(place.altitude_amsl_m), 3)}
    if capture.yaw_deg is not None:
        tags |= {16: "T", 17: round(capture.yaw_deg % 360.0, 2)}
    time = _time_of(capture)
    if time is not None:
        seconds = time.second + time.microsecond / 1e6
        tags |= {7: (float(time.hour), float(time.minute), seconds), 29: time.strftime("%Y:%m:%d")}
    return tags


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Degrees, minutes, seconds; four places of a second are some millimetres."""
    units = round(abs(degrees) * 36_000_000)
    minutes, seconds = divmod(units, 600_000)
    whole, minutes = divmod(minutes, 60)
    return float(whole), float(minutes), seconds / 10_000


def _time_of(capture: Capture) -> datetime | None:
    """``math.floor``: EXIF has whole seconds, which may not be rounded into the next one."""
    if capture.taken_at is None or not 0 <= capture.taken_at < LAST_SECOND:
        return None  # no calendar holds it
    return datetime.fromtimestamp(math.floor(capture.taken_at * 1000) / 1000, timezone.utc)


def _numbers(place: Any) -> tuple[float | None, ...]:
    return (
        round(place.latitude_deg, 7),
        round(place.longitude_deg, 7),
        None if place.altitude_amsl_m is None else round(place.altitude_amsl_m, 3),
        None if place.altitude_relative_m is None else round(place.altitude_relative_m, 3),
    )
