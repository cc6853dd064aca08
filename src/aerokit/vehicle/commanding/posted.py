"""`Posted`: an order that others may follow before it is answered, and whether it may still be sent again then."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.vehicle.commanding.order import failsafe_text, is_worse

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from aerokit.autopilots import Mode

__all__ = ["OWN_MODES_S", "Posted"]

OWN_MODES_S = 10.0
"""A mode that the program ordered so long ago may be told only now: that is nobody who takes over."""


class Posted:
    """Whether one posted order still stands: its effect has not been told yet, no newer one is of its subject, and
    nobody else, a pilot or a failsafe, has changed the mode since; nor, if it ``moves`` the vehicle, disarmed it.

    ``modes`` and ``armed`` are its effects: a change to them, as HEARTBEAT tells it. ``own_modes`` are others that the
    program had ordered shortly before. To disarm is meant whatever the mode.
    """

    def __init__(
        self,
        is_newest: Callable[[], bool],
        *,
        modes: Collection[Mode],
        own_modes: Collection[int],
        armed: bool | None,
        mode_now: Mode | None,
        armed_now: bool | None,
        state_now: int | None = None,
        ends_flight: bool = False,
        moves: bool = False,
    ) -> None:
        self.has_worked: bool = False
        """Whether HEARTBEAT has told its effect."""
        self.told_at: float = -math.inf
        """When HEARTBEAT came last."""
        self._is_newest, self._taken_by = is_newest, ""
        self.modes: tuple[Mode, ...] = tuple(modes)
        """Those that it brings about."""
        self.armed = armed
        """Whether it arms or disarms."""
        self._own_modes, self._moves = set(own_modes), moves
        self._mode_before = None if mode_now is None else mode_now.custom_mode
        self._armed_before = armed_now
        self._state_before, self._ends_flight = state_now, ends_flight

    @property
    def end(self) -> str:
        """Why it must not be sent again, as a clause; empty while it may."""
        return "its effect was told" if self.has_worked else self.lost

    @property
    def lost(self) -> str:
        """Why nothing of it may be sent any more, as a clause: another order or somebody else has the vehicle."""
        return self._taken_by if self._is_newest() else "a newer order was given meanwhile"

    def note_state(self, state: int) -> None:
        """Take MAV_STATE. To disarm, to land and to return is meant whatever failsafe is active."""
        if is_worse(state, self._state_before) and not self._ends_flight and self.armed is not False:
            self._taken_by = self._taken_by or failsafe_text(state)
        self._state_before = state

    def note_mode(self, mode: Mode, at: float) -> None:
        """The vehicle tells its mode."""
        before, self._mode_before = self._mode_before, mode.custom_mode
        if before is None or before == mode.custom_mode:
            return
        if any(mode.custom_mode == each.custom_mode for each in self.modes):
            self.has_worked = True
        elif self.armed is not False and mode.custom_mode not in self._own_modes:
            self._taken_by = self._taken_by or "the vehicle was put into another mode meanwhile"

    def note_armed(self, armed: bool, at: float) -> None:
        """The vehicle tells whether it is armed, which ends a HEARTBEAT."""
        before, self._armed_before = self._armed_before, armed
        if before is not None and before is not armed and armed is self.armed:
            self.has_worked = True
        elif before and not armed and self._moves:
            self._taken_by = self._taken_by or "the vehicle disarmed"
        self.told_at = at

    def note_reboot(self) -> None:
        """The vehicle has rebooted: nothing that was ordered before is meant any more."""
        self._taken_by = self._taken_by or "the vehicle rebooted"
