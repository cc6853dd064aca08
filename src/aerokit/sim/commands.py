"""Requests to a simulated vehicle: commands, with its `Faults`, and set-points.

https://mavlink.io/en/services/command.html
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from aerokit.mavlink.enums import MavSeverity
from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.mavlink.messages import SetPositionTargetGlobalInt, SetPositionTargetLocalNed
from aerokit.protocols.servers import commands
from aerokit.protocols.servers.commands import CommandHandler as CommandHandler
from aerokit.protocols.servers.commands import CommandProgress as CommandProgress
from aerokit.protocols.servers.commands import ReceivedCommand as ReceivedCommand
from aerokit.protocols.servers.commands import to_int as to_int
from aerokit.sim.faults import CommandFault
from aerokit.sim.motion import Ned
from aerokit.sim.vehicle import MessageHost


class CommandServer(commands.CommandDispatcher):
    """Answers commands. The `Faults` of the vehicle or component change the answers."""

    _host: MessageHost  # pyright: ignore[reportIncompatibleVariableOverride]

    def dispatch(self, command: ReceivedCommand) -> None:
        fault = self._host.faults.next_command_fault(command.command)
        if fault is not None and fault.ignore:
            return
        if fault is not None and fault.refuse_with is not None:
            if fault.text is not None:
                self._host.send_text(MavSeverity.CRITICAL, fault.text)
            self._answer_with(command, fault.refuse_with, fault)
            return
        answer = self.handle(command)
        if isinstance(answer, CommandProgress):
            self.report(command, answer, lambda: self._answer_with(command, answer.result, fault))
        elif answer is not None:
            self._answer_with(command, answer, fault)

    def _answer_with(self, command: ReceivedCommand, result: int, fault: CommandFault | None) -> None:
        fault = CommandFault() if fault is None else fault
        if fault.progress:
            # The final acknowledgement follows the progress. `final_fault` repeats, delays or drops it.
            final_fault = CommandFault(acks=fault.acks, delay_s=fault.delay_s)
            progress = CommandProgress(fault.progress, fault.progress_interval_s, result)
            self.report(command, progress, lambda: self._answer_with(command, result, final_fault))
            return
        for _ in range(fault.acks):
            if fault.delay_s > 0:
                self._host.call_later(fault.delay_s, lambda: self.answer(command, result))
            else:
                self.answer(command, result)


PositionTarget = SetPositionTargetLocalNed | SetPositionTargetGlobalInt

# Mask bits of the three axes of each vector. They are plain integers, because operators of enum flags take ten times
# as long.
_POSITION = (int(Mask.X_IGNORE), int(Mask.Y_IGNORE), int(Mask.Z_IGNORE))
_VELOCITY = (int(Mask.VX_IGNORE), int(Mask.VY_IGNORE), int(Mask.VZ_IGNORE))
_ACCELERATION = (int(Mask.AX_IGNORE), int(Mask.AY_IGNORE), int(Mask.AZ_IGNORE))


@dataclass(frozen=True)
class Setpoint:
    """The content of a set-point message. Its vectors are in the frame of the message."""

    mask: int
    velocity: Ned
    acceleration: Ned
    yaw: float | None
    """Yaw in radians; None if the mask ignores it."""
    yaw_rate: float | None
    """Yaw rate in radians per second; None if the mask ignores it."""

    @classmethod
    def of(cls, message: PositionTarget) -> Setpoint:
        mask = message.type_mask
        return cls(
            mask,
            velocity=(message.vx, message.vy, message.vz),
            acceleration=(message.afx, message.afy, message.afz),
            yaw=None if mask & Mask.YAW_IGNORE else message.yaw,
            yaw_rate=None if mask & Mask.YAW_RATE_IGNORE else message.yaw_rate,
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
        return bool(self.mask & Mask.FORCE_SET) and self.has_acceleration

    def axes(self, position: Ned) -> tuple[Ned, Ned, Ned]:
        """Return position, velocity and acceleration. An axis that is ignored or not finite is NaN."""
        return (
            self._masked(position, _POSITION),
            self._masked(self.velocity, _VELOCITY),
            self._masked(self.acceleration, _ACCELERATION),
        )

    def _masked(self, vector: Ned, ignore_bits: tuple[int, int, int]) -> Ned:
        x, y, z = (
            math.nan if self.mask & ignore_bit or not math.isfinite(value) else value
            for value, ignore_bit in zip(vector, ignore_bits, strict=True)
        )
        return (x, y, z)


def rotated(vector: Ned, yaw: float) -> Ned:
    """Rotate a vector of the body frame (forward, right, down) by ``yaw`` radians to north, east, down."""
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    forward, right, down = vector
    return (forward * cos_yaw - right * sin_yaw, forward * sin_yaw + right * cos_yaw, down)


def constrained(value: float, low: float, high: float) -> float:
    """Limit a value. NaN becomes the middle, as in ArduPilot (AP_Math.cpp, constrain_value)."""
    return (low + high) / 2.0 if math.isnan(value) else max(low, min(high, value))


def is_finite(*vectors: Ned | None) -> bool:
    """Return True if all components are finite. Vectors that are None do not count."""
    return all(math.isfinite(part) for vector in vectors if vector is not None for part in vector)
