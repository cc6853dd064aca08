"""`Part`: what every class of actions rests on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.vehicle.state.states import States

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot
    from aerokit.runtime.cells import StateCell
    from aerokit.runtime.connection import Connection
    from aerokit.runtime.events import LinkReport
    from aerokit.vehicle.orders.bridge import Bridge
    from aerokit.vehicle.state.telemetry import Telemetry

__all__ = ["Part"]


class Part(States):
    """A part of :class:`aerokit.Vehicle`: some of its actions. Parts know the bridge, and not each other."""

    def __init__(self, bridge: Bridge) -> None:
        self._bridge, talk = bridge, bridge.talk
        self.connection: Connection = talk.connection
        """The connection it is reached by."""
        self.system_id: int = talk.system_id
        """MAVLink system id, 1–255."""
        self.component_id: int = talk.component_id
        """Component id of its autopilot, usually 1."""
        self.vehicle_type: int = talk.vehicle_type
        """MAV_TYPE of the first heartbeat (https://mavlink.io/en/messages/minimal.html#MAV_TYPE)."""
        self.autopilot: Autopilot = talk.autopilot
        """What differs between ArduPilot, PX4 and others."""
        self.telemetry: Telemetry = talk.telemetry
        """The state cells; most are properties of the vehicle too."""
        self.link_quality: StateCell[LinkReport] = talk.link_quality
        """Loss, delay and rates of the last second."""
        self._talk, self._helm, self._orders = talk, bridge.helm, bridge.orders
        self._holding, self._late_arming = bridge.holding, bridge.late_arming
        self._health, self._where = bridge.health, bridge.where

    def _cell_of(self, name: str) -> StateCell[Any]:
        return self.telemetry.cells[name]
