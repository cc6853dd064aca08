"""Status texts of a simulated PX4, which links get them, and the events that go with them.

https://mavlink.io/en/services/events.html. Ids and log levels are those that a real one sent with the same texts.
Not simulated: events without a text, the health report of every component, and REQUEST_EVENT.
"""

from __future__ import annotations

import math
import re
import struct
from collections import deque

from aerokit.mavlink.messages import CurrentEventSequence, Event, Statustext
from aerokit.sim.channel import Channel
from aerokit.sim.px4.host import Px4Host

_FIRST_SEQUENCE = 65526
_INFO_LEVELS = 102
_ARMED_BY = {"external command": 4, "mission start": 5}
_DISARMED_BY = {"external command": 4, "landing": 6, "auto preflight disarming": 7}
_PLAIN = {
    "Takeoff detected": 21054825,
    "Landing detected": 26622124,
    "Returning to launch": 20262116,
    "RTL: land at destination": 16962474,
}
_ARMED, _DISARMED, _RETURN = 26266355, 32794487, 22161044
_RETURN_TEXT = re.compile(r"RTL: start return at (-?\d+) m \((-?\d+) m above destination\)")


class Events:
    """Counts them; the numbers begin ten before the overflow, so that clients learn about that."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self._next = _FIRST_SEQUENCE

    def current(self) -> CurrentEventSequence:
        """CURRENT_EVENT_SEQUENCE."""
        return CurrentEventSequence((self._next - 1) & 0xFFFF, 0)

    def tell(self, text: str) -> None:
        """Send the event of a status text, if it has one."""
        known = _event_of(text)
        if known is None:
            return
        (number, arguments), px4 = known, self._px4
        px4.send(Event(0, 0, number, px4.time_boot_ms, self._next, _INFO_LEVELS, arguments))
        self._next = (self._next + 1) & 0xFFFF


def _event_of(text: str) -> tuple[int, bytes] | None:
    if text in _PLAIN:
        return _PLAIN[text], b""
    for start, number, causes in (
        ("Armed by ", _ARMED, _ARMED_BY),
        ("Disarmed by ", _DISARMED, _DISARMED_BY),
    ):
        if text.startswith(start):
            return number, bytes([causes.get(text[len(start) :], 0)])
    found = _RETURN_TEXT.fullmatch(text)
    return None if found is None else (_RETURN, struct.pack("<ii", int(found[1]), int(found[2])))


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

    def __init__(self, px4: Px4Host) -> None:
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
    return text if text.startswith(_WITHOUT_TAB) else text + "\t"
