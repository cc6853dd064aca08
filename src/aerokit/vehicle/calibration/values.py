"""Values of a calibration (poses, steps, results), and PX4's ``[cal]`` texts."""

from __future__ import annotations

import re
from enum import Enum

from aerokit._internal.values import Snapshot

__all__ = ["CalibrationPose", "CalibrationReport", "CalibrationResult", "CalibrationStep", "CompassFit", "parse_report"]


class CalibrationPose(Enum):
    """How the vehicle has to be placed."""

    LEVEL = "level"
    LEFT = "on its left side"
    RIGHT = "on its right side"
    NOSE_DOWN = "nose down"
    NOSE_UP = "nose up"
    BACK = "on its back"


class CompassFit(Snapshot):
    """How well the calibration of one compass fits its samples.

    ``fitness_mgauss`` is the root mean square of the residuals; smaller is better. ``offsets_mgauss`` are the offsets
    along x, y and z.
    """

    compass: int
    fitness_mgauss: float
    offsets_mgauss: tuple[float, float, float]


class CalibrationResult(Snapshot):
    """The result of a successful calibration.

    ``compasses`` is empty if the vehicle reports no fitness. ``reboot_due``: the vehicle uses the result, or can be
    armed, only after a reboot. ``texts`` are the vehicle's status texts since the start.
    """

    compasses: tuple[CompassFit, ...] = ()
    reboot_due: bool = False
    texts: tuple[str, ...] = ()


class CalibrationStep(Snapshot):
    """The state of a calibration, for the person at the vehicle.

    Attributes:
        sensor: name of the method: ``"compass"`` …
        progress: 0 to 1; None if the vehicle reports none.
        instruction: what to do now.
        pose: the pose that is wanted now; None if none is.
        remaining: the poses that are still wanted, in any order, including ``pose``.
        needs_confirmation: the calibration waits until your program continues its loop, which confirms that the
            instruction was followed.
        result: of the last step; None before.
    """

    sensor: str
    progress: float | None
    instruction: str
    pose: CalibrationPose | None = None
    remaining: tuple[CalibrationPose, ...] = ()
    needs_confirmation: bool = False
    result: CalibrationResult | None = None


# PX4 names the side that points down, except "up" and "down": calibration_routines.cpp, detect_orientation_str.
SIDES = {
    "back": CalibrationPose.NOSE_UP,
    "front": CalibrationPose.NOSE_DOWN,
    "left": CalibrationPose.LEFT,
    "right": CalibrationPose.RIGHT,
    "up": CalibrationPose.BACK,
    "down": CalibrationPose.LEVEL,
}
_SIDE = "|".join(SIDES)
# Formats of calibration_messages.h and calibration_routines.cpp.
_FORMATS = {
    "started": r"calibration started: 2 \w+",
    "done": r"calibration done: \w+",
    "failed": r"calibration failed: .+",
    "cancelled": r"calibration cancelled",
    "progress": r"progress <(?P<percent>\d{1,3})>",
    "pending": rf"pending:(?P<sides>( ({_SIDE}))+)",
    "detected": rf"(?P<sides>{_SIDE}) orientation detected",
    "side done": rf"(?P<sides>{_SIDE}) side done, rotate to a different side",
    "side progress": rf"(?P<sides>{_SIDE}) side calibration: progress <\d{{1,3}}>",
    "already done": rf"(?P<sides>{_SIDE}) side already completed",
}


class CalibrationReport(Snapshot):
    """One ``[cal]`` text of PX4. ``kind`` is ``"text"`` for instructions, whose ``text`` has no prefix."""

    kind: str
    text: str
    progress: float | None = None
    poses: tuple[CalibrationPose, ...] = ()


def parse_report(status_text: str) -> CalibrationReport | None:
    """Parse a status text of PX4; None if it is not about a calibration."""
    if not status_text.startswith("[cal] "):
        return None
    text = status_text[len("[cal] ") :].strip()
    for kind, pattern in _FORMATS.items():
        if match := re.fullmatch(pattern, text):
            found = match.groupdict()
            progress = int(found["percent"]) / 100 if "percent" in found else None
            poses = tuple(SIDES[side] for side in found.get("sides", "").split())
            return CalibrationReport(kind, text, progress, poses) if progress is None or progress <= 1 else None
    return CalibrationReport("text", text)
