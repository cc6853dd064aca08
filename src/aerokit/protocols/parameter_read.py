"""``ParameterReads``: parameters by name (PARAM_REQUEST_READ).

https://mavlink.io/en/services/parameter.html#read_single
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from aerokit.errors import ParameterRejected
from aerokit.mavlink.enums import MavParamError
from aerokit.mavlink.messages import ParamRequestRead
from aerokit.parameters.encoding import parameter_of
from aerokit.parameters.parameter import same_value
from aerokit.protocols.parameter_requests import ParameterRequests
from aerokit.protocols.transfer import PATIENCE_S, OnProgress

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import ParamError, ParamValue
    from aerokit.protocols.round_trip import RoundTrip

__all__ = ["ParameterReads"]

READS_AT_ONCE = 20
BY_NAME = -1
PROBE, PROBE_INDEX = "", 0
"""The request for a parameter that every vehicle has."""
DOUBT = 1e-4
"""How probable it may be that a parameter exists although the vehicle, which answers otherwise, says nothing of it."""


class ParameterReads(ParameterRequests):
    """Read some parameters by name; ends with one answer for each.

    ArduPilot, and PX4 until 1.16, meet an unknown name with silence. So names that ``are_doubtful`` are asked for
    together with the parameter of index 0, and when that one comes time and again, the vehicle has none of the name
    that does not: the answer is a ParameterRejected without a code.

    Of a name and its ``rivals`` the vehicle has one at most: the others are rejected when that one has come.
    An answer that tells a ``distrusted`` value may have been under way for long: it is believed the second time.
    """

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
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__(
            target_system,
            target_component,
            names,
            bytewise=bytewise,
            window=READS_AT_ONCE,
            doubles_last=not are_doubtful,
            own_system=own_system,
            round_trip=round_trip,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        self._are_doubtful = self._is_probe_wanted = are_doubtful
        self._distrusted = dict(distrusted)
        self._refused: set[str] = set()
        self._rivals = {name: tuple(others) for name, others in rivals.items()}
        self._probes_sent = self._probes_answered = 0

    def _request(self, name: str) -> list[Message]:
        target = self.target_system, self.target_component
        if name == PROBE:
            self._probes_sent += 1
            return [ParamRequestRead(*target, "", PROBE_INDEX)]
        return [ParamRequestRead(*target, name, BY_NAME)]

    def _before_sending(self, now: float) -> None:
        overdue = [name for name in self._window.overdue(now) if name != PROBE]
        if self._are_doubtful and overdue:
            self._give_up_unknown(overdue, now)
            self._is_probe_wanted = True

    def _after_sending(self, now: float) -> None:
        if self._is_probe_wanted and PROBE not in self._window:
            self._window.send(PROBE, now)
            self._outbox += self._request(PROBE)
        self._is_probe_wanted = False

    def _take(self, message: ParamValue, now: float) -> None:
        if message.param_index == PROBE_INDEX and self._window.attempts(PROBE):
            self._probes_answered = min(
                self._probes_answered + 1, self._probes_sent
            )  # repeated ones count once
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

    def _give_up_unknown(self, names: list[str], now: float) -> None:
        """Silence is an answer once it can hardly be loss."""
        for name in names:
            if self._probability_of_silence(self._window.attempts(name)) < DOUBT:
                text = f"the vehicle has no parameter {name}: it answers others, and not this one"
                self._settle(name, ParameterRejected(text, name=name), now)

    def _probability_of_silence(self, attempts: int) -> float:
        """How probable it is to lose all answers to so many requests, after what became of the probes (Laplace)."""
        lost = self._probes_sent - self._probes_answered
        chances = ((lost + 1 + i) / (self._probes_sent + 2 + i) for i in range(attempts))
        return math.prod(chances) if self._probes_answered else 1.0

    def _timeout_text(self, name: str) -> str:
        return f"{name} was not answered, asked for {self._window.attempts(name)} times"
