"""Take off, visit two places, return.

python -m aerokit.dronekit examples/dronekit/simple_goto.py --connect udp:127.0.0.1:14550
"""

import argparse
import math
import time

from dronekit import LocationGlobalRelative, Vehicle, VehicleMode, connect

POLL_S = 0.2
MODES = ("GUIDED", "LOITER", "TAKEOFF")
"""Modes in which ArduPilot or PX4 obeys simple_goto."""
METRES_PER_DEGREE = 111_320.0


def offset(place: LocationGlobalRelative, north: float, east: float) -> LocationGlobalRelative:
    """Return the place that is ``north`` and ``east`` metres away, at the same altitude."""
    lon = place.lon + east / METRES_PER_DEGREE / math.cos(math.radians(place.lat))
    return LocationGlobalRelative(place.lat + north / METRES_PER_DEGREE, lon, place.alt)


def distance(one: LocationGlobalRelative, other: LocationGlobalRelative) -> float:
    """Return the horizontal distance in metres."""
    north = (other.lat - one.lat) * METRES_PER_DEGREE
    east = (other.lon - one.lon) * METRES_PER_DEGREE * math.cos(math.radians(one.lat))
    return math.hypot(north, east)


def arm_and_take_off(vehicle: Vehicle, mode: str, altitude: float) -> None:
    while not vehicle.is_armable:
        time.sleep(POLL_S)
    vehicle.mode = VehicleMode(mode)
    while vehicle.mode != mode:
        time.sleep(POLL_S)
    vehicle.armed = True
    while not vehicle.armed:
        time.sleep(POLL_S)
    vehicle.simple_takeoff(altitude)
    while vehicle.location.global_relative_frame.alt < altitude * 0.95:
        time.sleep(POLL_S)
    print(f"at {altitude:g} m")


def go_to(vehicle: Vehicle, place: LocationGlobalRelative, speed: float) -> None:
    """Return on arrival, or when the pilot has changed the mode."""
    vehicle.simple_goto(place, groundspeed=speed)
    while vehicle.mode.name in MODES:
        remaining = distance(vehicle.location.global_relative_frame, place)
        if remaining < 1.0:
            print("there")
            return
        print(f"{remaining:.0f} m to go")
        time.sleep(POLL_S)


def main() -> None:
    parser = argparse.ArgumentParser(description="Fly to two places in GUIDED mode.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    parser.add_argument("--altitude", type=float, default=10.0, help="metres above home")
    parser.add_argument("--mode", default="GUIDED", help="mode for simple_goto (PX4: LOITER)")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=True)
    arm_and_take_off(vehicle, options.mode, options.altitude)
    start = vehicle.location.global_relative_frame
    go_to(vehicle, offset(start, north=30, east=0), speed=5)
    go_to(vehicle, offset(start, north=30, east=30), speed=10)
    vehicle.mode = VehicleMode("RTL")
    while vehicle.armed:
        time.sleep(POLL_S)
    print("landed")
    vehicle.close()


if __name__ == "__main__":
    main()
