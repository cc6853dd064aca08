"""Simulated vehicles that speak MAVLink and fly, without hardware or firmware.

The vehicle classes, such as `SimulatedCopter`, do no I/O: they take bytes and the time, and return bytes.
`SimulatorServer` serves vehicles on links. `simulated_link` returns the client's end of a link in memory.
`open_simulator` listens on addresses:

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
from aerokit.sim.logs import SimulatedLog
from aerokit.sim.motion import HOME, SimulatedWind
from aerokit.sim.px4 import SimulatedPx4, SimulatedPx4Plane
from aerokit.sim.server import SimulatorServer, open_simulator, simulated_link
from aerokit.sim.vehicle import AttachableComponent, ExtraComponent, SimulatedVehicle

__all__ = [
    "HOME",
    "AttachableComponent",
    "BootTimeline",
    "CommandFault",
    "ExtraComponent",
    "Faults",
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
    "SimulatedWind",
    "SimulatorServer",
    "open_simulator",
    "simulated_link",
]
