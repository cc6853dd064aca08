"""Messages and set-points in a plain loop, without async.

python examples/blocking_messages.py udpin:0.0.0.0:14550
"""

from __future__ import annotations

import sys

import aerokit.sync
from aerokit import VelocitySetpoint, messages


def main(address: str) -> None:
    """Fly sideways and print speed and altitude."""
    with aerokit.sync.connect(address) as vehicle:
        vehicle.wait_ready()
        vehicle.arm()
        vehicle.take_off(altitude_m=5)
        with (
            vehicle.guided.velocity() as stream,
            vehicle.subscribe(messages.VfrHud, rate_hz=10) as received,
        ):
            for count, message in enumerate(received):
                stream.set(VelocitySetpoint(east_m_s=3))
                print(f"{message.groundspeed:.1f} m/s at {message.alt:.1f} m")
                if count == 20:
                    break
        print(f"holding in {vehicle.mode_name}")
        vehicle.land()


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550")
