"""``publishing``: the state of a vehicle as JSON on a network."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range, checked
from aerokit._internal.async_block import async_block
from aerokit._internal.formatting import to_jsonable
from aerokit.apps.network.mqtt_publisher import mqtt_publisher
from aerokit.apps.network.zenoh_publisher import zenoh_publisher
from aerokit.connection.tasks import BackgroundTasks
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
"""Maps the scheme of an address to the function that opens its publisher."""
VERSION = 1
"""Version of the message format. Only incompatible changes increment it."""
MAX_RATE_HZ = 50.0
REPEAT_INTERVAL_S = 2.0
"""Interval in seconds at which an unchanged state is published again, for new subscribers."""
_JSON = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def publisher_for(address: str) -> AbstractAsyncContextManager[Publisher]:
    scheme = address.partition(":")[0].strip().lower()  # The error omits the rest, which may contain a password.
    if scheme not in PUBLISHERS:
        raise InvalidArgument(f"to: {scheme!r} is not a scheme of a publisher; they are {', '.join(PUBLISHERS)}")
    return PUBLISHERS[scheme](address)


logger: logging.Logger = logging.getLogger("aerokit")


class Publishing:
    """Publishes the states of one vehicle, periodically within the block of :func:`publishing`.

    Args:
        vehicle: a connected vehicle.
        publisher: the network to publish to.
        states: names of the states to publish; if empty, all states are published.
    """

    published: int

    def __init__(self, vehicle: Vehicle, publisher: Publisher, states: frozenset[str] = frozenset()) -> None:
        self.published = 0
        """Number of messages published so far."""
        self._vehicle = vehicle
        self._publisher = publisher
        self._states = states
        self._has_logged_error = False
        self._sent: dict[str, tuple[float, object]] = {}  # maps states to time and value of their last message

    def publish(self, now: float) -> None:
        """Publish all states that have changed, or were not published for `REPEAT_INTERVAL_S`.

        ``now`` is the present time in seconds, on any clock.
        """
        for name, cell in self._vehicle.telemetry.cells.items():
            if cell.is_known and (not self._states or name in self._states):
                self._publish(name, to_jsonable(cell.latest), cell.age, now)
        is_link_wanted = not self._states or "link" in self._states
        # The statistics of the link change with every frame. They are therefore published every REPEAT_INTERVAL_S only.
        if is_link_wanted and self._is_repeat_due("link", now):
            self._publish("link", overview(self._vehicle)["link"], age_s=0.0, now=now)

    def _is_repeat_due(self, name: str, now: float) -> bool:
        sent_at, _ = self._sent.get(name, (-math.inf, None))
        return now - sent_at >= REPEAT_INTERVAL_S

    def _publish(self, name: str, value: object, age_s: float, now: float) -> None:
        _, sent_value = self._sent.get(name, (-math.inf, None))
        if value == sent_value and not self._is_repeat_due(name, now):
            return
        self._sent[name] = (now, value)
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
        except Exception:  # an error would end this task and close the connection, perhaps during a flight
            if not self._has_logged_error:
                self._has_logged_error = True
                logger.exception("the publisher %r could not publish a state; publishing continues", self._publisher)
            return
        self.published += 1


@checked
@async_block
async def publishing(
    vehicle: Vehicle, to: str | Publisher, *, rate_hz: float = 5.0, states: Iterable[str] = ()
) -> AsyncIterator[Publishing]:
    """Publish the state of a vehicle on a network as JSON while the block lasts, with one message for each state.

    A changed state is published at most ``rate_hz`` times a second, an unchanged state every two seconds.
    docs/state.schema.json has the schema of the messages. Nothing is requested from the vehicle, and subscribers cannot
    send anything to it.

    Args:
        vehicle: a connected vehicle.
        to: ``"zenoh://fleet/alpha"`` for the keys ``aerokit/fleet/alpha/state/SYSTEM_ID/STATE``,
            ``"mqtt://host/fleet/alpha"`` for topics of the same names, or a `Publisher`.
        rate_hz: maximum rate of each state, above 0, at most 50.
        states: names of states to publish (docs/states.md), or ``"link"``; if empty, all states are published.

    Raises:
        InvalidArgument: an argument is invalid, or there is no such state.
        LinkOpenError: the network or broker cannot be reached, or the required package is not installed.
        ConnectionClosed, LinkLost: the vehicle's connection has ended.
    """
    check_range("rate_hz", rate_hz, 0, MAX_RATE_HZ, above=True)
    state_names = frozenset(states)
    unknown = sorted(state_names - vehicle.telemetry.cells.keys() - {"link"})
    if unknown:
        raise InvalidArgument(f"states: {unknown[0]!r} is not a state; docs/states.md lists them")
    connection = vehicle.connection
    connection.raise_if_ended()
    async with AsyncExitStack() as stack:
        publisher = await stack.enter_async_context(publisher_for(to)) if isinstance(to, str) else to
        publication = Publishing(vehicle, publisher, state_names)

        async def publish_periodically() -> None:
            while connection.is_open:
                publication.publish(asyncio.get_running_loop().time())
                await anyio.sleep(1 / rate_hz)

        tasks = BackgroundTasks(connection.fail)
        tasks.start(publish_periodically)
        try:
            yield publication
        finally:
            await tasks.aclose()
