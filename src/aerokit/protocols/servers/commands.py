"""Commands: COMMAND_LONG and COMMAND_INT with their acknowledgement (https://mavlink.io/en/services/command.html)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import MavFrame, MavResult
from aerokit.mavlink.messages import CommandAck, CommandCancel, CommandInt, CommandLong
from aerokit.protocols.servers.host import Channel, ComponentIds, ServerHost, sender_of


@dataclass(frozen=True)
class ReceivedCommand:
    """A command received as COMMAND_LONG or COMMAND_INT.

    ``x`` and ``y`` are params 5 and 6 as sent. A position is in degrees in COMMAND_LONG, and in degrees times 1e7 in
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
    sender: ComponentIds
    confirmation: int = 0
    """Number of earlier transmissions of this COMMAND_LONG."""

    @property
    def is_long(self) -> bool:
        return self.frame is None

    @property
    def params(self) -> tuple[float, float, float, float, float, float, float]:
        return (self.param1, self.param2, self.param3, self.param4, self.x, self.y, self.z)

    def place(self) -> tuple[int, int]:
        """Return latitude and longitude in degrees times 1e7."""
        scale = 1e7 if self.is_long else 1
        return (to_int(self.x * scale), to_int(self.y * scale))

    @property
    def altitude_frame(self) -> int:
        """MAV_FRAME of ``z``. The ``z`` of a COMMAND_LONG is relative to home."""
        return MavFrame.GLOBAL_RELATIVE_ALT if self.frame is None else self.frame


@dataclass(frozen=True)
class CommandProgress:
    """Answers to a command that takes time: an IN_PROGRESS with each of ``percents``, and finally ``result``."""

    percents: tuple[int, ...]
    interval_s: float
    result: int = MavResult.ACCEPTED
    finish: Callable[[], None] | None = None
    """Called right before the result is sent."""


# Function that executes a command. It returns a MAV_RESULT or a CommandProgress; None if it sends the acknowledgement
# itself.
CommandHandler = Callable[[ReceivedCommand], "int | CommandProgress | None"]


class CommandDispatcher:
    """Dispatches commands to handlers and sends COMMAND_ACK to the sender.

    Messages that a handler sends precede the acknowledgement. A command without a handler is answered with UNSUPPORTED.
    ``refusal`` is called before the handler, and returns a MAV_RESULT to refuse the command, or None.
    """

    def __init__(
        self,
        host: ServerHost,
        handlers: dict[int, CommandHandler],
        refusal: Callable[[ReceivedCommand], int | None] = lambda _: None,
    ) -> None:
        self._host = host
        self._handlers = handlers
        self._refusal = refusal
        host.on(CommandLong, self._on_long)
        host.on(CommandInt, self._on_int)

    def _on_long(self, message: CommandLong, channel: Channel) -> None:
        command = ReceivedCommand(
            command=message.command, param1=message.param1, param2=message.param2, param3=message.param3,
            param4=message.param4, x=message.param5, y=message.param6, z=message.param7, frame=None, channel=channel,
            sender=sender_of(message), confirmation=message.confirmation,
        )  # fmt: skip
        self._execute(command)

    def _on_int(self, message: CommandInt, channel: Channel) -> None:
        command = ReceivedCommand(
            command=message.command, param1=message.param1, param2=message.param2, param3=message.param3,
            param4=message.param4, x=message.x, y=message.y, z=message.z, frame=message.frame, channel=channel,
            sender=sender_of(message),
        )  # fmt: skip
        self._execute(command)

    def _execute(self, command: ReceivedCommand) -> None:
        refusal = self._refusal(command)
        if refusal is not None:
            self.answer(command, refusal)
            return
        self.dispatch(command)

    def dispatch(self, command: ReceivedCommand) -> None:
        """Call the command's handler, and send its result as acknowledgement.

        A handler that returns None sends the acknowledgement itself.
        """
        answer = self.handle(command)
        if isinstance(answer, CommandProgress):
            self.report(command, answer, lambda: self.answer(command, answer.result))
        elif answer is not None:
            self.answer(command, answer)

    def handle(self, command: ReceivedCommand) -> int | CommandProgress | None:
        handler = self._handlers.get(command.command)
        return MavResult.UNSUPPORTED if handler is None else handler(command)

    def report(self, command: ReceivedCommand, progress: CommandProgress, send_result: Callable[[], None]) -> None:
        """Send IN_PROGRESS with each percentage, then call ``progress.finish`` and ``send_result``."""
        for index, percent in enumerate(progress.percents):
            self._host.call_later(
                index * progress.interval_s,
                lambda percent=percent: self.answer(command, MavResult.IN_PROGRESS, percent),  # type: ignore[misc]
            )

        def complete() -> None:
            if progress.finish is not None:
                progress.finish()
            send_result()

        self._host.call_later(max(1, len(progress.percents)) * progress.interval_s, complete)

    def answer(self, command: ReceivedCommand, result: int, progress: int = 0, detail: int = 0) -> None:
        """Send an acknowledgement with ``detail`` as its ``result_param2``."""
        ack = CommandAck(
            command.command, result, progress=progress, result_param2=detail, target_system=command.sender.system,
            target_component=command.sender.component,
        )  # fmt: skip
        self._host.send(ack, command.channel)


