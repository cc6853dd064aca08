"""Reading and writing parameters by name, many at once.

See https://mavlink.io/en/services/parameter.html#read_single and https://mavlink.io/en/services/parameter.html#write.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.mavlink.enums import MavParamError
from aerokit.mavlink.messages import ParamError, ParamRequestRead, ParamValue
from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.encoding import parameter_of, set_message
from aerokit.parameters.parameter import same_value
from aerokit.protocols.named_values import BY_NAME, PROBE, NamedReads, NamedRequests, RepeatedAnswers

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import TransferOptions

__all__ = ["ParameterAnswer", "ParameterReads", "ParameterRequests", "ParameterWrites", "rejection"]

ParameterAnswer = Parameter | ParameterRejected | ParameterTimeout
"""Answer to one request: the parameter as the vehicle reports it, or the error."""

ERRORS = {
    1: "the vehicle has no such parameter",
    2: "the vehicle does not accept this value",
    3: "the vehicle does not permit access",
    4: "the vehicle has no such component",
    5: "the parameter is read-only",
    6: "the vehicle has no parameters of this type",
    7: "the parameter has another type",
    8: "the vehicle could not read the value",
}


class ParameterRequests(NamedRequests[Parameter]):
    """Base class of the PARAM requests."""

    expects: tuple[type[Message], ...] = (ParamValue, ParamError)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        names: Iterable[str],
        *,
        bytewise: bool,
        own_system: int = 0,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(target_system, target_component, names, **options)
        self._bytewise, self._own_system = bytewise, own_system

    def _on_message(self, message: Message, now: float) -> None:
        if isinstance(message, ParamValue):
            self._on_value(message, now)
        elif isinstance(message, ParamError) and message.target_system in (0, self._own_system):
            self._on_error(message, now)

    @abstractmethod
    def _on_value(self, message: ParamValue, now: float) -> None: ...

    def _request_again(self, name: str, now: float) -> None:
        self._window.on_answer(name, now)
        self._window.request(name)

    def _on_error(self, message: ParamError, now: float) -> None:
        name = message.param_id  # The index and the target ids are not used, because PX4 does not initialise them.
        if name in self._names and name in self._window:
            self._window.on_answer(name, now)
            self._set_result(name, rejection(name, message.error), now)


def rejection(name: str, code: int) -> ParameterRejected:
    """Create the exception for a PARAM_ERROR (https://mavlink.io/en/messages/common.html#PARAM_ERROR)."""
    reason = ERRORS.get(code, f"MAV_PARAM_ERROR {code}")
    return ParameterRejected(f"{name} was refused: {reason}", name=name, code=code)


class ParameterReads(ParameterRequests, NamedReads[Parameter]):
    """Read some parameters by name. The result has one answer for each name.

    Args:
        probe: True to detect unknown names, which ArduPilot, and PX4 before 1.17, do not answer. The parameter with
            index 0 is then requested too. If the vehicle answers this request but none for a name, the result for that
            name is a ParameterRejected without a code.
        possibly_stale: maps a name to its old value, which a delayed message may still report. If an answer has this
            value, the parameter is read once more.
        alternatives: maps a name to other names of the same parameter. Once one name is answered, the results for the
            others are ParameterRejected errors.
    """

    unknown_text = "the vehicle has no parameter"
    window_size = 20

    def __init__(
        self,
        target_system: int,
        target_component: int,
        names: Iterable[str],
        *,
        bytewise: bool,
        probe: bool = False,
        possibly_stale: Mapping[str, float] = MappingProxyType({}),
        alternatives: Mapping[str, Iterable[str]] = MappingProxyType({}),
        own_system: int = 0,
        **options: Unpack[TransferOptions],
    ) -> None:
        self._may_probe = probe
        super().__init__(target_system, target_component, names, bytewise=bytewise, own_system=own_system, **options)
        self._is_probe_wanted = probe
        self._possibly_stale = dict(possibly_stale)
        self._refused_once: set[str] = set()
        self._alternatives = {name: tuple(other_names) for name, other_names in alternatives.items()}

    def _read_request(self, name: str, index: int) -> Message:
        return ParamRequestRead(self.target_system, self.target_component, name, index)

    def _process_overdue(self, now: float) -> None:
        overdue = self._overdue(now) if self._may_probe else []
        if overdue:
            self._reject_if_requested_often(overdue, now)
            self._is_probe_wanted = True

    def _on_value(self, message: ParamValue, now: float) -> None:
        # The probe requests index 0, which every vehicle has. An answer to another station also counts. This does no
        # harm, because a name is rejected only after several probes (see `_loss_probability`).
        if self._is_probe_answer(message.param_index, now):
            self._on_probe_answer(now)
        name = message.param_id
        if name and name in self._window:
            reported = parameter_of(message, self._bytewise)
            old_value = self._possibly_stale.pop(name, None)
            if old_value is not None and same_value(old_value, reported.value):
                self._request_again(name, now)  # A delayed message may contain the old value.
            else:
                self._window.on_answer(name, now)
                self._set_result(name, reported, now)
                self._reject_alternatives(name, now)

    def _on_probe_answer(self, now: float) -> None:
        self._count_probe_answer()
        unanswered = self._window.on_answer(PROBE, now, loss_threshold=1)  # all names requested before the probe
        if unanswered:
            self._reject_if_requested_often(unanswered, now)
            self._is_probe_wanted = True

    def _reject_alternatives(self, name: str, now: float) -> None:
        for alternative in self._alternatives.get(name, ()):
            if alternative in self._names and alternative not in self._results:
                text = f"the vehicle has no parameter {alternative}; its name on this vehicle is {name}"
                self._set_result(alternative, ParameterRejected(text, name=alternative), now)

    def _on_error(self, message: ParamError, now: float) -> None:
        # PX4 also answers DOES_NOT_EXIST if it has no room to send the value. The request is therefore repeated once.
        name = message.param_id
        is_first = name in self._names and name in self._window and name not in self._refused_once
        if is_first and message.error == MavParamError.DOES_NOT_EXIST:
            self._refused_once.add(name)
            self._request_again(name, now)
        else:
            super()._on_error(message, now)


# Seconds after the first PARAM_SET in which old values may still arrive, as late answers to earlier requests.
LATE_ANSWERS_S = 1.5


class ParameterWrites(ParameterRequests):
    """Set some parameters. The result has the value that the vehicle reports for each parameter afterwards.

    The next step depends on the answer to a write:

    - The requested value with the requested type: the write is complete.
    - No answer: the value is read.
    - The old value: PARAM_SET is sent again, because it may have been lost. The old value becomes the
      result if the vehicle has reported it eight times in a row, the last time later than 1.5 s after the first
      PARAM_SET. While the old value is unknown, every unexpected value is treated like the old value.
    - Another value: the value is read again. PARAM_SET is not sent again, because it would undo the change if another
      station has set the value. A value reported twice in a row is the result.

    Args:
        before: the old values, as far as they are known.
        recent: names that an earlier call has just written. An answer with the requested value may belong to that
            write, so the value is read once more.
    """

    # ArduPilot saves through a queue of 30. If it overflows while armed, values are not saved, and an internal error
    # prevents the next arming (AP_Param.cpp).
    window_size = 10
    max_window_size: ClassVar[int | None] = 25

    def __init__(
        self,
        target_system: int,
        target_component: int,
        requested: Iterable[Parameter],
        *,
        bytewise: bool,
        before: Mapping[str, float] = MappingProxyType({}),
        recent: Iterable[str] = (),
        own_system: int = 0,
        **options: Unpack[TransferOptions],
    ) -> None:
        self._requested = {parameter.name: parameter for parameter in requested}
        super().__init__(
            target_system, target_component, self._requested, bytewise=bytewise, own_system=own_system, **options
        )
        self._old_values = dict(before)
        self._recently_written = frozenset(recent)
        self._must_read_again = set(self._recently_written)
        self._must_write = set(self._requested)  # names whose next request is a PARAM_SET
        self._repeated_answers: dict[str, RepeatedAnswers[Parameter]] = {}

    def _request(self, name: str) -> list[Message]:
        read = ParamRequestRead(self.target_system, self.target_component, name, BY_NAME)
        if name not in self._must_write:
            return [read]
        self._must_write.remove(name)
        requested = self._requested[name]
        write = set_message(
            self.target_system, self.target_component, name, requested.value, requested.type, self._bytewise
        )
        answers = self._repeated_answers.get(name)
        if answers is not None and len(answers) > 0:
            # The vehicle has answered an earlier write with another value, so it may ignore this write and send no
            # answer. The read makes the vehicle send the value in any case.
            return [write, read]
        return [write]

    def _on_value(self, message: ParamValue, now: float) -> None:
        name = message.param_id
        if not self._window.attempts(name):
            return  # No request for the name is in flight, so the message may answer another station.
        requested = self._requested[name]
        reported = self._with_integer_type(parameter_of(message, self._bytewise), requested.type)
        answers = self._repeated_answers.setdefault(name, RepeatedAnswers(_is_same))
        is_as_requested = same_value(reported.value, requested.value)
        if is_as_requested and name in self._must_read_again:
            # The message may be the late answer to a write of this name by an earlier call, so the value is read once
            # more.
            self._must_read_again.remove(name)
            answers.add(reported)
            self._request_again(name, now)
            return
        if is_as_requested and name in self._recently_written and self._is_too_early(name, now, may_measure=False):
            return  # Another late answer to the earlier call, not the answer to the read.
        # The requested value with another type is accepted when it is reported a second time.
        if is_as_requested and (reported.type == requested.type or answers.ends_with(reported)):
            self._window.on_answer(name, now)
            self._set_result(name, reported, now)
            return
        self._on_unexpected_value(name, reported, now, is_as_requested=is_as_requested)

    def _on_unexpected_value(self, name: str, reported: Parameter, now: float, *, is_as_requested: bool) -> None:
        """Write or read again, or end the write after enough equal answers.

        With ``is_as_requested``, only the type of the value is unexpected.
        """
        answers = self._repeated_answers[name]
        if self._is_too_early(name, now, may_measure=self._window.attempts(name) == 1):
            return
        answers.add(reported)
        old_value = self._old_values.get(name)  # None if unknown
        may_be_unchanged = old_value is None or same_value(reported.value, old_value)
        if may_be_unchanged and not is_as_requested:
            self._must_write.add(name)  # The vehicle may still have the old value, so PARAM_SET is sent again.
        is_conclusive = answers.are_conclusive(is_unchanged=may_be_unchanged)
        may_be_late = may_be_unchanged or name in self._recently_written
        if is_conclusive and may_be_late and now < self._started_at + LATE_ANSWERS_S:
            return  # These answers may be older than the write. The request is repeated when it is overdue.
        if is_conclusive:
            self._window.on_answer(name, now)
            self._set_result(name, reported, now)
        else:
            self._request_again(name, now)

    def _is_too_early(self, name: str, now: float, *, may_measure: bool) -> bool:
        """Return True if the answer cannot belong to the latest request for this name."""
        return self._stale_answers.is_stale(name, self._sent_at.get(name, now), now, may_measure=may_measure)

    def _with_integer_type(self, reported: Parameter, type_: ParameterType) -> Parameter:
        # If the value is the default, ArduPilot's answer to PARAM_SET reports an integer parameter as a float.
        is_whole_float = reported.type is ParameterType.REAL32 and float(reported.value).is_integer()
        if self._bytewise or not type_.is_integer or not is_whole_float:
            return reported
        return Parameter(reported.name, int(reported.value), type_, index=reported.index)

    def _timeout_text(self, name: str) -> str:
        return f"PARAM_SET of {name} was not confirmed, sent {self._window.attempts(name)} times"


def _is_same(first: Parameter, second: Parameter) -> bool:
    return same_value(first.value, second.value) and first.type == second.type
