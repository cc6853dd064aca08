"""``zenoh_publisher``: typed state on a zenoh network."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from aerokit.arguments import checked
from aerokit.async_block import async_block
from aerokit.errors import InvalidArgument
from aerokit.links.address import parse_address
from aerokit.links.create import network_options
from aerokit.links.zenoh_keys import Place
from aerokit.links.zenoh_session import close_session, open_session
from aerokit.network.publisher import Publisher

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

__all__ = ["zenoh_publisher"]

CLOSE_TIMEOUT_S = 2.0


class _ZenohPublisher(Publisher):
    """On the keys ``aerokit/FLEET/NAME/state/…``."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._drop: Any = None
        self._session: Any = None

    def prepare(self, zenoh: Any, session: Any) -> None:
        self._drop = zenoh.CongestionControl.DROP
        self._session = session

    def put(self, name: str, data: bytes) -> None:
        with contextlib.suppress(Exception):  # zenoh's own: the session has ended
            self._session.put(
                self._place.state(name),
                data,
                encoding="application/json",
                congestion_control=self._drop,
            )


@checked
@async_block
async def zenoh_publisher(address: str) -> AsyncIterator[Publisher]:
    """Open a session on a zenoh network for the time of the block.

    What is put is dropped where it meets a queue that is full, and while there is no network.

    Args:
        address: ``"zenoh://fleet/alpha"``, with the options of :doc:`addresses </addresses>`.

    Returns:
        What :func:`publishing` takes.

    Raises:
        InvalidArgument: this is no address of a zenoh network.
        LinkOpenError: there is no network, or eclipse-zenoh is not installed.
    """
    where = parse_address(address)
    if where.kind not in ("zenoh", "zenohin"):
        raise InvalidArgument(
            f"address = {address!r} is not allowed: it is not on a network, as zenoh://fleet/alpha is"
        )
    fleet, _, name = where.path.partition("/")
    publisher = _ZenohPublisher(Place(fleet, name))
    session = await open_session(address, network_options(where), publisher.prepare)
    try:
        yield publisher
    finally:
        closed = asyncio.Event()
        close_session(session, closed.set)
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(closed.wait(), CLOSE_TIMEOUT_S)
