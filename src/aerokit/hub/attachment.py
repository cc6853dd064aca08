"""``Attachment``: an endpoint of a hub and its link: what the link calls, and the ports that come of it."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING

from aerokit.hub.border import Border
from aerokit.hub.filters import Filters
from aerokit.hub.kinds import Kind, kind_of
from aerokit.hub.port import NEVER, Port, Totals
from aerokit.hub.values import EndpointStatistics
from aerokit.links import ReconnectingLink, create_link
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.statistics import SourceLimit

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.errors import LinkLost
    from aerokit.hub.held import Held
    from aerokit.hub.switch import Switch
    from aerokit.hub.values import Endpoint, HubEventKind
    from aerokit.links.link import Link, Peer
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame

    Tell = Callable[["Attachment", HubEventKind, str], object]

__all__ = ["Attachment", "check_filters"]

MOST_PEERS = 256
"""So many of one endpoint are remembered; of datagrams the one not heard for longest is forgotten first."""
MOST_STRANGERS = 32
"""So many that have sent no good frame yet are listened to."""
MOST_SENDERS = 2048
"""So many (system id, component id) of one endpoint are counted apart."""
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
    tells_bursts: bool
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
        self.is_open = self.tells_bursts = False
        self._is_on_link = self._is_single = False
        self._ports: dict[Peer, Port] = {}
        self._strangers: dict[Peer, Framer] = {}
        self._limit = SourceLimit(MOST_SENDERS)
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
        for framer in (*(port.framer for port in ports), *self._strangers.values()):
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
            now = self._now()
            port = self._ports.get(peer)
            if port is not None:
                port.heard_at = now
                self._switch.receive(port, data, now)
            else:
                self._receive_from_stranger(data, peer, now)
        except Exception as error:
            self._tell(self, "mistake", f"a mistake inside aerokit: {error!r}")

    def burst_ended(self) -> None:
        """What came can be written to the others."""
        self._switch.flush()

    def peer_joined(self, peer: Peer) -> None:
        """A client is there, which may never say anything."""
        if peer not in self._ports:
            self._add_port(peer, self._new_framer(), self._now())
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
        self.tells_bursts = self.link.tells_bursts
        if self._is_single and None not in self._ports:
            self._add_port(None, self._new_framer(), self._now())

    def _go_down(self) -> None:
        self.is_open = False
        for peer in tuple(self._ports):
            self._forget(peer)
        self._strangers.clear()

    def _receive_from_stranger(self, data: bytes, peer: Peer, now: float) -> None:
        if peer is None or self._is_single:  # before `open` has returned; or a broadcast is answered
            port = self._ports.get(None) or self._add_port(None, self._new_framer(), now)
            before = port.framer.statistics.frames
            self._switch.receive(port, data, now)
            if peer is not None and port.framer.statistics.frames > before:
                self.link.keep_peer(peer)
            return
        framer = self._strangers.get(peer)
        if framer is None:
            if len(self._strangers) >= MOST_STRANGERS:
                self._strangers.pop(next(iter(self._strangers))).retire()
            framer = self._strangers[peer] = self._new_framer()
        frames = framer.receive(data, now)
        if framer.statistics.frames:
            del self._strangers[peer]
            self.link.keep_peer(peer)
            port = self._add_port(peer, framer, now)
            self._switch.take(port, frames, data, now)

    def _new_framer(self) -> Framer:
        framer = Framer(self._dialect, self._limit)
        framer.keep_unknown = True
        return framer

    def _add_port(self, peer: Peer, framer: Framer, now: float) -> Port:
        if len(self._ports) >= MOST_PEERS:
            self._forget(min(self._ports, key=lambda each: self._ports[each].heard_at))
        port = self._ports[peer] = Port(
            self.link,
            peer,
            framer,
            self.totals,
            dialect=self._dialect,
            hold_above=self._hold_above(),
            tell=self._dropped,
            border=self._border,
            is_mute=self.endpoint.read_only,
        )
        port.owner, port.heard_at = self, now
        self._switch.add(port)
        return port

    def _hold_above(self) -> int:
        kind = self.link.address.partition(":")[0]
        if kind in NEVER_WAIT and isinstance(self.endpoint.address, str):
            return NEVER
        return _hold_above(self.link.address)

    def _forget(self, peer: Peer) -> None:
        port = self._ports.pop(peer, None)
        if port is not None:
            self._switch.remove(port)
            self._gone = [a + b for a, b in zip(self._gone, _counted(port.framer), strict=True)]
            port.framer.retire()
            self.link.forget_peer(peer)

    # ------------------------------------------------------------------------------- what is told

    def _refused(self, frame: Frame, why: str) -> None:
        self.totals.dropped["refused"] += 1
        if why not in self._told_refusals:
            self._told_refusals.add(why)
            source = f"{frame.system_id}/{frame.component_id}"
            self._tell(
                self, "refused", f"a frame of {source} was refused: {why}; more such frames are only counted"
            )

    def _dropped(self, reason: str, held: Held) -> None:
        known = self._dialect.get(held.message_id)
        if known is None or kind_of(known.NAME, is_for_one=held.target[0] != 0) is not Kind.ORDER:
            return
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
    """What may go out there; LocalProtocolError when a name fits no message of the dialect."""
    return Filters(dialect, endpoint.only, endpoint.block, endpoint.rates)


def _hold_above(address: str) -> int:
    """Of a connection that is shared, and of several links, what the slowest of them stands."""
    kinds = (each.split(":")[0] for each in address.removeprefix("shared:").split(" + "))
    return min(HOLD_ABOVE.get(kind, HOLD_ABOVE_OTHERS) for kind in kinds)


def _counted(framer: Framer) -> tuple[int, int, int, int]:
    counters = framer.statistics
    lost = sum(source.lost for source in counters.sources.values())
    return counters.frames, counters.bytes, lost, counters.bad_bytes
