"""Who is there: the system ids of the vehicles that are heard on several networks."""

from __future__ import annotations

import asyncio
import logging
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit.connection.components import found_by
from aerokit.connection.opening import no_vehicle_reason
from aerokit.errors import ConnectFailed
from aerokit.events import VehicleFound

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from aerokit.connection.connection import Connection

logger: logging.Logger = logging.getLogger("aerokit")

SETTLE_S = 2.5
"""Heartbeats come once a second: who is there has been heard twice by then."""
TELL_AFTER_S = 5.0
"""Who is not there by then is worth a line."""


async def find_systems(
    networks: Mapping[str, Connection],
    wanted: Mapping[str, list[int] | None],
    count: int | None,
    given: int,
    timeout: float,
) -> dict[str, list[int]]:
    """Network → system ids: those that are wanted, or all that are heard and that the program has no vehicle of.

    Args:
        networks: by name.
        wanted: ids by network; None: whoever is heard.
        count: how many are waited for in all, with the ``given`` ones.
        given: how many vehicles the program has given.
        timeout: seconds.

    Raises:
        ConnectFailed: they were not heard in time.
    """
    looked_for = [name for name in networks if wanted[name] is None]
    found: dict[str, dict[int, None]] = {name: dict.fromkeys(wanted[name] or ()) for name in networks}
    news = anyio.Event()

    def hear(name: str, event: object) -> None:
        nonlocal news
        if isinstance(event, VehicleFound) and event.system_id not in networks[name].attached:
            found[name].setdefault(event.system_id)
            news.set()

    def is_enough() -> bool:
        if count is not None:
            return given + sum(map(len, found.values())) >= count
        return all(found[name] for name in looked_for)

    detach = []
    try:
        for name in looked_for:
            connection = networks[name]
            connection.raise_if_ended()
            detach.append(connection.bus.attach_event(VehicleFound, partial(hear, name)))
            for source, heartbeat in connection.heard.items():
                hear(name, found_by(heartbeat, connection.now(), *source))
        with anyio.move_on_after(timeout):
            with telling_who_is_missing(timeout, lambda: _so_far(found, looked_for, count, given)):
                while not is_enough():
                    news = anyio.Event()
                    await news.wait()
            if looked_for and count is None:
                await anyio.sleep(SETTLE_S)
    finally:
        for each in detach:
            each()
    if not is_enough():
        raise ConnectFailed(_missing(networks, found, looked_for, count, given, timeout))
    return {name: sorted(those) for name, those in found.items()}


def _missing(
    networks: Mapping[str, Connection],
    found: Mapping[str, Mapping[int, None]],
    looked_for: list[str],
    count: int | None,
    given: int,
    timeout: float,
) -> str:
    why = "".join(
        f"\n  - network {name}: {no_vehicle_reason(networks[name], None)}"
        for name in looked_for
        if not found[name]
    )
    return f"within {timeout:g} s {_so_far(found, looked_for, count, given)}{why}"


def _so_far(
    found: Mapping[str, Mapping[int, None]], looked_for: list[str], count: int | None, given: int
) -> str:
    """Who is there of those that are waited for, as a clause."""
    names = [f"{name}/{each}" for name, those in found.items() for each in those]
    given_too = f", {given} of them given by the program" if given else ""
    there = f": {', '.join(names)}" if names else ""
    if count is not None:
        return f"{given + len(names) or 'none'} of {count} vehicles were found{given_too}{there}"
    silent = ", ".join(name for name in looked_for if not found[name])
    return f"no vehicle was heard on {silent}{f'; found were {there[2:]}' if there else ''}"


@contextmanager
def telling_who_is_missing(timeout: float, describe: Callable[[], str]) -> Iterator[None]:
    """Warn, once, if the block takes long: a fleet is not whole before all are there, and its program waits."""

    def tell() -> None:
        logger.warning(
            "a fleet is waiting: after %g s %s; it waits for %g s", TELL_AFTER_S, describe(), timeout
        )

    timer = asyncio.get_running_loop().call_later(TELL_AFTER_S, tell)
    try:
        yield
    finally:
        timer.cancel()
