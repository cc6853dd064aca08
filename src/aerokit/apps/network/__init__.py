"""Vehicle state as JSON over zenoh or MQTT, for programs in any language, and the names on a zenoh network.

Full control of vehicles on a zenoh network, with MAVLink, uses the addresses ``zenoh:`` and ``zenohin:`` instead; see
docs/network.md.
"""

from __future__ import annotations

from aerokit.apps.network.mqtt_publisher import mqtt_publisher
from aerokit.apps.network.publisher import Publisher
from aerokit.apps.network.publishing import Publishing, publishing
from aerokit.apps.network.zenoh_publisher import discover, zenoh_publisher

__all__ = ["Publisher", "Publishing", "discover", "mqtt_publisher", "publishing", "zenoh_publisher"]
