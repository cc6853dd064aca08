"""``Vehicle``: one drone, rover, boat or submarine, as its program sees it."""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.mavlink.messages import ParamValue
from aerokit.vehicle.commanding.arming import ArmingActions
from aerokit.vehicle.commanding.flight import FlightActions, ModeActions
from aerokit.vehicle.commanding.messaging import TalkActions
from aerokit.vehicle.commanding.travel import LookActions, TravelActions
from aerokit.vehicle.missions.context import PlanContext
from aerokit.vehicle.state.field import MESSAGE_IDS

if TYPE_CHECKING:
    from aerokit.connection.cells import StateCell
    from aerokit.mavlink.signing import Signing
    from aerokit.vehicle.camera.cameras import Camera, Cameras
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.commanding.guided import Guided
    from aerokit.vehicle.components.component import Component, ComponentStatus
    from aerokit.vehicle.components.components import Components
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.files.logs import Logs
    from aerokit.vehicle.gimbal.gimbal import Gimbal, Gimbals
    from aerokit.vehicle.missions.mission import MissionControl
    from aerokit.vehicle.missions.plans import FenceControl, RallyControl
    from aerokit.vehicle.parameters.parameters import Parameters

__all__ = ["Vehicle", "overview"]

TELL_OF_GIMBALS = tuple(
    MESSAGE_IDS[name]
    for name in ("GimbalDeviceAttitudeStatus", "GimbalManagerStatus", "MountStatus", "MountOrientation")
)

TELL_OF_PICTURES = tuple(
    MESSAGE_IDS[name] for name in ("CameraImageCaptured", "CameraFeedback", "CameraTrigger")
)
"""By their names: few vehicles send one of them, and no other program needs their classes."""


