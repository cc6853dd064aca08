"""Comparison of items that tolerates the changes made by the protocol and by the vehicle's storage.

The tables describe how the firmware converts the numbers of an item (ArduPilot 4.7 AP_Mission, PX4 1.17
mavlink_mission), and were verified on vehicles.
"""

from __future__ import annotations

import math
import struct
from enum import Enum
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import (
    FENCE_COMMANDS,
    GLOBAL_FRAMES,
    RALLY_COMMANDS,
    canonical_frame,
    has_place,
    xy_scale,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from aerokit.missions.item import MissionItem

FIELDS = ("param1", "param2", "param3", "param4", "x", "y", "z")


class ItemStorage(Enum):
    """How a vehicle has stored items. Comparisons tolerate the changes that this storage causes."""

    WIRE = "wire"
    """Only changes made by MISSION_ITEM_INT: rounding to 32-bit floats, and equivalent frames."""
    ARDUPILOT = "ardupilot"
    """Changes made by MISSION_ITEM_INT, and by ArduPilot's storage of 15 bytes for each item."""
    PX4 = "px4"
    """Changes made by MISSION_ITEM_INT, and by PX4's item structure."""
    ANY = "any"
    """Changes made by any of the other three."""


# How an autopilot stores the parameters of each command: one letter for each of `FIELDS`, explained in `_stored_as`.
# Fields without a letter are not stored and are read back as 0, except those of a place.
_ARDUPILOT_FORMS: dict[int, tuple[str, ...]] = {
    MavCmd.NAV_WAYPOINT: ("u", "-cc"),  # "u" on Copter, Rover and Sub, "-cc" on Plane
    MavCmd.NAV_LOITER_UNLIM: ("--r",),
    MavCmd.NAV_LOITER_TURNS: ("n-R?",),
    MavCmd.NAV_LOITER_TIME: ("u-g?",),
    MavCmd.NAV_LAND: ("u--g",),
    MavCmd.NAV_TAKEOFF: ("u",),
    MavCmd.NAV_CONTINUE_AND_CHANGE_ALT: ("u",),
    MavCmd.NAV_LOITER_TO_ALT: ("-r-?",),
    MavCmd.NAV_SPLINE_WAYPOINT: ("u",),
    MavCmd.NAV_ALTITUDE_WAIT: ("ffb",),
    MavCmd.NAV_VTOL_LAND: ("u",),
    MavCmd.NAV_GUIDED_ENABLE: ("u",),
    MavCmd.NAV_DELAY: ("fiii",),
    MavCmd.NAV_PAYLOAD_PLACE: ("k",),
    MavCmd.CONDITION_DELAY: ("f",),
    MavCmd.CONDITION_DISTANCE: ("f",),
    MavCmd.CONDITION_YAW: ("ffib",),
    MavCmd.DO_JUMP: ("us",),
    MavCmd.DO_CHANGE_SPEED: ("bff",),
    MavCmd.DO_SET_HOME: ("u",),
    MavCmd.DO_SET_RELAY: ("bb",),
    MavCmd.DO_REPEAT_RELAY: ("bsf",),
    MavCmd.DO_SET_SERVO: ("bu",),
    MavCmd.DO_REPEAT_SERVO: ("busf",),
    MavCmd.DO_PAUSE_CONTINUE: ("u",),
    MavCmd.DO_SET_REVERSE: ("u",),
    MavCmd.DO_SET_ROI_LOCATION: ("u",),
    MavCmd.DO_SET_ROI_NONE: ("u",),
    MavCmd.DO_SET_ROI: ("u",),
    MavCmd.DO_DIGICAM_CONFIGURE: ("bububbf",),
    MavCmd.DO_DIGICAM_CONTROL: ("bbibbb",),
    MavCmd.DO_MOUNT_CONTROL: ("fff---2",),
    MavCmd.DO_SET_CAM_TRIGG_DIST: ("f-b",),
    MavCmd.DO_FENCE_ENABLE: ("u",),
    MavCmd.DO_PARACHUTE: ("u",),
    MavCmd.DO_INVERTED_FLIGHT: ("u",),
    MavCmd.DO_GRIPPER: ("bb",),
    MavCmd.DO_AUTOTUNE_ENABLE: ("u",),
    MavCmd.NAV_SET_YAW_SPEED: ("ffb",),
    MavCmd.DO_SET_RESUME_REPEAT_DIST: ("u",),
    MavCmd.DO_SPRAYER: ("u",),
    MavCmd.DO_SEND_SCRIPT_MESSAGE: ("ufff",),
    MavCmd.DO_AUX_FUNCTION: ("ub",),
    MavCmd.DO_GUIDED_LIMITS: ("ufff",),
    MavCmd.DO_ENGINE_CONTROL: ("??kb",),
    MavCmd.SET_CAMERA_ZOOM: ("bf",),
    MavCmd.SET_CAMERA_FOCUS: ("bf",),
    MavCmd.SET_CAMERA_SOURCE: ("bbb",),
    MavCmd.JUMP_TAG: ("u",),
    MavCmd.DO_JUMP_TAG: ("us",),
    MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: ("isiib-b",),
    MavCmd.IMAGE_START_CAPTURE: ("bfuu",),
    MavCmd.IMAGE_STOP_CAPTURE: ("u",),
    MavCmd.VIDEO_START_CAPTURE: ("b",),
    MavCmd.VIDEO_STOP_CAPTURE: ("b",),
    MavCmd.DO_VTOL_TRANSITION: ("b",),
    MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION: ("u",),
    MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION: ("u",),
    MavCmd.NAV_FENCE_CIRCLE_INCLUSION: ("f", "u"),  # "u" on firmware before 4.5
    MavCmd.NAV_FENCE_CIRCLE_EXCLUSION: ("f", "u"),
    MavCmd.DO_WINCH: ("bbff",),
    MavCmd.NAV_SCRIPT_TIME: ("bbhhss",),
    MavCmd.NAV_ATTITUDE_TIME: ("usiss",),
}

_PX4_FORMS: dict[int, str] = {
    MavCmd.NAV_WAYPOINT: "ff-y",
    MavCmd.NAV_LOITER_UNLIM: "--fy",
    MavCmd.NAV_LOITER_TIME: "f?f?",
    MavCmd.NAV_LAND: "-u-y",
    MavCmd.NAV_TAKEOFF: "---y",
    MavCmd.NAV_LOITER_TO_ALT: "?f-?",
    MavCmd.NAV_VTOL_TAKEOFF: "---y",
    MavCmd.NAV_VTOL_LAND: "---y",
    MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION: "u",
    MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION: "u",
    MavCmd.NAV_FENCE_CIRCLE_INCLUSION: "f",
    MavCmd.NAV_FENCE_CIRCLE_EXCLUSION: "f",
}

_PX4_JUMP_FORMS = "sUfffff"

_PX4_OTHER_FORMS = "fffffff"

_INTEGERS = {"b": (0, 0xFF), "u": (0, 0xFFFF), "i": (-0x80, 0x7F), "s": (-0x8000, 0x7FFF)}


def _stored_values(item: MissionItem, field: str, storage: ItemStorage) -> Iterator[float]:
    """Yield the values that a field may have when the item is read back."""
    field_index, value = FIELDS.index(field), getattr(item, field)
    forms: list[str] = []
    if storage in (ItemStorage.ARDUPILOT, ItemStorage.ANY):
        forms += _ARDUPILOT_FORMS.get(item.command, ("",))
    if storage in (ItemStorage.PX4, ItemStorage.ANY):
        forms.append(_px4_form(item))
    for form in forms:
        letter = form[field_index] if field_index < len(form) else "-"
        stored = _stored_as(letter, value)
        if stored is not None:
            yield stored


def _px4_form(item: MissionItem) -> str:
    if item.frame == MavFrame.MISSION:
        return _PX4_JUMP_FORMS if item.command == MavCmd.DO_JUMP else _PX4_OTHER_FORMS
    return _PX4_FORMS.get(item.command, "")


def _stored_as(letter: str, value: float) -> float | None:
    """Return the number that an autopilot sends back after it has stored ``value`` in the form ``letter``.

    Returns None if the autopilot cannot store the value.
    """
    if letter == "-":  # not stored
        return 0.0
    if letter == "2":  # always 2
        return 2.0
    if letter == "?":  # true if above 0
        return 1.0 if value > 0 else 0.0
    if letter == "g":  # only the sign
        return -1.0 if value < 0 else 1.0
    if not math.isfinite(value):
        return math.nan
    if letter in _INTEGERS:  # an integer with a range
        low, high = _INTEGERS[letter]
        # C does not define the result of this conversion for a value that is out of range.
        return float(math.trunc(value)) if low <= math.trunc(value) <= high else None
    return _finite_stored_as(letter, value)


def _finite_stored_as(letter: str, value: float) -> float | None:
    """Like `_stored_as`, for a finite value that is not stored as an integer with a range."""
    whole = math.trunc(value)
    stored: float | None = None
    if letter == "f":  # 32-bit float, whose maximum is 3.4e38
        if abs(value) <= 3.4028234663852886e38:
            (stored,) = struct.unpack("<f", struct.pack("<f", value))
    elif letter == "c":  # limited to 0..255
        stored = float(max(0, min(255, whole)))
    elif letter == "U":  # 16 bits, which wrap around
        stored = float(whole & 0xFFFF)
    elif letter == "y":  # heading from 0 to 360
        stored = value % 360.0
    elif letter == "k":  # whole centimetres
        stored = math.trunc(value * 100.0) / 100.0
    elif letter == "h" and abs(value) <= 65_504:  # 16-bit float, whose maximum is 65504
        (stored,) = struct.unpack("<e", struct.pack("<e", value))
    elif letter == "n":  # at most 255; below 1 in steps of 1/256
        stored = math.trunc(value * 256.0) / 256.0 if 0 < value < 1 else float(min(255, whole))
    elif letter == "r":  # whole metres
        stored = float(whole)
    elif letter == "R":  # one byte: whole metres up to 255 m, tens of metres above
        radius = math.trunc(abs(value)) if abs(value) <= 255 else 10 * min(255, math.trunc(abs(value) / 10))
        stored = math.copysign(radius, value)
    return stored


ALTITUDE_TOLERANCE_M = 0.011  # ArduPilot stores altitudes in whole centimetres.

HEADING_TOLERANCE_DEG = 0.001  # PX4 stores radians.

_HEADING_IS_PARAM4 = frozenset(
    {
        MavCmd.NAV_WAYPOINT,
        MavCmd.NAV_LOITER_UNLIM,
        MavCmd.NAV_LAND,
        MavCmd.NAV_TAKEOFF,
        MavCmd.NAV_VTOL_TAKEOFF,
        MavCmd.NAV_VTOL_LAND,
    }
)


def plan_differences(
    expected: Sequence[MissionItem], actual: Sequence[MissionItem], storage: ItemStorage = ItemStorage.ANY
) -> tuple[str, ...]:
    """Describe each difference: ``"item 3 (NAV_WAYPOINT): z is 20.0 instead of 30.0"``. Empty for equal plans."""
    texts = [f"there are {len(actual)} items instead of {len(expected)}"] if len(expected) != len(actual) else []
    for index, (item, actual_item) in enumerate(zip(expected, actual)):  # noqa: B905 - lengths may differ, see above
        texts += [f"item {index} ({item.name}): {text}" for text in item_differences(item, actual_item, storage)]
    return tuple(texts)


def changed_items(
    expected: Sequence[MissionItem], actual: Sequence[MissionItem], storage: ItemStorage = ItemStorage.WIRE
) -> tuple[int, ...]:
    """Return the indices of the expected items that are missing or different in ``actual``.

    Further items at the end of ``actual`` are not reported. Differences that ``storage`` causes are ignored.
    """
    common = min(len(expected), len(actual))
    changed = [index for index in range(common) if item_differences(expected[index], actual[index], storage)]
    return (*changed, *range(common, len(expected)))


def item_differences(
    expected: MissionItem,
    actual: MissionItem,
    storage: ItemStorage = ItemStorage.ANY,
    *,
    single_precision: bool = False,
) -> tuple[str, ...]:
    """Describe each field that differs: ``"z is 20.0 instead of 30.0"``.

    With ``single_precision``, places may differ by the rounding to 32-bit floats in MISSION_ITEM, up to 1.7 m.
    """
    if expected.command != actual.command:
        return (f"the command is {actual.name} instead of {expected.name}",)
    return tuple(
        f"{field} is {getattr(actual, field)!r} instead of {getattr(expected, field)!r}"
        for field in _different_fields(expected, actual, storage, single_precision)
    )


def _different_fields(
    expected: MissionItem, actual: MissionItem, storage: ItemStorage, single_precision: bool
) -> Iterator[str]:
    if not _frames_match(expected, actual, storage):
        yield "frame"
    for field in ("param1", "param2", "param3", "param4"):
        if not _same_number(expected, actual, field, storage):
            yield field
    for field in ("x", "y"):
        if not _same_place(expected, actual, field, storage, single_precision):
            yield field
    if not _same_altitude(expected, actual, storage):
        yield "z"
    if bool(expected.autocontinue) != bool(actual.autocontinue) and not _drops_autocontinue(actual, storage):
        yield "autocontinue"


def _drops_autocontinue(actual: MissionItem, storage: ItemStorage) -> bool:
    # ArduPilot reports autocontinue as 1 for all mission items, and as 0 for all fence and rally items.
    if actual.command in FENCE_COMMANDS | RALLY_COMMANDS:
        return True
    return storage in (ItemStorage.ARDUPILOT, ItemStorage.ANY) and actual.autocontinue


def _frames_match(expected: MissionItem, actual: MissionItem, storage: ItemStorage) -> bool:
    expected_frame, actual_frame = canonical_frame(expected.frame), canonical_frame(actual.frame)
    if expected_frame == actual_frame:
        return True
    # Autopilots do not use the altitudes in a fence, so the altitude reference of the frame does not matter.
    if expected.command in FENCE_COMMANDS and {expected.frame, actual.frame} <= GLOBAL_FRAMES:
        return True
    # ArduPilot returns the frame GLOBAL for items without a place, and for the frame MISSION.
    if storage not in (ItemStorage.ARDUPILOT, ItemStorage.ANY) or actual_frame != MavFrame.GLOBAL:
        return False
    return not has_place(expected.command) or expected_frame == MavFrame.MISSION


def _same_number(expected: MissionItem, actual: MissionItem, field: str, storage: ItemStorage) -> bool:
    value, actual_value = getattr(expected, field), getattr(actual, field)
    if _close(value, actual_value):
        return True
    is_heading = field == "param4" and expected.command in _HEADING_IS_PARAM4
    if is_heading and storage in (ItemStorage.PX4, ItemStorage.ANY):
        # The headings 359.9995° and 0° are close to each other.
        difference_deg = abs(value - actual_value) % 360.0
        if min(difference_deg, 360.0 - difference_deg) <= HEADING_TOLERANCE_DEG:
            return True
    return any(_close(stored, actual_value) for stored in _stored_values(expected, field, storage))


def _same_place(
    expected: MissionItem, actual: MissionItem, field: str, storage: ItemStorage, single_precision: bool
) -> bool:
    value, actual_value = getattr(expected, field), getattr(actual, field)
    scale = xy_scale(expected.command, expected.frame)
    if scale != 1:
        tolerance = 1.0  # Rounding may change x or y by one unit.
        if single_precision:
            tolerance += _float_step(value / scale) * scale
        return bool(abs(value - actual_value) <= tolerance)
    if has_place(expected.command):  # In the frame MISSION, x and y are integers that are not scaled.
        return bool(value == actual_value)
    stored_values = _stored_values(expected, field, storage)
    return value == actual_value or any(_close(stored, actual_value) for stored in stored_values)


def _float_step(value: float) -> float:
    """Return the distance between a 32-bit float and its neighbour."""
    significant_bits = 24
    _, exponent = math.frexp(value)
    return math.ldexp(1.0, exponent - significant_bits)


def _same_altitude(expected: MissionItem, actual: MissionItem, storage: ItemStorage) -> bool:
    # Autopilots use no altitudes of a fence, not even that of a return point: ArduPilot does not store it
    # (MissionItemProtocol_Fence.cpp), PX4 ignores it (geofence.cpp).
    if expected.command in FENCE_COMMANDS or _close(expected.z, actual.z):
        return True
    if not has_place(expected.command):
        return any(_close(stored, actual.z) for stored in _stored_values(expected, "z", storage))
    if storage not in (ItemStorage.ARDUPILOT, ItemStorage.ANY):
        return False  # Only ArduPilot rounds altitudes.
    if expected.command in RALLY_COMMANDS:  # ArduPilot stores whole metres.
        return math.isfinite(expected.z) and _close(math.trunc(expected.z), actual.z)
    return abs(expected.z - actual.z) <= ALTITUDE_TOLERANCE_M


def _close(left: float, right: float) -> bool:
    """Compare two numbers as 32-bit floats, with a margin for rounding. NaN equals NaN."""
    are_both_nan = left != left and right != right
    if left == right or are_both_nan:
        return True
    return abs(left - right) <= max(1e-6 * max(abs(left), abs(right)), 1e-9)
