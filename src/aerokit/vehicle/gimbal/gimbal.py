"""``vehicle.gimbal``: where a gimbal points, and orders to it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.arguments import checks_arguments
from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.mavlink.messages import GimbalDeviceInformation, GimbalManagerInformation
from aerokit.read_only import ReadOnly
from aerokit.vehicle.gimbal.control import GimbalControl
from aerokit.vehicle.gimbal.places import PlaceActions
from aerokit.vehicle.gimbal.pointing import PointActions
from aerokit.vehicle.gimbal.rates import GimbalRates
from aerokit.vehicle.gimbal.values import Frame, information_of

if TYPE_CHECKING:
    from aerokit.vehicle.gimbal.values import GimbalInformation

__all__ = ["Gimbal"]

ANSWER_S = 2.0
"""How long information may take to come once it was promised."""


@checks_arguments
class Gimbal(ReadOnly, PointActions, PlaceActions):
    """One gimbal, by the gimbal protocol v2 (https://mavlink.io/en/services/gimbal_v2.html), or the mount of a vehicle
    that knows no better.

    ``vehicle.gimbal`` is the first one, ``vehicle.gimbals`` has all. An order returns when the gimbal tells that it is
    there, ends when another one is given, and is stayed with however the vehicle moves. Where a manager obeys only who
    is in control, an order outside a block of :meth:`control` claims it, until :meth:`release`.
    """

    async def information(self) -> GimbalInformation:
        """Ask what it is, what it can do, and its limits (GIMBAL_MANAGER_INFORMATION, GIMBAL_DEVICE_INFORMATION).

        From then on angles beyond its limits are refused before anything is sent.

        Raises:
            CommandRejected: there is no gimbal manager, or it does not tell.
            CommandTimeout: there was no answer.
        """
        orders = self._orders
        manager_id = await orders.find_manager()
        refused: CommandRejected | CommandTimeout | None = None
        try:
            await orders.ask(GimbalManagerInformation.ID, manager_id)
            await orders.hear(lambda: orders.device.manager_information, GimbalManagerInformation, ANSWER_S)
        except (CommandRejected, CommandTimeout) as error:
            refused = error
        device = orders.device
        if refused is None or device.component_id:
            target = manager_id if device.number or not device.component_id else device.component_id
            try:
                await orders.ask(GimbalDeviceInformation.ID, target, attempts=1)
                await orders.hear(lambda: orders.device.device_information, GimbalDeviceInformation, ANSWER_S)
            except (CommandRejected, CommandTimeout):
                pass  # an autopilot has no such message of a gimbal that is a pair of servos
        device = orders.device
        told = (device.manager_information, device.device_information)
        if told == (None, None):
            raise refused or CommandTimeout(
                f"{orders.name}: information was promised and did not come; {self._talk.describe_link()}"
            )
        device.checks_limits = True
        return information_of(device.device_id, orders.manager_id, *told)

    def control(self, *, secondary: bool = False) -> GimbalControl:
        """Be in control of it for the time of an ``async with`` block; see :class:`GimbalControl`.

        Args:
            secondary: take the secondary control, beside whoever has the primary.
        """
        return GimbalControl(self._orders, not secondary)

    def rates(
        self,
        pitch_deg_s: float = 0.0,
        yaw_deg_s: float = 0.0,
        *,
        frame: Frame = "vehicle",
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> GimbalRates:
        """Turn it at rates for the time of an ``async with`` block that feeds them; see :class:`GimbalRates`.

        Args:
            pitch_deg_s: the first rate in degrees per second, −720 to 720; positive is up.
            yaw_deg_s: the first rate in degrees per second, −720 to 720; positive is to the right.
            frame: whether its yaw keeps to north (``"earth"``) or turns with the vehicle (``"vehicle"``) meanwhile.
            rate_hz: how often the latest rates are sent, 2 to 100.
            valid_for_s: how long rates may be resent without new ones.
            max_lag_s: how late the event loop may be.

        Raises:
            InvalidArgument: a value is out of range. Nothing was sent.
        """
        is_from_north = frame == "earth"
        return GimbalRates(
            self._orders, (pitch_deg_s, yaw_deg_s), is_from_north, rate_hz, valid_for_s, max_lag_s
        )
