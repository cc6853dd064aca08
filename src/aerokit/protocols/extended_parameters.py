"""Component settings by PARAM_EXT (https://mavlink.io/en/services/parameter_ext.html)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.mavlink.enums import ParamAck
from aerokit.mavlink.messages import ParamExtAck, ParamExtRequestList, ParamExtRequestRead, ParamExtSet, ParamExtValue
from aerokit.parameters.parameter import MAX_PARAMETERS, Setting, setting_bytes, setting_value, settings_equal
from aerokit.protocols.exchange import StaleAnswerFilter, Transfer
from aerokit.protocols.named_values import (
    BY_NAME,
    MIN_START_TIMEOUT_S,
    PROBE,
    TIMEOUT_PAUSES,
    NamedReads,
    RepeatedAnswers,
    ValueList,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.parameters.parameter import SettingValue
    from aerokit.protocols.exchange import TransferOptions

__all__ = ["SettingAnswer", "SettingList", "SettingReads", "SettingWrite", "setting_of"]

SettingAnswer = Setting | ParameterRejected | ParameterTimeout
"""Answer to one request: the setting as the component reports it, or the error."""

UNKNOWN_INDEX = 0xFFFF
MAX_STREAM_TIMEOUT_S = 1.1  # A list counts as ended after at most this many seconds of silence.
READ_WINDOW = 10
# Seconds to wait after PARAM_ACK_IN_PROGRESS before the value is requested.
PROGRESS_TIMEOUT_S = 5.0
REFUSALS = {
    ParamAck.VALUE_UNSUPPORTED: "the component has no such setting, or does not accept this value",
    ParamAck.FAILED: "the component could not set it",
}


def setting_of(message: ParamExtValue | ParamExtAck) -> Setting:
    """Convert a PARAM_EXT_VALUE or PARAM_EXT_ACK to a setting. PARAM_EXT_ACK has no index."""
    index = message.param_index if isinstance(message, ParamExtValue) else UNKNOWN_INDEX
    value = setting_value(message.param_value, message.param_type)
    return Setting(message.param_id, value, message.param_type, None if index == UNKNOWN_INDEX else index)


class SettingList(ValueList[dict[str, Setting], Setting]):
    """Download of all settings: requests the list once, then missing indices as soon as a gap appears.

    If the component reports another number of settings than before, earlier values are requested again.
    A component without settings does not answer, so the transfer times out.

    Raises from ``result()``:
        ParameterTimeout: no progress for ``idle_timeout_s`` seconds; ``missing`` has the missing indices.
    """

    expects: tuple[type[Message], ...] = (ParamExtValue,)
    list_request_name = "PARAM_EXT_REQUEST_LIST"
    noun = "settings"
    window_size = READ_WINDOW

    def _begin(self, now: float) -> None:
        self._send_list_request(now)
        self._proceed(now)

    def receive(self, message: Message, now: float) -> None:
        """Process a value. Other messages, and messages of other components, are ignored."""
        if self.done or not isinstance(message, ParamExtValue) or not self._is_from_target(message):
            return
        count = min(message.param_count, MAX_PARAMETERS)
        index = message.param_index
        if index < count:
            self._count = count
            self._on_value(setting_of(message), index, count, now)
        self._proceed(now)

    def _list_request(self) -> Message:
        return ParamExtRequestList(self.target_system, self.target_component)

    def _read_request(self, index: int) -> Message:
        return ParamExtRequestRead(self.target_system, self.target_component, param_id="", param_index=index)

    def _on_stream_stopped(self, now: float) -> None:
        if self._count is None:
            self._send_list_request(now)
        else:
            self._end_stream()

    def _on_value(self, setting: Setting, index: int, count: int, now: float) -> None:
        is_streamed = self._is_streaming and index >= self._next_index
        if is_streamed:
            for missing_index in range(self._next_index, index):
                self._window.request(missing_index)
            if self._next_index:  # The time before the first value is not a pause of the stream.
                self._pause_s = max(self._pause_s, now - self._last_at)
            self._next_index = index + 1
            self._last_at = now
            timeout_s = max(self.round_trip.timeout_s(), TIMEOUT_PAUSES * self._pause_s, MIN_START_TIMEOUT_S)
            self._stream_deadline = now + min(timeout_s, MAX_STREAM_TIMEOUT_S)
            self._window.discard(index)  # Only values that were requested one by one measure the round trip.
        else:
            self._window.on_answer(index, now)
        self._store(index, setting, count, now)
        if self._is_streaming and self._next_index >= count:
            self._end_stream()

    def _end_stream(self) -> None:
        self._is_streaming = False
        self._stream_deadline = None
        self._request_missing()

    def _request_missing(self) -> None:
        for index in self._missing():
            self._window.request(index)

    def _finish_or_request_missing(self) -> None:
        if self._is_streaming or self._count is None:
            return
        if len(self._received) >= self._count and not self._missing():
            stale = self._drop_stale(self._count)
            for index in stale:
                self._window.request(index)
            if not stale:
                settings = (self._received[index] for index in range(self._count))
                self._finish({setting.name: setting for setting in settings})
        elif len(self._window) == 0:  # Nothing is requested, but values are missing: the count has increased.
            self._request_missing()


class SettingReads(NamedReads[Setting]):
    """Read some settings by name. The result has one answer for each name, in the order given.

    Components do not answer requests for unknown names. After a time-out for a name, the setting with index 0, which
    always exists, is therefore requested as well. If the component sends that setting but repeatedly ignores the name,
    the result for the name is a ParameterRejected. After ``idle_timeout_s`` seconds without progress, the missing
    answers become ParameterTimeout errors.
    """

    expects: tuple[type[Message], ...] = (ParamExtValue,)
    unknown_text = "the component has no setting"
    window_size = READ_WINDOW
    _may_probe = True

    def _read_request(self, name: str, index: int) -> Message:
        return ParamExtRequestRead(self.target_system, self.target_component, name, index)

    def _process_overdue(self, now: float) -> None:
        self._is_probe_wanted = bool(self._overdue(now))

    def _on_message(self, message: Message, now: float) -> None:
        if not isinstance(message, ParamExtValue):
            return
        name = message.param_id
        if self._is_probe_answer(message.param_index, now):
            self._count_probe_answer()
            self._window.on_answer(PROBE, now)
            # The component answers requests for index 0, so it may not know the names that it has not answered.
            unanswered = [other for other in self._names if other not in self._results and other != name]
            self._reject_if_requested_often(unanswered, now)
        if name and name in self._window:
            self._window.on_answer(name, now)
            self._set_result(name, setting_of(message), now)


class SettingWrite(Transfer[Setting]):
    """Set one setting. The result is the setting as the component reports it afterwards.

    A PARAM_EXT_ACK with the requested value, or a refusal, completes the write. IN_PROGRESS extends the wait. If no
    answer arrives, the value is read. The next step depends on the value that the component reports:

    - The requested value: the write is complete.
    - The old value (``before``): PARAM_EXT_SET is sent again, because it may have been lost. The write fails if the
      component keeps the old value.
    - Another value: the value is read again. PARAM_EXT_SET is not sent again, because it would undo the change if
      another station has set the value. A value reported twice in a row is the result.

    Raises from ``result()``:
        ParameterRejected: the component refused (``code`` is the PARAM_ACK), or keeps the previous value.
        ParameterTimeout: no answer for ``idle_timeout_s`` seconds. The setting may still have been changed.
    """

    expects: tuple[type[Message], ...] = (ParamExtAck, ParamExtValue)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        name: str,
        value: SettingValue,
        type: int,  # noqa: A002 - the name of the field in the standard
        *,
        before: SettingValue | None,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._name = name
        self._value, self._type = value, type
        self._old_value = before
        self._repeated_answers: RepeatedAnswers[Setting] = RepeatedAnswers(_is_same)
        self._stale_answers = StaleAnswerFilter(self.round_trip)
        self._is_writing = False
        self._sent_at = 0.0
        self._attempts = 0  # number of transmissions of the current request
        self._writes = 0  # number of PARAM_EXT_SET messages sent

    def _begin(self, now: float) -> None:
        self._write(now)

    def receive(self, message: Message, now: float) -> None:
        """Process an answer. Messages about other settings, and messages of other components, are ignored."""
        if self.done or not self._is_from_target(message):
            return
        if not isinstance(message, (ParamExtAck, ParamExtValue)) or message.param_id != self._name:
            return
        reported = setting_of(message)
        if isinstance(message, ParamExtAck):
            self._on_ack(message.param_result, reported, now)
        elif settings_equal(reported.value, self._value):
            self._measure(now)
            self._finish(reported)
        # While it writes, the component may report the old value.
        elif not self._is_writing and not self._is_stale(now):
            self._measure(now)
            self._on_unexpected_value(reported, now)

    def expire(self, now: float) -> None:
        if self.deadline is None or now < self.deadline:
            return
        if self._is_idle(now):
            text = f"PARAM_EXT_SET of {self._name} was not confirmed, sent {self._writes} times"
            self._fail(ParameterTimeout(text, missing=(self._name,)))
        else:
            self._read(now)

    def _on_ack(self, result: int, reported: Setting, now: float) -> None:
        if result == ParamAck.ACCEPTED and settings_equal(reported.value, self._value):
            self._measure(now)
            self._finish(reported)
        elif self._is_stale(now):
            return  # The answer arrived too soon for our request, so it answers another station.
        elif result == ParamAck.IN_PROGRESS:
            self._progress_at = now
            self._is_writing = True
            self.deadline: float | None = now + min(PROGRESS_TIMEOUT_S, self._idle_timeout_s)
        elif result == ParamAck.ACCEPTED:
            # The accepted value differs from ours: the component adjusted it, or another station set it meanwhile.
            self._read(now)
        else:
            reason = REFUSALS.get(result, f"PARAM_ACK {result}")  # type: ignore[call-overload]
            self._fail(ParameterRejected(f"{self._name} was refused: {reason}", name=self._name, code=result))

    def _on_unexpected_value(self, reported: Setting, now: float) -> None:
        """Write or read again, or end the write after enough equal answers."""
        self._repeated_answers.add(reported)
        is_unchanged = self._old_value is not None and settings_equal(reported.value, self._old_value)
        if not self._repeated_answers.are_conclusive(is_unchanged=is_unchanged):
            if is_unchanged:
                self._write(now)
            else:
                self._read(now)
        elif is_unchanged:
            text = f"{self._name} was refused: the component keeps {reported.value!r}"
            self._fail(ParameterRejected(text, name=self._name))
        else:
            self._finish(reported)

    def _write(self, now: float) -> None:
        self._writes += 1
        value = setting_bytes(self._value, self._type)
        self._outbox.append(
            ParamExtSet(self.target_system, self.target_component, self._name, value, param_type=self._type)
        )
        self._attempts = 1
        self._wait(now, is_writing=True)

    def _read(self, now: float) -> None:
        self._attempts = 1 if self._is_writing else self._attempts + 1
        self._outbox.append(ParamExtRequestRead(self.target_system, self.target_component, self._name, BY_NAME))
        self._wait(now, is_writing=False)

    def _wait(self, now: float, *, is_writing: bool) -> None:
        self._is_writing = is_writing
        self._sent_at = now
        self._wait_until(now + self.round_trip.timeout_s(self._attempts))

    def _measure(self, now: float) -> None:
        if self._attempts == 1:
            self.round_trip.add_sample(now - self._sent_at)

    def _is_stale(self, now: float) -> bool:
        return self._stale_answers.is_stale(self._name, self._sent_at, now, may_measure=self._attempts == 1)


def _is_same(first: Setting, second: Setting) -> bool:
    return settings_equal(first.value, second.value)