@checks_arguments
class Vehicle(ReadOnly, FlightActions, TravelActions, LookActions, ArmingActions, ModeActions, TalkActions):
    """One vehicle. Coroutines talk to it, properties never do; everything has a deadline and can be cancelled.

    Made by :func:`aerokit.connect`. State is in cells (``vehicle.position.value``, ``.age``, ``.fresh(within=1)``,
    ``await vehicle.mode.wait_until(...)``), SI units and degrees, the unit in the name. Other threads may read the
    cells; the parts (``mission``, ``parameters`` …) are made when they are first used, on the loop's thread.
    """

    def __init__(self, bridge: Bridge) -> None:
        super().__init__(bridge)
        self._plans = PlanContext(bridge, lambda: self.files)
        first = partial(self.connection.bus.attach_first, system_id=self.system_id)
        bridge.talk.at_close(
            first(TELL_OF_GIMBALS, lambda: self.gimbal),
            first([ParamValue.ID], lambda: self.parameters),
            first(TELL_OF_PICTURES, lambda: self._cameras),
        )

    # Parts are made, and imported, when they are first used, or when the vehicle first says what they listen to.

    @property
    def components(self) -> StateCell[tuple[ComponentStatus, ...]]:
        """What is on board, as far as it was heard: autopilot, cameras, gimbals, companions, receivers, others.

        Cameras and gimbals without a component id of their own are known once one of their messages has come.
        """
        return self._components.cell

    def component(self, component_id: int) -> Component:
        """One of them, to talk to: ``vehicle.component(100).command(…)``. It need not have been heard yet.

        Raises:
            InvalidArgument: the id is not from 1 to 255.
        """
        return self._components.component(component_id)

    @cached_property
    def _components(self) -> Components:
        from aerokit.vehicle.components.components import Components

        return Components(self._bridge, lambda: self.files, lambda: self.parameters)

    @property
    def camera(self) -> Camera:
        """The first camera that is heard: one with a component id of its own before those behind the autopilot.

        Its calls wait for it a moment; ``camera_at`` gives any other one.
        """
        return self._cameras.first

    @property
    def cameras(self) -> StateCell[tuple[int, ...]]:
        """The numbers of the cameras that have been heard, for ``camera_at``.

        Component ids (100 to 105), and 1 to 6 for those behind the autopilot once they have told of a picture.
        """
        return self._cameras.cell

    def camera_at(self, number: int) -> Camera:
        """One camera by its number; it need not have been heard yet.

        Args:
            number: its component id (100 to 105, at most 255), or 1 to 6 behind the autopilot.

        Raises:
            InvalidArgument: there can be no such camera.
        """
        return self._cameras.at(number)

    @cached_property
    def _cameras(self) -> Cameras:
        from aerokit.vehicle.camera.cameras import Cameras

        return Cameras(self._bridge, self._components)

    @cached_property
    def guided(self) -> Guided:
        """Set-point streams: velocity, position, acceleration, attitude."""
        from aerokit.vehicle.commanding.guided import Guided

        return Guided(self._bridge)

    @cached_property
    def gimbal(self) -> Gimbal:
        """The first gimbal: where it points, and orders to it."""
        return self.gimbals.first

    @cached_property
    def gimbals(self) -> Gimbals:
        """All gimbals that it carries."""
        from aerokit.vehicle.gimbal.gimbal import Gimbals

        return Gimbals(self._bridge)

    @cached_property
    def files(self) -> Files:
        """The files on it, by MAVFTP."""
        from aerokit.vehicle.files.files import Files

        return Files(self._talk.transfers)

    @cached_property
    def logs(self) -> Logs:
        """Its flight logs."""
        from aerokit.vehicle.files.logs import Logs

        return Logs(self._talk.transfers, self.files)

    @cached_property
    def parameters(self) -> Parameters:
        """The autopilot's parameters: download, get, set, transactions, what was changed."""
        from aerokit.vehicle.parameters.parameters import Parameters

        return Parameters(self._talk, self.files)

    @cached_property
    def mission(self) -> MissionControl:
        """The mission it holds: upload, download, start, pause, wait until it is finished."""
        from aerokit.vehicle.missions.mission import MissionControl

        return MissionControl(self._plans)

    @cached_property
    def fence(self) -> FenceControl:
        """The fence it holds."""
        from aerokit.vehicle.missions.plans import FenceControl

        return FenceControl(self._plans)

    @cached_property
    def rally(self) -> RallyControl:
        """The rally points it holds."""
        from aerokit.vehicle.missions.plans import RallyControl

        return RallyControl(self._plans)

    def __repr__(self) -> str:
        return f"<Vehicle {self.system_id}/{self.component_id} {self.autopilot.firmware}, {self.describe_link()}>"

    async def setup_signing(self, signing: Signing | None, *, timeout: float = 5.0) -> None:
        """Give the vehicle a key (SETUP_SIGNING), and sign and check with it from then on; None takes the key away.

        **The key travels in clear**: do this over a cable or a link that nobody listens to. Returns when the
        vehicle's frames are signed with the key (None: when they are not signed any more); until then what was in use
        remains in use. All on this connection need the key then, or ``signing.allow_unsigned``. Cancelled, the vehicle
        may have taken the key all the same. See docs/signing.md.

        Args:
            signing: the key, as for ``connect(signing=…)``.
            timeout: seconds until the vehicle uses it.

        Raises:
            NotSupported: we or the vehicle speak MAVLink 1, which has no signatures. Nothing was sent.
            OperationRejected: it is armed, or not known to be disarmed. Nothing was sent.
            OperationTimeout: it went on as before; the text has what it said.
            BusyError: another vehicle on this connection is just being given a key. Nothing was sent.
        """
        from aerokit.vehicle.session.signing import set_up_signing

        await set_up_signing(self._talk, signing, timeout)


def overview(vehicle: Vehicle) -> dict[str, Any]:
    """What is known of a vehicle, for showing and for other programs; nothing is asked of it.

    Returns:
        ``system_id``, ``autopilot`` and ``firmware`` (names), ``vehicle_type`` (MAV_TYPE), ``link`` (``state`` as of
        :class:`aerokit.LinkState`, ``heartbeat_age_s``, and how many frames of the vehicle came and were lost on the
        way, by their numbers) and ``states``: for each state of docs/states.md that the vehicle has told, ``value``
        (as :func:`aerokit._internal.plain.plain` gives it) and ``age_s``, seconds since it was told.
    """
    from aerokit._internal.plain import plain

    received, lost = vehicle.connection.counts(vehicle.system_id)
    telemetry, link = vehicle.telemetry, vehicle.link_state.latest
    return {
        "system_id": vehicle.system_id,
        "autopilot": vehicle.autopilot.name,
        "firmware": vehicle.autopilot.firmware,
        "vehicle_type": vehicle.autopilot.vehicle_type,
        "link": {
            "state": None if link is None else link.value,
            "heartbeat_age_s": plain(vehicle.heartbeat_age),
            "frames_received": received,
            "frames_lost": lost,
        },
        "states": {
            name: {"value": plain(cell.value), "age_s": plain(cell.age)}
            for name, cell in telemetry.cells.items()
            if cell.is_known
        },
    }
