"""`ExternalRules`: the external measurements that an autopilot accepts, and the parameters that they require."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias

from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import MavFrame

__all__ = ["ARDUPILOT_EXTERNAL", "PX4_EXTERNAL", "ExternalKind", "ExternalRule", "ExternalRules"]

ExternalKind: TypeAlias = Literal[
    "odometry",
    "vision_position",
    "vision_speed",
    "motion_capture",
    "gps",
    "obstacles",
    "obstacle_points",
    "range_finder",
    "landing_target",
    "optical_flow",
]
"""Kind of measurement."""


class ExternalRule(Snapshot):
    """Parameter values with which the autopilot uses one kind of measurement."""

    required: tuple[tuple[tuple[str, ...], tuple[float, ...]], ...] = ()
    """(names, allowed values) of parameters. The autopilot uses the measurement only if each has an allowed value.

    ``names`` are the names of one parameter in different firmware versions.
    """
    sole_source: tuple[tuple[str, tuple[float, ...]], ...] = ()
    """(name, values) of parameters that show whether this measurement is the only source of position or velocity.

    It is if each parameter that the vehicle has is set to one of its ``values``. The vehicle must have the first
    parameter, and may lack the others.
    """


class ExternalRules(Snapshot):
    """Kinds of measurements that an autopilot supports, and differences in the messages that it reads.

    - ``ned_frame``: the MAV_FRAME in ODOMETRY for a pose in north, east, down
    - ``has_mocap``: the estimator reads ATT_POS_MOCAP; otherwise VISION_POSITION_ESTIMATE is sent
    - ``has_vision_speed``: the autopilot reads VISION_SPEED_ESTIMATE; otherwise ODOMETRY without a pose is sent
    - ``flow_in_radians``: the autopilot reads OPTICAL_FLOW_RAD instead of OPTICAL_FLOW
    - ``target_is_local``: the landing target must be in the local frame instead of relative to the vehicle
    - ``constant_position_at_rest``: the flag CONST_POS_MODE is set at rest even if the vehicle has a position
    - ``origin_is_final``: once the local frame has an origin, the autopilot refuses to change it
    """

    kinds: Mapping[ExternalKind, ExternalRule] = {}
    ned_frame: int = MavFrame.LOCAL_NED
    has_mocap: bool = True
    has_vision_speed: bool = True
    flow_in_radians: bool = False
    target_is_local: bool = False
    constant_position_at_rest: bool = False
    origin_is_final: bool = False


def _external_navigation(quantity: str) -> ExternalRule:
    """Return the rule for ArduPilot's external navigation (AP_VisualOdom). ``quantity`` is POSXY or VELXY."""
    # With these values, the estimator has no other source of `quantity`: 6 is ExternalNav, and 0 is none.
    sole_source = (
        (f"EK3_SRC1_{quantity}", (6.0,)),
        (f"EK3_SRC2_{quantity}", (0.0, 6.0)),
        (f"EK3_SRC3_{quantity}", (0.0, 6.0)),
    )
    return ExternalRule(required=((("VISO_TYPE",), (1.0, 2.0, 3.0)),), sole_source=sole_source)


# In EK3_SRC1_POSXY and EK3_SRC2_POSXY, 3 is GPS, and 0 is none.
_GPS_ALONE = (("EK3_SRC1_POSXY", (3.0,)), ("EK3_SRC2_POSXY", (0.0, 3.0)), ("GPS2_TYPE", (0.0,)))

# The values in `required` make ArduPilot read the sensor over MAVLink, e.g. GPS1_TYPE 14.
ARDUPILOT_EXTERNAL = ExternalRules(
    kinds={
        "odometry": _external_navigation("POSXY"),
        "vision_position": _external_navigation("POSXY"),
        "motion_capture": _external_navigation("POSXY"),
        "vision_speed": _external_navigation("VELXY"),
        "gps": ExternalRule(((("GPS1_TYPE", "GPS_TYPE"), (14.0,)),), _GPS_ALONE),
        "obstacles": ExternalRule(((("PRX1_TYPE", "PRX_TYPE"), (2.0,)),)),
        "obstacle_points": ExternalRule(((("PRX1_TYPE", "PRX_TYPE"), (2.0,)),)),
        "range_finder": ExternalRule(((("RNGFND1_TYPE",), (10.0,)),)),
        "landing_target": ExternalRule(((("PLND_ENABLED",), (1.0,)), (("PLND_TYPE",), (1.0,)))),
        "optical_flow": ExternalRule(((("FLOW_TYPE",), (5.0,)),)),
    },
    ned_frame=MavFrame.LOCAL_FRD,  # handle_odometry (GCS_Common.cpp) accepts only this frame and treats it as NED.
    origin_is_final=True,  # set_ekf_origin (GCS_Common.cpp) ignores a second origin.
)

# Bits of EKF2_EV_CTRL: 1 horizontal position, 2 vertical position, 4 velocity, 8 yaw.
# Bits of EKF2_GPS_CTRL: 1 position, 2 altitude, 4 velocity.
_EV_ANY = tuple(float(bits) for bits in range(1, 16))
_EV_VELOCITY = tuple(bits for bits in _EV_ANY if int(bits) & 4)
_NO_GPS_POSITION = tuple(float(bits) for bits in range(16) if not bits & 1)
_VISION_ALONE = (
    ("EKF2_EV_CTRL", tuple(bits for bits in _EV_ANY if int(bits) & 1)),
    ("EKF2_GPS_CTRL", _NO_GPS_POSITION),
)
_VISION = ExternalRule(((("EKF2_EV_CTRL",), _EV_ANY),), _VISION_ALONE)

PX4_EXTERNAL = ExternalRules(
    kinds={
        "odometry": _VISION,
        "vision_position": _VISION,
        "motion_capture": _VISION,
        "vision_speed": ExternalRule(((("EKF2_EV_CTRL",), _EV_VELOCITY),)),
        "obstacles": ExternalRule(),
        "range_finder": ExternalRule(),
        "landing_target": ExternalRule(),
        "optical_flow": ExternalRule(((("EKF2_OF_CTRL",), (1.0,)),)),
    },
    has_mocap=False,  # EKF2.hpp subscribes only to vehicle_visual_odometry.
    has_vision_speed=False,
    flow_in_radians=True,
    constant_position_at_rest=True,  # PX4 sets CONST_POS_MODE at rest, ArduPilot only if no sensor supplies positions.
    target_is_local=True,  # handle_message_landing_target (mavlink_receiver.cpp) refuses other frames.
)
