"""A payload with parameters: a winch that lowers a parcel on command, beside the autopilot.

python examples/payload.py udpout:127.0.0.1:14550          # another program commands it: MAV_CMD_USER_1, height
"""

from __future__ import annotations

import asyncio
import sys
from typing import Annotated, Any

import aerokit
from aerokit.enums import MavCmd, MavType
from aerokit.errors import InvalidArgument
from aerokit.onboard import CommandRequest, Identity, Range


async def main(address: Any, file: str = "payload.json") -> None:
    """Serve the payload until the link ends. Its parameters are kept in a file."""
    identity = Identity(vendor="Acme", model="Parcel winch", version="1.0.0")
    async with aerokit.component(
        address, component_id=191, type=MavType.WINCH, identity=identity, parameters_file=file
    ) as payload:
        payload.parameters.add("LINE_SPEED", 1.0, minimum=0.1, maximum=3.0, unit="m/s", description="Speed of the line")
        payload.parameters.add("LINE_LENGTH", 20.0, minimum=1.0, maximum=50.0, unit="m")

        @payload.command(MavCmd.USER_1)
        async def lower(request: CommandRequest, height_m: Annotated[float, Range(0.5, 50.0)]) -> None:
            """Lower the parcel by a height; COMMAND_CANCEL stops it."""
            if height_m > float(payload.parameters["LINE_LENGTH"]):
                raise InvalidArgument(f"the line has only {payload.parameters['LINE_LENGTH']} m")
            seconds = height_m / float(payload.parameters["LINE_SPEED"])
            for percent in range(0, 100, 10):
                request.report_progress(percent)
                await asyncio.sleep(seconds / 10)  # the motor of your winch runs here
            payload.send_text(f"parcel lowered by {height_m:g} m")

        print("ready")
        await payload.serve_forever()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:3]))
