"""The events of a simulated PX4: EVENT beside the status texts, and CURRENT_EVENT_SEQUENCE for who has missed one.

https://mavlink.io/en/services/events.html. Ids and log levels are those that a real one sent with the same texts.
Not simulated: events without a text, the health report of every component, and REQUEST_EVENT.
"""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING

from aerokit.mavlink.messages import CurrentEventSequence, Event

if TYPE_CHECKING:
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["Events"]

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

    def __init__(self, px4: SimulatedPx4) -> None:
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
