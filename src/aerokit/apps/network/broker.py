"""A line to a broker that is opened again, and what waits to go there."""

from __future__ import annotations

import errno
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, NoReturn
from urllib.parse import unquote, urlsplit

from aerokit._internal.values import Snapshot
from aerokit.apps.network.publisher import Publisher
from aerokit.connection.tasks import to_its_end
from aerokit.errors import InvalidArgument
from aerokit.transport.address import host_and_port
from aerokit.transport.link import BaseLink, link_open_error
from aerokit.transport.reconnecting import ReconnectingLink
from aerokit.transport.zenoh.keys import Place, check_name

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from aerokit.errors import LinkLost, LinkOpenError
    from aerokit.transport.link import Peer

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


PORTS: dict[str, int] = {"mqtt": 1883, "mqtts": 8883}
"""Scheme → the port where such brokers listen."""


class BrokerAddress(Snapshot):
    """A broker, and who publishes there; what is printed of it has no user and no password."""

    scheme: str
    """"mqtt", or "mqtts" by TLS."""
    host: str
    port: int
    place: Place
    user: str | None = None
    password: str | None = None

    def __str__(self) -> str:
        return f"{self.scheme}://{host_and_port(self.host, self.port)}/{self.place.fleet}/{self.place.name}"

    def __repr__(self) -> str:
        return f"<{self}>"


def parse_broker(text: str, *schemes: str) -> BrokerAddress:
    """Read an address; ``schemes`` are those that are allowed, none: all.

    Raises:
        InvalidArgument: it is none. What was given is not repeated in there where it may have a password.
    """
    allowed = schemes or tuple(PORTS)

    def fail(reason: str) -> NoReturn:
        shown = f"{scheme}://…" if "@" in text else text
        raise InvalidArgument(
            f"address = {shown!r} is not allowed: {reason}, as in"
            f" {allowed[0]}://10.0.0.5:{PORTS[allowed[0]]}/fleet/alpha (% and @ : / ? # in a password: %25, %40 …)"
        )

    scheme = text.partition("://")[0].strip().lower() if "://" in text else "…"
    if scheme not in allowed:
        if "@" in text:
            scheme = "…"
        fail(f"it begins with none of {', '.join(f'{each}://' for each in allowed)}")
    try:
        parts = urlsplit(text.strip())
        host, port = parts.hostname, parts.port
    except ValueError:
        fail("host and port cannot be read")
    if not host or port == 0:
        fail("host or port is missing")
    if parts.query or parts.fragment:
        fail("it has options, and there are none")
    fleet, _, name = parts.path.strip("/").partition("/")
    try:
        place = Place(check_name("fleet", fleet), check_name("name", name))
    except InvalidArgument:
        fail("fleet and name are up to 63 letters, digits, '_', '.' and '-', a letter or digit first")
    user, password = (None if each is None else unquote(each) for each in (parts.username, parts.password))
    return BrokerAddress(scheme, host, port or PORTS[scheme], place, user, password)
