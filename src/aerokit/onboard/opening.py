"""``aerokit.component``: makes your program a MAVLink component for the duration of an ``async with`` block."""

from __future__ import annotations

from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checked
from aerokit._internal.async_block import async_block
from aerokit.connection.opening import DEFAULT_BAUD, open_connection
from aerokit.errors import BusyError, InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavAutopilot, MavState, MavType
from aerokit.mavlink.messages import Heartbeat
from aerokit.onboard.component import MAVLINK_VERSION, OnboardComponent
from aerokit.onboard.identity import Identity

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncIterator, Iterable, Sequence

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.signing import Signing
    from aerokit.transport.link import Link
    from aerokit.transport.sockets import PeerFilter


@checked
@async_block
async def component(
    address: str | Link | Sequence[str | Link] | None = None,
    *,
    connection: Connection | None = None,
    system_id: int = 1,
    component_id: int = 191,
    type: int = MavType.ONBOARD_CONTROLLER.value,  # noqa: A002 - the name of the field in HEARTBEAT
    autopilot: int = MavAutopilot.INVALID.value,
    identity: Identity = Identity(),  # noqa: B008 - it is immutable
    parameters_file: str | os.PathLike[str] | None = None,
    bytewise: bool = True,
    accepts: Iterable[int] | None = None,
    baud: int = 57600,
    dialect: Dialect = STANDARD,
    mavlink_version: int = 2,
    signing: Signing | None = None,
    record: str | os.PathLike[str] | None = None,
    reconnect: bool = False,
    peers: PeerFilter | None = None,
    may_move: bool = False,
) -> AsyncIterator[OnboardComponent]:
    """Make your program a MAVLink component, such as a camera, for the duration of the ``async with`` block.

    The component runs on the current event loop, and answers other programs while your block waits. When the block
    ends, running commands are cancelled and answered, and the heartbeat stops.

    Args:
        address: a connection string, a link or a list of them, as for :func:`aerokit.open_connection`.
        connection: an open connection instead of an address. Use this for several components on one link, or for a
            component and a ground station. The arguments after ``accepts`` are then not allowed.
        system_id: system id of the component, 1 to 255. Use the system id of the vehicle that carries the component.
        component_id: component id (MAV_COMPONENT), 1 to 255.
        type: MAV_TYPE of the heartbeat, such as ONBOARD_CONTROLLER, CAMERA, GIMBAL, WINCH or GRIPPER.
        autopilot: MAV_AUTOPILOT of the heartbeat; INVALID for everything that is not a flight controller.
        identity: vendor, model and versions that the component reports.
        parameters_file: JSON file that stores the parameters; the file is replaced atomically after each change. With
            None, parameters are not stored.
        bytewise: True to encode integers in PARAM_VALUE bytewise, as PX4 does; False to cast them to float, as
            ArduPilot does. The component's capabilities announce the encoding. Some clients ignore them and expect the
            bytewise encoding of all systems that HEARTBEAT does not report as ArduPilot.
        accepts: system ids whose messages are processed; None means all. Without signing, senders can claim any id.
        baud: bits per second of a serial link whose address has none.
        dialect: the messages that are decoded.
        mavlink_version: version of sent messages, 1 or 2.
        signing: key that signs sent frames; received frames without its signature are refused.
        record: ``.tlog`` file for all traffic.
        reconnect: True to reopen a lost link instead of ending the connection.
        peers: IP addresses and networks to accept, for links with an open port.
        may_move: True to accept a sender that fell silent and returns from another IP address.

    Raises:
        InvalidArgument: an argument is not allowed; nothing was opened.
        BusyError: the connection already has a component with these ids.
        LinkOpenError: the link or the recording could not be opened.
        FileFormatError, OSError: ``parameters_file`` cannot be read.
    """
    heartbeat = _heartbeat(type, autopilot)
    if not 1 <= system_id <= 255 or not 1 <= component_id <= 255:
        raise InvalidArgument(
            f"system_id, component_id = {system_id}, {component_id} are not allowed: both must be 1 to 255"
        )
    if (address is None) == (connection is None):
        raise InvalidArgument("pass either an address or connection=…")
    for argument, is_given in (
        ("baud", baud != DEFAULT_BAUD),
        ("dialect", dialect is not STANDARD),
        ("mavlink_version", mavlink_version != 2),
        ("signing", signing is not None),
        ("record", record is not None),
        ("reconnect", reconnect),
        ("peers", peers is not None),
        ("may_move", may_move),
    ):
        if connection is not None and is_given:
            raise InvalidArgument(f"{argument} = … is not allowed with connection=…: pass it to open_connection")
    async with AsyncExitStack() as stack:
        if connection is None:
            assert address is not None
            connection = await stack.enter_async_context(
                open_connection(
                    address,
                    source_system=system_id,
                    source_component=component_id,
                    baud=baud,
                    dialect=dialect,
                    mavlink_version=mavlink_version,
                    signing=signing,
                    record=record,
                    reconnect=reconnect,
                    peers=peers,
                    may_move=may_move,
                    heartbeat=None,  # The component sends its own heartbeat.
                )
            )
        connection.raise_if_ended()
        key = (system_id, component_id)
        if key in connection.components:
            raise BusyError(f"this connection already has a component {system_id}/{component_id}")
        onboard_component = OnboardComponent(
            connection,
            system_id=system_id,
            component_id=component_id,
            heartbeat=heartbeat,
            identity=identity,
            parameters_file=None if parameters_file is None else Path(parameters_file),
            bytewise=bytewise,
            accepts=accepts,
        )
        connection.components.add(key)
        try:
            onboard_component._send_heartbeat()
            yield onboard_component
        finally:
            try:
                await onboard_component._aclose()
            finally:  # The ids are reserved until here, because the component answered messages until now.
                connection.components.discard(key)


def _heartbeat(type_: int, autopilot: int) -> Heartbeat:
    for name, value in (("type", type_), ("autopilot", autopilot)):
        check_range(name, value, 0, 255)
    return Heartbeat(
        type_, autopilot, base_mode=0, custom_mode=0, system_status=MavState.ACTIVE, mavlink_version=MAVLINK_VERSION
    )
