"""``Connection`` for programs without ``async``: one link, for several vehicles."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from aerokit.arguments import checked
from aerokit.mavlink.dialect import STANDARD
from aerokit.runtime.connection import MAV_COMP_ID_MISSIONPLANNER
from aerokit.runtime.opening import open_connection as open_async
from aerokit.sync.blocking_block import BlockingBlock
from aerokit.sync.cells import StateCell
from aerokit.sync.loop_thread import LoopThread
from aerokit.sync.subscription import Subscription

if TYPE_CHECKING:
    import os
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.links.allowed import Peers
    from aerokit.links.link import Link
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.signing import Signing
    from aerokit.runtime.connection import Connection as AsyncConnection
    from aerokit.runtime.events import Event
    from aerokit.runtime.subscription import Overflow
    from aerokit.sync.loop_thread import Held

__all__ = ["Connection", "open_connection"]

ItemT = TypeVar("ItemT", bound="Message | Event")


@checked
def open_connection(
    address: str | Link,
    *,
    source_system: int = 255,
    source_component: int = MAV_COMP_ID_MISSIONPLANNER,
    baud: int = 57600,
    dialect: Dialect = STANDARD,
    mavlink_version: int = 2,
    signing: Signing | None = None,
    record: str | os.PathLike[str] | None = None,
    reconnect: bool = False,
    peers: Peers | None = None,
    may_move: bool = False,
) -> Connection:
    """Open a link and be a MAVLink node on it, on a loop thread of its own, until the connection is closed.

    Use it in a ``with`` block; arguments and errors are those of :func:`aerokit.open_connection`.
    """
    loop = LoopThread()
    try:
        held = loop.hold_open(
            open_async(
                address,
                source_system=source_system,
                source_component=source_component,
                baud=baud,
                dialect=dialect,
                mavlink_version=mavlink_version,
                signing=signing,
                record=record,
                reconnect=reconnect,
                peers=peers,
                may_move=may_move,
            )
        )
    except BaseException:
        loop.close()
        raise
    return Connection(loop, held.value, held)


class Connection(BlockingBlock):
    """One MAVLink node on one link; as :class:`aerokit.Connection`. A context manager."""

    _opened_by = "open_connection"

    def __init__(
        self, loop: LoopThread, connection: AsyncConnection, held: Held[AsyncConnection] | None = None
    ) -> None:
        self._loop, self._held = loop, held
        self.aio = connection
        """The asynchronous connection, for code that runs on the loop."""
        self.link_state = StateCell(loop, connection.link_state)
        """Whether frames come at all, from whomever; ``vehicle.link_state`` is about one vehicle."""

    def send(self, message: Message, *, to: int | None = None) -> None:
        """Number, frame and write a message; as :meth:`aerokit.Connection.send`."""
        self._loop.call(self.aio.send, message, to=to)

    def subscribe(
        self,
        *types: type[ItemT],
        system_id: int = 0,
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
    ) -> Subscription[ItemT]:
        """Return a stream of these messages or events, of one system (or of all: 0), for use in a ``with`` block."""
        return Subscription(
            self._loop,
            self.aio.subscribe(*types, system_id=system_id, capacity=capacity, overflow=overflow),
        )

    @property
    def signing(self) -> Signing | None:
        """What signs the frames that we send and checks those that we receive; None: neither."""
        return self.aio.signing

    @property
    def unsent_bytes(self) -> int:
        """Bytes that were sent and have not left this machine; as :attr:`aerokit.Connection.unsent_bytes`."""
        return self._loop.call(lambda: self.aio.unsent_bytes)

    def discard_unsent(self) -> None:
        """Take back what was sent and has not left; as :meth:`aerokit.Connection.discard_unsent`."""
        self._loop.call(self.aio.discard_unsent)

    @property
    def is_open(self) -> bool:
        """Whether messages can still be sent and received."""
        return self.aio.is_open

    def now(self) -> float:
        """Seconds on the loop's clock, the one that all ages and deadlines are measured on."""
        return self.aio.now()

    def counts(self, system_id: int) -> tuple[int, int]:
        """Frames of this system that were received, and frames that its sequence numbers say were lost."""
        return self._loop.call(self.aio.counts, system_id)

    def close(self) -> None:
        """End it, its link, its loop and its thread; idempotent. Calls that wait raise ConnectionClosed.

        The connection of a vehicle that was connected by an address is closed with the vehicle.
        """
        if self._held is not None:
            try:
                self._held.close()
            finally:
                self._loop.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
