"""What a set-point message says: one decoder of its mask and its vectors for every make of autopilot."""

from __future__ import annotations

import math
from dataclasses import dataclass

from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.mavlink.messages import SetPositionTargetGlobalInt, SetPositionTargetLocalNed
from aerokit.sim.local_frame import Ned

PositionTarget = SetPositionTargetLocalNed | SetPositionTargetGlobalInt

# integers: arithmetic on flags takes ten times as long
_POSITION = (int(Mask.X_IGNORE), int(Mask.Y_IGNORE), int(Mask.Z_IGNORE))
_VELOCITY = (int(Mask.VX_IGNORE), int(Mask.VY_IGNORE), int(Mask.VZ_IGNORE))
_ACCELERATION = (int(Mask.AX_IGNORE), int(Mask.AY_IGNORE), int(Mask.AZ_IGNORE))


@dataclass(frozen=True)
class Setpoint:
    """Vectors are as they were sent, in the message's frame. A vector counts when none of its axes is ignored."""

    mask: int
    velocity: Ned
    acceleration: Ned
    yaw: float | None
    yaw_rate: float | None
    """Radians; None when it is ignored."""

    @classmethod
    def of(cls, message: PositionTarget) -> Setpoint:
        """Read a message."""
        mask = message.type_mask
        return cls(
            mask,
            (message.vx, message.vy, message.vz),
            (message.afx, message.afy, message.afz),
            None if mask & Mask.YAW_IGNORE else message.yaw,
            None if mask & Mask.YAW_RATE_IGNORE else message.yaw_rate,
        )

    @property
    def has_position(self) -> bool:
        return not self.mask & sum(_POSITION)

    @property
    def has_velocity(self) -> bool:
        return not self.mask & sum(_VELOCITY)

    @property
    def has_acceleration(self) -> bool:
        return not self.mask & sum(_ACCELERATION)

    @property
    def is_force(self) -> bool:
        """Whether the accelerations are forces."""
        return bool(self.mask & Mask.FORCE_SET) and self.has_acceleration

    def axes(self, position: Ned) -> tuple[Ned, Ned, Ned]:
        """Position, velocity and acceleration axis by axis, NaN where one is ignored or no number."""
        vectors = ((position, _POSITION), (self.velocity, _VELOCITY), (self.acceleration, _ACCELERATION))
        p, v, a = (self._masked(vector, bits) for vector, bits in vectors)
        return p, v, a

    def _masked(self, vector: Ned, bits: tuple[int, int, int]) -> Ned:
        x, y, z = (
            math.nan if self.mask & bit or not math.isfinite(value) else value
            for value, bit in zip(vector, bits, strict=True)
        )
        return (x, y, z)


def rotated(vector: Ned, yaw: float) -> Ned:
    """A vector relative to the nose, in the world: north, east, down."""
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    forward, right, down = vector
    return (forward * cos_yaw - right * sin_yaw, forward * sin_yaw + right * cos_yaw, down)


def is_finite(*vectors: Ned | None) -> bool:
    """Whether all of them are numbers; None counts as one."""
    return all(math.isfinite(part) for vector in vectors if vector is not None for part in vector)
