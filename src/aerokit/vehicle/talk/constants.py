"""Asks a vehicle for what it does not stream: version, home, origin, the names of its modes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import AutopilotVersion, AvailableModes, GpsGlobalOrigin, HomePosition

if TYPE_CHECKING:
    from aerokit.runtime.connection import Connection
    from aerokit.vehicle.state.telemetry import Telemetry
    from aerokit.vehicle.talk.commands import CommandSender

__all__ = ["learn_constants"]

ASK_AGAIN_S = 3.0
EAGER_REQUESTS, EAGER_S = 4, 0.3


async def learn_constants(connection: Connection, commands: CommandSender, telemetry: Telemetry) -> None:
    """Ask until it is known, for as long as the connection is open; a reboot makes it unknown again."""
    asked_for_modes = False
    await _learn_version(commands, telemetry)
    while connection.is_open:
        for message_id, cell in (
            (AutopilotVersion.ID, telemetry.version),
            (HomePosition.ID, telemetry.home),
            (GpsGlobalOrigin.ID, telemetry.origin),
        ):
            if not cell.is_known:
                await _request(commands, message_id)
        if not asked_for_modes:
            asked_for_modes = await _request(commands, AvailableModes.ID)
        await anyio.sleep(ASK_AGAIN_S)


async def _learn_version(commands: CommandSender, telemetry: Telemetry) -> None:
    """The first transfer waits for what the vehicle can do: ask eagerly, an answer may get lost behind its ack."""
    version = telemetry.version
    for _ in range(EAGER_REQUESTS):
        if version.is_known:
            return
        await _request(commands, AutopilotVersion.ID, attempt_timeout=EAGER_S)
        with anyio.move_on_after(EAGER_S):
            await version.wait_until(lambda _: True)


async def _request(commands: CommandSender, message_id: int, *, attempt_timeout: float = 1.0) -> bool:
    """Ask for one message once; whether there was an answer, also that the vehicle does not have it."""
    try:
        await commands.send_long(
            MavCmd.REQUEST_MESSAGE, message_id, attempts=2, attempt_timeout=attempt_timeout
        )
    except CommandTimeout:
        return False
    except CommandRejected:
        pass
    return True
