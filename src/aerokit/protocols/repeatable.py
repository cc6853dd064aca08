"""Which commands may be sent a second time, when their answer may have been lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["ATTEMPTS", "SENT_ONCE", "attempts_of"]

ATTEMPTS = 4
"""How often a command is sent that does the same when it is carried out twice."""
_ARM, _RELATIVE, _STEP = (0, 1.0), (3, 1.0), (0, 0.0)

SENT_ONCE: Mapping[int, tuple[str, tuple[int, float] | None]] = {
    MavCmd.COMPONENT_ARM_DISARM: ("arms a vehicle that a pilot has disarmed since", _ARM),
    MavCmd.CONDITION_YAW: ("turns on by the same angle", _RELATIVE),
    MavCmd.DO_REPEAT_RELAY: ("cycles the relay again", None),
    MavCmd.DO_REPEAT_SERVO: ("cycles the servo again", None),
    MavCmd.DO_DIGICAM_CONTROL: ("takes another picture, zooms another step", None),
    MavCmd.DO_SET_CAM_TRIGG_DIST: ("may take another picture at once", None),
    MavCmd.DO_MOTOR_TEST: ("spins the motor again", None),
    MavCmd.ACTUATOR_TEST: ("moves the actuator again", None),
    MavCmd.DO_AUTOTUNE_ENABLE: ("starts tuning anew", None),
    MavCmd.DO_SEND_SCRIPT_MESSAGE: ("gives the script the message again", None),
    MavCmd.DO_AUX_FUNCTION: ("carries out the function again", None),
    MavCmd.PREFLIGHT_CALIBRATION: ("calibrates again", None),
    MavCmd.PREFLIGHT_STORAGE: ("writes, reads or resets all parameters again", None),
    MavCmd.PREFLIGHT_REBOOT_SHUTDOWN: ("reboots again", None),
    MavCmd.START_RX_PAIR: ("starts pairing again", None),
    MavCmd.STORAGE_FORMAT: ("erases what was stored since", None),
    MavCmd.SET_CAMERA_ZOOM: ("zooms another step", _STEP),
    MavCmd.SET_CAMERA_FOCUS: ("focuses another step", _STEP),
    MavCmd.IMAGE_START_CAPTURE: ("takes another picture, or another series", None),
    MavCmd.VIDEO_START_CAPTURE: ("starts another file", None),
    MavCmd.LOGGING_START: ("starts another log", None),
    MavCmd.DO_START_MAG_CAL: ("calibrates again", None),
    MavCmd.FIXED_MAG_CAL_YAW: ("calibrates again", None),
    MavCmd.DO_WINCH: ("pays out the same length again", None),
    MavCmd.FLASH_BOOTLOADER: ("writes the bootloader again", None),
    MavCmd.PAYLOAD_CONTROL_DEPLOY: ("drops another payload", None),
}
"""MAV_CMD → what happens when it is carried out twice, and the parameter (its index, its value) that makes it so, if
that is not all of them. docs/reliability.md has the same table."""


def attempts_of(command: int, params: Sequence[float]) -> int:
    """How often it may be sent while it is not answered: once if a second time would do it again."""
    if command not in SENT_ONCE:
        return ATTEMPTS
    _, where = SENT_ONCE[command]
    return 1 if where is None or params[where[0]] == where[1] else ATTEMPTS