MAX_RUNNING_COMMANDS = 16
"""Maximum number of commands that a component executes at once. Further commands are TEMPORARILY_REJECTED."""
PROGRESS_DELAY_S = 0.1
"""Seconds before the first IN_PROGRESS, so that a quick command is acknowledged once."""
PROGRESS_INTERVAL_S = 0.5
UNKNOWN_PROGRESS = 255


RESULT_MAX_AGE_S = 5.0
"""For this time after a command has ended, or was repeated, a repetition gets its result, and is not executed again."""
MAX_RESULTS = 256
"""Maximum number of stored results. If there are more, the oldest is forgotten."""


class CommandResult(Snapshot):
    """Result of a command handler: a MAV_RESULT, and two numbers whose meaning depends on the command."""

    result: int = MavResult.ACCEPTED.value
    progress: int = 0
    detail: int = 0
    """``result_param2`` of COMMAND_ACK."""


class EndedCommand(NamedTuple):
    """A command that has ended, and the time of its end or of its last repetition."""

    command: ReceivedCommand
    result: CommandResult
    repeated_at: float


class RunningCommand:
    """A command that is being executed. ``cancel`` returns False if the command cannot be cancelled."""

    def __init__(self, command: ReceivedCommand, cancel: Callable[[], bool]) -> None:
        self.command = command
        self.progress: int = UNKNOWN_PROGRESS
        """Progress in percent; 255 if unknown."""
        self.cancel = cancel


