"""``WatchedStream``: requests a message from the autopilot while a cell is watched."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.cells import StateCell
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.session.rates import MessageRates


class WatchedStream:
    """Feed of a cell whose message is not requested by default: it is while your program waits for it or follows it.

    Reading the cell requests nothing.
    """

    pending = False

    def __init__(self, cell: StateCell[Any], rates: MessageRates, message: type[Message], hz: float) -> None:
        self._cell, self._rates, self._message, self._hz = cell, rates, message, hz
        self._release: Callable[[], None] | None = None

    def catch_up(self) -> None:
        """Do nothing: another feed decodes the message."""

    def watchers_changed(self) -> None:
        """Request the message while the cell is watched."""
        if not self._cell._is_watched:
            if self._release is not None:
                self._release()
            self._release = None
        elif self._release is None:
            self._release = self._rates.request(self._message, self._hz, is_optional=True)
