"""``aerokit.connect``: from an address to a vehicle, for the time of an ``async with`` block."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit.connection.bus import raisable
from aerokit.connection.components import is_autopilot
from aerokit.connection.connection import Connection
from aerokit.connection.opening import no_vehicle_reason, open_connection
from aerokit.connection.own_heartbeat import OwnHeartbeat
from aerokit.connection.routes import MOST_ROUTES
from aerokit.connection.tasks import Background
from aerokit.errors import AerokitError, BusyError, ConnectFailed, InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavComponent
from aerokit.mavlink.messages import Heartbeat
from aerokit.transport.link import Link
from aerokit.vehicle.commanding.context import Bridge
from aerokit.vehicle.session.rates import check_rate
from aerokit.vehicle.session.session import Talk
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
    from aerokit.transport.sockets import Peers

__all__ = ["connect", "tell_how_it_is_left", "vehicles_on"]

logger: logging.Logger = logging.getLogger("aerokit")

FRESH_HEARTBEAT_S = 2.0
"""A heartbeat heard longer ago says nothing about now: the next one is waited for."""

HEARTBEATS_ALONE = 3
"""So many heartbeats of another component and none of component 1 make it the vehicle's autopilot."""


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
    peers: Peers | None = None,
    may_move: bool = False,
    heartbeat: OwnHeartbeat | None = OwnHeartbeat(),  # noqa: B008 - it is immutable
    share: Iterable[str | Endpoint | Link] = (),
) -> AsyncIterator[Vehicle]:
    """Connect to a vehicle for the time of the ``async with`` block.

    Returns at its first heartbeat; ``await vehicle.wait_ready()`` waits until it could fly. Runs inside the asyncio
    loop that is already running: nothing outlives the block, and what the block raises comes out of it as it is.

    Args:
        address: ``"udpin:0.0.0.0:14550"``, ``"tcp:127.0.0.1:5760"``, ``"/dev/ttyACM0,57600"``, a ``.tlog`` file …;
            a link; several of these that lead to the vehicle (docs/how-to/several-links.md); or a connection that is
            open already, for several vehicles on one link: what follows ``rates`` here is then said where it is opened.
        system_id: the vehicle's MAVLink system id, 1–255; None takes the first autopilot that is heard.
        timeout: seconds to wait for its first heartbeat, above 0.
        rates: message class → Hz (above 0, at most 1000), asked for instead of the default rates; ``{}`` asks for
            nothing.
        source_system: our own system id.
        source_component: our own component id, 0–255; 0, which is nobody's, for programs that always were that.
        baud: of a serial link whose address names none.
        dialect: the messages that are understood.
        mavlink_version: of what we send, 1 or 2.
        signing: signs everything we send; what is not signed with its key is refused (docs/signing.md). None: neither.
        record: a ``.tlog`` file for everything received and sent; an existing file is replaced.
        reconnect: whether a link that is lost is opened again until it is back, instead of ending the connection.
        peers: the IP addresses and networks that are listened to: ``"10.0.0.7"``, ``["10.0.0.0/24"]``. For links to
            which anybody can send: udpin, udpbcast, tcpin. None: all.
        may_move: whether the vehicle, once silent, may come back from another IP address without going on where it
            stopped, by sequence numbers and time since boot (rebooted, with a new address). Else it is not listened to
            there (``MoveRefused``), for it might be anybody.
        heartbeat: what our own HEARTBEAT says, and on what condition it is sent; None: none is, and the vehicle
            knows of no ground station: PX4 sends no texts then, and a ``udpout:`` link stays silent.
        share: where ground stations and other programs are, or come, that use the same link:
            ``["tcpin:127.0.0.1:5760"]`` (docs/hub.md). They should have other ids than this program. For an open
            connection: ``async with aerokit.hub.shared(connection, […])``.

    Raises:
        InvalidArgument: an argument is wrong. Nothing was opened.
        BusyError: this system has a vehicle object on this connection already.
        LinkOpenError: the link, one to share it on, or the file to record to, could not be opened.
        LinkLost, ConnectionClosed: the link went down while waiting, or the connection was closed.
        ConnectFailed: no heartbeat of such a vehicle came in time; the text says what was heard instead.
    """
    _check(system_id, timeout, rates, address.bus.dialect if isinstance(address, Connection) else dialect)
    if isinstance(address, Connection):
        if record is not None:
            raise InvalidArgument("record = … is not allowed here: the connection is open; use its record()")
        if signing is not None:
            raise InvalidArgument(
                "signing = … is not allowed here: the connection is open; set its attribute signing"
            )
        if reconnect:
            raise InvalidArgument(
                "reconnect = True is not allowed here: the connection is open; say it to open_connection"
            )
        if heartbeat != OwnHeartbeat():
            raise InvalidArgument(
                "heartbeat = … is not allowed here: the connection is open; say it to open_connection"
            )
        if peers is not None or may_move:
            raise InvalidArgument(
                "peers and may_move are not allowed here: the connection is open; say it to open_connection"
            )
        if share:
            raise InvalidArgument(
                "share = … is not allowed here: the connection is open; use aerokit.hub.shared(connection, …)"
            )
        async with _attached(address, system_id, timeout, rates) as vehicle:
            yield vehicle
        return
    hub = _hub(share, dialect)
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


