"""Output of a simulated PX4 on each link: stream rates, status texts, and events with the content of texts.

https://mavlink.io/en/services/events.html. Event ids and log levels are those of a recording of a real PX4. Not
simulated: events without a text, the health report of the components, REQUEST_EVENT.
"""

from __future__ import annotations

import csv
import math
import re
import struct
from collections import deque
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavResult
from aerokit.mavlink.messages import CurrentEventSequence, Event, Statustext
from aerokit.sim.channel import Channel
from aerokit.sim.px4.host import Px4Host

_INITIAL_SEQUENCE = 65526
_INFO_LEVELS = 0x66  # MAV_SEVERITY INFO (6): four bits for logs and four bits for other programs
# Numbers that PX4's events use for the reasons of arming and disarming.
_OTHER_REASON = 0
_ARMED_BY = {"external command": 4, "mission start": 5}
_DISARMED_BY = {"external command": 4, "landing": 6, "auto preflight disarming": 7}
_EVENT_IDS = {
    "Takeoff detected": 21054825,
    "Landing detected": 26622124,
    "Returning to launch": 20262116,
    "RTL: land at destination": 16962474,
}
_ARMED, _DISARMED, _RETURN = 26266355, 32794487, 22161044
_RETURN_TEXT = re.compile(r"RTL: start return at (-?\d+) m \((-?\d+) m above destination\)")


class Px4Events:
    """Sends events. The sequence number starts just below its limit, so that tests of clients cover the overflow."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self._next_sequence = _INITIAL_SEQUENCE

    def current(self) -> CurrentEventSequence:
        return CurrentEventSequence((self._next_sequence - 1) & 0xFFFF, 0)

    def send_for(self, text: str) -> None:
        """Send the event with the content of a status text, if PX4 has one."""
        event = _event_of(text)
        if event is None:
            return
        event_id, arguments = event
        px4 = self._px4
        px4.send(
            Event(
                destination_component=0, destination_system=0, id=event_id, event_time_boot_ms=px4.time_boot_ms,
                sequence=self._next_sequence, log_levels=_INFO_LEVELS, arguments=arguments,
            )
        )  # fmt: skip
        self._next_sequence = (self._next_sequence + 1) & 0xFFFF


def _event_of(text: str) -> tuple[int, bytes] | None:
    """Return (event id, arguments) for a status text, or None if PX4 has no such event."""
    if text in _EVENT_IDS:
        return _EVENT_IDS[text], b""
    if text.startswith("Armed by "):
        reason = _ARMED_BY.get(text.removeprefix("Armed by "), _OTHER_REASON)
        return _ARMED, bytes([reason])
    if text.startswith("Disarmed by "):
        reason = _DISARMED_BY.get(text.removeprefix("Disarmed by "), _OTHER_REASON)
        return _DISARMED, bytes([reason])
    match = _RETURN_TEXT.fullmatch(text)
    if match is None:
        return None
    altitude, height = map(int, match.groups())
    return _RETURN, struct.pack("<ii", altitude, height)


NO_STATION = "Preflight Fail: No connection to the GCS"
TOO_FAR = "Geofence: exceeding maximum distance to Home"
TOO_HIGH = "Geofence: exceeding maximum altitude above Home"
OUTSIDE = "Geofence: approaching or outside geofence"

# PX4 appends a tab to a status text if an event has the same content. Texts that begin as follows have no tab.
_WITHOUT_TAB = (
    "Preflight Fail: ",
    "Geofence: ",
    "Figure 8 command",
    "Assuming vehicle is facing",
    "Mag quick calibration",
    "[cal] ",
    "MAVLink signing",
)


_STATION_TIMEOUT_S = 2.5
_MAX_QUEUED, _MAX_AGE_S = 8, 5.0


class Px4TextLinks:
    """Sends status texts (streams/STATUSTEXT.hpp). On each link, texts wait up to 5 s for a ground station."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.speedup: float = 1.0
        """Simulated seconds per second of the clients' clocks. The timeouts are multiplied by this number."""
        self._station_at: dict[Channel, float] = {}  # time of the last heartbeat of a ground station on each link
        # Queued texts of each link without a ground station, as (time, chunks).
        self._waiting: dict[Channel, deque[tuple[float, list[Statustext]]]] = {}

    def on_station_heartbeat(self, channel: Channel) -> None:
        self._station_at[channel] = self._px4.now
        for sent_at, chunks in self._waiting.pop(channel, ()):
            if self._px4.now - sent_at < _MAX_AGE_S * self.speedup:
                self._send(chunks, channel)

    def send(self, chunks: list[Statustext]) -> None:
        now, timeout_s = self._px4.now, _STATION_TIMEOUT_S * self.speedup
        for channel in self._px4.channels:
            if now - self._station_at.get(channel, -math.inf) <= timeout_s:
                self._send(chunks, channel)
            else:
                self._waiting.setdefault(channel, deque(maxlen=_MAX_QUEUED)).append((now, chunks))

    def _send(self, chunks: list[Statustext], channel: Channel) -> None:
        for chunk in chunks:
            self._px4.send(chunk, channel)


def on_the_wire(text: str) -> str:
    return text if text.startswith(_WITHOUT_TAB) else text + "\t"


