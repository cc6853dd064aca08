"""Who steers: one order at a time, the newest one; and a pilot before all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.autopilots import Mode

__all__ = ["MOVING_COMMANDS", "Order"]

MOVING_COMMANDS = frozenset((16, 17, 18, 19, 20, 21, 22, 84, 85, 176, 185, 192, 193, 252, 300, 400))
"""MAV_CMDs by which a program steers past the actions: what an action left to be done must not come after them."""


class Order:
    """One order that moves the vehicle: when it was given, from which mode, and the modes it may bring about."""

    __slots__ = ("given_at", "mode_before", "modes")

    def __init__(self, given_at: float, mode_before: Mode | None, modes: tuple[Mode, ...]) -> None:
        self.given_at = given_at
        self.mode_before = mode_before
        self.modes = modes

    def explains(self, mode: Mode | None) -> bool:
        """Whether this mode can be the order's own doing; any other one is a pilot's or a failsafe's."""
        return mode is None or mode == self.mode_before or mode in self.modes
