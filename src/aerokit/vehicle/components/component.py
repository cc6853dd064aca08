"""``Component``: any MAVLink component of a vehicle, and ``Components``: all of them."""

from __future__ import annotations

import json
import math
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit._internal.files import decompress
from aerokit._internal.formatting import enum_name
from aerokit._internal.values import Snapshot
from aerokit.connection.bus import Overflow, Subscription
from aerokit.connection.cells import Source, StateCell
from aerokit.connection.heartbeats import is_autopilot
from aerokit.errors import (
    CommandRejected,
    FileFormatError,
    InvalidArgument,
    NotSupported,
    OperationTimeout,
)
from aerokit.events import SILENT_AFTER_S
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CompMetadataType, MavCmd, MavComponent, MavType
from aerokit.mavlink.message import Message
from aerokit.vehicle.commanding.simple_orders import request_refusal
from aerokit.vehicle.components.session import WEB_SCHEMES, ComponentSession

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.events import Event
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.messages import CommandAck, Heartbeat
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.sender import OrderSender
    from aerokit.vehicle.components.settings import Settings
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.parameters.parameters import Parameters
    from aerokit.vehicle.session.session import VehicleSession

__all__ = ["Component", "ComponentInformation", "ComponentStatus"]


class ComponentStatus(Snapshot):
    """One component of the vehicle's system.

    ``kind`` is ``"autopilot"``, ``"camera"``, ``"gimbal"``, ``"onboard_controller"``, ``"adsb"``, ``"parachute"`` …:
    MAV_TYPE in lower case or, for MAV_TYPE_GENERIC, MAV_COMPONENT. ``device_id`` is 1 to 6 for a camera or gimbal that
    has no component id of its own, otherwise 0. The ``component_id`` of such a device is that of the component to which
    it is attached. ``received_at`` is the time of the component's last message on the event loop's clock.
    """

    component_id: int
    device_id: int
    kind: str
    received_at: float


class ComponentInformation(Snapshot):
    """Identity of a component (COMPONENT_INFORMATION_BASIC); unknown texts are empty.

    ``capabilities`` are MAV_PROTOCOL_CAPABILITY bits; ``manufactured_at`` is in seconds since 1970, None if unknown.
    """

    vendor: str
    model: str
    software_version: str
    hardware_version: str
    serial_number: str
    capabilities: int
    manufactured_at: int | None


def kind_of(heartbeat: Heartbeat | None, component_id: int) -> str:
    """Return the kind of a component according to its MAV_TYPE, or to its component id if the type is generic."""
    if heartbeat is None:
        return "unknown"
    if is_autopilot(heartbeat):
        return "autopilot"
    if heartbeat.type != MavType.GENERIC:
        return enum_name(MavType, heartbeat.type, "unknown").lower()
    return enum_name(MavComponent, component_id, "unknown").lower()


ItemT = TypeVar("ItemT", bound="Message | Event")

MessageT = TypeVar("MessageT", bound=Message)

MetadataKind = Literal["general", "parameter", "commands", "peripherals", "events", "actuators"]

ATTEMPT_TIMEOUT_S, REQUEST_ATTEMPTS = 1.0, 3


