"""``FenceControl``: the fence that a vehicle holds, and whether it minds it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.arguments import checks_arguments
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.plans.held import HeldPlan

if TYPE_CHECKING:
    from aerokit.missions import Fence

__all__ = ["FenceControl"]


@checks_arguments
class FenceControl(HeldPlan["Fence"]):
    """``await vehicle.fence.upload(Fence(polygons=[...]))``: where the vehicle may and may not be.

    Uploading does not switch it on for ArduPilot (:meth:`enable`, or the parameter FENCE_ENABLE); PX4 minds every fence
    it holds, and does what GF_ACTION says.
    """

    async def enable(self, on: bool = True) -> None:
        """Have the vehicle mind its fence, or not (MAV_CMD_DO_FENCE_ENABLE), until it reboots.

        See https://mavlink.io/en/messages/common.html#MAV_CMD_DO_FENCE_ENABLE.

        Raises:
            CommandRejected: the vehicle refused; PX4 does not know the command.
            CommandTimeout: it did not answer.
        """
        await self._context.bridge.orders.command_aside(MavCmd.DO_FENCE_ENABLE, float(on))

    def _plan_type(self) -> type[Fence]:
        from aerokit.missions import Fence

        return Fence
