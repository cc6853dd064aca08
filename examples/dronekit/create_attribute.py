"""Add an attribute to Vehicle, from a message that DroneKit does not use.

python -m aerokit.dronekit examples/dronekit/create_attribute.py --connect udp:127.0.0.1:14550
"""

import argparse
import threading
from typing import Any

from dronekit import Vehicle, connect


class Vibration:
    """Vibration levels in m/s², and the number of accelerometer clippings."""

    def __init__(self, x: float, y: float, z: float, clippings: int) -> None:
        self.x = x
        self.y = y
        self.z = z
        self.clippings = clippings

    def __str__(self) -> str:
        return f"Vibration: x={self.x:.4f}, y={self.y:.4f}, z={self.z:.4f}, clippings={self.clippings}"


class ShakingVehicle(Vehicle):
    """Vehicle with the attribute ``vibration``, None before the first VIBRATION."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._vibration: Vibration | None = None

        @self.on_message("VIBRATION")
        def on_vibration(vehicle: Vehicle, name: str, message: Any) -> None:
            clippings = message.clipping_0 + message.clipping_1 + message.clipping_2
            self._vibration = Vibration(message.vibration_x, message.vibration_y, message.vibration_z, clippings)
            self.notify_attribute_listeners("vibration", self._vibration)

    @property
    def vibration(self) -> Vibration | None:
        return self._vibration


def main() -> None:
    parser = argparse.ArgumentParser(description="Print the vibration of a vehicle.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    parser.add_argument("--count", type=int, default=5, help="number of values")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=["mode", "vibration"], vehicle_class=ShakingVehicle)
    print("first:", vehicle.vibration)
    remaining = options.count
    done = threading.Event()

    def print_it(vehicle: Vehicle, name: str, value: Vibration) -> None:
        nonlocal remaining
        print(f"{name}: {value}")
        remaining -= 1
        if remaining == 0:
            vehicle.remove_attribute_listener(name, print_it)
            done.set()

    vehicle.add_attribute_listener("vibration", print_it)
    if not done.wait(30):
        print("no further VIBRATION within 30 s")
    vehicle.close()


if __name__ == "__main__":
    main()
