"""A line to a broker that is opened again, and what waits to go there."""

from __future__ import annotations

import errno
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from aerokit.links.base import BaseLink, link_open_error
from aerokit.links.reconnecting import ReconnectingLink
from aerokit.network.publisher import Publisher
from aerokit.runtime.background import to_its_end

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from aerokit.errors import LinkLost, LinkOpenError
    from aerokit.links.link import Peer
    from aerokit.network.broker_address import BrokerAddress

__all__ = ["CONNECT_TIMEOUT_S", "BrokerLink", "publisher_over"]

CONNECT_TIMEOUT_S = 5.0
MOST_WAITING = 32_768
"""Names: all states of 255 vehicles."""


class BrokerLink(BaseLink):
    """A line to a broker: of what is written under a name, the latest waits until the broker takes it.

    The ``peer`` of :meth:`write` is the name of a state. Nothing that waits outlives the line.
    """

    def __init__(self, where: BrokerAddress) -> None:
        super().__init__(str(where))
        self._where = where
        self._waiting: dict[str, bytes] = {}

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; the latest wins."""
        name = str(peer)
        if self._receiver is None or (name not in self._waiting and len(self._waiting) >= MOST_WAITING):
            self._drop(1)
            return
        self._drop(int(name in self._waiting))
        self._waiting[name] = data
        self._send_waiting()

    def _send_waiting(self) -> None:
        """Send what can be sent now, or have it sent."""
        raise NotImplementedError

    def _refused(self, error: OSError) -> LinkOpenError:
        is_nobody = error.errno == errno.ECONNREFUSED
        hint = "nothing listens there; is the broker running, and is this its port?" if is_nobody else ""
        return link_open_error(self.address, error, hint)


class _OverLink(Publisher):
    def __init__(self, link: ReconnectingLink) -> None:
        self._link = link

    def __repr__(self) -> str:
        return f"<publisher on {self._link.address}>"

    def put(self, name: str, data: bytes) -> None:
        self._link.write(data, name)


class _Nobody:
    """Who listens to a broker: the log tells what happens to the line (`ReconnectingLink`)."""

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        pass

    def link_lost(self, error: LinkLost) -> None:
        pass


@asynccontextmanager
async def publisher_over(make_link: Callable[[], BrokerLink]) -> AsyncIterator[Publisher]:
    """Put over a line that is opened again whenever it was lost; what is put meanwhile is dropped."""
    link = ReconnectingLink(make_link)
    await link.open(_Nobody())
    try:
        yield _OverLink(link)
    finally:
        link.close()
        await to_its_end(link.wait_closed())
