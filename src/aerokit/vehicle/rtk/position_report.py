"""The vehicle's position as an NMEA GGA sentence, which casters of virtual reference stations need."""

from __future__ import annotations

import time
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.vehicle.state.telemetry import Telemetry

MAX_AGE_S = 10.0
# GPS_FIX_TYPE → quality of GGA: 1 autonomous, 2 differential, 4 RTK fixed, 5 RTK float.
QUALITIES = {4: 2, 5: 5, 6: 4}


def gga_sentence(telemetry: Telemetry, unix_time: float) -> bytes | None:
    """Return the position as ``$GPGGA,…``; None while no recent position is known."""
    cell = telemetry.position
    place = cell.latest
    if place is None or cell.age > MAX_AGE_S or place.altitude_amsl_m is None:
        return None
    receiver = next(iter(telemetry.cells["gps"].latest or ()), None)
    quality = QUALITIES.get(receiver.fix_type, 1) if receiver is not None else 1
    satellites = (receiver.satellites if receiver is not None else None) or 4
    clock = time.strftime("%H%M%S", time.gmtime(unix_time))
    fields = (
        f"GPGGA,{clock}.00,{_angle(place.latitude_deg, 2)},{'NS'[place.latitude_deg < 0]},"
        f"{_angle(place.longitude_deg, 3)},{'EW'[place.longitude_deg < 0]},{quality},{satellites:02d},1.0,"
        f"{place.altitude_amsl_m:.1f},M,0.0,M,,"
    )
    return f"${fields}*{reduce(xor, fields.encode()):02X}\r\n".encode()


def _angle(degrees: float, digits: int) -> str:
    """Return degrees and minutes without a separator: 4723.86456."""
    units = round(abs(degrees) * 60 * 100_000)
    whole, rest = divmod(units, 60 * 100_000)
    return f"{whole:0{digits}d}{rest // 100_000:02d}.{rest % 100_000:05d}"
