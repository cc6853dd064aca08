"""``zenoh_publisher``: typed state on a zenoh network."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit.apps.network.publisher import Publisher
from aerokit.errors import InvalidArgument
from aerokit.transport.address import parse_address
from aerokit.transport.create import network_options
from aerokit.transport.zenoh.keys import Place, check_name
from aerokit.transport.zenoh.session import NetworkOptions, close_session, open_session

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

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


@checked
async def found(
    fleet: str,
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    config: str = "",
    wait: float = 1.0,
) -> list[str]:
    """The names of a fleet that are on a zenoh network now: what ``zenoh://FLEET/NAME`` can be opened for.

    Args:
        fleet: its name.
        connect: endpoints of routers and peers, ``["tcp/10.0.0.5:7447"]``; none, and nothing to listen on: whoever is
            found by multicast.
        listen: endpoints to listen on.
        config: a configuration file of zenoh's own.
        wait: seconds to look, above 0; on a network that is found by multicast, a second is not much.

    Returns:
        The names, sorted.

    Raises:
        InvalidArgument: an argument is wrong.
        LinkOpenError: there is no network, or eclipse-zenoh is not installed.
    """
    check_name("fleet", fleet)
    there: set[str] = set()
    declared: list[Any] = []

    def prepare(zenoh: Any, session: Any) -> None:
        def hear(sample: Any) -> None:  # on a thread of zenoh's; a set is changed whole
            key = str(sample.key_expr)
            (there.add if sample.kind == zenoh.SampleKind.PUT else there.discard)(key)

        everybody = Place(fleet, "*").alive()
        declared.append(session.liveliness().declare_subscriber(everybody, hear, history=True))

    options = NetworkOptions(tuple(connect), tuple(listen), "", config)
    session = await open_session(f"zenoh://{fleet}", options, prepare)
    closed = asyncio.Event()
    try:
        await anyio.sleep(wait)
    finally:
        declared.clear()
        close_session(session, closed.set)
    await closed.wait()
    return sorted({key.split("/")[2] for key in there})
