"""Faults that can be injected into a simulated vehicle."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavResult
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Heartbeat


@dataclass
class CommandFault:
    """Fault that applies to the next ``times`` commands with the same MAV_CMD, or to all if ``times`` is None."""

    times: int | None = None
    refuse_with: int | None = None
    """MAV_RESULT with which the command is refused instead of being executed; None to execute the command."""
    text: str | None = None
    """Status text sent with the refusal."""
    ignore: bool = False
    """Neither execute nor acknowledge the command."""
    acks: int = 1
    """Number of acknowledgements to send. 0 loses the acknowledgement, 2 repeats it."""
    delay_s: float = 0.0
    """Delay of the acknowledgement in seconds. The command itself is executed at once."""
    progress: tuple[int, ...] = ()
    """Percentages of IN_PROGRESS answers sent before the result."""
    progress_interval_s: float = 0.5


@dataclass
class Faults:
    """Faults of a vehicle or component, initially all off. A change takes effect at the next message or step.

    - ``gps_lost``: no GPS fix. ArduPilot's estimator drops its position after seven seconds, PX4's at once. After five
      seconds, PX4 leaves a mode that needs a position
    - ``rc_lost``: the pilot's transmitter is off; the failsafes of the vehicle react
    - ``leak``: water in the hull of a submarine
    - ``heartbeats_stopped``: HEARTBEAT stops, all other streams continue
    - ``frozen``: the autopilot hangs; it does not receive, move or send until the fault is False again
    - ``silent``: the radio fails in both directions; the vehicle continues to fly
    - ``prearm_failures``: additional failures of the arming checks, such as "Compass not healthy"
    - ``drop_outgoing``, ``drop_incoming``: how many of the next frames to lose; each lost frame decrements the number
    - ``loss``, ``loss_incoming``: share of the outgoing and the incoming frames to lose, 0 to 1; the vehicle's seed
      determines which frames
    - ``lost_messages``: how many of the next outgoing messages to lose, by message id; see ``lose``
    - ``motor_failed``: one motor stops; the vehicle cannot hold its altitude and descends
    - ``no_ftp``: FILE_TRANSFER_PROTOCOL is not answered and not in the capabilities
    - ``parameter_limits``: minimum and maximum by parameter name; values that are set are clamped silently
    - ``read_only_parameters``: names of parameters that cannot be set
    - ``mute_parameters``: names of parameters whose PARAM_VALUE is always lost
    """

    gps_lost: bool = False
    rc_lost: bool = False
    leak: bool = False
    heartbeats_stopped: bool = False
    frozen: bool = False
    silent: bool = False
    prearm_failures: list[str] = field(default_factory=list)
    drop_outgoing: int = 0
    drop_incoming: int = 0
    loss: float = 0.0
    loss_incoming: float = 0.0
    lost_messages: dict[int, int] = field(default_factory=dict)
    motor_failed: bool = False
    no_ftp: bool = False
    parameter_limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    read_only_parameters: set[str] = field(default_factory=set)
    mute_parameters: set[str] = field(default_factory=set)
    commands: dict[int, CommandFault] = field(default_factory=dict)

    if not TYPE_CHECKING:  # If type checkers saw `__setattr__`, they would accept any name.

        def __setattr__(self, name: str, value: object) -> None:
            if name not in self.__dataclass_fields__:
                raise AttributeError(f"Faults has no fault {name!r}; faults: {', '.join(self.__dataclass_fields__)}")
            super().__setattr__(name, value)

    def refuse(
        self, command: int, result: int = MavResult.DENIED, text: str | None = None, *, times: int | None = None
    ) -> None:
        """Answer the next ``times`` commands of this MAV_CMD (None: all) with a MAV_RESULT, but do not execute them.

        ``text`` is sent as a status text before each answer.
        """
        self.commands[command] = CommandFault(times, refuse_with=result, text=text)

    def ignore(self, command: int, *, times: int | None = None) -> None:
        """Neither execute nor acknowledge the next ``times`` commands of this MAV_CMD (None: all)."""
        self.commands[command] = CommandFault(times, ignore=True)

    def lose_ack(self, command: int, *, times: int | None = 1) -> None:
        """Execute the next ``times`` commands of this MAV_CMD (None: all), but lose their acknowledgements."""
        self.commands[command] = CommandFault(times, acks=0)

    def lose(self, message_type: type[Message], *, times: int = 1) -> None:
        """Lose the next ``times`` outgoing messages of this type."""
        self.lost_messages[message_type.ID] = times

    def drops_outgoing(self, message: Message, rng: random.Random) -> bool:
        """Return True if a fault loses this outgoing message. Decrement the counter of the fault, if it has one."""
        if self.silent or (self.heartbeats_stopped and message.ID == Heartbeat.ID):
            return True
        remaining = self.lost_messages.get(message.ID, 0)
        if remaining:
            self.lost_messages[message.ID] = remaining - 1
            return True
        if self.drop_outgoing > 0:
            self.drop_outgoing -= 1
            return True
        return self.loss > 0.0 and rng.random() < self.loss

    def drops_incoming(self, rng: random.Random) -> bool:
        """Return True if a fault loses the next incoming message. Decrement the counter of the fault, if it has one."""
        if self.drop_incoming > 0:
            self.drop_incoming -= 1
            return True
        return self.loss_incoming > 0.0 and rng.random() < self.loss_incoming

    def repeat_ack(self, command: int, count: int = 2, *, times: int | None = None) -> None:
        """Send ``count`` acknowledgements for each of the next ``times`` commands of this MAV_CMD (None: all)."""
        self.commands[command] = CommandFault(times, acks=count)

    def delay_ack(self, command: int, seconds: float, *, times: int | None = None) -> None:
        """Execute the next ``times`` commands of this MAV_CMD (None: all), and acknowledge each after ``seconds``."""
        self.commands[command] = CommandFault(times, delay_s=seconds)

    def report_progress(
        self, command: int, percents: tuple[int, ...] = (10, 50, 90), *, interval_s: float = 0.5
    ) -> None:
        """Answer this MAV_CMD with IN_PROGRESS, a percentage every ``interval_s`` seconds, and then with the result."""
        self.commands[command] = CommandFault(progress=percents, progress_interval_s=interval_s)

    def clear(self, command: int | None = None) -> None:
        """Remove the faults of one command, or of all commands."""
        if command is None:
            self.commands.clear()
        else:
            self.commands.pop(command, None)

    def next_command_fault(self, command: int) -> CommandFault | None:
        """Return the fault to apply to this command now, or None. Decrement the ``times`` of the fault."""
        fault = self.commands.get(command)
        if fault is not None and fault.times is not None:
            fault.times -= 1
            if fault.times <= 0:
                del self.commands[command]
        return fault
