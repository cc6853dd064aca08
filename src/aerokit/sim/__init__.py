"""Simulated vehicles: they speak MAVLink and fly, without hardware, firmware builds or waiting.

`SimulatedCopter` is the vehicle, without any IO: bytes and the time go in, bytes come out. `SimulatorServer`
puts vehicles on links, `simulated_link` gives the client's end of a link in memory, `open_simulator` serves
addresses:

```python
copter = SimulatedCopter(boot_time_s=1.0)
async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
    ...
    copter.faults.refuse(MavCmd.NAV_TAKEOFF, MavResult.DENIED, "No")
```
"""

from __future__ import annotations

from aerokit.sim.ardupilot import BootTimeline, SimulatedCopter, SimulatedPlane, SimulatedRover, SimulatedSub
from aerokit.sim.components import SimulatedCamera, SimulatedComponent, SimulatedGimbal
from aerokit.sim.faults import CommandFault, Faults
from aerokit.sim.local_frame import HOME
from aerokit.sim.logs import SimulatedLog
from aerokit.sim.motion import Wind
from aerokit.sim.px4 import SimulatedPx4, SimulatedPx4Plane
from aerokit.sim.recorded import RecordedVehicle
from aerokit.sim.server import SimulatorServer, open_simulator, simulated_link
from aerokit.sim.vehicle import Component, ExtraComponent, SimulatedVehicle

__all__ = [
    "HOME",
    "BootTimeline",
    "CommandFault",
    "Component",
    "ExtraComponent",
    "Faults",
    "RecordedVehicle",
    "SimulatedCamera",
    "SimulatedComponent",
    "SimulatedCopter",
    "SimulatedGimbal",
    "SimulatedLog",
    "SimulatedPlane",
    "SimulatedPx4",
    "SimulatedPx4Plane",
    "SimulatedRover",
    "SimulatedSub",
    "SimulatedVehicle",
    "SimulatorServer",
    "Wind",
    "open_simulator",
    "simulated_link",
]