def _hub(share: Iterable[str | Endpoint | Link], dialect: Dialect) -> Hub | None:
    """The hub that others use the link by, checked before anything is opened; None: there are no others."""
    endpoints = tuple(share)
    if not endpoints:
        return None
    from aerokit.hub.hub import Hub  # few programs share

    return Hub(endpoints, dialect=dialect)


@asynccontextmanager
async def _shared(connection: Connection, hub: Hub | None) -> AsyncIterator[None]:
    """Let others use the link, too, for the time of the block."""
    if hub is None:
        yield
        return
    async with hub:
        await hub.share(connection)
        yield


def _check(
    system_id: int | None, timeout: float, rates: Mapping[type[Message], float] | None, dialect: Dialect
) -> None:
    if system_id is not None and not 1 <= system_id <= 255:
        raise InvalidArgument(
            f"system_id = {system_id} is not allowed: 1 to 255, or None for the first heard"
        )
    if not timeout > 0:
        raise InvalidArgument(f"timeout = {timeout} is not allowed: above 0")
    for message_type, hz in (rates or {}).items():
        check_rate(message_type, hz)
        if dialect.get(message_type.ID) is not message_type:
            raise InvalidArgument(f"{message_type.NAME} is not in the dialect {dialect.name!r}")


@asynccontextmanager
async def _attached(
    connection: Connection,
    system_id: int | None,
    timeout: float,
    rates: Mapping[type[Message], float] | None,
) -> AsyncIterator[Vehicle]:
    """Find a vehicle on an open connection and keep it for the time of the block."""
    bridge, vehicle, heartbeat = await _find_vehicle(connection, system_id, timeout)
    is_cut_short = False
    try:
        bridge.talk.start(heartbeat, rates)
        yield vehicle
    except BaseException:
        is_cut_short = True
        raise
    finally:
        try:
            is_given_up = await bridge.finish()
            if is_cut_short or is_given_up:
                tell_how_it_is_left(vehicle)
        finally:
            bridge.talk.close()
            connection.attached.discard(vehicle.system_id)
            await bridge.talk.background.aclose()


def tell_how_it_is_left(vehicle: Vehicle) -> None:
    """Log what a vehicle does that a program lets go in flight without having meant to, if it does so by its orders."""
    if vehicle._arbiter.is_obeyed and not vehicle.is_surely_disarmed:
        logger.warning("vehicle %d is let go: %s", vehicle.system_id, vehicle.describe_now())


async def _find_vehicle(connection: Connection, system_id: int | None, timeout: float) -> _Found:
    """The vehicle of the first heartbeat that will do, listening from the instant it came."""
    connection.raise_if_ended()
    search = _Search(connection, system_id)
    for known in connection.heard.values():
        frame = known.received_frame
        if frame is not None and connection.now() - frame.received_at <= FRESH_HEARTBEAT_S:
            search.take(known)
    detachments = [
        connection.bus.attach(Heartbeat, search.take, system_id=system_id or 0),
        connection.on_end(search.abort),
    ]
    try:
        with anyio.move_on_after(timeout):
            return await search.result()
    finally:
        for detach in detachments:
            detach()
        search.forget()
    raise ConnectFailed(
        f"no heartbeat of {search.wanted} within {timeout:g} s on {connection.link.address}:"
        f" {no_vehicle_reason(connection, system_id)}"
    )


_Found = tuple[Bridge, Vehicle, Heartbeat]


