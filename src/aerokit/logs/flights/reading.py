"""``read_flight``: a log → `Flight`, whoever wrote it."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.errors import FileFormatError
from aerokit.logs.flights.failsafes import signs_of_texts
from aerokit.logs.flights.flight import Flight
from aerokit.logs.flights.from_bin import read_bin_flight
from aerokit.logs.flights.from_tlog import read_tlog_flight
from aerokit.logs.flights.from_ulog import read_ulog_flight
from aerokit.protocols.exchange import Progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.protocols.exchange import OnProgress

LOGS: dict[str, Callable[[Flight, int | None, Callable[[int], object]], None]] = {
    ".tlog": read_tlog_flight,
    ".bin": read_bin_flight,
    ".ulg": read_ulog_flight,
}
"""Suffix of a log → what reads it."""


_SAME_M = 5.0


def check_log_name(path: Path) -> None:
    """FileFormatError where a file is no flight log by its name."""
    if path.suffix.lower() not in LOGS:
        raise FileFormatError(f"{path} is no flight log by its name: {', '.join(LOGS)}")


def read_flight(
    log: str | os.PathLike[str],
    *,
    system_id: int | None = None,
    on_progress: OnProgress | None = None,
) -> Flight:
    """Read a flight out of a log; of a damaged one as much as can be read. Blocks until then; no event loop is needed.

    Args:
        log: a ``.tlog`` of a ground station or of ``record=``, a ``.bin`` of ArduPilot, a ``.ulg`` of PX4.
        system_id: whose flight, where a ``.tlog`` has several vehicles; None: of the first one in it.
        on_progress: called now and then with the bytes that were read.

    Raises:
        FileFormatError: it is no such log, or has nothing that can be read.
        OSError: it cannot be read.
        ModuleNotFoundError: pyulog, of the extra ``report``, is not installed (``.ulg``).
    """
    path = Path(log)
    check_log_name(path)
    read = LOGS[path.suffix.lower()]
    total, begun = path.stat().st_size, time.monotonic()

    def show(done: int) -> None:
        if on_progress is not None:
            on_progress(Progress(min(done, total), total, time.monotonic() - begun))

    flight = Flight(path)
    read(flight, system_id, show)
    _complete(flight)
    show(total)
    return flight


def _complete(flight: Flight) -> None:
    """What all logs have in common: spans that are still open, home, and what texts say."""
    if flight.armed and math.isinf(flight.armed[-1][1]):
        flight.armed[-1] = (flight.armed[-1][0], flight.duration_s)
        flight.notes.append("the log ends while the vehicle is armed")
    if flight.home is None and len(flight.track):
        row = max(flight.track.index_at(flight.armed[0][0]), 0) if flight.armed else 0
        place = (flight.track[name][row] for name in ("latitude_deg", "longitude_deg", "altitude_amsl_m"))
        flight.note_home(flight.track.times[row], *place)
    _fill_relative(flight)
    flight.signs += signs_of_texts(flight.texts)
    flight.signs.sort(key=lambda sign: sign.time_s)


def _fill_relative(flight: Flight) -> None:
    """Heights above home where the log has only those above the sea.

    Before ArduPilot knows home, or the height of the sea, it tells one of the two for both.
    """
    home = flight.home.altitude_amsl_m if flight.home is not None else None
    if home is None:
        return
    for columns in (flight.track, flight.position_target):
        amsl, relative = columns["altitude_amsl_m"], columns["altitude_relative_m"]
        for row, height in enumerate(relative):
            above_sea = amsl[row]
            if math.isnan(height):
                relative[row] = above_sea - home
            elif abs(home) > _SAME_M and abs(height - above_sea) < _SAME_M:
                if abs(above_sea - home) < abs(above_sea):
                    relative[row] = above_sea - home
                else:
                    amsl[row] = math.nan
