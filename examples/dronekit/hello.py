"""Connect and print the state.

python -m aerokit.dronekit examples/dronekit/hello.py --connect udp:127.0.0.1:14550
"""

import argparse

from dronekit import connect


def main() -> None:
    parser = argparse.ArgumentParser(description="Print the state of a vehicle.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=True)
    print("firmware:", vehicle.version)
    print("mode:", vehicle.mode.name)
    print("armed:", vehicle.armed)
    print("can be armed:", vehicle.is_armable)
    print("position:", vehicle.location.global_relative_frame)
    print("battery:", vehicle.battery)
    vehicle.close()


if __name__ == "__main__":
    main()
