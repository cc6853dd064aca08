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

from aerokit import errors, events
from aerokit.mavlink import enums, messages
from aerokit.mavlink.dialect import Dialect
from aerokit.runtime.connection import Connection, open_connection
from aerokit.vehicle.connect import connect
from aerokit.vehicle.setpoints import (
    AccelerationSetpoint,
    AttitudeSetpoint,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    VelocitySetpoint,
)
from aerokit.vehicle.values import Position
from aerokit.vehicle.vehicle import Vehicle

__version__ = "0.1.0"

__all__ = [
    "AccelerationSetpoint",
    "AttitudeSetpoint",
    "BodyVelocitySetpoint",
    "Connection",
    "Dialect",
    "LocalPositionSetpoint",
    "Position",
    "PositionSetpoint",
    "Vehicle",
    "VelocitySetpoint",
    "connect",
    "enums",
    "errors",
    "events",
    "messages",
    "open_connection",
]
