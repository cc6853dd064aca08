"""Which status texts of a PX4 end in a tab: all but those of the health checks, the geofence and a few more."""

from __future__ import annotations

__all__ = ["NO_STATION", "OUTSIDE", "TOO_FAR", "TOO_HIGH", "on_the_wire"]

NO_STATION = "Preflight Fail: No connection to the GCS"
TOO_FAR = "Geofence: exceeding maximum distance to Home"
TOO_HIGH = "Geofence: exceeding maximum altitude above Home"
OUTSIDE = "Geofence: approaching or outside geofence"

_WITHOUT_TAB = (
    "Preflight Fail: ",
    "Geofence: ",
    "Figure 8 command",
    "Assuming vehicle is facing",
    "Mag quick calibration",
    "[cal] ",
    "MAVLink signing",
)


def on_the_wire(text: str) -> str:
    """The text as STATUSTEXT carries it."""
    return text if text.startswith(_WITHOUT_TAB) else text + "\t"
