"""``SharedLink``: an open connection of this program as a link of a hub."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from aerokit.errors import AerokitError, BusyError, LinkLost
from aerokit.events import HeardTwice
from aerokit.hub.guards import Border
from aerokit.hub.targets import Targets
from aerokit.mavlink.frame import MAGIC_V1, SIGNATURE_LENGTH, Frame
from aerokit.transport.link import Link, Peer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.signing import Signing
    from aerokit.transport.link import Receiver

logger: logging.Logger = logging.getLogger("aerokit")


class SharedLink(Link):
    """Gives what a connection receives and sends to a hub, and what the hub has for its vehicles to it.

    The connection, and its link, stay open when this one is closed.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._targets = Targets(connection.bus.dialect)
        self._receiver: Receiver | None = None
        self._detachments: list[Callable[[], None]] = []
        self._border: Border | None = None
        self._lost: asyncio.Handle | None = None
        self._is_double_told = False
        self.address: str = f"shared:{connection.link.address}"
        self.dropped_writes: int = 0

    async def open(self, receiver: Receiver) -> None:
        """See `Link.open`. BusyError when it is open, ConnectionClosed or LinkLost when the connection has ended."""
        if self._receiver is not None:
            raise BusyError(f"{self.address} is open; a link is opened once")
        self._connection.raise_if_ended()
        self._receiver = receiver
        self._detachments = [
            self._connection.tap(self._on_frame),
            self._connection.tap_sent(self._on_sent),
            self._connection.on_end(self._on_end),
        ]

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`: to the vehicles, signed if the connection signs; not what is for this program."""
        if self._receiver is None:
            return
        for raw in _frames(data):
            frame = Frame.parse(raw)
            if not self._is_double_told:
                self._look_for_double(frame)
            if self._targets.of(frame)[0] == self._connection.source_system:
                continue
            try:
                border = self._present_border()
                signed = raw if border is None else border.signed(raw, self._connection.unix_time())
                if signed is None:
                    self.dropped_writes += 1
                else:
                    self._connection.write_raw(signed)
            except AerokitError:  # the connection has ended just now
                self.dropped_writes += 1

    @property
    def unsent_bytes(self) -> int:
        """See `Link.unsent_bytes`; what this program has sent counts, too."""
        return self._connection.unsent_bytes

    def close(self) -> None:
        """See `Link.close`."""
        self._receiver = None
        for detach in self._detachments:
            detach()
        self._detachments.clear()
        if self._lost is not None:
            self._lost.cancel()

    async def wait_closed(self) -> None:
        """See `Link.wait_closed`."""

    def _look_for_double(self, frame: Frame) -> None:
        """Vehicles cannot tell a station that has our ids from us: what they answer to it would be taken for ours."""
        ours = self._connection.source_system, self._connection.source_component
        if (frame.system_id, frame.component_id) == ours:
            self._is_double_told = True
            logger.warning(
                "a station shares the link of this program, and its ids %d/%d as well: each of them takes the vehicle's"
                " answers to the other for its own; give the program others (source_system=, source_component=)",
                *ours,
            )
            self._connection.bus.publish(HeardTwice(self._connection.now(), *ours))

    def _on_frame(self, frame: Frame, peer: Peer) -> None:
        border = self._present_border()
        if self._receiver is not None:
            self._receiver.bytes_received((frame if border is None else border.unsigned(frame)).raw, None)

    def _on_sent(self, raw: bytes) -> None:
        border = self._present_border()
        if self._receiver is not None:
            unsigned = raw if border is None else border.unsigned(Frame.parse(raw)).raw
            self._receiver.bytes_received(unsigned, None)

    def _on_end(self, error: Exception) -> None:
        """Told on the next turn of the loop: the connection may have ended inside a write."""
        self._lost = asyncio.get_running_loop().call_soon(self._tell_lost, error)

    def _tell_lost(self, error: Exception) -> None:
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            lost = LinkLost(f"{self.address}: {error}")
            lost.__cause__ = error
            receiver.link_lost(lost)

    def _present_border(self) -> Border | None:
        signing: Signing | None = self._connection.signing
        if signing is None:
            self._border = None
        elif self._border is None or self._border.signing is not signing:
            self._border = Border(signing, self._connection.bus.dialect.extras, _ignore)
        return self._border


def _frames(data: bytes) -> Iterator[bytes]:
    """The whole frames that a hub wrote together."""
    begin = 0
    while begin < len(data):
        if data[begin] == MAGIC_V1:
            end = begin + 8 + data[begin + 1]
        else:
            end = begin + 12 + data[begin + 1] + (SIGNATURE_LENGTH if data[begin + 2] else 0)
        yield data[begin:end]
        begin = end


def _ignore(frame: Frame, why: str) -> None:
    """The connection itself checks what comes in."""
