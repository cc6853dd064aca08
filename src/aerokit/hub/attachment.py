"""``Attachment``: an endpoint of a hub and its link: what the link calls, and the ports that come of it."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING

from aerokit.connection.frame_receiver import MOST_PEERS, Peers
from aerokit.hub.guards import Border, IdentityGuard
from aerokit.hub.outgoing import Filters, Kind
from aerokit.hub.port import NEVER, Port, Totals
from aerokit.hub.values import EndpointStatistics
from aerokit.transport import ReconnectingLink, create_link

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.errors import LinkLost
    from aerokit.hub.outgoing import Held
    from aerokit.hub.switch import Switch
    from aerokit.hub.values import Endpoint, HubEventKind
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.framer import Framer
    from aerokit.transport.link import Link, Peer

    Tell = Callable[["Attachment", HubEventKind, str], object]

HOLD_ABOVE = {"serial": 2048, "pty": 2048}
"""Bytes that may be on their way out of this machine while more is written: a third of a second of a slow radio."""
HOLD_ABOVE_OTHERS = 16 * 1024
NEVER_WAIT = ("udpin", "udpout", "udpbcast")
"""Made of an address, these send or drop at once: there is no need to ask what has not left."""


class Attachment:
    """One endpoint with its link. Nothing that the link does reaches the others but by frames.

    ``now`` is the loop's clock, ``tell(attachment, kind, text)`` tells an event.
    """

    filters: Filters
    is_open: bool
    totals: Totals

    def __init__(
        self, endpoint: Endpoint, switch: Switch, dialect: Dialect, now: Callable[[], float], tell: Tell
    ) -> None:
        self.endpoint = endpoint
        self.filters = check_filters(endpoint, dialect)
        self._switch, self._dialect, self._now, self._tell = switch, dialect, now, tell
        address = endpoint.address
        if isinstance(address, str):
            make_link = partial(create_link, address, baud=endpoint.baud, peers=endpoint.peers)
            self.link: Link = ReconnectingLink(make_link)
        else:
            self.link = address
        self.name: str = endpoint.name or self.link.address
        self.keeps_peers = True
        self.is_open = False
        self._is_on_link = self._is_single = False
        self._ports: dict[Peer, Port] = {}
        self._guard = IdentityGuard(self.link, self._tell_of_peer)
        self._peers = Peers(
            self.link, dialect, self._guard.least_wanted, _keep_unknown, forgotten=self._forget_port
        )
        self._is_crowded = False
        self.totals = Totals(Counter())
        self._gone = [0, 0, 0, 0]  # frames, bytes, lost frames, bad bytes of peers that are forgotten
        self._told_refusals: set[str] = set()
        self._border: Border | None = None
        if endpoint.signing is not None:
            self._border = Border(endpoint.signing, dialect.extras, self._refused)

    async def open(self) -> None:
        """Open the link. LinkOpenError, BusyError, ConnectionClosed as the link raises them."""
        await self.link.open(self)
        self._is_on_link = True
        self._come_up()
        self._tell(self, "opened", f"{self.link.address} is open")

    def close(self) -> None:
        """Close the link, and forget who was there."""
        self._go_down()
        if self._is_on_link:
            self.link.close()

    async def wait_closed(self) -> None:
        """See `Link.wait_closed`."""
        if self._is_on_link:
            await self.link.wait_closed()

    def statistics(self) -> EndpointStatistics:
        """What has come and gone until now."""
        router, ports = self._switch.router, tuple(self._ports.values())
        sums = list(self._gone)
        for framer in self._peers:
            sums = [before + more for before, more in zip(sums, _counted(framer), strict=True)]
        heard = {source for port in ports if port.node is not None for source in router.heard_at(port.node)}
        dropped = {reason: count for reason, count in self.totals.dropped.items() if count}
        if self.link.dropped_writes:
            dropped["link"] = self.link.dropped_writes
        return EndpointStatistics(
            name=self.name,
            address=self.link.address,
            is_open=self.is_open,
            peers=len(ports),
            frames_in=sums[0],
            bytes_in=sums[1],
            frames_out=self.totals.frames_out,
            bytes_out=self.totals.bytes_out,
            lost=sums[2],
            bad_bytes=sums[3],
            waiting=sum(port.waiting for port in ports),
            dropped=dropped,
            systems=tuple(sorted(heard)),
        )

    # -------------------------------------------------------------------- what the link calls

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Take bytes off the link; never raises."""
        try:
            now, place = self._now(), None if self._is_single else peer
            framer = self._peers.framers.get(place)
            if framer is not None:
                frames = framer.receive(data, now)
            else:
                framer, frames = self._peers.receive_from_stranger(place, data, now)
                self._tell_crowded(framer, place)
            if frames:
                port = self._ports.get(place) or self._add_port(place)
                self._switch.take(port, framer, frames, data, now)
                if place != peer:  # of a broadcast: it is answered
                    self.link.keep_peer(peer)
        except Exception as error:
            self._tell(self, "mistake", f"a mistake inside aerokit: {error!r}")

    def burst_ended(self) -> None:
        """What came can be written to the others."""
        self._switch.flush()

    def peer_joined(self, peer: Peer) -> None:
        """A client is there, which may never say anything."""
        if peer not in self._ports:
            self._add_port(peer)
            self._tell(self, "client_joined", f"{_named(peer)} has connected")

    def peer_left(self, peer: Peer) -> None:
        """A client has gone."""
        if peer in self._ports:
            self._forget(peer)
            self._tell(self, "client_left", f"{_named(peer)} has gone")

    def link_interrupted(self, error: LinkLost) -> None:
        """The link has gone, and is being opened again."""
        self._go_down()
        self._tell(self, "lost", f"{error}; it is being opened again")

    def link_restored(self, away_s: float) -> None:
        """It is back."""
        self._come_up()
        self._tell(self, "restored", f"{self.link.address} is back after {away_s:.1f} s")

    def link_stalled(self, unsent_bytes: int) -> None:
        """What is written does not leave."""
        self._tell(self, "stalled", f"{unsent_bytes} bytes wait, and nothing leaves")

    def link_drained(self, stalled_s: float) -> None:
        """It does again."""
        self._tell(self, "drained", f"it goes on after {stalled_s:.1f} s")

    def link_lost(self, error: LinkLost) -> None:
        """The link has gone for good."""
        self._go_down()
        self._tell(self, "lost", f"{error}")

    # ------------------------------------------------------------------------------------ ports

    def _come_up(self) -> None:
        self.is_open = True
        self._is_single = self.link.has_peer(None)
        if self._is_single and None not in self._ports:
            self._add_port(None)

    def _go_down(self) -> None:
        self.is_open = False
        for peer in tuple(self._ports):
            self._forget(peer)

    def _add_port(self, peer: Peer) -> Port:
        port = self._ports[peer] = Port(
            self.link,
            peer,
            self.totals,
            endpoint=self.name,
            dialect=self._dialect,
            hold_above=self._hold_above(),
            period=self.filters.period,
            report=partial(self._tell, self),
            tell=self._dropped,
            border=self._border,
            guard=None if self._is_single else self._guard,
            is_mute=self.endpoint.read_only,
        )
        self._guard.is_shared = len(self._ports) > 1
        self._switch.add(port)
        return port

    def _hold_above(self) -> int:
        kind = self.link.address.partition(":")[0]
        if kind in NEVER_WAIT and isinstance(self.endpoint.address, str):
            return NEVER
        return _hold_above(self.link.address)

    def _forget(self, peer: Peer) -> None:
        self._forget_port(peer)
        self._peers.forget(peer)

    def _forget_port(self, peer: Peer) -> None:
        framer = self._peers.framers.get(peer)
        if framer is not None:
            self._gone = [a + b for a, b in zip(self._gone, _counted(framer), strict=True)]
        self._guard.forget(peer)
        port = self._ports.pop(peer, None)
        self._guard.is_shared = len(self._ports) > 1
        if port is not None:
            self._switch.remove(port)

    # ------------------------------------------------------------------------------- what is told

    def _refused(self, frame: Frame, why: str) -> None:
        self.totals.dropped["refused"] += 1
        if why not in self._told_refusals:
            self._told_refusals.add(why)
            source = f"{frame.system_id}/{frame.component_id}"
            self._tell(
                self, "refused", f"a frame of {source} was refused: {why}; more such frames are only counted"
            )

    def _tell_of_peer(self, kind: HubEventKind, peer: Peer, text: str) -> None:
        self._tell(self, kind, f"{_named(peer)}: {text}")

    def _tell_crowded(self, framer: Framer, peer: Peer) -> None:
        """A newcomer that sent a good frame was turned away, because all places are taken by live peers."""
        is_crowded = framer.statistics.frames > 0 and peer not in self._peers.framers
        if is_crowded and not self._is_crowded:
            self._tell_of_peer(
                "turned_away", peer, f"all {MOST_PEERS} places are taken by peers that are heard"
            )
        self._is_crowded = is_crowded

    def _dropped(self, reason: str, held: Held) -> None:
        if held.kind is not Kind.ORDER:
            return
        known = self._dialect[held.message_id]
        waited = self._now() - held.since
        why = {"late": "it had waited too long", "queue_full": "too much was waiting"}.get(
            reason, "the link went"
        )
        target = f"{held.target[0]}/{held.target[1]}"
        self._tell(
            self, "order_dropped", f"{known.NAME} for {target} was dropped after {waited:.1f} s: {why}"
        )


def _named(peer: Peer) -> str:
    """An IP address and a port as addresses have them, if it is that."""
    host, port = peer[:2] if isinstance(peer, tuple) and len(peer) > 1 else (peer, "")
    return f"client [{host}]:{port}" if ":" in str(host) else f"client {host}:{port}".rstrip(":")


def check_filters(endpoint: Endpoint, dialect: Dialect) -> Filters:
    """What may go out there; InvalidArgument when a name fits no message of the dialect."""
    return Filters(dialect, endpoint.only, endpoint.block, endpoint.rates)


def _hold_above(address: str) -> int:
    """Of a connection that is shared, and of several links, what the slowest of them stands."""
    kinds = (each.split(":")[0] for each in address.removeprefix("shared:").split(" + "))
    return min(HOLD_ABOVE.get(kind, HOLD_ABOVE_OTHERS) for kind in kinds)


def _keep_unknown(framer: Framer) -> None:
    framer.keep_unknown = True


def _counted(framer: Framer) -> tuple[int, int, int, int]:
    counters = framer.statistics
    lost = sum(source.lost for source in counters.sources.values())
    return counters.frames, counters.bytes, lost, counters.bad_bytes
