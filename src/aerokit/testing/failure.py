"""What a report says of a test that failed: what was flown, said and ordered, and where its picture is."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.sim.picture import save_picture
from aerokit.testing.flights import Fleet

if TYPE_CHECKING:
    from aerokit.sim.journal import SaidText
    from aerokit.testing.flights import Flight
    from aerokit.testing.served import ServedFlight

__all__ = ["what_was_flown"]

_TEXTS = 6


def what_was_flown(flown: Iterable[Fleet | Flight | ServedFlight], test: str, directory: str | None) -> str:
    """Some lines for each vehicle; with a directory, a picture of them all is drawn there, named after the test."""
    flights = _each(flown)
    lines = [line for flight in flights for line in _told(flight)]
    if directory is not None:
        lines.append(_picture(flights, test, Path(directory)))
    return "\n".join(lines)


def _each(flown: Iterable[Fleet | Flight | ServedFlight]) -> list[Flight | ServedFlight]:
    flights: list[Flight | ServedFlight] = []
    for each in flown:
        flights += each if isinstance(each, Fleet) else [each]
    return flights


def _told(flight: Flight | ServedFlight) -> list[str]:
    try:
        return _story(flight)
    except Exception as error:  # the vehicle makes a mistake just now; the failure is to be told all the same
        return [f"{flight.simulated!r} fails: {error!r}"]


def _story(flight: Flight | ServedFlight) -> list[str]:
    track, texts = flight.track, flight.journal.texts
    if not track:
        return [f"{track.name}: not switched on"]
    lines = [
        f"{track.name}: {' → '.join(track.modes)}, armed for {track.armed_s:.1f} s,"
        f" up to {track.max_altitude_m:.1f} m high and {track.max_distance_m:.1f} m away",
        f"  ended {track.end}",
    ]
    return [*lines, *_last(texts)]


def _last(texts: Sequence[SaidText]) -> list[str]:
    return [f"  said at {text}" for text in texts[-_TEXTS:]]


def _picture(flights: Sequence[Flight | ServedFlight], test: str, directory: Path) -> str:
    path = directory / (re.sub(r"[^\w.-]+", "-", test).strip("-") + ".svg")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        save_picture([flight.track for flight in flights], path)
    except OSError as error:  # the failure is to be told all the same
        return f"no picture: {error}"
    return f"track in {path}"
