"""``Component``: one device of a vehicle beside its autopilot, spoken to as the autopilot is."""

from __future__ import annotations

import json
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit._internal.files import unpacked
from aerokit._internal.values import Snapshot
from aerokit.connection.bus import Overflow, Subscription
from aerokit.connection.components import is_autopilot
from aerokit.errors import CommandRejected, CommandTimeout, FileFormatError, NotSupported, OperationTimeout
from aerokit.events import SILENT_AFTER_S
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CompMetadataType, MavCmd, MavComponent, MavType
from aerokit.mavlink.message import Message
from aerokit.vehicle.components.session import WEB

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.connection.cells import StateCell
    from aerokit.events import Event
    from aerokit.mavlink.messages import CommandAck, ComponentInformationBasic, Heartbeat
    from aerokit.vehicle.commanding.sender import OrderSender
    from aerokit.vehicle.components.session import ComponentTalk
    from aerokit.vehicle.components.settings import Settings
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.parameters.parameters import Parameters
    from aerokit.vehicle.session.session import Talk

__all__ = [
    "KINDS",
    "Component",
    "ComponentInformation",
    "ComponentStatus",
    "information_of",
    "kind_of",
    "read_metadata",
]


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


ItemT = TypeVar("ItemT", bound="Message | Event")

MessageT = TypeVar("MessageT", bound=Message)

MetadataKind = Literal["general", "parameter", "commands", "peripherals", "events", "actuators"]

ASK_S, ASKED = 1.0, 3


