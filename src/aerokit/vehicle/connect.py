"""``aerokit.connect``: opens a connection and finds the vehicle, for the duration of an ``async with`` block."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit.connection.bus import EVERY_SYSTEM, copy_exception
from aerokit.connection.connection import Connection
from aerokit.connection.heartbeats import OwnHeartbeat, is_autopilot
from aerokit.connection.opening import DEFAULT_BAUD, explain_no_vehicle, open_connection
from aerokit.connection.routes import MAX_ROUTES
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import AerokitError, BusyError, ConnectFailed, InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavComponent
from aerokit.mavlink.messages import Heartbeat
from aerokit.transport.link import Link
from aerokit.vehicle.commanding.context import VehicleContext
from aerokit.vehicle.session.rates import check_rate
from aerokit.vehicle.session.session import VehicleSession
from aerokit.vehicle.vehicle import Vehicle

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence

    from aerokit.hub.hub import Hub
    from aerokit.hub.values import Endpoint
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.signing import Signing
    from aerokit.transport.sockets import PeerFilter

__all__ = ["connect", "vehicles_on", "warn_if_left_flying"]

logger: logging.Logger = logging.getLogger("aerokit")

# A heartbeat older than this (seconds) does not prove that the vehicle is present, so the search waits for a new one.
HEARTBEAT_MAX_AGE_S = 2.0

# A component other than 1 counts as the autopilot after this many heartbeats, if component 1 has sent none.
MIN_LONE_HEARTBEATS = 3


@checked
@async_block
async def connect(
    address: str | Link | Sequence[str | Link] | Connection,
    *,
    system_id: int | None = None,
    timeout: float = 30.0,
    rates: Mapping[type[Message], float] | None = None,
    source_system: int = 255,
    source_component: int = MavComponent.MISSIONPLANNER.value,
    baud: int = 57600,
    dialect: Dialect = STANDARD,
    mavlink_version: int = 2,
    signing: Signing | None = None,
    record: str | os.PathLike[str] | None = None,
    reconnect: bool = False,
    peers: PeerFilter | None = None,
    may_move: bool = False,
    heartbeat: OwnHeartbeat | None = OwnHeartbeat(),  # noqa: B008 - it is immutable
    share: Iterable[str | Endpoint | Link] = (),
) -> AsyncIterator[Vehicle]:
    """Connect to a vehicle for the duration of the ``async with`` block.

    Returns at the vehicle's first heartbeat; ``await vehicle.wait_ready()`` waits until it can fly. Runs inside the
    running asyncio loop: nothing outlives the block, and exceptions raised in the block propagate unchanged.

    Args:
        address: ``"udpin:0.0.0.0:14550"``, ``"tcp:127.0.0.1:5760"``, ``"/dev/ttyACM0,57600"``, a ``.tlog`` file …, or a
            link; a list of these, if several links lead to the same vehicle (docs/how-to/several-links.md); or an open
            connection, to use several vehicles on one link. With an open connection, the arguments after ``rates``
            are not allowed: pass them to ``open_connection``.
        system_id: the vehicle's MAVLink system id, 1–255; None means the first autopilot found.
        timeout: seconds to wait for the vehicle's first heartbeat, above 0.
        rates: rates to request instead of the default ones, as a mapping of message class to Hz (above 0, at most
            1000). ``{}`` requests nothing.
        source_system: our own system id.
        source_component: our own component id, 0–255. 0 is not a valid component id, but some old programs use it.
        baud: baud rate of a serial link whose address has none. Not allowed if only link objects are given.
        dialect: the message definitions to use.
        mavlink_version: version of the frames we send, 1 or 2.
        signing: signs everything we send, and rejects frames that are not signed with its key (docs/signing.md).
            None: no signatures.
        record: a ``.tlog`` file that receives all traffic in both directions; an existing file is kept under a numbered
            name, ``flight.1.tlog``.
        reconnect: reopen a lost link, with as many attempts as it needs, instead of ending the connection.
        peers: accept datagrams and connections only from these IP addresses and networks: ``"10.0.0.7"``,
            ``["10.0.0.0/24"]``. For links with an open port: udpin, udpbcast, tcpin. None: accept all.
        may_move: accept a vehicle that fell silent and returns from a new IP address, even if its sequence numbers and
            time since boot do not continue (for example after a reboot). By default such an address is refused
            (``RouteChangeRefused``), because it may belong to another sender.
        heartbeat: contents of our own HEARTBEAT, and the condition under which it is sent. None: no heartbeat is sent,
            so the vehicle sees no ground station. PX4 then sends no status texts, and a ``udpout:`` link stays silent.
        share: addresses at which ground stations and other programs can use the same link, such as
            ``["tcpin:127.0.0.1:5760"]`` (docs/hub.md). These programs should use other ids than this program. For an
            open connection use ``async with aerokit.hub.shared(connection, […])``.

    Raises:
        InvalidArgument: an argument is invalid. Nothing was opened.
        BusyError: this connection already has a vehicle object for this system.
        LinkOpenError: the link, a shared link or the recording could not be opened.
        LinkLost, ConnectionClosed: the link failed while waiting, or the connection was closed.
        ConnectFailed: no heartbeat of the requested vehicle arrived in time; the error text says what was received
            instead.
    """
    used_dialect = address.bus.dialect if isinstance(address, Connection) else dialect
    _check_arguments(system_id, timeout, rates, used_dialect)
    if isinstance(address, Connection):
        for is_given, arguments, instead in (
            (source_system != 255, f"source_system = {source_system} is", "pass source_system to open_connection"),
            (
                source_component != MavComponent.MISSIONPLANNER,
                f"source_component = {source_component} is",
                "pass source_component to open_connection",
            ),
            (baud != DEFAULT_BAUD, f"baud = {baud} is", "pass baud to open_connection"),
            (dialect is not STANDARD, f"dialect = {dialect.name!r} is", "pass dialect to open_connection"),
            (mavlink_version != 2, f"mavlink_version = {mavlink_version} is", "set connection.mavlink_version"),
            (record is not None, "record = … is", "use connection.record(…)"),
            (signing is not None, "signing = … is", "set connection.signing"),
            (reconnect, "reconnect = True is", "pass reconnect to open_connection"),
            (heartbeat != OwnHeartbeat(), "heartbeat = … is", "pass heartbeat to open_connection"),
            (peers is not None or may_move, "peers and may_move are", "pass them to open_connection"),
            (bool(share), "share = … is", "use aerokit.hub.shared(connection, …)"),
        ):
            if is_given:
                raise InvalidArgument(f"{arguments} not allowed here: the connection is already open; {instead}")
        async with _attached(address, system_id, timeout, rates) as vehicle:
            yield vehicle
        return
    hub = _create_hub(share, dialect)
    async with (
        open_connection(
            address,
            source_system=source_system,
            source_component=source_component,
            baud=baud,
            dialect=dialect,
            mavlink_version=mavlink_version,
            signing=signing,
            record=record,
            reconnect=reconnect,
            peers=peers,
            may_move=may_move,
            heartbeat=heartbeat,
        ) as connection,
        _shared(connection, hub),
        _attached(connection, system_id, timeout, rates) as vehicle,
    ):
        yield vehicle


def _create_hub(share: Iterable[str | Endpoint | Link], dialect: Dialect) -> Hub | None:
    """Create the hub without opening its links. Return None if ``share`` is empty."""
    endpoints = tuple(share)
    if not endpoints:
        return None
    from aerokit.hub.hub import Hub  # Imported here because few programs share a link.

    return Hub(endpoints, dialect=dialect)


@asynccontextmanager
async def _shared(connection: Connection, hub: Hub | None) -> AsyncIterator[None]:
    if hub is None:
        yield
        return
    async with hub:
        await hub.share(connection)
        yield


def _check_arguments(
    system_id: int | None, timeout: float, rates: Mapping[type[Message], float] | None, dialect: Dialect
) -> None:
    if system_id is not None and not 1 <= system_id <= 255:
        raise InvalidArgument(
            f"system_id = {system_id} is not allowed: it must be 1 to 255, or None for the first vehicle found"
        )
    if not timeout > 0:
        raise InvalidArgument(f"timeout = {timeout} is not allowed: it must be above 0")
    _check_rates(rates, dialect)


def _check_rates(rates: Mapping[type[Message], float] | None, dialect: Dialect) -> None:
    for message_type, hz in (rates or {}).items():
        check_rate(message_type, hz)
        if dialect.get(message_type.ID) is not message_type:
            raise InvalidArgument(f"rates: {message_type.NAME} is not in the dialect {dialect.name!r}")


@asynccontextmanager
async def _attached(
    connection: Connection,
    system_id: int | None,
    timeout: float,
    rates: Mapping[type[Message], float] | None,
) -> AsyncIterator[Vehicle]:
    """Context manager: find a vehicle on an open connection, and release it at the end. The connection stays open."""
    context, vehicle, heartbeat = await _find_vehicle(connection, system_id, timeout)
    was_left_by_exception = False
    try:
        context.session.start(heartbeat, rates)
        yield vehicle
    except BaseException:
        was_left_by_exception = True
        raise
    finally:
        was_flight_abandoned = True  # The value if `finish` is cancelled.
        try:
            was_flight_abandoned = await context.finish()
        finally:
            if was_left_by_exception or was_flight_abandoned:
                warn_if_left_flying(vehicle)
            context.session.close()
            connection.attached.discard(vehicle.system_id)
            await context.session.background.aclose()


def warn_if_left_flying(vehicle: Vehicle) -> None:
    if vehicle._arbiter.may_be_executing and not vehicle.is_confirmed_disarmed:
        logger.warning("the async with block of vehicle %d was left: %s", vehicle.system_id, vehicle.describe_now())


async def _find_vehicle(connection: Connection, system_id: int | None, timeout: float) -> _Found:
    connection.raise_if_ended()
    search = _Search(connection, system_id)
    # A recent heartbeat may have arrived before this call.
    for heartbeat in connection.heartbeats.values():
        frame = heartbeat.received_frame
        if frame is not None and connection.now() - frame.received_at <= HEARTBEAT_MAX_AGE_S:
            search.on_heartbeat(heartbeat)
    detach_callbacks = [
        connection.bus.attach(Heartbeat, search.on_heartbeat, system_id=system_id or EVERY_SYSTEM),
        connection.on_end(search.abort),
    ]
    try:
        with anyio.move_on_after(timeout):
            return await search.result()
    finally:
        for detach in detach_callbacks:
            detach()
        search.close()
    # The time-out has expired.
    raise ConnectFailed(
        f"no heartbeat of {search.description} arrived within {timeout:g} s on {connection.link.address}:"
        f" {explain_no_vehicle(connection, system_id)}"
    )


_Found = tuple[VehicleContext, Vehicle, Heartbeat]


class _Search:
    """Creates the vehicle in the callback for its first heartbeat, so that the vehicle misses no later message.

    A task that waits for the heartbeat would create the vehicle too late: a recording replayed at full speed delivers
    many messages in one iteration of the loop.
    """

    def __init__(self, connection: Connection, system_id: int | None) -> None:
        self._connection, self._system_id = connection, system_id
        # The result: a vehicle that the caller has not received yet, or the error that ended the search.
        self._found: _Found | None = None
        self._error: Exception | None = None
        self._ended = asyncio.Event()
        # Number of heartbeats of each autopilot other than component 1, by system id and component id.
        self._heartbeat_counts: dict[tuple[int, int], int] = {}
        self.description = "an autopilot" if system_id is None else f"the autopilot of system {system_id}"

    def on_heartbeat(self, heartbeat: Heartbeat) -> None:
        frame = heartbeat.received_frame
        if frame is None or self._ended.is_set() or not self._is_wanted(frame, heartbeat):
            return
        # Component 1 takes precedence, so an autopilot with another id must first send several heartbeats.
        if frame.component_id != MavComponent.AUTOPILOT1 and not self._has_sent_enough(frame):
            return
        try:
            if frame.system_id in self._connection.attached:
                raise BusyError(f"system {frame.system_id} already has a vehicle object on this connection")
            context = VehicleContext(VehicleSession(self._connection, frame.system_id, frame.component_id, heartbeat))
            self._found = (context, Vehicle(context), heartbeat)
            self._connection.attached.add(frame.system_id)
        except Exception as error:
            self._error = error
        self._ended.set()

    def _has_sent_enough(self, frame: Frame) -> bool:
        """Count the heartbeat. Return True if its sender has sent at least ``MIN_LONE_HEARTBEATS``."""
        source = (frame.system_id, frame.component_id)
        counts = self._heartbeat_counts
        if source not in counts and len(counts) >= MAX_ROUTES:  # A faulty sender may use many ids.
            return False
        counts[source] = counts.get(source, 0) + 1
        return counts[source] >= MIN_LONE_HEARTBEATS

    def abort(self, error: Exception) -> None:
        if not self._ended.is_set():
            self._error = copy_exception(error)
            self._ended.set()

    async def result(self) -> _Found:
        await self._ended.wait()
        if self._found is None:
            assert self._error is not None
            raise self._error
        result, self._found = self._found, None  # The caller closes the vehicle from now on.
        return result

    def close(self) -> None:
        self._ended.set()
        if self._found is not None:  # `result` has not returned this vehicle to the caller.
            context, vehicle, _ = self._found
            context.session.close()
            self._connection.attached.discard(vehicle.system_id)

    def _is_wanted(self, frame: Frame, heartbeat: Heartbeat) -> bool:
        return frame.system_id != 0 and self._system_id in (None, frame.system_id) and is_autopilot(heartbeat)


@async_block
async def vehicles_on(
    connection: Connection,
    *,
    rates: Mapping[type[Message], float] | None = None,
    on_found: Callable[[Vehicle], object] | None = None,
) -> AsyncIterator[Mapping[int, Vehicle]]:
    """Connect to every vehicle found on a connection, for the duration of the ``async with`` block.

    A vehicle that falls silent stays in the mapping; its ``link_state`` and the ages of its cells show the silence.
    Vehicles to which this program is already connected are not in the mapping.

    Args:
        connection: the result of :func:`aerokit.open_connection`.
        rates: rates to request from each vehicle, as a mapping of message class to Hz; see :func:`aerokit.connect`.
            ``{}`` requests nothing.
        on_found: called in the event loop with each new vehicle. Its exceptions are logged.

    Returns:
        Mapping of system id to vehicle, in the order in which they were found; grows while the block lasts.

    Raises:
        InvalidArgument: a rate is invalid. Nothing was sent.
        ConnectionClosed, LinkLost: the connection has ended.
    """
    connection.raise_if_ended()
    _check_rates(rates, connection.bus.dialect)
    vehicles: dict[int, Vehicle] = {}
    tasks = BackgroundTasks(connection.fail)

    async def stay_connected(system_id: int) -> None:
        try:
            async with connect(connection, system_id=system_id, rates=rates) as vehicle:
                vehicles[system_id] = vehicle
                try:
                    if on_found is not None:
                        on_found(vehicle)
                except Exception:  # An error in the program's callback does not disconnect the vehicle.
                    logger.exception("on_found failed for vehicle %d", system_id)
                await asyncio.Event().wait()  # This event is never set: `vehicles_on` cancels the task at its end.
        except AerokitError as error:
            # No other heartbeat came in time, the program is connected already, or the connection has ended.
            logger.info("the connection to system %d failed or ended: %s", system_id, error)

    async def search() -> None:
        try:
            async for event in connection.vehicles():
                if event.system_id not in vehicles:
                    tasks.start(partial(stay_connected, event.system_id))
        except AerokitError as error:
            logger.info("the search for vehicles has ended: %s", error)

    tasks.start(search)
    try:
        yield vehicles
    finally:
        await tasks.aclose()
