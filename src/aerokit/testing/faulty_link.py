"""``FaultyLink``: a bad radio around any link, for tests and benchmarks.

```python
radio = FaultyLink(
    create_link("udpin:0.0.0.0:14550"),
    incoming=FaultModel(loss=0.2, delay_s=0.05),                # from the vehicle
    outgoing=FaultModel(loss=0.1, delay_s=0.05, bandwidth=5760),  # to the vehicle
    seed=7,
)
async with aerokit.connect(radio) as vehicle:
    ...
print(radio.incoming.lost, "of", radio.incoming.frames, "frames of the vehicle were lost")
```
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from heapq import heappop, heappush

from aerokit.errors import BusyError, ConnectionClosed, LinkLost
from aerokit.testing.fault_model import Air, FaultModel, FaultyPath
from aerokit.transport.link import (
    LINGER_S,
    DrainListener,
    Link,
    OrderRefusalListener,
    Peer,
    PeerListener,
    Receiver,
    keeps_peers,
)
from aerokit.transport.outbox import Outbox

# Maximum number of bytes that wait for a peer, as in the TCP links.
LIMIT = 256 * 1024


class StalledQueue:
    """Simulates a TCP connection that is stalled until `drain`.

    The simulated operating system accepts the first ``system_bytes``. Further bytes wait in an `Outbox` per peer.

    ``carry(data, peer)`` sends bytes. ``on_drop(count)`` is called when an outbox drops writes.
    ``on_stall(is_any_stalled)`` is called when an outbox stalls or drains.
    """

    def __init__(
        self,
        system_bytes: int,
        carry: Callable[[bytes, Peer], object],
        on_drop: Callable[[int], object],
        on_stall: Callable[[bool], object],
    ) -> None:
        self._system_limit = system_bytes
        self._carry = carry
        self._on_drop = on_drop
        self._on_stall = on_stall
        # Bytes that the simulated operating system has accepted, and sends after the stall.
        self._accepted: list[tuple[bytes, Peer]] = []
        self._outboxes: dict[Peer, Outbox] = {}
        self._stalled_peers: set[Peer] = set()  # Peers whose outbox has reported a stall.
        self._is_stalled = True  # True until `drain`. The stall affects all peers.

    @property
    def unsent_bytes(self) -> int:
        return sum(outbox.unsent_bytes for outbox in self._outboxes.values())

    def write(self, data: bytes, peer: Peer) -> None:
        outbox = self._outboxes.get(peer)
        if outbox is None:
            outbox = self._new_outbox(peer)
            self._outboxes[peer] = outbox
        outbox.write(data)

    def discard(self) -> None:
        """Discard the queued bytes, which the operating system has not accepted."""
        for outbox in self._outboxes.values():
            outbox.discard()

    def drain(self) -> None:
        """End the stall. Send the bytes that the operating system accepted, then the queued bytes."""
        self._is_stalled = False
        accepted, self._accepted = self._accepted, []
        for data, peer in accepted:
            self._carry(data, peer)
        for outbox in self._outboxes.values():
            outbox.resume()

    def close(self) -> None:
        """Close the queues, and drop what they contain."""
        for outbox in self._outboxes.values():
            outbox.discard()
            outbox.close()

    def _new_outbox(self, peer: Peer) -> Outbox:
        outbox = Outbox(
            send=partial(self._send_or_accept, peer=peer),
            pending_bytes=partial(self._accepted_bytes_of, peer),
            limit=LIMIT,
            on_dropped=self._on_drop,
            on_stalled=partial(self._on_peer_stalled, peer),
        )
        if self._is_full:
            outbox.pause()
        return outbox

    def _send_or_accept(self, data: bytes, peer: Peer) -> None:
        if not self._is_stalled:
            self._carry(data, peer)
            return
        self._accepted.append((data, peer))
        if self._is_full:
            for outbox in self._outboxes.values():
                outbox.pause()

    @property
    def _is_full(self) -> bool:
        return self._is_stalled and sum(len(data) for data, _ in self._accepted) >= self._system_limit

    def _accepted_bytes_of(self, peer: Peer) -> int:
        return sum(len(data) for data, receiver in self._accepted if receiver == peer)

    def _on_peer_stalled(self, peer: Peer, is_stalled: bool) -> None:
        if is_stalled:
            self._stalled_peers.add(peer)
        else:
            self._stalled_peers.discard(peer)
        self._on_stall(bool(self._stalled_peers))


class FaultyLink(Link):
    """Loses, duplicates, delays and corrupts the traffic of another link, as `FaultModel` specifies.

    ``outgoing`` applies to data that this program writes, ``incoming`` to data that this program receives. ``model`` is
    the default of both. Each direction has a separate random generator, derived from ``seed``, so that a program on
    virtual time gets the same faults in every run. With ``half_duplex``, only one direction transmits at a time.

    The wrapped link must not be open, because this link opens and closes it.
    """

    def __init__(
        self,
        link: Link,
        model: FaultModel | None = None,
        *,
        outgoing: FaultModel | None = None,
        incoming: FaultModel | None = None,
        seed: int = 0,
        half_duplex: bool = False,
    ) -> None:
        self.link = link
        """The wrapped link."""
        model = FaultModel() if model is None else model
        air = Air() if half_duplex else None
        self.outgoing: FaultyPath = FaultyPath(outgoing or model, (seed, "outgoing"), air)
        """The outgoing direction, with counters. Its ``model`` may be replaced at any time."""
        self.incoming: FaultyPath = FaultyPath(incoming or model, (seed, "incoming"), air)
        """The incoming direction, with counters. Its ``model`` may be replaced at any time."""
        self._incoming_path: _IncomingPath | None = None  # None until the link is opened
        self._in_flight: _DeliveryQueue | None = None  # outgoing frames in transit; None until the link is opened
        self._is_closed = False
        self._stalled_queue: StalledQueue | None = None  # None before the first call of `stall`
        self._stalled_at: float | None = None  # start of the present stall; None if there is none
        self._expired_writes = 0
        self._delivered = asyncio.Event()  # not set while a closed link still delivers frames
        self._delivered.set()

    @property
    def address(self) -> str:  # type: ignore[override]
        """Address such as ``faulty(udpin:0.0.0.0:14550)``."""
        return f"faulty({self.link.address})"

    @property
    def dropped_writes(self) -> int:  # type: ignore[override]
        """Number of writes dropped by the wrapped link, by a stall or by the full queue of `outgoing`.

        Frames that were lost in transit do not count.
        """
        return self.link.dropped_writes + self.outgoing.overflowed + self._expired_writes

    @property
    def unsent_bytes(self) -> int:
        """See `Link.unsent_bytes`. Bytes in transit do not count."""
        queued_bytes = 0 if self._stalled_queue is None else self._stalled_queue.unsent_bytes
        return self.link.unsent_bytes + queued_bytes

    def discard_unsent(self) -> None:
        if self._stalled_queue is not None:
            self._stalled_queue.discard()
        self.link.discard_unsent()

    def stall(self, system_bytes: int = 0) -> None:
        """Stop sending until :meth:`drain`, like TCP over an interrupted network.

        The simulated operating system accepts the first ``system_bytes`` bytes, which arrive after :meth:`drain`.
        Further bytes are queued. They are dropped after a second in the queue, or at once by :meth:`discard_unsent`. If
        the link is already stalled, its unsent bytes are dropped and a new stall begins. The link must be open.
        """
        if self._stalled_queue is not None:
            self._stalled_queue.close()
        self._stalled_queue = StalledQueue(system_bytes, self._carry, self._count_expired, self._on_stalled)

    def drain(self) -> None:
        """Resume sending after :meth:`stall`."""
        if self._stalled_queue is not None:
            self._stalled_queue.drain()
            self._on_stalled(False)  # After a second `stall`, the first queue is closed and reports no end.

    async def open(self, receiver: Receiver) -> None:
        if self._is_closed:
            raise ConnectionClosed(f"{self.address} was closed and cannot be opened again; make a new link")
        if self._incoming_path is not None:
            raise BusyError(f"{self.address} is already open; a link can be opened only once")
        loop = asyncio.get_running_loop()
        self._in_flight = _DeliveryQueue(loop)
        self._incoming_path = _IncomingPath(self.incoming, receiver, self._discard_in_transit)
        self.outgoing.start(loop.time())
        self.incoming.start(loop.time())
        try:
            await self.link.open(self._incoming_path)
        except BaseException:  # After a failed or cancelled attempt, `open` may be called again.
            self._incoming_path.close()
            self._in_flight.clear()
            self._incoming_path = None
            self._in_flight = None
            raise

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`. A frame that is lost in transit does not count as a dropped write."""
        if self._in_flight is None or self._is_closed:
            return
        if self._stalled_queue is not None:
            self._stalled_queue.write(bytes(data), peer)
        else:
            self._carry(data, peer)

    def _carry(self, data: bytes, peer: Peer) -> None:
        in_flight = self._in_flight
        if in_flight is None:
            return
        for due, piece in self.outgoing.carry(bytes(data), in_flight.loop.time()):
            in_flight.put(due, partial(self.link.write, piece, peer))

    def keep_peer(self, peer: Peer) -> None:
        self.link.keep_peer(peer)

    def forget_peer(self, peer: Peer) -> None:
        self.link.forget_peer(peer)

    def host_of(self, peer: Peer) -> object:
        return self.link.host_of(peer)

    def has_peer(self, peer: Peer) -> bool:
        return self.link.has_peer(peer)

    def close(self) -> None:
        """See `Link.close`. Outgoing frames in transit are still delivered, for up to `LINGER_S` seconds.

        Incoming frames in transit, and outgoing frames that wait for the end of a stall, are dropped.
        """
        if self._is_closed:
            return
        self._is_closed = True
        if self._stalled_queue is not None:
            self._stalled_queue.close()
        if self._incoming_path is not None:
            self._incoming_path.close()
        in_flight = self._in_flight
        if in_flight is None or in_flight.loop.is_closed() or in_flight.is_empty:  # There is nothing left to deliver.
            self.link.close()
            return
        self._delivered.clear()
        latest_close = in_flight.loop.time() + LINGER_S
        in_flight.put(min(in_flight.latest_due, latest_close), self._close_link)

    async def wait_closed(self) -> None:
        await self._delivered.wait()
        await self.link.wait_closed()

    def _count_expired(self, writes: int) -> None:
        self._expired_writes += writes

    def _on_stalled(self, is_stalled: bool) -> None:
        stalled_at = self._stalled_at
        was_stalled = stalled_at is not None
        if self._incoming_path is None or is_stalled == was_stalled:  # The link is not open, or nothing has changed.
            return
        now = asyncio.get_running_loop().time()
        if stalled_at is None:  # The stall begins.
            self._stalled_at = now
            self._incoming_path.link_stalled(self.unsent_bytes)
        else:
            self._stalled_at = None
            self._incoming_path.link_drained(now - stalled_at)

    def _discard_in_transit(self) -> None:
        if self._stalled_queue is not None:
            self._stalled_queue.close()
        if self._in_flight is not None:
            self._in_flight.clear()
        self._delivered.set()

    def _close_link(self) -> None:
        self._discard_in_transit()
        self.link.close()


