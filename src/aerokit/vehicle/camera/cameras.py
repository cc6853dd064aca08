"""``Cameras``: those of one vehicle, as they are heard."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavType
from aerokit.vehicle.camera.controls import LensCalls, StorageCalls, TrackingCalls
from aerokit.vehicle.camera.link import BEHIND, HEARD_WITHIN_S, CameraLine
from aerokit.vehicle.camera.photos import PhotoCalls
from aerokit.vehicle.camera.values import CameraInformation
from aerokit.vehicle.camera.videos import VideoCalls

if TYPE_CHECKING:
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.components.components import Components

__all__ = ["Camera", "Cameras"]


@checks_arguments
class Camera(ReadOnly, PhotoCalls, VideoCalls, LensCalls, TrackingCalls, StorageCalls):
    """One camera: pictures, video, lens, tracking, storage, streams (https://mavlink.io/en/services/camera.html).

    ``vehicle.camera`` is the first one that is heard, ``vehicle.camera_at(number)`` any: one with a component id of its
    own (100 to 105), or behind the autopilot (1 to 6), which are ArduPilot's own drivers and PX4's trigger. What a
    camera says that it cannot do is refused before anything is sent. Cells are asked for while somebody looks at them.
    """

    def __init__(self, line: CameraLine) -> None:
        super().__init__(line)
        self.information: StateCell[CameraInformation] = line.information
        """What it is (CAMERA_INFORMATION): asked for once, by the first call."""

    @property
    def number(self) -> int | None:
        """1 to 6 behind the autopilot, otherwise its component id; None before the first camera was heard."""
        return self._line.number

    async def wait_found(self, *, timeout: float = 10.0) -> CameraInformation:
        """Wait until the camera is heard and says what it is; other calls do so by themselves.

        Raises:
            CommandRejected: it does not say what it is.
            OperationTimeout: none was heard, or it does not say what it is: PX4's trigger never does.
        """
        found: CameraInformation | None = None
        with anyio.move_on_after(timeout):
            found = await self._line.find()
        if found is None:
            raise self._line.timed_out(f"says nothing of itself; waited for {timeout:g} s at most")
        return found

    def __repr__(self) -> str:
        return f"<Camera {self._line.describe().removeprefix('camera ')}>"


OWN_IDS = range(100, 106)

MOST_EARLY = 99


class Cameras:
    """Finds cameras by heartbeats and by what only cameras say, and keeps the objects that were made of them."""

    def __init__(self, bridge: Bridge, components: Components) -> None:
        self._bridge, self._talk, self._components = bridge, bridge.talk, components
        self._made: dict[int, Camera] = {}
        talk = bridge.talk
        self.cell: StateCell[tuple[int, ...]] = talk.connection.new_cell(
            "cameras", "HEARTBEAT or CAMERA_INFORMATION of a camera"
        )
        self._early: list[tuple[int, Any]] = []
        """Pictures of a camera behind the autopilot, while it is not known yet whether it is the first."""
        self._first_line = CameraLine(bridge, components.component, None, on_bound=self._on_first_bound)
        self._first = Camera(self._first_line)
        self._is_first_given = False
        """Somebody has it, and always gets the same."""
        talk.keep(self.cell)
        bus = talk.connection.bus
        for message_type, find in (
            (m.Heartbeat, self._on_heartbeat),
            (m.CameraInformation, self._on_information),
            (m.CameraFeedback, lambda each: self._on_picture(each, each.cam_idx + 1)),
            (m.CameraImageCaptured, lambda each: self._on_picture(each, each.camera_id or 1)),
            (m.CameraTrigger, lambda each: self._on_picture(each, 1)),
        ):
            if bus.dialect.get(message_type.ID) is not None:
                talk.at_close(bus.attach(message_type, find, system_id=talk.system_id))
        for (system_id, _), heartbeat in tuple(talk.connection.heard.items()):
            if system_id == talk.system_id:
                self._on_heartbeat(heartbeat)

    @property
    def first(self) -> Camera:
        """That which is heard first, or has the lowest component id of those that are; the autopilot's come last."""
        if not self._is_first_given and self._first_line.number in self._made:
            return self._made[self._first_line.number]
        self._is_first_given = True
        self._first_line.look()
        return self._first

    def at(self, number: int) -> Camera:
        """The object of one camera, the same each time; it need not have been heard yet."""
        if number not in BEHIND and not 7 <= number <= 255:
            raise InvalidArgument(
                f"number = {number} is not allowed: 1 to 6 behind the autopilot, or a component id up to 255"
            )
        if number not in self._made:
            if number == self._first_line.number:
                return self.first
            line = CameraLine(self._bridge, self._components.component, number)
            line.look()
            self._made[number] = Camera(line)
        return self._made[number]

    def _on_heartbeat(self, heartbeat: m.Heartbeat) -> None:
        frame = heartbeat.received_frame
        if frame is not None and (heartbeat.type == MavType.CAMERA or frame.component_id in OWN_IDS):
            self._note(heartbeat, frame.component_id)

    def _on_information(self, message: m.CameraInformation) -> None:
        self._note(message, message.camera_device_id or message.lens_id + 1)

    def _on_first_bound(self, number: int) -> None:
        """One that was made before goes on telling of its pictures alone."""
        self._first_line.is_quiet = number in self._made

    def _on_picture(self, message: Any, device: int) -> None:
        """Have somebody hear of the pictures of this camera, this one included."""
        number = self._note(message, device)
        if number in (0, self._first_line.number, *self._made):
            return
        if self._first_line.number is None:
            if not self._early:
                self._first_line.later(HEARD_WITHIN_S, self._give_early)
            del self._early[MOST_EARLY:]
            self._early.append((number, message))
        else:
            self.at(number)._album.hear(message)

    def _give_early(self) -> None:
        """No camera with a heartbeat of its own was heard: those of the autopilot are all there are."""
        early, self._early = self._early, []
        self._first_line.bind(early[0][0])
        for number, message in early:
            self.at(number)._album.hear(message)

    def _note(self, message: Any, device: int) -> int:
        """Its number. ``device`` counts only for what the autopilot says; 0 is nobody who can be spoken to."""
        frame = message.received_frame
        if frame is None:
            return 0
        is_autopilots = frame.component_id == self._talk.component_id
        number = device if is_autopilots else frame.component_id
        if (number in BEHIND) is not is_autopilots or number == 0:
            return 0
        before = self.cell.latest or ()
        if number not in before:
            source = Source(self._talk.system_id, frame.component_id, message.NAME)
            self.cell.set(tuple(sorted((*before, number), key=_rank)), source)
        if number not in BEHIND and self._first_line.number is None:
            self._first_line.bind(number)
        return int(number)


def _rank(number: int) -> tuple[bool, int]:
    """Those with a component id of their own first."""
    return number in BEHIND, number
