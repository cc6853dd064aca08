"""``vehicle.gimbal``: where a gimbal points, and orders to it."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.errors import BusyError, CommandRejected, CommandTimeout
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import GimbalDeviceInformation, GimbalManagerInformation
from aerokit.vehicle.gimbal.control import GimbalControl
from aerokit.vehicle.gimbal.device import LAST_NUMBER, Frame, information_of
from aerokit.vehicle.gimbal.discovery import MOST, Hearing
from aerokit.vehicle.gimbal.places import PlaceActions
from aerokit.vehicle.gimbal.pointing import PointActions
from aerokit.vehicle.gimbal.rates import GimbalRates

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.gimbal.device import Device, GimbalInformation

__all__ = ["Gimbal", "Gimbals"]

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


TO_ALL = 0
"""The component id of a question to everybody."""


@checks_arguments
class Gimbals:
    """The gimbals that were heard of: ``vehicle.gimbals[154]``; ``for gimbal in vehicle.gimbals``.

    A gimbal is known by its gimbal device id: its component id (154, 171 to 175), or 1 to 6 behind the autopilot.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._hearing = Hearing(bridge)
        self._made: dict[tuple[int, int], Gimbal] = {}
        self.first: Gimbal = Gimbal(bridge, self._hearing, None)
        """The first one, whichever that is: one behind the autopilot goes before those with ids of their own."""

    @property
    def ids(self) -> tuple[int, ...]:
        """The gimbal device ids of those that were heard of, the first one first."""
        return tuple(each.device_id for each in self._sorted())

    def get(self, device_id: int) -> Gimbal:
        """The gimbal of this id, whether it was heard of or not.

        Args:
            device_id: 1 to 6 behind the autopilot, or a component id up to 255.

        Raises:
            InvalidArgument: there is no such id.
            BusyError: too many gimbals were heard of already.
        """
        check_range("device_id", device_id, 1, 255)
        device = self._hearing.find(device_id)
        if device is None:
            is_numbered = device_id <= LAST_NUMBER
            key = (self._bridge.talk.component_id, device_id) if is_numbered else (device_id, 0)
            device = self._hearing.device(*key)
        if device is None:
            raise BusyError(f"{MOST} gimbals were heard of already: {', '.join(map(str, self.ids))}")
        return self._gimbal(device)

    async def discover(self, *, timeout: float = 2.0) -> tuple[int, ...]:
        """Ask everybody on the vehicle which gimbals they manage (GIMBAL_MANAGER_INFORMATION); :attr:`ids` afterwards.

        Args:
            timeout: seconds in which they have to answer; this takes so long.

        Raises:
            ConnectionClosed, LinkLost: the connection ended.
        """
        talk = self._bridge.talk
        until = talk.connection.now() + timeout
        with anyio.move_on_after(timeout):
            with suppress(CommandRejected, CommandTimeout):  # the autopilot's answer; others answer besides
                await talk.commands.send_long(
                    MavCmd.REQUEST_MESSAGE, GimbalManagerInformation.ID, component_id=TO_ALL, attempts=2
                )
        await anyio.sleep(max(0.0, until - talk.connection.now()))
        talk.connection.raise_if_ended()
        return self.ids

    def __getitem__(self, device_id: int) -> Gimbal:
        return self.get(device_id)

    def __iter__(self) -> Iterator[Gimbal]:
        return iter([self._gimbal(each) for each in self._sorted()])

    def _sorted(self) -> list[Device]:
        return sorted(self._hearing.devices.values(), key=self._hearing.order)

    def _gimbal(self, device: Device) -> Gimbal:
        if device.key not in self._made:
            self._made[device.key] = Gimbal(self._bridge, self._hearing, device)
        return self._made[device.key]

    def __len__(self) -> int:
        return len(self._hearing.devices)
