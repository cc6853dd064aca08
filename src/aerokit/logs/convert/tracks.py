"""GPX and KML: where the vehicles flew, and the missions they were given."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import MavCmd, MavFrame

if TYPE_CHECKING:
    from pathlib import Path

    from aerokit.logs.flights.entries import Entry, Log
    from aerokit.position import Position

_ABSOLUTE = frozenset((MavFrame.GLOBAL, MavFrame.GLOBAL_INT))
_RELATIVE = frozenset((MavFrame.GLOBAL_RELATIVE_ALT, MavFrame.GLOBAL_RELATIVE_ALT_INT))
_TERRAIN = frozenset((MavFrame.GLOBAL_TERRAIN_ALT, MavFrame.GLOBAL_TERRAIN_ALT_INT))


class Waypoint(Snapshot):
    """A place of a mission; the altitude is above the sea, above home, or above the ground, as ``frame`` says."""

    index: int
    command: int
    frame: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    @property
    def name(self) -> str:
        """``"3 NAV_WAYPOINT"``."""
        try:
            return f"{self.index} {MavCmd(self.command).name}"
        except ValueError:
            return f"{self.index} command {self.command}"

    def altitude_amsl_m(self, home_amsl_m: float | None) -> float | None:
        """Above mean sea level; None where that is not known."""
        if self.frame in _ABSOLUTE:
            return self.altitude_m
        return self.altitude_m + home_amsl_m if self.frame in _RELATIVE and home_amsl_m is not None else None


class _Track:
    """The positions of one vehicle, and its mission as it was told last."""

    def __init__(self) -> None:
        self.points: list[tuple[datetime, Position]] = []
        self.waypoints: dict[int, Waypoint] = {}
        self.home_amsl_m: float | None = None

    def add(self, unix_s: float, place: Position) -> None:
        self.points.append((datetime.fromtimestamp(unix_s, timezone.utc), place))
        if place.altitude_amsl_m is not None and place.altitude_relative_m is not None:
            self.home_amsl_m = place.altitude_amsl_m - place.altitude_relative_m


class _Tracks:
    """What both formats gather; the file is written at the end."""

    def __init__(self, path: Path, log: Log) -> None:
        self._path, self._log = path, log
        self._tracks: dict[int, _Track] = {}
        self._mission: dict[int, Waypoint] = {}
        self.written: int = 0

    def take(self, entry: Entry) -> None:
        """Keep the positions and the items of missions."""
        for state, value in entry.states:
            if state == "position":
                self._tracks.setdefault(entry.system_id, _Track()).add(entry.unix_s, value)
                self.written += 1
        if entry.table in _ITEMS:
            self._take_item(entry)

    def abandon(self) -> None:
        """Nothing is open."""

    def close(self) -> None:
        """Write the file."""
        if not self.written:
            self._log.notes.append("no position is in this log: there is no track")
        self._path.write_text(self._text(), encoding="utf-8")

    def _take_item(self, entry: Entry) -> None:
        item: Any = entry.message
        if item is None or item.mission_type or item.frame not in _ABSOLUTE | _RELATIVE | _TERRAIN:
            return
        if item.target_system in self._tracks:  # somebody sends it to a vehicle
            system_id = item.target_system
        elif entry.system_id in self._tracks:  # a vehicle tells it
            system_id = entry.system_id
        else:
            return
        scale = 1e7 if item.NAME == "MISSION_ITEM_INT" else 1.0
        latitude, longitude = item.x / scale, item.y / scale
        # 0, 0 is no place, but where it is then; NaN and what is not on earth is none, either
        is_place = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude or longitude)
        if is_place and math.isfinite(item.z):
            self._tracks[system_id].waypoints[item.seq] = Waypoint(
                item.seq, item.command, item.frame, latitude, longitude, item.z
            )

    def _text(self) -> str:
        raise NotImplementedError


_ITEMS = frozenset(("MISSION_ITEM_INT", "MISSION_ITEM"))


class GpxFile(_Tracks):
    """``.gpx``: a track with times and elevations above the sea for each vehicle, and waypoints of its mission."""

    def _text(self) -> str:
        gpx = import_module("gpxpy.gpx")
        file = gpx.GPX()
        file.creator = "aerokit"
        for system_id, track in self._tracks.items():
            segment = gpx.GPXTrackSegment(
                [
                    gpx.GPXTrackPoint(
                        place.latitude_deg, place.longitude_deg, elevation=place.altitude_amsl_m, time=at
                    )
                    for at, place in track.points
                ]
            )
            written = gpx.GPXTrack(name=f"vehicle {system_id}")
            written.segments.append(segment)
            file.tracks.append(written)
            for _, waypoint in sorted(track.waypoints.items()):
                file.waypoints.append(
                    gpx.GPXWaypoint(
                        waypoint.latitude_deg,
                        waypoint.longitude_deg,
                        elevation=waypoint.altitude_amsl_m(track.home_amsl_m),
                        name=waypoint.name,
                    )
                )
        return str(file.to_xml())


class KmlFile(_Tracks):
    """``.kml``: a gx:Track with times for each vehicle, and its mission as points and a line."""

    def _text(self) -> str:
        kml = import_module("simplekml")
        file = kml.Kml(name=self._log.path.name)
        for system_id, track in self._tracks.items():
            folder = file.newfolder(name=f"vehicle {system_id}")
            # Above the sea where that is known; else above home, which is nearest to "above the ground".
            is_absolute = all(place.altitude_amsl_m is not None for _, place in track.points)
            mode = kml.AltitudeMode.absolute if is_absolute else kml.AltitudeMode.relativetoground
            line = folder.newgxtrack(name="track", altitudemode=mode)
            line.newwhen([at.isoformat(timespec="milliseconds") for at, _ in track.points])
            line.newgxcoord(
                [
                    (
                        place.longitude_deg,
                        place.latitude_deg,
                        (place.altitude_amsl_m if is_absolute else place.altitude_relative_m) or 0.0,
                    )
                    for _, place in track.points
                ]
            )
            for _, waypoint in sorted(track.waypoints.items()):
                altitude = waypoint.altitude_amsl_m(track.home_amsl_m)
                known = altitude is not None
                folder.newpoint(
                    name=waypoint.name,
                    coords=[
                        (
                            waypoint.longitude_deg,
                            waypoint.latitude_deg,
                            altitude if known else waypoint.altitude_m,
                        )
                    ],
                    altitudemode=kml.AltitudeMode.absolute if known else kml.AltitudeMode.relativetoground,
                )
        return str(file.kml())
