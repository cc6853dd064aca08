"""Read attributes, listen to them, read and set parameters.

python -m aerokit.dronekit examples/dronekit/vehicle_state.py --connect udp:127.0.0.1:14550
"""

import argparse
import time

from dronekit import Vehicle, connect

ATTRIBUTES = (
    "version",
    "mode",
    "armed",
    "is_armable",
    "system_status",
    "ekf_ok",
    "attitude",
    "velocity",
    "heading",
    "airspeed",
    "groundspeed",
    "gps_0",
    "battery",
    "rangefinder",
    "last_heartbeat",
    "home_location",
)


def print_attributes(vehicle: Vehicle) -> None:
    for name in ATTRIBUTES:
        print(f"{name}: {getattr(vehicle, name)}")
    location = vehicle.location
    for place in (location.global_frame, location.global_relative_frame, location.local_frame):
        print(place)


def listen(vehicle: Vehicle, seconds: float) -> None:
    """Listen to attributes. Only a listener from add_attribute_listener can be removed."""
    headings: list[int] = []
    names: set[str] = set()

    @vehicle.on_attribute("heading")
    def on_heading(vehicle: Vehicle, name: str, value: int) -> None:
        headings.append(value)

    def on_any(vehicle: Vehicle, name: str, value: object) -> None:
        names.add(name)

    vehicle.add_attribute_listener("*", on_any)
    time.sleep(seconds)
    vehicle.remove_attribute_listener("*", on_any)
    print(f"received {len(headings)} headings, and these attributes: {', '.join(sorted(names))}")


def change_parameter(vehicle: Vehicle, name: str) -> None:
    old_value = vehicle.parameters[name]
    vehicle.parameters[name] = old_value + 1
    print(f"{name} was {old_value}, is {vehicle.parameters[name]}")
    vehicle.parameters[name] = old_value


def main() -> None:
    parser = argparse.ArgumentParser(description="Print the state of a vehicle.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    parser.add_argument("--parameter", default="RTL_LOIT_TIME", help="one to change and restore; PX4: RTL_RETURN_ALT")
    parser.add_argument("--seconds", type=float, default=3.0, help="how long to listen")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=True)
    vehicle.commands.download()  # also downloads the home position
    vehicle.commands.wait_ready()
    print_attributes(vehicle)
    listen(vehicle, options.seconds)
    print(f"{len(vehicle.parameters)} parameters")
    change_parameter(vehicle, options.parameter)
    vehicle.close()


if __name__ == "__main__":
    main()
