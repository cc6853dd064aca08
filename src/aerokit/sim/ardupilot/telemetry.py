"""Everything that each simulated ArduPilot can send when it is asked for it by id."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from aerokit.mavlink import messages as m
from aerokit.sim.ardupilot import servo_outputs as outputs
from aerokit.sim.ardupilot import telemetry_extra as extra
from aerokit.sim.ardupilot.calibration import CALIBRATION_BUILDERS
from aerokit.sim.ardupilot.camera import CAMERA_BUILDERS
from aerokit.sim.ardupilot.fence import fence_status
from aerokit.sim.ardupilot.gimbal_status import GIMBAL_BUILDERS
from aerokit.sim.ardupilot.telemetry_attitude import ATTITUDE_BUILDERS
from aerokit.sim.ardupilot.telemetry_position import POSITION_BUILDERS
from aerokit.sim.ardupilot.telemetry_state import STATE_BUILDERS

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.ardupilot.parameter_tables import Kind

__all__ = ["BUILDERS", "Builders"]

Builders = Mapping[int, "Callable[[Any], Message | None]"]
"""Message id → function that makes such a message of the vehicle's present state, or None."""

_ALL = {
    **STATE_BUILDERS,
    **ATTITUDE_BUILDERS,
    **POSITION_BUILDERS,
    **GIMBAL_BUILDERS,
    **CAMERA_BUILDERS,
    **extra.EXTRA_BUILDERS,
    m.FenceStatus.ID: fence_status,
    **CALIBRATION_BUILDERS,
}
_FLYING = (m.Wind.ID, m.TerrainReport.ID, m.EscTelemetry1To4.ID)
_COPTER_TARGETS = (m.AttitudeTarget.ID, m.PositionTargetLocalNed.ID)


def _without(*message_ids: int) -> dict[int, Any]:
    return {number: builder for number, builder in _ALL.items() if number not in message_ids}


BUILDERS: dict[Kind, Builders] = {
    "copter": {
        **_ALL,
        m.ServoOutputRaw.ID: outputs.copter_outputs,
        m.TerrainRequest.ID: extra.terrain_request,
    },
    "plane": {
        **_without(*_COPTER_TARGETS),
        m.ServoOutputRaw.ID: outputs.plane_outputs,
        m.TerrainRequest.ID: extra.terrain_request,
        m.Airspeed.ID: extra.airspeed,
        m.AoaSsa.ID: extra.angles_of_flow,
    },
    "rover": {
        **_without(*_FLYING, *_COPTER_TARGETS),
        m.ServoOutputRaw.ID: outputs.rover_outputs,
        m.RcChannelsScaled.ID: extra.scaled_channels,
        m.VfrHud.ID: extra.rover_hud,
        m.ExtendedSysState.ID: extra.no_landed_state,
    },
    "sub": {
        **_without(m.Wind.ID, m.EscTelemetry1To4.ID, *_COPTER_TARGETS),
        m.ServoOutputRaw.ID: outputs.sub_outputs,
        m.NamedValueFloat.ID: extra.display_value,
        m.ScaledPressure3.ID: extra.outside_pressure,
        m.ExtendedSysState.ID: extra.no_landed_state,
    },
}
"""Kind → builders; what is not there is not sent."""
