"""Asks a vehicle for what it does not stream: version, home, origin, the names of its modes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import CommandRejected, CommandTimeout

if TYPE_CHECKING:
    from aerokit.runtime.connection import Connection
    from aerokit.vehicle.state.telemetry import Telemetry
    from aerokit.vehicle.talk.commands import CommandSender

__all__ = ["HOME_POSITION", "REQUEST_MESSAGE", "learn_constants"]

REQUEST_MESSAGE = 512
AUTOPILOT_VERSION, HOME_POSITION, GPS_GLOBAL_ORIGIN, AVAILABLE_MODES = 148, 242, 49, 435
ASK_AGAIN_S = 3.0
EAGER_REQUESTS, EAGER_S = 4, 0.3


async def learn_constants(connection: Connection, commands: CommandSender, telemetry: Telemetry) -> None:
    """Ask until it is known, for as long as the connection is open; a reboot makes it unknown again."""
    asked_for_modes = False
    await _learn_version(commands, telemetry)
    while connection.is_open:
        for message_id, cell in (
            (AUTOPILOT_VERSION, telemetry.version),
            (HOME_POSITION, telemetry.home),
            (GPS_GLOBAL_ORIGIN, telemetry.origin),
        ):
            if not cell.is_known:
                await _request(commands, message_id)
        if not asked_for_modes:
            asked_for_modes = await _request(commands, AVAILABLE_MODES)
        await anyio.sleep(ASK_AGAIN_S)


async def _learn_version(commands: CommandSender, telemetry: Telemetry) -> None:
    """The first transfer waits for what the vehicle can do: ask eagerly, an answer may get lost behind its ack."""
    version = telemetry.version
    for _ in range(EAGER_REQUESTS):
        if version.is_known:
            return
        await _request(commands, AUTOPILOT_VERSION, attempt_timeout=EAGER_S)
        with anyio.move_on_after(EAGER_S):
            await version.wait_until(lambda _: True)


async def _request(commands: CommandSender, message_id: int, *, attempt_timeout: float = 1.0) -> bool:
    """Ask for one message once; whether there was an answer, also that the vehicle does not have it."""
    try:
        await commands.send_long(REQUEST_MESSAGE, message_id, attempts=2, attempt_timeout=attempt_timeout)
    except CommandTimeout:
        return False
    except CommandRejected:
        pass
    return True
