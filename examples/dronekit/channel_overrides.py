"""Read the RC channels and override them. Do not run this in the air or while a pilot is flying.

python -m aerokit.dronekit examples/dronekit/channel_overrides.py --connect udp:127.0.0.1:14550
"""

import argparse
import time

from dronekit import Vehicle, connect

POLL_S = 0.1
TIMEOUT_S = 5.0


def wait_for_channels(vehicle: Vehicle, wanted: dict[str, int]) -> None:
    """Wait until RC_CHANNELS reports these values, which come from the receiver or from overrides."""

    def are_as_wanted() -> bool:
        return all(vehicle.channels[number] == value for number, value in wanted.items())

    vehicle.wait_for(
        are_as_wanted, timeout=TIMEOUT_S, interval=POLL_S, errmsg=f"the channels did not change to {wanted}"
    )
    print("channels:", vehicle.channels)


def main() -> None:
    parser = argparse.ArgumentParser(description="Override RC channels.")
    parser.add_argument("--connect", metavar="ADDRESS", default="udp:127.0.0.1:14550")
    options = parser.parse_args()

    vehicle = connect(options.connect, wait_ready=True)
    deadline = time.monotonic() + TIMEOUT_S
    while vehicle.channels["1"] is None and time.monotonic() < deadline:
        time.sleep(POLL_S)
    initial_channels = dict(vehicle.channels)
    print("channels:", initial_channels)

    vehicle.channels.overrides["3"] = 1100
    wait_for_channels(vehicle, {"3": 1100})
    vehicle.channels.overrides = {"1": 1600, "2": 1400}
    print("overrides:", vehicle.channels.overrides)
    wait_for_channels(vehicle, {"1": 1600, "2": 1400, "3": initial_channels["3"]})
    del vehicle.channels.overrides["1"]
    vehicle.channels.overrides["2"] = None
    wait_for_channels(vehicle, {"1": initial_channels["1"], "2": initial_channels["2"]})
    vehicle.channels.overrides = {}
    vehicle.close()


if __name__ == "__main__":
    main()