@checks_arguments
class Component(ReadOnly):
    """One component of a vehicle, for example a camera, a gimbal or a companion computer.

    Returned by :meth:`aerokit.Vehicle.component`. Commands, messages, rates, parameters and files of the component work
    like those of the autopilot. See https://mavlink.io/en/services/component_information.html
    """

    def __init__(
        self,
        session: ComponentSession | VehicleSession,
        sender: OrderSender,
        files: Callable[[], Files],
        parameters: Callable[[], Parameters],
        component_of: Callable[[int], Component],
    ) -> None:
        self._session = session
        self._sender = sender
        # Returns the component of this vehicle that has a given id.
        self._component_of = component_of
        self._make_files = files
        self._make_parameters = parameters
        self.system_id: int = session.system_id
        """System id of the vehicle."""
        self.component_id: int = session.component_id
        """MAV_COMPONENT id, 1 to 255."""

    def __repr__(self) -> str:
        return f"<Component {self.system_id}/{self.component_id} {self.kind}, {self._session.describe_link()}>"

    @property
    def kind(self) -> str:
        """Kind according to HEARTBEAT: ``"camera"``, ``"gimbal"``, ``"onboard_controller"`` … or ``"unknown"``."""
        heartbeat = self._session.connection.heartbeats.get((self.system_id, self.component_id))
        return kind_of(heartbeat, self.component_id)

    @property
    def age(self) -> float:
        """Seconds since the last HEARTBEAT of the component; inf before the first."""
        connection = self._session.connection
        return connection.now() - connection.last_heartbeat_at(self.system_id, self.component_id)

    @property
    def is_silent(self) -> bool:
        """True if the component's last HEARTBEAT is older than 3.5 seconds, or none was received."""
        return self.age > SILENT_AFTER_S

    async def information(self, *, timeout: float = 3.0) -> ComponentInformation:
        """Request identity and capabilities of the component (COMPONENT_INFORMATION_BASIC).

        Raises:
            CommandRejected: the component does not support the message.
            OperationTimeout: the component did not answer within ``timeout`` seconds.
        """
        message = await self.request(m.ComponentInformationBasic, timeout=timeout)
        return ComponentInformation(
            vendor=message.vendor_name,
            model=message.model_name,
            software_version=message.software_version,
            hardware_version=message.hardware_version,
            serial_number=message.serial_number,
            capabilities=message.capabilities,
            manufactured_at=message.time_manufacture_s or None,
        )

    async def metadata(self, kind: MetadataKind = "general", *, timeout: float = 3.0) -> dict[str, Any]:
        """Read a metadata file of the component (COMPONENT_METADATA) by MAVFTP and return its JSON object.

        Args:
            kind: ``"general"`` lists the other files: ``"parameter"``, ``"commands"``, ``"peripherals"``, ``"events"``,
                ``"actuators"``. PX4 has general, parameter, events and actuators.
            timeout: seconds to wait for the address of the file.

        Raises:
            NotSupported: the component has no such file, does not answer the request for its address, or names a file
                that is not stored on the vehicle.
            FileFormatError: the file is damaged.
            FileError, FileTimeout: the file cannot be read.
        """
        general = await _read_json(self, await _general_uri(self, timeout))
        if kind == "general":
            return general
        entries = general.get("metadataTypes", [])
        if not isinstance(entries, list):
            raise FileFormatError(f"the metadata of component {self.component_id} is damaged: it has no list of files")
        for entry in entries:
            if not isinstance(entry, dict) or entry.get("type") != METADATA_TYPES[kind]:
                continue
            if isinstance(entry.get("uri"), str):
                return await _read_json(self, entry["uri"])
        raise NotSupported(f"component {self.component_id} has no {kind} metadata")

    async def fetch(self, uri: str, *, idle_timeout_s: float = 10.0) -> bytes:
        """Return the content of the file at an address that a component has reported; at most 16 MB.

        Args:
            uri: ``mftp://path`` is on this component, ``mftp://[;comp=1]path`` on another component of the vehicle;
                ``http://`` and ``https://`` are fetched from the web.
            idle_timeout_s: fail after this many seconds without progress.

        Raises:
            InvalidArgument: the address has another scheme.
            FileFormatError: the file has more than 16 MB.
            FileError, FileTimeout, OperationRejected: the file could not be read.
        """
        from aerokit.vehicle.components.session import fetch

        return await fetch(uri, self._files_of, self.component_id, idle_timeout_s)

    def _files_of(self, component_id: int) -> Files:
        return self._component_of(component_id).files

    async def command(
        self,
        command: int,
        *params: float,
        retries: int | None = None,
        attempt_timeout: float | None = None,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
    ) -> CommandAck:
        """Send any MAV_CMD as COMMAND_LONG and return its COMMAND_ACK, like :meth:`aerokit.Vehicle.command`."""
        return await self._sender.send_raw(
            self._session.commands.send_long,
            command,
            *params,
            component_id=self.component_id,
            retries=retries,
            attempt_timeout=attempt_timeout,
            progress_timeout=progress_timeout,
            on_progress=on_progress,
        )

    async def request(
        self,
        message_type: type[MessageT],
        *params: float,
        timeout: float = 3.0,
        where: Callable[[MessageT], bool] | None = None,
    ) -> MessageT:
        """Request one message (MAV_CMD_REQUEST_MESSAGE) and return it.

        Args:
            message_type: class of the message.
            params: param2 to param6, e.g. the number of a camera, stream or storage.
            timeout: seconds to wait; the message is requested up to three times.
            where: predicate to select one of several messages.

        Raises:
            CommandRejected: the component refused.
            OperationTimeout: the message did not arrive.
        """
        commands, subscriber = self._session.commands, self._session.subscriber
        with subscriber.subscribe((message_type,), capacity=100, overflow="drop_oldest", rate_hz=None) as answers:
            with anyio.move_on_after(timeout):
                for attempt in range(1, REQUEST_ATTEMPTS + 1):
                    is_last = attempt == REQUEST_ATTEMPTS
                    may_get_late_ack = commands.may_get_late_ack(MavCmd.REQUEST_MESSAGE, self.component_id)
                    refusal = await request_refusal(
                        commands, message_type.ID, *params, component_id=self.component_id, attempts=1
                    )
                    # If the refusal may belong to an earlier request, it counts only after the last attempt.
                    if may_get_late_ack and not is_last:
                        refusal = None
                    if refusal is not None:
                        wait_s = 0.0  # Return the message only if it has arrived already.
                    elif is_last:
                        wait_s = math.inf  # `timeout` ends the wait.
                    else:
                        wait_s = ATTEMPT_TIMEOUT_S
                    with anyio.move_on_after(wait_s):
                        async for answer in answers:
                            if where is None or where(answer):
                                return answer
                    if refusal is not None:
                        raise refusal
        raise OperationTimeout(
            f"component {self.component_id} sent no {message_type.NAME} within {timeout:g} s;"
            f" {self._session.describe_link()}"
        )

    def subscribe(
        self,
        *types: type[ItemT],
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
        rate_hz: float | None = None,
    ) -> Subscription[ItemT]:
        """Subscribe to messages of this component, requested at ``rate_hz``, and to events about it.

        Works like :meth:`aerokit.Vehicle.subscribe`.
        """
        return self._session.subscriber.subscribe(types, capacity, overflow, rate_hz)

    def message(self, message_type: type[MessageT], *, rate_hz: float | None = None) -> StateCell[MessageT]:
        """Return a cell with the component's latest message of a type, like :meth:`aerokit.Vehicle.message`."""
        return self._session.subscriber.cell(message_type, rate_hz)

    @contextmanager
    def rate(self, message_type: type[Message], rate_hz: float) -> Iterator[None]:
        """Request ``message_type`` at ``rate_hz`` or faster for the duration of the ``with`` block."""
        release = self._session.rates.request(message_type, rate_hz)
        try:
            yield
        finally:
            release()

    @cached_property
    def files(self) -> Files:
        """The component's files, by MAVFTP."""
        return self._make_files()

    @cached_property
    def parameters(self) -> Parameters:
        """The component's parameters (PARAM_VALUE)."""
        return self._make_parameters()

    @cached_property
    def settings(self) -> Settings:
        """The component's settings (PARAM_EXT). A camera definition file explains the settings of a camera."""
        from aerokit.vehicle.components.settings import Settings

        async def information() -> m.CameraInformation:
            return await self.request(m.CameraInformation)

        return Settings(self._session, information, self._files_of)


