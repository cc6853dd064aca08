"""Requests to a simulated vehicle: commands (COMMAND_LONG, COMMAND_INT) with their acknowledgement, and set-points.

https://mavlink.io/en/services/command.html
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from aerokit.mavlink.enums import MavFrame, MavResult, MavSeverity
from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.mavlink.messages import (
    CommandAck,
    CommandInt,
    CommandLong,
    SetPositionTargetGlobalInt,
    SetPositionTargetLocalNed,
)
from aerokit.sim.channel import Channel
from aerokit.sim.faults import CommandFault
from aerokit.sim.motion import Ned
from aerokit.sim.vehicle import MessageHost, sender_of


@dataclass(frozen=True)
class ReceivedCommand:
    """A command received as COMMAND_LONG or COMMAND_INT.

    ``x`` and ``y`` are params 5 and 6 as sent; positions are in degrees in COMMAND_LONG, in degrees times 1e7 in
    COMMAND_INT.
    """

    command: int
    param1: float
    param2: float
    param3: float
    param4: float
    x: float
    y: float
    z: float
    frame: int | None
    """MAV_FRAME of a COMMAND_INT; None for COMMAND_LONG."""
    channel: Channel
    sender: tuple[int, int]

    @property
    def is_long(self) -> bool:
        """True if it was sent as COMMAND_LONG."""
        return self.frame is None

    def place(self) -> tuple[int, int]:
        """Return latitude and longitude in degrees times 1e7."""
        scale = 1e7 if self.is_long else 1
        return (whole(self.x * scale), whole(self.y * scale))

    @property
    def altitude_frame(self) -> int:
        """MAV_FRAME of ``z``; a COMMAND_LONG is relative to home."""
        return MavFrame.GLOBAL_RELATIVE_ALT if self.frame is None else self.frame


@dataclass(frozen=True)
class CommandProgress:
    """Answer to a command that takes time: IN_PROGRESS with each percentage, then ``result``."""

    percents: tuple[int, ...]
    interval_s: float
    result: int = MavResult.ACCEPTED
    finish: Callable[[], None] | None = None
    """Called right before the result is sent."""


CommandHandler = Callable[[ReceivedCommand], "int | CommandProgress | None"]


class CommandServer:
    """Dispatches commands to handlers, applies `Faults` and sends COMMAND_ACK to the sender.

    A handler returns a MAV_RESULT, a `CommandProgress`, or None if it sends the acknowledgement. Messages that it
    sends precede the acknowledgement. A command without a handler is UNSUPPORTED. ``refusal`` returns the MAV_RESULT
    of a command to refuse before its handler is called, else None.
    """

    def __init__(
        self,
        vehicle: MessageHost,
        handlers: dict[int, CommandHandler],
        refusal: Callable[[ReceivedCommand], int | None] = lambda _: None,
    ) -> None:
        self._vehicle = vehicle
        self._handlers = handlers
        self._refusal = refusal
        vehicle.on(CommandLong, self._on_long)
        vehicle.on(CommandInt, self._on_int)

    def _on_long(self, message: CommandLong, channel: Channel) -> None:
        numbers = (message.param1, message.param2, message.param3, message.param4)
        place = (message.param5, message.param6, message.param7)
        self.execute(ReceivedCommand(message.command, *numbers, *place, None, channel, sender_of(message)))

    def _on_int(self, message: CommandInt, channel: Channel) -> None:
        numbers = (message.param1, message.param2, message.param3, message.param4)
        place = (message.x, message.y, message.z)
        self.execute(ReceivedCommand(message.command, *numbers, *place, message.frame, channel, sender_of(message)))

    def execute(self, command: ReceivedCommand) -> None:
        if (refused := self._refusal(command)) is not None:
            self.answer(command, refused)
            return
        fault = self._vehicle.faults.take(command.command)
        if fault is not None and fault.ignore:
            return
        if fault is not None and fault.refuse_with is not None:
            if fault.text is not None:
                self._vehicle.send_text(MavSeverity.CRITICAL, fault.text)
            self.answer(command, fault.refuse_with, fault)
            return
        handler = self._handlers.get(command.command)
        answer = MavResult.UNSUPPORTED if handler is None else handler(command)
        if isinstance(answer, CommandProgress):
            self._report(command, answer, fault)
        elif answer is not None:
            self.answer(command, answer, fault)

    def answer(self, command: ReceivedCommand, result: int, fault: CommandFault | None = None) -> None:
        """Send the acknowledgement, modified by ``fault``."""
        fault = CommandFault() if fault is None else fault
        if fault.progress:
            without = CommandFault(acks=fault.acks, delay_s=fault.delay_s)
            self._report(command, CommandProgress(fault.progress, fault.progress_interval_s, result), without)
            return
        for _ in range(fault.acks):
            if fault.delay_s > 0:
                self._vehicle.call_later(fault.delay_s, lambda: self._send(command, result))
            else:
                self._send(command, result)

    def _report(self, command: ReceivedCommand, progress: CommandProgress, fault: CommandFault | None) -> None:
        for number, percent in enumerate(progress.percents):
            self._vehicle.call_later(
                number * progress.interval_s,
                lambda percent=percent: self._send(command, MavResult.IN_PROGRESS, percent),  # type: ignore[misc]
            )

        def finish() -> None:
            if progress.finish is not None:
                progress.finish()
            self.answer(command, progress.result, fault)

        self._vehicle.call_later(max(1, len(progress.percents)) * progress.interval_s, finish)

    def _send(self, command: ReceivedCommand, result: int, progress: int = 0) -> None:
        system, component = command.sender
        ack = CommandAck(command.command, result, progress, 0, system, component)
        self._vehicle.send(ack, command.channel)


def whole(value: float) -> int:
    """Return a parameter as an integer; 0 for NaN (unset) and for values beyond 32 bits."""
    return int(value) if value == value and abs(value) < 2**31 else 0


PositionTarget = SetPositionTargetLocalNed | SetPositionTargetGlobalInt

# Arithmetic on plain integers is ten times as fast as on flags.
_POSITION = (int(Mask.X_IGNORE), int(Mask.Y_IGNORE), int(Mask.Z_IGNORE))
_VELOCITY = (int(Mask.VX_IGNORE), int(Mask.VY_IGNORE), int(Mask.VZ_IGNORE))
_ACCELERATION = (int(Mask.AX_IGNORE), int(Mask.AY_IGNORE), int(Mask.AZ_IGNORE))


@dataclass(frozen=True)
class Setpoint:
    """A decoded set-point message; vectors are in the frame of the message."""

    mask: int
    velocity: Ned
    acceleration: Ned
    yaw: float | None
    yaw_rate: float | None
    """Radians; None if ignored."""

    @classmethod
    def of(cls, message: PositionTarget) -> Setpoint:
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
        """True if the accelerations are forces (FORCE_SET)."""
        return bool(self.mask & Mask.FORCE_SET) and self.has_acceleration

    def axes(self, position: Ned) -> tuple[Ned, Ned, Ned]:
        """Return position, velocity and acceleration; an axis is NaN if it is ignored or not finite."""
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
    """Rotate a body vector (forward, right, down) to north, east, down."""
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    forward, right, down = vector
    return (forward * cos_yaw - right * sin_yaw, forward * sin_yaw + right * cos_yaw, down)


def is_finite(*vectors: Ned | None) -> bool:
    """Return True if all components of all vectors are finite; None is skipped."""
    return all(math.isfinite(part) for vector in vectors if vector is not None for part in vector)
