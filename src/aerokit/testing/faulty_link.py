"""``FaultyLink``: a bad radio around any link, for tests, benchmarks and trying out what a program does then.

```python
radio = FaultyLink(
    create_link("udpin:0.0.0.0:14550"),
    incoming=FaultModel(loss=0.2, delay_s=0.05),                # from the vehicle
    outgoing=FaultModel(loss=0.1, delay_s=0.05, bandwidth=5760),  # to it
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
    HelmListener,
    Link,
    Peer,
    PeerListener,
    Receiver,
    keeps_peers,
)
from aerokit.transport.outbox import Outbox

LIMIT = 256 * 1024


class StalledLine:
    """As a TCP connection whose other side has stopped: the system takes ``system_bytes``, the rest waits.

    ``carry(data, peer)`` is what happens to bytes that leave; ``dropped`` and ``stalled`` are those of an `Outbox`.
    """

    def __init__(
        self,
        system_bytes: int,
        carry: Callable[[bytes, Peer], object],
        dropped: Callable[[int], object],
        stalled: Callable[[bool], object],
    ) -> None:
        self._room, self._carry, self._dropped, self._stalled = system_bytes, carry, dropped, stalled
        self._system: list[tuple[bytes, Peer]] = []
        self._outboxes: dict[Peer, Outbox] = {}
        self._stalled_ones: set[Peer] = set()
        self._is_stuck = True

    @property
    def unsent_bytes(self) -> int:
        """Bytes that wait here or in the system."""
        return sum(outbox.unsent_bytes for outbox in self._outboxes.values())

    def write(self, data: bytes, peer: Peer) -> None:
        """As `Link.write`."""
        outbox = self._outboxes.get(peer)
        if outbox is None:
            outbox = self._outboxes[peer] = self._new_outbox(peer)
        outbox.write(data)

    def discard(self) -> None:
        """Take back what the system does not have."""
        for outbox in self._outboxes.values():
            outbox.discard()

    def drain(self) -> None:
        """What the system has goes out, and what has not waited for too long."""
        self._is_stuck = False
        system, self._system = self._system, []
        for data, peer in system:
            self._carry(data, peer)
        for outbox in self._outboxes.values():
            outbox.resume()

    def close(self) -> None:
        """What the system has is forgotten with it."""
        for outbox in self._outboxes.values():
            outbox.discard()
            outbox.close()

    def _new_outbox(self, peer: Peer) -> Outbox:
        outbox = Outbox(
            partial(self._take, peer=peer),
            partial(self._in_system, peer),
            limit=LIMIT,
            dropped=self._dropped,
            stalled=partial(self._tell, peer),
        )
        if self._is_stuck and not self._room:
            outbox.pause()
        return outbox

    def _take(self, data: bytes, peer: Peer) -> None:
        if not self._is_stuck:
            self._carry(data, peer)
            return
        self._system.append((data, peer))
        if sum(len(piece) for piece, _ in self._system) >= self._room:
            for outbox in self._outboxes.values():
                outbox.pause()

    def _in_system(self, peer: Peer) -> int:
        return sum(len(data) for data, each in self._system if each == peer)

    def _tell(self, peer: Peer, is_stalled: bool) -> None:
        (self._stalled_ones.add if is_stalled else self._stalled_ones.discard)(peer)
        self._stalled(bool(self._stalled_ones))


class FaultyLink(Link):
    """Loses, repeats, delays and damages what another link brings and takes, as `FaultModel` says.

    ``outgoing`` is what this program writes, ``incoming`` what it receives; ``model`` is for the one of them that is
    not given. Each direction has its own random numbers, made from ``seed``; on virtual time the same program has the
    same bad luck each time. ``half_duplex`` lets both directions take turns on one frequency, each with its own
    ``bandwidth``.

    The wrapped link must not be open yet, and belongs to this one from now on.
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
        """What happens to what is written, with its counters; its ``model`` may be replaced at any time."""
        self.incoming: FaultyPath = FaultyPath(incoming or model, (seed, "incoming"), air)
        """What happens to what is received."""
        self._ears: _Ears | None = None
        self._on_the_way: _Timetable | None = None
        self._is_closed = False
        self._line: StalledLine | None = None  # None: it has never stalled
        self._stalled_at: float | None = None
        self._too_late = 0
        self._drained = asyncio.Event()
        self._drained.set()

    @property
    def address(self) -> str:  # type: ignore[override]
        """``faulty(udpin:0.0.0.0:14550)``."""
        return f"faulty({self.link.address})"

    @property
    def dropped_writes(self) -> int:  # type: ignore[override]
        """What the wrapped link dropped, what had no room in the queue, and what a stall kept for too long.

        What was lost on its way is none.
        """
        return self.link.dropped_writes + self.outgoing.overflowed + self._too_late

    @property
    def unsent_bytes(self) -> int:
        """See `Link.unsent_bytes`; what is on its way through the air has left."""
        return self.link.unsent_bytes + (0 if self._line is None else self._line.unsent_bytes)

    def discard_unsent(self) -> None:
        """See `Link.discard_unsent`."""
        if self._line is not None:
            self._line.discard()
        self.link.discard_unsent()

    def stall(self, system_bytes: int = 0) -> None:
        """From now on what is written does not leave, until :meth:`drain`: as over TCP when the network is away.

        The system takes ``system_bytes`` of it, which arrive after :meth:`drain`, whenever that is; the rest waits for
        at most a second, can be taken back by :meth:`discard_unsent`, and is dropped then. The link must be open.
        """
        if self._line is not None:
            self._line.close()
        self._line = StalledLine(system_bytes, self._carry, self._count_too_late, self._tell_stalled)

    def drain(self) -> None:
        """What was written leaves again."""
        if self._line is not None:
            self._line.drain()

    async def open(self, receiver: Receiver) -> None:
        """See `Link.open`."""
        if self._is_closed:
            raise ConnectionClosed(f"{self.address} was closed; make a new link to open it again")
        if self._ears is not None:
            raise BusyError(f"{self.address} is open; a link is opened once")
        loop = asyncio.get_running_loop()
        self._on_the_way = _Timetable(loop)
        self._ears = _Ears(self.incoming, receiver, self._lost)
        self.outgoing.start(loop.time())
        self.incoming.start(loop.time())
        try:
            await self.link.open(self._ears)
        except BaseException:
            self._ears.close()
            self._on_the_way.clear()
            self._ears = self._on_the_way = None
            raise

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; what is lost on its way is no dropped write."""
        if self._on_the_way is None or self._is_closed:
            return
        if self._line is not None:
            self._line.write(bytes(data), peer)
        else:
            self._carry(data, peer)

    def _carry(self, data: bytes, peer: Peer) -> None:
        on_the_way = self._on_the_way
        if on_the_way is None:
            return
        for due, piece in self.outgoing.carry(bytes(data), on_the_way.loop.time()):
            on_the_way.put(due, lambda piece=piece: self.link.write(piece, peer))  # type: ignore[misc]

    def keep_peer(self, peer: Peer) -> None:
        """See `Link.keep_peer`."""
        self.link.keep_peer(peer)

    def forget_peer(self, peer: Peer) -> None:
        """See `Link.forget_peer`."""
        self.link.forget_peer(peer)

    def host_of(self, peer: Peer) -> object:
        """See `Link.host_of`."""
        return self.link.host_of(peer)

    def has_peer(self, peer: Peer) -> bool:
        """See `Link.has_peer`."""
        return self.link.has_peer(peer)

    def close(self) -> None:
        """See `Link.close`; what is on its way still goes out, unless that takes longer than `LINGER_S`."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._line is not None:
            self._line.close()
        if self._ears is not None:
            self._ears.close()
        on_the_way = self._on_the_way
        if on_the_way is None or on_the_way.loop.is_closed() or not on_the_way:
            self.link.close()
            return
        self._drained.clear()
        on_the_way.put(min(on_the_way.latest_due, on_the_way.loop.time() + LINGER_S), self._close_link)

    async def wait_closed(self) -> None:
        """See `Link.wait_closed`."""
        await self._drained.wait()
        await self.link.wait_closed()

    def _count_too_late(self, writes: int) -> None:
        self._too_late += writes

    def _tell_stalled(self, is_stalled: bool) -> None:
        ears, now, since = self._ears, asyncio.get_running_loop().time(), self._stalled_at
        if ears is None or is_stalled == (since is not None):
            return
        self._stalled_at = now if is_stalled else None
        if since is None:
            ears.link_stalled(self.unsent_bytes)
        else:
            ears.link_drained(now - since)

    def _lost(self) -> None:
        """What is on its way out meets nobody any more."""
        if self._line is not None:
            self._line.close()
        if self._on_the_way is not None:
            self._on_the_way.clear()
        self._drained.set()

    def _close_link(self) -> None:
        self._lost()
        self.link.close()


