"""The public `Vehicle` object: one drone, rover, boat or submarine."""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.mavlink.messages import ParamValue
from aerokit.vehicle.commanding.arming import ArmingActions
from aerokit.vehicle.commanding.flight import FlightActions, ModeActions
from aerokit.vehicle.commanding.maneuvers import ManeuverActions
from aerokit.vehicle.commanding.messaging import MessagingActions
from aerokit.vehicle.commanding.progress import MAX_SILENCE_S
from aerokit.vehicle.commanding.termination import TerminationActions
from aerokit.vehicle.commanding.travel import LookActions, TravelActions
from aerokit.vehicle.commanding.tuning import TuningActions
from aerokit.vehicle.devices.actions import DeviceActions
from aerokit.vehicle.missions.context import PlanContext
from aerokit.vehicle.state.field import MESSAGE_IDS

if TYPE_CHECKING:
    from aerokit.connection.cells import StateCell
    from aerokit.mavlink.signing import Signing
    from aerokit.vehicle.calibration.calibration import CalibrationControl
    from aerokit.vehicle.camera.cameras import Camera, Cameras
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.guided import Guided
    from aerokit.vehicle.commanding.sticks import StickInput, StickStream
    from aerokit.vehicle.components.component import Component, Components, ComponentStatus
    from aerokit.vehicle.external.external import External
    from aerokit.vehicle.external.landing import LandingReport, TargetSource
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.files.logs import Logs
    from aerokit.vehicle.gimbal.gimbal import Gimbal, Gimbals
    from aerokit.vehicle.missions.mission import MissionControl
    from aerokit.vehicle.missions.plans import FenceControl, RallyControl
    from aerokit.vehicle.parameters.parameters import Parameters
    from aerokit.vehicle.rtk.rtk import Rtk

__all__ = ["Vehicle", "overview"]

GIMBAL_MESSAGE_IDS = tuple(
    MESSAGE_IDS[name]
    for name in ("GimbalDeviceAttitudeStatus", "GimbalManagerStatus", "MountStatus", "MountOrientation")
)

PICTURE_MESSAGE_IDS = tuple(MESSAGE_IDS[name] for name in ("CameraImageCaptured", "CameraFeedback", "CameraTrigger"))
"""Ids of the messages that report a picture.

They are looked up by name, so that programs without cameras do not import the message classes.
"""


