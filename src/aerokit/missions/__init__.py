"""Missions, fences and rally points: building, checking and comparing them, and reading and writing their files.

```python
from aerokit.missions import Mission, return_to_launch, take_off, waypoint

mission = Mission([
    take_off(20),
    waypoint(47.3977, 8.5456, altitude_relative_m=20, hold_s=5),
    return_to_launch(),
])
```
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.missions.actions import change_speed as change_speed
    from aerokit.missions.actions import condition_delay as condition_delay
    from aerokit.missions.actions import condition_distance as condition_distance
    from aerokit.missions.actions import condition_yaw as condition_yaw
    from aerokit.missions.actions import delay as delay
    from aerokit.missions.actions import delay_until as delay_until
    from aerokit.missions.actions import enable_fence as enable_fence
    from aerokit.missions.actions import jump as jump
    from aerokit.missions.actions import jump_tag as jump_tag
    from aerokit.missions.actions import jump_to_tag as jump_to_tag
    from aerokit.missions.actions import land_start as land_start
    from aerokit.missions.actions import point_gimbal as point_gimbal
    from aerokit.missions.actions import region_of_interest as region_of_interest
    from aerokit.missions.actions import region_of_interest_none as region_of_interest_none
    from aerokit.missions.actions import set_camera_trigger_distance as set_camera_trigger_distance
    from aerokit.missions.actions import set_relay as set_relay
    from aerokit.missions.actions import set_servo as set_servo
    from aerokit.missions.actions import start_video as start_video
    from aerokit.missions.actions import stop_photos as stop_photos
    from aerokit.missions.actions import stop_video as stop_video
    from aerokit.missions.actions import take_photo as take_photo
    from aerokit.missions.actions import take_photos as take_photos
    from aerokit.missions.actions import trigger_camera as trigger_camera
    from aerokit.missions.actions import vtol_transition as vtol_transition
    from aerokit.missions.compare import ItemStorage as ItemStorage
    from aerokit.missions.item import MissionItem as MissionItem
    from aerokit.missions.mission import Fence as Fence
    from aerokit.missions.mission import FenceCircle as FenceCircle
    from aerokit.missions.mission import FencePolygon as FencePolygon
    from aerokit.missions.mission import Mission as Mission
    from aerokit.missions.mission import Plan as Plan
    from aerokit.missions.mission import RallyPoints as RallyPoints
    from aerokit.missions.navigation import land as land
    from aerokit.missions.navigation import loiter_time as loiter_time
    from aerokit.missions.navigation import loiter_to_altitude as loiter_to_altitude
    from aerokit.missions.navigation import loiter_turns as loiter_turns
    from aerokit.missions.navigation import loiter_unlimited as loiter_unlimited
    from aerokit.missions.navigation import rally_point as rally_point
    from aerokit.missions.navigation import return_to_launch as return_to_launch
    from aerokit.missions.navigation import spline_waypoint as spline_waypoint
    from aerokit.missions.navigation import take_off as take_off
    from aerokit.missions.navigation import vtol_land as vtol_land
    from aerokit.missions.navigation import vtol_take_off as vtol_take_off
    from aerokit.missions.navigation import waypoint as waypoint
    from aerokit.missions.plan_file import format_plan as format_plan
    from aerokit.missions.plan_file import parse_plan as parse_plan
    from aerokit.missions.plan_file import read_plan_file as read_plan_file
    from aerokit.missions.plan_file import write_plan_file as write_plan_file
    from aerokit.missions.waypoint_file import format_waypoints as format_waypoints
    from aerokit.missions.waypoint_file import parse_waypoints as parse_waypoints
    from aerokit.missions.waypoint_file import read_waypoint_file as read_waypoint_file
    from aerokit.missions.waypoint_file import write_waypoint_file as write_waypoint_file

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "aerokit.missions.actions": (
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
            "land_start",
            "point_gimbal",
            "region_of_interest",
            "region_of_interest_none",
            "set_camera_trigger_distance",
            "set_relay",
            "set_servo",
            "start_video",
            "stop_photos",
            "stop_video",
            "take_photo",
            "take_photos",
            "trigger_camera",
            "vtol_transition",
        ),
        "aerokit.missions.compare": ("ItemStorage",),
        "aerokit.missions.item": ("MissionItem",),
        "aerokit.missions.mission": (
            "Fence",
            "FenceCircle",
            "FencePolygon",
            "Mission",
            "Plan",
            "RallyPoints",
        ),
        "aerokit.missions.navigation": (
            "land",
            "loiter_time",
            "loiter_to_altitude",
            "loiter_turns",
            "loiter_unlimited",
            "rally_point",
            "return_to_launch",
            "spline_waypoint",
            "take_off",
            "vtol_land",
            "vtol_take_off",
            "waypoint",
        ),
        "aerokit.missions.plan_file": ("format_plan", "parse_plan", "read_plan_file", "write_plan_file"),
        "aerokit.missions.waypoint_file": (
            "format_waypoints",
            "parse_waypoints",
            "read_waypoint_file",
            "write_waypoint_file",
        ),
    },
)
