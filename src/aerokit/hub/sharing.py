"""``shared``: ground stations on the link of this program, for the time of an ``async with`` block."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.arguments import checked
from aerokit.async_block import async_block
from aerokit.hub.hub import Hub

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable

    from aerokit.hub.values import Endpoint
    from aerokit.links.link import Link
    from aerokit.runtime.connection import Connection

__all__ = ["shared"]


@checked
@async_block
async def shared(connection: Connection, endpoints: Iterable[str | Endpoint | Link]) -> AsyncIterator[Hub]:
    """Share an open connection with other programs for the time of the ``async with`` block; gives the hub that does.

    ``aerokit.connect(…, share=[…])`` does the same. See `Hub.share`.

    Args:
        connection: of this program; it stays open.
        endpoints: where the others are, or come: ``["tcpin:127.0.0.1:5760"]``.

    Raises:
        InvalidArgument: an address is wrong, or two endpoints have one name.
        LinkOpenError: an endpoint could not be opened.
        ConnectionClosed, LinkLost: the connection has ended.
    """
    async with Hub(endpoints, dialect=connection.bus.dialect) as hub:
        await hub.share(connection)
        yield hub
