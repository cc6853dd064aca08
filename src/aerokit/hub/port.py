"""``Port``: one peer of one endpoint, which is what frames come from and go to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.hub.outgoing import Held, HeldFrames, Kind, kind_of

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable

    from aerokit.hub.guards import Border, IdentityGuard
    from aerokit.hub.routing import Node, Plan
    from aerokit.hub.values import HubEventKind
    from aerokit.mavlink.dialect import Dialect
    from aerokit.transport.link import Link, Peer

JOINED_BYTES = 1200
"""Frames that leave together are written together up to so many bytes, which is a datagram that nobody cuts up."""
NEVER = 1 << 62
MOST_RATES = 4096
"""So many (sender, message) are thinned out one by one."""


class Totals:
    """What an endpoint counts; shared by its ports, and kept when they have gone."""

    def __init__(self, dropped: Counter[str]) -> None:
        self.dropped: Counter[str] = dropped
        self.frames_out = 0
        self.bytes_out = 0


class Port:
    """One peer of one endpoint, and a batch, or a queue, for what goes there.

    While the link takes everything, frames are gathered in ``batch`` until the present turn of the loop is over. While
    more than ``hold_above`` bytes (`NEVER`: it is not asked) have not left it, they wait in a queue that knows what
    they are.

    ``endpoint`` is the endpoint's name, ``period(message_id)`` its filters' answer (`Filters.period`). ``report(kind,
    text)`` tells an event of the endpoint, ``tell(reason, held)`` is called for each frame that was dropped out of the
    queue.
    """

    link: Link
    peer: Peer

    def __init__(
        self,
        link: Link,
        peer: Peer,
        totals: Totals,
        *,
        endpoint: str,
        dialect: Dialect,
        hold_above: int,
        period: Callable[[int], float | None],
        report: Callable[[HubEventKind, str], object],
        tell: Callable[[str, Held], object],
        border: Border | None = None,
        guard: IdentityGuard | None = None,
        is_mute: bool = False,
    ) -> None:
        self.link, self.peer = link, peer
        self.totals = totals
        self.endpoint: str = endpoint
        self.period: Callable[[int], float | None] = period
        self.report: Callable[[HubEventKind, str], object] = report
        self.tells_bursts: bool = link.tells_bursts
        """Whether its link says when nothing more comes for now."""
        self.border: Border | None = border
        self.guard: IdentityGuard | None = guard
        self.is_mute: bool = is_mute
        """Whether nothing that comes from here is passed on."""
        self.one_at_a_time = False
        """Whether each frame is written by itself: autopilots read datagrams into small buffers."""
        self.batch: list[bytes] = []
        self.node: Node[Port] | None = None
        self._dialect = dialect
        self._hold_above, self._may_hold = hold_above, hold_above < NEVER
        self._tell = tell
        self._held = HeldFrames()
        self._due: dict[int, float] = {}

    @property
    def is_holding(self) -> bool:
        """Whether something waits for the link."""
        return bool(self._held)

    @property
    def waiting(self) -> int:
        """Frames that wait for the link."""
        return len(self._held)

    def must_hold(self) -> bool:
        """Whether the next frame has to wait."""
        return self._may_hold and (bool(self._held) or self._is_full())

    def hold(self, raw: bytes, plan: Plan[Port], now: float) -> None:
        """Have a frame wait for the link."""
        known = self._dialect.get(plan.message_id)
        kind = Kind.TRANSFER if known is None else kind_of(known.NAME, is_for_one=plan.target[0] != 0)
        self._drop(self._held.put(Held(raw, kind, plan.message_id, plan.target, now), plan.key))

    def is_due(self, key: int, period_s: float, now: float) -> bool:
        """Whether a message whose rate is limited may go out again."""
        due = self._due.get(key)
        if due is not None and now < due:
            self.totals.dropped["thinned"] += 1
            return False
        if due is None and len(self._due) >= MOST_RATES:
            self._due.clear()
        # On average the rate is kept, whatever comes in between; but nothing is made up for after a pause.
        self._due[key] = now + period_s if due is None else max(due, now - period_s) + period_s
        return True

    def flush(self, unix_time: float) -> None:
        """Write what was gathered."""
        batch, self.batch = self.batch, []
        if self.border is not None:
            batch = self._signed(batch, unix_time)
        totals, write, peer = self.totals, self.link.write, self.peer
        totals.frames_out += len(batch)
        if len(batch) == 1 or self.one_at_a_time:
            for raw in batch:
                totals.bytes_out += len(raw)
                write(raw, peer)
            return
        data = b"".join(batch)
        totals.bytes_out += len(data)
        if len(data) <= JOINED_BYTES:
            if data:
                write(data, peer)
            return
        for piece in _pieces(batch):
            write(piece, peer)

    def drain(self, now: float, unix_time: float) -> None:
        """Write what waits, as far as the link takes it, and drop the orders that have become late."""
        self._drop(self._held.expire(now))
        while self._held and not self._is_full():
            raw = self._held.next()
            assert raw is not None
            self.batch.append(raw)
            self.flush(unix_time)

    def close(self) -> None:
        """The peer has gone: what waits is dropped."""
        self._drop(self._held.clear())
        self.batch.clear()
        self._due.clear()

    def _is_full(self) -> bool:
        return self.link.unsent_bytes_to(self.peer) > self._hold_above

    def _signed(self, batch: list[bytes], unix_time: float) -> list[bytes]:
        assert self.border is not None
        signed = [self.border.signed(raw, unix_time) for raw in batch]
        self.totals.dropped["unsignable"] += sum(raw is None for raw in signed)
        return [raw for raw in signed if raw is not None]

    def _drop(self, dropped: list[tuple[str, Held]]) -> None:
        for reason, held in dropped:
            self.totals.dropped[reason] += 1
            self._tell(reason, held)


def _pieces(batch: list[bytes]) -> list[bytes]:
    pieces: list[bytes] = []
    piece: list[bytes] = []
    size = 0
    for raw in batch:
        if size + len(raw) > JOINED_BYTES and piece:
            pieces.append(b"".join(piece))
            piece, size = [], 0
        piece.append(raw)
        size += len(raw)
    pieces.append(b"".join(piece))
    return pieces
