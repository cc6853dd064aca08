"""Cameras and gimbals with a component id of their own, for any simulated vehicle.

```python
copter = SimulatedCopter(components=[SimulatedCamera(), SimulatedGimbal()])
```
"""

from __future__ import annotations

from aerokit.sim.components.camera import SimulatedCamera
from aerokit.sim.components.component import SimulatedComponent, serve_files
from aerokit.sim.components.gimbal import SimulatedGimbal

__all__ = ["SimulatedCamera", "SimulatedComponent", "SimulatedGimbal", "serve_files"]
