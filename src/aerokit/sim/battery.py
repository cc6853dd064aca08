"""A simulated lithium battery: charge, resting voltage by charge, sag by current."""

from __future__ import annotations

from itertools import pairwise

_RESTING_CELL_VOLTS = ((0.0, 3.0), (5.0, 3.3), (20.0, 3.6), (50.0, 3.75), (75.0, 3.95), (100.0, 4.2))
_RESTING_CELL_SLOPES = tuple(
    (low, volts, (high_volts - volts) / (high - low))
    for (low, volts), (high, high_volts) in pairwise(_RESTING_CELL_VOLTS)
)[::-1]
"""From the full end: percent, volts, volts for each percent above it."""


class Battery:
    """One pack. ``drain`` is all that happens to it; everything else is read from it."""

    consumed_mah: float
    consumed_wh: float

    def __init__(
        self,
        capacity_mah: float = 3300.0,
        *,
        cells: int = 3,
        percent: float = 100.0,
        resistance_ohm: float = 0.012,
    ) -> None:
        self.capacity_mah = capacity_mah
        self.cells = cells
        self.resistance_ohm = resistance_ohm
        self.consumed_mah = 0.0
        """Since power on, as a current sensor counts it."""
        self.consumed_wh = 0.0
        self.current_a: float = 0.0
        self._charge_mah = capacity_mah * percent / 100.0

    @property
    def percent(self) -> float:
        """Charge left, 0 to 100."""
        return 100.0 * self._charge_mah / self.capacity_mah

    @percent.setter
    def percent(self, value: float) -> None:
        self._charge_mah = self.capacity_mah * value / 100.0

    @property
    def voltage_v(self) -> float:
        volts = self.cells * self._resting_cell_volts() - self.current_a * self.resistance_ohm
        return volts if volts > 0.0 else 0.0

    def drain(self, current_a: float, dt: float) -> None:
        """Draw a current for ``dt`` seconds."""
        self.current_a = current_a
        used_mah = current_a * dt / 3.6
        self.consumed_mah += used_mah
        self.consumed_wh += used_mah * self.voltage_v / 1000.0
        left_mah = self._charge_mah - used_mah
        self._charge_mah = left_mah if left_mah > 0.0 else 0.0

    def _resting_cell_volts(self) -> float:
        percent = 100.0 * self._charge_mah / self.capacity_mah
        for low_percent, low_volts, volts_per_percent in _RESTING_CELL_SLOPES:
            if percent >= low_percent:
                return low_volts + (min(percent, 100.0) - low_percent) * volts_per_percent
        return _RESTING_CELL_VOLTS[0][1]
