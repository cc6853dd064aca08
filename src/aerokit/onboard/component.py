"""``OnboardComponent``: your program as a MAVLink component with commands, parameters, files and messages."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.formatting import enum_name
from aerokit.connection.tasks import BackgroundTasks, run_shielded
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CompMetadataType, MavCmd, MavModeFlag, MavSeverity, MavState, MavType
from aerokit.mavlink.enums import MavProtocolCapability as Capability
from aerokit.mavlink.message import Message
from aerokit.onboard.commands import ComponentServices
from aerokit.onboard.files import DirectoryFiles
from aerokit.onboard.host import ComponentHost, EventSender, answer_pings, check_severity
from aerokit.onboard.identity import PARAMETER_PATH, Identity, IdentityMessages
from aerokit.onboard.missions import ComponentMissions
from aerokit.onboard.parameters import ComponentParameters
from aerokit.protocols.servers.ftp import SessionFtpServer

if TYPE_CHECKING:
    from aerokit.connection.connection import Connection
    from aerokit.onboard.autopilot import AutopilotDriver
    from aerokit.onboard.camera import CameraDriver
    from aerokit.onboard.devices import WinchDriver
    from aerokit.onboard.gimbal import GimbalDriver
    from aerokit.onboard.sources import ComponentSources

HEARTBEAT_INTERVAL_S = 1.0
MAX_UNSENT_BYTES = 8192
"""MAVFTP bursts pause while more bytes than this wait to be sent on the link."""
MAX_METADATA_BYTES = 1 << 20
MAVLINK_VERSION = 3

MetadataKind = Literal["commands", "peripherals", "events", "actuators"]
HandlerT = TypeVar("HandlerT", bound=Callable[..., Any])


@checks_arguments
class OnboardComponent:
    """Your program as one MAVLink component, returned by :func:`aerokit.component`.

    The component sends its own heartbeat, executes commands, and serves parameters, files, missions and messages. It
    answers all other requests as MAVLink requires: with UNSUPPORTED, DENIED or DOES_NOT_EXIST.
    """

    def __init__(
        self,
        connection: Connection,
        *,
        system_id: int,
        component_id: int,
        heartbeat: m.Heartbeat,
        identity: Identity,
        parameters_file: Path | None,
        bytewise: bool,
        accepts: Iterable[int] | None,
    ) -> None:
        self._host = ComponentHost(connection, system_id, component_id, accepts)
        self._heartbeat = heartbeat
        # An error in values of the program must not close the connection, which may also fly a vehicle.
        self._tasks = BackgroundTasks(partial(self._host.report_error, "component"))
        self.parameters: ComponentParameters = ComponentParameters(self._host, parameters_file, bytewise=bytewise)
        """Parameters that this component offers."""
        self._services = ComponentServices(self._host, self._tasks, self.parameters)
        self._commands, self._streams = self._services.commands, self._services.streams
        self._commands.handlers[MavCmd.REQUEST_AUTOPILOT_CAPABILITIES] = lambda command: self._streams.answer_with(
            m.AutopilotVersion.ID, command
        )
        self._memory = self._services.memory
        self._identity = IdentityMessages(self._host, identity, self._memory)
        self._streams.builders.update(self._identity.builders())
        files = DirectoryFiles(None, self._memory, is_writable=False)
        self._ftp: SessionFtpServer[DirectoryFiles] = SessionFtpServer(
            self._host, files, is_congested=self._is_congested
        )
        self._events = EventSender(self._host)
        self._missions: ComponentMissions | None = None
        self._sources: ComponentSources | None = None
        answer_pings(self._host)
        encoding = Capability.PARAM_ENCODE_BYTEWISE if bytewise else Capability.PARAM_ENCODE_C_CAST
        self._identity.capabilities |= Capability.FTP | encoding
        self._identity.add_metadata(CompMetadataType.PARAMETER, PARAMETER_PATH, self.parameters.json)

    async def _aclose(self) -> None:
        self._commands.cancel_all()
        try:
            await self._tasks.aclose()
        finally:
            # Commands must not arrive after this line, because nothing would stop their motions or save their changes.
            self._host.stop_receiving()
            try:
                await run_shielded(self._stop_and_save())
            finally:
                self._commands.close()
                self._ftp.close()
                self._host.close()

    async def _stop_and_save(self) -> None:
        await self._services.stop_motions()
        await self.parameters.aclose()

    def _use_threads(self) -> None:
        """Call the program's plain functions in threads, because they may block. aerokit.sync calls this method."""
        self._commands.uses_threads = True

    # ------------------------------------------------------------------------------------ state

    @property
    def connection(self) -> Connection:
        """The connection, for subscriptions and for further components on the same link."""
        return self._host.connection

    @property
    def system_id(self) -> int:
        """System id of this component."""
        return self._host.system_id

    @property
    def component_id(self) -> int:
        """Component id (MAV_COMPONENT)."""
        return self._host.component_id

    @property
    def state(self) -> int:
        """MAV_STATE of the heartbeat: ACTIVE unless :meth:`set_state` was called."""
        return self._heartbeat.system_status

    @property
    def time_boot_ms(self) -> int:
        """Milliseconds since the component started, for the field ``time_boot_ms`` of messages."""
        return self._host.time_boot_ms

    def set_state(self, state: int, *, base_mode: int | None = None, custom_mode: int | None = None) -> None:
        """Change the state and mode in the heartbeat, and send a heartbeat at once.

        Args:
            state: MAV_STATE, such as ACTIVE, STANDBY, CALIBRATING or CRITICAL.
            base_mode: MAV_MODE_FLAG; None leaves it unchanged.
            custom_mode: mode number of this component, 0 to 4294967295; None leaves it unchanged.

        Raises:
            InvalidArgument: a value is out of range.
        """
        if state not in MavState.__members__.values():
            raise InvalidArgument(f"state = {state} is not allowed: it must be a MAV_STATE (0 to 8)")
        old = self._heartbeat
        heartbeat = m.Heartbeat(
            old.type,
            old.autopilot,
            old.base_mode if base_mode is None else base_mode,
            old.custom_mode if custom_mode is None else custom_mode,
            system_status=state,
            mavlink_version=MAVLINK_VERSION,
        )
        heartbeat.encode()  # Raises InvalidArgument before the old heartbeat is replaced.
        self._heartbeat = heartbeat
        self._host.send(heartbeat)

    def _send_heartbeat(self) -> None:
        self._host.send(self._heartbeat)
        self._host.call_later(HEARTBEAT_INTERVAL_S, self._send_heartbeat)

    # --------------------------------------------------------------------------------- commands

    def command(self, command: int) -> Callable[[HandlerT], HandlerT]:
        """Decorator: execute a MAV_CMD by a function or coroutine function.

        The function's first argument is the :class:`~aerokit.onboard.CommandRequest`. The other arguments are the
        command's parameters in order, unless :class:`~aerokit.onboard.Param` selects others. Annotate each argument
        with float, int, bool or an enum. Add ``| None`` if the parameter may be missing, and limit its range by
        ``Annotated[float, Range(0, 50)]``. A command whose values do not fit is DENIED, and the function is not called.

        The function returns None or True for ACCEPTED, False for FAILED, a MAV_RESULT, or a
        :class:`~aerokit.onboard.CommandResult`. An exception is sent as a status text, and becomes the result:
        DENIED for InvalidArgument, ValueError and PermissionError, TEMPORARILY_REJECTED for BusyError, UNSUPPORTED for
        NotSupported, and FAILED for all others.

        While a coroutine runs, the sender gets IN_PROGRESS, and COMMAND_CANCEL cancels the coroutine (CANCELLED).
        Another command with the same MAV_CMD is TEMPORARILY_REJECTED meanwhile; a repeated transmission is not executed
        again.

        Raises:
            InvalidArgument: the command already has a handler, or an annotation of the function is not supported.
        """

        def register(function: HandlerT) -> HandlerT:
            self._commands.add(command, function)
            return function

        return register

    # --------------------------------------------------------------------------------- messages

    def message(
        self, message_type: type[Message], *, hz: float = 0.0
    ) -> Callable[[Callable[[], Message | None]], Callable[[], Message | None]]:
        """Decorator: send the message that the function returns, on request and at intervals that other programs set.

        The function returns None while it has no values. ``hz`` (0 to 200) is the rate at which the message is sent to
        all programs from the start. With 0, the message is sent only when other programs ask for it.

        Raises:
            InvalidArgument: ``hz`` is out of range, or the message already has a function.
        """

        def register(function: Callable[[], Message | None]) -> Callable[[], Message | None]:
            self._services.add_message(message_type, function, hz)
            return function

        return register

    def send(self, message: Message) -> None:
        """Send a message as this component, to the target in the message, or to all programs if it has no target.

        Raises:
            InvalidArgument: a field is out of range; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        self.connection.raise_if_ended()
        self._host.send(message)

    def send_text(self, text: str, *, severity: int = MavSeverity.INFO.value) -> None:
        """Send a status text to all programs (STATUSTEXT).

        Characters that are not ASCII are replaced by "?". A text of more than 254 characters is cut.

        Raises:
            InvalidArgument: ``severity`` is not a MAV_SEVERITY, 0 to 7.
        """
        check_severity(severity)
        self._host.send_text(severity, text)

    def send_event(self, event_id: int, arguments: bytes = b"", *, severity: int = MavSeverity.INFO.value) -> None:
        """Send an event to all programs (EVENT). A receiver that missed the event can request it again.

        Args:
            event_id: id in the component's event metadata: ``component_id << 24`` plus the number of the event.
            arguments: at most 40 bytes.
            severity: MAV_SEVERITY, 0 to 7.

        Raises:
            InvalidArgument: a value is out of range.
        """
        self._events.send(event_id, arguments, severity)

    # ------------------------------------------------------------------------- files and missions

    def serve_files(self, directory: str | Path, *, writable: bool = False) -> None:
        """Serve the files of one directory by MAVFTP. Clients cannot leave the directory, not even by symbolic links.

        Files are read and written on the event loop, in blocks of 239 bytes, so the directory should be on a local
        disk.

        Args:
            directory: existing directory.
            writable: True if any sender may write, rename and remove files in the directory.

        Raises:
            InvalidArgument: there is no such directory, or the component already serves a directory.
        """
        root = Path(directory)
        if not root.is_dir():
            raise InvalidArgument(f"directory = {str(directory)!r} is not an existing directory")
        if self._ftp.files.root is not None:
            raise InvalidArgument("serve_files was called before: a component serves one directory")
        self._ftp.files = DirectoryFiles(root, self._memory, is_writable=writable)

    def set_metadata(self, kind: MetadataKind, content: bytes) -> None:
        """Serve a metadata file (JSON) by MAVFTP, and list it in the general metadata file.

        https://mavlink.io/en/services/component_information.html

        Args:
            kind: ``"commands"``, ``"peripherals"``, ``"events"`` or ``"actuators"``. aerokit writes the file for the
                parameters itself.
            content: the content of the file, at most 1 MiB.

        Raises:
            InvalidArgument: the content is too large, or the kind is unknown.
        """
        if len(content) > MAX_METADATA_BYTES:
            raise InvalidArgument(f"content has {len(content)} bytes; at most {MAX_METADATA_BYTES} are allowed")
        self._identity.add_metadata(CompMetadataType[kind.upper()], f"/{kind}.json", lambda: content)

    def _is_congested(self) -> bool:
        return self.connection.unsent_bytes > MAX_UNSENT_BYTES

    @property
    def missions(self) -> ComponentMissions:
        """Missions, fences and rally points that other programs upload and download.

        The component serves them from the first access to this property on.
        """
        if self._missions is None:
            self._missions = ComponentMissions(self._services)
            self._identity.capabilities |= Capability.MISSION_INT | Capability.MISSION_FENCE | Capability.MISSION_RALLY
        return self._missions

    # ---------------------------------------------------------------------------- ready-made parts

    def add_autopilot(self, driver: AutopilotDriver) -> None:
        """Serve the commands that ground stations send to a vehicle: arm, mode, take-off, landing, return, reboot.

        Open the component with component id 1, a vehicle's ``type``, and ``autopilot=MavAutopilot.GENERIC``. HEARTBEAT
        reports armed after ``arm``, and the new mode after ``set_mode``. Send telemetry by :meth:`message`.

        Args:
            driver: an instance of your subclass of :class:`~aerokit.onboard.AutopilotDriver`.

        Raises:
            InvalidArgument: one of these commands already has a handler.
        """
        from aerokit.onboard.autopilot import add_autopilot  # Imported here, because few components need it.

        add_autopilot(self._services, driver, self._set_flight_state)

    def _set_flight_state(self, *, is_armed: bool | None = None, custom_mode: int | None = None) -> None:
        """Change the armed state or the mode in the heartbeat; None leaves it unchanged."""
        old = self._heartbeat
        flags = old.base_mode | MavModeFlag.CUSTOM_MODE_ENABLED
        if is_armed is True:
            flags |= MavModeFlag.SAFETY_ARMED
        elif is_armed is False:
            flags &= ~MavModeFlag.SAFETY_ARMED
        self.set_state(old.system_status, base_mode=int(flags), custom_mode=custom_mode)

    def add_camera(self, camera: CameraDriver) -> None:
        """Serve the camera protocol: photos, videos, storage, streams, zoom, focus, tracking, settings.

        https://mavlink.io/en/services/camera.html

        Args:
            camera: an instance of your subclass of :class:`~aerokit.onboard.CameraDriver`.

        Raises:
            InvalidArgument: the component already has a camera, a handler for a camera command, or (if the camera has a
                definition file) parameters.
            FileFormatError: the definition file is damaged.
        """
        from aerokit.onboard.camera import add_camera  # Imported here, because few components need it.

        add_camera(self._services, camera)

    def add_gimbal(self, gimbal: GimbalDriver) -> None:
        """Serve the gimbal protocol v2, as a gimbal device and its gimbal manager in one component.

        https://mavlink.io/en/services/gimbal_v2.html

        Args:
            gimbal: an instance of your subclass of :class:`~aerokit.onboard.GimbalDriver`.

        Raises:
            InvalidArgument: the component already has a gimbal, or a handler for a gimbal command.
        """
        from aerokit.onboard.gimbal import add_gimbal  # Imported here, because few components need it.

        add_gimbal(self._services, gimbal)

    def add_winch(self, winch: WinchDriver) -> None:
        """Serve DO_WINCH by your subclass of :class:`~aerokit.onboard.WinchDriver`, and send WINCH_STATUS at 5 Hz.

        Commands for other instances than 0 (all), 1 and the component id are DENIED.

        Raises:
            InvalidArgument: the component already has a winch.
        """
        from aerokit.onboard.devices import add_winch  # Imported here, because few components need it.

        add_winch(self._services, winch)

    def add_gripper(self, grab: Callable[[], Awaitable[Any]], release: Callable[[], Awaitable[Any]]) -> None:
        """Serve DO_GRIPPER by two coroutine functions, which return when the gripper has moved.

        Commands for other instances than 0 (all), 1 and the component id are DENIED.

        Raises:
            InvalidArgument: the component already has a gripper.
        """
        from aerokit.onboard.devices import add_gripper  # Imported here, because few components need it.

        add_gripper(self._services, grab, release)

    def add_arm_authorizer(self, authorize: Callable[[int], Any]) -> None:
        """Answer ARM_AUTHORIZATION_REQUEST (https://mavlink.io/en/services/arm_authorization.html).

        Args:
            authorize: function or coroutine function, called with the vehicle's system id. The function returns for
                how many seconds arming is allowed (above 0, at most 255). An exception denies arming, and its text is
                sent as a status text. To deny with a MAV_ARM_AUTH_DENIED_REASON, the function returns a
                :class:`~aerokit.onboard.CommandResult` with the result DENIED and the reason as ``detail``.

        Raises:
            InvalidArgument: the component already has an arm authorizer.
        """
        from aerokit.onboard.devices import add_arm_authorizer  # Imported here, because few components need it.

        add_arm_authorizer(self._services, authorize)

    @property
    def sources(self) -> ComponentSources:
        """Measurements for the autopilot: obstacles, traffic, landing targets, GNSS corrections."""
        from aerokit.onboard.sources import ComponentSources  # Imported here, because few components need it.

        if self._sources is None:
            self._sources = ComponentSources(self._host)
        return self._sources

    async def serve_forever(self) -> None:
        """Wait until the connection ends, and raise its error.

        Raises:
            ConnectionClosed, LinkLost: the connection has ended.
        """
        ended = anyio.Event()
        detach = self.connection.on_end(lambda _: ended.set())
        try:
            await ended.wait()
        finally:
            detach()
        self.connection.raise_if_ended()

    def __repr__(self) -> str:
        name = enum_name(MavType, self._heartbeat.type, str(self._heartbeat.type))
        return f"<OnboardComponent {self.system_id}/{self.component_id}, {name}>"
