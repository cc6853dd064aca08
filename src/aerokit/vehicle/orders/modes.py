"""Actions that change the mode alone: modes by name, and holding."""

from __future__ import annotations

from aerokit.arguments import checks_arguments
from aerokit.mavlink.enums import MavLandedState
from aerokit.vehicle.orders.part import Part

__all__ = ["ModeActions"]


@checks_arguments
class ModeActions(Part):
    """Changing the flight mode; stopping."""

    async def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> None:
        """Change the flight mode and wait until HEARTBEAT tells it.

        Args:
            mode: a name as the autopilot's own documentation spells it (``"GUIDED"``, ``"POSCTL"``; case does not
                matter), or the number in HEARTBEAT.custom_mode.
            timeout: seconds for the whole of it.

        Sends MAV_CMD_DO_SET_MODE, and SET_MODE to a vehicle that does not know that command
        (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_MODE).

        Raises:
            InvalidArgument: this vehicle has no such mode; the text lists those it has. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said meanwhile.
            OperationRejected: a pilot or a failsafe has chosen another mode meanwhile.
            OperationTimeout: it accepted and stayed in another mode, or did not answer.
        """
        wanted = self.autopilot.find_mode(mode, self.telemetry.mode_names)
        await self._orders.change_mode(wanted, self._helm.order(wanted), timeout)

    async def hold(self) -> None:
        """Stop and stay (a fixed wing circles); returns when HEARTBEAT tells the autopilot's mode for that.

        Copter BRAKE, Plane LOITER, Rover HOLD (a boat LOITER), Sub POSHOLD; PX4 LOITER where it comes to a stop.

        Raises:
            NotSupported: this vehicle has no mode for it. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said meanwhile.
            OperationRejected: a pilot or a failsafe has chosen another mode meanwhile.
            OperationTimeout: it accepted and stayed in another mode, or did not answer.
        """
        await self._holding.hold()

    @property
    def is_told_to_hold(self) -> bool:
        """Whether a flight was given up, and the order to hold that followed is not confirmed yet."""
        return self._holding.is_told_to_hold

    @property
    def is_flown_by_program(self) -> bool:
        """Whether the vehicle is armed and does what this program has ordered.

        The program has armed it, or has given an order that steers since somebody else did; and no pilot, failsafe or
        other program has taken it from that. False for a vehicle that others fly and that this program only watches.
        """
        return self.telemetry.is_armed and self._helm.is_flown_by_program

    @property
    def taken_over(self) -> str:
        """What somebody else has made of the program's last action, as a clause; empty: nothing that was told.

        "the mode changed to LOITER": by a pilot, a failsafe or another program, which HEARTBEAT does not tell apart; or
        "a failsafe became active (MAV_STATE_CRITICAL)", which may come some seconds before the mode changes.
        A vehicle that only disarmed, as after a landing, was not taken over. The program's next action begins anew.
        """
        order = self._helm.current or self._helm.newest
        if order is None or not order.has_lost_mode:
            return "" if order is None else order.failsafe
        may_have_landed = self.telemetry.landed_state.latest != MavLandedState.IN_AIR
        if may_have_landed and self.telemetry.armed.updated_at < order.mode_lost_at:
            return (
                ""  # PX4 leaves LAND when it disarms: CURRENT_MODE tells that a moment before HEARTBEAT does
            )
        return order.taken_by
