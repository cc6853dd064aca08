"""`SimulatedGimbal`: a gimbal that speaks the MAVLink gimbal protocol v2 with a component id of its own.

https://mavlink.io/en/services/gimbal_v2.html
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.mavlink.enums import MavType
from aerokit.sim.components.component import Builder, SimulatedComponent, pose_of
from aerokit.sim.components.gimbal_commands import (
    gimbal_builders,
    gimbal_commands,
    gimbal_manager_status,
    hear_gimbal_orders,
)

if TYPE_CHECKING:
    from aerokit.sim.commands import CommandHandler
    from aerokit.sim.local_frame import GlobalPoint

__all__ = ["SimulatedGimbal"]

Angles = tuple[float, float, float]
_STATUS_S = 1.0
_STILL: Angles = (0.0, 0.0, 0.0)


class SimulatedGimbal(SimulatedComponent):
    """A gimbal device that is its own manager; it turns with limited speed and points at places by itself.

    Orders are taken from who is in control, and nobody is at first: MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE claims it.
    Other people's orders are DENIED, their messages ignored.

    - ``component_id``: 154, 171 to 175 are MAVLink's gimbals; ``system_id``: None is the vehicle's own
    - ``roll_deg``, ``pitch_deg``, ``yaw_deg``: lowest and highest angle; roll and pitch are from the horizon
    - ``slew_deg_s``: how fast it turns
    - ``attitude_rate_hz``: of GIMBAL_DEVICE_ATTITUDE_STATUS, without being asked

    Not simulated: the vehicle's lean, which a real one evens out, motors that fail, a second manager.
    """

    TYPE: ClassVar[int] = MavType.GIMBAL

    def __init__(
        self,
        component_id: int = 154,
        *,
        system_id: int | None = None,
        roll_deg: tuple[float, float] = (-30.0, 30.0),
        pitch_deg: tuple[float, float] = (-90.0, 25.0),
        yaw_deg: tuple[float, float] = (-180.0, 180.0),
        slew_deg_s: float = 60.0,
        attitude_rate_hz: float = 5.0,
    ) -> None:
        super().__init__(component_id, system_id=system_id)
        self.limits: tuple[tuple[float, float], ...] = tuple(
            (math.radians(low), math.radians(high)) for low, high in (roll_deg, pitch_deg, yaw_deg)
        )
        """Lowest and highest roll, pitch, yaw in radians."""
        self.slew_rad_s: float = math.radians(slew_deg_s)
        self._attitude_rate_hz = attitude_rate_hz
        self._forget()

    def _forget(self) -> None:
        self.primary: tuple[int, int] = (0, 0)
        self.secondary: tuple[int, int] = (0, 0)
        """System and component ids of who is in control; zeros are nobody."""
        self.flags: int = 0
        """GIMBAL_MANAGER_FLAGS of the latest order."""
        self.region: GlobalPoint | None = None
        """The place that it looks at."""
        self.followed: int = 0
        """The system id of the vehicle that it looks at, wherever that is; 0: none."""
        self._from: Angles = _STILL
        self._since = 0.0
        self._target: Angles = _STILL
        self._rates: Angles = _STILL
        self._is_locked = False

    def start(self) -> None:
        """The power comes on: nobody is in control, and it looks ahead."""
        self._forget()
        self._since = self.now
        self.stream(m.GimbalManagerStatus.ID, _STATUS_S)
        if self._attitude_rate_hz > 0:
            self.stream(m.GimbalDeviceAttitudeStatus.ID, 1.0 / self._attitude_rate_hz)

    def commands(self) -> dict[int, CommandHandler]:
        """See `gimbal_commands`."""
        return gimbal_commands(self)

    def builders(self) -> dict[int, Builder]:
        """See `gimbal_builders`."""
        return gimbal_builders(self)

    def listen(self) -> None:
        """Orders that are messages."""
        hear_gimbal_orders(self)

    # -------------------------------------------------------------------------------- where it looks

    @property
    def is_yaw_locked(self) -> bool:
        """Whether its yaw keeps its direction while the vehicle turns."""
        return self._is_locked or self.region is not None

    def angles(self) -> Angles:
        """Roll, pitch and yaw in radians; roll and pitch from the horizon, yaw from the vehicle's nose."""
        moved = [
            _towards(start, target, self.slew_rad_s * (self.now - self._since))
            for start, target in zip(self._from, self._wanted(), strict=True)
        ]
        return (moved[0], moved[1], moved[2])

    def angles_from_north(self) -> Angles:
        """The same with the yaw from north."""
        roll, pitch, yaw = self.angles()
        return (roll, pitch, math.remainder(yaw + self.heading(), math.tau))

    def heading(self) -> float:
        """The vehicle's, in radians; 0 when nobody knows."""
        pose = pose_of(self.vehicle)
        return 0.0 if pose is None else pose.yaw

    def _wanted(self) -> Angles:
        target = self._target if self.region is None else self._look(self.region)
        seconds = self.now - self._since
        roll, pitch, yaw = (angle + rate * seconds for angle, rate in zip(target, self._rates, strict=True))
        if self.is_yaw_locked:
            yaw = math.remainder(yaw - self.heading(), math.tau)
        return (self._limited(0, roll), self._limited(1, pitch), self._limited(2, yaw))

    def _look(self, region: GlobalPoint) -> Angles:
        """Yaw from north; of a vehicle that is nowhere it stays as it is."""
        pose = pose_of(self.vehicle)
        if pose is None:
            return self._target
        frame = self.vehicle.frame  # type: ignore[attr-defined]
        north, east = frame.to_local(region.latitude_e7, region.longitude_e7)
        here = frame.to_local(pose.place.latitude_e7, pose.place.longitude_e7)
        north, east = north - here[0], east - here[1]
        pitch = math.atan2(region.altitude_m - pose.place.altitude_m, math.hypot(north, east))
        return (0.0, pitch, math.atan2(east, north))

    def _limited(self, axis: int, angle: float) -> float:
        low, high = self.limits[axis]
        return max(low, min(high, angle))

    # ----------------------------------------------------------------------------------------- orders

    def point(self, angles: Angles, flags: int, *, locked: bool) -> None:
        """Turn to angles in radians; ``locked``: yaw is from north and stays so, else from the nose."""
        self._begin(flags)
        self._target, self._is_locked = angles, locked

    def turn(self, rates: Angles, flags: int, *, locked: bool) -> None:
        """Keep turning, in radians per second, no faster than it can."""
        here = self.angles_from_north() if locked else self.angles()
        self._begin(flags)
        fastest = self.slew_rad_s
        roll, pitch, yaw = (max(-fastest, min(fastest, rate)) for rate in rates)
        self._target, self._rates, self._is_locked = here, (roll, pitch, yaw), locked

    def look_at(self, place: GlobalPoint | None) -> None:
        """Keep pointing at a place; None: ahead again."""
        self._begin(0)
        self.region = place

    def follow(self, system_id: int) -> None:
        """Keep pointing at another vehicle, from when it tells where it is; until then it stays as it is."""
        here = self.angles_from_north()
        self.point(here, Flags.YAW_LOCK, locked=True)
        self.followed = system_id

    def note_place(self, system_id: int, place: GlobalPoint) -> None:
        """Another vehicle tells where it is."""
        if system_id == self.followed:
            self._from, self._since = self.angles(), self.now
            self.region = place

    def _begin(self, flags: int) -> None:
        self._from, self._since = self.angles(), self.now
        self._target = _STILL
        self._rates = _STILL
        self.region = None
        self.followed = 0
        self.flags = flags
        self._is_locked = False

    def set_control(self, primary: tuple[int, int], secondary: tuple[int, int]) -> None:
        """Give it to somebody; a change is told at once."""
        if (primary, secondary) != (self.primary, self.secondary):
            self.primary = primary
            self.secondary = secondary
            self.send(gimbal_manager_status(self))

    def obeys(self, sender: tuple[int, int]) -> bool:
        """Whether somebody is in control."""
        return sender in (self.primary, self.secondary) and sender != (0, 0)


def _towards(start: float, target: float, most: float) -> float:
    return start + max(-most, min(most, target - start))
