"""Meanings of numbers in ArduPilot logs: mode reasons, and errors of subsystems.

The meanings are from ``ModeReason.h`` and ``AP_Logger.h`` of ArduPilot 4.7.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from aerokit.autopilots.failsafes import GCS_FAILSAFE_ACTIONS

MODE_REASONS: Mapping[int | None, tuple[str, str | None, bool | None]] = {
    1: ("radio control", None, False),
    2: ("ground station", None, False),
    3: ("radio failsafe", "radio", True),
    4: ("battery failsafe", "battery", True),
    5: ("ground station failsafe", "ground station", True),
    6: ("estimator failsafe", "estimator", True),
    7: ("GPS glitch", "gps", True),
    8: ("end of the mission", None, True),
    9: ("pilot's throttle ended the landing", None, False),
    10: ("fence breach", "fence", True),
    11: ("terrain failsafe", "terrain", True),
    12: ("BRAKE timed out", None, True),
    13: ("flip complete", None, True),
    14: ("avoidance", "avoidance", True),
    15: ("end of the avoidance", None, True),
    16: ("throw complete", None, True),
    17: ("termination", "termination", True),
    18: ("toy mode", None, False),
    19: ("crash failsafe", "crash", True),
    20: ("soaring: motor runs", None, True),
    21: ("soaring: thermal found", None, True),
    22: ("soaring: thermal lost", None, True),
    23: ("transition failed", "transition", True),
    24: ("take-off failed", "take-off", True),
    25: ("failsafe", "general", True),
    26: ("initialised", None, True),
    27: ("surface reached", None, True),
    28: ("bad depth", "depth", True),
    29: ("leak failsafe", "leak", True),
    30: ("servo test", None, None),
    31: ("start-up", None, True),
    32: ("script", None, None),
    33: ("mode not available", None, True),
    34: ("autorotation", None, True),
    35: ("end of the autorotation", None, True),
    36: ("soaring: too high", None, True),
    37: ("soaring: too low", None, True),
    38: ("soaring: drifted too far", None, True),
    39: ("return complete, landing", None, True),
    40: ("return complete, landing", None, True),
    41: ("mission command", None, True),
    42: ("RC telemetry", None, False),
    43: ("back to the mode before the fence breach", None, True),
    44: ("QRTL instead of RTL", None, True),
    45: ("end of AUTO RTL", None, True),
    46: ("height for landing reached", None, True),
    47: ("loiter height in a VTOL mode", None, True),
    48: ("end of the radio failsafe", None, True),
    49: ("QLAND instead of RTL", None, True),
    50: ("dead-reckoning failsafe", "estimator", True),
    51: ("failsafe of the TAKEOFF mode", "take-off", True),
    52: ("DDS command", None, False),
    53: ("auxiliary switch", None, False),
    54: ("automatic landing", None, True),
    55: ("fence re-enabled", None, True),
}
"""Maps a reason's number to its description, the kind of failsafe (or None), and True if the autopilot itself changed
the mode (None if unknown)."""

ERRORS: Mapping[int, tuple[str, str]] = {
    1: ("general", "main loop"),
    2: ("radio", "RC receiver"),
    3: ("compass", "compass"),
    5: ("radio", "radio failsafe"),
    6: ("battery", "battery failsafe"),
    8: ("ground station", "ground station failsafe"),
    9: ("fence", "fence"),
    10: ("mode", "mode change"),
    11: ("gps", "GPS"),
    12: ("crash", "crash check"),
    13: ("mode", "flip"),
    15: ("general", "parachute"),
    16: ("estimator", "estimator check"),
    17: ("estimator", "estimator failsafe"),
    18: ("general", "barometer"),
    19: ("general", "processor"),
    20: ("avoidance", "ADS-B avoidance"),
    21: ("terrain", "terrain data"),
    22: ("general", "navigation"),
    23: ("terrain", "terrain failsafe"),
    24: ("estimator", "switch to another estimator"),
    25: ("thrust", "thrust loss"),
    26: ("general", "sensors"),
    27: ("leak", "leak"),
    28: ("general", "pilot's input"),
    29: ("vibration", "vibration failsafe"),
    30: ("general", "internal error"),
    31: ("estimator", "dead reckoning"),
}
"""Maps the number of a subsystem to the kind of failsafe and a description of the error."""

# Maps (subsystem, error code) of ArduPilot's ERR records to details of the error.
_ERROR_DETAILS: Mapping[tuple[int, int], str] = {
    (2, 2): "late frames",
    (11, 2): "glitch",
    (12, 1): "crash into the ground",
    (12, 2): "lost control",
    (16, 2): "variances too high",
    (18, 2): "glitch",
}

# Subsystems whose error code has a meaning of its own.
_MODE_CHANGE = 10  # the code is the number of the refused mode
_ESTIMATOR_SWITCH = 24  # the code is the number of the new estimator
_FENCE = 9  # the code has the bits of AC_FENCE_TYPE
_FENCE_TYPES = {
    1: "above the maximum altitude",
    2: "outside the circle",
    4: "outside a polygon",
    8: "below the minimum altitude",
}
_CONTROL_CHARACTERS = re.compile(
    r"(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]"  # CSI sequences of ECMA-48, such as colours
    r"|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)"  # OSC sequences, such as window titles
    r"|[\x00-\x08\x0b-\x1f\x7f-\x9f]"  # other control characters, except tab and newline
)


def error_text(subsystem: int, code: int, text: str) -> str:
    """Return a description of ArduPilot's log message ERR."""
    if subsystem == _MODE_CHANGE:
        return f"mode {code} was refused"
    if subsystem == _ESTIMATOR_SWITCH:
        return f"{text}: number {code}"
    if subsystem == _FENCE:
        detail: str | None = " and ".join(words for bit, words in _FENCE_TYPES.items() if code & bit)
    else:
        detail = _ERROR_DETAILS.get((subsystem, code))
    return f"{text}: {detail}" if detail else text


