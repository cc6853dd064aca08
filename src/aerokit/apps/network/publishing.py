"""``publishing``: what is known of a vehicle as JSON, on a network, for programs in other languages."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit._internal.plain import plain
from aerokit.apps.network.mqtt_publisher import mqtt_publisher
from aerokit.apps.network.zenoh_publisher import zenoh_publisher
from aerokit.connection.tasks import Background
from aerokit.errors import InvalidArgument
from aerokit.vehicle.vehicle import overview

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable
    from contextlib import AbstractAsyncContextManager

    from aerokit.apps.network.publisher import Publisher
    from aerokit.vehicle.vehicle import Vehicle

PUBLISHERS: dict[str, Callable[[str], AbstractAsyncContextManager[Publisher]]] = {
    "mqtt": mqtt_publisher,
    "mqtts": mqtt_publisher,
    "zenoh": zenoh_publisher,
    "zenohin": zenoh_publisher,
}
"""Scheme of an address → what it opens."""


def publisher_for(address: str) -> AbstractAsyncContextManager[Publisher]:
    """Not open yet; what has no scheme of these is refused as an address of zenoh is."""
    scheme = address.partition(":")[0].strip().lower()
    return PUBLISHERS.get(scheme, zenoh_publisher)(address)


logger: logging.Logger = logging.getLogger("aerokit")

VERSION = 1
"""Of the messages: a change that a reader would misunderstand makes it 2."""

HIGHEST_RATE_HZ = 50.0

REPEAT_S = 2.0
"""A state that does not change is told so often all the same, for whoever comes later, with its age."""

_JSON = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, allow_nan=False)


class Publishing:
    """States of one vehicle on their way to a publisher: by the block of :func:`publishing`, or whenever asked.

    Args:
        vehicle: a vehicle that is connected.
        publisher: where they go.
        states: names; none: all.
    """

    published: int

    def __init__(self, vehicle: Vehicle, publisher: Publisher, states: frozenset[str] = frozenset()) -> None:
        self.published = 0
        """Messages so far."""
        self._vehicle, self._publisher, self._states = vehicle, publisher, states
        self._is_mistake_told = False
        self._told: dict[str, tuple[float, object]] = {}  # state → when it was put, and what

    def publish(self, now: float) -> None:
        """Put what has changed since it was put last, and what was not put for `REPEAT_S`; ``now`` in seconds."""
        for name, cell in self._vehicle.telemetry.cells.items():
            if cell.is_known and (not self._states or name in self._states):
                self._publish(name, plain(cell.latest), cell.age, now)
        if not self._states or "link" in self._states:
            link = overview(self._vehicle)["link"] if self._is_due("link", now) else None
            if link is not None:
                self._publish("link", link, 0.0, now)

    def _is_due(self, name: str, now: float) -> bool:
        return now - self._told.get(name, (-math.inf, None))[0] >= REPEAT_S

    def _publish(self, name: str, value: object, age_s: float, now: float) -> None:
        if name in self._told and self._told[name][1] == value and not self._is_due(name, now):
            return
        self._told[name] = (now, value)
        system_id = self._vehicle.system_id
        message = {
            "version": VERSION,
            "system_id": system_id,
            "state": name,
            "value": value,
            "age_s": round(age_s, 3),
            "unix_s": round(self._vehicle.connection.unix_time(), 3),
        }
        try:
            self._publisher.put(f"{system_id}/{name}", _JSON.encode(message).encode())
        except (
            Exception
        ):  # else it would be taken for a mistake of ours, which closes the connection in mid-flight
            if not self._is_mistake_told:
                self._is_mistake_told = True
                logger.exception("a publisher (%r) raised; it is asked on", self._publisher)
            return
        self.published += 1


@checked
@async_block
async def publishing(
    vehicle: Vehicle, to: str | Publisher, *, rate_hz: float = 5.0, states: Iterable[str] = ()
) -> AsyncIterator[Publishing]:
    """Put what is known of a vehicle on a network, for the time of the block: JSON, one message for each state.

    A state is put when it has changed, ``rate_hz`` times a second at most and then as it is by then, and every two
    seconds all the same. docs/state.schema.json says what the messages look like. Nothing is asked of the vehicle, and
    nothing that anybody does on these keys reaches it.

    Args:
        vehicle: a vehicle that is connected.
        to: ``"zenoh://fleet/alpha"``: on the keys ``aerokit/fleet/alpha/state/SYSTEM_ID/STATE``;
            ``"mqtt://host/fleet/alpha"``: on these topics; or a `Publisher`.
        rate_hz: of each state at most, above 0 to 50.
        states: names as in docs/states.md, and ``"link"``; none: all of them.

    Raises:
        InvalidArgument: an argument is wrong, or there is no such state.
        LinkOpenError: there is no network or broker, or the package that it takes is not installed.
        ConnectionClosed, LinkLost: the vehicle's connection has ended.
    """
    if not 0 < rate_hz <= HIGHEST_RATE_HZ:
        raise InvalidArgument(f"rate_hz = {rate_hz} is not allowed: above 0, at most {HIGHEST_RATE_HZ:g}")
    wanted = frozenset(states)
    unknown = sorted(wanted - vehicle.telemetry.cells.keys() - {"link"})
    if unknown:
        raise InvalidArgument(f"states = … has {unknown[0]!r}, which is no state (docs/states.md has them)")
    connection = vehicle.connection
    connection.raise_if_ended()
    async with AsyncExitStack() as stack:
        publisher = await stack.enter_async_context(publisher_for(to)) if isinstance(to, str) else to
        under_way = Publishing(vehicle, publisher, wanted)

        async def go_on() -> None:
            while connection.is_open:
                under_way.publish(asyncio.get_running_loop().time())
                await anyio.sleep(1 / rate_hz)

        tasks = Background(connection.fail)
        tasks.start(go_on)
        try:
            yield under_way
        finally:
            await tasks.aclose()
