"""``Publisher``: the interface of networks to which state is published."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Publisher(ABC):
    """Publishes bytes under a name. Subclass it for networks other than zenoh and MQTT."""

    @abstractmethod
    def put(self, name: str, data: bytes) -> None:
        """Publish ``data`` under ``name`` ("1/position"), or drop it. The method must not block or raise."""
