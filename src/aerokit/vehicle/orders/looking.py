"""Looking at a place: the region of interest."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from aerokit.arguments import checks_arguments
from aerokit.errors import CommandRejected, CommandTimeout, OperationRejected
from aerokit.mavlink.enums import MavCmd, MavFrame, MavProtocolCapability, MavResult
from aerokit.vehicle.orders.part import Part

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.position import Position
    from aerokit.vehicle.orders.order import Order

__all__ = ["LookActions"]

LOCATION = MavCmd.DO_SET_ROI_LOCATION


@checks_arguments
class LookActions(Part):
    """Nose or gimbal at a place: of two orders the newer one counts."""

    async def look_at(self, target: Position) -> None:
        """Make nose or gimbal point at a place, until :meth:`stop_looking`; without an altitude, at its own.

        Sends MAV_CMD_DO_SET_ROI_LOCATION (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_ROI_LOCATION), and
        MAV_CMD_DO_SET_ROI to old firmware, which knows no other.

        Raises:
            ValueUnknownError: home is not known and is needed here.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
            OperationRejected: the mode changed, or a newer order was given, before there was an answer.
        """
        latitude, longitude, altitude, is_relative = self._where.global_target(target)
        if not self._talk.commands.is_unknown(LOCATION):
            frame = MavFrame.GLOBAL_RELATIVE_ALT_INT if is_relative else MavFrame.GLOBAL_INT
            if await self._set_roi_location({"frame": frame, "x": latitude, "y": longitude, "z": altitude}):
                return
        above_home = altitude if is_relative else altitude - self._where.home_altitude()
        place = (latitude * 1e-7, longitude * 1e-7, above_home)
        await self._give(MavCmd.DO_SET_ROI, 0, 0, 0, 0, *place)

    async def _set_roi_location(self, place: dict[str, Any]) -> bool:
        """False for firmware that does not know it, or no COMMAND_INT at all: that says nothing."""
        with self._newest() as order:
            try:
                await self._orders.give(order, self._talk.commands.send_int, LOCATION, **place)
            except CommandTimeout:
                knows_int = (self.telemetry.capabilities.latest or 0) & MavProtocolCapability.COMMAND_INT
                if knows_int or not self._helm.is_known:
                    raise
                self._raise_if_overruled(order)
                return False
            except CommandRejected:
                if not self._talk.commands.is_unknown(LOCATION):
                    raise
                self._raise_if_overruled(order)
                return False
        return True

    async def _give(self, command: int, *params: float) -> None:
        with self._newest() as order:
            await self._orders.give(order, self._talk.commands.send_long, command, *params)

    @contextmanager
    def _newest(self) -> Iterator[Order]:
        with self._bridge.looking.begin().order() as order:
            yield order

    @staticmethod
    def _raise_if_overruled(order: Order) -> None:
        """A mode of the program's own is no reason: it looks there in any."""
        if order.end and not order.taken_by:
            raise OperationRejected(f"{order.end}; the rest of the order was not sent")

    async def stop_looking(self) -> None:
        """End :meth:`look_at` (MAV_CMD_DO_SET_ROI_NONE; MAV_CMD_DO_SET_ROI to old firmware).

        Raises:
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
            OperationRejected: the mode changed, or a newer order was given, before there was an answer.
        """
        with self._newest() as order:
            try:
                await self._orders.give(order, self._talk.commands.send_long, MavCmd.DO_SET_ROI_NONE)
                return
            except CommandRejected as error:
                if error.result != MavResult.UNSUPPORTED:
                    raise
                self._raise_if_overruled(order)
        await self._give(MavCmd.DO_SET_ROI)
