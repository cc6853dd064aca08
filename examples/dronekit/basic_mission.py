"""Write a mission, read it back, fly it.

python -m aerokit.dronekit examples/dronekit/basic_mission.py --connect udp:127.0.0.1:14550
"""

import argparse
import math
import time

from dronekit import Command, LocationGlobal, Vehicle, VehicleMode, connect, mavutil

POLL_S = 0.2
METRES_PER_DEGREE = 111_320.0
TAKEOFF = mavutil.mavlink.MAV_CMD_NAV_TAKEOFF
WAYPOINT = mavutil.mavlink.MAV_CMD_NAV_WAYPOINT
RETURN = mavutil.mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH
ABOVE_HOME = mavutil.mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT


def item(command: int, lat: float, lon: float, altitude: float) -> Command:
    """Make a mission item with an altitude above home. Adding the item to a mission sets target and seq."""
    return Command(
        target_system=0, target_component=0, seq=0, frame=ABOVE_HOME, command=command, current=0, autocontinue=1,
        param1=0, param2=0, param3=0, param4=0, x=lat, y=lon, z=altitude,
    )  # fmt: skip


def download(vehicle: Vehicle) -> None:
    vehicle.commands.download()
    vehicle.commands.wait_ready()


def upload_square(vehicle: Vehicle, home: LocationGlobal, side: float, altitude: float) -> None:
    """Upload take-off, four corners around home, return."""
    north = side / 2 / METRES_PER_DEGREE
    east = north / math.cos(math.radians(home.lat))
    commands = vehicle.commands
    commands.clear()
    commands.add(item(TAKEOFF, 0, 0, altitude))
    for north_sign, east_sign in ((1, -1), (1, 1), (-1, 1), (-1, -1)):
        commands.add(item(WAYPOINT, home.lat + north_sign * north, home.lon + east_sign * east, altitude))
    commands.add(item(RETURN, 0, 0, 0))
    commands.upload()


def arm(vehicle: Vehicle, mode: str) -> None:
    while not vehicle.is_armable:
        time.sleep(POLL_S)
    vehicle.mode = VehicleMode(mode)
    vehicle.armed = True
    while not vehicle.armed:
        time.sleep(POLL_S)


def fly_mission(vehicle: Vehicle, mode: str, altitude: float) -> None:
    """Take off first: ArduCopter starts a mission on the ground only if AUTO_OPTIONS allows it."""
    vehicle.simple_takeoff(altitude)
    while vehicle.location.global_relative_frame.alt < altitude * 0.9:
        time.sleep(POLL_S)
    vehicle.commands.next = 1
    vehicle.mode = VehicleMode(mode)
    shown = 0
    while vehicle.armed:
        if vehicle.commands.next != shown:
            shown = vehicle.commands.next
            print(f"executing command {shown} of {len(vehicle.commands)}")
        time.sleep(POLL_S)


def main() -> None:
    parser = argparse.ArgumentParser(description="Fly a square as a mission.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    parser.add_argument("--side", type=float, default=40.0, help="metres")
    parser.add_argument("--altitude", type=float, default=10.0, help="metres above home")
    parser.add_argument("--px4", action="store_true", help="use the mode names of PX4")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=True)
    download(vehicle)
    home = vehicle.home_location
    if home is None:
        raise SystemExit("the vehicle has no home position yet")
    upload_square(vehicle, home, options.side, options.altitude)
    download(vehicle)
    for command in vehicle.commands:
        print(f"{command.seq}: command {command.command} at {command.x:.6f}, {command.y:.6f}, {command.z:g} m")
    arm(vehicle, "LOITER" if options.px4 else "GUIDED")
    fly_mission(vehicle, "MISSION" if options.px4 else "AUTO", options.altitude)
    print("landed")
    vehicle.close()


if __name__ == "__main__":
    main()
