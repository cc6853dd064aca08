"""``MonitorModel``: the data of the terminal monitor, which are texts, events, message rates and tracks."""

from __future__ import annotations

import math
import re
import time
from collections import Counter, defaultdict, deque
from typing import TYPE_CHECKING, NamedTuple

from rich.text import Text

from aerokit._internal import geo
from aerokit._internal.formatting import printable
from aerokit.apps.event_text import event_details
from aerokit.apps.monitor.lines import DANGER
from aerokit.events import Event, LinkReport, LoopBlocked, StatusTextReceived, StreamSlow

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.frame import Frame
    from aerokit.vehicle.vehicle import Vehicle

MAX_LINES = 500
MAX_TRACK_POINTS = 3000
MIN_POINT_DISTANCE_M = 0.5
MAX_MESSAGE_TYPES = 2000
"""Maximum number of message types that are counted. It limits memory, because a sender can use many ids."""
RATE_WINDOW_S = 5.0
SEVERITY_STYLES = (DANGER, DANGER, DANGER, "bold red", "bold magenta", "bold", "", "dim")
"""Text styles; the index is the MAV_SEVERITY, from 0 (emergency) to 7 (debug)."""


class _CountSample(NamedTuple):
    """Counts of the messages received before the time ``at``, by system id and message id."""

    at: float
    counts: Counter[tuple[int, int]]


class MonitorModel:
    """Collects the data from a connection. ``update()`` must be called a few times a second."""

    def __init__(self, connection: Connection, vehicles: Mapping[int, Vehicle]) -> None:
        self.connection: Connection = connection
        self.vehicles: Mapping[int, Vehicle] = vehicles
        self.lines: deque[Text] = deque(maxlen=MAX_LINES)
        """Texts and events that are not displayed yet, the oldest first."""
        self.slow_streams: str = ""
        """One line about all `StreamSlow` events: their number and the last one. ``lines`` omits these events."""
        self._slow_count = 0
        self.tracks: dict[int, deque[tuple[float, float]]] = defaultdict(lambda: deque(maxlen=MAX_TRACK_POINTS))
        """Maps system ids to positions in metres north and east of ``reference``, the oldest first."""
        self.reference: tuple[float, float] | None = None
        """Latitude and longitude of the first known position, in degrees."""
        self._counts: Counter[tuple[int, int]] = Counter()
        # One sample for each second of RATE_WINDOW_S.
        self._count_samples: deque[_CountSample] = deque([_CountSample(connection.now(), Counter())])
        self._detach: list[Detach] = [
            connection.observe_frames(self._count_frame),
            *connection.attach([Event], self._on_event),
        ]

    def close(self) -> None:
        for detach in self._detach:
            detach()

    def update(self) -> None:
        now = self.connection.now()
        if now - self._count_samples[-1].at >= 1.0:
            self._count_samples.append(_CountSample(now, self._counts.copy()))
            # Drop the oldest sample once the second oldest is at least as old as the window.
            while now - self._count_samples[1].at >= RATE_WINDOW_S:
                self._count_samples.popleft()
        for system_id, vehicle in self.vehicles.items():
            position = vehicle.position.latest
            if position is not None:
                point = self.metres(position.latitude_deg, position.longitude_deg)
                track = self.tracks[system_id]
                if not track or math.dist(track[-1], point) >= MIN_POINT_DISTANCE_M:
                    track.append(point)

    def rates(self, system_id: int) -> list[tuple[str, float]]:
        """Return the names of a system's messages, and their rates in Hz in the last five seconds."""
        oldest = self._count_samples[0]
        newest = self._count_samples[-1]
        duration_s = newest.at - oldest.at
        if duration_s <= 0.0:
            return []
        dialect = self.connection.bus.dialect
        rates = []
        for (sender_id, message_id), count in newest.counts.items():
            if sender_id == system_id:
                message = dialect.get(message_id)
                name = f"message {message_id}" if message is None else message.NAME
                received = count - oldest.counts[sender_id, message_id]
                rates.append((name, received / duration_s))
        return rates

    def metres(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Convert a position to metres north and east of the first position."""
        if self.reference is None:
            self.reference = latitude_deg, longitude_deg
        return geo.north_east_m(*self.reference, latitude_deg, longitude_deg)

    def add_line(self, system_id: int, text: str, style: str = "") -> None:
        """Add a line that begins with the current time. System id 0 stands for the link."""
        line = Text(f"{self._time()} ", "dim")
        line.append(f"{system_id} " if system_id else "link ", "bold")
        line.append(printable(text).replace("\n", " "), style)
        self.lines.append(line)

    def _time(self) -> str:
        return time.strftime("%H:%M:%S", time.localtime(self.connection.unix_time()))

    def _count_frame(self, frame: Frame, _peer: object) -> None:
        key = frame.system_id, frame.message_id
        if key in self._counts or len(self._counts) < MAX_MESSAGE_TYPES:
            self._counts[key] += 1

    def _on_event(self, event: Event) -> None:
        if isinstance(event, StatusTextReceived):
            style = SEVERITY_STYLES[event.severity] if 0 <= event.severity < 8 else ""
            self.add_line(event.system_id, event.text, style)
        elif isinstance(event, StreamSlow):
            self._slow_count += 1
            self.slow_streams = (
                f"{self._slow_count} × stream slow, last {self._time()} {event.system_id} {event.message}"
                f" {event.achieved_hz:g} of {event.requested_hz:g} Hz"
            )
        elif not isinstance(event, (LinkReport, LoopBlocked)):
            self.add_line(event.system_id, _event_line(event), "italic")


def _event_line(event: Event) -> str:
    """Return ``ModeChanged(before='A', after='B')`` as "mode changed: A → B"."""
    name = re.sub(r"(?<!^)(?=[A-Z])", " ", type(event).__name__).lower()
    details = event_details(event)
    return f"{name}: {details}" if details else name
