"""Flight logs as flights: `read_flight` reads a log into time series; see docs/report.md."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.errors import FileFormatError
from aerokit.logs.flights.failsafes import Failsafe, evidence_in_texts, failsafes
from aerokit.logs.flights.falls import Fall, falls
from aerokit.logs.flights.flight import (
    FailsafeEvidence,
    FlightLog,
    LoggedText,
    ModeChange,
    ParameterChange,
    TimeSeries,
    Waypoint,
)
from aerokit.logs.flights.from_bin import read_bin_flight
from aerokit.logs.flights.from_tlog import read_tlog_flight
from aerokit.logs.flights.from_ulog import read_ulog_flight
from aerokit.protocols.exchange import TransferProgress

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.protocols.exchange import OnProgress

__all__ = [
    "Failsafe",
    "FailsafeEvidence",
    "Fall",
    "FlightLog",
    "LoggedText",
    "ModeChange",
    "ParameterChange",
    "TimeSeries",
    "Waypoint",
    "failsafes",
    "falls",
    "read_flight",
]


LOG_READERS: dict[str, Callable[[FlightLog, int | None, Callable[[int], object]], None]] = {
    ".tlog": read_tlog_flight,
    ".bin": read_bin_flight,
    ".ulg": read_ulog_flight,
}
"""Maps the suffix of a log to the function that reads it."""
_SAME_ALTITUDE_M = 5.0  # a smaller difference means that both altitudes are the same value


def check_log_name(path: Path) -> None:
    """Raise FileFormatError if the suffix is not that of a flight log."""
    if path.suffix.lower() not in LOG_READERS:
        raise FileFormatError(f"{path} is not a flight log; supported suffixes: {', '.join(LOG_READERS)}")


def read_flight(
    log: str | os.PathLike[str], *, system_id: int | None = None, on_progress: OnProgress | None = None
) -> FlightLog:
    """Read a flight from a log. If the log is damaged, only its readable part is returned.

    The function blocks and needs no event loop.

    Args:
        log: a ``.tlog`` of a ground station or of ``record=``, a ``.bin`` of ArduPilot, a ``.ulg`` of PX4.
        system_id: system id of the vehicle, if a ``.tlog`` contains several vehicles; None: the first vehicle.
        on_progress: called from time to time with the bytes that were read.

    Raises:
        FileFormatError: the file is not a flight log, or nothing can be read.
        OSError: the file cannot be read.
        ModuleNotFoundError: pyulog, of the extra ``report``, is not installed (``.ulg``).
    """
    path = Path(log)
    check_log_name(path)
    read = LOG_READERS[path.suffix.lower()]
    total, started = path.stat().st_size, time.monotonic()

    def report_progress(done: int) -> None:
        if on_progress is not None:
            on_progress(TransferProgress(min(done, total), total, time.monotonic() - started))

    report_progress(0)
    flight = FlightLog(path)
    read(flight, system_id, report_progress)
    _complete(flight)
    report_progress(total)
    return flight


def _complete(flight: FlightLog) -> None:
    """Close open spans, and derive home, heights and failsafe evidence."""
    if flight.armed and math.isinf(flight.armed[-1][1]):
        flight.armed[-1] = (flight.armed[-1][0], flight.duration_s)
        flight.notes.append("the log ends while the vehicle is armed")
    if flight.home is None and len(flight.track):
        first_armed_row = max(flight.track.index_at(flight.armed[0][0]), 0) if flight.armed else 0
        columns = ("latitude_deg", "longitude_deg", "altitude_amsl_m")
        position = (flight.track[name][first_armed_row] for name in columns)
        flight.set_home(flight.track.times[first_armed_row], *position)
    _complete_altitudes(flight)
    flight.failsafe_evidence += evidence_in_texts(flight.texts)
    flight.failsafe_evidence.sort(key=lambda evidence: evidence.time_s)


def _complete_altitudes(flight: FlightLog) -> None:
    """Derive heights above home from altitudes above sea level.

    While ArduPilot does not know home or the altitude above sea level, it logs the same value as both altitudes.
    """
    home_amsl_m = flight.home.altitude_amsl_m if flight.home is not None else None
    if home_amsl_m is None:
        return
    for columns in (flight.track, flight.position_target):
        amsl, relative = columns["altitude_amsl_m"], columns["altitude_relative_m"]
        for row, relative_m in enumerate(relative):
            amsl_m = amsl[row]
            if math.isnan(relative_m):
                relative[row] = amsl_m - home_amsl_m
            elif abs(home_amsl_m) > _SAME_ALTITUDE_M and abs(relative_m - amsl_m) < _SAME_ALTITUDE_M:
                # The value is above sea level if that puts the vehicle closer to home, otherwise above home.
                if abs(amsl_m - home_amsl_m) < abs(amsl_m):
                    relative[row] = amsl_m - home_amsl_m
                else:
                    amsl[row] = math.nan
