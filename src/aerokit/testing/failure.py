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

_TEXTS = 6


def what_was_flown(flown: Iterable[Fleet | Flight | ServedFlight], test: str, directory: str | None) -> str:
    """Some lines for each vehicle; with a directory, a picture of them all is drawn there, named after the test.

    What was recorded is put there, too, with its report.
    """
    flights = _each(flown)
    lines = [line for flight in flights for line in _told(flight)]
    if directory is not None:
        lines.append(_picture(flights, test, Path(directory)))
        lines += _recordings(flights, test, Path(directory))
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


def _path(test: str, directory: Path, ending: str) -> Path:
    return directory / (re.sub(r"[^\w.-]+", "-", test).strip("-") + ending)


def _picture(flights: Sequence[Flight | ServedFlight], test: str, directory: Path) -> str:
    path = _path(test, directory, ".svg")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        save_picture([flight.track for flight in flights], path)
    except OSError as error:  # the failure is to be told all the same
        return f"no picture: {error}"
    return f"track in {path}"


def _recordings(flights: Sequence[Flight | ServedFlight], test: str, directory: Path) -> list[str]:
    """A file for each link, and a report for each vehicle."""
    by_recording: dict[int, list[Flight | ServedFlight]] = {}
    for flight in flights:
        by_recording.setdefault(id(flight.recording), []).append(flight)
    lines: list[str] = []
    for number, group in enumerate(by_recording.values()):
        recording = group[0].recording
        if recording is None:
            continue
        path = _path(test, directory, f"-{number + 1}.tlog" if number else ".tlog")
        try:
            path.write_bytes(recording.to_bytes())
            lines.append(f"recording in {path}")
            lines += [_report(path, flight, len(group)) for flight in group]
        except (
            Exception
        ) as error:  # nothing was said on the link, or the disk is full: the failure is to be told
            lines.append(f"no report: {error}")
    return lines


def _report(path: Path, flight: Flight | ServedFlight, count: int) -> str:
    from aerokit.logs.report import write_report

    system_id = flight.simulated.system_id
    target = path.with_suffix(f".{system_id}.html" if count > 1 else ".html")
    try:
        write_report(path, target, system_id=system_id, force=True)
    except ModuleNotFoundError:
        return "no report of it: pip install 'aerokit-mavlink[report]'"
    return f"report in {target}"
