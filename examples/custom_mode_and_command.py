"""Set modes by name and by number, and send raw commands.

python examples/custom_mode_and_command.py udpin:0.0.0.0:14550
"""

from __future__ import annotations

import asyncio
import sys

import aerokit
from aerokit import enums, errors, messages


async def main(address: str) -> None:
    """Set modes and send commands without arming the vehicle."""
    async with aerokit.connect(address) as vehicle:
        hold = vehicle.autopilot.mode_for("hold")
        if hold is not None:
            await vehicle.set_mode(hold.custom_mode)  # the number, or a name: "BRAKE"
            print(f"mode {vehicle.mode.value}")
        try:
            await vehicle.set_mode("FASTER")
        except errors.InvalidArgument as error:
            print(error)

        with vehicle.subscribe(messages.AutopilotVersion) as versions:
            await vehicle.command(enums.MavCmd.REQUEST_MESSAGE, messages.AutopilotVersion.ID)
            print(await versions.get(timeout=5))
        try:
            await vehicle.command(enums.MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10)  # refused: the vehicle is not armed
        except errors.CommandRejected as error:
            print(f"result {error.result}: {error}")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550"))
