"""Looking at places and at other vehicles: the region of interest of one gimbal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.mavlink.messages import GlobalPositionInt
from aerokit.position import Position
from aerokit.vehicle.gimbal.orders import GimbalPart
from aerokit.vehicle.gimbal.pointing import Aim, arrive, direction_to, told_often

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.connection.bus import Detach
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.gimbal.pointing import Wanted

OLD_S = 5.0
"""A place that was told longer ago is none."""


class Looking:
    """In its block: what that system tells on our connection."""

    def __init__(self, bridge: Bridge, system_id: int) -> None:
        self._bridge, self._system_id = bridge, system_id
        self._there: Position | None = None
        self._at = 0.0
        self._detach: Detach | None = None

    def __enter__(self) -> Self:
        bus = self._bridge.talk.connection.bus
        self._detach = bus.attach(GlobalPositionInt, self._hear, system_id=self._system_id)
        return self

    def __exit__(self, *_: object) -> None:
        if self._detach is not None:
            self._detach()

    def direction(self) -> Wanted | None:
        """The way there from the vehicle; None while that is not known."""
        if self._there is None or self._bridge.talk.connection.now() - self._at > OLD_S:
            return None
        return direction_to(self._bridge, self._there)

    def _hear(self, message: GlobalPositionInt) -> None:
        if message.lat or message.lon:
            self._there = Position(message.lat * 1e-7, message.lon * 1e-7, altitude_amsl_m=message.alt * 1e-3)
            self._at = self._bridge.talk.connection.now()


@checks_arguments
class PlaceActions(GimbalPart):
    """Orders to look at something: of two the newer one counts."""

    async def look_at(
        self, target: Position, *, wait: bool = True, tolerance_deg: float = 5.0, timeout: float = 15.0
    ) -> None:
        """Keep it pointed at a place, and return when it points there; without an altitude, at the vehicle's own.

        Sends MAV_CMD_DO_SET_ROI_LOCATION. A copter whose gimbal does not pan turns its nose.

        Args:
            target: the place.
            wait: False: return when it was accepted.
            tolerance_deg: how near in each axis is there, above 0 to 45.
            timeout: seconds until it has to be there.

        Raises:
            InvalidArgument: the tolerance is out of range. Nothing was sent.
            NotSupported: the manager can do that with its first gimbal only. Nothing was sent.
            ValueUnknownError: home, or the vehicle's altitude, is not known and is needed here. Nothing was sent.
            CommandRejected: the manager refused.
            CommandTimeout: there was no answer.
            GimbalTaken: control was lost in the block that has it.
            OperationRejected: another order was given meanwhile, or the vehicle rebooted.
            OperationTimeout: it was not there in time; the text says where it points.
            HeartbeatTimeout: the vehicle fell silent.
        """
        check_range("tolerance_deg", tolerance_deg, 0, 45, above=True)
        orders = self._orders
        orders.check_looks()
        x, y, z, is_relative = self._bridge.where.global_target(target)
        frame = MavFrame.GLOBAL_RELATIVE_ALT_INT if is_relative else MavFrame.GLOBAL_INT
        turn = orders.begin()
        aim = Aim(
            lambda: direction_to(self._bridge, target), tolerance_deg, "the vehicle does not tell where it is"
        )
        with told_often(orders), self._talk.streaming("position"):
            since = self._now()
            place = {"frame": frame, "x": x, "y": y, "z": z}
            await orders.look(turn, MavCmd.DO_SET_ROI_LOCATION, orders.roi_parameter, **place)
            if wait:
                await arrive(orders, turn, f"{orders.name}: look_at", aim, since=since, timeout=timeout)

    async def look_at_system(
        self, system_id: int, *, wait: bool = True, tolerance_deg: float = 5.0, timeout: float = 15.0
    ) -> None:
        """Keep it pointed at another vehicle (MAV_CMD_DO_SET_ROI_SYSID), and return when it points there.

        Both have to hear where the other vehicle is (its GLOBAL_POSITION_INT): the gimbal's manager to point at it,
        and this connection to notice.

        Args:
            system_id: its MAVLink system id, 1 to 255.
            wait: False: return when it was accepted.
            tolerance_deg: how near in each axis is there, above 0 to 45.
            timeout: seconds until it has to be there.

        Raises:
            InvalidArgument: there is no such system id, or the tolerance is out of range. Nothing was sent.
            NotSupported: the manager cannot do that. Nothing was sent.
            CommandRejected: the manager refused.
            CommandTimeout: there was no answer.
            GimbalTaken: control was lost in the block that has it.
            OperationRejected: another order was given meanwhile, or the vehicle rebooted.
            OperationTimeout: it was not there in time; the text says where it points.
            HeartbeatTimeout: the vehicle fell silent.
        """
        if isinstance(system_id, bool):
            raise InvalidArgument(f"system_id = {system_id} is not allowed: 1 to 255")
        check_range("system_id", system_id, 1, 255)
        check_range("tolerance_deg", tolerance_deg, 0, 45, above=True)
        orders = self._orders
        orders.check_looks()
        if not orders.rules.looks_at_systems:
            orders.not_supported("points at places, and at no systems")
        turn = orders.begin()
        with Looking(self._bridge, system_id) as other, told_often(orders), self._talk.streaming("position"):
            since = self._now()
            await orders.look(turn, MavCmd.DO_SET_ROI_SYSID, system_id, orders.roi_parameter)
            if wait:
                aim = Aim(other.direction, tolerance_deg, f"where system {system_id} is was not heard here")
                what = f"{orders.name}: look_at_system({system_id})"
                await arrive(orders, turn, what, aim, since=since, timeout=timeout)

    async def stop_looking(self) -> None:
        """End :meth:`look_at` (MAV_CMD_DO_SET_ROI_NONE). Where it turns then is its manager's business.

        Raises:
            CommandRejected: the manager refused.
            CommandTimeout: there was no answer.
            GimbalTaken: control was lost in the block that has it.
        """
        orders = self._orders
        orders.raise_if_taken()
        await orders.look(orders.begin(), MavCmd.DO_SET_ROI_NONE, orders.roi_parameter)
