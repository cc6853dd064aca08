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

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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
        point_gimbal,
        region_of_interest,
        region_of_interest_none,
        set_camera_trigger_distance,
        set_relay,
        set_servo,
        start_video,
        stop_photos,
        stop_video,
        take_photo,
        take_photos,
        trigger_camera,
        vtol_transition,
    )
    from aerokit.missions.compare import Storage
    from aerokit.missions.fence import Fence, FenceCircle, FencePolygon, RallyPoints
    from aerokit.missions.item import MissionItem
    from aerokit.missions.mission import Mission, Plan
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
    from aerokit.missions.plan_file import format_plan, parse_plan, read_plan_file, write_plan_file
    from aerokit.missions.waypoint_file import (
        format_waypoints,
        parse_waypoints,
        read_waypoint_file,
        write_waypoint_file,
    )

__all__ = [
    "Fence",
    "FenceCircle",
    "FencePolygon",
    "Mission",
    "MissionItem",
    "Plan",
    "RallyPoints",
    "Storage",
    "change_speed",
    "condition_delay",
    "condition_distance",
    "condition_yaw",
    "delay",
    "delay_until",
    "enable_fence",
    "format_plan",
    "format_waypoints",
    "jump",
    "jump_tag",
    "jump_to_tag",
    "land",
    "land_start",
    "loiter_time",
    "loiter_to_altitude",
    "loiter_turns",
    "loiter_unlimited",
    "parse_plan",
    "parse_waypoints",
    "point_gimbal",
    "rally_point",
    "read_plan_file",
    "read_waypoint_file",
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
    "write_plan_file",
    "write_waypoint_file",
]

# Imported when first asked for: whoever flies no mission does not pay for these.
_MODULES = {
    "actions": (
        "change_speed condition_delay condition_distance condition_yaw delay delay_until "
        "enable_fence jump jump_tag jump_to_tag land_start set_relay set_servo vtol_transition"
    ),
    "camera": (
        "point_gimbal region_of_interest region_of_interest_none set_camera_trigger_distance "
        "start_video stop_photos stop_video take_photo take_photos trigger_camera"
    ),
    "fence": "Fence FenceCircle FencePolygon",
    "item": "MissionItem",
    "mission": "Mission",
    "navigation": (
        "land loiter_time loiter_to_altitude loiter_turns loiter_unlimited rally_point "
        "return_to_launch spline_waypoint take_off vtol_land vtol_take_off waypoint"
    ),
    "plan": "Plan",
    "plan_file": "format_plan parse_plan read_plan_file write_plan_file",
    "rally": "RallyPoints",
    "storage": "Storage",
    "waypoint_file": "format_waypoints parse_waypoints read_waypoint_file write_waypoint_file",
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"aerokit.missions.{_HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
