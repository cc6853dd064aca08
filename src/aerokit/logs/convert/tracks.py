"""GPX and KML: tracks of vehicles, and their missions."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit._internal.formatting import printable
from aerokit.logs.flights.tlog_missions import RecordedMission
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions.item import canonical_frame

if TYPE_CHECKING:
    from pathlib import Path

    from aerokit.logs.flights.flight import Waypoint
    from aerokit.logs.flights.records import LogReader, LogRecord
    from aerokit.position import Position


def _waypoint_name(waypoint: Waypoint) -> str:
    try:
        return f"{waypoint.number} {MavCmd(waypoint.command).name}"
    except ValueError:
        return f"{waypoint.number} command {waypoint.command}"


def _altitude_amsl_m(waypoint: Waypoint, home_amsl_m: float | None) -> float | None:
    frame = canonical_frame(waypoint.frame)
    if frame == MavFrame.GLOBAL:
        return waypoint.altitude_m
    if frame == MavFrame.GLOBAL_RELATIVE_ALT and home_amsl_m is not None:
        return waypoint.altitude_m + home_amsl_m
    return None


class _Track:
    """The positions of one vehicle."""

    def __init__(self) -> None:
        self.points: list[tuple[datetime, Position]] = []
        self.home_amsl_m: float | None = None

    def add(self, unix_s: float, position: Position) -> None:
        self.points.append((datetime.fromtimestamp(unix_s, timezone.utc), position))
        if position.altitude_amsl_m is not None and position.altitude_relative_m is not None:
            self.home_amsl_m = position.altitude_amsl_m - position.altitude_relative_m


class _TrackWriter:
    """Base class of writers that collect positions and missions, and write the whole file at the end."""

    def __init__(self, path: Path, log: LogReader) -> None:
        self._path, self._log = path, log
        self._tracks: dict[int, _Track] = {}
        self._missions: dict[int, RecordedMission] = {}  # by system id
        self.written: int = 0

    def write(self, record: LogRecord) -> None:
        for state, value in record.states:
            if state == "position":
                self._tracks.setdefault(record.system_id, _Track()).add(record.unix_s, value)
                self.written += 1
        if isinstance(record.message, RecordedMission.MESSAGES):
            self._record_mission(record)

    def discard(self) -> None:
        pass  # nothing to discard, because only `close` opens the file

    def close(self) -> None:
        if not self.written:
            self._log.notes.append("the log contains no position; there is no track")
        self._path.write_text(self._text(), encoding="utf-8")

    def _record_mission(self, record: LogRecord) -> None:
        message: Any = record.message
        # Before a HEARTBEAT, it is unknown whether the sender or the receiver is the vehicle, so both get the mission.
        for system_id in {record.system_id, message.target_system}:
            if system_id not in self._missions:
                self._missions[system_id] = RecordedMission(system_id)
            self._missions[system_id].on_message(record.unix_s, message)

    def _waypoints(self, system_id: int) -> list[Waypoint]:
        if system_id not in self._missions:
            return []
        return [
            waypoint
            for waypoint in self._missions[system_id].waypoints
            # These comparisons are False for NaN.
            if abs(waypoint.latitude_deg) <= 90
            and abs(waypoint.longitude_deg) <= 180
            and math.isfinite(waypoint.altitude_m)
        ]

    def _text(self) -> str:
        raise NotImplementedError


class GpxWriter(_TrackWriter):
    """Writes ``.gpx``: for each vehicle a track with times, and its mission. Altitudes are above sea level."""

    def _text(self) -> str:
        gpx = import_module("gpxpy.gpx")
        file = gpx.GPX()
        file.creator = "aerokit"
        for system_id, track in self._tracks.items():
            segment = gpx.GPXTrackSegment(
                [
                    gpx.GPXTrackPoint(
                        position.latitude_deg, position.longitude_deg, elevation=position.altitude_amsl_m, time=time
                    )
                    for time, position in track.points
                ]
            )
            gpx_track = gpx.GPXTrack(name=f"vehicle {system_id}")
            gpx_track.segments.append(segment)
            file.tracks.append(gpx_track)
            for waypoint in self._waypoints(system_id):
                file.waypoints.append(
                    gpx.GPXWaypoint(
                        waypoint.latitude_deg,
                        waypoint.longitude_deg,
                        elevation=_altitude_amsl_m(waypoint, track.home_amsl_m),
                        name=_waypoint_name(waypoint),
                    )
                )
        return str(file.to_xml())


class KmlWriter(_TrackWriter):
    """Writes ``.kml``: for each vehicle a gx:Track with times, and the waypoints of its mission."""

    def _text(self) -> str:
        kml = import_module("simplekml")
        file = kml.Kml(name=printable(self._log.path.name))
        for system_id, track in self._tracks.items():
            folder = file.newfolder(name=f"vehicle {system_id}")
            # Without altitudes above sea level, write the altitudes above home. KML has no mode for them, so they
            # count as above ground.
            is_absolute = all(position.altitude_amsl_m is not None for _, position in track.points)
            mode = kml.AltitudeMode.absolute if is_absolute else kml.AltitudeMode.relativetoground
            line = folder.newgxtrack(name="track", altitudemode=mode)
            line.newwhen([time.isoformat(timespec="milliseconds") for time, _ in track.points])
            line.newgxcoord(
                [
                    (
                        position.longitude_deg,
                        position.latitude_deg,
                        (position.altitude_amsl_m if is_absolute else position.altitude_relative_m) or 0.0,
                    )
                    for _, position in track.points
                ]
            )
            for waypoint in self._waypoints(system_id):
                amsl_m = _altitude_amsl_m(waypoint, track.home_amsl_m)
                is_known = amsl_m is not None
                folder.newpoint(
                    name=_waypoint_name(waypoint),
                    coords=[
                        (waypoint.longitude_deg, waypoint.latitude_deg, amsl_m if is_known else waypoint.altitude_m)
                    ],
                    altitudemode=kml.AltitudeMode.absolute if is_known else kml.AltitudeMode.relativetoground,
                )
        return str(file.kml())
