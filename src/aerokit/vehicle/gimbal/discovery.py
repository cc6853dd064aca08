"""`Hearing`: which gimbals a vehicle has, by what is heard of them."""

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
from aerokit.vehicle.commanding.order import LOOKING
from aerokit.vehicle.gimbal.device import LAST_NUMBER, Claims, Device
from aerokit.vehicle.state.equipment import GimbalAttitude, from_device, from_orientation, from_status

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import Bridge

MOST = 32
"""So many gimbals of one vehicle are known; the standard has component ids for seven."""
OF_GIMBALS = frozenset((154, *range(171, 176)))
"""Component ids of gimbals."""
UNKNOWN = GimbalAttitude(None, None, None, None)
SILENT_S = 10.0
"""A component that was not heard for longer, while the autopilot was heard all the time, is taken for gone."""
BY_STATUS, BY_INFORMATION, IS_AUTOPILOT = 1, 2, 3
"""How much the word of a manager counts: the device itself has the second, whatever it tells."""


class Hearing:
    """Takes what is heard of gimbals. ``first`` is the one that a program means that names none."""

    def __init__(self, bridge: Bridge) -> None:
        self._bridge, self._talk = bridge, bridge.talk
        self.devices: dict[tuple[int, int], Device] = {}
        """Those that were heard of, by their keys."""
        self.nobody: Device = Device(bridge, 0, 0)
        """What stands for the first one while none is heard of; its cells tell of the first one."""
        self.nobody.topic = LOOKING
        self.claims: Claims = Claims()
        """Of control of all its gimbals."""
        self._heard: dict[int, float] = {}
        """When components were heard last, in HEARTBEAT or of gimbals."""
        self._steady_since = math.inf
        """From when on the autopilot was heard without a pause."""
        bridge.talk.on_reboot.append(self._forget)
        self._listen(Heartbeat, self._note_heard)
        self._listen(GimbalDeviceAttitudeStatus, self._on_device)
        self._listen(MountStatus, lambda message: self.nobody.tell(message, from_status(message)))
        self._listen(MountOrientation, self._on_orientation)
        self._listen(GimbalManagerStatus, self._on_status)
        self._listen(GimbalManagerInformation, self._on_manager)
        self._listen(GimbalDeviceInformation, self._on_information)

    @property
    def first(self) -> Device:
        """Of all that were heard of; of those whose component is gone only while no other one is heard."""
        return min(self.devices.values(), key=self.order, default=self.nobody)

    @property
    def telling(self) -> Device | None:
        """Of those that tell where they point the first."""
        telling = [each for each in self.devices.values() if each.attitude.is_known]
        return min(telling, key=self.order, default=None)

    def order(self, device: Device) -> tuple[bool, tuple[int, int]]:
        """By this they are sorted; one that is in use is not given up."""
        return (not device.is_in_use and self._has_gone(device), device.key)

    def silent_for_s(self, component_id: int) -> float:
        """Seconds in which nothing was read of a component; inf: it was never heard."""
        return self._talk.connection.now() - self._heard.get(component_id, -math.inf)

    def _has_gone(self, device: Device) -> bool:
        """One that is never heard itself is told of by its manager."""
        component_id = device.component_id
        if component_id not in self._heard and device.manager_id is not None:
            component_id = device.manager_id
        return not device.is_told or self._is_gone(component_id)

    def _is_gone(self, component_id: int) -> bool:
        heard = self._heard.get
        since = max(self._steady_since, heard(component_id, -math.inf))
        return heard(self._talk.component_id, -math.inf) - since > SILENT_S

    def find(self, device_id: int) -> Device | None:
        """The gimbal of this id; one behind the autopilot goes before others of the same number."""
        found = [each for each in self.devices.values() if each.device_id == device_id]
        return min(
            found, key=lambda each: (each.component_id != self._talk.component_id, each.key), default=None
        )

    def device(self, component_id: int, number: int) -> Device | None:
        """The gimbal of this key, made if need be; None: there are too many already."""
        key = (component_id, number)
        device = self.devices.get(key)
        if device is None and len(self.devices) < MOST:
            device = self.devices[key] = Device(self._bridge, *key)
            if component_id == self._talk.component_id and number == 1:
                device.topic = LOOKING  # what the vehicle looks at, this one does
        return device

    # ----------------------------------------------------------------------------- receiving

    def _listen(self, message_type: type[Message], take: Callable[[Any], None]) -> None:
        bus = self._talk.connection.bus
        if bus.dialect.get(message_type.ID) is not None:
            self._talk.at_close(bus.attach(message_type, take, system_id=self._talk.system_id))

    def _note_heard(self, message: Message) -> None:
        frame = message.received_frame
        if frame is None:
            return
        is_autopilot = frame.component_id == self._talk.component_id
        if is_autopilot and self.silent_for_s(frame.component_id) > SILENT_AFTER_S:
            self._steady_since = self._talk.connection.now()
        self._heard[frame.component_id] = self._talk.connection.now()

    def _of(self, message: Message, device_id: int) -> Device | None:
        """What a device tells: 0 is the sender itself, 1 to 6 are behind it; another id than its own is nobody's."""
        self._note_heard(message)
        frame = message.received_frame
        component_id = self._talk.component_id if frame is None else frame.component_id
        if device_id > LAST_NUMBER and device_id != component_id:
            return None
        has_own_id = component_id > LAST_NUMBER and component_id != self._talk.component_id
        is_itself = device_id > LAST_NUMBER or (device_id == 0 and has_own_id)
        number = 0 if is_itself else device_id or 1  # autopilots of old do not number theirs
        return self._told(self.device(component_id, number))

    def _told(self, device: Device | None) -> Device | None:
        if device is not None:
            device.is_told = True
        return device

    def _on_device(self, message: GimbalDeviceAttitudeStatus) -> None:
        device = self._of(message, message.gimbal_device_id)
        if device is None:
            return
        device.note_flags(message)
        attitude = UNKNOWN
        if all(map(math.isfinite, message.q)):
            attitude = from_device(message, self._heading())
        device.tell(message, attitude)
        if device is self.telling:
            self.nobody.note_flags(message)
            self.nobody.tell(message, attitude)

    def _on_orientation(self, message: MountOrientation) -> None:
        if self.telling is None:
            self.nobody.tell(message, from_orientation(message, self._heading()))

    def _on_status(self, message: GimbalManagerStatus) -> None:
        device = self._managed(message, message.gimbal_device_id)
        if device is not None and device.note_status(message) and device is self.first:
            self.nobody.tell_status(message)

    def _on_manager(self, message: GimbalManagerInformation) -> None:
        device = self._managed(message, message.gimbal_device_id)
        if device is not None:
            device.manager_information = message

    def _managed(
        self, message: GimbalManagerStatus | GimbalManagerInformation, device_id: int
    ) -> Device | None:
        """What its manager tells; only the one that counts is listened to."""
        frame = message.received_frame
        if frame is None:
            return None
        sender = frame.component_id
        rank = BY_INFORMATION if isinstance(message, GimbalManagerInformation) else BY_STATUS
        if sender == self._talk.component_id:
            rank = IS_AUTOPILOT
        if device_id > LAST_NUMBER and device_id != sender:
            self._note_heard(message)
            device = self._of_another(device_id, may_be_new=rank > BY_STATUS)
        else:
            device, rank = self._of(message, device_id), max(rank, BY_INFORMATION)
        if device is None:
            return None
        is_gone = device.manager_id is not None and self._is_gone(device.manager_id)
        device.note_manager(sender, rank, is_gone=is_gone)
        return device if device.manager_id == sender else None

    def _of_another(self, device_id: int, *, may_be_new: bool) -> Device | None:
        """What a manager tells of a device with an id of its own: of a gimbal, or of what was heard."""
        key = (device_id, 0)
        if key in self.devices or (may_be_new and device_id in OF_GIMBALS):
            return self._told(self.device(*key))
        return None

    def _on_information(self, message: GimbalDeviceInformation) -> None:
        device = self._of(message, message.gimbal_device_id)
        if device is not None:
            device.device_information = message

    def _heading(self) -> float | None:
        """Degrees clockwise from north in which the vehicle's nose points."""
        attitude = self._talk.telemetry.attitude.latest
        return None if attitude is None else attitude.yaw_deg

    def _forget(self) -> None:
        """The cells have been forgotten; who has a gimbal in its hands keeps it."""
        for each in (*self.devices.values(), self.nobody):
            each.forget()
