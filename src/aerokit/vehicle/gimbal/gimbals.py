"""``vehicle.gimbals``: all gimbals of a vehicle."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import anyio

from aerokit.arguments import checks_arguments
from aerokit.errors import BusyError, CommandRejected, CommandTimeout
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import GimbalManagerInformation
from aerokit.vehicle.checks import check_range
from aerokit.vehicle.gimbal.device import LAST_NUMBER
from aerokit.vehicle.gimbal.gimbal import Gimbal
from aerokit.vehicle.gimbal.hearing import MOST, Hearing

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.vehicle.gimbal.device import Device
    from aerokit.vehicle.orders.bridge import Bridge

__all__ = ["Gimbals"]

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
