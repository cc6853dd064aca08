"""Report on a failed test: its flights, their status texts, and the paths of pictures and recordings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.testing.flights import SimulatedFleet
from aerokit.testing.picture import save_picture

if TYPE_CHECKING:
    from aerokit.testing.flights import Flight
    from aerokit.testing.served import ServedFlight

_MAX_TEXTS = 6


def failure_report(opened: Iterable[SimulatedFleet | Flight | ServedFlight], test: str, directory: str | None) -> str:
    """Describe each vehicle of a failed test in a few lines.

    If ``directory`` is given, save a picture of the tracks there, and each recording with a report. The file names
    begin with the name of the test.
    """
    flights = _flatten(opened)
    lines = [line for flight in flights for line in _describe(flight)]
    if directory is not None:
        lines.append(_write_picture(flights, test, Path(directory)))
        lines += _write_recordings(flights, test, Path(directory))
    return "\n".join(lines)


def _flatten(opened: Iterable[SimulatedFleet | Flight | ServedFlight]) -> list[Flight | ServedFlight]:
    flights: list[Flight | ServedFlight] = []
    for fleet_or_flight in opened:
        flights += fleet_or_flight if isinstance(fleet_or_flight, SimulatedFleet) else [fleet_or_flight]
    return flights


def _describe(flight: Flight | ServedFlight) -> list[str]:
    try:
        track = flight.track
        if not track:  # The track has no points.
            return [f"{track.name}: not switched on"]
        return [
            f"{track.name}: {' → '.join(track.modes)}, armed for {track.armed_s:.1f} s,"
            f" up to {track.max_altitude_m:.1f} m high and {track.max_distance_m:.1f} m away",
            f"  ended {track.end}",
            *(f"  text at {text}" for text in flight.journal.texts[-_MAX_TEXTS:]),
        ]
    except Exception as error:  # An exception of the simulated vehicle must not prevent the report.
        return [f"{flight.simulated!r} fails: {error!r}"]


def _path(test: str, directory: Path, ending: str) -> Path:
    return directory / (re.sub(r"[^\w.-]+", "-", test).strip("-") + ending)


def _write_picture(flights: Sequence[Flight | ServedFlight], test: str, directory: Path) -> str:
    path = _path(test, directory, ".svg")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        save_picture([flight.track for flight in flights], path)
    except OSError as error:  # A picture that cannot be saved must not prevent the report.
        return f"no picture: {error}"
    return f"track in {path}"


def _write_recordings(flights: Sequence[Flight | ServedFlight], test: str, directory: Path) -> list[str]:
    """Save the recordings and their reports. Return the lines about these files."""
    # The vehicles of a fleet share one recording.
    by_recording: dict[int, list[Flight | ServedFlight]] = {}
    for flight in flights:
        if flight.recording is not None:
            by_recording.setdefault(id(flight.recording), []).append(flight)
    lines: list[str] = []
    for number, group in enumerate(by_recording.values()):
        recording = group[0].recording
        assert recording is not None
        is_first = number == 0  # Only further recordings have a number in their names.
        path = _path(test, directory, ".tlog" if is_first else f"-{number + 1}.tlog")
        try:
            path.write_bytes(recording.to_bytes())
        except Exception as error:  # For example, the recording is empty or the disk is full.
            lines.append(f"no recording: {error}")
            continue
        lines.append(f"recording in {path}")
        lines += [_write_report(path, flight, shares_recording=len(group) > 1) for flight in group]
    return lines


def _write_report(path: Path, flight: Flight | ServedFlight, *, shares_recording: bool) -> str:
    """Write the report on one vehicle of a recording. Return its path or the error as text."""
    from aerokit.logs.report import write_report

    system_id = flight.simulated.system_id
    target = path.with_suffix(f".{system_id}.html" if shares_recording else ".html")
    try:
        write_report(path, target, system_id=system_id, force=True)
    except ModuleNotFoundError:  # The packages of the extra "report" are not installed.
        return "no report: pip install 'aerokit-mavlink[report]'"
    except Exception as error:  # The reports on the other vehicles must still be written.
        return f"no report: {error}"
    return f"report in {target}"
