"""``aerokit.connect``: from an address to a vehicle, for the time of an ``async with`` block."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import BusyError, ConnectFailed, LocalProtocolError
from aerokit.links.link import Link
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.messages import Heartbeat
from aerokit.runtime.connection import MAV_COMP_ID_MISSIONPLANNER, Connection, open_connection
from aerokit.runtime.diagnosis import is_autopilot, no_vehicle_reason
from aerokit.runtime.events import VehicleFound
from aerokit.vehicle.vehicle import Vehicle

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncIterator, Mapping

    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.message import Message

__all__ = ["connect"]


@asynccontextmanager
async def connect(
    address: str | Link | Connection,
    *,
    system_id: int | None = None,
    timeout: float = 30.0,
    rates: Mapping[type[Message], float] | None = None,
    source_system: int = 255,
    source_component: int = MAV_COMP_ID_MISSIONPLANNER,
    baud: int = 57600,
    dialect: Dialect = STANDARD,
    mavlink_version: int = 2,
    record: str | os.PathLike[str] | None = None,
) -> AsyncIterator[Vehicle]:
    """Connect to a vehicle for the time of the ``async with`` block.

    Returns at its first heartbeat; ``await vehicle.wait_ready()`` waits until it could fly. Runs inside the asyncio
    loop that is already running, in one task group: nothing outlives the block.

    Args:
        address: ``"udpin:0.0.0.0:14550"``, ``"tcp:127.0.0.1:5760"``, ``"/dev/ttyACM0,57600"``, a ``.tlog`` file …;
            a link; or a connection that is open already, for several vehicles on one link.
        system_id: the vehicle's MAVLink system id, 1–255; None takes the first autopilot that is heard.
        timeout: seconds to wait for its first heartbeat, above 0.
        rates: message class → Hz, asked for instead of the default rates; ``{}`` asks for nothing.
        source_system: our own system id.
        source_component: our own component id.
        baud: of a serial link whose address names none.
        dialect: the messages that are understood.
        mavlink_version: of what we send, 1 or 2.
        record: a ``.tlog`` file for everything received and sent; an existing file is replaced.

    Raises:
        LocalProtocolError: an argument is wrong. Nothing was opened.
        LinkOpenError: the link could not be opened.
        LinkLost: the link went down while waiting.
        ConnectFailed: no heartbeat of such a vehicle came in time; the text says what was heard instead.
    """
    if system_id is not None and not 1 <= system_id <= 255:
        raise LocalProtocolError(
            f"system_id = {system_id} is not allowed: 1 to 255, or None for the first heard"
        )
    if not timeout > 0:
        raise LocalProtocolError(f"timeout = {timeout} is not allowed: above 0")
    if isinstance(address, Connection):
        async with _attached(address, system_id, timeout, rates) as vehicle:
            yield vehicle
        return
    async with (
        open_connection(
            address,
            source_system=source_system,
            source_component=source_component,
            baud=baud,
            dialect=dialect,
            mavlink_version=mavlink_version,
            record=record,
        ) as connection,
        _attached(connection, system_id, timeout, rates) as vehicle,
    ):
        yield vehicle


@asynccontextmanager
async def _attached(
    connection: Connection,
    system_id: int | None,
    timeout: float,
    rates: Mapping[type[Message], float] | None,
) -> AsyncIterator[Vehicle]:
    """Find a vehicle on an open connection and keep it for the time of the block."""
    heartbeat = await _first_heartbeat(connection, system_id, timeout)
    frame = heartbeat.received_frame
    assert frame is not None
    if frame.system_id in connection.attached:
        raise BusyError(f"system {frame.system_id} has a vehicle object on this connection already")
    vehicle = Vehicle(connection, frame.system_id, frame.component_id, heartbeat)
    failure: BaseException | None = None
    connection.attached.add(frame.system_id)
    try:
        async with anyio.create_task_group() as tasks:
            vehicle._start(tasks, heartbeat, rates)
            connection.bus.publish(VehicleFound(connection.now(), frame.system_id, frame.component_id))
            try:
                yield vehicle
            except asyncio.CancelledError:
                raise
            except BaseException as error:
                failure = error  # raised below: a task group would wrap it in an exception group
            finally:
                tasks.cancel_scope.cancel()
    finally:
        vehicle._close()
        connection.attached.discard(frame.system_id)
    if failure is not None:
        raise failure


async def _first_heartbeat(connection: Connection, system_id: int | None, timeout: float) -> Heartbeat:
    def is_wanted(heartbeat: Heartbeat) -> bool:
        frame = heartbeat.received_frame
        return (
            frame is not None
            and frame.system_id != 0
            and system_id in (None, frame.system_id)
            and is_autopilot(heartbeat)
        )

    for known in connection.heard.values():
        if is_wanted(known):
            return known
    with (
        connection.subscribe(Heartbeat, capacity=64) as heartbeats,
        anyio.move_on_after(timeout),
    ):
        async for heartbeat in heartbeats:
            if is_wanted(heartbeat):
                return heartbeat
    wanted = "an autopilot" if system_id is None else f"the autopilot of system {system_id}"
    raise ConnectFailed(
        f"no heartbeat of {wanted} within {timeout:g} s on {connection.link.address}:"
        f" {no_vehicle_reason(connection, system_id)}"
    )
