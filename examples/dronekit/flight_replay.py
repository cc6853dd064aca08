"""Fly the track of a recorded flight as a mission.

python -m aerokit.dronekit examples/dronekit/flight_replay.py flight.tlog --connect udp:127.0.0.1:14550
"""

import argparse
import math
import time

from dronekit import Command, LocationGlobalRelative, Vehicle, VehicleMode, connect, mavutil

POLL_S = 0.2
METRES_PER_DEGREE = 111_320.0
WAYPOINT = mavutil.mavlink.MAV_CMD_NAV_WAYPOINT
ABOVE_HOME = mavutil.mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT


def distance(one: LocationGlobalRelative, other: LocationGlobalRelative) -> float:
    """Return the distance in metres, altitude included."""
    north = (other.lat - one.lat) * METRES_PER_DEGREE
    east = (other.lon - one.lon) * METRES_PER_DEGREE * math.cos(math.radians(one.lat))
    return math.hypot(north, east, other.alt - one.alt)


def track_of(path: str, spacing: float, lowest: float) -> list[LocationGlobalRelative]:
    """Return places of a flight, at least ``spacing`` metres apart and above ``lowest``."""
    track: list[LocationGlobalRelative] = []
    recording = mavutil.mavlink_connection(path)
    while (message := recording.recv_match(type="GLOBAL_POSITION_INT")) is not None:
        place = LocationGlobalRelative(message.lat / 1e7, message.lon / 1e7, message.relative_alt / 1000)
        if place.alt >= lowest and (not track or distance(track[-1], place) >= spacing):
            track.append(place)
    recording.close()
    return track


def here(vehicle: Vehicle) -> LocationGlobalRelative:
    return vehicle.location.global_relative_frame


def upload(vehicle: Vehicle, track: list[LocationGlobalRelative]) -> None:
    commands = vehicle.commands
    commands.clear()
    for place in track:
        commands.add(Command(
            target_system=0, target_component=0, seq=0, frame=ABOVE_HOME, command=WAYPOINT, current=0, autocontinue=1,
            param1=0, param2=0, param3=0, param4=0, x=place.lat, y=place.lon, z=place.alt,
        ))  # fmt: skip
    commands.upload()


def main() -> None:
    parser = argparse.ArgumentParser(description="Fly the track of a recorded flight.")
    parser.add_argument("recording", help="a .tlog file")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    parser.add_argument("--spacing", type=float, default=5.0, help="metres between waypoints")
    parser.add_argument("--farthest", type=float, default=1000.0, help="maximum distance to its start, in metres")
    parser.add_argument("--px4", action="store_true", help="use the mode names of PX4")
    options = parser.parse_args()

    track = track_of(options.recording, options.spacing, lowest=2.0)
    if not track:
        raise SystemExit("the recording has no flight")
    vehicle = connect(options.connect, wait_ready=True)
    distance_to_start = distance(here(vehicle), track[0])
    if distance_to_start > options.farthest:
        raise SystemExit(f"the recorded flight starts {distance_to_start:.0f} m away, more than --farthest")
    print(f"{len(track)} waypoints")
    upload(vehicle, track)

    vehicle.wait_for_armable(timeout=60)
    vehicle.wait_for_mode("LOITER" if options.px4 else "GUIDED", timeout=10)
    vehicle.arm(timeout=10)
    vehicle.wait_simple_takeoff(track[0].alt, epsilon=0.5, timeout=60)
    vehicle.commands.next = 1
    vehicle.mode = VehicleMode("MISSION" if options.px4 else "AUTO")
    while vehicle.commands.next < len(track) or distance(here(vehicle), track[-1]) > 2.0:
        print(f"to waypoint {vehicle.commands.next}, {here(vehicle)}")
        time.sleep(POLL_S)
    print("at the end of the track")
    vehicle.mode = VehicleMode("RTL")
    vehicle.wait_for(lambda: not vehicle.armed, timeout=300, errmsg="the vehicle did not land")
    vehicle.close()


if __name__ == "__main__":
    main()
