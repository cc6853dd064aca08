"""Simulated cameras and gimbals: separate MAVLink components that any simulated vehicle can carry.

```python
copter = SimulatedCopter(components=[SimulatedCamera(), SimulatedGimbal()])
```
"""

from __future__ import annotations

from aerokit.sim.components.camera import SimulatedCamera
from aerokit.sim.components.component import SimulatedComponent, serve_files
from aerokit.sim.components.gimbal import SimulatedGimbal

__all__ = ["SimulatedCamera", "SimulatedComponent", "SimulatedGimbal", "serve_files"]