METADATA_TYPES = {metadata_type.name.lower(): int(metadata_type) for metadata_type in CompMetadataType}


async def _general_uri(component: Component, timeout: float) -> str:
    try:
        return (await component.request(m.ComponentMetadata, timeout=timeout)).uri
    except CommandRejected:  # The component may only support COMPONENT_INFORMATION.
        pass
    except OperationTimeout as error:
        raise NotSupported(f"component {component.component_id} reports no metadata: {error}") from None
    try:
        return (await component.request(m.ComponentInformation, timeout=timeout)).general_metadata_uri
    except (CommandRejected, OperationTimeout) as error:
        raise NotSupported(f"component {component.component_id} reports no metadata: {error}") from None


async def _read_json(component: Component, uri: str) -> dict[str, Any]:
    if uri.lower().startswith(WEB_SCHEMES):
        raise NotSupported(f"{uri} is on the web, not on the vehicle: download it with another program")
    try:
        data = decompress(await component.fetch(uri), uri)
    except InvalidArgument as error:  # The component, not the caller, has chosen the address.
        raise NotSupported(f"component {component.component_id}: {error}") from None
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{uri} is not valid JSON: {error}") from None
    if not isinstance(content, dict):
        raise FileFormatError(f"{uri}: the top-level JSON value is not an object")
    return content


