"""``Publisher``: the interface of networks to which state is published."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Publisher(ABC):
    """Publishes bytes under a name. Implement it for other networks than zenoh and MQTT."""

    @abstractmethod
    def put(self, name: str, data: bytes) -> None:
        """Publish ``data`` under ``name`` ("1/position"), immediately or never. It must not block or raise."""
