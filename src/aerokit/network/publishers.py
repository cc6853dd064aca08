"""``publisher_for``: the publisher that an address is for, by its scheme."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.network.mqtt_publisher import mqtt_publisher
from aerokit.network.zenoh_publisher import zenoh_publisher

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

    from aerokit.network.publisher import Publisher

__all__ = ["PUBLISHERS", "publisher_for"]

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