class _Search:
    """Makes the vehicle as soon as it is heard, inside the delivery of its heartbeat: what follows is not missed.

    A recording that is replayed as fast as it goes brings many frames in one turn of the loop.
    """

    def __init__(self, connection: Connection, system_id: int | None) -> None:
        self._connection, self._system_id = connection, system_id
        self._found: _Found | None = None
        self._error: Exception | None = None
        self._ended = asyncio.Event()
        self._others: dict[tuple[int, int], int] = {}
        self.wanted = "an autopilot" if system_id is None else f"the autopilot of system {system_id}"

    def take(self, heartbeat: Heartbeat) -> None:
        """One heartbeat off the link."""
        frame = heartbeat.received_frame
        if frame is None or self._ended.is_set() or not self._is_wanted(frame, heartbeat):
            return
        if frame.component_id != MavComponent.AUTOPILOT1 and not self._is_alone(frame):
            return
        try:
            if frame.system_id in self._connection.attached:
                raise BusyError(f"system {frame.system_id} has a vehicle object on this connection already")
            bridge = Bridge(Talk(self._connection, frame.system_id, frame.component_id, heartbeat))
            self._found = (bridge, Vehicle(bridge), heartbeat)
            self._connection.attached.add(frame.system_id)
        except Exception as error:
            self._error = error
        self._ended.set()

    def _is_alone(self, frame: Frame) -> bool:
        """A component that says it is an autopilot gives the system's first autopilot the time to be heard."""
        source = (frame.system_id, frame.component_id)
        if source not in self._others and len(self._others) >= MOST_ROUTES:
            return False
        self._others[source] = self._others.get(source, 0) + 1
        return self._others[source] >= HEARTBEATS_ALONE

    def abort(self, error: Exception) -> None:
        """The connection has ended."""
        if not self._ended.is_set():
            self._error = raisable(error)
            self._ended.set()

    async def result(self) -> _Found:
        """The vehicle, now its finder's to close, and its first heartbeat."""
        await self._ended.wait()
        if self._found is None:
            assert self._error is not None
            raise self._error
        found, self._found = self._found, None
        return found

    def forget(self) -> None:
        """Close the vehicle if nobody took it: the wait was cancelled just then."""
        self._ended.set()
        if self._found is not None:
            talk = self._found[0].talk
            talk.close()
            self._connection.attached.discard(talk.system_id)

    def _is_wanted(self, frame: Frame, heartbeat: Heartbeat) -> bool:
        return frame.system_id != 0 and self._system_id in (None, frame.system_id) and is_autopilot(heartbeat)


@async_block
async def vehicles_on(
    connection: Connection,
    *,
    rates: Mapping[type[Message], float] | None = None,
    on_found: Callable[[Vehicle], object] | None = None,
) -> AsyncIterator[Mapping[int, Vehicle]]:
    """Connect to each vehicle that is heard on a connection, as soon as it is heard, for the time of the block.

    A vehicle that falls silent stays: its cells have ages, and its ``link_state`` says so. One that this program has
    a vehicle object of already is left out.

    Args:
        connection: of :func:`aerokit.open_connection`.
        rates: message class → Hz, asked of each, as by :func:`aerokit.connect`; ``{}`` asks for nothing.
        on_found: called with each new vehicle, in the loop.

    Returns:
        System id → vehicle, in the order in which they were heard; it grows while the block lasts.

    Raises:
        ConnectionClosed, LinkLost: the connection has ended.
    """
    connection.raise_if_ended()
    vehicles: dict[int, Vehicle] = {}

    async def keep(system_id: int) -> None:
        try:
            async with connect(connection, system_id=system_id, rates=rates) as vehicle:
                vehicles[system_id] = vehicle
                if on_found is not None:
                    on_found(vehicle)
                await asyncio.Event().wait()
        except AerokitError as error:  # silent again at once, known already, or the connection has ended
            logger.info("system %d is not followed: %s", system_id, error)

    async def look_out() -> None:
        try:
            async for found in connection.vehicles():
                if found.system_id not in vehicles:
                    tasks.start(partial(keep, found.system_id))
        except AerokitError as error:
            logger.info("no more vehicles are looked for: %s", error)

    tasks = Background(connection.fail)
    tasks.start(look_out)
    try:
        yield vehicles
    finally:
        await tasks.aclose()
