"""``open_connection``: from an address to a connection, for the time of an ``async with`` block."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit._internal.wording import shown
from aerokit.connection.components import is_autopilot
from aerokit.connection.connection import Connection
from aerokit.connection.own_heartbeat import OwnHeartbeat
from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavComponent, MavType
from aerokit.transport import ReconnectingLink, create_link
from aerokit.transport.link import Link

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncIterator, Callable, Sequence

    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.signing import Signing
    from aerokit.transport import LinkAddress
    from aerokit.transport.sockets import Peers

CLOSE_TIMEOUT_S = 2.0

ONLOOKER = 254
"""Who comes and goes while a vehicle flies: ArduPilot (FS_GCS_ENABLE) misses the ground station 255, its MAV_GCS_SYSID,
five seconds after it has gone."""


@checked
@async_block
async def open_connection(
    address: str | Link | Sequence[str | Link],
    *,
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
) -> AsyncIterator[Connection]:
    """Open a link and be a MAVLink node on it for the time of the ``async with`` block.

    Runs in the asyncio loop that is already running; nothing outlives the block, and what the block raises comes out
    of it as it is. Our HEARTBEAT goes out at 1 Hz from the start (https://mavlink.io/en/services/heartbeat.html).

    Args:
        address: a connection string (``"udpin:0.0.0.0:14550"``, ``"/dev/ttyACM0,57600"``, …) or a link not yet open; or
            several of them, none twice, that lead to the same vehicles (docs/how-to/several-links.md): each frame is
            taken once, orders go over the best link, and over the next one when it falls silent. ``?costly=1`` behind
            an address marks one that is used when the others fail. A link that is lost is opened again, as long as
            another one is there.
        source_system: our own system id, 1–255; ground stations take 255.
        source_component: our own component id, 1–255. 0, which is nobody's, is allowed for programs that always were
            that (DroneKit).
        baud: of a serial link whose address names none, bits per second, above 0.
        dialect: the messages that are understood.
        mavlink_version: of what we send, 1 or 2; both are understood.
        signing: signs everything we send; what is not signed with its key is refused (docs/signing.md). None: what we
            send is not signed, and signatures are not checked.
        record: a ``.tlog`` file for everything received and sent, messages of unknown dialects too; an existing file
            is replaced when the first frame is received. A disk that is full ends the recording, not the connection.
        reconnect: whether a link that is lost, a device unplugged for example, is opened again until it is back,
            instead of ending the connection: ``LinkInterrupted``, ``LinkRestored``. Not for the first opening, and not
            at the end of a recording. Of several links: whether the connection outlives that all are away.
        peers: the IP addresses and networks that are listened to: ``"10.0.0.7"``, ``["10.0.0.0/24", "fd00::/8"]``, or
            those of :mod:`ipaddress`. For links to which anybody can send: udpin, udpbcast, tcpin. None: all.
        may_move: whether a vehicle that was silent may come back from another IP address without going on where it
            stopped, by sequence numbers and time since boot: rebooted, with a new address. Else it is not listened to
            there (``MoveRefused``), for it might be anybody.
        heartbeat: what our own HEARTBEAT says, and on what condition it is sent; None: none is, and the vehicle
            knows of no ground station: PX4 sends no texts then, and a ``udpout:`` link stays silent.

    Raises:
        InvalidArgument: an argument is wrong; nothing was opened.
        LinkOpenError: the link or the file for the recording could not be opened.
        ConnectionClosed, BusyError: the link given was used before.
    """
    if not baud > 0:
        raise InvalidArgument(f"baud = {baud} is not allowed: above 0")
    link = _link(address, baud, reconnect, peers)
    connection = Connection(
        link,
        source_system=source_system,
        source_component=source_component,
        dialect=dialect,
        mavlink_version=mavlink_version,
        signing=signing,
        may_move=may_move,
        heartbeat=heartbeat,
    )
    try:
        if record is not None:
            connection.record(record)
        await connection._open_link()
        connection._start()
        yield connection
    finally:
        connection.close()
        try:
            await connection._background.aclose()
        finally:
            with anyio.CancelScope(shield=True), anyio.move_on_after(CLOSE_TIMEOUT_S):
                await connection._wait_until_link_is_closed()


def _link(
    address: str | Link | Sequence[str | Link], baud: int, reconnect: bool, peers: Peers | None
) -> Link:
    if isinstance(address, str):
        make_link = partial(create_link, address, baud=baud, peers=peers)
        return ReconnectingLink(make_link) if reconnect else make_link()
    if not isinstance(address, Link):
        return _several(address, baud, reconnect, peers)
    if reconnect:
        raise InvalidArgument(
            "reconnect = True is not allowed with a link, which can be opened once only: pass an address,"
            " or a ReconnectingLink of aerokit.transport"
        )
    if peers is not None:
        raise InvalidArgument(
            "peers = … is not allowed with a link: pass an address, or give them to the link (UdpListen, TcpListen)"
        )
    return address


def _several(addresses: Sequence[str | Link], baud: int, reconnect: bool, peers: Peers | None) -> Link:
    if not isinstance(addresses, (list, tuple)) or not all(
        isinstance(each, (str, Link)) for each in addresses
    ):
        raise InvalidArgument(
            f"address = {shown(addresses)} is not allowed: an address, a link, or a list of these"
        )
    if len(addresses) < 2:
        if not addresses:
            raise InvalidArgument("address = [] is not allowed: at least one")
        return _link(addresses[0], baud, reconnect, peers)
    from aerokit.transport import SeveralLinks, parse_address  # few programs have several

    _refuse_twice(addresses, [each if isinstance(each, Link) else parse_address(each) for each in addresses])
    makers: list[Callable[[], Link]] = []
    costly: set[int] = set()
    for index, address in enumerate(addresses):
        if isinstance(address, Link):
            makers.append(partial(_itself, address))
            continue
        where = parse_address(address)
        if where.option("costly") == "1":
            costly.add(index)
        if where.kind == "replay":
            raise InvalidArgument(
                f"{address} is not allowed among several links: a recording is no link to a vehicle"
            )
        listened_to = peers if where.kind in ("udpin", "udpbcast", "tcpin") else None
        makers.append(partial(ReconnectingLink, partial(create_link, where, baud=baud, peers=listened_to)))
    return SeveralLinks(makers, costly=costly, stays=reconnect)


def _refuse_twice(addresses: Sequence[str | Link], places: Sequence[Link | LinkAddress]) -> None:
    """The same socket or port cannot be opened twice; that it cannot would be told as a link that is away."""
    seen: set[object] = set()
    for address, place in zip(addresses, places):  # noqa: B905 - as many
        which = _which(place)
        if which in seen:
            raise InvalidArgument(
                f"address = {shown(addresses)} is not allowed: {shown(address)} is named twice; each link once"
            )
        if which is not None:
            seen.add(which)


def _which(place: Link | LinkAddress) -> object:
    """What is opened there, whatever its options; None: another one each time."""
    if isinstance(place, Link):
        return id(place)
    is_new = (place.kind in ("udpin", "tcpin") and not place.port) or (place.kind == "pty" and not place.path)
    if is_new:
        return None
    ways = [each for each in place.options if each[0] in ("connect", "listen")]  # two ways to one name
    return place.kind, place.host, place.port, place.device, place.path, tuple(ways)


def _itself(link: Link) -> Link:
    return link


NOISE_BYTES = 500
"""In so many bytes of noise there is about a tenth of a place that looks like a damaged frame."""

SOME = 5


def no_vehicle_reason(connection: Connection, wanted_system: int | None) -> str:
    """Say what was heard on a link on which no vehicle was found."""
    return _Diagnosis(connection, wanted_system).text()


class _Diagnosis:
    """Looks at the counters of a connection from the least that can be heard to the most."""

    def __init__(self, connection: Connection, wanted_system: int | None) -> None:
        self._wanted = wanted_system
        self._heard = connection.heard
        self._signatures = connection.describe_signatures()
        statistics = list(connection.statistics())
        self._bytes = sum(each.bytes for each in statistics)
        self._frames = sum(each.frames for each in statistics)
        self._bad_crcs = sum(each.bad_crcs for each in statistics)
        self._bad_bytes = sum(each.bad_bytes for each in statistics)
        self._unknown = sum(each.unknown_ids for each in statistics)
        self._unknown_messages = {number for each in statistics for number in each.unknown_messages}
        self._systems = {system for each in statistics for system, _ in each.sources}

    def text(self) -> str:
        if not self._bytes:
            return "not a single byte was heard: is the vehicle on, and is it sending to this address?"
        if not self._frames:
            return self._without_frames()
        if not self._heard:
            return self._without_heartbeats()
        return self._without_vehicle()

    def _without_frames(self) -> str:
        """Noise has a few places that look like frames: what is said rests on most of the bytes."""
        heard = f"{self._bytes} bytes were heard"
        if self._unknown and 2 * self._bad_bytes < self._bytes:
            numbers = ", ".join(map(str, sorted(self._unknown_messages)[:SOME]))
            return (
                f"{heard} with {self._unknown} frames of an unknown dialect (messages {numbers}) and none of this one:"
                " pass dialect=Dialect.from_xml(...)"
            )
        if self._bad_crcs * NOISE_BYTES > self._bytes:
            return f"{heard} with {self._bad_crcs} damaged frames and no good one: a noisy link, or another dialect?"
        return f"{heard}, but no MAVLink frame: wrong baud rate, or another protocol?"

    def _without_heartbeats(self) -> str:
        heard = f"{self._frames} frames were heard"
        if self._signatures:
            return f"{heard}; {self._signatures}"
        if not any(self._systems):
            return f"{heard}, all of system id 0, which is nobody's: give the vehicle an id of 1 to 255"
        return f"{heard}, but no HEARTBEAT among them"

    def _without_vehicle(self) -> str:
        autopilots = sorted({system for (system, _), beat in self._heard.items() if is_autopilot(beat)})
        if autopilots:
            names = ", ".join(map(str, autopilots))
            return f"vehicles with other system ids were heard: {names} (wanted: {self._wanted})"
        names = ", ".join(f"{system}/{component}" for system, component in sorted(self._heard))
        if all(beat.type == MavType.GCS for beat in self._heard.values()):
            return f"only ground stations were heard ({names})"
        return f"only components that are no autopilot were heard ({names})"