class _Ears:
    """What the wrapped link calls."""

    def __init__(self, path: FaultyPath, receiver: Receiver, when_lost: Callable[[], None]) -> None:
        self._path, self._receiver, self._when_lost = path, receiver, when_lost
        self.keeps_peers = keeps_peers(receiver)
        self._on_the_way = _Timetable(asyncio.get_running_loop())
        self._is_closed = False

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """See `Receiver`."""
        for due, piece in self._path.carry(data, self._on_the_way.loop.time()):
            if self._is_closed:  # by the receiver
                return
            self._on_the_way.put(due, lambda piece=piece: self._receiver.bytes_received(piece, peer))  # type: ignore[misc]

    def link_lost(self, error: LinkLost) -> None:
        """See `Receiver`; what is on its way is heard before."""
        self._when_lost()
        if not self._is_closed:
            self._on_the_way.put(self._on_the_way.latest_due, lambda: self._receiver.link_lost(error))

    def link_stalled(self, unsent_bytes: int) -> None:
        """See `DrainListener`."""
        if not self._is_closed and isinstance(self._receiver, DrainListener):
            self._receiver.link_stalled(unsent_bytes)

    def link_drained(self, stalled_s: float) -> None:
        """See `DrainListener`."""
        if not self._is_closed and isinstance(self._receiver, DrainListener):
            self._receiver.link_drained(stalled_s)

    def order_refused(self, message: str, reason: str, helm: str | None, answers: tuple[bytes, ...]) -> None:
        """See `HelmListener`."""
        if not self._is_closed and isinstance(self._receiver, HelmListener):
            self._receiver.order_refused(message, reason, helm, answers)

    def peer_joined(self, peer: Peer) -> None:
        """See `PeerListener`."""
        if not self._is_closed and isinstance(self._receiver, PeerListener):
            self._receiver.peer_joined(peer)

    def peer_left(self, peer: Peer) -> None:
        """See `PeerListener`."""
        if not self._is_closed and isinstance(self._receiver, PeerListener):
            self._receiver.peer_left(peer)

    def close(self) -> None:
        self._is_closed = True
        self._on_the_way.clear()


class _Timetable:
    """Does things when they are due, in order, those of one instant in the order they were put in; one timer."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self.latest_due = loop.time()
        self._waiting: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0  # uvloop's handle of a time that is past does not tell it

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, due: float, action: Callable[[], None]) -> None:
        """At once when it is due and nothing waits, so that a radio without faults is no radio at all."""
        if due <= self.loop.time() and not self._waiting:
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
        due = self._waiting[0][0]
        if self._timer is not None:
            if self._timer_at <= due:
                return
            self._timer.cancel()
        self._timer, self._timer_at = self.loop.call_at(due, self._run), due

    def _run(self) -> None:
        self._timer = None
        now = max(self.loop.time(), self._waiting[0][0])  # a timer may fire a hair early
        try:
            while self._waiting and self._waiting[0][0] <= now:
                heappop(self._waiting)[2]()
        finally:  # what an action raised is for the loop to report; the others are done all the same
            if self._waiting:
                self._schedule()