# Device ids of cameras and gimbals without their own component id.
DEVICE_IDS = range(1, 7)
DEVICE_MESSAGES = (
    (m.CameraInformation, "camera_device_id", "camera"),
    (m.GimbalManagerInformation, "gimbal_device_id", "gimbal"),
    (m.GimbalDeviceAttitudeStatus, "gimbal_device_id", "gimbal"),
)


class Components:
    """The components of one vehicle: their status, and the `Component` objects."""

    def __init__(
        self, context: VehicleContext, files: Callable[[], Files], parameters: Callable[[], Parameters]
    ) -> None:
        self._context = context
        self._session = context.session
        # These functions return the autopilot's objects, which the vehicle creates on first use.
        self._files = files
        self._parameters = parameters
        self._by_id: dict[int, Component] = {}
        # Maps (component id, device id) to the last status.
        self._statuses: dict[tuple[int, int], ComponentStatus] = {}
        session = context.session
        self.cell: StateCell[tuple[ComponentStatus, ...]] = session.connection.new_cell("components", "HEARTBEAT")
        session.register_cell(self.cell)
        bus = session.connection.bus
        session.at_close(bus.attach(m.Heartbeat, self._on_heartbeat, system_id=session.system_id))
        for message_type, field, kind in DEVICE_MESSAGES:
            if bus.dialect.get(message_type.ID) is not None:  # The user's dialect may lack a message.
                on_message = self._device_listener(field, kind)
                session.at_close(bus.attach(message_type, on_message, system_id=session.system_id))
        for (system_id, _), heartbeat in session.connection.heartbeats.items():
            if system_id == session.system_id:
                self._on_heartbeat(heartbeat)

    def component(self, component_id: int) -> Component:
        """Return the object for a component id. The component need not have been discovered."""
        if not 1 <= component_id <= 255:
            raise InvalidArgument(f"component_id = {component_id} is not allowed: it must be 1 to 255")
        if component_id not in self._by_id:
            self._by_id[component_id] = self._new(component_id)
        return self._by_id[component_id]

    def _new(self, component_id: int) -> Component:
        from aerokit.vehicle.files.files import Files
        from aerokit.vehicle.parameters.parameters import Parameters

        sender = self._context.sender
        if component_id == self._session.component_id:  # The autopilot shares the session of the vehicle.
            return Component(self._session, sender, self._files, self._parameters, self.component)
        session = ComponentSession(self._session, component_id)
        files = Files(session.transfers)
        return Component(session, sender, lambda: files, lambda: Parameters(session, files), self.component)

    def _on_heartbeat(self, heartbeat: m.Heartbeat) -> None:
        frame = heartbeat.received_frame
        if frame is not None:
            self._record(frame, device_id=0, kind=kind_of(heartbeat, frame.component_id))

    def _device_listener(self, id_field: str, kind: str) -> Callable[[Any], None]:
        def on_message(message: Any) -> None:
            device_id, frame = getattr(message, id_field), message.received_frame
            if frame is not None and device_id in DEVICE_IDS:
                self._record(frame, device_id=device_id, kind=kind)

        return on_message

    def _record(self, frame: Frame, *, device_id: int, kind: str) -> None:
        status = ComponentStatus(frame.component_id, device_id, kind, frame.received_at)
        self._statuses[frame.component_id, device_id] = status
        source = Source(frame.system_id, frame.component_id, "HEARTBEAT")
        self.cell.set(tuple(self._statuses[key] for key in sorted(self._statuses)), source)
