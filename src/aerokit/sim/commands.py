"""Commands to a simulated vehicle: COMMAND_LONG and COMMAND_INT in, COMMAND_ACK out.

https://mavlink.io/en/services/command.html
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from aerokit.mavlink.enums import MavFrame, MavResult, MavSeverity
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandAck, CommandInt, CommandLong
from aerokit.sim.channel import Channel
from aerokit.sim.faults import CommandFault, Faults
from aerokit.sim.vehicle import sender_of


@dataclass(frozen=True)
class Command:
    """One request, whichever message it came in.

    ``x`` and ``y`` are params 5 and 6: numbers as they are in COMMAND_LONG, degrees times 1e7 in COMMAND_INT.
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
    """MAV_FRAME of a COMMAND_INT; None in COMMAND_LONG."""
    channel: Channel
    sender: tuple[int, int]

    @property
    def is_long(self) -> bool:
        """Whether it came as COMMAND_LONG."""
        return self.frame is None

    def place(self) -> tuple[int, int]:
        """Latitude and longitude in degrees times 1e7."""
        scale = 1e7 if self.is_long else 1
        return (whole(self.x * scale), whole(self.y * scale))

    @property
    def altitude_frame(self) -> int:
        """The MAV_FRAME that ``z`` is in; COMMAND_LONG means above home."""
        return MavFrame.GLOBAL_RELATIVE_ALT if self.frame is None else self.frame


@dataclass(frozen=True)
class Progress:
    """A command that takes time: IN_PROGRESS with these percentages, then the result."""

    percents: tuple[int, ...]
    interval_s: float
    result: int = MavResult.ACCEPTED
    finish: Callable[[], None] | None = None
    """Done right before the result is sent."""


CommandHandler = Callable[[Command], "int | Progress | None"]


class Commanded(Protocol):
    """Who takes commands: a vehicle, or another component."""

    faults: Faults

    def on(self, message_class: type[Message], handler: Callable[[Any, Channel], None]) -> None:
        """Hear such messages."""
        ...

    def send(self, message: Message, channel: Channel | None = None) -> None: ...

    def send_text(self, severity: int, text: str) -> None: ...

    def call_later(self, delay: float, action: Callable[[], None]) -> None:
        """Do something after ``delay`` seconds."""
        ...


class CommandServer:
    """Finds the handler of a command, lets faults meddle, and answers to who asked.

    A handler returns a MAV_RESULT, a `Progress`, or None when it answers by itself. What it sends itself goes
    out before the acknowledgement. An unknown command is UNSUPPORTED. ``refusal`` gives the MAV_RESULT of what is
    refused whichever command it is.
    """

    def __init__(
        self,
        vehicle: Commanded,
        handlers: dict[int, CommandHandler],
        refusal: Callable[[Command], int | None] = lambda _: None,
    ) -> None:
        self._vehicle = vehicle
        self._handlers = handlers
        self._refusal = refusal
        vehicle.on(CommandLong, self._on_long)
        vehicle.on(CommandInt, self._on_int)

    def _on_long(self, message: CommandLong, channel: Channel) -> None:
        numbers = (message.param1, message.param2, message.param3, message.param4)
        place = (message.param5, message.param6, message.param7)
        self.execute(Command(message.command, *numbers, *place, None, channel, sender_of(message)))

    def _on_int(self, message: CommandInt, channel: Channel) -> None:
        numbers = (message.param1, message.param2, message.param3, message.param4)
        place = (message.x, message.y, message.z)
        self.execute(Command(message.command, *numbers, *place, message.frame, channel, sender_of(message)))

    def execute(self, command: Command) -> None:
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
        if isinstance(answer, Progress):
            self._report(command, answer, fault)
        elif answer is not None:
            self.answer(command, answer, fault)

    def answer(self, command: Command, result: int, fault: CommandFault | None = None) -> None:
        """Send the acknowledgement, as often and as late as the fault wants it."""
        fault = CommandFault() if fault is None else fault
        if fault.progress:
            without = CommandFault(acks=fault.acks, delay_s=fault.delay_s)
            self._report(command, Progress(fault.progress, fault.progress_interval_s, result), without)
            return
        for _ in range(fault.acks):
            if fault.delay_s > 0:
                self._vehicle.call_later(fault.delay_s, lambda: self._send(command, result))
            else:
                self._send(command, result)

    def _report(self, command: Command, progress: Progress, fault: CommandFault | None) -> None:
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

    def _send(self, command: Command, result: int, progress: int = 0) -> None:
        system, component = command.sender
        ack = CommandAck(command.command, result, progress, 0, system, component)
        self._vehicle.send(ack, command.channel)


def whole(value: float) -> int:
    """A parameter as a whole number. 0 for NaN, by which programs leave it open, and for what is too big."""
    return int(value) if value == value and abs(value) < 2**31 else 0
