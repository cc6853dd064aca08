"""``Border``: an endpoint that signs. What comes in is checked and loses its signature, what goes out gets one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.routes import LIVE_FOR_S, Routes
from aerokit.events import HeardTwice, VehicleMoved
from aerokit.hub.senders import is_autopilot
from aerokit.mavlink.frame import MAGIC_V2, SIGNED, Frame, x25

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from aerokit.events import Event
    from aerokit.hub.values import HubEventKind
    from aerokit.mavlink.framer import Framer
    from aerokit.mavlink.signing import Signing
    from aerokit.transport.link import Link, Peer


def reframed(frame: Frame, crc_extra: bytes, *, flags: int) -> bytes:
    """The frame with these incompatibility flags and without a signature, as MAVLink 2; sender and number stay.

    The checksum covers the flags: it is made anew.
    """
    body = frame.body
    payload = body[9:].rstrip(b"\0") or body[9:10]  # of MAVLink 1 too: version 2 has no zeros at its end
    body = bytes((len(payload), flags)) + body[2:9] + payload
    return bytes((MAGIC_V2,)) + body + x25(body + crc_extra).to_bytes(2, "little")


class Border:
    """Signs what goes out of one endpoint with its key, and lets in what is signed with it.

    ``unix_time`` is seconds since 1970. Frames of MAVLink 1 cannot be signed: they go out as MAVLink 2, and do not come
    in unless the ``allow_unsigned`` of the `Signing` lets them. Nor can frames of messages that the dialect does not
    know: their checksum cannot be made.
    """

    def __init__(
        self, signing: Signing, crc_extras: Mapping[int, bytes], refused: Callable[[Frame, str], object]
    ) -> None:
        """``refused(frame, why)`` is called for each frame that is not let in."""
        self.signing = signing
        self._extras, self._refused = crc_extras, refused

    def admitted(self, frame: Frame, unix_time: float) -> Frame | None:
        """The frame without its signature; None: it is not let in."""
        try:
            refusal = self.signing.check(frame, unix_time)
        except Exception as error:  # of the program's allow_unsigned
            self._refused(frame, f"allow_unsigned raised {error!r}")
            return None
        if refusal is not None:
            self._refused(frame, refusal.value)
            return None
        return self.unsigned(frame)

    def unsigned(self, frame: Frame) -> Frame:
        """The frame without its signature."""
        extra = self._extras.get(frame.message_id)
        if not frame.incompat_flags & SIGNED or extra is None:
            return frame
        return Frame.parse(reframed(frame, extra, flags=0), frame.received_at)

    def signed(self, raw: bytes, unix_time: float) -> bytes | None:
        """A whole frame, signed; None when it cannot be, because the dialect does not know the message."""
        frame = Frame.parse(raw)
        extra = self._extras.get(frame.message_id)
        if extra is None:
            return None
        data = reframed(frame, extra, flags=SIGNED)
        return data + self.signing.sign(data, unix_time)


REPEAT_EVENT_S = 60.0
"""A second peer that speaks as the same autopilot is told of at most this often, whatever number of peers it uses."""


class IdentityGuard:
    """Applies the rules of a connection (`Routes`) to the peers of one endpoint.

    The first peer that is heard as an autopilot keeps the place while it is heard; what other peers say in its name is
    not passed on. Ground stations and companions may share their ids. ``tell(kind, peer, text)`` is called for events.
    """

    def __init__(self, link: Link, tell: Callable[[HubEventKind, Peer, str], object]) -> None:
        self.is_shared = False
        """Whether the endpoint has more than one peer; of one alone only heartbeats are of interest."""
        self._routes = Routes(link, self._publish)
        self._tell = tell
        self._heartbeat_at: dict[Peer, float] = {}
        self._told_at: dict[tuple[int, int], float] = {}
        self._speaker: Peer = None

    def admits(self, frame: Frame, framer: Framer, peer: Peer) -> bool:
        """Whether this peer may say this frame. Call it with each heartbeat, and with all frames if `is_shared`."""
        if self._routes.is_elsewhere(frame, peer):
            self._speaker = peer
            if not self._routes.takes_place(frame, peer, framer.counters_of(frame), is_signed=False):
                return False
        if frame.message_id == 0:
            self._heartbeat_at[peer] = frame.received_at
            if is_autopilot(frame.body):
                self._routes.note(frame, peer, framer.counters_of(frame))
        return True

    def least_wanted(self, peers: Iterable[Peer], now: float) -> Iterable[Peer]:
        """The first peer that has sent no heartbeat in the last 30 s, if there is one."""
        silent = (peer for peer in peers if now - self._heartbeat_at.get(peer, -math.inf) > LIVE_FOR_S)
        return self._routes.least_wanted(silent, now)

    def forget(self, peer: Peer) -> None:
        """A peer has gone."""
        self._heartbeat_at.pop(peer, None)

    def _publish(self, event: Event) -> None:
        if isinstance(event, VehicleMoved):
            source = event.system_id, event.component_id
            self._told_at.pop(source, None)
            self._tell(
                "moved",
                self._speaker,
                f"{source[0]}/{source[1]} is there now, and not at {event.before} any more",
            )
        elif isinstance(event, HeardTwice):
            source = event.system_id, event.component_id
            if event.at - self._told_at.get(source, -math.inf) > REPEAT_EVENT_S:
                self._told_at[source] = event.at
                self._tell(
                    "heard_twice",
                    self._speaker,
                    f"it speaks as {source[0]}/{source[1]}, which is heard from another peer: what it says is dropped",
                )
