"""``LinkStates``: how each of several links does, into a cell and as events."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.runtime.cells import Source, StateCell
from aerokit.runtime.events import OneLinkChanged
from aerokit.runtime.link_state import LinkState, LinkStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from aerokit.links.several import SeveralLinks
    from aerokit.runtime.events import Event
    from aerokit.runtime.link_choice import LinkChoice

__all__ = ["LinkStates"]

PERIOD_S = 0.95
"""A second, looked at ten times a second."""


class LinkStates:
    """``choices`` is the choice for each system; ``publish`` tells an event."""

    def __init__(
        self,
        link: SeveralLinks,
        choices: Mapping[int, LinkChoice],
        clock: Callable[[], float],
        publish: Callable[[Event], object],
    ) -> None:
        self._link, self._choices, self._publish = link, choices, publish
        self._states = [LinkState.LOST] * len(link.names)
        self._told_at = -math.inf
        self.cell: StateCell[tuple[LinkStatus, ...]] = StateCell("links", clock, "frame")

    def look(self, now: float) -> None:
        """Tell what has changed, and once a second how all of them do."""
        for link in range(len(self._states)):
            candidates = [each.candidates[link] for each in self._choices.values() if link in each.candidates]
            if candidates and self._link.is_there(link):
                is_alive = any(each.is_alive(now) for each in candidates)
                self.become(link, LinkState.CONNECTED if is_alive else LinkState.SILENT, now)
        if now - self._told_at >= PERIOD_S:
            self.tell(now)

    def become(self, link: int, state: LinkState, now: float) -> None:
        """It is so with this link."""
        before, self._states[link] = self._states[link], state
        if before is not state:
            self._told_at = -math.inf
            self._publish(OneLinkChanged(now, 0, self._link.names[link], before, state))

    def tell(self, now: float) -> None:
        """How all of them do."""
        self._told_at = now
        self.cell.set(tuple(map(self._status, range(len(self._states)))), Source(0, 0, "link"))

    def _status(self, link: int) -> LinkStatus:
        candidates = {
            system_id: choice.candidates[link]
            for system_id, choice in self._choices.items()
            if link in choice.candidates
        }
        losses = [each.loss for each in candidates.values() if each.loss is not None]
        trips = [each.round_trip_s for each in candidates.values() if each.round_trip_s is not None]
        return LinkStatus(
            self._link.names[link],
            self._states[link],
            is_costly=link in self._link.costly,
            systems=tuple(sorted(candidates)),
            used_for=tuple(
                sorted(each for each in candidates if self._choices[each].used is candidates[each])
            ),
            loss_percent=100 * max(losses) if losses else None,
            round_trip_s=max(trips) if trips else None,
        )
