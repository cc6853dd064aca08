"""``LinkStateWatch``: the way CONNECTED → SILENT → LOST of one link or vehicle, into its cell and as events."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.connection.cells import Source
from aerokit.events import SILENT_AFTER_S, LinkState, LinkStateChanged

if TYPE_CHECKING:
    from aerokit.connection.bus import Bus
    from aerokit.connection.cells import StateCell


class LinkStateWatch:
    """Is told what is heard, and looks from time to time for how long nothing was; times on the loop's clock."""

    # from heard() on
    _heard_at: float

    def __init__(
        self, cell: StateCell[LinkState], bus: Bus, *, system_id: int, component_id: int = 0
    ) -> None:
        self._cell, self._bus = cell, bus
        self._source = Source(system_id, component_id, "link")
        self._frames = 0

    @property
    def state(self) -> LinkState | None:
        """The present state; None before anything was heard."""
        return self._cell.latest

    def heard(self, at: float) -> None:
        """Something came at this time: it is connected."""
        self._heard_at = at
        if self._cell.latest is not LinkState.CONNECTED:
            self._become(LinkState.CONNECTED, at)

    def count(self, now: float, frames: int) -> None:
        """So many frames have come so far."""
        if frames != self._frames:
            self._frames = frames
            self.heard(now)
        else:
            self.check(now)

    def check(self, now: float) -> None:
        """It is silent when nothing has come for ``SILENT_AFTER_S``."""
        if self._cell.latest is LinkState.CONNECTED and now - self._heard_at > SILENT_AFTER_S:
            self._become(LinkState.SILENT, now)

    def lost(self, now: float, *, is_told: bool = True) -> None:
        """Nothing is heard any more: the link has gone, or (not ``is_told``) the program has closed it itself."""
        self._become(LinkState.LOST, now, is_told=is_told)

    def _become(self, state: LinkState, now: float, *, is_told: bool = True) -> None:
        before = self._cell.latest
        if before is not state:
            self._cell.set(state, self._source)
            if before is not None and is_told:
                self._bus.publish(LinkStateChanged(now, self._source.system_id, before, state))
