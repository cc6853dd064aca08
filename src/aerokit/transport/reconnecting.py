"""``ReconnectingLink``: a link that is opened again whenever it was lost, until it is closed.

```python
link = ReconnectingLink(lambda: create_link("/dev/serial/by-id/usb-Hex_CubeOrange-if00"))
async with aerokit.connect(link) as vehicle:        # the same as aerokit.connect("/dev/…", reconnect=True)
    ...
```
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from typing import Protocol, runtime_checkable

from aerokit.errors import BusyError, ConnectionClosed, LinkLost, RecordingEnded
from aerokit.transport.link import (
    BurstListener,
    DrainListener,
    HelmListener,
    Link,
    Peer,
    PeerListener,
    Receiver,
    keeps_peers,
)

FIRST_DELAY_S = 0.2
"""Before the first further attempt."""

LONGEST_DELAY_S = 5.0
"""Before each of many."""


class Delays:
    """Twice as long each time: 0.2 s, 0.4 s, … 5 s."""

    def __init__(self, first_s: float = FIRST_DELAY_S, longest_s: float = LONGEST_DELAY_S) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._next_s = first_s

    def take(self) -> float:
        """Seconds to wait now."""
        delay_s, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        return delay_s

    def begin_anew(self) -> None:
        """It was there again: the next one is the first."""
        self._next_s = self._first_s


logger: logging.Logger = logging.getLogger("aerokit")

STEADY_S = 1.0
"""A link that was opened again is back when bytes come, or when it has not been lost again for so long."""


@runtime_checkable
class Interruptible(Receiver, Protocol):
    """A receiver that wants to be told when its link goes and comes back; others just hear nothing meanwhile."""

    def link_interrupted(self, error: LinkLost) -> None:
        """The link has gone; it is being opened again."""

    def link_restored(self, away_s: float) -> None:
        """It is back after so many seconds; what comes now is a new stream of bytes."""


class ReconnectingLink(Link):
    """Opens another link like the lost one, after 0.2 s, then ever more rarely, down to every 5 s, until it is closed.

    Opening it behaves as opening the link that ``make_link`` gives: what is wrong is told at once. ``link_lost`` is
    called only at the end of a recording, and when ``make_link`` itself fails. What is written while the link is away
    is dropped, and counted in `dropped_writes`. Going and coming back are logged once each (``aerokit``, WARNING and
    INFO): a server that takes connections only to close them is still away.

    ``make_link`` is called at once, and again for each attempt; it must give a new link each time.
    """

    def __init__(
        self,
        make_link: Callable[[], Link],
        *,
        first_delay_s: float = FIRST_DELAY_S,
        longest_delay_s: float = LONGEST_DELAY_S,
    ) -> None:
        self._make_link = make_link
        self._link = make_link()
        self._delays = Delays(first_delay_s, longest_delay_s)
        self._receiver: Receiver | None = None  # None: no callback is made
        self._ears: _Ears | None = None  # those of the present link; others are not listened to any more
        self._was_opened = self._is_closed = self._is_up = False
        self._lost_at: float | None = None  # None: it is not away, as far as anybody was told
        self._reopening: asyncio.Task[None] | None = None
        self._steady: asyncio.TimerHandle | None = None
        self._dropped = 0

    @property
    def address(self) -> str:  # type: ignore[override]
        """That of the present link."""
        return self._link.address

    @property
    def dropped_writes(self) -> int:  # type: ignore[override]
        """What all its links dropped, and what was written while there was none."""
        return self._dropped + self._link.dropped_writes

    @property
    def tells_bursts(self) -> bool:
        """See `Link.tells_bursts`."""
        return self._link.tells_bursts

    @property
    def unsent_bytes(self) -> int:
        """See `Link.unsent_bytes`; nothing of a link that was lost waits any more."""
        return self._link.unsent_bytes if self._is_up else 0

    def unsent_bytes_to(self, peer: Peer) -> int:
        """See `Link.unsent_bytes_to`."""
        return self._link.unsent_bytes_to(peer) if self._is_up else 0

    def discard_unsent(self) -> None:
        """See `Link.discard_unsent`."""
        if self._is_up:
            self._link.discard_unsent()

    @property
    def is_away(self) -> bool:
        """Whether it was lost and is not back yet."""
        return self._lost_at is not None

    async def open(self, receiver: Receiver) -> None:
        """See `Link.open`."""
        if self._is_closed:
            raise ConnectionClosed(f"{self.address} was closed; make a new link to open it again")
        if self._was_opened:
            raise BusyError(f"{self.address} is open; a link is opened once")
        self._was_opened, self._receiver = True, receiver
        self._ears = ears = _Ears(self)
        try:
            await self._link.open(ears)
        except BaseException:
            self._end_reopening()
            self._receiver = self._ears = self._lost_at = None
            self._was_opened = False
            raise
        self._is_up = not ears.is_lost

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`."""
        if self._is_up:
            self._link.write(data, peer)
        elif self._receiver is not None:
            self._dropped += 1

    def keep_peer(self, peer: Peer) -> None:
        """See `Link.keep_peer`."""
        self._link.keep_peer(peer)

    def forget_peer(self, peer: Peer) -> None:
        """See `Link.forget_peer`."""
        self._link.forget_peer(peer)

    def host_of(self, peer: Peer) -> object:
        """See `Link.host_of`."""
        return self._link.host_of(peer)

    def has_peer(self, peer: Peer) -> bool:
        """See `Link.has_peer`."""
        return self._is_up and self._link.has_peer(peer)

    def reopen(self) -> None:
        """Close the present link and open it again, as if it had been lost; nothing happens while it is away."""
        if self._ears is not None and self._is_up:
            self._link.close()
            self._lost(self._ears, LinkLost(f"{self.address} was closed to be opened again"))

    def close(self) -> None:
        """See `Link.close`."""
        if not self._is_closed:
            self._is_closed, self._is_up = True, False
            self._receiver = self._ears = None
            self._end_reopening()
            self._link.close()

    async def wait_closed(self) -> None:
        """See `Link.wait_closed`."""
        if self._reopening is not None:
            await asyncio.wait([self._reopening])
        await self._link.wait_closed()

    # ------------------------------------------------------------------------ what the present link says

    def _heard(self, ears: _Ears, data: bytes, peer: Peer) -> None:
        if ears is self._ears and self._lost_at is not None:
            self._is_up = True
            self._is_back()
        if ears is self._ears and self._receiver is not None:
            self._receiver.bytes_received(data, peer)

    def _listener_of(self, ears: _Ears) -> DrainListener | None:
        is_present = ears is self._ears and isinstance(self._receiver, DrainListener)
        return self._receiver if is_present else None  # type: ignore[return-value]

    def _lost(self, ears: _Ears, error: LinkLost) -> None:
        if ears is not self._ears:
            return
        self._is_up = False
        self._cancel_steady()
        if isinstance(error, RecordingEnded):
            self._end(error)
            return
        if self._lost_at is None:
            self._lost_at = asyncio.get_running_loop().time()
            logger.warning("%s; trying to open it again", error)
            if isinstance(self._receiver, Interruptible):
                self._receiver.link_interrupted(error)
        if self._reopening is None and self._receiver is not None:  # it was not closed just now
            self._reopening = asyncio.get_running_loop().create_task(self._reopen(), name="aerokit reopening")

    # ------------------------------------------------------------------------------- opening it again

    async def _reopen(self) -> None:
        try:
            while not await self._try_again():
                pass
        except Exception as error:  # no link would come of further attempts
            lost = LinkLost(f"{self.address} cannot be opened again: {error}")
            lost.__cause__ = error
            self._end(lost)
        finally:
            self._reopening = None

    async def _try_again(self) -> bool:
        await self._link.wait_closed()
        await asyncio.sleep(self._delays.take())
        link = self._make_link()
        self._dropped += self._link.dropped_writes
        self._link = link
        self._ears = ears = _Ears(self)
        try:
            await link.open(ears)
        except OSError as error:
            logger.debug("not yet: %s", error)
            return False
        if ears.is_lost:
            return self._receiver is None
        self._is_up = True
        if self._lost_at is not None:
            self._steady = asyncio.get_running_loop().call_later(STEADY_S, self._is_back)
        return True

    def _is_back(self) -> None:
        self._cancel_steady()
        if self._lost_at is None:
            return
        away_s, self._lost_at = asyncio.get_running_loop().time() - self._lost_at, None
        self._delays.begin_anew()
        logger.info("%s is back after %.1f s", self.address, away_s)
        if isinstance(self._receiver, Interruptible):
            self._receiver.link_restored(away_s)

    def _end(self, error: LinkLost) -> None:
        """It will not come back."""
        receiver, self._receiver, self._ears = self._receiver, None, None
        if receiver is not None:
            receiver.link_lost(error)

    def _end_reopening(self) -> None:
        self._cancel_steady()
        if self._reopening is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._reopening.cancel()

    def _cancel_steady(self) -> None:
        if self._steady is not None:
            self._steady.cancel()
            self._steady = None