class RunningCommands:
    """The commands that a component is executing. Sends their IN_PROGRESS messages, and handles COMMAND_CANCEL.

    While a command runs, a second one with the same MAV_CMD is TEMPORARILY_REJECTED, unless it is a stop command. All
    new commands are rejected in this way while ``MAX_RUNNING_COMMANDS`` run.

    A repeated transmission (COMMAND_LONG with a confirmation) does not execute its command again. The answer is
    IN_PROGRESS while the command runs, and its result for five seconds after the end or the last repetition.
    """

    def __init__(self, host: ServerHost, server: CommandDispatcher) -> None:
        self._host = host
        self._server = server
        self._running: dict[int, RunningCommand] = {}
        # By MAV_CMD and sender: the command that ended last. Entries are ordered by `repeated_at`.
        self._ended: dict[tuple[int, ComponentIds], EndedCommand] = {}
        host.on(CommandCancel, self._on_cancel)

    def start(
        self, command: ReceivedCommand, cancel: Callable[[], bool], *, is_stop: bool = False
    ) -> RunningCommand | None:
        """Register a command before it is executed.

        Returns None if the command must not be executed. Its sender has then been answered. A stop command
        (``is_stop``) first cancels the running command with the same MAV_CMD.
        """
        running = self._running.get(command.command)
        if running is not None and _is_repeated(command, running.command):
            self._server.answer(command, MavResult.IN_PROGRESS, running.progress)
            return None
        ended = self._ended.get((command.command, command.sender))
        is_recent = ended is not None and self._host.now - ended.repeated_at <= RESULT_MAX_AGE_S
        # A stop command is executed again, because it may be a new one whose first transmission was lost.
        if ended is not None and is_recent and not is_stop and _is_repeated(command, ended.command):
            # A sender that loses many answers may repeat its command for longer than `RESULT_MAX_AGE_S`.
            self._record_result(ended.command, ended.result)
            self._server.answer(command, **ended.result.to_dict())
            return None
        if running is not None and is_stop and self._cancel(running, on_behalf_of=command):
            running = None
        if running is not None or len(self._running) >= MAX_RUNNING_COMMANDS:
            self._server.answer(command, MavResult.TEMPORARILY_REJECTED)
            return None
        started = RunningCommand(command, cancel)
        self._running[command.command] = started
        self._host.call_later(PROGRESS_DELAY_S, lambda: self._report_repeatedly(started))
        return started

    def _cancel(self, running: RunningCommand, *, on_behalf_of: ReceivedCommand) -> bool:
        """Cancel a running command for a stop command. Return False if it cannot be cancelled."""
        key = running.command.command
        del self._running[key]  # first, because `cancel` may finish the command, which would send its result
        if not running.cancel():
            self._running[key] = running
            return False
        # The sender of both commands would take CANCELLED for the answer to the stop command.
        if running.command.sender != on_behalf_of.sender:
            self._server.answer(running.command, MavResult.CANCELLED)
        return True

    def report(self, running: RunningCommand, percent: int) -> None:
        running.progress = percent
        if self._running.get(running.command.command) is running:
            self._server.answer(running.command, MavResult.IN_PROGRESS, percent)

    def _report_repeatedly(self, running: RunningCommand) -> None:
        if self._running.get(running.command.command) is running:
            self._server.answer(running.command, MavResult.IN_PROGRESS, running.progress)
            self._host.call_later(PROGRESS_INTERVAL_S, lambda: self._report_repeatedly(running))

    def finish(self, running: RunningCommand, result: CommandResult) -> None:
        command = running.command
        if self._running.get(command.command) is running:
            del self._running[command.command]
            self._record_result(command, result)
            self._server.answer(command, **result.to_dict())

    def _record_result(self, command: ReceivedCommand, result: CommandResult) -> None:
        # Each sender has its own entry, because a repetition may arrive after the same command of another sender.
        key = (command.command, command.sender)
        self._ended.pop(key, None)  # A replaced entry would keep its old place, and be removed too early.
        if len(self._ended) >= MAX_RESULTS:
            del self._ended[next(iter(self._ended))]
        self._ended[key] = EndedCommand(command, result, self._host.now)

    def cancel_all(self) -> None:
        for running in tuple(self._running.values()):
            running.cancel()

    def _on_cancel(self, message: CommandCancel, _: Channel) -> None:
        running = self._running.get(message.command)
        if running is not None:
            running.cancel()


def _is_repeated(command: ReceivedCommand, earlier: ReceivedCommand) -> bool:
    if command.confirmation == 0 or command.sender != earlier.sender:
        return False
    pairs = zip(command.params, earlier.params, strict=True)
    # NaN, which many commands use for a missing parameter, does not equal itself.
    return all(param == old_param or (math.isnan(param) and math.isnan(old_param)) for param, old_param in pairs)


def to_int(value: float) -> int:
    """Return a parameter as an integer. NaN (unset) and values beyond 32 bits become 0."""
    return int(value) if not math.isnan(value) and abs(value) < 2**31 else 0
