"""Values of a calibration (poses, steps, results), and PX4's ``[cal]`` texts."""

from __future__ import annotations

import re
from enum import Enum

from aerokit._internal.values import Snapshot

__all__ = ["CalibrationPose", "CalibrationReport", "CalibrationResult", "CalibrationStep", "CompassFit", "parse_report"]


class CalibrationPose(Enum):
    """Pose in which a person has to place the vehicle."""

    LEVEL = "level"
    LEFT = "on its left side"
    RIGHT = "on its right side"
    NOSE_DOWN = "nose down"
    NOSE_UP = "nose up"
    BACK = "on its back"


class CompassFit(Snapshot):
    """Quality of the calibration of one compass.

    ``fitness_mgauss`` is the root mean square of the residuals of the samples; smaller is better. ``offsets_mgauss``
    are the offsets along x, y and z.
    """

    compass: int
    fitness_mgauss: float
    offsets_mgauss: tuple[float, float, float]


class CalibrationResult(Snapshot):
    """The result of a successful calibration.

    ``compasses`` is empty if the vehicle reports no fitness. If ``reboot_due`` is true, the vehicle must reboot before
    it uses the result or can be armed. ``texts`` are the vehicle's status texts since the start.
    """

    compasses: tuple[CompassFit, ...] = ()
    reboot_due: bool = False
    texts: tuple[str, ...] = ()


class CalibrationStep(Snapshot):
    """The state of a calibration, for the person at the vehicle.

    Attributes:
        sensor: name of the method of ``vehicle.calibrate``, such as ``"compass"``.
        progress: 0 to 1; None if the vehicle reports none.
        instruction: what to do now.
        pose: the pose to take now; None if no pose is needed.
        remaining: the poses that are still needed, including ``pose``; PX4 accepts them in any order.
        needs_confirmation: the calibration waits until your program continues its loop, which confirms that the
            instruction was followed.
        result: the result of the calibration in the last step; None in all others.
    """

    sensor: str
    progress: float | None
    instruction: str
    pose: CalibrationPose | None = None
    remaining: tuple[CalibrationPose, ...] = ()
    needs_confirmation: bool = False
    result: CalibrationResult | None = None


# PX4 names the side that points down: "down" is the bottom, "up" the top, "back" the tail (calibration_routines.cpp,
# detect_orientation_str).
SIDES = {
    "back": CalibrationPose.NOSE_UP,
    "front": CalibrationPose.NOSE_DOWN,
    "left": CalibrationPose.LEFT,
    "right": CalibrationPose.RIGHT,
    "up": CalibrationPose.BACK,
    "down": CalibrationPose.LEVEL,
}
_SIDE = "|".join(SIDES)
# Formats of PX4's texts, from calibration_messages.h and calibration_routines.cpp.
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
    """One ``[cal]`` text of PX4.

    ``kind`` is the key of ``_FORMATS`` whose pattern matches, or ``"text"`` if none does. ``text`` is the text without
    its prefix ``[cal]``.
    """

    kind: str
    text: str
    progress: float | None = None
    poses: tuple[CalibrationPose, ...] = ()


def parse_report(status_text: str) -> CalibrationReport | None:
    """Parse a status text of PX4; return None if it is not about a calibration."""
    if not status_text.startswith("[cal] "):
        return None
    text = status_text[len("[cal] ") :].strip()
    for kind, pattern in _FORMATS.items():
        if match := re.fullmatch(pattern, text):
            groups = match.groupdict()
            progress = int(groups["percent"]) / 100 if "percent" in groups else None
            if progress is not None and progress > 1:  # The text is damaged.
                return None
            poses = tuple(SIDES[side] for side in groups.get("sides", "").split())
            return CalibrationReport(kind, text, progress, poses)
    return CalibrationReport("text", text)
