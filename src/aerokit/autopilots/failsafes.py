"""Failsafes: texts that report them, and the action of the ground station failsafe according to the parameters."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

_OFF = "continues: the failsafe is off"
_RETURN, _SMART, _HOLD, _TERMINATE = "returns to launch", "returns on its own track", "holds", "stops its motors"
GCS_FAILSAFE_ACTIONS: Mapping[str, Mapping[str, Mapping[float, str]]] = {
    "ArduCopter": {
        "FS_GCS_ENABLE": {
            0: _OFF,
            1: _RETURN,
            2: _RETURN,  # since 4.0; before, a mission continued (ArduCopter/events.cpp, failsafe_gcs_on_event)
            3: f"{_SMART}, otherwise {_RETURN}",
            4: f"{_SMART}, otherwise lands",
            5: "lands",
            6: f"flies its landing sequence, otherwise {_RETURN}",
            7: "brakes, otherwise lands",
        }
    },
    "ArduPlane": {
        "FS_GCS_ENABL": {0: _OFF},
        "FS_LONG_ACTN": {
            0: f"continues in AUTO and GUIDED, otherwise {_RETURN}",
            1: _RETURN,
            2: "glides",
            3: "opens its parachute",
            4: "flies its mission",
            5: f"lands (AUTOLAND), otherwise {_RETURN}",
        },
    },
    "Rover": {
        "FS_GCS_ENABLE": {0: _OFF},
        "FS_ACTION": {
            0: "continues",
            1: _RETURN,
            2: _HOLD,
            3: f"{_SMART}, otherwise {_RETURN}",
            4: f"{_SMART}, otherwise {_HOLD}",
            5: _TERMINATE,
            6: _HOLD,
        },
    },
    "ArduSub": {"FS_GCS_ENABLE": {0: _OFF, 1: "continues", 2: _TERMINATE, 3: "holds its depth", 4: "surfaces"}},
    "PX4": {"NAV_DLL_ACT": {0: _OFF, 1: _HOLD, 2: _RETURN, 3: "lands", 5: _TERMINATE, 6: _TERMINATE}},
}
"""Actions of the ground station failsafe: firmware → parameter → value → action.

The first parameter of a firmware decides if its value is listed; otherwise the next parameter decides. Sources:
Parameters.cpp of ArduPilot's firmwares, navigator parameters of PX4.
"""


def gcs_failsafe(firmware: str, value_of: Callable[[str], float | None]) -> tuple[str | None, str | None]:
    """Return the name of the parameter that sets the action of the failsafe, and the action, such as ``lands``.

    The action is None if ``value_of`` does not know the parameter. Both are None if no parameter sets an action.
    """
    for name, actions in GCS_FAILSAFE_ACTIONS.get(firmware, {}).items():
        value = value_of(name)
        if value is None:
            return name, None
        if value in actions:
            return name, actions[value]
    return None, None


_NO_EVIDENCE_PATTERN = re.compile(
    r"clear|resolved|\boff$|prearm|pre-arm|preflight|^arm\b|\barming|re-?gained|recovered|restored"
    r"|compensation off|connection .*established|fence enabled|fence disabled",
    re.I,
)
_TEXT_PATTERNS: tuple[tuple[re.Pattern[str], str], ...] = tuple(
    (re.compile(pattern, re.I), kind)
    for pattern, kind in (
        (r"battery.*(failsafe|is low|critical|unhealthy|emergency)", "battery"),
        (r"low battery|(critical|emergency|dangerous).*batter", "battery"),
        (r"fence.*(breach|violat)|breach.*fence|outside.*fence", "fence"),
        (r"(radio|\brc|throttle|manual control).*(failsafe|lost)|no rc\b|(short|long) failsafe", "radio"),
        (r"gcs.*(failsafe|lost)|data ?link lost", "ground station"),
        (r"(connection|link) to ground.*lost|ground (control )?station.*lost", "ground station"),
        (r"ekf.*(failsafe|variance)|dead ?reckon|position estimate|navigation failure|estimator.*fail", "estimator"),
        (r"gps.*(glitch|lost|failsafe|spoof|jam)|gnss.*(stopped|spoof|not reliable|lost)", "gps"),
        (r"compass.*(error|fail|variance|inconsistent)", "compass"),
        (r"vibration", "vibration"),
        (r"crash|loss of control|attitude fail", "crash"),
        (r"thrust loss", "thrust"),
        (r"(motor|\besc).*fail", "motor"),
        (r"terrain data missing|failsafe.*terrain", "terrain"),
        (r"avoid.*perform", "avoidance"),
        (r"offboard.*lost|no offboard", "offboard"),
        (r"parachute.*released|terminat", "termination"),
        (r"maximum flight time", "time"),
        (r"wind.*(limit|too)", "wind"),
        (r"fail-?safe", "general"),
    )
)  # fmt: skip


def failsafe_kind(text: str) -> str | None:
    """Return the kind (such as ``"battery"``) if a text reports the beginning of a failsafe; otherwise None."""
    if _NO_EVIDENCE_PATTERN.search(text) is not None:
        return None  # The text reports for example that a failsafe ended, or that a pre-arm check fails.
    return next((kind for pattern, kind in _TEXT_PATTERNS if pattern.search(text)), None)
