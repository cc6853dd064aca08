"""`Journal`: status texts that a simulated vehicle sent, and messages that it received."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TypeVar

from aerokit.mavlink.enums import MavCmd, MavSeverity
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandInt, CommandLong

MessageT = TypeVar("MessageT", bound=Message)


@dataclass(frozen=True)
class SentText:
    """A status text that the vehicle sent, joined from its chunks. The text may have been lost in transit."""

    time_s: float
    """Simulated seconds."""
    severity: int
    """MAV_SEVERITY: 0 is an emergency, 7 is for debugging."""
    text: str

    def __str__(self) -> str:
        severities = set(MavSeverity)
        name = MavSeverity(self.severity).name if self.severity in severities else str(self.severity)
        return f"{self.time_s:.1f} s {name} {self.text!r}"


@dataclass(frozen=True)
class ReceivedMessage:
    """A received message that was addressed to the vehicle and is supported by its firmware."""

    time_s: float
    """Simulated seconds."""
    message: Message


class Journal:
    """Status texts that a vehicle sent, and messages that it received, from the oldest to the newest.

    The journal grows while the vehicle runs. The ``assert_…`` methods raise AssertionError.
    """

    def __init__(self) -> None:
        self._texts: list[SentText] = []
        self._messages: list[ReceivedMessage] = []

    def on_text_sent(self, time_s: float, severity: int, text: str) -> None:
        """Append a text."""
        self._texts.append(SentText(time_s, severity, text.rstrip()))

    def on_message_received(self, time_s: float, message: Message) -> None:
        """Append a message."""
        self._messages.append(ReceivedMessage(time_s, message))

    @property
    def texts(self) -> list[SentText]:
        """Status texts that the vehicle sent."""
        return list(self._texts)

    @property
    def messages(self) -> list[ReceivedMessage]:
        """Messages that the vehicle received."""
        return list(self._messages)

    def of(self, kind: type[MessageT]) -> list[MessageT]:
        """Return the received messages of one class."""
        return [received.message for received in self.messages if isinstance(received.message, kind)]

    def commands(self, command: int) -> list[CommandLong | CommandInt]:
        """Return the received COMMAND_LONG and COMMAND_INT messages with this MAV_CMD, including repetitions."""
        return [message for message in self._received_commands() if message.command == command]

    def assert_sent_text(self, part: str) -> None:
        """Assert that the vehicle sent a text that contains ``part``."""
        __tracebackhide__ = True
        is_sent = any(part in text.text for text in self.texts)
        assert is_sent, f"no text with {part!r} was sent; sent texts:{_lines(self.texts)}"

    def assert_received_command(self, command: int, *, times: int | None = None) -> None:
        """Assert that the vehicle received this MAV_CMD at least once or, if ``times`` is given, that many times."""
        __tracebackhide__ = True
        count = len(self.commands(command))
        is_expected = count > 0 if times is None else count == times
        expected = "" if times is None else f", not {times} times"
        received = _lines(self._command_counts())
        assert is_expected, f"{_name(command)} was received {count} times{expected}; received commands:{received}"

    def _received_commands(self) -> list[CommandLong | CommandInt]:
        messages = (received.message for received in self.messages)
        return [message for message in messages if isinstance(message, CommandLong | CommandInt)]

    def _command_counts(self) -> list[str]:
        """Return the names of the received commands in order, with counts above 1."""
        counts = Counter(_name(message.command) for message in self._received_commands())
        return [name if count == 1 else f"{name}, {count} times" for name, count in counts.items()]


def _name(command: int) -> str:
    return MavCmd(command).name if command in set(MavCmd) else f"command {command}"


def _lines(entries: list[SentText] | list[str]) -> str:
    return "".join(f"\n  - {entry}" for entry in entries) or " none"
