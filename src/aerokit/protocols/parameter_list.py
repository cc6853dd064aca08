"""``ParameterList``: all parameters of a vehicle by PARAM_REQUEST_LIST, holes asked for as soon as they are seen.

https://mavlink.io/en/services/parameter.html#read_all
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavParamError
from aerokit.mavlink.messages import ParamError, ParamRequestList, ParamRequestRead, ParamValue
from aerokit.parameters import Parameter, ParameterTable, ParameterType
from aerokit.parameters.encoding import UNKNOWN_INDEX, parameter_of
from aerokit.parameters.pack import HASH_NAME
from aerokit.parameters.parameter import MOST_PARAMETERS, same_value
from aerokit.protocols.named_values import PAUSES, SHORTEST_START_S, ValueList

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import TransferOptions

__all__ = ["ParameterList", "updated"]


def updated(known: Parameter, told: Parameter, bytewise: bool) -> Parameter:
    """What is known of a parameter after a PARAM_VALUE outside a list.

    Where values travel as numbers, such a message tells less than a list or a file. ArduPilot calls an integer a float
    in its answer to PARAM_SET when it holds its default, and an INT32 beyond 2**24 has lost its last bits.
    """
    value, type_ = told.value, told.type
    if not bytewise and known.type.is_integer:
        if type_ is ParameterType.REAL32 and value == value // 1:
            value, type_ = int(value), known.type
        if same_value(float(known.value), float(value)):
            value = known.value
    index = known.index if told.index is None else told.index
    return Parameter(known.name, value, type_, known.default, index)


LONGEST_TICK_S = 1.1
"""ArduPilot sends some of the list ten times a second, or as rarely as once (MAV1_PARAMS)."""

NEAR_END = 20
"""So few are asked for by index without waiting for that: it costs little if they were still to come."""

BEGUN = 2
"""With so many values the stream has begun: it is not asked for afresh any more."""

REFUSALS = 2


class ParameterList(ValueList[ParameterTable, Parameter]):
    """Ask for the whole list once; a hole in the stream of answers is asked for by its index at once, in a window.

    The vehicle says how many there are. That number may change meanwhile (ArduPilot shows a group when it is enabled,
    PX4 counts a parameter once it is used), and the indices behind the change with it: when the names do not add up,
    what came before the change is asked for again. Values with the index 65535 are no part of the list.

    Raises from ``result()``:
        ParameterTimeout: nothing new for ``patience_s`` seconds; ``missing`` are the indices that did not come.
    """

    expects: tuple[type[Message], ...] = (ParamValue, ParamError)
    asked_by = "PARAM_REQUEST_LIST"
    noun = "parameters"

    def __init__(
        self, target_system: int, target_component: int, *, bytewise: bool, **options: Unpack[TransferOptions]
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._bytewise = bytewise
        self._names: dict[str, Parameter] = {}
        self._refusals: dict[int, int] = {}
        self._streamed_count: int | None = None
        self._is_to_be_checked = False
        self._streamed = 0

    # ---------------------------------------------------------------------------- as an exchange

    def start(self, now: float) -> None:
        """Ask for the list, and for one value beside: its answer tells how long answers take."""
        self._begin(now)
        self._ask_for_list(now)
        if self.round_trip.smoothed_s is None:
            self._window.ask(0)
        self._step(now)

    def receive(self, message: Message, now: float) -> None:
        """Take one value of the list; others are ignored, as are those of other components."""
        if self.done or not self._is_from_target(message):
            return
        if isinstance(message, ParamValue):
            self._take(message, now)
        elif isinstance(message, ParamError):
            self._take_refusal(message)
        else:
            return
        self._step(now)

    # ------------------------------------------------------------------------------- what comes

    def _take(self, message: ParamValue, now: float) -> None:
        index = message.param_index
        if index == UNKNOWN_INDEX or message.param_id == HASH_NAME:
            self._take_uncounted(message, now)
            return
        is_streamed = self._is_streaming and index >= self._next
        self._note_count(message.param_count, is_streamed)
        if is_streamed:
            self._take_streamed(index, now)
        else:
            self._window.answered(index, now)
        if self._is_streaming and (is_streamed or not self._is_near_end):
            self._quiet_at = now + self._quiet_s()
        parameter = parameter_of(message, self._bytewise)
        if parameter.name not in self._names and len(self._names) >= MOST_PARAMETERS:
            return
        self._names[parameter.name] = parameter
        self._keep(index, parameter, message.param_count, now)

    def _take_uncounted(self, message: ParamValue, now: float) -> None:
        """Somebody has set it, or it is the hash: the list is about to begin."""
        self._note_count(message.param_count, False)
        if message.param_id == HASH_NAME:
            self._last_at = now
            self._quiet_at = now + self._quiet_s() if self._is_streaming else None
        elif message.param_id in self._names:
            told = parameter_of(message, self._bytewise)
            self._names[told.name] = updated(self._names[told.name], told, self._bytewise)

    def _take_refusal(self, message: ParamError) -> None:
        """An index that the vehicle has no more: the list has become shorter. Only the index counts, see PX4."""
        index = message.param_index
        if message.error != MavParamError.DOES_NOT_EXIST or index not in self._window or index in self._told:
            return
        self._refusals[index] = self._refusals.get(index, 0) + 1
        if self._refusals[index] >= REFUSALS and self._count is not None:
            for beyond in range(index, self._count):
                self._window.forget(beyond)
            self._count = min(self._count, index)

    def _note_count(self, count: int, is_streamed: bool) -> None:
        """Take a new count; those in ArduPilot's stream stay what they were at its beginning, and are no news."""
        if count == (self._streamed_count if is_streamed else self._count):
            return
        if is_streamed:
            self._streamed_count = count
        self._count, self._is_to_be_checked = count, True

    def _take_streamed(self, index: int, now: float) -> None:
        """Notice holes in the stream, and learn its pace."""
        for hole in range(self._next, min(index, self._count or 0)):
            self._window.ask(hole)
        if self._streamed:
            self._pause_s = max(now - self._last_at, 0.98 * self._pause_s)
        self._next = index + 1
        self._streamed += 1
        self._last_at = now
        if index == 0:
            self._window.answered(0, now)
        else:
            self._window.forget(index)
        if self._count is not None and self._next >= self._count:
            self._end_stream()

    # -------------------------------------------------------------------------------- what is sent

    def _list_request(self) -> Message:
        return ParamRequestList(self.target_system, self.target_component)

    def _read_request(self, index: int) -> Message:
        return ParamRequestRead(self.target_system, self.target_component, "", index)

    def _on_quiet(self, now: float) -> None:
        """The stream has not begun, or has stopped before its end: the rest is asked for by index."""
        if self._streamed < BEGUN and (self._count is None or self._count > BEGUN):
            self._ask_for_list(now)
            return
        self._end_stream()

    def _end_stream(self) -> None:
        self._is_streaming, self._quiet_at, self._is_to_be_checked = False, None, True

    def _quiet_s(self) -> float:
        """How long nothing at all has to come until the stream has stopped. Answers come in its place."""
        seconds = max(self.round_trip.timeout_s(), PAUSES * self._pause_s)
        if self._streamed < BEGUN:  # perhaps only the answer to what was asked beside
            return max(seconds, SHORTEST_START_S)
        return seconds if self._is_near_end else max(seconds, LONGEST_TICK_S)

    @property
    def _is_near_end(self) -> bool:
        return self._count is not None and self._count - self._next <= NEAR_END

    def _conclude(self) -> None:
        if self._is_streaming:
            return
        self._finish_when_complete()
        if self._is_to_be_checked and not self.done:
            self._is_to_be_checked = False
            for index in self._missing():
                self._window.ask(index)

    # -------------------------------------------------------------------------------- the end

    def _finish_when_complete(self) -> None:
        count = self._count
        if count is None or len(self._told) < count:
            return
        held = [self._told[index][0] for index in range(count) if index in self._told]
        names = {parameter.name for parameter in held}
        adds_up = len(names) == count == len(self._names)
        if len(held) != count:
            return
        if not adds_up and self._drop_stale(count):
            self._is_to_be_checked = True
        else:
            self._finish(ParameterTable(self._in_order(held, names)))

    def _in_order(self, held: list[Parameter], names: set[str]) -> list[Parameter]:
        """By index, each name once and with the value that came last; names that have no index any more at the end."""
        ordered = dict.fromkeys(parameter.name for parameter in held)
        if self._rounds == 0:
            ordered.update(dict.fromkeys(name for name in self._names if name not in names))
        table = []
        for index, name in enumerate(ordered):
            latest = self._names[name]
            table.append(Parameter(name, latest.value, latest.type, None, index))
        return table
