"""Status texts about failsafes and problems in flight."""

from __future__ import annotations

import re

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
        return None
    return next((kind for pattern, kind in _TEXT_PATTERNS if pattern.search(text)), None)
