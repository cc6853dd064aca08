"""Is it from now? Proven without clocks that agree: whoever judges, judges by its own clock.

The vehicle side sends beacons, numbered; a client stamps each datagram with the last one that it has heard. So the
datagram is not older than that beacon, and how old the beacon is the vehicle side knows. What a broken connection kept
back bears an old number, whenever it comes.

Time is an argument, seconds on any clock that does not go back.
"""

from __future__ import annotations

from collections import OrderedDict, deque

from .zenoh_keys import Beacon, Stamp, Wish

__all__ = ["BEACON_EVERY_S", "FRESH_S", "Ears", "Judge", "Lateness"]

BEACON_EVERY_S = 0.5
"""So often a vehicle side says that it is there."""

FRESH_S = 2.0
"""A datagram whose stamp is older is refused; a client that has heard no beacon for so long sends nothing."""

_MOST_NONCES = 256
_DRIFT = 0.001
"""Two clocks go apart by less than this (a millisecond in a second; quartz is ten times better)."""


class Judge:
    """The vehicle side: makes beacons, and judges what bears their numbers."""

    doubled: int
    late: int

    def __init__(self, epoch: int) -> None:
        self.epoch: int = epoch
        self.late = 0
        """Datagrams that were refused because their stamp was too old, or another vehicle side's."""
        self.doubled = 0
        """Datagrams that were refused because one like them, or a later one, had come."""
        self._number = 0
        self._sent: deque[tuple[int, float]] = deque()  # (number, when) of the beacons that still count
        self._sequences: OrderedDict[tuple[str, int], int] = OrderedDict()

    def beacon(self, now: float, helm: str | None = None) -> Beacon:
        """The next beacon, to be sent at once."""
        self._forget(now)
        self._number += 1
        self._sent.append((self._number, now))
        return Beacon(self.epoch, self._number, now, helm)

    def accepts(self, client: str, stamp: Stamp | None, now: float) -> bool:
        """Whether what bears this stamp is from now, and did not come before; counts what is not."""
        self._forget(now)
        is_fresh = (
            stamp is not None
            and stamp.epoch == self.epoch
            and bool(self._sent)
            and self._sent[0][0] <= stamp.beacon <= self._sent[-1][0]
        )
        if stamp is None or not is_fresh:
            self.late += 1
            return False
        who = client, stamp.nonce
        if stamp.sequence <= self._sequences.get(who, 0):
            self.doubled += 1
            return False
        self._sequences[who] = stamp.sequence
        self._sequences.move_to_end(who)
        if len(self._sequences) > _MOST_NONCES:
            self._sequences.popitem(last=False)
        return True

    def _forget(self, now: float) -> None:
        while self._sent and now - self._sent[0][1] > FRESH_S:
            self._sent.popleft()


class Lateness:
    """How much later than the quickest something comes: the least delay ever seen is taken for no delay.

    The clocks need not agree, only go alike. What was late from the very beginning is not known to be.
    """

    def __init__(self) -> None:
        self._least: float | None = None  # of our time less the sender's
        self._at = 0.0

    def of(self, sent_s: float, now: float) -> float:
        """Seconds, of what was sent then on the sender's clock and came ``now`` on ours."""
        delay = now - sent_s
        least = None if self._least is None else self._least + _DRIFT * (now - self._at)
        if least is None or delay <= least:
            self._least, self._at = delay, now
            return 0.0
        return delay - least


class Ears:
    """A client: which vehicle side it listens to, whether that one is there, and what to stamp."""

    foreign: int
    heard_at: float
    late: int

    def __init__(self, nonce: int, wish: Wish = "free") -> None:
        self.epoch: int | None = None
        """Of the vehicle side that is listened to; None: none was heard."""
        self.helm: str | None = None
        """Who has the helm, as told last."""
        self.late = 0
        """Frames of the vehicle side and beacons that came too late to be listened to."""
        self.foreign = 0
        """Those of another vehicle side of the same name than the one that is listened to."""
        self.heard_at = 0.0
        """When the last beacon came in time."""
        self._nonce, self._wish = nonce, wish
        self._beacon = 0
        self._sequence = 0
        self._lateness = Lateness()

    def hear_beacon(self, beacon: Beacon, now: float) -> bool:
        """Whether it counts: one of the vehicle side that is listened to, in time.

        Another one's counts as soon as the first has been silent for `FRESH_S`, or was :meth:`forget`-ten.
        """
        if beacon.epoch != self.epoch:
            if self.epoch is not None and not self.is_silent(now):
                self.foreign += 1
                return False
            self.epoch, self._beacon, self._lateness = beacon.epoch, 0, Lateness()
        elif beacon.number <= self._beacon:
            return False
        if self._lateness.of(beacon.clock_s, now) > FRESH_S:
            self.late += 1
            return False
        self._beacon, self.heard_at, self.helm = beacon.number, now, beacon.helm
        return True

    def hears(self, epoch: int, sent_s: float, now: float) -> bool:
        """Whether frames that were sent then, on the vehicle side's clock, are listened to."""
        if epoch != self.epoch:
            self.foreign += 1
            return False
        if self._lateness.of(sent_s, now) > FRESH_S:
            self.late += 1
            return False
        return True

    def stamp(self, now: float, wish: Wish | None = None) -> Stamp | None:
        """For what is sent now; None: nothing may be sent, because no beacon has come for `FRESH_S`."""
        if self.epoch is None or self.is_silent(now):
            return None
        self._sequence += 1
        return Stamp(self.epoch, self._beacon, self._nonce, self._sequence, wish or self._wish)

    def is_silent(self, now: float) -> bool:
        """Whether no beacon has come in time for `FRESH_S`."""
        return self._beacon == 0 or now - self.heard_at > FRESH_S

    def forget(self) -> None:
        """The vehicle side has said that it ends."""
        self.epoch, self._beacon, self.helm = None, 0, None
