"""What a component is: by its heartbeat, by its id, and by what it tells of itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavComponent, MavType
from aerokit.runtime.components import is_autopilot
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from aerokit.mavlink.messages import ComponentInformationBasic, Heartbeat

__all__ = ["ComponentInformation", "ComponentStatus", "information_of", "kind_of"]


class ComponentStatus(Snapshot):
    """One component of the vehicle's system, as far as it was heard.

    ``kind`` is ``"autopilot"``, ``"camera"``, ``"gimbal"``, ``"onboard_controller"``, ``"adsb"``, ``"parachute"`` …:
    MAV_TYPE in small letters. ``device_id`` is 0, or 1 to 6 for a camera or gimbal without a component id of its own,
    behind the component that speaks for it. ``heard_at`` is when it was last heard, on the loop's clock.
    """

    component_id: int
    device_id: int
    kind: str
    heard_at: float


class ComponentInformation(Snapshot):
    """What a component says of itself (COMPONENT_INFORMATION_BASIC); texts are empty where it tells nothing.

    ``capabilities`` are MAV_PROTOCOL_CAPABILITY bits; ``manufactured_at`` is in seconds since 1970, None if not told.
    """

    vendor: str
    model: str
    software_version: str
    hardware_version: str
    serial_number: str
    capabilities: int
    manufactured_at: int | None


def kind_of(heartbeat: Heartbeat | None, component_id: int) -> str:
    """The kind of a component: of one whose type says nothing, by its id."""
    if heartbeat is not None and is_autopilot(heartbeat):
        return "autopilot"
    if heartbeat is not None and heartbeat.type != MavType.GENERIC:
        return _name(MavType, heartbeat.type)
    return _name(MavComponent, component_id) if heartbeat is not None else "unknown"


def information_of(message: ComponentInformationBasic) -> ComponentInformation:
    """The same in words."""
    return ComponentInformation(
        message.vendor_name,
        message.model_name,
        message.software_version,
        message.hardware_version,
        message.serial_number,
        message.capabilities,
        message.time_manufacture_s or None,
    )


def _name(enum: type[MavType | MavComponent], number: int) -> str:
    try:
        return enum(number).name.lower()
    except ValueError:
        return "unknown"