LINK_MODES = ("normal", "onboard", "config", "minimal")
"""Link modes, which PX4 names Normal, Onboard, Config and Minimal (MAV_n_MODE)."""

_FAST_MESSAGES = (
    m.Attitude.ID,
    m.AttitudeQuaternion.ID,
    m.AttitudeTarget.ID,
    m.GlobalPositionInt.ID,
    m.LocalPositionNed.ID,
    m.PositionTargetLocalNed.ID,
    m.ServoOutputRaw.ID,
)
_SIMULATION_RATES_HZ = {m.RcChannels.ID: 20.0, m.OpticalFlowRad.ID: 10.0, m.Statustext.ID: 20.0}
# Messages whose rate is the same on every link and cannot be changed. The values are the rates in Hz.
_ALWAYS_HZ = {m.Heartbeat.ID: 1.0, m.MissionCurrent.ID: 1.0, m.CurrentEventSequence.ID: 0.3}

_OFF, _ON_CHANGE = -1, 0
_MIN_INTERVAL_S = 0.0015  # PX4 sends a stream at most once in each loop (mavlink_main.h, MAVLINK_MIN_INTERVAL).


class Px4StreamRates:
    """Stream rates of each link. ``modes`` lists the modes of the links. Further links have the last mode of the list.

    The "normal" link is the ground-station link of PX4's simulation. It sends some messages at ``fast_hz``.
    """

    def __init__(self, modes: Sequence[str], is_built: Callable[[int], bool], fast_hz: float) -> None:
        unknown = sorted(set(modes) - set(LINK_MODES))
        if unknown or not modes:
            reason = f"contains the unknown mode {unknown[0]!r}" if unknown else "is empty"
            raise ValueError(f"link_modes {reason}; modes: {', '.join(LINK_MODES)}")
        self._modes = tuple(modes)
        self._is_built = is_built
        self._fast_hz = fast_hz
        self._intervals_us: dict[Channel, dict[int, int]] = {}
        self._mode_of: dict[Channel, str] = {}

    def start(self, channel: Channel, number: int, first: float) -> None:
        """Start the streams of link ``number`` at time ``first``."""
        mode = self._modes[min(number, len(self._modes) - 1)]  # Further links have the last mode.
        self._mode_of[channel] = mode
        intervals_us = self._intervals_us[channel] = {}
        for message_id, rate in self._rates_at_start(mode).items():
            intervals_us[message_id] = _interval_us(rate)
            # PX4 sends GPS_GLOBAL_ORIGIN only once and after a change, although the table has a rate for it.
            if rate and self._is_built(message_id) and message_id != m.GpsGlobalOrigin.ID:
                channel.streams.set_interval(message_id, 1.0 / rate, first)
        for message_id, rate in _ALWAYS_HZ.items():
            channel.streams.set_interval(message_id, 1.0 / rate, first)

    def _rates_at_start(self, mode: str) -> dict[int, float]:
        rates = _table()[mode]
        if mode != "normal":
            return rates
        fast = dict.fromkeys(_FAST_MESSAGES, self._fast_hz)
        return {**rates, **fast, **_SIMULATION_RATES_HZ}

    def interval_us(self, channel: Channel, message_id: int) -> int:
        """Return the interval for MESSAGE_INTERVAL: -1 if the message is off or unknown, 0 if it is sent on change."""
        if message_id == m.Heartbeat.ID:
            return 1_000_000
        return self._intervals_us.get(channel, {}).get(message_id, _OFF)

    def set_interval_us(self, channel: Channel, message_id: int, interval_us: float, now: float) -> int:
        """Set the interval of a message and return the MAV_RESULT. 0 restores the rate of the link mode."""
        rates = _table()[self._mode_of[channel]]
        if message_id not in rates:
            return MavResult.FAILED
        requested_us = round(interval_us) if math.isfinite(interval_us) else 0
        default_us = _interval_us(rates[message_id])
        new_us = default_us if requested_us == 0 else max(_OFF, requested_us)
        self._intervals_us[channel][message_id] = new_us
        if self._is_built(message_id):
            interval_s = max(_MIN_INTERVAL_S, new_us / 1e6) if new_us > 0 else 0.0  # 0 stops the stream.
            channel.streams.set_interval(message_id, interval_s, now)
        return MavResult.ACCEPTED

    def on_requested(self, channel: Channel, message_id: int) -> None:
        intervals_us = self._intervals_us.get(channel, {})
        # After a request of a message whose stream is off, PX4 reports its interval as "on change".
        if intervals_us.get(message_id) == _OFF:
            intervals_us[message_id] = _ON_CHANGE


def _interval_us(rate_hz: float) -> int:
    return int(1e6 / rate_hz) if rate_hz else _OFF


@lru_cache(maxsize=1)
def _table() -> dict[str, dict[int, float]]:
    """Return the rates in Hz by link mode and message id. A message with the rate 0 is sent only on request."""
    rows = list(csv.DictReader(Path(__file__).with_name("stream_rates.csv").read_text("utf-8").splitlines()))
    return {mode: {int(row["message_id"]): float(row[mode]) for row in rows} for mode in LINK_MODES}
