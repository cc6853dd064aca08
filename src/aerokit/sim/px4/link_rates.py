"""How often a PX4 sends what on a link, which depends on the link's mode, and what it says of that when asked."""

from __future__ import annotations

import csv
import math
import pkgutil
from collections.abc import Callable, Sequence
from functools import lru_cache

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavResult
from aerokit.sim.channel import Channel

LINK_MODES = ("normal", "onboard", "config", "minimal")
"""What MAV_n_MODE calls Normal, Onboard, Config and Minimal."""

_FAST_IN_SIMULATION = (
    m.Attitude.ID,
    m.AttitudeQuaternion.ID,
    m.AttitudeTarget.ID,
    m.GlobalPositionInt.ID,
    m.LocalPositionNed.ID,
    m.PositionTargetLocalNed.ID,
    m.ServoOutputRaw.ID,
)
_MORE_IN_SIMULATION_HZ = {m.RcChannels.ID: 20.0, m.OpticalFlowRad.ID: 10.0, m.Statustext.ID: 20.0}
_ALWAYS_HZ = {m.Heartbeat.ID: 1.0, m.MissionCurrent.ID: 1.0, m.CurrentEventSequence.ID: 0.3}
"""On every link, and not to be changed."""

_OFF, _WHEN_IT_CHANGES = -1, 0


class LinkRates:
    """Rates of all links. A link gets the mode at its place of ``modes``, one beyond the last the last.

    "normal" is as the simulator's link for ground stations is started: some messages come at ``fast_hz``.
    """

    def __init__(self, modes: Sequence[str], is_built: Callable[[int], bool], fast_hz: float) -> None:
        unknown = sorted(set(modes) - set(LINK_MODES))
        if unknown or not modes:
            raise ValueError(
                f"link_modes: {unknown[0] if unknown else 'empty'}; there are {', '.join(LINK_MODES)}"
            )
        self._modes, self._is_built, self._fast_hz = tuple(modes), is_built, fast_hz
        self._told: dict[Channel, dict[int, int]] = {}
        self._mode_of: dict[Channel, str] = {}

    def start(self, channel: Channel, number: int, first: float) -> None:
        """A link begins to stream at ``first``; ``number`` is its place."""
        mode = self._modes[min(number, len(self._modes) - 1)]
        self._mode_of[channel], told = mode, {}
        for message_id, rate in self._rates_at_start(mode).items():
            told[message_id] = _interval_us(rate)
            if rate and self._is_built(message_id) and message_id != m.GpsGlobalOrigin.ID:
                channel.streams.set_interval(message_id, 1.0 / rate, first)
        self._told[channel] = told
        for message_id, rate in _ALWAYS_HZ.items():
            channel.streams.set_interval(message_id, 1.0 / rate, first)

    def _rates_at_start(self, mode: str) -> dict[int, float]:
        rates = _table()[mode]
        if mode != "normal":
            return rates
        fast = dict.fromkeys(_FAST_IN_SIMULATION, self._fast_hz)
        return {**rates, **fast, **_MORE_IN_SIMULATION_HZ}

    def interval_us(self, channel: Channel, message_id: int) -> int:
        """As MESSAGE_INTERVAL tells it: -1 is off or unknown, 0 whenever there is something new."""
        if message_id == m.Heartbeat.ID:
            return 1_000_000
        return self._told.get(channel, {}).get(message_id, _OFF)

    def set_interval_us(self, channel: Channel, message_id: int, interval_us: float, now: float) -> int:
        """The MAV_RESULT; 0 goes back to the link's own rate."""
        rates = _table()[self._mode_of[channel]]
        if message_id not in rates:
            return MavResult.FAILED
        wanted = round(interval_us) if math.isfinite(interval_us) else 0
        wanted = _interval_us(rates[message_id]) if wanted == 0 else max(_OFF, wanted)
        self._told[channel][message_id] = wanted
        if self._is_built(message_id):
            channel.streams.set_interval(message_id, max(0, wanted) / 1e6, now)
        return MavResult.ACCEPTED

    def requested(self, channel: Channel, message_id: int) -> None:
        """A message was asked for once: from now on it counts as one that is sent when it changes."""
        told = self._told.get(channel, {})
        if told.get(message_id) == _OFF:
            told[message_id] = _WHEN_IT_CHANGES


def _interval_us(rate_hz: float) -> int:
    return int(1e6 / rate_hz) if rate_hz else _OFF


@lru_cache(maxsize=1)
def _table() -> dict[str, dict[int, float]]:
    """Link mode → message id → Hz, 0 for what has to be asked for."""
    data = pkgutil.get_data(__name__, "stream_rates.csv")
    assert data is not None
    rows = list(csv.DictReader(data.decode().splitlines()))
    return {mode: {int(row["message_id"]): float(row[mode]) for row in rows} for mode in LINK_MODES}
