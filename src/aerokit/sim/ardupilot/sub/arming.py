"""What ArduSub checks before arming besides what every ArduPilot does."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from aerokit.sim.ardupilot.arming import Arming

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.sub.vehicle import SimulatedSub

__all__ = ["SubArming"]

_BUTTONS = range(16)
_SHIFT, _ARM_TOGGLE, _DISARM = 1, 2, 4
"""BTNn_FUNCTION."""
_DISARMS = frozenset({_ARM_TOGGLE, _DISARM})


class SubArming(Arming):
    """Radio and battery only by default (ARMING_CHECK 448), a position never; a joystick button must disarm it."""

    ARMED_TEXT: ClassVar[str] = "Arming motors"
    DISARMED_TEXT: ClassVar[str] = "Disarming motors"

    def __init__(self, sub: SimulatedSub) -> None:
        super().__init__(sub)
        self._sub = sub

    def reasons(self) -> list[str]:
        """Without such a button nothing else is looked at."""
        if self._sub.is_initialised and not self._has_disarm_button():
            return ["Must assign a disarm or arm_toggle button or disarm aux function"]
        return super().reasons()

    def disarm(self, *, force: bool = True) -> bool:
        """At any time."""
        return super().disarm(force=True)

    def _has_disarm_button(self) -> bool:
        parameters = self._sub.parameters
        names = [f"BTN{number}_" for number in _BUTTONS if f"BTN{number}_FUNCTION" in parameters]
        plain = {int(parameters[f"{name}FUNCTION"]) for name in names}
        if not names or plain & _DISARMS:
            return True
        return _SHIFT in plain and any(int(parameters[f"{name}SFUNCTION"]) in _DISARMS for name in names)
