"""Vehicles for programs on other machines, in whatever language: typed state as JSON, and who is on a network.

Frames, and with them the whole API, go over the addresses ``zenoh:`` and ``zenohin:``; see docs/network.md.
"""

from __future__ import annotations

from aerokit.apps.network.mqtt_publisher import mqtt_publisher
from aerokit.apps.network.publisher import Publisher
from aerokit.apps.network.publishing import Publishing, publishing
from aerokit.apps.network.zenoh_publisher import found, zenoh_publisher

__all__ = [
    "Publisher",
    "Publishing",
    "found",
    "mqtt_publisher",
    "publishing",
    "zenoh_publisher",
]