@checks_arguments
class Vehicle(
    ReadOnly,
    FlightActions,
    TravelActions,
    ManeuverActions,
    LookActions,
    ArmingActions,
    ModeActions,
    TerminationActions,
    TuningActions,
    MessagingActions,
    DeviceActions,
):
    """One remote vehicle. Coroutines send commands to it; properties only read. Every call can be cancelled.

    Create it with :func:`aerokit.connect`. State is held in cells (``vehicle.position.value``, ``.age``,
    ``.fresh(within=1)``, ``await vehicle.mode.wait_until(...)``) in SI units and degrees, with the unit in the name.
    Other threads may read the cells. Sub-objects (``mission``, ``parameters`` …) are created on first use; with
    asyncio, use them first in the event loop's thread.
    """

    def __init__(self, context: VehicleContext) -> None:
        super().__init__(context)
        self._plans = PlanContext(context, lambda: self.files)
        # Reading a sub-object creates it. Some must also be created when the vehicle sends their first message.
        create_on_first = partial(self.connection.bus.create_on_first, system_id=self.system_id)
        context.session.at_close(
            create_on_first(GIMBAL_MESSAGE_IDS, lambda: self.gimbal),
            create_on_first([ParamValue.ID], lambda: self.parameters),
            create_on_first(PICTURE_MESSAGE_IDS, lambda: self._cameras),
        )

    # A sub-object is imported and created on first use, or when the vehicle first sends a message that the sub-object
    # handles.

    @property
    def components(self) -> StateCell[tuple[ComponentStatus, ...]]:
        """The components seen on board: autopilot, cameras, gimbals, companion computers, receivers and others.

        Cameras and gimbals without their own component id appear after their first message.
        """
        return self._components.cell

    def component(self, component_id: int) -> Component:
        """Return the component with this id, to send commands to it: ``vehicle.component(100).command(…)``.

        The component need not have been seen yet.

        Raises:
            InvalidArgument: the id is not from 1 to 255.
        """
        return self._components.component(component_id)

    @cached_property
    def _components(self) -> Components:
        from aerokit.vehicle.components.component import Components

        return Components(self._context, lambda: self.files, lambda: self.parameters)

    @property
    def camera(self) -> Camera:
        """The first camera found with its own component id; if none was found, one attached to the autopilot.

        If no camera was found yet, its methods wait briefly for one. Use :meth:`camera_at` for any other camera.
        """
        return self._cameras.first

    @property
    def cameras(self) -> StateCell[tuple[int, ...]]:
        """The numbers of the cameras found so far. Pass a number to ``camera_at`` to get the camera.

        A number is a component id (100 to 105), or 1 to 6 for a camera attached to the autopilot that has reported a
        picture.
        """
        return self._cameras.cell

    def camera_at(self, number: int) -> Camera:
        """Return the camera with this number. It need not have been found yet.

        Args:
            number: component id of the camera (usually 100 to 105, but any id from 7 to 255 is allowed), or 1 to 6 for
                a camera attached to the autopilot.

        Raises:
            InvalidArgument: no camera can have this number.
        """
        return self._cameras.at(number)

    @cached_property
    def _cameras(self) -> Cameras:
        from aerokit.vehicle.camera.cameras import Cameras

        return Cameras(self._context, self._components)

    @cached_property
    def guided(self) -> Guided:
        """Set-point streams: velocity, position, acceleration, attitude, body rates, trajectory, actuators."""
        from aerokit.vehicle.commanding.guided import Guided

        return Guided(self._context)

    def sticks(
        self,
        initial: StickInput | None = None,
        *,
        mode: str | int | None = None,
        rate_hz: float = 20.0,
        valid_for_s: float = 0.5,
        max_lag_s: float = 0.5,
    ) -> StickStream:
        """Fly by stick positions from your program (MANUAL_CONTROL): ``async with vehicle.sticks() as sticks: …``.

        Args:
            initial: stick positions that are sent while the mode is entered; None centers all sticks.
            mode: the flight mode for the sticks. By default LOITER (ArduCopter), FBWA or QLOITER (ArduPlane),
                MANUAL (ArduPilot Rover), ALT_HOLD (ArduSub), POSCTL (PX4).
            rate_hz: transmission rate of the latest positions, 2 to 400.
            valid_for_s: seconds for which the latest positions are repeated; the stream stops after that.
            max_lag_s: the stream stops if the event loop is blocked for more than this many seconds.

        Raises:
            InvalidArgument: a rate or a time is out of range, or the autopilot has no such mode.
        """
        from aerokit.vehicle.commanding.sticks import StickStream

        probe = self.parameters.probe
        return StickStream(self._context, probe, mode, initial, rate_hz, valid_for_s, max_lag_s)

    @cached_property
    def external(self) -> External:
        """Measurements from your program for the autopilot: odometry, vision, GPS, obstacles, ranges, origin, wind."""
        from aerokit.vehicle.external.external import External

        return External(self._context, self.parameters.probe)

    async def land_on(
        self,
        target: TargetSource,
        *,
        rate_hz: float = 20.0,
        acquire_timeout: float = 10.0,
        timeout: float | None = 300.0,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> LandingReport:
        """Land on a target that your program sees. Returns a report when the vehicle is on the ground and disarmed.

        aerokit streams LANDING_TARGET, and the autopilot's own mode lands: LAND with PLND_ENABLED on ArduCopter,
        PRECLAND on PX4. If the target is lost, the autopilot decides. ArduCopter retries, or lands where it is
        (PLND_STRICT, PLND_RET_MAX). PX4 climbs to PLD_SRCH_ALT, searches for PLD_SRCH_TOUT, and then lands where it is.
        The report says for how long the target was lost. After a cancellation the vehicle continues to land, without
        new targets.

        Args:
            target: a function or coroutine function that returns a :class:`aerokit.TargetMeasurement`, or None while
                the target is not visible; or an asynchronous iterable of such results.
            rate_hz: rate at which the function is called, and the highest rate of LANDING_TARGET.
            acquire_timeout: seconds to wait until the target is visible. Once it is visible, the landing is ordered.
            timeout: seconds until the vehicle must be on the ground and disarmed; None: no limit.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no limit.

        Raises:
            InvalidArgument: a rate or a time is out of range, or the target is of another type.
            NotSupported: this type of vehicle has no precision landing. Nothing was sent.
            CommandRejected: the vehicle refused the mode.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: a parameter makes the vehicle ignore the target, so the landing was not ordered. Or the
                mode changed, another order was given, or the vehicle fell during the landing.
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: the target was not visible in time (the landing was not ordered), or the vehicle was not
                on the ground in time.
            ParameterTimeout: the vehicle did not report a parameter that aerokit must check first.
        """
        from aerokit.vehicle.external.landing import land_on

        return await land_on(self._context, self.external, target, rate_hz, acquire_timeout, timeout, max_silence_s)

    @cached_property
    def gimbal(self) -> Gimbal:
        """The first gimbal: its attitude, and commands to it."""
        return self.gimbals.first

    @cached_property
    def gimbals(self) -> Gimbals:
        """All gimbals of the vehicle."""
        from aerokit.vehicle.gimbal.gimbal import Gimbals

        return Gimbals(self._context)

    @cached_property
    def files(self) -> Files:
        """The vehicle's file system, accessed by MAVFTP."""
        from aerokit.vehicle.files.files import Files

        return Files(self._session.transfers)

    @cached_property
    def logs(self) -> Logs:
        """The vehicle's flight logs."""
        from aerokit.vehicle.files.logs import Logs

        return Logs(self._session.transfers, self.files, self._context)

    @cached_property
    def parameters(self) -> Parameters:
        """The autopilot's parameters: download, get, set, transactions, change notifications."""
        from aerokit.vehicle.parameters.parameters import Parameters

        return Parameters(self._session, self.files)

    @cached_property
    def mission(self) -> MissionControl:
        """The vehicle's mission: upload, download, start, pause, wait until finished."""
        from aerokit.vehicle.missions.mission import MissionControl

        return MissionControl(self._plans)

    @cached_property
    def fence(self) -> FenceControl:
        """The vehicle's geofence."""
        from aerokit.vehicle.missions.plans import FenceControl

        return FenceControl(self._plans)

    @cached_property
    def rally(self) -> RallyControl:
        """The vehicle's rally points."""
        from aerokit.vehicle.missions.plans import RallyControl

        return RallyControl(self._plans)

    @cached_property
    def calibrate(self) -> CalibrationControl:
        """Calibration of sensors, radio and ESCs."""
        from aerokit.vehicle.calibration.calibration import CalibrationControl

        return CalibrationControl(self._context, lambda: self.parameters)

    @cached_property
    def rtk(self) -> Rtk:
        """RTCM corrections for the satellite receivers, from your program or from an NTRIP caster."""
        from aerokit.vehicle.rtk.rtk import Rtk

        return Rtk(self._context)

    async def return_altitude(self) -> float:
        """Return the altitude above home, in metres, at which the vehicle returns to launch.

        Reads RTL_ALT_M (ArduCopter 4.7; before that RTL_ALT, in centimetres), RTL_ALTITUDE (ArduPlane; before 4.5
        ALT_HOLD_RTL), Q_RTL_ALT (ArduPilot's VTOL planes, which return in QRTL) or RTL_RETURN_ALT (PX4). If the vehicle
        is set to return at its present altitude, the result is −1 (ArduPlane) or 0 (ArduCopter).

        Raises:
            NotSupported: this type of vehicle does not climb for a return. Nothing was sent.
            ParameterRejected: the vehicle has no such parameter.
            ParameterTimeout: there was no answer.
        """
        from aerokit.vehicle.parameters.return_altitude import read_return_altitude

        return await read_return_altitude(self.parameters, self._session)

    async def set_return_altitude(self, altitude_m: float) -> None:
        """Set the altitude at which the vehicle returns to launch. Returns when the vehicle has confirmed the value.

        Writes the parameter that :meth:`return_altitude` reads, so the value survives a reboot. If the vehicle is
        higher than this when the return starts, ArduCopter and PX4 keep the height, and ArduPlane descends.

        Args:
            altitude_m: metres above home, above 0, at most 3,000. The parameter Q_RTL_ALT can hold only whole metres.

        Raises:
            InvalidArgument: the altitude is out of range, or has a fraction that the parameter cannot hold.
            NotSupported: this type of vehicle does not climb for a return. Nothing was sent.
            ParameterRejected: the vehicle has no such parameter, or kept the previous value.
            ParameterTimeout: the vehicle did not confirm the new value, but may have stored it.
        """
        from aerokit.vehicle.parameters.return_altitude import write_return_altitude

        await write_return_altitude(self.parameters, self._session, altitude_m)

    def __repr__(self) -> str:
        return f"<Vehicle {self.system_id}/{self.component_id} {self.autopilot.firmware}, {self.describe_link()}>"

    async def setup_signing(self, signing: Signing | None, *, timeout: float = 5.0) -> None:
        """Install a signing key on the vehicle and sign all traffic with it from then on; None removes the key.

        **The key is sent unencrypted**: do this over a cable or a private link. Returns when the vehicle's frames are
        signed with the key or, for None, no longer signed. Every other vehicle on this connection needs the key too, or
        ``signing.allow_unsigned``. If you cancel the call, the vehicle may still have accepted the change. See
        docs/signing.md.

        Args:
            signing: the key, as for ``connect(signing=…)``.
            timeout: seconds until the vehicle must use the key, or no longer sign.

        Raises:
            NotSupported: this program or the vehicle uses MAVLink 1, which has no signatures. Nothing was sent.
            OperationRejected: the vehicle is armed, or not known to be disarmed. Nothing was sent.
            OperationTimeout: the vehicle did not start to use the key, or did not stop signing; the error text includes
                its status texts.
            BusyError: another key exchange is in progress on this connection. Nothing was sent.
        """
        from aerokit.vehicle.session.signing import set_up_signing

        await set_up_signing(self._session, signing, timeout)


def overview(vehicle: Vehicle) -> dict[str, Any]:
    """Return a summary of the vehicle's state that can be written as JSON. Sends nothing.

    Returns:
        ``system_id``, ``autopilot`` and ``firmware`` (names), ``vehicle_type`` (MAV_TYPE), ``link`` and ``states``.
        ``link`` has ``state`` (of :class:`aerokit.LinkState`), ``heartbeat_age_s``, ``frames_received`` and
        ``frames_lost`` (gaps in the sequence numbers). ``states`` maps the name of each known state (docs/states.md) to
        its ``value`` (converted by :func:`aerokit._internal.formatting.to_jsonable`) and its ``age_s`` in seconds.
    """
    from aerokit._internal.formatting import to_jsonable

    received, lost = vehicle.connection.counts(vehicle.system_id)
    telemetry, link = vehicle.telemetry, vehicle.link_state.latest
    return {
        "system_id": vehicle.system_id,
        "autopilot": vehicle.autopilot.name,
        "firmware": vehicle.autopilot.firmware,
        "vehicle_type": vehicle.autopilot.vehicle_type,
        "link": {
            "state": None if link is None else link.value,
            "heartbeat_age_s": to_jsonable(vehicle.heartbeat_age),
            "frames_received": received,
            "frames_lost": lost,
        },
        "states": {
            name: {"value": to_jsonable(cell.value), "age_s": to_jsonable(cell.age)}
            for name, cell in telemetry.cells.items()
            if cell.is_known
        },
    }
