"""`Told`: how a state is declared: which messages tell it, by which decoder, and which of them is asked for.

Values are immutable, in SI units and degrees, the unit in the name. A number that the standard marks as unknown
(UINT16_MAX, −1, NaN …) is None, never a number. Angles are degrees, lengths metres, speeds metres per second;
directions are clockwise from north; ``down`` is positive downwards.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar, overload

from aerokit.mavlink import messages
from aerokit.mavlink.frame import Frame

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Mapping, Sequence

    from aerokit.autopilots import Autopilot
    from aerokit.connection.cells import StateCell
    from aerokit.mavlink.message import Message

T = TypeVar("T")

MESSAGE_IDS = {row[0]: message_id for message_id, row in messages.INDEX.items()}
"""Name of a message class → message id, without importing the class."""


def message_type(class_name: str) -> type[Message]:
    """The message class of this name."""
    found: type[Message] = getattr(messages, class_name)
    return found


class By(Generic[T]):
    """One message that tells a state.

    Args:
        message: name of its class; a name, so that not all messages are imported.
        decode: gives the value, or None when the message does not know it; None: the telemetry itself does it.
        knowing: ``decode`` is given what else is known (``reading.Context``), too.
        hz: the rate that it is asked for when a program asks for nothing special.
        second_best: it counts only while no better message has told the state lately.
        instead: some autopilots send this one instead of the first.
        one_of: the field that says which one of several it speaks of; each of them counts.
    """

    def __init__(
        self,
        message: str,
        decode: Callable[..., T | None] | None,
        *,
        knowing: bool = False,
        hz: float | None = None,
        second_best: bool = False,
        instead: bool = False,
        one_of: str | None = None,
    ) -> None:
        if message not in MESSAGE_IDS:
            raise ValueError(f"{message} is no message class")
        self.message: str = message
        self.decode = decode
        self.knowing: bool = knowing
        self.hz: float | None = hz
        self.second_best: bool = second_best
        self.instead: bool = instead
        self.one_of: str | None = one_of


class _HasCells(Protocol):
    def _cell_of(self, name: str) -> StateCell[Any]:
        """The cell of this name."""
        ...


class Told(Generic[T]):
    """A state that messages tell, in a class that declares states: the declaration on the class, a cell on an object.

    Args:
        sources: what tells it, the best first.
        waits_for: what is named when nothing has come; the messages that are asked for by default.
        at_once: it is worked out when the message comes, not when somebody looks.
    """

    name: str

    def __init__(self, *sources: By[T], waits_for: str = "", at_once: bool = False) -> None:
        if not sources:
            raise ValueError("a state needs a message that tells it")
        self.sources = sources
        self.at_once: bool = at_once
        self._waits_for = waits_for

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, instance: None, owner: type) -> Told[T]: ...
    @overload
    def __get__(self, instance: _HasCells, owner: type) -> StateCell[T]: ...
    def __get__(self, instance: _HasCells | None, owner: type) -> Told[T] | StateCell[T]:
        if instance is None:
            return self
        cell: StateCell[T] = instance._cell_of(self.name)
        instance.__dict__[self.name] = cell  # found there from now on
        return cell

    def asked_of(self, autopilot: Autopilot) -> list[type[Message]]:
        """The messages to ask this autopilot for when a program wants the state."""
        names = [each.message for each in self.sources[:1]] + [e.message for e in self.sources if e.instead]
        return [kind for kind in map(message_type, names) if autopilot.sends(kind)]

    def waits_for(self, autopilot: Autopilot) -> str:
        """The messages that it comes from, for error texts."""
        return self._waits_for or " or ".join(kind.NAME for kind in self.asked_of(autopilot))


U8, U16 = 0xFF, 0xFFFF

I16 = 0x7FFF


class Context:
    """What a decoder may know beside the message; ``before`` is the latest value of the state that it decodes."""

    __slots__ = ("autopilot", "base_mode", "before", "home_is_known", "mode_names")

    def __init__(
        self, autopilot: Autopilot, mode_names: Mapping[int, str], home_is_known: Callable[[], bool]
    ) -> None:
        self.autopilot: Autopilot = autopilot
        self.mode_names: Mapping[int, str] = mode_names
        self.home_is_known: Callable[[], bool] = home_is_known
        self.base_mode: int = 0
        self.before: Any = None


def member(enum: type[int], value: int) -> int:
    """The enum's member, or the number itself when the enum does not know it."""
    return enum._value2member_map_.get(value, value)  # type: ignore[attr-defined,no-any-return]


