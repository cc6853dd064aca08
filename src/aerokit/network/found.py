"""``found``: who is there, by the liveliness tokens of a fleet."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.arguments import checked
from aerokit.links.zenoh_keys import Place, check_name
from aerokit.links.zenoh_session import NetworkOptions, close_session, open_session

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["found"]


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
