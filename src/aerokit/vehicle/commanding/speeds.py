"""Airspeed and climb speed."""

from __future__ import annotations

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import NotSupported
from aerokit.mavlink.enums import MavCmd, SpeedType
from aerokit.vehicle.commanding.context import VehicleBase
from aerokit.vehicle.commanding.simple_orders import Argument, SimpleOrder

MAX_SPEED_M_S, KEEP_THROTTLE = 1000, -1.0


def _speed(name: str, argument: str, kind: SpeedType) -> SimpleOrder:
    params = (float(kind), Argument(argument, 0, MAX_SPEED_M_S, above=True), KEEP_THROTTLE)
    return SimpleOrder(name, MavCmd.DO_CHANGE_SPEED, params)


SET_AIRSPEED = _speed("set_airspeed", "airspeed_m_s", SpeedType.AIRSPEED)
SET_CLIMB_SPEED = _speed("set_climb_speed", "climb_m_s", SpeedType.CLIMB_SPEED)


@checks_arguments
class SpeedActions(VehicleBase):
    """Airspeed and climb speed. ``set_speed`` changes the ground speed."""

    async def set_airspeed(self, airspeed_m_s: float) -> None:
        """Change the airspeed of a fixed wing in m/s, above 0 (MAV_CMD_DO_CHANGE_SPEED, SPEED_TYPE_AIRSPEED).

        Returns at the acknowledgement, because no message reports the setting; VFR_HUD has what the
        vehicle measures.
        ArduPlane applies it in GUIDED and AUTO, within AIRSPEED_MIN and AIRSPEED_MAX, and refuses it otherwise. PX4
        applies it in modes that navigate, and accepts it always.

        Raises:
            InvalidArgument: out of range. Nothing was sent.
            NotSupported: this vehicle has no wings: use ``set_speed``. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
        """
        await self._set_speed(SET_AIRSPEED, airspeed_m_s)

    async def set_climb_speed(self, climb_m_s: float) -> None:
        """Change the speed of climbs in m/s, above 0 (MAV_CMD_DO_CHANGE_SPEED, SPEED_TYPE_CLIMB_SPEED).

        Returns at the acknowledgement, because no message reports the setting. ArduCopter applies it in GUIDED, AUTO
        and RTL until the mode changes, and refuses it otherwise. PX4 would take it for the cruise speed.

        Raises:
            InvalidArgument: out of range. Nothing was sent.
            NotSupported: this firmware has no such command. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
        """
        await self._set_speed(SET_CLIMB_SPEED, climb_m_s)

    async def _set_speed(self, order: SimpleOrder, speed_m_s: float) -> None:
        kind, *_ = order.wire_params(speed_m_s)
        if kind not in self.autopilot.speed_types:
            name = SpeedType(int(kind)).name
            raise NotSupported(f"{order.name}: {self.autopilot.firmware} has no SPEED_TYPE_{name}; nothing was sent")
        await order.send(self._context, speed_m_s)