class _IncomingPath:
    """The receiver of the wrapped link. It applies the faults of the incoming direction."""

    def __init__(self, path: FaultyPath, receiver: Receiver, on_lost: Callable[[], None]) -> None:
        self._path = path
        self._receiver = receiver
        self._on_lost = on_lost
        self.keeps_peers = keeps_peers(receiver)
        self._in_flight = _DeliveryQueue(asyncio.get_running_loop())
        self._is_closed = False

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        for due, piece in self._path.carry(data, self._in_flight.loop.time()):
            if self._is_closed:  # The receiver has closed the link while it processed the previous piece.
                return
            self._in_flight.put(due, partial(self._receiver.bytes_received, piece, peer))

    def link_lost(self, error: LinkLost) -> None:
        self._on_lost()
        if not self._is_closed:  # The error arrives after all frames in transit.
            self._in_flight.put(self._in_flight.latest_due, lambda: self._receiver.link_lost(error))

    def link_stalled(self, unsent_bytes: int) -> None:
        if not self._is_closed and isinstance(self._receiver, DrainListener):
            self._receiver.link_stalled(unsent_bytes)

    def link_drained(self, stalled_s: float) -> None:
        if not self._is_closed and isinstance(self._receiver, DrainListener):
            self._receiver.link_drained(stalled_s)

    def order_refused(self, message: str, reason: str, lease_holder: str | None, answers: tuple[bytes, ...]) -> None:
        if not self._is_closed and isinstance(self._receiver, OrderRefusalListener):
            self._receiver.order_refused(message, reason, lease_holder, answers)

    def peer_joined(self, peer: Peer) -> None:
        if not self._is_closed and isinstance(self._receiver, PeerListener):
            self._receiver.peer_joined(peer)

    def peer_left(self, peer: Peer) -> None:
        if not self._is_closed and isinstance(self._receiver, PeerListener):
            self._receiver.peer_left(peer)

    def close(self) -> None:
        self._is_closed = True
        self._in_flight.clear()


