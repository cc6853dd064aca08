"""`GimbalPart`: what every class of orders to a gimbal rests on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.vehicle.gimbal.orders import GimbalOrders

if TYPE_CHECKING:
    from aerokit.runtime.cells import StateCell
    from aerokit.vehicle.gimbal.device import Device
    from aerokit.vehicle.gimbal.hearing import Hearing
    from aerokit.vehicle.gimbal.values import GimbalControllers
    from aerokit.vehicle.orders.bridge import Bridge
    from aerokit.vehicle.state.gimbal import GimbalAttitude

__all__ = ["GimbalPart"]


class GimbalPart:
    """A part of :class:`Gimbal`: its state, and some of its orders."""

    def __init__(self, bridge: Bridge, hearing: Hearing, device: Device | None) -> None:
        self._orders = GimbalOrders(bridge, hearing, device)
        self._bridge, self._talk = bridge, bridge.talk
        shown = self._orders.shown
        self.attitude: StateCell[GimbalAttitude] = shown.attitude
        """Where it points (GIMBAL_DEVICE_ATTITUDE_STATUS of any component of the vehicle, MOUNT_ORIENTATION,
        MOUNT_STATUS). The autopilot is asked for it while somebody waits, follows or observes; reading asks nothing."""
        self.controllers: StateCell[GimbalControllers] = shown.controllers
        """Who is in control of it, as its manager tells by itself (GIMBAL_MANAGER_STATUS)."""

    @property
    def device_id(self) -> int:
        """Its gimbal device id: 1 to 6 behind its manager, or its component id; 0 while none is heard of."""
        return self._orders.device.device_id

    def _now(self) -> float:
        return self._talk.connection.now()
