"""Flight logs as flights: `read_flight` reads a log into time series; see docs/report.md."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.errors import FileFormatError
from aerokit.logs.flights.failsafes import Failsafe, evidence_in_fixes, evidence_in_texts, failsafes
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
# A vehicle less than `_FLYING_HEIGHT_M` above home may be on the ground. A sink rate below `_SINKING_M_S` is noise.
_FLYING_HEIGHT_M, _SINKING_M_S = 1.0, 0.3
_SAME_ALTITUDE_M = 5.0  # Two logged altitudes that differ by at most this count as the same altitude.


def check_log_name(path: Path) -> None:
    """Raise FileFormatError if the suffix of the name is not supported."""
    if path.suffix.lower() not in LOG_READERS:
        raise FileFormatError(f"{path} is not a flight log; supported suffixes: {', '.join(LOG_READERS)}")


def progress_callback(total: int, on_progress: OnProgress | None) -> Callable[[int], object]:
    """Return a function that reports how many of ``total`` bytes were read so far to ``on_progress``."""
    started_at = time.monotonic()
    if on_progress is None:
        return lambda bytes_read: None
    return lambda bytes_read: on_progress(
        TransferProgress(min(bytes_read, total), total, time.monotonic() - started_at)
    )


def read_flight(
    log: str | os.PathLike[str], *, system_id: int | None = None, on_progress: OnProgress | None = None
) -> FlightLog:
    """Read a flight from a log. If the log is damaged, only its readable part is returned.

    The function blocks and needs no event loop.

    Args:
        log: a ``.tlog`` of a ground station or of ``record=``, a ``.bin`` of ArduPilot, or a ``.ulg`` of PX4.
        system_id: system id of the vehicle, if a ``.tlog`` contains several vehicles; None selects the first vehicle.
        on_progress: called from time to time with the number of bytes read so far.

    Raises:
        FileFormatError: the file is not a flight log, or nothing in it can be read.
        OSError: the file cannot be read.
        ModuleNotFoundError: pyulog, of the extra ``report``, is not installed (``.ulg``).
    """
    path = Path(log)
    check_log_name(path)
    read = LOG_READERS[path.suffix.lower()]
    size = path.stat().st_size
    report_progress = progress_callback(size, on_progress)
    report_progress(0)
    flight = FlightLog(path)
    read(flight, system_id, report_progress)
    _complete(flight)
    report_progress(size)
    return flight


def _complete(flight: FlightLog) -> None:
    """Compute home, heights and failsafe evidence after the whole log is read."""
    _, last_disarmed_s = flight.armed[-1] if flight.armed else (0.0, 0.0)
    is_armed_at_end = math.isinf(last_disarmed_s)
    flight.set_armed(flight.duration_s, armed=False)  # ends an open span
    track = flight.track
    if flight.home is None and len(track):  # use the position at the first arming, or else the first position
        row = 0
        if flight.armed:
            first_armed_s, _ = flight.armed[0]
            row = max(track.index_at(first_armed_s), 0)
        latitude, longitude = track["latitude_deg"][row], track["longitude_deg"][row]
        flight.set_home(track.times[row], latitude, longitude, track["altitude_amsl_m"][row])
    _complete_altitudes(flight)
    if is_armed_at_end:
        flight.notes.append(_armed_at_end_note(flight))
    flight.failsafe_evidence += evidence_in_texts(flight.texts) + evidence_in_fixes(flight)
    flight.failsafe_evidence.sort(key=lambda evidence: evidence.time_s)


def _armed_at_end_note(flight: FlightLog) -> str:
    note = "the log ends while the vehicle is armed"
    is_silent = bool(flight.silences) and flight.silences[-1].ends_s >= flight.duration_s
    last_heard_s = flight.silences[-1].begins_s if is_silent else flight.duration_s
    height_m = flight.track.at("altitude_relative_m", last_heard_s)
    if height_m < _FLYING_HEIGHT_M:  # False if the height is unknown (NaN)
        return note
    where = "" if math.isnan(height_m) else f", {height_m:.1f} m above home"
    sink_m_s = flight.velocity.at("down_m_s", last_heard_s)
    motion = f", sinking at {sink_m_s:.1f} m/s" if sink_m_s >= _SINKING_M_S else ""
    mode = flight.mode_at(flight.duration_s)
    in_mode = f" in {mode}" if mode else ""
    when = f", last heard {flight.duration_s - last_heard_s:.0f} s before the end" if is_silent else ""
    state = f"{where}{in_mode}{motion}{when}"
    return f"{note}{state}: the rest of the flight, and with it a landing or a crash, was not recorded"


def _complete_altitudes(flight: FlightLog) -> None:
    home_amsl_m = flight.home.altitude_amsl_m if flight.home is not None else None
    if home_amsl_m is None:
        return
    is_home_at_sea_level = abs(home_amsl_m) <= _SAME_ALTITUDE_M
    for series in (flight.track, flight.position_target):
        amsl, relative = series["altitude_amsl_m"], series["altitude_relative_m"]
        for row, relative_m in enumerate(relative):
            amsl_m = amsl[row]
            if math.isnan(relative_m):
                relative[row] = amsl_m - home_amsl_m
            # While ArduPilot knows only one of the two altitudes, it logs the same value in both columns.
            elif not is_home_at_sea_level and abs(relative_m - amsl_m) < _SAME_ALTITUDE_M:
                is_above_sea_level = abs(amsl_m - home_amsl_m) < abs(amsl_m)  # nearer to home's altitude than to 0
                if is_above_sea_level:
                    relative[row] = amsl_m - home_amsl_m
                else:
                    amsl[row] = math.nan
