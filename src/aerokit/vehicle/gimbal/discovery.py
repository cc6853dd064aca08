"""`GimbalRegistry`: discovers the gimbals of a vehicle from their messages."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from aerokit.events import SILENT_AFTER_S
from aerokit.mavlink.messages import (
    GimbalDeviceAttitudeStatus,
    GimbalDeviceInformation,
    GimbalManagerInformation,
    GimbalManagerStatus,
    Heartbeat,
    MountOrientation,
    MountStatus,
)
from aerokit.vehicle.commanding.order import ROI
from aerokit.vehicle.gimbal.device import MAX_GIMBAL_NUMBER, ControlRequest, GimbalDevice
from aerokit.vehicle.state.equipment import GimbalAttitude, from_device, from_orientation, from_status

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext

# MAVLink has component ids for six gimbals. The limit protects against corrupt ids.
MAX_GIMBALS = 32
GIMBAL_COMPONENT_IDS = frozenset((154, *range(171, 176)))
UNKNOWN_ATTITUDE = GimbalAttitude(None, None, None, None)
HEADING_MAX_AGE_S = 5.0
# A component counts as gone if it is silent for this many seconds while the autopilot is not.
MAX_SILENCE_S = 10.0
# If several components send the messages of a gimbal manager, the one with the highest rank gets the orders. The rank
# depends on the message; the autopilot always has the highest.
RANK_STATUS, RANK_INFORMATION, RANK_AUTOPILOT = 1, 2, 3


class GimbalRegistry:
    """The gimbals of one vehicle, created as their messages arrive."""

    def __init__(self, context: VehicleContext) -> None:
        self._context, self._session = context, context.session
        # Maps (component id, number) to the gimbal; the number is 0 if the component itself is the gimbal.
        self.devices: dict[tuple[int, int], GimbalDevice] = {}
        # Represents the first gimbal until one is discovered, and receives the values of the first gimbal afterwards.
        # MOUNT_STATUS and MOUNT_ORIENTATION, which have no gimbal id, set only the values of this placeholder.
        self.placeholder: GimbalDevice = GimbalDevice(context, 0, 0)
        self.placeholder.topic = ROI
        # Requests of this program's `gimbal.control()` blocks that have not ended.
        self.control_requests: list[ControlRequest] = []
        # Maps component id to the loop time of the last HEARTBEAT or gimbal message.
        self._received_at: dict[int, float] = {}
        # Time of the first HEARTBEAT after the autopilot's last silence.
        self._steady_since = math.inf
        context.session.on_reboot.append(self._on_reboot)
        self._listen(Heartbeat, self._record_received)
        self._listen(GimbalDeviceAttitudeStatus, self._on_attitude)
        self._listen(MountStatus, lambda message: self.placeholder.set_attitude(message, from_status(message)))
        self._listen(MountOrientation, self._on_orientation)
        self._listen(GimbalManagerStatus, self._on_manager_status)
        self._listen(GimbalManagerInformation, self._on_manager_information)
        self._listen(GimbalDeviceInformation, self._on_device_information)

    @property
    def first(self) -> GimbalDevice:
        """The gimbal that ``vehicle.gimbal`` stands for."""
        return min(self.devices.values(), key=self.sort_key, default=self.placeholder)

    @property
    def first_reporting(self) -> GimbalDevice | None:
        reporting = [device for device in self.devices.values() if device.attitude.is_known]
        return min(reporting, key=self.sort_key, default=None)

    def sort_key(self, device: GimbalDevice) -> tuple[bool, tuple[int, int]]:
        # Gimbals that are gone come last. A gimbal in use does not count as gone.
        return (not device.is_in_use and self._is_device_gone(device), device.key)

    def silent_for_s(self, component_id: int) -> float:
        return self._session.connection.now() - self._received_at.get(component_id, -math.inf)

    def _is_device_gone(self, device: GimbalDevice) -> bool:
        # If a device sends no messages itself, use the time of its manager's messages.
        component_id = device.component_id
        if component_id not in self._received_at and device.manager_id is not None:
            component_id = device.manager_id
        return not device.is_discovered or self._is_component_gone(component_id)

    def _is_component_gone(self, component_id: int) -> bool:
        """Return True if this component is silent while the autopilot is not."""
        silent_since = max(self._steady_since, self._received_at.get(component_id, -math.inf))
        autopilot_received_at = self._received_at.get(self._session.component_id, -math.inf)
        return autopilot_received_at - silent_since > MAX_SILENCE_S

    def find(self, device_id: int) -> GimbalDevice | None:
        matching = [device for device in self.devices.values() if device.device_id == device_id]
        autopilot_id = self._session.component_id
        # A gimbal attached to the autopilot takes precedence over others with the same id.
        return min(matching, key=lambda device: (device.component_id != autopilot_id, device.key), default=None)

    def get_or_create(self, component_id: int, number: int) -> GimbalDevice | None:
        """Return a gimbal, and create it if needed. Return None if there are ``MAX_GIMBALS`` others."""
        key = (component_id, number)
        device = self.devices.get(key)
        if device is None and len(self.devices) < MAX_GIMBALS:
            device = GimbalDevice(self._context, component_id, number)
            self.devices[key] = device
            if component_id == self._session.component_id and number == 1:
                device.topic = ROI  # The vehicle's region of interest moves this gimbal.
        return device

    def _listen(self, message_type: type[Message], callback: Callable[[Any], None]) -> None:
        bus = self._session.connection.bus
        if bus.dialect.get(message_type.ID) is not None:
            self._session.at_close(bus.attach(message_type, callback, system_id=self._session.system_id))

    def _record_received(self, message: Message) -> None:
        frame = message.received_frame
        if frame is None:
            return
        is_autopilot = frame.component_id == self._session.component_id
        if is_autopilot and self.silent_for_s(frame.component_id) > SILENT_AFTER_S:
            self._steady_since = self._session.connection.now()
        self._received_at[frame.component_id] = self._session.connection.now()

    def _device_of(self, message: Message, device_id: int) -> GimbalDevice | None:
        """Return the gimbal that a message is about, or None if it is about no gimbal."""
        self._record_received(message)
        frame = message.received_frame
        component_id = self._session.component_id if frame is None else frame.component_id
        if device_id > MAX_GIMBAL_NUMBER and device_id != component_id:
            return None  # The message is about another component.
        has_own_id = component_id > MAX_GIMBAL_NUMBER and component_id != self._session.component_id
        # A sender with its own component id may send 0 for itself.
        is_sender = device_id > MAX_GIMBAL_NUMBER or (device_id == 0 and has_own_id)
        attached_number = device_id or 1  # Older autopilots send 0 for their gimbal.
        number = 0 if is_sender else attached_number
        return self._marked_discovered(self.get_or_create(component_id, number))

    def _marked_discovered(self, device: GimbalDevice | None) -> GimbalDevice | None:
        if device is not None:
            device.is_discovered = True
        return device

    def _on_attitude(self, message: GimbalDeviceAttitudeStatus) -> None:
        device = self._device_of(message, message.gimbal_device_id)
        if device is None:
            return
        device.update_flags(message)
        attitude = UNKNOWN_ATTITUDE
        if all(map(math.isfinite, message.q)):
            attitude = from_device(message, self.heading())
        device.set_attitude(message, attitude)
        if device is self.first_reporting:
            self.placeholder.update_flags(message)
            self.placeholder.set_attitude(message, attitude)

    def _on_orientation(self, message: MountOrientation) -> None:
        if self.first_reporting is None:
            self.placeholder.set_attitude(message, from_orientation(message, self.heading()))

    def _on_manager_status(self, message: GimbalManagerStatus) -> None:
        device = self._managed_device(message, message.gimbal_device_id)
        if device is None:
            return
        is_newest = device.update_status(message)
        if is_newest and device is self.first:
            self.placeholder.set_controllers(message)

    def _on_manager_information(self, message: GimbalManagerInformation) -> None:
        device = self._managed_device(message, message.gimbal_device_id)
        if device is not None:
            device.manager_information = message

    def _managed_device(
        self, message: GimbalManagerStatus | GimbalManagerInformation, device_id: int
    ) -> GimbalDevice | None:
        """Return the gimbal if the sender of this message is its manager, otherwise None.

        A sender that outranks the known manager becomes the manager.
        """
        frame = message.received_frame
        if frame is None:
            return None
        sender = frame.component_id
        rank = RANK_INFORMATION if isinstance(message, GimbalManagerInformation) else RANK_STATUS
        if sender == self._session.component_id:
            rank = RANK_AUTOPILOT
        if device_id > MAX_GIMBAL_NUMBER and device_id != sender:
            self._record_received(message)
            device = self._device_with_own_id(device_id, may_be_new=rank > RANK_STATUS)
        else:  # The gimbal is the sender, or attached to it.
            device = self._device_of(message, device_id)
            # A status about the sender's own gimbal is as reliable as GIMBAL_MANAGER_INFORMATION.
            rank = max(rank, RANK_INFORMATION)
        if device is None:
            return None
        is_known_manager_gone = device.manager_id is not None and self._is_component_gone(device.manager_id)
        device.update_manager(sender, rank, is_known_manager_gone=is_known_manager_gone)
        return device if device.manager_id == sender else None

    def _device_with_own_id(self, device_id: int, *, may_be_new: bool) -> GimbalDevice | None:
        # GIMBAL_MANAGER_STATUS may name a device that does not exist; GIMBAL_MANAGER_INFORMATION names existing ones.
        if (device_id, 0) in self.devices or (may_be_new and device_id in GIMBAL_COMPONENT_IDS):
            return self._marked_discovered(self.get_or_create(device_id, number=0))
        return None

    def _on_device_information(self, message: GimbalDeviceInformation) -> None:
        device = self._device_of(message, message.gimbal_device_id)
        if device is not None:
            device.device_information = message

    def heading(self) -> float | None:
        """Return the vehicle's heading in degrees, or None if no recent one is known."""
        attitude = self._session.telemetry.attitude
        return attitude.value.yaw_deg if attitude.age <= HEADING_MAX_AGE_S else None

    def _on_reboot(self) -> None:
        # `reset` keeps open `gimbal.control()` blocks and pending orders, which outlast a reboot of the vehicle.
        for device in (*self.devices.values(), self.placeholder):
            device.reset()
