"""A simulated lithium battery: charge, resting voltage by charge, sag by current."""

from __future__ import annotations

__all__ = ["Battery"]

_RESTING_CELL_VOLTS = ((0.0, 3.0), (5.0, 3.3), (20.0, 3.6), (50.0, 3.75), (75.0, 3.95), (100.0, 4.2))


class Battery:
    """One pack. ``drain`` is all that happens to it; everything else is read from it."""

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
        self.current_a = 0.0
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
        """Voltage under the present load."""
        return max(0.0, self.cells * self._resting_cell_volts() - self.current_a * self.resistance_ohm)

    def drain(self, current_a: float, dt: float) -> None:
        """Draw a current for ``dt`` seconds."""
        self.current_a = current_a
        used_mah = current_a * dt / 3.6
        self.consumed_mah += used_mah
        self.consumed_wh += used_mah * self.voltage_v / 1000.0
        self._charge_mah = max(0.0, self._charge_mah - used_mah)

    def _resting_cell_volts(self) -> float:
        percent = self.percent
        low_percent, low_volts = _RESTING_CELL_VOLTS[0]
        for high_percent, high_volts in _RESTING_CELL_VOLTS[1:]:
            if percent <= high_percent:
                share = (percent - low_percent) / (high_percent - low_percent)
                return low_volts + share * (high_volts - low_volts)
            low_percent, low_volts = high_percent, high_volts
        return low_volts
