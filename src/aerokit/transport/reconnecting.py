"""``ReconnectingLink``: a link that is reopened whenever it is lost, until it is closed.

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
    Link,
    OrderRefusalListener,
    Peer,
    PeerListener,
    Receiver,
    keeps_peers,
)

MIN_RETRY_DELAY_S = 0.2

MAX_RETRY_DELAY_S = 5.0


class Backoff:
    """Delays between attempts, doubled each time: by default 0.2 s, 0.4 s, … 5 s."""

    def __init__(self, min_s: float = MIN_RETRY_DELAY_S, max_s: float = MAX_RETRY_DELAY_S) -> None:
        self._min_s, self._max_s = min_s, max_s
        self._next_s = min_s

    def next_delay(self) -> float:
        delay_s = self._next_s
        self._next_s = min(2 * delay_s, self._max_s)
        return delay_s

    def reset(self) -> None:
        self._next_s = self._min_s


logger: logging.Logger = logging.getLogger("aerokit")

STABLE_AFTER_S = 1.0
"""A reopened link counts as restored when bytes arrive, or when it has been open for this time."""


@runtime_checkable
class InterruptionListener(Receiver, Protocol):
    """A receiver that is notified when its link is lost and restored."""

    def link_interrupted(self, error: LinkLost) -> None:
        """Called when the link was lost and is being reopened."""

    def link_restored(self, away_s: float) -> None:
        """Called when the link is open again after ``away_s`` seconds. A new byte stream starts."""


class ReconnectingLink(Link):
    """Link that is reopened after a loss, with increasing delays of 0.2 s to 5 s, until it is closed.

    The first opening is not retried. ``link_lost`` is called only at the end of a recording, and if ``make_link``
    raises. Data written while the link is lost is dropped and counted in `dropped_writes`. Each loss is logged as
    WARNING, each recovery as INFO. A reopened link counts as recovered when bytes arrive or when it has been open for
    1 s, because a server may close each connection just after accepting it.

    ``make_link`` is called at once and for each attempt, and must return a new link each time.
    """

    def __init__(
        self,
        make_link: Callable[[], Link],
        *,
        min_delay_s: float = MIN_RETRY_DELAY_S,
        max_delay_s: float = MAX_RETRY_DELAY_S,
    ) -> None:
        self._make_link = make_link
        self._link = make_link()
        self._backoff = Backoff(min_delay_s, max_delay_s)
        self._receiver: Receiver | None = None  # None before open() and after the end; no callback is called then
        self._current: _CurrentReceiver | None = None  # receiver of the current link; earlier links are ignored
        self._was_opened = self._is_closed = False
        self._is_up = False  # True while the current link is open
        self._lost_at: float | None = None  # time of the reported loss; None while no loss is reported
        self._reopening: asyncio.Task[None] | None = None  # None while no attempt is running or due
        self._stable_timer: asyncio.TimerHandle | None = None  # runs after a reopening, until the link counts as stable
        self._dropped = 0  # writes dropped by earlier links, and while the link was lost

    @property
    def address(self) -> str:  # type: ignore[override]
        return self._link.address

    @property
    def dropped_writes(self) -> int:  # type: ignore[override]
        """See `Link.dropped_writes`; includes earlier links, and writes while the link was lost."""
        return self._dropped + self._link.dropped_writes

    @property
    def reports_bursts(self) -> bool:
        return self._link.reports_bursts

    @property
    def unsent_bytes(self) -> int:
        """See `Link.unsent_bytes`; 0 while the link is lost."""
        return self._link.unsent_bytes if self._is_up else 0

    def unsent_bytes_to(self, peer: Peer) -> int:
        return self._link.unsent_bytes_to(peer) if self._is_up else 0

    def discard_unsent(self) -> None:
        if self._is_up:
            self._link.discard_unsent()

    @property
    def is_away(self) -> bool:
        """True while the link is lost."""
        return self._lost_at is not None

    async def open(self, receiver: Receiver) -> None:
        """See `Link.open`. After a failure, the link may be opened again."""
        if self._is_closed:
            raise ConnectionClosed(f"{self.address} was closed; make a new link to open it again")
        if self._was_opened:
            raise BusyError(f"{self.address} was already opened; a link can be opened only once")
        self._was_opened, self._receiver = True, receiver
        self._current = current = _CurrentReceiver(self)
        try:
            await self._link.open(current)
        except BaseException:
            self._cancel_reopening()  # A reopening runs if the link was lost while it was being opened.
            self._receiver = self._current = self._lost_at = None
            self._was_opened = False
            raise
        self._is_up = not current.is_lost

    def write(self, data: bytes, peer: Peer = None) -> None:
        if self._is_up:
            self._link.write(data, peer)
        elif self._receiver is not None:
            self._dropped += 1

    def keep_peer(self, peer: Peer) -> None:
        self._link.keep_peer(peer)

    def forget_peer(self, peer: Peer) -> None:
        self._link.forget_peer(peer)

    def host_of(self, peer: Peer) -> object:
        return self._link.host_of(peer)

    def has_peer(self, peer: Peer) -> bool:
        return self._is_up and self._link.has_peer(peer)

    def reopen(self) -> None:
        """Close and reopen the current link, as if it had been lost. Does nothing while it is lost."""
        if self._current is not None and self._is_up:
            self._link.close()
            self._on_lost(self._current, LinkLost(f"{self.address} was closed to be reopened"))

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed, self._is_up = True, False
            self._receiver = self._current = None
            self._cancel_reopening()
            self._link.close()

    async def wait_closed(self) -> None:
        if self._reopening is not None:
            await asyncio.wait([self._reopening])
        await self._link.wait_closed()

    # ------------------------------------------------------------ callbacks of the current link

    def _on_bytes(self, current: _CurrentReceiver, data: bytes, peer: Peer) -> None:
        # The first bytes after a reopening show that the link is back.
        if current is self._current and self._lost_at is not None:
            self._is_up = True
            self._on_restored()
        # `link_restored` may have closed this link.
        if current is self._current and self._receiver is not None:
            self._receiver.bytes_received(data, peer)

    def _on_lost(self, current: _CurrentReceiver, error: LinkLost) -> None:
        if current is not self._current:  # This link was replaced already.
            return
        self._is_up = False
        self._cancel_stable_timer()
        if isinstance(error, RecordingEnded):
            self._report_final_loss(error)
            return
        if self._lost_at is None:
            self._lost_at = asyncio.get_running_loop().time()
            logger.warning("%s; reopening it", error)
            if isinstance(self._receiver, InterruptionListener):
                self._receiver.link_interrupted(error)
        # `link_interrupted` may have closed this link.
        if self._reopening is None and self._receiver is not None:
            self._reopening = asyncio.get_running_loop().create_task(self._reopen(), name="aerokit reopening")

    # ----------------------------------------------------------------------- reopening

    async def _reopen(self) -> None:
        try:
            while not await self._try_to_open():
                pass
        except Exception as error:  # make_link() failed, or returned a link that can never be opened.
            lost = LinkLost(f"{self.address} cannot be reopened: {error}")
            lost.__cause__ = error
            self._report_final_loss(lost)
        finally:
            self._reopening = None

    async def _try_to_open(self) -> bool:
        """Wait, then try once to open a new link. Return True if no further attempt is needed."""
        await self._link.wait_closed()
        await asyncio.sleep(self._backoff.next_delay())
        link = self._make_link()
        self._dropped += self._link.dropped_writes
        self._link = link
        self._current = current = _CurrentReceiver(self)
        try:
            await link.open(current)
        except OSError as error:
            logger.debug("the link still cannot be opened: %s", error)
            return False
        if current.is_lost:  # The new link was lost while it was being opened.
            # `_receiver` is None if the loss has ended this link, too, because the new link is a recording at its end.
            return self._receiver is None
        self._is_up = True
        if self._lost_at is not None:
            self._stable_timer = asyncio.get_running_loop().call_later(STABLE_AFTER_S, self._on_restored)
        return True

    def _on_restored(self) -> None:
        self._cancel_stable_timer()
        if self._lost_at is None:
            return
        away_s = asyncio.get_running_loop().time() - self._lost_at
        self._lost_at = None
        self._backoff.reset()
        logger.info("%s is back after %.1f s", self.address, away_s)
        if isinstance(self._receiver, InterruptionListener):
            self._receiver.link_restored(away_s)

    def _report_final_loss(self, error: LinkLost) -> None:
        """Report that this link is lost for good. Nothing is called afterwards."""
        receiver, self._receiver, self._current = self._receiver, None, None
        if receiver is not None:
            receiver.link_lost(error)

    def _cancel_reopening(self) -> None:
        self._cancel_stable_timer()
        if self._reopening is not None:
            with contextlib.suppress(RuntimeError):  # The loop may be closed.
                self._reopening.cancel()

    def _cancel_stable_timer(self) -> None:
        if self._stable_timer is not None:
            self._stable_timer.cancel()
            self._stable_timer = None


class _CurrentReceiver:
    """Receiver of one link; forwards callbacks while that link is the current one."""

    def __init__(self, owner: ReconnectingLink) -> None:
        self._owner = owner
        receiver = owner._receiver
        self.keeps_peers = receiver is not None and keeps_peers(receiver)
        self._burst_listener = receiver if isinstance(receiver, BurstListener) else None
        self.is_lost = False

    @property
    def _receiver(self) -> Receiver | None:
        return self._owner._receiver if self is self._owner._current else None

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self._owner._on_bytes(self, data, peer)

    def link_stalled(self, unsent_bytes: int) -> None:
        if isinstance(receiver := self._receiver, DrainListener):
            receiver.link_stalled(unsent_bytes)

    def link_drained(self, stalled_s: float) -> None:
        if isinstance(receiver := self._receiver, DrainListener):
            receiver.link_drained(stalled_s)

    def order_refused(self, message: str, reason: str, lease_holder: str | None, answers: tuple[bytes, ...]) -> None:
        if isinstance(receiver := self._receiver, OrderRefusalListener):
            receiver.order_refused(message, reason, lease_holder, answers)

    def burst_ended(self) -> None:
        if self._burst_listener is not None and self._receiver is not None:
            self._burst_listener.burst_ended()

    def peer_joined(self, peer: Peer) -> None:
        if isinstance(receiver := self._receiver, PeerListener):
            receiver.peer_joined(peer)

    def peer_left(self, peer: Peer) -> None:
        if isinstance(receiver := self._receiver, PeerListener):
            receiver.peer_left(peer)

    def link_lost(self, error: LinkLost) -> None:
        self.is_lost = True
        self._owner._on_lost(self, error)
