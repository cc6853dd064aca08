"""Everything that a simulated ArduCopter can send when it is asked for it by id."""

from __future__ import annotations

from aerokit.mavlink.messages import FenceStatus
from aerokit.sim.ardupilot.camera import CAMERA_BUILDERS
from aerokit.sim.ardupilot.fence import fence_status
from aerokit.sim.ardupilot.gimbal_status import GIMBAL_BUILDERS
from aerokit.sim.ardupilot.telemetry_attitude import ATTITUDE_BUILDERS
from aerokit.sim.ardupilot.telemetry_position import POSITION_BUILDERS
from aerokit.sim.ardupilot.telemetry_state import STATE_BUILDERS

__all__ = ["BUILDERS"]

BUILDERS = {
    **STATE_BUILDERS,
    **ATTITUDE_BUILDERS,
    **POSITION_BUILDERS,
    **GIMBAL_BUILDERS,
    **CAMERA_BUILDERS,
    FenceStatus.ID: fence_status,
}
"""Message id → function that makes such a message of the copter's present state, or None."""
