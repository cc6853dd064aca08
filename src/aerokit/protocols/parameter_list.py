"""Download of all parameters by PARAM_REQUEST_LIST (https://mavlink.io/en/services/parameter.html#read_all)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavParamError
from aerokit.mavlink.messages import ParamError, ParamRequestList, ParamRequestRead, ParamValue
from aerokit.parameters import Parameter, ParameterTable, ParameterType
from aerokit.parameters.encoding import UNKNOWN_INDEX, parameter_of
from aerokit.parameters.pack import HASH_NAME
from aerokit.parameters.parameter import MAX_PARAMETERS, same_value
from aerokit.protocols.named_values import MIN_START_TIMEOUT_S, TIMEOUT_PAUSES, ValueList

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import TransferOptions

__all__ = ["ParameterList", "merge_update"]


def merge_update(known: Parameter, reported: Parameter, bytewise: bool) -> Parameter:
    """Merge a PARAM_VALUE that is not part of a list into a known parameter.

    PARAM_VALUE is less exact for integers, unless the vehicle encodes them ``bytewise``. Then the known type is kept
    if the reported one is a float, and the known value if it rounds to the same float as the reported one.
    """
    value, type_ = reported.value, reported.type
    if not bytewise and known.type.is_integer:
        is_whole = float(value).is_integer()
        # If the value is the default, ArduPilot's answer to PARAM_SET reports an integer parameter as a float.
        if type_ is ParameterType.REAL32 and is_whole:
            value, type_ = int(value), known.type
        # A float cannot hold the last bits of an INT32 beyond 2**24, so the known value is more exact.
        if same_value(float(known.value), float(value)):
            value = known.value
    index = known.index if reported.index is None else reported.index
    return Parameter(known.name, value, type_, default=known.default, index=index)


# Maximum seconds between two groups of values of a list. ArduPilot sends ten groups a second, or one (MAV1_PARAMS = 1).
MAX_GROUP_INTERVAL_S = 1.1

# If at most this many values are left in the stream, its time-out is shorter. Values that are then requested too early
# arrive twice, which costs little.
NEAR_END = 20

# The list's stream counts as started once it has sent this many values. The list is then not requested again.
MIN_STREAMED = 2

# With each value of the stream, the longest pause shrinks by this factor, so that a single long pause is forgotten.
PAUSE_DECAY = 0.98

# An index counts as nonexistent after this many PARAM_ERROR messages.
MAX_REFUSALS = 2


class ParameterList(ValueList[ParameterTable, Parameter]):
    """Download of all parameters: requests the list once, then missing indices as soon as a gap appears.

    If the number of parameters changes during the transfer, indices shift: ArduPilot reveals a group of parameters when
    the group is enabled, PX4 counts only the parameters in use. If names and indices then do not match one to one, all
    values received before the change are requested again. Values with index 65535 are not part of the list.

    Raises from ``result()``:
        ParameterTimeout: no progress for ``idle_timeout_s`` seconds; ``missing`` has the missing indices.
    """

    expects: tuple[type[Message], ...] = (ParamValue, ParamError)
    list_request_name = "PARAM_REQUEST_LIST"
    noun = "parameters"

    def __init__(
        self, target_system: int, target_component: int, *, bytewise: bool, **options: Unpack[TransferOptions]
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._bytewise = bytewise
        self._parameters: dict[str, Parameter] = {}  # by name: the parameter with its latest value
        self._refusals: dict[int, int] = {}  # by index: number of PARAM_ERROR messages
        self._count_in_stream: int | None = None  # number of parameters that the stream's last message reported
        self._must_request_missing = False
        self._streamed_count = 0  # number of values received from the stream

    # ---------------------------------------------------------------------------- as an exchange

    def _begin(self, now: float) -> None:
        """Request the list. If the round trip is unknown, also request one value by index to measure it."""
        self._send_list_request(now)
        if self.round_trip.smoothed_s is None:
            self._window.request(0)
        self._proceed(now)

    def receive(self, message: Message, now: float) -> None:
        """Process a value or an error. Other messages, and messages of other components, are ignored."""
        if self.done or not self._is_from_target(message):
            return
        if isinstance(message, ParamValue):
            self._on_value(message, now)
        elif isinstance(message, ParamError):
            self._on_refusal(message)
        else:
            return
        self._proceed(now)

    # ------------------------------------------------------------------------------------ answers

    def _on_value(self, message: ParamValue, now: float) -> None:
        index = message.param_index
        if index == UNKNOWN_INDEX or message.param_id == HASH_NAME:
            self._on_value_without_index(message, now)
            return
        is_streamed = self._is_streaming and index >= self._next_index
        is_requested = index in self._window  # A value that is neither streamed nor requested answers another station.
        self._record_count(message.param_count, is_streamed=is_streamed)
        if is_streamed:
            self._on_streamed_value(index, now)
        else:
            self._window.on_answer(index, now)
        # The answer to a request delays the stream, so it also restarts the stream's time-out. Near the end of the
        # list it does not, so that the last missing values are requested early.
        restarts_timeout = is_streamed or (is_requested and not self._is_near_end)
        if self._is_streaming and restarts_timeout:
            self._stream_deadline = now + self._stream_timeout_s()
        parameter = parameter_of(message, self._bytewise)
        if parameter.name not in self._parameters and len(self._parameters) >= MAX_PARAMETERS:
            return  # A faulty vehicle must not fill the memory.
        self._parameters[parameter.name] = parameter
        self._store(index, parameter, message.param_count, now)

    def _on_value_without_index(self, message: ParamValue, now: float) -> None:
        # The value is not a part of the list. Either a client has set the parameter, or the value is PX4's hash of all
        # parameters, after which the list starts.
        self._record_count(message.param_count, is_streamed=False)
        if message.param_id == HASH_NAME:
            self._last_at = now
            self._stream_deadline = (now + self._stream_timeout_s()) if self._is_streaming else None
        elif message.param_id in self._parameters:
            reported = parameter_of(message, self._bytewise)
            self._parameters[reported.name] = merge_update(self._parameters[reported.name], reported, self._bytewise)

    def _on_refusal(self, message: ParamError) -> None:
        index = message.param_index  # PX4 does not fill in the name.
        is_awaited = index in self._window and index not in self._received
        if message.error != MavParamError.DOES_NOT_EXIST or not is_awaited:
            return
        self._refusals[index] = self._refusals.get(index, 0) + 1
        # A single error does not prove that the list has become shorter: PX4 also sends it if it has no room for the
        # value.
        if self._refusals[index] >= MAX_REFUSALS and self._count is not None:
            for nonexistent in range(index, self._count):
                self._window.discard(nonexistent)
            # The count may now be too low. If a received parameter has a higher index, `_finish_when_complete` requests
            # values again, and each answer has the vehicle's count.
            self._count = min(self._count, index)

    def _record_count(self, count: int, *, is_streamed: bool) -> None:
        # ArduPilot reports the same count throughout a stream, even if the number of parameters changes meanwhile. A
        # streamed count is therefore only compared with an earlier streamed count.
        if is_streamed:
            is_unchanged = count == self._count_in_stream
            self._count_in_stream = count
        else:
            is_unchanged = count == self._count
        if not is_unchanged:
            self._count = count
            self._must_request_missing = True

    def _on_streamed_value(self, index: int, now: float) -> None:
        for missing_index in range(self._next_index, min(index, self._count or 0)):
            self._window.request(missing_index)
        if self._streamed_count:
            self._pause_s = max(now - self._last_at, PAUSE_DECAY * self._pause_s)
        self._next_index = index + 1
        self._streamed_count += 1
        self._last_at = now
        if index == 0:  # `start` may have requested this value to measure the round trip.
            self._window.on_answer(0, now)
        else:
            self._window.discard(index)
        if self._count is not None and self._next_index >= self._count:
            self._end_stream()

    # ----------------------------------------------------------------------------------- requests

    def _list_request(self) -> Message:
        return ParamRequestList(self.target_system, self.target_component)

    def _read_request(self, index: int) -> Message:
        return ParamRequestRead(self.target_system, self.target_component, param_id="", param_index=index)

    def _on_stream_stopped(self, now: float) -> None:
        is_short_list = self._count is not None and self._count <= MIN_STREAMED
        has_started = self._streamed_count >= MIN_STREAMED or is_short_list
        if has_started:
            self._end_stream()
        else:
            self._send_list_request(now)

    def _end_stream(self) -> None:
        self._is_streaming = False
        self._stream_deadline = None
        self._must_request_missing = True

    def _stream_timeout_s(self) -> float:
        """Return after how many seconds without a value the stream counts as stopped."""
        seconds = max(self.round_trip.timeout_s(), TIMEOUT_PAUSES * self._pause_s)
        if self._streamed_count < MIN_STREAMED:  # A single value may be the answer to our request by index.
            return max(seconds, MIN_START_TIMEOUT_S)
        # Near the end, waiting for a further group of values would take longer than requesting the rest.
        return seconds if self._is_near_end else max(seconds, MAX_GROUP_INTERVAL_S)

    @property
    def _is_near_end(self) -> bool:
        return self._count is not None and self._count - self._next_index <= NEAR_END

    def _finish_or_request_missing(self) -> None:
        if self._is_streaming:
            return
        self._finish_when_complete()
        if self._must_request_missing and not self.done:
            self._must_request_missing = False
            for index in self._missing():
                self._window.request(index)

    # ------------------------------------------------------------------------------------- result

    def _finish_when_complete(self) -> None:
        count = self._count
        if count is None or len(self._received) < count:
            return
        parameters = [self._received[index] for index in range(count) if index in self._received]
        if len(parameters) != count:  # The count has decreased, and some received indices are beyond it.
            return
        names = {parameter.name for parameter in parameters}
        is_consistent = len(names) == count == len(self._parameters)  # Each name has exactly one index, and vice versa.
        # If `_drop_stale` drops nothing, nothing can be requested again, and the result stays inconsistent.
        if not is_consistent and self._drop_stale(count):
            self._must_request_missing = True
        else:
            self._finish(ParameterTable(self._in_order(parameters, names)))

    def _in_order(self, parameters: list[Parameter], names: set[str]) -> list[Parameter]:
        """Return each parameter once, with its latest value and in the order of the indices.

        Parameters without an index come last.
        """
        indices: dict[str, int | None] = {}
        for index, parameter in enumerate(parameters):
            indices.setdefault(parameter.name, index)
        if self._refreshes == 0:  # If the list has changed, the names without an index may no longer exist.
            indices.update(dict.fromkeys(name for name in self._parameters if name not in names))
        latest = self._parameters
        return [Parameter(name, latest[name].value, latest[name].type, index=index) for name, index in indices.items()]
