"""What a gimbal can do, and who is in control of it, as values."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from aerokit.mavlink.enums import GimbalManagerCapFlags
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from aerokit.mavlink.messages import (
        GimbalDeviceInformation,
        GimbalManagerInformation,
        GimbalManagerStatus,
    )

__all__ = ["Frame", "GimbalControllers", "GimbalInformation", "controllers_of", "information_of"]

Frame = Literal["earth", "vehicle"]
"""What a yaw counts from, and keeps to: north, or the vehicle's nose."""
Can = GimbalManagerCapFlags


class GimbalControllers(Snapshot):
    """Who is in control of a gimbal: (system id, component id), (0, 0): nobody (GIMBAL_MANAGER_STATUS)."""

    primary: tuple[int, int]
    secondary: tuple[int, int]


class GimbalInformation(Snapshot):
    """What a gimbal is and can do (GIMBAL_MANAGER_INFORMATION, GIMBAL_DEVICE_INFORMATION).

    ``gimbal_device_id``: the component id of the device, or 1 to 6 behind its manager's component, which is
    ``manager_component_id``. ``roll_deg``, ``pitch_deg``, ``yaw_deg``: lowest and highest angle, None: not told. The
    texts are empty, and ``uid`` is 0, of a device that does not tell them.
    """

    gimbal_device_id: int
    manager_component_id: int
    capabilities: int
    roll_deg: tuple[float, float] | None = None
    pitch_deg: tuple[float, float] | None = None
    yaw_deg: tuple[float, float] | None = None
    vendor: str = ""
    model: str = ""
    custom_name: str = ""
    firmware_version: str = ""
    hardware_version: str = ""
    uid: int = 0

    def can(self, capability: int) -> bool:
        """Whether it has this: a member of ``enums.GimbalManagerCapFlags``."""
        return bool(self.capabilities & capability)

    @property
    def retracts(self) -> bool:
        """Whether it can be retracted."""
        return self.can(Can.HAS_RETRACT)

    @property
    def has_neutral(self) -> bool:
        """Whether it has a neutral position."""
        return self.can(Can.HAS_NEUTRAL)

    @property
    def axes(self) -> tuple[str, ...]:
        """Those that it turns about: of ``"roll"``, ``"pitch"``, ``"yaw"``."""
        bits = (("roll", Can.HAS_ROLL_AXIS), ("pitch", Can.HAS_PITCH_AXIS), ("yaw", Can.HAS_YAW_AXIS))
        return tuple(name for name, bit in bits if self.can(bit))

    @property
    def looks_at_places(self) -> bool:
        """Whether its manager says that it can point at a place on the globe."""
        return self.can(Can.CAN_POINT_LOCATION_GLOBAL)


def controllers_of(message: GimbalManagerStatus) -> GimbalControllers:
    """Of GIMBAL_MANAGER_STATUS."""
    return GimbalControllers(
        (message.primary_control_sysid, message.primary_control_compid),
        (message.secondary_control_sysid, message.secondary_control_compid),
    )


def information_of(
    device_id: int,
    manager_id: int,
    manager: GimbalManagerInformation | None,
    device: GimbalDeviceInformation | None,
) -> GimbalInformation:
    """Of what was told; the manager's word goes before the device's."""
    told = manager or device
    assert told is not None
    capabilities = manager.cap_flags if manager is not None else told.cap_flags
    limits = (
        _limits(told.roll_min, told.roll_max),
        _limits(told.pitch_min, told.pitch_max),
        _limits(told.yaw_min, told.yaw_max),
    )
    if device is None:
        return GimbalInformation(device_id, manager_id, capabilities, *limits)
    names = (device.vendor_name, device.model_name, device.custom_name)
    versions = (_version(device.firmware_version), _version(device.hardware_version))
    return GimbalInformation(device_id, manager_id, capabilities, *limits, *names, *versions, device.uid)


def _limits(low: float, high: float) -> tuple[float, float] | None:
    """Zeros are what devices say that do not know."""
    if not (math.isfinite(low) and math.isfinite(high)) or low >= high:
        return None
    return round(math.degrees(low), 2) + 0.0, round(math.degrees(high), 2) + 0.0


def _version(number: int) -> str:
    """Major, minor and patch, each a byte from the lowest on."""
    return "" if not number else f"{number & 0xFF}.{number >> 8 & 0xFF}.{number >> 16 & 0xFF}"
