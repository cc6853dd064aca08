"""Which command a vehicle flies, counted as ``Command.seq``: 0 is home."""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import LocalProtocolError
from aerokit.mavlink.enums import MavCmd, MissionState
from aerokit.mavlink.messages import MissionCurrent, MissionSetCurrent

if TYPE_CHECKING:
    from aerokit.dronekit.core import Core

__all__ = ["CurrentCommand"]

CONFIRMED_S = 1.5
"""So long MISSION_CURRENT is waited for before it is ordered by command."""
MOST = 0xFFFF
NO_MISSION = 0xFFFF


class CurrentCommand:
    """MISSION_CURRENT and MISSION_SET_CURRENT of one vehicle.

    ArduPilot counts home as 0, and is at 0 before it flies its mission. PX4 counts the first item as 0: that is 1
    here, and 0 as long as it does not fly.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._chosen: int | None = None
        """What PX4 was told to fly next and has not gone past."""
        self._latest = core.on(MissionCurrent, self._on_current)

    @property
    def seq(self) -> int:
        """The command that the vehicle flies or will fly next; 0 before its first MISSION_CURRENT."""
        message = self._latest.message
        if message is None:
            return 0
        if self._core.aio.autopilot.home_is_item_0:
            return int(message.seq)
        if message.total == NO_MISSION or (self._is_over(message) and message.seq != self._chosen):
            return 0
        return int(message.seq) + 1

    def choose(self, seq: int) -> None:
        """Have the vehicle fly this one next; does not wait.

        Raises:
            LocalProtocolError: a ValueError; it is no number from 0 to 65,535.
            APIException: the link is down.
        """
        if not 0 <= operator.index(seq) <= MOST:
            raise LocalProtocolError(f"next = {seq!r} is not allowed, but 0 to {MOST}")
        self._core.order("commands.next", self._choose, operator.index(seq))

    # ------------------------------------------------------------------------------- inside

    def _on_current(self, message: MissionCurrent) -> None:
        if message.seq != self._chosen:
            self._chosen = None

    def _is_over(self, message: MissionCurrent) -> bool:
        is_at_an_end = message.seq == 0 or message.mission_state == MissionState.COMPLETE
        return is_at_an_end and not self._core.aio.is_armed

    async def _choose(self, seq: int) -> None:
        """By the message that DroneKit sends, once; what is not heard is ordered by the rules of all orders."""
        aio = self._core.aio
        if not aio.autopilot.home_is_item_0:
            await aio.mission.set_current(max(seq - 1, 0))
            self._chosen = seq - 1
            return
        aio.send(MissionSetCurrent(aio.system_id, aio.component_id, seq))
        with anyio.move_on_after(CONFIRMED_S):
            await aio.telemetry.mission_current.wait_until(lambda progress: progress.current == seq)
            return
        if seq == 0:
            await aio.command(MavCmd.DO_SET_MISSION_CURRENT, 0)
        else:
            await aio.mission.set_current(seq - 1)
