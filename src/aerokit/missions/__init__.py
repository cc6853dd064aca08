"""Missions, fences and rally points as values: made, checked, compared, and read from and written to files.

```python
from aerokit.missions import Mission, return_to_launch, take_off, waypoint

mission = Mission([
    take_off(altitude_relative_m=20),
    waypoint(47.3977, 8.5456, altitude_relative_m=20, hold_s=5),
    return_to_launch(),
])
```
"""

from __future__ import annotations

from aerokit.missions.fence import Fence, FenceCircle, FencePolygon
from aerokit.missions.item import MissionItem
from aerokit.missions.mission import Mission
from aerokit.missions.rally import RallyPoints
from aerokit.missions.storage import Storage

__all__ = ["Fence", "FenceCircle", "FencePolygon", "Mission", "MissionItem", "RallyPoints", "Storage"]
