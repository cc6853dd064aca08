"""``Rtk``: sends corrections to the vehicle's satellite receivers."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.values import Snapshot
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import ConnectionClosed
from aerokit.protocols.rtcm import fragments, message_number, rtcm_messages

if TYPE_CHECKING:
    from aerokit.connection.connection import Connection
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.rtk.ntrip import NtripClient

__all__ = ["Corrections", "Rtk"]

BANDWIDTH_WINDOW_S = 10.0
# If the program passes an equal message to another vehicle within this many seconds, the message is not sent again. A
# base station repeats its position (1005) after a second at the earliest.
REPEAT_WINDOW_S = 0.9
MAX_RECENT = 64


class _SentMessages:
    """RTCM messages that were recently sent to any vehicle of one connection."""

    def __init__(self) -> None:
        self.sequence = 0
        self.recent: dict[bytes, tuple[float, set[int]]] = {}
        """Maps each message to the time at which it was sent, and the ids of the `Rtk` objects that passed it on."""


# The vehicles of a connection share an entry, because GPS_RTCM_DATA reaches all of them. The dictionary is weak, so
# that an entry ends with its connection.
_SENT: WeakKeyDictionary[Connection, _SentMessages] = WeakKeyDictionary()


def send_rtcm(connection: Connection, message: bytes, sender: object) -> int:
    """Send one RTCM message as GPS_RTCM_DATA to every vehicle of the connection.

    Sends nothing if another sender has just sent the same message. Returns the number of MAVLink messages sent.
    """
    sent = _SENT.setdefault(connection, _SentMessages())
    now = connection.now()
    if message in sent.recent:
        sent_at, sender_ids = sent.recent[message]
        # If a sender passes a message for the second time, it is no duplicate: base stations repeat their position.
        if id(sender) not in sender_ids and now - sent_at < REPEAT_WINDOW_S:
            sender_ids.add(id(sender))
            return 0
    pieces = fragments(message, sent.sequence)
    for piece in pieces:
        connection.send(piece)
    sent.sequence += 1
    # Remove an equal message first, so that the dictionary has the newest message last and the oldest can be dropped.
    sent.recent.pop(message, None)
    sent.recent[message] = (now, {id(sender)})
    if len(sent.recent) > MAX_RECENT:
        del sent.recent[next(iter(sent.recent))]
    return len(pieces)


class Corrections(Snapshot):
    """Statistics of the corrections that were sent to the vehicle.

    ``message_number`` is the RTCM number of the last message (1005, 1077 …), None if that message was empty.
    ``messages`` and ``bytes_sent`` are totals. ``bandwidth_bytes_s`` is the mean rate over the last ten seconds.
    """

    message_number: int | None
    messages: int
    bytes_sent: int
    bandwidth_bytes_s: float


@checks_arguments
class Rtk:
    """RTCM corrections for the vehicle's satellite receivers (GPS_RTCM_DATA).

    ``vehicle.gps`` reports the effect: fix types 5 (RTK float) and 6 (RTK fixed).
    """

    def __init__(self, context: VehicleContext) -> None:
        self._session = context.session
        self._corrections: StateCell[Corrections] = StateCell(
            "rtk.corrections", context.session.connection.now, "corrections by rtk.send or rtk.ntrip"
        )
        self._session.register_cell(self._corrections)
        self._message_count = 0
        self._byte_count = 0
        # Time and size of each message in the last BANDWIDTH_WINDOW_S.
        self._recent: deque[tuple[float, int]] = deque()

    @property
    def corrections(self) -> StateCell[Corrections]:
        """Number, bytes and bandwidth of the corrections sent; ``age`` is the time since the last transmission."""
        return self._corrections

    def send(self, rtcm: bytes) -> None:
        """Send RTCM 3 messages to the vehicle; never blocks.

        aerokit splits each message into GPS_RTCM_DATA. GPS_RTCM_DATA has no target and reaches all vehicles of the
        connection. If you pass the same message to several vehicles within 0.9 s, aerokit therefore transmits it once.
        There is no acknowledgement: ``vehicle.gps`` shows whether the receiver uses the corrections.

        Args:
            rtcm: one or more complete messages of at most 720 bytes each.

        Raises:
            InvalidArgument: ``rtcm`` is empty, or a message is incomplete, damaged or too long. Nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended, or this vehicle's `async with` block was left.
        """
        for message in rtcm_messages(rtcm):
            self._send(message)

    def ntrip(self, url: str, *, send_position: bool | None = None, timeout: float = 10.0) -> NtripClient:
        """Fetch corrections from an NTRIP caster while the ``async with`` block runs, and send them to the vehicle.

        Args:
            url: ``"ntrip://user:password@host:2101/MOUNT"``; ``ntrips://`` for TLS. Characters such as ``@`` in the
                password are written as ``%40``. The password appears in no log, error or repr.
            send_position: send the vehicle's position to the caster every 10 s (GGA), as a virtual reference station
                needs. None: only if the caster's source table asks for it.
            timeout: seconds to wait for the caster's answer.

        Raises:
            InvalidArgument: the URL is invalid. Nothing was opened.
        """
        from aerokit.vehicle.rtk.ntrip import Caster, NtripClient

        return NtripClient(self._session, self._send, Caster.parse(url), send_position, timeout)

    def _send(self, message: bytes) -> None:
        if self._session.is_closed:
            raise ConnectionClosed("the async with block of this vehicle was left; nothing was sent")
        # One transmission reaches all vehicles of the connection. If another vehicle's object has just sent the same
        # message, `send_rtcm` does not send it again.
        send_rtcm(self._session.connection, message, self)
        now = self._session.connection.now()
        self._message_count += 1
        self._byte_count += len(message)
        self._recent.append((now, len(message)))
        while self._recent:
            oldest_at, _ = self._recent[0]
            if oldest_at > now - BANDWIDTH_WINDOW_S:
                break
            self._recent.popleft()
        bandwidth = sum(size for _, size in self._recent) / BANDWIDTH_WINDOW_S
        value = Corrections(message_number(message), self._message_count, self._byte_count, bandwidth)
        self._corrections.set(value, Source(self._session.system_id, self._session.component_id, "GPS_RTCM_DATA"))
