"""The status texts of a simulated PX4: which end in a tab, and which links get them."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.mavlink.messages import Statustext
    from aerokit.sim.channel import Channel
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["NO_STATION", "OUTSIDE", "TOO_FAR", "TOO_HIGH", "TextLinks", "on_the_wire"]

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


_STATION_TIMEOUT_S = 2.5
_MAX_WAITING, _MAX_AGE_S = 8, 5.0


class TextLinks:
    """Sends texts to links on which a ground station is heard (streams/STATUSTEXT.hpp); others wait a while for one."""

    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4
        self._station_at: dict[Channel, float] = {}
        self._waiting: dict[Channel, deque[tuple[float, list[Statustext]]]] = {}

    def hear_station(self, channel: Channel) -> None:
        """A HEARTBEAT of a ground station came in; what was said just before is sent now."""
        self._station_at[channel] = self._px4.now
        for said_at, chunks in self._waiting.pop(channel, ()):
            if self._px4.now - said_at < _MAX_AGE_S:
                self._send(chunks, channel)

    def tell(self, chunks: list[Statustext]) -> None:
        """Send a text, where somebody is to read it."""
        now = self._px4.now
        for channel in self._px4.channels:
            if now - self._station_at.get(channel, -math.inf) <= _STATION_TIMEOUT_S:
                self._send(chunks, channel)
            else:
                self._waiting.setdefault(channel, deque(maxlen=_MAX_WAITING)).append((now, chunks))

    def _send(self, chunks: list[Statustext], channel: Channel) -> None:
        for chunk in chunks:
            self._px4.send(chunk, channel)


def on_the_wire(text: str) -> str:
    """The text as STATUSTEXT carries it."""
    return text if text.startswith(_WITHOUT_TAB) else text + "\t"