def clean_text(text: str) -> str:
    """Remove terminal control sequences and surrounding white space."""
    # PX4 ends status texts with a tab.
    return _CONTROL_CHARACTERS.sub("", text).strip()


def ardupilot_system_id(parameters: Mapping[str, float]) -> int:
    """Return the system id in the parameters; ArduPilot's default of 1 if it is absent or invalid."""
    system_id = parameters.get("MAV_SYSID", parameters.get("SYSID_THISMAV", 1))  # renamed in 4.7
    return int(system_id) if 1 <= system_id <= 255 else 1


def skipped_rows_note(count: int) -> str:
    return f"{count} damaged row{' was' if count == 1 else 's were'} skipped: impossible time"


_STOPS = "stops the motors"
_COPTER_BATTERY = (
    "none",
    "LAND",
    "RTL",
    "SMART_RTL or RTL",
    "SMART_RTL or LAND",
    _STOPS,
    "landing sequence or RTL",
    "BRAKE or LAND",
)
_ROVER_BATTERY = ("none", "RTL", "HOLD", "SMART_RTL", "SMART_RTL or HOLD", _STOPS, "LOITER or HOLD")
_PLANE_BATTERY = ("none", "RTL", "LAND", _STOPS, "QLAND", "parachute", "LOITER, then QLAND", "AUTOLAND or RTL")
_SUB_BATTERY = ("none", "", "disarms", "SURFACE")
_BATTERY = ("BATT_FS_LOW_ACT", "BATT_FS_CRT_ACT")
# Maps firmwares and failsafe parameters to descriptions of the values 0, 1, 2, … Sources: AP_BattMonitor_Params.cpp,
# AC_Fence.cpp and Parameters.cpp of ArduPilot 4.7, commander and navigator parameters of PX4 1.17.
_ACTIONS: dict[str, dict[str, tuple[str, ...]]] = {
    "ArduCopter": {
        **dict.fromkeys(_BATTERY, _COPTER_BATTERY),
        "FENCE_ACTION": (
            "report",
            "RTL or LAND",
            "LAND",
            "SMART_RTL, RTL or LAND",
            "BRAKE or LAND",
            "SMART_RTL or LAND",
        ),
        "FS_EKF_ACTION": ("report", "LAND", "ALT_HOLD", "LAND from all modes"),
        "FS_THR_ENABLE": (
            "off",
            "RTL",
            "RTL",
            "LAND",
            "SMART_RTL or RTL",
            "SMART_RTL or LAND",
            "landing sequence or RTL",
            "BRAKE or LAND",
        ),
    },
    "Rover": {
        **dict.fromkeys(_BATTERY, _ROVER_BATTERY),
        "FENCE_ACTION": (
            "report",
            "RTL or HOLD",
            "HOLD",
            "SMART_RTL, RTL or HOLD",
            "SMART_RTL or HOLD",
            _STOPS,
            "LOITER or HOLD",
        ),
    },
    "ArduPlane": {
        **dict.fromkeys(_BATTERY, _PLANE_BATTERY),
        "FENCE_ACTION": ("report", "RTL", "", "", "", "", "GUIDED", "GUIDED, pilot's throttle", "AUTOLAND or RTL"),
    },
    "ArduSub": dict.fromkeys(_BATTERY, _SUB_BATTERY),
    "PX4": {
        "COM_LOW_BAT_ACT": ("warning", "", "Land", "Return if critical, Land in an emergency"),
        "GF_ACTION": ("none", "warning", "Hold", "Return", _STOPS, "Land"),
        "NAV_RCL_ACT": ("none", "Hold", "Return", "Land", "", _STOPS, "disarms"),
    },
}


def failsafe_action(vehicle: str, parameter: str, value: float) -> str:
    """Return the meaning of a failsafe parameter's value; empty if unknown."""
    firmware = next((firmware for firmware in _ACTIONS if firmware in vehicle), "")
    gcs_meanings = GCS_FAILSAFE_ACTIONS.get(firmware, {}).get(parameter)
    if gcs_meanings is not None:
        return gcs_meanings.get(value, "")
    meanings = _ACTIONS.get(firmware, {}).get(parameter, ())
    is_known = value in range(len(meanings))  # also False for a fraction
    return meanings[int(value)] if is_known else ""
