"""Mode numbers of ArduPilot's vehicles, as of 4.7, and those that only older firmware has.

From ``enum class Number`` in each vehicle's mode.h. Names are those of the ground stations and of pymavlink
(``SMART_RTL``, ``FBWA``); what AVAILABLE_MODES calls them otherwise is an alias.
"""

from __future__ import annotations

from aerokit.autopilots.modes import ModeTable

__all__ = ["BLIMP", "COPTER", "PLANE", "ROVER", "SUB", "TRACKER"]

COPTER = ModeTable(
    {
        0: "STABILIZE",
        1: "ACRO",
        2: "ALT_HOLD",
        3: "AUTO",
        4: "GUIDED",
        5: "LOITER",
        6: "RTL",
        7: "CIRCLE",
        8: "POSITION",  # until 3.1
        9: "LAND",
        10: "OF_LOITER",  # until 3.3
        11: "DRIFT",
        13: "SPORT",
        14: "FLIP",
        15: "AUTOTUNE",
        16: "POSHOLD",
        17: "BRAKE",
        18: "THROW",
        19: "AVOID_ADSB",
        20: "GUIDED_NOGPS",
        21: "SMART_RTL",
        22: "FLOWHOLD",
        23: "FOLLOW",
        24: "ZIGZAG",
        25: "SYSTEMID",
        26: "AUTOROTATE",
        27: "AUTO_RTL",
        28: "TURTLE",
        29: "RATE_ACRO",
    }
)

PLANE = ModeTable(
    {
        0: "MANUAL",
        1: "CIRCLE",
        2: "STABILIZE",
        3: "TRAINING",
        4: "ACRO",
        5: "FBWA",
        6: "FBWB",
        7: "CRUISE",
        8: "AUTOTUNE",
        10: "AUTO",
        11: "RTL",
        12: "LOITER",
        13: "TAKEOFF",
        14: "AVOID_ADSB",
        15: "GUIDED",
        16: "INITIALISING",
        17: "QSTABILIZE",
        18: "QHOVER",
        19: "QLOITER",
        20: "QLAND",
        21: "QRTL",
        22: "QAUTOTUNE",
        23: "QACRO",
        24: "THERMAL",
        25: "LOITERALTQLAND",
        26: "AUTOLAND",
    },
    {"FLY_BY_WIRE_A": "FBWA", "FLY_BY_WIRE_B": "FBWB", "LOITER_TO_QLAND": "LOITERALTQLAND"},
)

ROVER = ModeTable(
    {
        0: "MANUAL",
        1: "ACRO",
        2: "LEARNING",  # until 3.2
        3: "STEERING",
        4: "HOLD",
        5: "LOITER",
        6: "FOLLOW",
        7: "SIMPLE",
        8: "DOCK",
        9: "CIRCLE",
        10: "AUTO",
        11: "RTL",
        12: "SMART_RTL",
        15: "GUIDED",
        16: "INITIALISING",
    }
)

SUB = ModeTable(
    {
        0: "STABILIZE",
        1: "ACRO",
        2: "ALT_HOLD",
        3: "AUTO",
        4: "GUIDED",
        7: "CIRCLE",
        9: "SURFACE",
        16: "POSHOLD",
        19: "MANUAL",
        20: "MOTOR_DETECT",
        21: "SURFTRAK",
    },
    {"DEPTH_HOLD": "ALT_HOLD"},
)

BLIMP = ModeTable(
    {
        0: "LAND",
        1: "MANUAL",
        2: "VELOCITY",
        3: "LOITER",
        4: "RTL",
        5: "AUTO",
        6: "HOLD",
    }  # 5, 6: pymavlink only
)

TRACKER = ModeTable(
    {0: "MANUAL", 1: "STOP", 2: "SCAN", 3: "SERVOTEST", 4: "GUIDED", 10: "AUTO", 16: "INITIALISING"}
)
