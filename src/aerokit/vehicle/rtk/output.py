"""`RtcmOutput`: sends RTCM messages on one connection, each once, however many vehicles of the connection use them."""

from __future__ import annotations

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary, ref

from aerokit.protocols.rtcm import fragments

if TYPE_CHECKING:
    from aerokit.connection.connection import Connection

# Vehicles that use the same corrections pass the same message within this time. A base station repeats equal messages
# (1005, its position) after a second at the earliest.
REPEAT_WINDOW_S = 0.9
MAX_RECENT = 64


class RtcmOutput:
    """Numbers RTCM messages and sends them as GPS_RTCM_DATA, which has no target and so reaches every vehicle."""

    def __init__(self, connection: Connection) -> None:
        # A strong reference would keep the entry of the connection in the table for ever.
        self._connection = ref(connection)
        self._sequence = 0
        self._recent: dict[bytes, tuple[float, set[int]]] = {}

    def send(self, message: bytes, sender: object) -> int:
        """Send one RTCM message unless another sender has just sent it; return the number of MAVLink messages."""
        connection = self._connection()
        assert connection is not None
        now, (at, senders) = connection.now(), self._recent.get(message, (0.0, {id(sender)}))
        if id(sender) not in senders and now - at < REPEAT_WINDOW_S:
            senders.add(id(sender))
            return 0
        pieces = fragments(message, self._sequence)
        for piece in pieces:
            connection.send(piece)
        self._sequence += 1
        self._recent.pop(message, None)
        self._recent[message] = (now, {id(sender)})
        if len(self._recent) > MAX_RECENT:
            del self._recent[next(iter(self._recent))]
        return len(pieces)


_OUTPUTS: WeakKeyDictionary[Connection, RtcmOutput] = WeakKeyDictionary()


def output_of(connection: Connection) -> RtcmOutput:
    """Return the output of this connection, shared by all its vehicles."""
    if connection not in _OUTPUTS:
        _OUTPUTS[connection] = RtcmOutput(connection)
    return _OUTPUTS[connection]
