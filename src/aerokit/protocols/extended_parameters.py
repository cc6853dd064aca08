"""Settings of a component by PARAM_EXT: the whole list, some by name, and one written.

https://mavlink.io/en/services/parameter_ext.html
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.mavlink.enums import ParamAck
from aerokit.mavlink.messages import (
    ParamExtAck,
    ParamExtRequestList,
    ParamExtRequestRead,
    ParamExtSet,
    ParamExtValue,
)
from aerokit.parameters.parameter import MOST_PARAMETERS
from aerokit.parameters.setting import Setting, setting_bytes, setting_value, settings_equal
from aerokit.protocols.exchange import PATIENCE_S, EarlyAnswers, Transfer
from aerokit.protocols.named_values import (
    BY_NAME,
    PAUSES,
    PROBE,
    PROBE_INDEX,
    SHORTEST_START_S,
    NamedReads,
    OtherAnswers,
    ValueList,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.parameters.setting import SettingValue
    from aerokit.protocols.exchange import RoundTrip, TransferOptions

__all__ = ["SettingAnswer", "SettingList", "SettingReads", "SettingWrite", "setting_of"]

SettingAnswer = Setting | ParameterRejected | ParameterTimeout
"""What came of one request: what the component says the setting is, or why there is nothing to say."""

UNKNOWN_INDEX = 0xFFFF
LONGEST_QUIET_S = 1.1
READS_AT_ONCE = 10
PROGRESS_S = 5.0
"""How long PARAM_ACK_IN_PROGRESS is worth waiting without a word before the component is asked what it has."""
REFUSALS = {
    ParamAck.VALUE_UNSUPPORTED: "the component has no such setting, or does not accept this value",
    ParamAck.FAILED: "the component could not set it",
}


def setting_of(message: ParamExtValue | ParamExtAck) -> Setting:
    """What a message tells; PARAM_EXT_ACK has no index."""
    index = message.param_index if isinstance(message, ParamExtValue) else UNKNOWN_INDEX
    value = setting_value(message.param_value, message.param_type)
    return Setting(message.param_id, value, message.param_type, None if index == UNKNOWN_INDEX else index)


class SettingList(ValueList[dict[str, Setting], Setting]):
    """Ask for the whole list once; a hole in the stream of answers is asked for by its index at once, in a window.

    When the component says that there is another number of settings than before, what came before that is asked for
    again. One that has none says nothing, and so ends in a time-out.

    Raises from ``result()``:
        ParameterTimeout: nothing new for ``patience_s`` seconds; ``missing`` are the indices that did not come.
    """

    expects: tuple[type[Message], ...] = (ParamExtValue,)
    asked_by = "PARAM_EXT_REQUEST_LIST"
    noun = "settings"
    window_size = READS_AT_ONCE

    def start(self, now: float) -> None:
        """Ask for the list."""
        self._begin(now)
        self._ask_for_list(now)
        self._step(now)

    def receive(self, message: Message, now: float) -> None:
        """Take one value of the list; others are ignored, as are those of other components."""
        if self.done or not isinstance(message, ParamExtValue) or not self._is_from_target(message):
            return
        count, index = min(message.param_count, MOST_PARAMETERS), message.param_index
        if index < count:
            self._count = count
            self._take(setting_of(message), index, count, now)
        self._step(now)

    def _list_request(self) -> Message:
        return ParamExtRequestList(self.target_system, self.target_component)

    def _read_request(self, index: int) -> Message:
        return ParamExtRequestRead(self.target_system, self.target_component, "", index)

    def _on_quiet(self, now: float) -> None:
        if self._count is None:
            self._ask_for_list(now)
        else:
            self._end_stream()

    def _take(self, setting: Setting, index: int, count: int, now: float) -> None:
        if self._is_streaming and index >= self._next:
            for hole in range(self._next, index):
                self._window.ask(hole)
            if self._next:
                self._pause_s = max(self._pause_s, now - self._last_at)
            self._next, self._last_at = index + 1, now
            quiet_s = max(self.round_trip.timeout_s(), PAUSES * self._pause_s, SHORTEST_START_S)
            self._quiet_at = now + min(quiet_s, LONGEST_QUIET_S)
            self._window.forget(index)
        else:
            self._window.answered(index, now)
        self._keep(index, setting, count, now)
        if self._next >= count:
            self._end_stream()

    def _end_stream(self) -> None:
        self._is_streaming, self._quiet_at = False, None
        for index in self._missing():
            self._window.ask(index)

    def _conclude(self) -> None:
        if self._is_streaming or self._count is None:
            return
        if len(self._told) >= self._count and not self._missing():
            stale = self._drop_stale(self._count)
            for index in stale:
                self._window.ask(index)
            if not stale:
                settings = (self._told[index][0] for index in range(self._count))
                self._finish({setting.name: setting for setting in settings})
        elif not len(self._window):  # there are more than there were
            self._end_stream()


class SettingReads(NamedReads[Setting]):
    """Read some settings by name; ends with one answer for each, in the order given.

    A component meets an unknown name with silence. So the setting of index 0 is asked for beside what is overdue, and
    when that one comes time and again, the component has none of the name that does not: a ParameterRejected.
    Where nothing new comes for ``patience_s`` seconds, what is missing becomes a ParameterTimeout.
    """

    expects: tuple[type[Message], ...] = (ParamExtValue,)
    whose = "the component has no setting"

    def __init__(
        self,
        target_system: int,
        target_component: int,
        names: Iterable[str],
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(
            target_system,
            target_component,
            names,
            window=READS_AT_ONCE,
            doubles_last=False,
            **options,
        )

    def _read_request(self, name: str, index: int) -> Message:
        return ParamExtRequestRead(self.target_system, self.target_component, name, index)

    def _before_sending(self, now: float) -> None:
        self._is_probe_wanted = bool(self._overdue(now))

    def _hear(self, message: Message, now: float) -> None:
        if not isinstance(message, ParamExtValue):
            return
        name = message.param_id
        if message.param_index == PROBE_INDEX and self._window.attempts(PROBE):
            self._count_probe()
            self._window.answered(PROBE, now)
            waiting = [each for each in self._names if each not in self._answers]
            self._give_up_unknown([each for each in waiting if each != name], now)
        if name and name in self._window:
            self._window.answered(name, now)
            self._settle(name, setting_of(message), now)


class SettingWrite(Transfer[Setting]):
    """Set one setting; ends with what the component says it is then.

    PARAM_EXT_ACK with the value as asked for ends it, and so does a refusal. IN_PROGRESS is waited for. When no answer
    comes the component is asked what it has: a PARAM_EXT_SET is never sent into a silence. Only an answer with the
    value from ``before`` has it set again; any other value is the component's own (it rounds or clamps) or another
    station's, and is the answer when it comes twice. So nothing is sent for ever, and nobody's later setting is undone.

    Raises from ``result()``:
        ParameterRejected: it was refused (``code`` is the PARAM_ACK), or the component keeps the value from before.
        ParameterTimeout: nothing came for ``patience_s`` seconds. It may have been set all the same.
    """

    expects: tuple[type[Message], ...] = (ParamExtAck, ParamExtValue)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        name: str,
        value: SettingValue,
        type: int,  # noqa: A002 - the standard's word
        *,
        before: SettingValue | None,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        super().__init__(target_system, target_component, round_trip=round_trip, patience_s=patience_s)
        self._name, self._value, self._type, self._before = name, value, type, before
        self._others: OtherAnswers[Setting] = OtherAnswers(_is_same)
        self._early = EarlyAnswers(self.round_trip)
        self._is_writing = False
        self._sent_at = 0.0
        self._attempts = 0
        """Of the same question without an answer."""
        self._writes = 0

    def start(self, now: float) -> None:
        """Set it."""
        self._begin(now)
        self._write(now)

    def receive(self, message: Message, now: float) -> None:
        """Take an answer; what is about another setting is ignored, as are other components."""
        if self.done or not self._is_from_target(message):
            return
        if not isinstance(message, (ParamExtAck, ParamExtValue)) or message.param_id != self._name:
            return
        told = setting_of(message)
        if isinstance(message, ParamExtAck):
            self._take_ack(message.param_result, told, now)
        elif settings_equal(told.value, self._value):
            self._measure(now)
            self._finish(told)
        elif not self._is_writing and not self._is_too_early(now):
            self._measure(now)
            self._take_other(told, now)

    def expire(self, now: float) -> None:
        """No answer: ask what it has."""
        if self.deadline is None or now < self.deadline:
            return
        if self._is_out_of_patience(now):
            text = f"PARAM_EXT_SET of {self._name} was not confirmed, sent {self._writes} times"
            self._fail(ParameterTimeout(text, missing=(self._name,)))
        else:
            self._read(now)

    def _take_ack(self, result: int, told: Setting, now: float) -> None:
        if result == ParamAck.ACCEPTED and settings_equal(told.value, self._value):
            self._measure(now)
            self._finish(told)
        elif self._is_too_early(now):
            return  # somebody else's
        elif result == ParamAck.IN_PROGRESS:
            self._moved_at = now
            self._is_writing = True
            self.deadline = now + min(PROGRESS_S, self._patience_s)
        elif result == ParamAck.ACCEPTED:
            self._read(now)  # with another value: perhaps its own, perhaps another station's
        else:
            reason = REFUSALS.get(result, f"PARAM_ACK {result}")  # type: ignore[call-overload]
            self._fail(ParameterRejected(f"{self._name} was refused: {reason}", name=self._name, code=result))

    def _take_other(self, told: Setting, now: float) -> None:
        self._others.add(told)
        is_no_change = self._before is not None and settings_equal(told.value, self._before)
        if not self._others.are_verdict(is_no_change=is_no_change):
            if is_no_change:
                self._write(now)
            else:
                self._read(now)
        elif is_no_change:
            text = f"{self._name} was refused: the component keeps {told.value!r}"
            self._fail(ParameterRejected(text, name=self._name))
        else:
            self._finish(told)

    def _write(self, now: float) -> None:
        self._writes += 1
        value = setting_bytes(self._value, self._type)
        target = self.target_system, self.target_component
        self._outbox.append(ParamExtSet(*target, self._name, value, self._type))
        self._attempts = 1
        self._wait(now, is_writing=True)

    def _read(self, now: float) -> None:
        self._attempts = 1 if self._is_writing else self._attempts + 1
        self._outbox.append(
            ParamExtRequestRead(self.target_system, self.target_component, self._name, BY_NAME)
        )
        self._wait(now, is_writing=False)

    def _wait(self, now: float, *, is_writing: bool) -> None:
        self._is_writing, self._sent_at = is_writing, now
        self.deadline: float | None = min(
            now + self.round_trip.timeout_s(self._attempts), self._moved_at + self._patience_s
        )

    def _measure(self, now: float) -> None:
        if self._attempts == 1:
            self.round_trip.measured(now - self._sent_at)

    def _is_too_early(self, now: float) -> bool:
        """Whether this can be no answer to what was sent last: it is a late or repeated one to something before."""
        return self._early.is_one(self._name, self._sent_at, now, attempts=self._attempts)


def _is_same(one: Setting, other: Setting) -> bool:
    return settings_equal(one.value, other.value)
