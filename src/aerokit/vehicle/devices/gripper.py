"""``Gripper``: holds and releases a load."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.mavlink.enums import GripperActions, MavCmd
from aerokit.vehicle.commanding.simple_orders import Argument, SimpleOrder

if TYPE_CHECKING:
    from aerokit.vehicle.commanding.context import VehicleContext

__all__ = ["Gripper"]

NUMBER = Argument("number", 1, 8)
GRIP_TIMEOUT_S = 10.0
EPM_WAIT_S = 3.0
"""Seconds until an electro-permanent gripper has moved. ArduPilot reports only the start of its movement."""
BEGIN_TEXTS = {GripperActions.GRAB: "Gripper load grabbing", GripperActions.RELEASE: "Gripper load releasing"}
END_TEXTS = {GripperActions.GRAB: "Gripper load grabbed", GripperActions.RELEASE: "Gripper load released"}


@checks_arguments
class Gripper(ReadOnly):
    """One gripper: ``vehicle.gripper()`` (MAV_CMD_DO_GRIPPER).

    Enable it by PD_GRIPPER_EN on PX4, by GRIP_ENABLE on ArduPilot. PX4 acknowledges when the gripper has moved.
    ArduPilot acknowledges at once and reports the end by a status text. For an electro-permanent gripper, it reports
    only the start, and the call returns three seconds later. Orders are sent once. If you cancel a call, the gripper
    may still have moved.
    """

    def __init__(self, context: VehicleContext, number: int) -> None:
        self._context, self._number = context, number

    async def grab(self) -> None:
        """Close the gripper, and return when it has closed.

        Raises:
            CommandRejected: the vehicle has no gripper, or refused.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: your program gave a newer order for this gripper.
            OperationTimeout: the vehicle did not report the end of the movement within ten seconds.
        """
        await self._move(GripperActions.GRAB)

    async def release(self) -> None:
        """Open the gripper, and return when it has opened. Raises as :meth:`grab`."""
        await self._move(GripperActions.RELEASE)

    async def _move(self, action: GripperActions) -> None:
        context, topic = self._context, ("gripper", self._number)
        order = SimpleOrder(f"gripper {action.name.lower()}", MavCmd.DO_GRIPPER, (NUMBER, action))
        if not context.session.autopilot.reports_gripper_by_text:
            # The acknowledgement reports the end of the movement.
            await order.send(context, self._number, topic=topic)
            return

        def has_moved(text: str, since_acknowledgement_s: float) -> bool:
            has_begun = text == BEGIN_TEXTS[action]
            # For an electro-permanent gripper, ArduPilot reports no end, so wait as long as its movement takes. A
            # servo gripper usually reports its end sooner.
            return text == END_TEXTS[action] or (has_begun and since_acknowledgement_s >= EPM_WAIT_S)

        await order.send_until_text(context, self._number, topic=topic, is_done=has_moved, timeout=GRIP_TIMEOUT_S)
