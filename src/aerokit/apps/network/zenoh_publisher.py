"""``zenoh_publisher``: vehicle state on a zenoh network."""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import check_range, checked
from aerokit._internal.async_block import async_block
from aerokit.apps.network.publisher import Publisher
from aerokit.connection.tasks import run_shielded
from aerokit.errors import InvalidArgument
from aerokit.transport.address import parse_address
from aerokit.transport.create import network_options
from aerokit.transport.zenoh.keys import KeySpace, check_name
from aerokit.transport.zenoh.session import NetworkOptions, close_session, open_session

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

_CLOSE_SESSION_TIMEOUT_S = 2.0


class _ZenohPublisher(Publisher):
    """Publishes to the keys ``aerokit/FLEET/NAME/state/…``."""

    def __init__(self, key_space: KeySpace) -> None:
        self._key_space = key_space
        self._drop: Any = None
        self._session: Any = None

    def use_session(self, zenoh: Any, session: Any) -> None:
        self._drop = zenoh.CongestionControl.DROP
        self._session = session

    def put(self, name: str, data: bytes) -> None:
        with contextlib.suppress(Exception):  # after the end of the session, zenoh raises its own error
            self._session.put(
                self._key_space.state(name), data, encoding="application/json", congestion_control=self._drop
            )


@checked
@async_block
async def zenoh_publisher(address: str) -> AsyncIterator[Publisher]:
    """Open a session on a zenoh network while the block lasts.

    Data is dropped while zenoh's queue is full or the network is unreachable.

    Args:
        address: ``"zenoh://fleet/alpha"``, with the options of :doc:`addresses </addresses>`.

    Returns:
        A publisher for :func:`publishing`.

    Raises:
        InvalidArgument: the address is invalid.
        LinkOpenError: there is no network, or eclipse-zenoh is not installed.
    """
    parsed = parse_address(address)
    if parsed.kind not in ("zenoh", "zenohin"):
        raise InvalidArgument(
            f"address = {address!r} is not allowed: it must be a zenoh address, such as zenoh://fleet/alpha"
        )
    fleet, _, name = parsed.path.partition("/")
    publisher = _ZenohPublisher(KeySpace(fleet, name))
    session = await open_session(address, network_options(parsed), publisher.use_session)
    try:
        yield publisher
    finally:
        await run_shielded(_close(session))


async def _close(session: Any) -> None:
    closed = asyncio.Event()
    close_session(session, closed.set)
    with anyio.move_on_after(_CLOSE_SESSION_TIMEOUT_S):
        await closed.wait()


@checked
async def discover(
    fleet: str, *, connect: Sequence[str] = (), listen: Sequence[str] = (), config: str = "", wait: float = 1.0
) -> list[str]:
    """Return the names in a fleet that are on a zenoh network and can be opened as ``zenoh://FLEET/NAME``.

    Args:
        fleet: name of the fleet.
        connect: endpoints of routers and peers, ``["tcp/10.0.0.5:7447"]``. Multicast is used without ``connect`` and
            ``listen``.
        listen: endpoints to listen on.
        config: path of a zenoh configuration file.
        wait: seconds to search, above 0; multicast discovery can take more than a second.

    Returns:
        The names, sorted.

    Raises:
        InvalidArgument: an argument is invalid.
        LinkOpenError: there is no network, or eclipse-zenoh is not installed.
    """
    check_name("fleet", fleet)
    check_range("wait", wait, 0, math.inf, above=True)
    keys: set[str] = set()
    subscribers: list[Any] = []  # keeps the subscriber alive, because zenoh ends a garbage-collected subscription

    def subscribe(zenoh: Any, session: Any) -> None:
        def on_sample(sample: Any) -> None:  # runs on a zenoh thread; set.add and set.discard are atomic
            key = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.PUT:
                keys.add(key)
            else:
                keys.discard(key)

        all_names = KeySpace(fleet, "*").server_token()
        subscribers.append(session.liveliness().declare_subscriber(all_names, on_sample, history=True))

    options = NetworkOptions(tuple(connect), tuple(listen), config=config)
    session = await open_session(f"zenoh://{fleet}", options, subscribe)
    try:
        await anyio.sleep(wait)
    finally:
        subscribers.clear()
        await run_shielded(_close(session))
    return sorted({key.split("/")[2] for key in keys})  # the keys are aerokit/FLEET/NAME/…