def finite(value: float) -> float | None:
    """The number, None for NaN and infinity."""
    return value if math.isfinite(value) else None


def unless(value: int, unknown: int) -> int | None:
    """The number, None when it is the one that stands for unknown."""
    return None if value == unknown else value


def scaled(value: int, unknown: int, divisor: int) -> float | None:
    """The number by ``divisor``, None when it is the one that stands for unknown."""
    return None if value == unknown else value / divisor


LOOK_S = 5.0
"""So often, in seconds, they are worked out although nobody looks: a value that a later message does not have any more
(a position without a fix) is known from before."""

_HEADER_LENGTH = 9


class StreamedMessage:
    """One kind of message of one vehicle's autopilot. It keeps the latest frame, and works it out when it is looked at.

    ``number_at``: where in the payload the byte is that says which one of several it speaks of; each of them is kept.
    While one of ``cells`` is watched, each frame is worked out (``apply(frame, message)``) as it comes. Frames come on
    the loop's thread; any thread may look. ``lock`` keeps the threads apart.
    """

    __slots__ = (
        "_apply",
        "_cells",
        "_component_id",
        "_is_watched",
        "_lock",
        "_look_at",
        "_number_at",
        "pending",
    )

    def __init__(
        self,
        component_id: int,
        cells: Sequence[StateCell[object]],
        number_at: int | None,
        apply: Callable[[Frame, Message | None], None],
        lock: threading.RLock,
    ) -> None:
        self._component_id, self._cells, self._apply, self._lock = component_id, cells, apply, lock
        self._number_at = None if number_at is None else number_at + _HEADER_LENGTH
        self._look_at = -math.inf
        self._is_watched = False
        self.pending: dict[int, Frame | Message] = {}
        """The frames that were not worked out yet, by the number of what they speak of."""

    def take(self, frame: Frame, message: Message | None = None) -> None:
        """Take a frame of the vehicle's system; only those of its autopilot count. ``message``: if it is decoded."""
        if frame.component_id != self._component_id:
            return
        if self._is_watched or frame.received_at >= self._look_at:
            self._look_at = frame.received_at + LOOK_S
            with self._lock:  # never left to another thread: who waits for it is told on this one
                self.catch_up()
                self._apply(frame, message)
            return
        number_at = self._number_at
        if number_at is None:
            self.pending[0] = frame if message is None else message
        else:
            number = frame.body[number_at] if len(frame.body) > number_at else 0
            self.pending[number] = frame if message is None else message

    def catch_up(self) -> None:
        """Work out what has come, in the order in which it came."""
        with self._lock:
            waiting: list[tuple[Frame, Message | None]] = []
            # None is left first: who works one out may look at the value before, and come here again.
            while self.pending:
                came = self.pending.popitem()[1]
                if isinstance(came, Frame):
                    waiting.append((came, None))
                elif came.received_frame is not None:
                    waiting.append((came.received_frame, came))
            waiting.sort(key=lambda each: each[0].received_at)
            for frame, message in waiting:
                self._apply(frame, message)

    def watchers_changed(self) -> None:
        """Somebody begins or ends to wait for what is in the cells."""
        self._is_watched = any(cell._is_watched for cell in self._cells)

    def forget(self) -> None:
        """What has come does not count any more."""
        with self._lock:
            self.pending.clear()
            self._look_at = -math.inf
