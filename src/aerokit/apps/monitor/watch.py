"""``Watch``: what a monitor keeps of a connection beside its vehicles: texts and events, message rates, tracks."""

from __future__ import annotations

import math
import re
import time
from collections import Counter, defaultdict, deque
from typing import TYPE_CHECKING

from rich.text import Text

from aerokit._internal import geo
from aerokit._internal.plain import printable
from aerokit._internal.wording import in_words
from aerokit.events import Event, LinkReport, LoopBlocked, StatusTextReceived

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.frame import Frame
    from aerokit.vehicle.vehicle import Vehicle

MOST_LINES = 500
MOST_POINTS = 3000
NEAREST_POINTS_M = 0.5
MOST_KINDS = 2000
"""Of messages that are counted: what comes from the air fills no table."""
RATES_OVER_S = 5.0
SEVERITY_STYLES = ("bold white on red", "bold red", "bold red", "red", "yellow", "cyan", "", "dim")
"""By MAV_SEVERITY, emergency first."""


class Watch:
    """Listens to a connection from the start; ``look()`` is called a few times a second."""

    def __init__(self, connection: Connection, vehicles: Mapping[int, Vehicle]) -> None:
        self.connection: Connection = connection
        self.vehicles: Mapping[int, Vehicle] = vehicles
        self.lines: deque[Text] = deque(maxlen=MOST_LINES)
        """Texts and events that nobody has taken yet, the oldest first."""
        self.tracks: dict[int, deque[tuple[float, float]]] = defaultdict(lambda: deque(maxlen=MOST_POINTS))
        """System id → metres north and east of ``reference``."""
        self.reference: tuple[float, float] | None = None
        """The first place heard of, latitude and longitude in degrees."""
        self._counts: Counter[tuple[int, int]] = Counter()
        self._counted: deque[tuple[float, Counter[tuple[int, int]]]] = deque([(connection.now(), Counter())])
        self._detach: list[Detach] = [
            connection.tap(self._count),
            *connection.attach([Event], self._on_event),
        ]

    def close(self) -> None:
        """Listen no more."""
        for detach in self._detach:
            detach()

    def look(self) -> None:
        """Note where the vehicles are, and how many messages have come by now."""
        now = self.connection.now()
        if now - self._counted[-1][0] >= 1.0:
            self._counted.append((now, self._counts.copy()))
            while now - self._counted[1][0] >= RATES_OVER_S:
                self._counted.popleft()
        for system_id, vehicle in self.vehicles.items():
            place = vehicle.position.latest
            if place is not None:
                self._add(system_id, self.metres(place.latitude_deg, place.longitude_deg))

    def rates(self, system_id: int) -> list[tuple[str, float]]:
        """Message names of a system and how many came a second, over the last five; those heard before are 0."""
        (since, before), (until, after) = self._counted[0], self._counted[-1]
        if until <= since:
            return []
        dialect = self.connection.bus.dialect
        rates = []
        for (system, number), count in after.items():
            if system == system_id:
                known = dialect.get(number)
                name = f"message {number}" if known is None else known.NAME
                rates.append((name, (count - before[system, number]) / (until - since)))
        return sorted(rates, key=lambda each: (-each[1], each[0]))

    def metres(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Metres north and east of ``reference``, which is this place if there is none."""
        if self.reference is None:
            self.reference = latitude_deg, longitude_deg
        return geo.north_east_m(*self.reference, latitude_deg, longitude_deg)

    def note(self, system_id: int, text: str, style: str = "") -> None:
        """A line beside the texts, at this time."""
        line = Text(f"{_time_of_day(self.connection.unix_time())} ", "dim")
        line.append(f"{system_id} " if system_id else "link ", "bold")
        line.append(printable(text).replace("\n", " "), style)
        self.lines.append(line)

    def _add(self, system_id: int, point: tuple[float, float]) -> None:
        track = self.tracks[system_id]
        if not track or math.dist(track[-1], point) >= NEAREST_POINTS_M:
            track.append(point)

    def _count(self, frame: Frame, _peer: object) -> None:
        kind = frame.system_id, frame.message_id
        if kind in self._counts or len(self._counts) < MOST_KINDS:
            self._counts[kind] += 1

    def _on_event(self, event: Event) -> None:
        if isinstance(event, StatusTextReceived):
            style = SEVERITY_STYLES[event.severity] if 0 <= event.severity < 8 else ""
            self.note(event.system_id, event.text, style)
        elif not isinstance(event, (LinkReport, LoopBlocked)):
            self.note(event.system_id, _words(event), "italic")


def _words(event: Event) -> str:
    """``ModeChanged(before='A', after='B')`` as "mode changed: before A, after B"."""
    name = re.sub(r"(?<!^)(?=[A-Z])", " ", type(event).__name__).lower()
    fields = {
        field: getattr(event, field) for field in event.__match_args__ if field not in ("at", "system_id")
    }
    told = ", ".join(f"{field.replace('_', ' ')} {in_words(value)}" for field, value in fields.items())
    return f"{name}: {told}" if told else name


def _time_of_day(unix_time: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(unix_time))
