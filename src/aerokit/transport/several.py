"""`SeveralLinks`: links that lead to the same vehicles, as one: a radio and a modem, two radios, a cable and WiFi.

It carries bytes over each of them and says over which: who takes what, and over which of them orders go, is decided
by the connection (:mod:`aerokit.connection.multilink.routes`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from aerokit.errors import BusyError, ConnectionClosed, InvalidArgument, LinkLost, LinkOpenError
from aerokit.transport.link import HelmListener, Link, Peer, Receiver, keeps_peers
from aerokit.transport.reconnecting import Delays, Interruptible

logger: logging.Logger = logging.getLogger("aerokit")


class LinkPeer(NamedTuple):
    """A peer behind one of several links."""

    link: int
    """Which of them, from 0."""
    peer: Peer
    """By that link's own reckoning; None: everybody there."""


@runtime_checkable
class OneOfSeveralListener(Receiver, Protocol):
    """A receiver that wants to be told what becomes of each link."""

    def one_link_changed(self, link: int, is_there: bool) -> None:
        """A link has gone, or is there again."""

    def one_link_stalled(self, link: int, is_stalled: bool) -> None:
        """What is written to a link does not leave, or leaves again."""

    def one_link_not_opened(self, link: int, error: LinkOpenError) -> None:
        """A link could not be opened at first, nor at the second attempt; it is tried again. Told once."""


