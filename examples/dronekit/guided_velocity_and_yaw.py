"""Steer by velocities and headings with raw messages.

python -m aerokit.dronekit examples/dronekit/guided_velocity_and_yaw.py --connect udp:127.0.0.1:14550
"""

import argparse
import time

from dronekit import Vehicle, VehicleMode, connect, mavutil

POLL_S = 0.1
LEGS = ((2, 0, 0), (0, 2, 0), (-2, -2, 0), (0, 0, 0.5), (0, 0, 0))
"""Velocities in m/s north, east and down. The last velocity stops the vehicle."""
ONLY_VELOCITY = 0b110111000111
"""type_mask: ignore position, acceleration, yaw and yaw rate."""


def fly(vehicle: Vehicle, north: float, east: float, down: float, seconds: float) -> None:
    """Send a velocity in m/s repeatedly, because the vehicle stops when set-points stop."""
    message = vehicle.message_factory.set_position_target_local_ned_encode(
        time_boot_ms=0, target_system=0, target_component=0,
        coordinate_frame=mavutil.mavlink.MAV_FRAME_LOCAL_NED, type_mask=ONLY_VELOCITY,
        x=0, y=0, z=0, vx=north, vy=east, vz=down, afx=0, afy=0, afz=0, yaw=0, yaw_rate=0,
    )  # fmt: skip
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        vehicle.send_mavlink(message)
        time.sleep(POLL_S)


def turn(vehicle: Vehicle, heading: float, timeout: float = 20.0) -> None:
    """Turn to a heading in degrees and wait for it."""
    # With param4 = 0, param1 is a compass heading and not an angle relative to the present one.
    message = vehicle.message_factory.command_long_encode(
        target_system=0, target_component=0, command=mavutil.mavlink.MAV_CMD_CONDITION_YAW, confirmation=0,
        param1=heading, param2=0, param3=0, param4=0, param5=0, param6=0, param7=0,
    )  # fmt: skip
    vehicle.send_mavlink(message)

    def error_deg() -> float:
        return float(abs((vehicle.heading - heading + 180) % 360 - 180))

    vehicle.wait_for(
        lambda: error_deg() < 5, timeout=timeout, errmsg=f"the vehicle did not turn to {heading:g} degrees"
    )
    print(f"heading {vehicle.heading}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Fly by velocities.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each leg")
    parser.add_argument("--altitude", type=float, default=10.0, help="metres above home")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=True)
    vehicle.wait_for_armable(timeout=60)
    vehicle.wait_for_mode("GUIDED", timeout=10)
    vehicle.arm(timeout=10)
    vehicle.wait_simple_takeoff(options.altitude, epsilon=0.5, timeout=60)
    for north, east, down in LEGS:
        fly(vehicle, north, east, down, options.seconds)
        print(f"{vehicle.location.local_frame} at {vehicle.velocity} m/s")
    for heading in (90, 180):
        turn(vehicle, heading)
    vehicle.mode = VehicleMode("LAND")
    vehicle.wait_for(lambda: not vehicle.armed, timeout=60, errmsg="the vehicle did not land")
    print("landed")
    vehicle.close()


if __name__ == "__main__":
    main()