@checks_arguments
class Component(ReadOnly):
    """One component of a vehicle: a camera, a gimbal, a companion computer, a receiver or another.

    Made by :meth:`aerokit.Vehicle.component`. Commands, messages with rates, parameters and files are those of this
    component, by the code that the autopilot's go through. https://mavlink.io/en/services/component_information.html
    """

    def __init__(
        self,
        talk: ComponentTalk | Talk,
        sender: OrderSender,
        files: Callable[[], Files],
        parameters: Callable[[], Parameters],
        beside: Callable[[int], Component],
    ) -> None:
        self._talk, self._sender, self._beside = talk, sender, beside
        self._make_files, self._make_parameters = files, parameters
        self.system_id: int = talk.system_id
        """The vehicle's system id."""
        self.component_id: int = talk.component_id
        """Its MAV_COMPONENT id, 1 to 255."""

    def __repr__(self) -> str:
        return f"<Component {self.system_id}/{self.component_id} {self.kind}, {self._talk.describe_link()}>"

    # --------------------------------------------------------------------------------- state

    @property
    def kind(self) -> str:
        """What its HEARTBEAT says it is: ``"camera"``, ``"gimbal"``, ``"onboard_controller"`` … or ``"unknown"``."""
        heartbeat = self._talk.connection.heard.get((self.system_id, self.component_id))
        return kind_of(heartbeat, self.component_id)

    @property
    def age(self) -> float:
        """Seconds since its last HEARTBEAT; inf before the first."""
        connection = self._talk.connection
        return connection.now() - connection.heard_at(self.system_id, self.component_id)

    @property
    def is_silent(self) -> bool:
        """Whether it has not been heard for more than 3.5 seconds, or never."""
        return self.age > SILENT_AFTER_S

    async def information(self, *, timeout: float = 3.0) -> ComponentInformation:
        """Ask what it is and what it can do (COMPONENT_INFORMATION_BASIC).

        Raises:
            CommandRejected: it does not know the question.
            OperationTimeout: it did not answer within ``timeout`` seconds.
        """
        return information_of(await self.request(m.ComponentInformationBasic, timeout=timeout))

    async def metadata(self, kind: MetadataKind = "general", *, timeout: float = 3.0) -> dict[str, Any]:
        """What it tells of itself in a file (COMPONENT_METADATA, read by MAVFTP), as its JSON has it.

        Args:
            kind: ``"general"`` lists the others: ``"parameter"``, ``"commands"``, ``"peripherals"``, ``"events"``,
                ``"actuators"``. PX4 has general, parameter, events and actuators.
            timeout: seconds until it must have said where the files are.

        Raises:
            NotSupported: it has no such file, or not on the vehicle.
            FileFormatError: the file is damaged.
            FileError, FileTimeout: it cannot be read.
        """
        return await read_metadata(self, kind, timeout)

    async def fetch(self, uri: str, *, patience_s: float = 10.0) -> bytes:
        """The content of a file that a component names by its address, at most 16 MB.

        Args:
            uri: ``mftp://path`` is on this component, ``mftp://[;comp=1]path`` on another one of the vehicle;
                ``http://`` and ``https://`` are fetched from the web.
            patience_s: give up when nothing has come for so many seconds.

        Raises:
            InvalidArgument: the address is another one.
            FileFormatError: the file has more than 16 MB.
            FileError, FileTimeout, OperationRejected: it was not given.
        """
        from aerokit.vehicle.components.session import fetch

        return await fetch(uri, self._files_of, self.component_id, patience_s)

    def _files_of(self, component_id: int) -> Files:
        return self._beside(component_id).files

    # ------------------------------------------------------------------------------ commands

    async def command(
        self,
        command: int,
        *params: float,
        retries: int | None = None,
        attempt_timeout: float | None = None,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
    ) -> CommandAck:
        """Send it any MAV_CMD as COMMAND_LONG and return its ACCEPTED ack; as :meth:`aerokit.Vehicle.command`."""
        return await self._sender.answered(
            self._talk.commands.send_long,
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
        """Ask for one message (MAV_CMD_REQUEST_MESSAGE with these params behind the id) and return it.

        Args:
            message_type: its class.
            params: param2 to param6, where the message has several: which camera, stream, card …
            timeout: seconds until it must have come; it is asked for up to three times.
            where: which of several is meant; called with each that comes.

        Raises:
            CommandRejected: it refused.
            OperationTimeout: no such message came.
        """
        with self._talk.hearing.subscribe((message_type,), 100, "drop_oldest", None) as answers:
            refusal: CommandRejected | None = None
            with anyio.move_on_after(timeout):
                for _ in range(ASKED):
                    try:
                        await self._talk.commands.send_long(
                            MavCmd.REQUEST_MESSAGE,
                            message_type.ID,
                            *params,
                            component_id=self.component_id,
                            attempts=1,
                        )
                    except CommandTimeout:
                        pass
                    except CommandRejected as error:
                        refusal = error
                    with anyio.move_on_after(ASK_S if refusal is None else 0):
                        async for answer in answers:
                            if where is None or where(answer):
                                return answer
                    if refusal is not None:
                        raise refusal
        raise OperationTimeout(
            f"component {self.component_id} sent no {message_type.NAME} within {timeout:g} s;"
            f" {self._talk.describe_link()}"
        )

    # ------------------------------------------------------------------------------ messages

    def subscribe(
        self,
        *types: type[ItemT],
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
        rate_hz: float | None = None,
    ) -> Subscription[ItemT]:
        """What this component says, and events that name it; it is asked for ``rate_hz``.

        As :meth:`aerokit.Vehicle.subscribe`.
        """
        return self._talk.hearing.subscribe(types, capacity, overflow, rate_hz)

    def message(self, message_type: type[MessageT], *, rate_hz: float | None = None) -> StateCell[MessageT]:
        """Its latest message of a kind, in a cell; as :meth:`aerokit.Vehicle.message`."""
        return self._talk.hearing.cell(message_type, rate_hz)

    @contextmanager
    def rate(self, message_type: type[Message], rate_hz: float) -> Iterator[None]:
        """Have it send ``message_type`` at ``rate_hz`` or faster for the time of the ``with`` block."""
        release = self._talk.rates.want(message_type, rate_hz)
        try:
            yield
        finally:
            release()

    # --------------------------------------------------------------------------------- parts

    @cached_property
    def files(self) -> Files:
        """The files on it, by MAVFTP."""
        return self._make_files()

    @cached_property
    def parameters(self) -> Parameters:
        """Its parameters (PARAM_VALUE), as those of the autopilot."""
        return self._make_parameters()

    @cached_property
    def settings(self) -> Settings:
        """Its settings (PARAM_EXT), texts among them; those of a camera with what its definition file says of them."""
        from aerokit.vehicle.components.settings import Settings

        async def information() -> m.CameraInformation:
            return await self.request(m.CameraInformation)

        return Settings(self._talk, information, self._files_of)


KINDS = {each.name.lower(): int(each) for each in CompMetadataType}
"""Kinds of files: ``"general"``, ``"parameter"``, ``"commands"``, ``"peripherals"``, ``"events"``, ``"actuators"``."""


async def read_metadata(component: Component, kind: str, timeout: float) -> dict[str, Any]:
    """Fetch the file of this kind by MAVFTP; see :meth:`Component.metadata`."""
    general = await _read(component, await _general_uri(component, timeout))
    if kind == "general":
        return general
    for each in _listed(general):
        if each.get("type") == KINDS[kind] and isinstance(each.get("uri"), str):
            return await _read(component, each["uri"])
    raise NotSupported(f"component {component.component_id} has no metadata of its {kind}")


async def _general_uri(component: Component, timeout: float) -> str:
    """Where its first file is, by COMPONENT_METADATA, or COMPONENT_INFORMATION of older firmware."""
    try:
        return (await component.request(m.ComponentMetadata, timeout=timeout)).uri
    except CommandRejected:
        pass
    except OperationTimeout as error:
        raise NotSupported(f"component {component.component_id} tells of no metadata: {error}") from None
    try:
        return (await component.request(m.ComponentInformation, timeout=timeout)).general_metadata_uri
    except (CommandRejected, OperationTimeout) as error:
        raise NotSupported(f"component {component.component_id} tells of no metadata: {error}") from None


def _listed(general: dict[str, Any]) -> list[dict[str, Any]]:
    listed = general.get("metadataTypes")
    return [each for each in listed if isinstance(each, dict)] if isinstance(listed, list) else []


async def _read(component: Component, uri: str) -> dict[str, Any]:
    if uri.lower().startswith(WEB):
        raise NotSupported(f"{uri} is not on the vehicle: fetch it by another program")
    data = unpacked(await component.fetch(uri), uri)
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{uri}: no JSON: {error}") from None
    if not isinstance(content, dict):
        raise FileFormatError(f"{uri}: its outermost value is no object")
    return content
