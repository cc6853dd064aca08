"""`StateField`: declares a state with the messages that report it, their decoders, and the rates to request.

Values are immutable, in SI units and degrees, with the unit in the name. A number that MAVLink defines as "unknown"
(UINT16_MAX, −1, NaN …) becomes None. Angles are in degrees, lengths in metres, speeds in metres per second; directions
are clockwise from north; ``down`` is positive downwards.
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

MESSAGE_IDS = {class_name: message_id for message_id, (class_name, *_) in messages.INDEX.items()}
"""Maps the name of a message class to the message id, without importing the class."""


def message_type(class_name: str) -> type[Message]:
    message_class: type[Message] = getattr(messages, class_name)
    return message_class


class MessageSource(Generic[T]):
    """One message that reports a state.

    Args:
        message: name of the message class. The class itself is imported only when it is needed.
        decode: function that returns the value, or None if the message does not contain the value. Pass None instead
            of a function if `Telemetry` itself handles the message.
        needs_context: True if ``decode`` also takes a :class:`Context`.
        hz: the default rate to request, in Hz.
        fallback: True if the message is ignored when a better one has reported the state recently.
        alternative: True if some autopilots send this message instead of the first message of the state.
        instance_field: the field with the number of the instance, such as the battery. The state combines all
            instances.
        watched_hz: the rate to request instead of ``hz`` while your program waits for the state or follows it.
    """

    def __init__(
        self,
        message: str,
        decode: Callable[..., T | None] | None,
        *,
        needs_context: bool = False,
        hz: float | None = None,
        fallback: bool = False,
        alternative: bool = False,
        instance_field: str | None = None,
        watched_hz: float | None = None,
    ) -> None:
        if message not in MESSAGE_IDS:
            raise ValueError(f"{message} is not the name of a message class")
        self.message: str = message
        self.decode = decode
        self.needs_context: bool = needs_context
        self.hz: float | None = hz
        self.fallback: bool = fallback
        self.alternative: bool = alternative
        self.instance_field: str | None = instance_field
        self.watched_hz: float | None = watched_hz


class _HasCells(Protocol):
    def _cell_of(self, name: str) -> StateCell[Any]: ...


class StateField(Generic[T]):
    """Descriptor of a state: the class attribute is the declaration, the instance attribute the cell with the value.

    Args:
        sources: the messages that report the state, the best first.
        waits_for: what error texts name as missing while the state is unknown; default: the requested messages.
        eager: decode each message when it arrives, not on the first access to the value.
    """

    name: str

    def __init__(self, *sources: MessageSource[T], waits_for: str = "", eager: bool = False) -> None:
        if not sources:
            raise ValueError("a state needs at least one message that reports it")
        self.sources = sources
        self.eager: bool = eager
        self._waits_for = waits_for

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, instance: None, owner: type) -> StateField[T]: ...
    @overload
    def __get__(self, instance: _HasCells, owner: type) -> StateCell[T]: ...
    def __get__(self, instance: _HasCells | None, owner: type) -> StateField[T] | StateCell[T]:
        if instance is None:
            return self
        cell: StateCell[T] = instance._cell_of(self.name)
        instance.__dict__[self.name] = cell  # Later accesses find the cell in the instance and bypass this method.
        return cell

    def requested_from(self, autopilot: Autopilot) -> list[type[Message]]:
        best, *others = self.sources
        names = [best.message, *(source.message for source in others if source.alternative)]
        return [message_class for message_class in map(message_type, names) if autopilot.sends(message_class)]

    def waits_for(self, autopilot: Autopilot) -> str:
        """Return the names of the messages that report the state, for error texts."""
        if self._waits_for:
            return self._waits_for
        names = " or ".join(message_class.NAME for message_class in self.requested_from(autopilot))
        return names or f"{message_type(self.sources[0].message).NAME}, which {autopilot.firmware} does not send,"


# The greatest values of integer fields (unsigned and signed). In many fields of MAVLink they mean "unknown".
U8, U16, I16 = 0xFF, 0xFFFF, 0x7FFF


class Context:
    """Input of a decoder besides the message. ``previous_value`` is the value of the state so far."""

    __slots__ = ("autopilot", "base_mode", "home_is_known", "mode_names", "previous_value")

    def __init__(self, autopilot: Autopilot, mode_names: Mapping[int, str], home_is_known: Callable[[], bool]) -> None:
        self.autopilot: Autopilot = autopilot
        self.mode_names: Mapping[int, str] = mode_names
        self.home_is_known: Callable[[], bool] = home_is_known
        self.base_mode: int = 0
        self.previous_value: Any = None


def enum_member(enum: type[int], value: int) -> int:
    """Return the enum's member, or the number itself if the enum does not contain it."""
    return enum._value2member_map_.get(value, value)  # type: ignore[attr-defined,no-any-return]


