"""What reading and writing parameters by name have in common: many at once, one result each.

https://mavlink.io/en/services/parameter.html

https://mavlink.io/en/services/parameter.html#read_single

https://mavlink.io/en/services/parameter.html#write
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.mavlink.enums import MavParamError
from aerokit.mavlink.messages import ParamError, ParamRequestRead, ParamValue
from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.encoding import parameter_of, set_message
from aerokit.parameters.parameter import same_value
from aerokit.protocols.exchange import EarlyAnswers
from aerokit.protocols.named_values import (
    BY_NAME,
    PROBE,
    PROBE_INDEX,
    NamedReads,
    NamedRequests,
    OtherAnswers,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import TransferOptions

__all__ = ["Answer", "ParameterReads", "ParameterRequests", "ParameterWrites", "rejection"]

Answer = Parameter | ParameterRejected | ParameterTimeout
"""What came of one request: what the vehicle says the parameter is, or why there is nothing to say."""

ERRORS = {
    1: "the vehicle has no such parameter",
    2: "the vehicle does not accept this value",
    3: "the vehicle does not permit it",
    4: "the vehicle has no such component",
    5: "it is read-only",
    6: "the vehicle has no parameters of this type",
    7: "it is of another type",
    8: "the vehicle could not read it",
}


class ParameterRequests(NamedRequests[Parameter]):
    """Requests of PARAM; see the base."""

    expects: tuple[type[Message], ...] = (ParamValue, ParamError)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        names: Iterable[str],
        *,
        bytewise: bool,
        window: int,
        doubles_last: bool = True,
        own_system: int = 0,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(
            target_system, target_component, names, window=window, doubles_last=doubles_last, **options
        )
        self._bytewise, self._own_system = bytewise, own_system

    def _hear(self, message: Message, now: float) -> None:
        if isinstance(message, ParamValue):
            self._take(message, now)
        elif isinstance(message, ParamError) and message.target_system in (0, self._own_system):
            self._take_error(message, now)

    @abstractmethod
    def _take(self, message: ParamValue, now: float) -> None:
        """A value has come."""

    def _take_error(self, message: ParamError, now: float) -> None:
        name = message.param_id  # PX4 fills what it does not use with anything: only the name counts
        if name in self._names and name in self._window:
            self._window.answered(name, now)
            self._settle(name, rejection(name, message.error), now)


def rejection(name: str, code: int) -> ParameterRejected:
    """The exception that stands for a PARAM_ERROR (https://mavlink.io/en/messages/common.html#PARAM_ERROR)."""
    reason = ERRORS.get(code, f"MAV_PARAM_ERROR {code}")
    return ParameterRejected(f"{name} was refused: {reason}", name=name, code=code)


READS_AT_ONCE = 20


class ParameterReads(ParameterRequests, NamedReads[Parameter]):
    """Read some parameters by name; ends with one answer for each.

    ArduPilot, and PX4 until 1.16, meet an unknown name with silence. So names that ``are_doubtful`` are asked for
    together with the parameter of index 0, and when that one comes time and again, the vehicle has none of the name
    that does not: the answer is a ParameterRejected without a code.

    Of a name and its ``rivals`` the vehicle has one at most: the others are rejected when that one has come.
    An answer that tells a ``distrusted`` value may have been under way for long: it is believed the second time.
    """

    whose = "the vehicle has no parameter"

    def __init__(
        self,
        target_system: int,
        target_component: int,
        names: Iterable[str],
        *,
        bytewise: bool,
        are_doubtful: bool = False,
        distrusted: Mapping[str, float] = MappingProxyType({}),
        rivals: Mapping[str, Iterable[str]] = MappingProxyType({}),
        own_system: int = 0,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(
            target_system,
            target_component,
            names,
            bytewise=bytewise,
            window=READS_AT_ONCE,
            doubles_last=not are_doubtful,
            own_system=own_system,
            **options,
        )
        self._are_doubtful = self._is_probe_wanted = are_doubtful
        self._distrusted = dict(distrusted)
        self._refused: set[str] = set()
        self._rivals = {name: tuple(others) for name, others in rivals.items()}

    def _read_request(self, name: str, index: int) -> Message:
        return ParamRequestRead(self.target_system, self.target_component, name, index)

    def _before_sending(self, now: float) -> None:
        if self._are_doubtful and (overdue := self._overdue(now)):
            self._give_up_unknown(overdue, now)
            self._is_probe_wanted = True

    def _take(self, message: ParamValue, now: float) -> None:
        if message.param_index == PROBE_INDEX and self._window.attempts(PROBE):
            self._count_probe()
            passed_over = self._window.answered(PROBE, now, overtaken=1)
            self._give_up_unknown(passed_over, now)
            self._is_probe_wanted |= bool(passed_over)
        name = message.param_id
        if name and name in self._window:
            self._window.answered(name, now)
            told = parameter_of(message, self._bytewise)
            old = self._distrusted.pop(name, None)
            if old is not None and same_value(old, told.value):
                self._window.ask(name)
            else:
                self._settle(name, told, now)
                self._reject_rivals(name, now)

    def _reject_rivals(self, name: str, now: float) -> None:
        for other in self._rivals.get(name, ()):
            if other in self._names and other not in self._answers:
                text = f"the vehicle has no parameter {other}, it has {name}"
                self._settle(other, ParameterRejected(text, name=other), now)

    def _take_error(self, message: ParamError, now: float) -> None:
        """PX4 says that there is no such parameter also when it has no room to send it: once more, then."""
        name = message.param_id
        is_first = name in self._names and name in self._window and name not in self._refused
        if is_first and message.error == MavParamError.DOES_NOT_EXIST:
            self._refused.add(name)
            self._window.answered(name, now)
            self._window.ask(name)
        else:
            super()._take_error(message, now)


WRITES_AT_ONCE = 10
"""ArduPilot saves through a queue of 30, which it must not overflow while it is armed."""


class ParameterWrites(ParameterRequests):
    """Set some parameters; ends with what the vehicle says each of them is then.

    The answer that tells value and type as asked for ends a write. When none comes the vehicle is asked what it has: a
    PARAM_SET is never sent into a silence. Only an answer with the value from ``before`` (the one known so far) has it
    set again; any other value is the vehicle's own (it rounds or clamps) or another station's, and is the answer
    when it comes twice. So nothing is sent for ever, and nobody's later setting is undone.

    ``recent`` are names that were written a moment ago: echoes of that write
    may still come, so that the first answer as asked is read back.
    """

    def __init__(
        self,
        target_system: int,
        target_component: int,
        wanted: Iterable[Parameter],
        *,
        bytewise: bool,
        before: Mapping[str, float] = MappingProxyType({}),
        recent: Iterable[str] = (),
        own_system: int = 0,
        **options: Unpack[TransferOptions],
    ) -> None:
        self._wanted = {each.name: each for each in wanted}
        super().__init__(
            target_system,
            target_component,
            self._wanted,
            bytewise=bytewise,
            window=WRITES_AT_ONCE,
            own_system=own_system,
            **options,
        )
        self._before = dict(before)
        self._recent = set(recent)
        self._to_set = set(self._wanted)
        """Those that may be set with the next request."""
        self._others: dict[str, OtherAnswers[Parameter]] = {}
        self._early = EarlyAnswers(self.round_trip)

    def _request(self, name: str) -> list[Message]:
        wanted, others = self._wanted[name], self._others.get(name)
        read = ParamRequestRead(self.target_system, self.target_component, name, BY_NAME)
        if name not in self._to_set:
            return [read]
        self._to_set.remove(name)
        write = set_message(
            self.target_system, self.target_component, name, wanted.value, wanted.type, self._bytewise
        )
        return [write, read] if others else [write]

    def _take(self, message: ParamValue, now: float) -> None:
        name = message.param_id
        if not self._window.attempts(name):
            return  # it has not been sent yet
        wanted = self._wanted[name]
        told = self._typed(parameter_of(message, self._bytewise), wanted.type)
        others = self._others.setdefault(name, OtherAnswers(_is_same))
        is_as_asked = same_value(told.value, wanted.value)
        if is_as_asked and name in self._recent:
            self._recent.remove(name)
            others.add(told)
            self._window.answered(name, now)
            self._window.ask(name)
            return
        if is_as_asked and (told.type == wanted.type or others.ends_with(told)):
            self._window.answered(name, now)
            self._settle(name, told, now)
            return
        if self._is_too_early(name, now):
            return
        others.add(told)
        self._window.answered(name, now)
        is_no_change = same_value(told.value, self._before.get(name, told.value))
        if is_no_change and not is_as_asked:
            self._to_set.add(name)
        if others.are_verdict(is_no_change=is_no_change):
            self._settle(name, told, now)
        else:
            self._window.ask(name)

    def _is_too_early(self, name: str, now: float) -> bool:
        """Whether this can be no answer to what was sent last: it is a late or repeated one to something before."""
        sent_at = self._sent_at.get(name, now)
        return self._early.is_one(name, sent_at, now, attempts=self._window.attempts(name))

    def _typed(self, told: Parameter, type_: ParameterType) -> Parameter:
        """ArduPilot calls an integer that holds its default a float, in answers to PARAM_SET alone."""
        is_whole = told.type is ParameterType.REAL32 and told.value == told.value // 1
        if self._bytewise or not type_.is_integer or not is_whole:
            return told
        return Parameter(told.name, int(told.value), type_, None, told.index)

    def _timeout_text(self, name: str) -> str:
        return f"PARAM_SET of {name} was not confirmed, sent {self._window.attempts(name)} times"


def _is_same(one: Parameter, other: Parameter) -> bool:
    return same_value(one.value, other.value) and one.type == other.type
