"""``Line``: what ``vehicle._master`` needs of the connection that it belongs to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.links.link import Peer
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.runtime.connection import Connection
    from aerokit.sync.loop_thread import LoopThread

__all__ = ["Line", "Steered"]


class Steered(Protocol):
    """The vehicle at its end."""

    mode: Any

    @property
    def parameters(self) -> Any:
        """The autopilot's parameters."""


class Line(Protocol):
    """A ``MAVConnection``, seen from there."""

    connection: Connection
    loop: LoopThread
    target_system: int
    vehicle: Steered | None

    @property
    def is_closed(self) -> bool:
        """Whether the program has closed it."""
        ...

    def send(self, message: Message, *, to: int | None = None) -> None:
        """Send a message."""

    def tap(self, sink: Callable[[Frame, Peer], None]) -> None:
        """Hear every frame."""

    def is_of_another_vehicle(self, system_id: int) -> bool:
        """Whether this system is neither the vehicle nor one without an autopilot."""
        ...

    def close(self) -> None:
        """Close it."""
