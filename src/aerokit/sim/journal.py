"""`Journal`: what a simulated vehicle heard and what it said, for whoever wants to know afterwards."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TypeVar

from aerokit.mavlink.enums import MavCmd, MavSeverity
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandInt, CommandLong

MessageT = TypeVar("MessageT", bound=Message)


@dataclass(frozen=True)
class SaidText:
    """A status text, whole, as the vehicle said it; it may have been lost on the way."""

    time_s: float
    """Simulated seconds."""
    severity: int
    """A MAV_SEVERITY: 0 is an emergency, 7 is for debugging."""
    text: str

    def __str__(self) -> str:
        severities = set(MavSeverity)
        name = MavSeverity(self.severity).name if self.severity in severities else str(self.severity)
        return f"{self.time_s:.1f} s {name} {self.text!r}"


@dataclass(frozen=True)
class HeardMessage:
    """A message that reached the vehicle, was for it, and is of a kind that it understands."""

    time_s: float
    """Simulated seconds."""
    message: Message


class Journal:
    """Oldest first; it grows while the vehicle lives. Assertions raise AssertionError."""

    def __init__(self) -> None:
        self._texts: list[SaidText] = []
        self._messages: list[HeardMessage] = []

    def said(self, time_s: float, severity: int, text: str) -> None:
        """Note a text."""
        self._texts.append(SaidText(time_s, severity, text.rstrip()))

    def heard(self, time_s: float, message: Message) -> None:
        """Note a message."""
        self._messages.append(HeardMessage(time_s, message))

    @property
    def texts(self) -> list[SaidText]:
        """What it said."""
        return list(self._texts)

    @property
    def messages(self) -> list[HeardMessage]:
        """What it heard."""
        return list(self._messages)

    def of(self, kind: type[MessageT]) -> list[MessageT]:
        """The messages of one kind that it heard."""
        return [heard.message for heard in self.messages if isinstance(heard.message, kind)]

    def commands(self, command: int) -> list[CommandLong | CommandInt]:
        """The orders of one MAV_CMD that it heard, in either message; repetitions count."""
        return [order for order in self._orders() if order.command == command]

    def assert_said(self, part: str) -> None:
        """It said a text with these words in it."""
        __tracebackhide__ = True
        said = any(part in text.text for text in self.texts)
        assert said, f"it never said {part!r}; it said:{_lines(self.texts)}"

    def assert_heard(self, command: int, *, times: int | None = None) -> None:
        """It heard an order of this MAV_CMD, once or more; or just so many times (0: never)."""
        __tracebackhide__ = True
        count = len(self.commands(command))
        right = count > 0 if times is None else count == times
        wanted = "" if times is None else f", not {times} times"
        assert right, f"it heard {_name(command)} {count} times{wanted}; it heard:{_lines(self._names())}"

    def _orders(self) -> list[CommandLong | CommandInt]:
        messages = (heard.message for heard in self.messages)
        return [message for message in messages if isinstance(message, CommandLong | CommandInt)]

    def _names(self) -> list[str]:
        """Each once, in the order of its first time, with how often it was heard."""
        counts = Counter(_name(order.command) for order in self._orders())
        return [name if count == 1 else f"{name}, {count} times" for name, count in counts.items()]


def _name(command: int) -> str:
    return MavCmd(command).name if command in set(MavCmd) else f"command {command}"


def _lines(entries: list[SaidText] | list[str]) -> str:
    return "".join(f"\n  - {entry}" for entry in entries) or " nothing"