class SeveralLinks(Link):
    """Opens all of them; one that cannot be opened is tried again, as long as there is another one.

    It is lost when all of them are away at once (``stays``: then it is interrupted, until the first is back).

    Args:
        make_links: gives each link, from 0 on; called once for each attempt to open it the first time.
        costly: which of them are used only when the others fail.
        stays: whether it outlives that all of them are away.
    """

    is_several = True

    def __init__(
        self, make_links: Sequence[Callable[[], Link]], *, costly: Collection[int] = (), stays: bool = False
    ) -> None:
        if not make_links:
            raise InvalidArgument("several links: none was given")
        wrong = [index for index in costly if not 0 <= index < len(make_links)]
        if wrong:
            raise InvalidArgument(
                f"costly = {wrong} is not allowed: there are links 0 to {len(make_links) - 1}"
            )
        self.costly: frozenset[int] = frozenset(costly)
        """Which of them are used only when the others fail."""
        self._make_links = tuple(make_links)
        self._links = [make() for make in make_links]
        self._stays = stays
        self._receiver: Receiver | None = None
        self._was_opened = self._is_closed = False
        self._is_there = [False] * len(self._links)
        self._kept: list[set[Peer]] = [set() for _ in self._links]
        self._openings: set[asyncio.Task[None]] = set()
        self._strange: set[int] = set()  # in use elsewhere: not ours to close
        self._is_opening = False
        self._last_loss: LinkLost | None = None
        self._lost_at: float | None = None
        self._dropped = 0

    @property
    def address(self) -> str:  # type: ignore[override]
        """``udpin:0.0.0.0:14550 + serial:///dev/ttyUSB0:57600``."""
        return " + ".join(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """The address of each link."""
        return tuple(link.address for link in self._links)

    @property
    def dropped_writes(self) -> int:  # type: ignore[override]
        """What all of them dropped."""
        return self._dropped + sum(link.dropped_writes for link in self._links)

    @property
    def unsent_bytes(self) -> int:
        """See `Link.unsent_bytes`."""
        return sum(link.unsent_bytes for link in self._links)

    def discard_unsent(self) -> None:
        """See `Link.discard_unsent`."""
        for link in self._links:
            link.discard_unsent()

    def discard_unsent_of(self, link: int) -> None:
        """Take back what waits in one of them: what is ordered now goes over another one."""
        self._links[link].discard_unsent()

    def is_there(self, link: int) -> bool:
        """Whether one of them is open, and not away."""
        return self._is_there[link]

    async def open(self, receiver: Receiver) -> None:
        """See `Link.open`; LinkOpenError when none of them can be opened, with the reason of each."""
        if self._is_closed:
            raise ConnectionClosed(f"{self.address} was closed; make a new link to open it again")
        if self._was_opened:
            raise BusyError(f"{self.address} is open; a link is opened once")
        self._was_opened, self._receiver = True, receiver
        self._strange.clear()
        self._is_opening, self._last_loss = True, None
        openings = [asyncio.ensure_future(self._open_one(index)) for index in range(len(self._links))]
        try:
            results = await asyncio.gather(*openings)
            if all(results):
                raise LinkOpenError("none of the links can be opened: " + "; ".join(map(str, results)))
        except BaseException:
            await self._give_up_opening(openings)
            raise
        finally:
            self._is_opening = False
        for index, failure in enumerate(results):
            if failure is not None and not self._is_closed:
                logger.warning("one of several links cannot be opened, and is tried again: %s", failure)
                self._begin_opening(index)
        self._look_whether_any_is_there()

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; None writes to every peer of every link."""
        if isinstance(peer, LinkPeer):
            self._write_to(peer.link, data, peer.peer)
            return
        for index in range(len(self._links)):
            self._write_to(index, data, None)

    def keep_peer(self, peer: Peer) -> None:
        """See `Link.keep_peer`."""
        if isinstance(peer, LinkPeer):
            self._kept[peer.link].add(peer.peer)
            self._links[peer.link].keep_peer(peer.peer)

    def forget_peer(self, peer: Peer) -> None:
        """See `Link.forget_peer`."""
        if isinstance(peer, LinkPeer):
            self._kept[peer.link].discard(peer.peer)
            self._links[peer.link].forget_peer(peer.peer)

    def host_of(self, peer: Peer) -> object:
        """See `Link.host_of`."""
        return self._links[peer.link].host_of(peer.peer) if isinstance(peer, LinkPeer) else peer

    def has_peer(self, peer: Peer) -> bool:
        """See `Link.has_peer`."""
        if not isinstance(peer, LinkPeer):
            return True
        return self._is_there[peer.link] and self._links[peer.link].has_peer(peer.peer)

    def close(self) -> None:
        """See `Link.close`."""
        if not self._is_closed:
            self._is_closed, self._receiver = True, None
            for task in self._openings:
                with contextlib.suppress(RuntimeError):  # the loop is closed
                    task.cancel()
            for link in self._own:
                link.close()

    async def wait_closed(self) -> None:
        """See `Link.wait_closed`."""
        if self._openings:
            await asyncio.wait(tuple(self._openings))
        for link in self._own:
            await link.wait_closed()

    @property
    def _own(self) -> list[Link]:
        return [link for index, link in enumerate(self._links) if index not in self._strange]

    # ------------------------------------------------------------------------------- opening

    async def _open_one(self, index: int) -> LinkOpenError | None:
        ears = _Ears(self, index)
        try:
            await self._links[index].open(ears)
        except LinkOpenError as error:
            return error
        except BusyError:
            self._strange.add(index)
            raise
        if not ears.is_away:
            self._back(index)
        return None

    async def _give_up_opening(self, openings: Collection[asyncio.Future[LinkOpenError | None]]) -> None:
        self._receiver = None
        for opening in openings:
            opening.cancel()
        await asyncio.wait(openings)
        for link in self._own:
            link.close()
        for index, make_link in enumerate(self._make_links):
            if index not in self._strange:
                self._links[index] = make_link()
        self._is_there = [False] * len(self._links)
        self._was_opened = False

    def _begin_opening(self, index: int) -> None:
        task = asyncio.get_running_loop().create_task(self._open_late(index), name="aerokit opening")
        self._openings.add(task)
        task.add_done_callback(self._openings.discard)

    async def _open_late(self, index: int) -> None:
        delays, is_told = Delays(), False
        while not self._is_closed:
            await asyncio.sleep(delays.take())
            error = await self._open_one(index)
            if error is None:
                return
            logger.debug("not yet: %s", error)
            # Not at the first attempt: whoever opens them could not listen yet.
            if not is_told and isinstance(self._receiver, OneOfSeveralListener):
                is_told = True
                self._receiver.one_link_not_opened(index, error)

    # ------------------------------------------------------------------- what one of them says

    def _heard(self, index: int, data: bytes, peer: Peer) -> None:
        if self._receiver is not None:
            self._receiver.bytes_received(data, LinkPeer(index, peer))

    def _gone(self, index: int, error: LinkLost) -> None:
        self._is_there[index] = False
        self._tell(index)
        self._last_loss = error
        self._look_whether_any_is_there()

    def _look_whether_any_is_there(self) -> None:
        receiver, error = self._receiver, self._last_loss
        if error is None or receiver is None or self._is_opening:
            return
        if any(self._is_there) or self._lost_at is not None:
            return
        if self._stays and self._may_come_back:
            self._lost_at = asyncio.get_running_loop().time()
            if isinstance(receiver, Interruptible):
                receiver.link_interrupted(error)
            return
        self._receiver = None
        lost = LinkLost(f"all links are away; the last: {error}")
        lost.__cause__ = error
        receiver.link_lost(lost)

    def _back(self, index: int) -> None:
        self._is_there[index] = True
        for peer in self._kept[index]:
            self._links[index].keep_peer(peer)
        self._tell(index)
        if self._lost_at is not None:
            away_s, self._lost_at = asyncio.get_running_loop().time() - self._lost_at, None
            if isinstance(self._receiver, Interruptible):
                self._receiver.link_restored(away_s)

    def _stalled(self, index: int, is_stalled: bool) -> None:
        if isinstance(self._receiver, OneOfSeveralListener):
            self._receiver.one_link_stalled(index, is_stalled)

    def _tell(self, index: int) -> None:
        if isinstance(self._receiver, OneOfSeveralListener):
            self._receiver.one_link_changed(index, self._is_there[index])

    @property
    def _may_come_back(self) -> bool:
        from aerokit.transport.reconnecting import ReconnectingLink

        return bool(self._openings) or any(isinstance(link, ReconnectingLink) for link in self._links)

    def _write_to(self, index: int, data: bytes, peer: Peer) -> None:
        if self._is_there[index]:
            self._links[index].write(data, peer)
        elif self._receiver is not None:
            self._dropped += 1


class _Ears:
    """What one of the links calls."""

    def __init__(self, owner: SeveralLinks, index: int) -> None:
        self._owner, self._index = owner, index
        self.keeps_peers = owner._receiver is not None and keeps_peers(owner._receiver)
        self.is_away = False

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self._owner._heard(self._index, data, peer)

    def link_stalled(self, unsent_bytes: int) -> None:
        self._owner._stalled(self._index, True)

    def link_drained(self, stalled_s: float) -> None:
        self._owner._stalled(self._index, False)

    def order_refused(self, message: str, reason: str, helm: str | None, answers: tuple[bytes, ...]) -> None:
        if isinstance(self._owner._receiver, HelmListener):
            self._owner._receiver.order_refused(message, reason, helm, answers)

    def link_interrupted(self, error: LinkLost) -> None:
        self.is_away = True
        self._owner._gone(self._index, error)

    def link_restored(self, away_s: float) -> None:
        self.is_away = False
        self._owner._back(self._index)

    def link_lost(self, error: LinkLost) -> None:
        self.is_away = True
        self._owner._gone(self._index, error)
