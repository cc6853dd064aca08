"""Follow another vehicle, or a simulated walker.

python -m aerokit.dronekit examples/dronekit/follow_me.py --connect udp:127.0.0.1:14550 [--leader udp:127.0.0.1:14560]
"""

import argparse
import math
import time
from collections.abc import Callable

from dronekit import LocationGlobalRelative, VehicleMode, connect

POLL_S = 0.2
MODES = ("GUIDED", "LOITER", "TAKEOFF")
"""Modes in which ArduPilot or PX4 obeys simple_goto."""
METRES_PER_DEGREE = 111_320.0
Locator = Callable[[], LocationGlobalRelative]


def distance(one: LocationGlobalRelative, other: LocationGlobalRelative) -> float:
    """Return the horizontal distance in metres."""
    north = (other.lat - one.lat) * METRES_PER_DEGREE
    east = (other.lon - one.lon) * METRES_PER_DEGREE * math.cos(math.radians(one.lat))
    return math.hypot(north, east)


def walker(start: LocationGlobalRelative, speed: float) -> Locator:
    """Return a function that returns the position of a walker, who walks north at ``speed`` m/s."""
    started_at = time.monotonic()

    def locate() -> LocationGlobalRelative:
        walked = speed * (time.monotonic() - started_at)
        return LocationGlobalRelative(start.lat + walked / METRES_PER_DEGREE, start.lon, 0)

    return locate


def main() -> None:
    parser = argparse.ArgumentParser(description="Follow a walker or another vehicle.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    parser.add_argument("--leader", metavar="ADDRESS", help="the vehicle to follow")
    parser.add_argument("--altitude", type=float, default=10.0, help="metres above home")
    parser.add_argument("--walking-speed", type=float, default=1.5, help="metres per second")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--mode", default="GUIDED", help="mode for simple_goto (PX4: LOITER)")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=True)
    leader = connect(options.leader, wait_ready=["location"]) if options.leader else None
    vehicle.wait_for_armable(timeout=60)
    vehicle.wait_for_mode(options.mode, timeout=10)
    vehicle.arm(timeout=10)
    vehicle.wait_simple_takeoff(options.altitude, epsilon=0.5, timeout=60)

    start = vehicle.location.global_relative_frame
    locate: Locator = walker(start, options.walking_speed)
    if leader is not None:
        location = leader.location
        locate = lambda: location.global_relative_frame  # noqa: E731
    end = time.monotonic() + options.seconds
    while time.monotonic() < end and vehicle.mode.name in MODES:  # stop when the pilot changes the mode
        place = locate()
        vehicle.simple_goto(LocationGlobalRelative(place.lat, place.lon, options.altitude))
        print(f"{distance(vehicle.location.global_relative_frame, place):.0f} m behind")
        time.sleep(POLL_S)
    print(f"followed for {distance(start, vehicle.location.global_relative_frame):.0f} m")
    vehicle.mode = VehicleMode("LAND")
    vehicle.wait_for(lambda: not vehicle.armed, timeout=60, errmsg="the vehicle did not land")
    print("landed")
    vehicle.close()
    if leader is not None:
        leader.close()


if __name__ == "__main__":
    main()
