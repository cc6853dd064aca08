"""Without async: connect, print the state, take off and land.

python examples/blocking_hello.py udpin:0.0.0.0:14550
"""

from __future__ import annotations

import sys

import aerokit.sync
from aerokit import errors


def main(address: str) -> None:
    """Fly up and down. Every call returns when the action is complete; Ctrl-C ends any call."""
    with aerokit.sync.connect(address) as vehicle:
        vehicle.wait_ready()
        print(f"{vehicle.autopilot.firmware} {vehicle.version.value} at {vehicle.position.value}")
        try:
            vehicle.arm()
        except errors.CommandRejected as error:
            print(f"the vehicle does not arm: {error}")
            return
        vehicle.take_off(altitude_m=5)
        print(f"at {vehicle.position.fresh(within=2).altitude_relative_m} m")
        vehicle.land()
        vehicle.armed.wait_until(lambda armed: not armed, timeout=30)
        print("landed")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550")
