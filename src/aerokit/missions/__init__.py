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

from aerokit.missions.actions import (
    change_speed,
    condition_delay,
    condition_distance,
    condition_yaw,
    delay,
    delay_until,
    enable_fence,
    jump,
    jump_tag,
    jump_to_tag,
    land_start,
    set_relay,
    set_servo,
    vtol_transition,
)
from aerokit.missions.camera import (
    point_gimbal,
    region_of_interest,
    region_of_interest_none,
    set_camera_trigger_distance,
    start_video,
    stop_photos,
    stop_video,
    take_photo,
    take_photos,
    trigger_camera,
)
from aerokit.missions.fence import Fence, FenceCircle, FencePolygon
from aerokit.missions.item import MissionItem
from aerokit.missions.mission import Mission
from aerokit.missions.navigation import (
    land,
    loiter_time,
    loiter_to_altitude,
    loiter_turns,
    loiter_unlimited,
    rally_point,
    return_to_launch,
    spline_waypoint,
    take_off,
    vtol_land,
    vtol_take_off,
    waypoint,
)
from aerokit.missions.rally import RallyPoints
from aerokit.missions.storage import Storage

__all__ = [
    "Fence",
    "FenceCircle",
    "FencePolygon",
    "Mission",
    "MissionItem",
    "RallyPoints",
    "Storage",
    "change_speed",
    "condition_delay",
    "condition_distance",
    "condition_yaw",
    "delay",
    "delay_until",
    "enable_fence",
    "jump",
    "jump_tag",
    "jump_to_tag",
    "land",
    "land_start",
    "loiter_time",
    "loiter_to_altitude",
    "loiter_turns",
    "loiter_unlimited",
    "point_gimbal",
    "rally_point",
    "region_of_interest",
    "region_of_interest_none",
    "return_to_launch",
    "set_camera_trigger_distance",
    "set_relay",
    "set_servo",
    "spline_waypoint",
    "start_video",
    "stop_photos",
    "stop_video",
    "take_off",
    "take_photo",
    "take_photos",
    "trigger_camera",
    "vtol_land",
    "vtol_take_off",
    "vtol_transition",
    "waypoint",
]
