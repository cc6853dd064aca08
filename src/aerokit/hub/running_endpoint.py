"""``RunningEndpoint``: an endpoint of a hub with its link and its ports; the receiver of the link."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING

from aerokit.connection.frame_receiver import MAX_PEERS, PeerTable
from aerokit.hub.message_rules import Filters, MessageKind
from aerokit.hub.port import UNLIMITED, EndpointCounters, FrameSigner, Port, joined
from aerokit.hub.senders import IdentityGuard
from aerokit.hub.shared_link import SharedLink
from aerokit.hub.values import EndpointStatistics
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2
from aerokit.transport import ReconnectingLink, create_link

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.errors import LinkLost
    from aerokit.hub.port import QueuedFrame
    from aerokit.hub.switch import Switch
    from aerokit.hub.values import Endpoint, HubEventKind
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.framer import Framer
    from aerokit.transport.link import Link, Peer

    Report = Callable[["RunningEndpoint", HubEventKind, str], object]

# Frames are queued while a link has more unsent bytes than this. A radio at 57600 baud sends 2048 bytes in 0.36 s.
QUEUE_ABOVE_BYTES = {"serial": 2048, "pty": 2048}
DEFAULT_QUEUE_ABOVE_BYTES = 16 * 1024

# These links send or drop data at once, so they never have unsent bytes.
UNBUFFERED_KINDS = ("udpin", "udpout", "udpbcast")

# The possible first bytes of a frame.
_MAGICS = (bytes((MAGIC_V2,)), bytes((MAGIC_V1,)))


class RunningEndpoint:
    """One endpoint with its link. Failures of the link do not affect other endpoints.

    ``now`` is the loop's clock; ``report(endpoint, kind, text)`` publishes an event.
    """

    def __init__(
        self, endpoint: Endpoint, switch: Switch, dialect: Dialect, now: Callable[[], float], report: Report
    ) -> None:
        self.endpoint = endpoint
        self.filters: Filters = filters_of(endpoint, dialect)
        self._switch, self._dialect, self._now, self._report = switch, dialect, now, report
        address = endpoint.address
        if isinstance(address, str):
            make_link = partial(create_link, address, baud=endpoint.baud, peers=endpoint.peers)
            self.link: Link = ReconnectingLink(make_link)
        else:
            self.link = address
        self._is_shared = isinstance(self.link, SharedLink)  # True if the link is a connection of our own program
        self.name: str = endpoint.name or self.link.address
        self.keeps_peers = True  # see `PeerKeeper`
        self.is_open: bool = False
        self._owns_link = False  # True once this object has opened the link, and therefore must close it
        self._reports_bursts = False  # True if the link calls `burst_ended`
        # True for a link with one remote end, e.g. a serial port. The only key in `_ports` is then None.
        self._has_single_peer = False
        self._burst: list[bytes] = []  # datagrams of `_burst_peer` that are not processed yet
        self._burst_peer: Peer = None
        self._ports: dict[Peer, Port] = {}
        self._guard = IdentityGuard(self.link, self._report_peer)
        self._peers = PeerTable(
            self.link, dialect, self._guard.evict_idle_peer, _keep_unknown, on_evict=self._forget_port
        )
        self._is_full_reported = False  # True if it was reported that the endpoint has too many peers
        self.counters: EndpointCounters = EndpointCounters(Counter())
        self._totals_of_forgotten_peers: Counter[str] = Counter()
        self._reported_refusals: set[str] = set()  # reasons that were already reported
        self._signer: FrameSigner | None = None  # verifies and adds signatures
        if endpoint.signing is not None:
            self._signer = FrameSigner(endpoint.signing, dialect.extras, self._on_refused)

    async def open(self) -> None:
        await self.link.open(self)
        self._owns_link = True
        self._on_up()
        self._report(self, "opened", f"{self.link.address} is open")

    def close(self) -> None:
        self._on_down()
        if self._owns_link:
            self.link.close()

    async def wait_closed(self) -> None:
        if self._owns_link:
            await self.link.wait_closed()

    def statistics(self) -> EndpointStatistics:
        router, ports = self._switch.router, tuple(self._ports.values())
        totals = self._totals_of_forgotten_peers.copy()
        for framer in self._peers:
            totals.update(_totals_of(framer))
        systems: set[tuple[int, int]] = set()
        for port in ports:
            if port.ingress is not None:
                systems.update(router.senders_at(port.ingress))
        dropped = {reason: count for reason, count in self.counters.dropped.items() if count}
        if self.link.dropped_writes:
            dropped["link"] = self.link.dropped_writes
        return EndpointStatistics(
            name=self.name,
            address=self.link.address,
            is_open=self.is_open,
            peers=len(ports),
            frames_in=totals["frames"],
            bytes_in=totals["bytes"],
            frames_out=self.counters.frames_out,
            bytes_out=self.counters.bytes_out,
            lost=totals["lost"],
            bad_bytes=totals["bad_bytes"],
            waiting=sum(port.waiting for port in ports),
            dropped=dropped,
            systems=tuple(sorted(systems)),
        )

    # -------------------------------------------------------------------- called by the link

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        # The datagrams that the link reads from one known peer at once are forwarded together, if each begins with a
        # frame.
        if self._burst:
            if peer == self._burst_peer and data[:1] in _MAGICS:
                self._burst.append(data)
                return
            self._receive_burst()
        if self._reports_bursts and peer in self._peers.framers and data[:1] in _MAGICS:
            self._burst.append(data)
            self._burst_peer = peer
        else:
            self._receive(data, peer)

    def burst_ended(self) -> None:
        self._receive_burst()
        self._switch.flush()

    def _receive_burst(self) -> None:
        if self._burst:
            burst, self._burst = self._burst, []
            for data in joined(burst):
                self._receive(data, self._burst_peer)

    def _receive(self, data: bytes, peer: Peer) -> None:
        try:
            now = self._now()
            # Frames of a SharedLink have not waited in a socket.
            arrived_at = now if self._is_shared else self._switch.arrival_time(now)
            port_peer = None if self._has_single_peer else peer
            framer = self._peers.framers.get(port_peer)
            is_whole = False  # True if the data consists of whole valid frames and nothing else
            if framer is not None:
                waiting_before, bad_bytes_before = framer.waiting, framer.statistics.bad_bytes
                frames = framer.receive(data, arrived_at)
                has_partial_frame = bool(waiting_before or framer.waiting)
                is_whole = not has_partial_frame and framer.statistics.bad_bytes == bad_bytes_before
            else:
                framer, frames = self._peers.receive_unverified(port_peer, data, arrived_at)
                self._report_rejected_peer(framer, port_peer)
            if frames:
                port = self._ports.get(port_peer) or self._add_port(port_peer)
                self._switch.receive(port, framer, frames, data if is_whole else None, now, arrived_at)
                if port_peer != peer:  # A peer of a udpbcast link has answered, so send to it only.
                    self.link.keep_peer(peer)
        except Exception as error:
            self._report(self, "internal_error", f"internal error of aerokit: {error!r}")

    def peer_joined(self, peer: Peer) -> None:
        if peer not in self._ports:
            self._add_port(peer)
            self._report(self, "client_joined", f"{_client_name(peer)} has connected")

    def peer_left(self, peer: Peer) -> None:
        if peer in self._ports:
            self._forget(peer)
            self._report(self, "client_left", f"{_client_name(peer)} has disconnected")

    def link_interrupted(self, error: LinkLost) -> None:
        self._on_down()
        self._report(self, "lost", f"{error}; it is being reopened")

    def link_restored(self, away_s: float) -> None:
        self._on_up()
        self._report(self, "restored", f"{self.link.address} is back after {away_s:.1f} s")

    def link_stalled(self, unsent_bytes: int) -> None:
        self._report(self, "stalled", f"the link has stalled with {unsent_bytes} unsent bytes")

    def link_drained(self, stalled_s: float) -> None:
        self._report(self, "drained", f"the link continues after {stalled_s:.1f} s")

    def link_lost(self, error: LinkLost) -> None:
        self._on_down()
        self._report(self, "lost", f"{error}")

    # ------------------------------------------------------------------------------------ ports

    def _on_up(self) -> None:
        self.is_open, self._reports_bursts = True, self.link.reports_bursts
        self._has_single_peer = self.link.has_peer(None)
        if self._has_single_peer and None not in self._ports:
            self._add_port(None)

    def _on_down(self) -> None:
        if self._burst:  # The link was lost before it reported the end of the burst.
            self.burst_ended()
        self.is_open = False
        for peer in tuple(self._ports):
            self._forget(peer)

    def _add_port(self, peer: Peer) -> Port:
        port = self._ports[peer] = Port(
            self.link,
            peer,
            self.counters,
            endpoint=self.name,
            dialect=self._dialect,
            queue_above_bytes=self._queue_above_bytes(),
            min_interval=self.filters.min_interval,
            report=partial(self._report, self),
            on_drop=self._on_drop,
            signer=self._signer,
            guard=None if self._has_single_peer else self._guard,
            is_read_only=self.endpoint.read_only,
        )
        self._guard.has_several_peers = len(self._ports) > 1
        self._switch.add(port)
        return port

    def _queue_above_bytes(self) -> int:
        kind, _, _ = self.link.address.partition(":")
        if kind in UNBUFFERED_KINDS and isinstance(self.endpoint.address, str):
            return UNLIMITED
        return _min_queue_above_bytes(self.link.address)

    def _forget(self, peer: Peer) -> None:
        self._forget_port(peer)
        self._peers.forget(peer)

    def _forget_port(self, peer: Peer) -> None:
        framer = self._peers.framers.get(peer)
        if framer is not None:
            self._totals_of_forgotten_peers.update(_totals_of(framer))
        self._guard.forget(peer)
        port = self._ports.pop(peer, None)
        self._guard.has_several_peers = len(self._ports) > 1
        if port is not None:
            self._switch.remove(port)

    # ------------------------------------------------------------------------------- events

    def _on_refused(self, frame: Frame, reason: str) -> None:
        self.counters.dropped["refused"] += 1
        if reason not in self._reported_refusals:
            self._reported_refusals.add(reason)
            source = f"{frame.system_id}/{frame.component_id}"
            text = f"a frame of {source} was refused: {reason}; further ones are counted, but not reported"
            self._report(self, "refused", text)

    def _report_peer(self, kind: HubEventKind, peer: Peer, text: str) -> None:
        self._report(self, kind, f"{_client_name(peer)}: {text}")

    def _report_rejected_peer(self, framer: Framer, peer: Peer) -> None:
        is_rejected = framer.statistics.frames > 0 and peer not in self._peers.framers
        if is_rejected and not self._is_full_reported:
            self._report_peer("peer_rejected", peer, f"rejected, because {MAX_PEERS} other peers are active")
        self._is_full_reported = is_rejected

    def _on_drop(self, reason: str, frame: QueuedFrame) -> None:
        if frame.kind is not MessageKind.ORDER:  # Only dropped commands are reported; other frames are just counted.
            return
        name = self._dialect[frame.message_id].NAME
        waited_s = self._now() - frame.waiting_since
        explanation = {"late": "it waited too long", "queue_full": "the queue is full"}.get(reason, "the link was lost")
        system_id, component_id = frame.target
        target = f"{system_id}/{component_id}"
        self._report(self, "order_dropped", f"{name} for {target} was dropped after {waited_s:.1f} s: {explanation}")


def _client_name(peer: Peer) -> str:
    host, port = peer[:2] if isinstance(peer, tuple) and len(peer) > 1 else (peer, "")
    return f"client [{host}]:{port}" if ":" in str(host) else f"client {host}:{port}".rstrip(":")


def filters_of(endpoint: Endpoint, dialect: Dialect) -> Filters:
    return Filters(dialect, endpoint.only, endpoint.block, endpoint.rates)


def _min_queue_above_bytes(address: str) -> int:
    # An address may name several links.
    kinds = (part.split(":")[0] for part in address.removeprefix("shared:").split(" + "))
    return min(QUEUE_ABOVE_BYTES.get(kind, DEFAULT_QUEUE_ABOVE_BYTES) for kind in kinds)


def _keep_unknown(framer: Framer) -> None:
    framer.keep_unknown = True


def _totals_of(framer: Framer) -> Counter[str]:
    counters = framer.statistics
    lost = sum(source.lost for source in counters.sources.values())
    return Counter(frames=counters.frames, bytes=counters.bytes, lost=lost, bad_bytes=counters.bad_bytes)
