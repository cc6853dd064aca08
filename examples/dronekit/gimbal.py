"""Point a gimbal: by angles, then at a place, then back to the pilot.

python -m aerokit.dronekit examples/dronekit/gimbal.py --connect udp:127.0.0.1:14550
"""

import argparse
import time

from dronekit import LocationGlobalRelative, Vehicle, connect

METRES_PER_DEGREE = 111_320.0


def look(vehicle: Vehicle, seconds: float) -> None:
    time.sleep(seconds)
    print(vehicle.gimbal)


def main() -> None:
    parser = argparse.ArgumentParser(description="Point a gimbal.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each direction")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=["mode", "location.global_relative_frame"])
    look(vehicle, options.seconds)
    if vehicle.gimbal.pitch is None:
        print("no gimbal attitude received; sending commands anyway")
    for pitch, yaw in ((-90, 0), (-45, 90), (0, 0)):
        print(f"pitch {pitch}, yaw {yaw}")
        vehicle.gimbal.rotate(pitch, 0, yaw)
        look(vehicle, options.seconds)
    here = vehicle.location.global_relative_frame
    north_of_here = LocationGlobalRelative(here.lat + 100 / METRES_PER_DEGREE, here.lon, 0)
    print("at", north_of_here)
    vehicle.gimbal.target_location(north_of_here)
    look(vehicle, options.seconds)
    vehicle.gimbal.release()
    print("released")
    vehicle.close()


if __name__ == "__main__":
    main()
