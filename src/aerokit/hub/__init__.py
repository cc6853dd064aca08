"""``Hub``: joins several links into one MAVLink network, with filters, signing per endpoint and bounded queues."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.hub.hub import Hub as Hub
    from aerokit.hub.hub import shared as shared
    from aerokit.hub.values import Endpoint as Endpoint
    from aerokit.hub.values import EndpointStatistics as EndpointStatistics
    from aerokit.hub.values import HubEvent as HubEvent
    from aerokit.hub.values import HubEventKind as HubEventKind

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "aerokit.hub.hub": ("Hub", "shared"),
        "aerokit.hub.values": ("Endpoint", "EndpointStatistics", "HubEvent", "HubEventKind"),
    },
)
