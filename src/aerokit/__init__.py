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

from aerokit._internal.imports import installation_problem, lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit import errors as errors
    from aerokit import events as events
    from aerokit._internal.wire import wire_implementation as wire_implementation
    from aerokit.connection.connection import Connection as Connection
    from aerokit.connection.heartbeats import OwnHeartbeat as OwnHeartbeat
    from aerokit.connection.opening import open_connection as open_connection
    from aerokit.events import LinkState as LinkState
    from aerokit.fleets.fleet import Fleet as Fleet
    from aerokit.fleets.formation import Formation as Formation
    from aerokit.fleets.formation import Offset as Offset
    from aerokit.fleets.members import Member as Member
    from aerokit.fleets.members import MemberState as MemberState
    from aerokit.fleets.opening import fleet as fleet
    from aerokit.fleets.policy import FleetResult as FleetResult
    from aerokit.fleets.separation import Deconfliction as Deconfliction
    from aerokit.fleets.show import Show as Show
    from aerokit.hub.hub import Hub as Hub
    from aerokit.hub.values import Endpoint as Endpoint
    from aerokit.mavlink import enums as enums
    from aerokit.mavlink import messages as messages
    from aerokit.mavlink.dialect import Dialect as Dialect
    from aerokit.mavlink.signing import Signing as Signing
    from aerokit.mavlink.signing import SigningKey as SigningKey
    from aerokit.onboard.opening import component as component
    from aerokit.position import Position as Position
    from aerokit.vehicle.commanding.setpoints import AccelerationSetpoint as AccelerationSetpoint
    from aerokit.vehicle.commanding.setpoints import ActuatorSetpoint as ActuatorSetpoint
    from aerokit.vehicle.commanding.setpoints import AttitudeRateSetpoint as AttitudeRateSetpoint
    from aerokit.vehicle.commanding.setpoints import AttitudeSetpoint as AttitudeSetpoint
    from aerokit.vehicle.commanding.setpoints import BodyVelocitySetpoint as BodyVelocitySetpoint
    from aerokit.vehicle.commanding.setpoints import LocalPositionSetpoint as LocalPositionSetpoint
    from aerokit.vehicle.commanding.setpoints import PositionSetpoint as PositionSetpoint
    from aerokit.vehicle.commanding.setpoints import TrajectorySetpoint as TrajectorySetpoint
    from aerokit.vehicle.commanding.setpoints import VelocitySetpoint as VelocitySetpoint
    from aerokit.vehicle.commanding.sticks import StickInput as StickInput
    from aerokit.vehicle.connect import connect as connect
    from aerokit.vehicle.external.values import FlowMeasurement as FlowMeasurement
    from aerokit.vehicle.external.values import GpsMeasurement as GpsMeasurement
    from aerokit.vehicle.external.values import ObstaclePoints as ObstaclePoints
    from aerokit.vehicle.external.values import ObstacleSectors as ObstacleSectors
    from aerokit.vehicle.external.values import OdometryMeasurement as OdometryMeasurement
    from aerokit.vehicle.external.values import PoseMeasurement as PoseMeasurement
    from aerokit.vehicle.external.values import RangeMeasurement as RangeMeasurement
    from aerokit.vehicle.external.values import SpeedMeasurement as SpeedMeasurement
    from aerokit.vehicle.external.values import TargetMeasurement as TargetMeasurement
    from aerokit.vehicle.state.movement import Attitude as Attitude
    from aerokit.vehicle.vehicle import Vehicle as Vehicle

__version__ = "0.1.0"


if (_problem := installation_problem(__path__[0])) is not None:
    import warnings

    warnings.warn(_problem, RuntimeWarning, stacklevel=2)

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "aerokit._internal.wire": ("wire_implementation",),
        "aerokit.connection.connection": ("Connection",),
        "aerokit.connection.opening": ("open_connection",),
        "aerokit.connection.heartbeats": ("OwnHeartbeat",),
        "aerokit.errors": ("errors",),
        "aerokit.events": ("LinkState", "events"),
        "aerokit.fleets.fleet": ("Fleet",),
        "aerokit.fleets.formation": ("Formation", "Offset"),
        "aerokit.fleets.members": ("Member", "MemberState"),
        "aerokit.fleets.opening": ("fleet",),
        "aerokit.fleets.policy": ("FleetResult",),
        "aerokit.fleets.separation": ("Deconfliction",),
        "aerokit.fleets.show": ("Show",),
        "aerokit.hub.hub": ("Hub",),
        "aerokit.hub.values": ("Endpoint",),
        "aerokit.mavlink.dialect": ("Dialect",),
        "aerokit.mavlink.enums": ("enums",),
        "aerokit.mavlink.messages": ("messages",),
        "aerokit.mavlink.signing": ("Signing", "SigningKey"),
        "aerokit.onboard.opening": ("component",),
        "aerokit.position": ("Position",),
        "aerokit.vehicle.commanding.setpoints": (
            "AccelerationSetpoint",
            "ActuatorSetpoint",
            "AttitudeRateSetpoint",
            "AttitudeSetpoint",
            "BodyVelocitySetpoint",
            "LocalPositionSetpoint",
            "PositionSetpoint",
            "TrajectorySetpoint",
            "VelocitySetpoint",
        ),
        "aerokit.vehicle.commanding.sticks": ("StickInput",),
        "aerokit.vehicle.connect": ("connect",),
        "aerokit.vehicle.external.values": (
            "FlowMeasurement",
            "GpsMeasurement",
            "ObstaclePoints",
            "ObstacleSectors",
            "OdometryMeasurement",
            "PoseMeasurement",
            "RangeMeasurement",
            "SpeedMeasurement",
            "TargetMeasurement",
        ),
        "aerokit.vehicle.state.movement": ("Attitude",),
        "aerokit.vehicle.vehicle": ("Vehicle",),
    },
)
