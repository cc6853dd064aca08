"""``open_connection``: open a connection for an ``async with`` block, and explain why no vehicle was found."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit._internal.formatting import short_repr
from aerokit.connection.connection import Connection
from aerokit.connection.heartbeats import OwnHeartbeat, is_autopilot
from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavComponent, MavType
from aerokit.transport import ReconnectingLink, create_link
from aerokit.transport.create import FILTERING_KINDS
from aerokit.transport.link import Link

if TYPE_CHECKING:
    import os
    from collections.abc import AsyncIterator, Callable, Sequence

    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.signing import Signing
    from aerokit.transport import LinkAddress
    from aerokit.transport.sockets import PeerFilter

CLOSE_TIMEOUT_S = 2.0

OBSERVER_SYSTEM_ID = 254
"""System id for tools that connect briefly while a vehicle flies.

It is not 255, the default of ArduPilot's MAV_GCS_SYSID, because a failsafe (FS_GCS_ENABLE) acts five seconds after a
ground station with that id has gone.
"""


DEFAULT_BAUD = 57600
"""Default of the argument ``baud``. Any other value was given by the caller."""

PEERS_WITH_LINK_OBJECT = (
    "peers = … is not allowed with a link object: pass an address, or pass them to UdpListen or TcpListen"
)


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
    peers: PeerFilter | None = None,
    may_move: bool = False,
    heartbeat: OwnHeartbeat | None = OwnHeartbeat(),  # noqa: B008 - it is immutable
) -> AsyncIterator[Connection]:
    """Open a connection for an ``async with`` block: this program becomes a MAVLink node on the link.

    Runs in the current asyncio loop. Everything ends with the block, and exceptions of the block pass unchanged. Our
    HEARTBEAT is sent at 1 Hz from the start (https://mavlink.io/en/services/heartbeat.html).

    Args:
        address: a connection string (``"udpin:0.0.0.0:14550"``, ``"/dev/ttyACM0,57600"``, …) or an unopened link; or a
            list of links to the same vehicles (docs/how-to/several-links.md). With a list, each frame is processed
            once, and commands use the best link that works. ``?costly=1`` in an address marks a link that is used only
            when the others fail. A lost link is reopened while another link works.
        source_system: own system id, 1–255; ground stations use 255.
        source_component: own component id, 1–255. 0 is allowed for programs that have always used it (DroneKit).
        baud: bits per second of a serial link whose address does not give them, above 0. Not allowed if only
            link objects are given.
        dialect: the messages that are decoded.
        mavlink_version: version of sent messages, 1 or 2; both are received.
        signing: key that signs sent frames; received frames without its signature are refused (docs/signing.md). None:
            frames are neither signed nor verified.
        record: ``.tlog`` file for all sent and received frames, unknown messages included. When the first frame is
            received, an existing file is renamed to the next free number (``flight.1.tlog``), which logger "aerokit"
            reports. A full disk ends the recording, not the connection.
        reconnect: True to reopen a lost link (e.g. an unplugged device) until it is back, instead of ending the
            connection; see ``LinkInterrupted`` and ``LinkRestored``. Does not apply to the first opening, or to the end
            of a replay. With several links: True to keep the connection while all of them are lost.
        peers: IP addresses and networks to accept, e.g. ``"10.0.0.7"``, ``["10.0.0.0/24", "fd00::/8"]``, or objects of
            :mod:`ipaddress`. For udpin, udpbcast and tcpin links. None: all.
        may_move: True to accept a silent vehicle from another IP address even if its sequence numbers and time since
            boot do not continue, e.g. after a reboot with a new address. Otherwise it is refused (see
            ``RouteChangeRefused``), because it may be a different sender.
        heartbeat: content of our HEARTBEAT and when it pauses. None sends none: PX4 then sends no STATUSTEXT, and a
            ``udpout:`` link stays silent.

    Raises:
        InvalidArgument: an argument is wrong; nothing was opened.
        LinkOpenError: the link or the recording could not be opened.
        ConnectionClosed, BusyError: the given link was used before.
    """
    if not baud > 0:
        raise InvalidArgument(f"baud = {baud} is not allowed: it must be above 0")
    link = _create_link(address, baud, reconnect, peers)
    _import_messages()
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


def _import_messages() -> None:
    # Messages that vehicles send are imported before the link opens. An import at the first frames would block the
    # event loop: 20 ms of CPU time, 200 ms without cached bytecode.
    for name in ("ardupilotmega", "common_more"):
        import_module(f"aerokit.mavlink.messages.{name}")


def _create_link(
    address: str | Link | Sequence[str | Link], baud: int, reconnect: bool, peers: PeerFilter | None
) -> Link:
    if isinstance(address, str):
        make_link = partial(create_link, address, baud=baud, peers=peers)
        return ReconnectingLink(make_link) if reconnect else make_link()
    if not isinstance(address, Link):
        return _create_multilink(address, baud, reconnect, peers)
    if reconnect:
        raise InvalidArgument(
            "reconnect = True is not allowed with a link object, which can be opened only once: pass an address,"
            " or an aerokit.transport.ReconnectingLink"
        )
    if peers is not None:
        raise InvalidArgument(PEERS_WITH_LINK_OBJECT)
    _check_that_baud_applies(baud)
    return address


def _check_that_baud_applies(baud: int) -> None:
    """Raise InvalidArgument if the caller gave a baud rate, because only link objects were given with it."""
    if baud != DEFAULT_BAUD:
        raise InvalidArgument(
            f"baud = {baud} is not allowed with a link object: pass an address, or pass baud to SerialLink"
        )


def _create_multilink(addresses: Sequence[str | Link], baud: int, reconnect: bool, peers: PeerFilter | None) -> Link:
    if not isinstance(addresses, (list, tuple)) or not all(isinstance(address, (str, Link)) for address in addresses):
        raise InvalidArgument(
            f"address = {short_repr(addresses)} is not allowed: it must be an address, a link, or a list of them"
        )
    if len(addresses) < 2:
        if not addresses:
            raise InvalidArgument("address = [] is not allowed: the list must have at least one address or link")
        return _create_link(addresses[0], baud, reconnect, peers)
    from aerokit.transport import MultiLink, parse_address  # imported here because few programs have several links

    targets = [address if isinstance(address, Link) else parse_address(address) for address in addresses]
    _check_distinct(addresses, targets)
    if peers is not None:
        _check_that_peers_apply(targets)
    if all(isinstance(target, Link) for target in targets):
        _check_that_baud_applies(baud)
    factories = list(map(partial(_link_factory, baud=baud, peers=peers), addresses, targets))
    costly = {
        index for index, target in enumerate(targets) if not isinstance(target, Link) and target.option("costly") == "1"
    }
    return MultiLink(factories, costly=costly, survives_loss=reconnect)


def _link_factory(
    address: str | Link, target: Link | LinkAddress, *, baud: int, peers: PeerFilter | None
) -> Callable[[], Link]:
    """Return a function that creates one of several links. ``target`` is the parsed ``address``."""
    if isinstance(target, Link):
        return lambda: target
    if target.kind == "replay":
        raise InvalidArgument(
            f"{address} is not allowed among several links: they must all lead to vehicles, and it is a recording"
        )
    # Only listening links get the filter, because other kinds of links refuse the argument.
    peer_filter = peers if target.kind in FILTERING_KINDS else None
    # A lost link is reopened while another one works, even without ``reconnect``.
    return partial(ReconnectingLink, partial(create_link, target, baud=baud, peers=peer_filter))


def _check_that_peers_apply(targets: Sequence[Link | LinkAddress]) -> None:
    if any(isinstance(target, Link) for target in targets):
        raise InvalidArgument(PEERS_WITH_LINK_OBJECT)
    if not any(getattr(target, "kind", None) in FILTERING_KINDS for target in targets):
        raise InvalidArgument("peers = … is not allowed: none of the addresses is udpin, udpbcast or tcpin")


def _check_distinct(addresses: Sequence[str | Link], targets: Sequence[Link | LinkAddress]) -> None:
    seen: set[object] = set()
    for address, target in zip(addresses, targets):  # noqa: B905 - equal lengths
        key = _target_key(target)
        if key in seen:  # The second link would fail to open, and the error would look like a broken link.
            raise InvalidArgument(
                f"address = {short_repr(addresses)} is not allowed: {short_repr(address)} is listed twice"
            )
        if key is not None:
            seen.add(key)


def _target_key(target: Link | LinkAddress) -> object:
    """Return a key that is equal for links to the same target. None if the system chooses a new port or pty."""
    if isinstance(target, Link):
        return id(target)
    gets_new_endpoint = (target.kind in ("udpin", "tcpin") and not target.port) or (
        target.kind == "pty" and not target.path
    )
    if gets_new_endpoint:
        return None
    # On zenoh, the same name on a network with other endpoints is another vehicle.
    endpoints = [(name, value) for name, value in target.options if name in ("connect", "listen")]
    return target.kind, target.host, target.port, target.device, target.path, tuple(endpoints)


# With a probability of about 10 %, a pattern in this many bytes of noise looks like a damaged frame. Damaged frames are
# therefore only diagnosed if there is more than one in this many bytes.
NOISE_BYTES_PER_BAD_CRC = 500

MAX_LISTED_IDS = 5


def explain_no_vehicle(connection: Connection, wanted_system: int | None) -> str:
    return _Diagnosis(connection, wanted_system).text()


class _Diagnosis:
    """Counts of everything received so far, summed over all peers."""

    def __init__(self, connection: Connection, wanted_system: int | None) -> None:
        self._wanted_system = wanted_system
        self._heartbeats = connection.heartbeats
        self._signature_problems = connection.describe_signature_problems()
        statistics = list(connection.statistics())
        self._bytes = sum(counters.bytes for counters in statistics)
        self._frames = sum(counters.frames for counters in statistics)
        self._bad_crcs = sum(counters.bad_crcs for counters in statistics)
        self._bad_bytes = sum(counters.bad_bytes for counters in statistics)
        self._unknown_frames = sum(counters.unknown_ids for counters in statistics)
        self._unknown_messages = {message_id for counters in statistics for message_id in counters.unknown_messages}
        self._systems = {system for counters in statistics for system, _ in counters.sources}

    def text(self) -> str:
        if not self._bytes:
            return "no bytes were received: is the vehicle on, and is it sending to this address?"
        if not self._frames:
            return self._without_frames()
        if not self._heartbeats:
            return self._without_heartbeats()
        return self._without_vehicle()

    def _without_frames(self) -> str:
        # Noise contains a few patterns that look like frames of an unknown dialect. An unknown dialect is therefore
        # only diagnosed if most bytes belong to frames.
        received = f"{self._bytes} bytes were received"
        is_mostly_framed = 2 * self._bad_bytes < self._bytes
        if self._unknown_frames and is_mostly_framed:
            numbers = ", ".join(map(str, sorted(self._unknown_messages)[:MAX_LISTED_IDS]))
            if len(self._unknown_messages) > MAX_LISTED_IDS:
                numbers += ", …"
            return (
                f"{received}, with {self._unknown_frames} frames of an unknown dialect (messages {numbers}) and no"
                " known message: pass dialect=Dialect.from_xml(...)"
            )
        if self._bad_crcs * NOISE_BYTES_PER_BAD_CRC > self._bytes:
            return f"{received}, with {self._bad_crcs} damaged frames and no valid one: noisy link, or another dialect?"
        return f"{received}, but no MAVLink frame: wrong baud rate, or another protocol?"

    def _without_heartbeats(self) -> str:
        received = f"{self._frames} frames were received"
        if self._signature_problems:
            return f"{received}; {self._signature_problems}"
        if not any(self._systems):
            return f"{received}, all with the invalid system id 0: set the vehicle's system id to 1–255"
        return f"{received}, but no HEARTBEAT among them"

    def _without_vehicle(self) -> str:
        autopilots = sorted({system for (system, _), heartbeat in self._heartbeats.items() if is_autopilot(heartbeat)})
        if autopilots:
            names = ", ".join(map(str, autopilots))
            return f"only vehicles with other system ids were received: {names} (wanted: {self._wanted_system})"
        names = ", ".join(f"{system}/{component}" for system, component in sorted(self._heartbeats))
        if all(heartbeat.type == MavType.GCS for heartbeat in self._heartbeats.values()):
            return f"only ground stations were received ({names})"
        return f"only components that are not autopilots were received ({names})"
