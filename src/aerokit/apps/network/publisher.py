"""``Publisher``: where typed state goes; zenoh, MQTT, or whatever else takes a name and bytes."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Publisher(ABC):
    """Puts bytes under a name on some network: zenoh, MQTT, or what a program brings a client of."""

    @abstractmethod
    def put(self, name: str, data: bytes) -> None:
        """Put ``data`` under ``name`` ("1/position"), at once or not at all: it must not block and not raise."""
