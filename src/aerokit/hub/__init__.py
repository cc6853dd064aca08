"""A hub: several links joined into one MAVLink network, with filters, signing at the border and bounded queues."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.lazy import lazy_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.hub.hub import Hub
    from aerokit.hub.sharing import shared
    from aerokit.hub.values import Endpoint, EndpointStatistics, HubEvent, HubEventKind

__all__ = ["Endpoint", "EndpointStatistics", "Hub", "HubEvent", "HubEventKind", "shared"]

_HOMES = {
    "Endpoint": "aerokit.hub.values",
    "EndpointStatistics": "aerokit.hub.values",
    "Hub": "aerokit.hub.hub",
    "HubEvent": "aerokit.hub.values",
    "HubEventKind": "aerokit.hub.values",
    "shared": "aerokit.hub.sharing",
}

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__ = lazy_names(__name__, _HOMES, __all__)
