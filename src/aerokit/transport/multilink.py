"""``MultiLink``: several links to the same vehicles as one, e.g. a radio and a modem.

It only transports bytes. The connection selects the link for each message and merges received frames
(:mod:`aerokit.connection.multilink.routes`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from aerokit.errors import BusyError, ConnectionClosed, InvalidArgument, LinkLost, LinkOpenError
from aerokit.transport.link import Link, OrderRefusalListener, Peer, Receiver, keeps_peers
from aerokit.transport.reconnecting import Backoff, InterruptionListener, ReconnectingLink

logger: logging.Logger = logging.getLogger("aerokit")


class LinkPeer(NamedTuple):
    """A peer of a `MultiLink`: one of the links, and a peer of this link."""

    link: int
    """Index of the link."""
    peer: Peer
    """Peer of that link; None stands for all of its peers."""


@runtime_checkable
class MemberLinkListener(Receiver, Protocol):
    """A receiver that is notified of the state of each link."""

    def member_link_changed(self, link: int, is_available: bool) -> None:
        """Called when a link was lost or is available again."""

    def member_link_stalled(self, link: int, is_stalled: bool) -> None:
        """Called when data written to a link has stopped leaving, or leaves again."""

    def member_link_open_failed(self, link: int, error: LinkOpenError) -> None:
        """Called once per link, when the first two attempts to open it have failed; further attempts follow."""


class MultiLink(Link):
    """Several links to the same vehicles. If at least one can be opened, the others are retried.

    Args:
        factories: functions that create the links, called for the first and every later attempt to open them.
        costly: indices of links that are used only when the others fail.
        survives_loss: what happens when all links are lost. True keeps this link open, reports an interruption and
            reopens the links as soon as possible. False reports this link as lost for good.
    """

    is_multilink = True

    def __init__(
        self,
        factories: Sequence[Callable[[], Link]],
        *,
        costly: Collection[int] = (),
        survives_loss: bool = False,
    ) -> None:
        if not factories:
            raise InvalidArgument("factories = [] is not allowed: at least one link is needed")
        unknown_links = [index for index in costly if not 0 <= index < len(factories)]
        if unknown_links:
            raise InvalidArgument(f"costly = {unknown_links} is not allowed: the indices are 0 to {len(factories) - 1}")
        self.costly: frozenset[int] = frozenset(costly)
        """Indices of links that are used only when the others fail."""
        self._members = [_Member(self, index, make_link) for index, make_link in enumerate(factories)]
        self._survives_loss = survives_loss
        self._receiver: Receiver | None = None  # None before open() and after the end; no callback is called then
        self._was_opened = self._is_closed = False
        self._openings: set[asyncio.Task[None]] = set()  # tasks that retry links which could not be opened
        self._is_opening = False  # True while open() runs
        self._last_loss: LinkLost | None = None  # last loss of any link since the opening
        self._lost_at: float | None = None  # time since which all links are lost; None while one is available
        self._dropped = 0  # number of writes dropped here because their link was not available

    @property
    def address(self) -> str:  # type: ignore[override]
        """The addresses of all links: ``udpin:0.0.0.0:14550 + serial:///dev/ttyUSB0:57600``."""
        return " + ".join(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """The address of each link."""
        return tuple(member.link.address for member in self._members)

    @property
    def dropped_writes(self) -> int:  # type: ignore[override]
        """Sum of `Link.dropped_writes` over all links, and the writes that no link could take."""
        return self._dropped + sum(member.link.dropped_writes for member in self._members)

    @property
    def unsent_bytes(self) -> int:
        return sum(member.link.unsent_bytes for member in self._members)

    def discard_unsent(self) -> None:
        for member in self._members:
            member.link.discard_unsent()

    def discard_unsent_of(self, link: int) -> None:
        """Discard unsent data of one link, so that it does not arrive after commands over another link."""
        self._members[link].link.discard_unsent()

    def is_available(self, link: int) -> bool:
        """Return True if the link with this index is open."""
        return self._members[link].is_available

    async def open(self, receiver: Receiver) -> None:
        """See `Link.open`. Raises LinkOpenError with the reason of every link if no link can be opened."""
        if self._is_closed:
            raise ConnectionClosed(f"{self.address} was closed; make a new link to open it again")
        if self._was_opened:
            raise BusyError(f"{self.address} was already opened; a link can be opened only once")
        self._was_opened, self._receiver = True, receiver
        self._is_opening, self._last_loss = True, None
        openings = [asyncio.ensure_future(member.open()) for member in self._members]
        try:
            failures = await asyncio.gather(*openings)  # None for each link that was opened
            if None not in failures:
                raise LinkOpenError("no link can be opened: " + "; ".join(map(str, failures)))
        except BaseException:
            await self._abort_opening(openings)
            raise
        finally:
            self._is_opening = False
        for member, failure in zip(self._members, failures, strict=True):
            if failure is not None and not self._is_closed:
                logger.warning("one of several links cannot be opened and is retried: %s", failure)
                self._start_opening(member)
        self._check_all_lost()  # A link may have been lost while others were still being opened.

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; None writes to every peer of every link."""
        if isinstance(peer, LinkPeer):
            self._write_to(self._members[peer.link], data, peer.peer)
            return
        for member in self._members:
            self._write_to(member, data, None)

    def keep_peer(self, peer: Peer) -> None:
        if isinstance(peer, LinkPeer):
            self._members[peer.link].kept_peers.add(peer.peer)
            self._members[peer.link].link.keep_peer(peer.peer)

    def forget_peer(self, peer: Peer) -> None:
        if isinstance(peer, LinkPeer):
            self._members[peer.link].kept_peers.discard(peer.peer)
            self._members[peer.link].link.forget_peer(peer.peer)

    def host_of(self, peer: Peer) -> object:
        return self._members[peer.link].link.host_of(peer.peer) if isinstance(peer, LinkPeer) else peer

    def has_peer(self, peer: Peer) -> bool:
        if not isinstance(peer, LinkPeer):
            return True
        member = self._members[peer.link]
        return member.is_available and member.link.has_peer(peer.peer)

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed, self._receiver = True, None
            for task in self._openings:
                with contextlib.suppress(RuntimeError):  # The loop may be closed.
                    task.cancel()
            for link in self._own_links:
                link.close()

    async def wait_closed(self) -> None:
        if self._openings:
            await asyncio.wait(tuple(self._openings))
        for link in self._own_links:
            await link.wait_closed()

    @property
    def _own_links(self) -> list[Link]:
        return [member.link for member in self._members if member.owns_link]

    # ------------------------------------------------------------------------------- opening

    async def _abort_opening(self, openings: Collection[asyncio.Future[LinkOpenError | None]]) -> None:
        self._receiver = None
        for opening in openings:
            opening.cancel()
        try:
            await asyncio.wait(openings)
        finally:  # In a cancelled anyio scope, wait() raises at once.
            for link in self._own_links:
                link.close()
            for member in self._members:
                member.replace_link()
            self._was_opened = False

    def _start_opening(self, member: _Member) -> None:
        task = asyncio.get_running_loop().create_task(self._retry_opening(member), name="aerokit opening")
        self._openings.add(task)
        task.add_done_callback(self._openings.discard)

    async def _retry_opening(self, member: _Member) -> None:
        backoff = Backoff()
        is_reported = False
        while not self._is_closed:
            await asyncio.sleep(backoff.next_delay())
            try:
                error = await member.open()
            except Exception as failure:  # e.g. another connection has opened the link meanwhile
                logger.warning("one of several links is given up: %s", failure)
                return
            if error is None:
                return
            logger.debug("the link still cannot be opened: %s", error)
            # Only the first failed retry is reported: open() failed before the program could subscribe to events.
            if not is_reported and isinstance(self._receiver, MemberLinkListener):
                is_reported = True
                self._receiver.member_link_open_failed(member.index, error)

    # ------------------------------------------------------------ callbacks of the links

    def _on_lost(self, member: _Member, error: LinkLost) -> None:
        self._notify_availability(member)
        self._last_loss = error
        self._check_all_lost()

    def _check_all_lost(self) -> None:
        """If no link is available, report an interruption or a loss."""
        receiver, error = self._receiver, self._last_loss
        # No link was lost, this link has ended, or open() calls this method again at its end.
        if error is None or receiver is None or self._is_opening:
            return
        is_reported = self._lost_at is not None
        if is_reported or any(member.is_available for member in self._members):
            return
        if self._survives_loss and self._may_come_back:
            self._lost_at = asyncio.get_running_loop().time()
            if isinstance(receiver, InterruptionListener):
                receiver.link_interrupted(error)
            return
        self._receiver = None
        for task in self._openings:
            task.cancel()
        lost = LinkLost(f"all links are lost; the last error: {error}")
        lost.__cause__ = error
        receiver.link_lost(lost)

    def _on_restored(self, member: _Member) -> None:
        self._notify_availability(member)
        if self._lost_at is not None:
            away_s = asyncio.get_running_loop().time() - self._lost_at
            self._lost_at = None
            if isinstance(self._receiver, InterruptionListener):
                self._receiver.link_restored(away_s)

    def _on_stalled(self, index: int, is_stalled: bool) -> None:
        if isinstance(self._receiver, MemberLinkListener):
            self._receiver.member_link_stalled(index, is_stalled)

    def _notify_availability(self, member: _Member) -> None:
        if isinstance(self._receiver, MemberLinkListener):
            self._receiver.member_link_changed(member.index, member.is_available)

    @property
    def _may_come_back(self) -> bool:
        return bool(self._openings) or any(isinstance(member.link, ReconnectingLink) for member in self._members)

    def _write_to(self, member: _Member, data: bytes, peer: Peer) -> None:
        if member.is_available:
            member.link.write(data, peer)
        elif self._receiver is not None:
            self._dropped += 1


class _Member:
    """One link of a `MultiLink`, and the receiver of its callbacks."""

    def __init__(self, owner: MultiLink, index: int, make_link: Callable[[], Link]) -> None:
        self._owner, self._make_link = owner, make_link
        self.index = index
        self.link = make_link()
        self.is_available = False  # True while the link is open
        self.owns_link = True  # False if another connection has opened the link, which must not be closed here
        self.kept_peers: set[Peer] = set()  # After a reopening, `keep_peer` is called again for them.
        self.keeps_peers = False  # see `PeerKeeper`
        self._is_lost = False

    async def open(self) -> LinkOpenError | None:
        """Open the link. Return an error after which another attempt may succeed, None after a success."""
        receiver = self._owner._receiver
        self.keeps_peers = receiver is not None and keeps_peers(receiver)
        self._is_lost, self.owns_link = False, True
        try:
            await self.link.open(self)
        except LinkOpenError as error:
            return error
        except BusyError:  # The given link object is already used by another connection.
            self.owns_link = False
            raise
        if not self._is_lost:
            self._set_available()
        return None

    def replace_link(self) -> None:
        """Make a new link, because a closed link cannot be opened again."""
        if self.owns_link:
            self.link = self._make_link()
        self.is_available = False

    def _set_available(self) -> None:
        self.is_available = True
        for peer in self.kept_peers:
            self.link.keep_peer(peer)
        self._owner._on_restored(self)

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        if self._owner._receiver is not None:
            self._owner._receiver.bytes_received(data, LinkPeer(self.index, peer))

    def link_stalled(self, unsent_bytes: int) -> None:
        self._owner._on_stalled(self.index, True)

    def link_drained(self, stalled_s: float) -> None:
        self._owner._on_stalled(self.index, False)

    def order_refused(self, message: str, reason: str, lease_holder: str | None, answers: tuple[bytes, ...]) -> None:
        if isinstance(self._owner._receiver, OrderRefusalListener):
            self._owner._receiver.order_refused(message, reason, lease_holder, answers)

    def link_interrupted(self, error: LinkLost) -> None:
        self.link_lost(error)

    def link_restored(self, away_s: float) -> None:
        self._is_lost = False
        self._set_available()

    def link_lost(self, error: LinkLost) -> None:
        self._is_lost, self.is_available = True, False
        self._owner._on_lost(self, error)