class _Ears:
    """What one link calls."""

    def __init__(self, owner: ReconnectingLink) -> None:
        self._owner = owner
        self.keeps_peers = owner._receiver is not None and keeps_peers(owner._receiver)
        receiver = owner._receiver
        self._burst_listener = receiver if isinstance(receiver, BurstListener) else None
        self.is_lost = False

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self._owner._heard(self, data, peer)

    def link_stalled(self, unsent_bytes: int) -> None:
        if listener := self._owner._listener_of(self):
            listener.link_stalled(unsent_bytes)

    def link_drained(self, stalled_s: float) -> None:
        if listener := self._owner._listener_of(self):
            listener.link_drained(stalled_s)

    def order_refused(self, message: str, reason: str, helm: str | None, answers: tuple[bytes, ...]) -> None:
        receiver = self._owner._receiver
        if self is self._owner._ears and isinstance(receiver, HelmListener):
            receiver.order_refused(message, reason, helm, answers)

    def burst_ended(self) -> None:
        if (
            self._burst_listener is not None
            and self is self._owner._ears
            and self._owner._receiver is not None
        ):
            self._burst_listener.burst_ended()

    def peer_joined(self, peer: Peer) -> None:
        if listener := self._peer_listener():
            listener.peer_joined(peer)

    def peer_left(self, peer: Peer) -> None:
        if listener := self._peer_listener():
            listener.peer_left(peer)

    def _peer_listener(self) -> PeerListener | None:
        receiver = self._owner._receiver if self is self._owner._ears else None
        return receiver if isinstance(receiver, PeerListener) else None

    def link_lost(self, error: LinkLost) -> None:
        self.is_lost = True
        self._owner._lost(self, error)