def finite(value: float) -> float | None:
    """Return the number, or None for NaN and infinity."""
    return value if math.isfinite(value) else None


def known(value: int, *, unknown: int) -> int | None:
    return None if value == unknown else value


def divided(value: int, divisor: int, *, unknown: int) -> float | None:
    return None if value == unknown else value / divisor


# A frame is decoded at least this often, even if the program reads no value. Without this limit, the last position
# before a loss of the fix could be replaced, undecoded, by a frame without a position.
MAX_DECODE_DELAY_S = 5.0

# Number of bytes before the payload in ``Frame.body``.
_HEADER_LENGTH = 9


class StreamedMessage:
    """One message type of a vehicle's autopilot. Keeps the latest frame, and decodes it when a value is read.

    Some messages report several instances, such as batteries, and have an instance number at ``instance_at`` in the
    payload. The latest frame of each instance is kept. ``apply(frame, message)`` updates ``cells``; ``message`` is None
    if the frame is not decoded yet. Any thread may read a cell, so ``lock`` protects this object.
    """

    __slots__ = (
        "_apply",
        "_cells",
        "_component_id",
        "_decode_due_at",
        "_instance_at",
        "_is_watched",
        "_lock",
        "pending",
    )

    def __init__(
        self,
        component_id: int,
        cells: Sequence[StateCell[object]],
        instance_at: int | None,
        apply: Callable[[Frame, Message | None], None],
        lock: threading.RLock,
    ) -> None:
        self._component_id = component_id
        self._cells = cells
        self._apply = apply
        self._lock = lock
        # Offset of the instance number in `Frame.body`, which begins with the header. None if the message has none.
        self._instance_at = None if instance_at is None else instance_at + _HEADER_LENGTH
        # From this time on, a frame is decoded when it arrives. Before, it is decoded only when a cell is read.
        self._decode_due_at = -math.inf
        # True while one of the cells has observers.
        self._is_watched = False
        self.pending: dict[int, Frame | Message] = {}
        """The latest frame or decoded message of each instance number, until it is applied to the cells."""

    def receive(self, frame: Frame, message: Message | None = None) -> None:
        """Keep a frame until a cell is read. Apply it now if a cell has observers, or after MAX_DECODE_DELAY_S.

        ``message`` is the decoded frame, if it was decoded already.
        """
        if frame.component_id != self._component_id:
            return
        if self._is_watched or frame.received_at >= self._decode_due_at:
            self._decode_due_at = frame.received_at + MAX_DECODE_DELAY_S
            # Without the lock, a thread that reads a cell could apply older frames between `catch_up` and `_apply`.
            with self._lock:
                if self.pending:
                    self.catch_up()  # Frames that arrived earlier must be applied first.
                self._apply(frame, message)
            return
        instance = 0
        # MAVLink 2 truncates zeros at the end of the payload, so a missing byte is 0.
        if self._instance_at is not None and len(frame.body) > self._instance_at:
            instance = frame.body[self._instance_at]
        self.pending[instance] = message or frame  # Setting an item of a dict is atomic, so it needs no lock.

    def catch_up(self) -> None:
        """Decode the pending frames in the order of their arrival."""
        with self._lock:
            to_apply: list[tuple[Frame, Message | None]] = []
            # Remove all frames before the first one is decoded. A decoder may read the previous value of a cell, which
            # calls `catch_up` again.
            while self.pending:
                _, pending = self.pending.popitem()
                if isinstance(pending, Frame):
                    to_apply.append((pending, None))
                elif pending.received_frame is not None:
                    to_apply.append((pending.received_frame, pending))
            to_apply.sort(key=lambda frame_and_message: frame_and_message[0].received_at)
            for frame, message in to_apply:
                self._apply(frame, message)

    def watchers_changed(self) -> None:
        """Decode frames on arrival if a cell has observers, otherwise on access."""
        self._is_watched = any(cell._is_watched for cell in self._cells)

    def forget(self) -> None:
        with self._lock:
            self.pending.clear()
            self._decode_due_at = -math.inf
