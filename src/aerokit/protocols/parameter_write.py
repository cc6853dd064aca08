"""``ParameterWrites``: parameters set (PARAM_SET) and confirmed by value and type.

https://mavlink.io/en/services/parameter.html#write
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from aerokit.mavlink.messages import ParamRequestRead
from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.encoding import parameter_of, set_message
from aerokit.parameters.parameter import same_value
from aerokit.protocols.parameter_requests import ParameterRequests
from aerokit.protocols.transfer import PATIENCE_S, OnProgress

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import ParamValue
    from aerokit.protocols.round_trip import RoundTrip

__all__ = ["ParameterWrites"]

WRITES_AT_ONCE = 10
"""ArduPilot saves through a queue of 30, which it must not overflow while it is armed."""
BY_NAME = -1
VERDICT, VERDICT_OF_NO_CHANGE = 2, 8
"""So many answers with another value than asked for are a verdict; more when it is the value from before, which may
also stand in a message that was under way, while PARAM_SET was lost."""


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
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        self._wanted = {each.name: each for each in wanted}
        super().__init__(
            target_system,
            target_component,
            self._wanted,
            bytewise=bytewise,
            window=WRITES_AT_ONCE,
            own_system=own_system,
            round_trip=round_trip,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        self._before = dict(before)
        self._recent = set(recent)
        self._to_set = set(self._wanted)
        """Those that may be set with the next request."""
        self._others: dict[str, list[Parameter]] = {}

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
        others = self._others.setdefault(name, [])
        is_as_asked = same_value(told.value, wanted.value)
        if is_as_asked and name in self._recent:
            self._recent.remove(name)
            others.append(told)
            self._window.answered(name, now)
            self._window.ask(name)
            return
        if is_as_asked and (told.type == wanted.type or (others and _is_same(others[-1], told))):
            self._window.answered(name, now)
            self._settle(name, told, now)
            return
        if self._is_too_early(name, now):
            return
        if others and not _is_same(others[-1], told):
            others.clear()
        others.append(told)
        self._window.answered(name, now)
        is_no_change = same_value(told.value, self._before.get(name, told.value))
        if is_no_change and not is_as_asked:
            self._to_set.add(name)
        if len(others) >= (VERDICT_OF_NO_CHANGE if is_no_change else VERDICT):
            self._settle(name, told, now)
        else:
            self._window.ask(name)

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