class _DeliveryQueue:
    """Runs actions when they are due, in the order of their times, with a single timer."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self.latest_due = loop.time()  # the latest due time of all actions so far
        # Heap of (due time, number, action). The numbers keep the order of actions that are due at the same time.
        self._waiting: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0  # number of actions queued so far
        self._timer: asyncio.TimerHandle | None = None
        # The due time of `_timer` is stored, because TimerHandle.when() of uvloop fails after that time.
        self._timer_at = 0.0

    @property
    def is_empty(self) -> bool:
        return not self._waiting

    def put(self, due: float, action: Callable[[], None]) -> None:
        """Queue an action. It runs at once if it is due and the queue is empty."""
        if due <= self.loop.time() and not self._waiting:
            # A link without faults adds no delay.
            action()
            return
        self.latest_due = max(self.latest_due, due)
        self._count += 1
        heappush(self._waiting, (due, self._count, action))
        self._schedule()

    def clear(self) -> None:
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None

    def _schedule(self) -> None:
        due, _, _ = self._waiting[0]
        if self._timer is not None:
            if self._timer_at <= due:
                return  # The timer is early enough.
            self._timer.cancel()
        self._timer = self.loop.call_at(due, self._run)
        self._timer_at = due

    def _run(self) -> None:
        first_due, _, _ = self._waiting[0]
        now = max(self.loop.time(), first_due)  # A timer may fire slightly early.
        try:
            while self._waiting:
                due, _, action = self._waiting[0]
                if due > now:
                    break
                heappop(self._waiting)
                action()
        finally:  # If an action raises an exception, a new timer runs the remaining actions.
            # `self._timer` is the timer that has fired, or one that an action has started by calling `put`.
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            if self._waiting:
                self._schedule()
