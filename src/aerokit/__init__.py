"""aerokit: control drones over MAVLink from asyncio.

```python
import asyncio, aerokit

async def main():
    async with aerokit.connect("udpin:0.0.0.0:14550") as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(altitude_m=10)
        await vehicle.land()

asyncio.run(main())
```
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.installed import complaint
from aerokit.lazy import lazy_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit import errors, events
    from aerokit.fleets.apart import Deconfliction
    from aerokit.fleets.fleet import Fleet
    from aerokit.fleets.formation import Formation, Offset
    from aerokit.fleets.members import Member, MemberState
    from aerokit.fleets.opening import fleet
    from aerokit.fleets.results import FleetResult
    from aerokit.fleets.show import Show
    from aerokit.hub.hub import Hub
    from aerokit.hub.values import Endpoint
    from aerokit.mavlink import enums, messages
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.signing import Signing, SigningKey
    from aerokit.position import Position
    from aerokit.runtime.connection import Connection
    from aerokit.runtime.link_state import LinkState
    from aerokit.runtime.opening import open_connection
    from aerokit.runtime.own_heartbeat import OwnHeartbeat
    from aerokit.vehicle.connect import connect
    from aerokit.vehicle.orders.setpoints import (
        AccelerationSetpoint,
        AttitudeSetpoint,
        BodyVelocitySetpoint,
        LocalPositionSetpoint,
        PositionSetpoint,
        VelocitySetpoint,
    )
    from aerokit.vehicle.vehicle import Vehicle

__version__ = "0.1.0"

__all__ = [
    "AccelerationSetpoint",
    "AttitudeSetpoint",
    "BodyVelocitySetpoint",
    "Connection",
    "Deconfliction",
    "Dialect",
    "Endpoint",
    "Fleet",
    "FleetResult",
    "Formation",
    "Hub",
    "LinkState",
    "LocalPositionSetpoint",
    "Member",
    "MemberState",
    "Offset",
    "OwnHeartbeat",
    "Position",
    "PositionSetpoint",
    "Show",
    "Signing",
    "SigningKey",
    "Vehicle",
    "VelocitySetpoint",
    "connect",
    "enums",
    "errors",
    "events",
    "fleet",
    "messages",
    "open_connection",
]

# Imported when first asked for: whoever wants `aerokit.messages` does not pay for asyncio.
_HOMES = {
    "AccelerationSetpoint": "aerokit.vehicle.orders.setpoints",
    "AttitudeSetpoint": "aerokit.vehicle.orders.setpoints",
    "BodyVelocitySetpoint": "aerokit.vehicle.orders.setpoints",
    "Connection": "aerokit.runtime.connection",
    "OwnHeartbeat": "aerokit.runtime.own_heartbeat",
    "Deconfliction": "aerokit.fleets.apart",
    "Dialect": "aerokit.mavlink.dialect",
    "Endpoint": "aerokit.hub.values",
    "Hub": "aerokit.hub.hub",
    "Fleet": "aerokit.fleets.fleet",
    "FleetResult": "aerokit.fleets.results",
    "Formation": "aerokit.fleets.formation",
    "LinkState": "aerokit.runtime.link_state",
    "LocalPositionSetpoint": "aerokit.vehicle.orders.setpoints",
    "Member": "aerokit.fleets.members",
    "MemberState": "aerokit.fleets.members",
    "Offset": "aerokit.fleets.formation",
    "Position": "aerokit.position",
    "PositionSetpoint": "aerokit.vehicle.orders.setpoints",
    "Show": "aerokit.fleets.show",
    "Signing": "aerokit.mavlink.signing",
    "SigningKey": "aerokit.mavlink.signing",
    "Vehicle": "aerokit.vehicle.vehicle",
    "VelocitySetpoint": "aerokit.vehicle.orders.setpoints",
    "connect": "aerokit.vehicle.connect",
    "enums": "aerokit.mavlink.enums",
    "errors": "aerokit.errors",
    "events": "aerokit.events",
    "fleet": "aerokit.fleets.opening",
    "messages": "aerokit.mavlink.messages",
    "open_connection": "aerokit.runtime.opening",
}

if (_mixed := complaint(__path__[0])) is not None:
    import warnings

    warnings.warn(_mixed, RuntimeWarning, stacklevel=2)

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__ = lazy_names(__name__, _HOMES, __all__)
