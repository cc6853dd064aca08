"""``Components``: what is on board of one vehicle, as it is heard."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.connection.cells import Source, StateCell
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.vehicle.components.component import Component, ComponentStatus, kind_of
from aerokit.vehicle.components.session import ComponentTalk
from aerokit.vehicle.files.files import Files
from aerokit.vehicle.parameters.parameters import Parameters

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.mavlink.frame import Frame
    from aerokit.vehicle.commanding.context import Bridge

DEVICES = (1, 6)
"""Ids of devices that have no component id of their own."""
TELL_OF_DEVICES = (
    (m.CameraInformation, "camera_device_id", "camera"),
    (m.GimbalManagerInformation, "gimbal_device_id", "gimbal"),
    (m.GimbalDeviceAttitudeStatus, "gimbal_device_id", "gimbal"),
)


class Components:
    """Keeps the list of components, and the objects that were made of them."""

    def __init__(
        self, bridge: Bridge, files: Callable[[], Files], parameters: Callable[[], Parameters]
    ) -> None:
        self._bridge, self._talk = bridge, bridge.talk
        self._files, self._parameters = files, parameters
        self._made: dict[int, Component] = {}
        self._heard: dict[tuple[int, int], ComponentStatus] = {}
        talk = bridge.talk
        self.cell: StateCell[tuple[ComponentStatus, ...]] = talk.connection.new_cell(
            "components", "HEARTBEAT"
        )
        talk.keep(self.cell)
        bus = talk.connection.bus
        talk.at_close(bus.attach(m.Heartbeat, self._on_heartbeat, system_id=talk.system_id))
        for message_type, field, kind in TELL_OF_DEVICES:
            if bus.dialect.get(message_type.ID) is not None:
                talk.at_close(bus.attach(message_type, self._listener(field, kind), system_id=talk.system_id))
        for (system_id, _), heartbeat in talk.connection.heard.items():
            if system_id == talk.system_id:
                self._on_heartbeat(heartbeat)

    def component(self, component_id: int) -> Component:
        """The object of one component, the same each time; it need not have been heard yet."""
        if not 1 <= component_id <= 255:
            raise InvalidArgument(f"component_id = {component_id} is not allowed: 1 to 255")
        if component_id not in self._made:
            self._made[component_id] = self._new(component_id)
        return self._made[component_id]

    def _new(self, component_id: int) -> Component:
        sender = self._bridge.sender
        if component_id == self._talk.component_id:
            return Component(self._talk, sender, self._files, self._parameters, self.component)
        talk = ComponentTalk(self._talk, component_id)
        files = Files(talk.transfers)
        return Component(talk, sender, lambda: files, lambda: Parameters(talk, files), self.component)

    def _on_heartbeat(self, heartbeat: m.Heartbeat) -> None:
        frame = heartbeat.received_frame
        if frame is not None:
            self._note(frame, 0, kind_of(heartbeat, frame.component_id))

    def _listener(self, field: str, kind: str) -> Any:
        first, last = DEVICES

        def take(message: Any) -> None:
            number, frame = getattr(message, field), message.received_frame
            if frame is not None and first <= number <= last:
                self._note(frame, number, kind)

        return take

    def _note(self, frame: Frame, device_id: int, kind: str) -> None:
        key = frame.component_id, device_id
        self._heard[key] = ComponentStatus(*key, kind, frame.received_at)
        source = Source(frame.system_id, frame.component_id, "HEARTBEAT")
        self.cell.set(tuple(self._heard[each] for each in sorted(self._heard)), source)
