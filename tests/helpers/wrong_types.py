"""Wrong arguments for every public method of an object: for each parameter, values of other types than its annotation.

An annotation that is not listed here is an error, so that new ones in the library are covered.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from decimal import Decimal
from functools import partial
from typing import Any, NamedTuple

from aerokit import Position, messages
from aerokit.errors import InvalidArgument
from aerokit.missions import Fence, Mission, RallyPoints
from aerokit.vehicle.commanding.setpoints import (
    ActuatorSetpoint,
    AttitudeSetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    TrajectorySetpoint,
    VelocitySetpoint,
)
from aerokit.vehicle.commanding.sticks import StickInput

__all__ = ["Misuse", "misuses", "misuses_of", "refusal_of"]


class _Anything:
    """A value of an unknown type."""

    def __repr__(self) -> str:
        raise RuntimeError("not even that")


PLACE = Position(47.0, 8.0)
NOTHING: tuple[object, ...] = (None,)
STRANGE: tuple[object, ...] = (_Anything(), [PLACE], (47.0, 8.0), {"a": "b"}, 1j, type)
TEXT: tuple[object, ...] = ("ten",)
NUMBER: tuple[object, ...] = (12,)
WRONG: dict[str, tuple[object, ...]] = {
    "float": (*NOTHING, *STRANGE, *TEXT, Decimal(1), "1.0", b"1"),
    "float | None": (*STRANGE, *TEXT, Decimal(1), "1.0"),
    "int": (*NOTHING, *STRANGE, *TEXT, 1.5, "1"),
    "int | None": (*STRANGE, *TEXT, 1.5, "1"),
    "bool": (*NOTHING, *STRANGE, "no", 2),
    "str": (*NOTHING, *STRANGE, *NUMBER, b"text"),
    "bytes": (*NOTHING, *STRANGE, *TEXT, *NUMBER),
    "str | None": (*STRANGE, *NUMBER, b"text"),
    "float | str | bytes": (*NOTHING, *STRANGE, Decimal(1)),
    "CameraDefinition | str | os.PathLike[str]": (*NOTHING, *STRANGE, *NUMBER),
    "str | int | None": (*STRANGE, 1.5, b"GUIDED"),
    "str | int": (*NOTHING, *STRANGE, 1.5, b"GUIDED"),
    "str | os.PathLike[str]": (*NOTHING, *STRANGE, *NUMBER),
    "str | os.PathLike[str] | None": (*STRANGE, *NUMBER),
    "Position": (*NOTHING, *STRANGE, *TEXT, *NUMBER, [47.0, 8.0]),
    "Position | Home": (*NOTHING, *STRANGE, *TEXT, *NUMBER, [47.0, 8.0]),
    "Position | Home | None": (*STRANGE, *TEXT, *NUMBER, [47.0, 8.0]),
    "Message": (*NOTHING, *STRANGE, *TEXT, *NUMBER, messages.Heartbeat),
    "type[Message]": (*NOTHING, *STRANGE, *TEXT, *NUMBER, messages.Heartbeat(0, 0, 0, 0, 0), int),
    "Mapping[str, float]": (*NOTHING, *STRANGE, *TEXT, *NUMBER, {1: 1.0}, {"A": "1"}, {"A": None}, ["A"]),
    "Mapping[type[Message], float] | None": (
        *STRANGE,
        *TEXT,
        *NUMBER,
        {"HEARTBEAT": 1.0},
        {messages.Heartbeat: "1"},
    ),
    "Callable[[int], object] | None": (*TEXT, *NUMBER, [print]),
    "Callable[[int | None], None] | None": (*TEXT, *NUMBER, [print]),
    "OnProgress | None": (*TEXT, *NUMBER, [print]),
    "Callable[[T], object]": (*NOTHING, *TEXT, *NUMBER, [print]),
    "Callable[[T | None, T], None]": (*NOTHING, *TEXT, *NUMBER, [print]),
    "Signing | None": (*STRANGE, *TEXT, *NUMBER, bytes(32)),
    "OwnHeartbeat | None": (*STRANGE, *TEXT, *NUMBER),
    "bool | None": (*STRANGE, "no", 2),
    "tuple[Mode, ...]": (*NOTHING, _Anything(), [PLACE], (47.0, 8.0), 1j, *TEXT, *NUMBER),
    "PeerFilter | None": (*STRANGE, 1.5, b"10.0.0.7"),
    "Dialect": (*NOTHING, *STRANGE, *TEXT, *NUMBER),
    "LogEntry | int": (*NOTHING, *STRANGE, *TEXT, 1.5),
    "ParameterSource": (*NOTHING, _Anything(), [PLACE], (47.0, 8.0), 1j, *NUMBER),
    **dict.fromkeys(("PlanT", "Mission", "Fence", "RallyPoints"), (*NOTHING, *STRANGE, *TEXT, *NUMBER, PLACE)),
    "SetpointT": (*NOTHING, *STRANGE, *TEXT, *NUMBER, PLACE),
    "Iterable[str | Endpoint | Link]": (*NOTHING, _Anything(), [PLACE], (47.0, 8.0), 1j, *TEXT, *NUMBER),
    "str | Endpoint | Link": (*NOTHING, *STRANGE, *TEXT, *NUMBER),
    "Callable[[HubEvent], object]": (*NOTHING, *TEXT, *NUMBER, [print]),
    "str | Link": (*NOTHING, *STRANGE, *NUMBER, b"udpin:0.0.0.0:14550"),
    "str | Link | Sequence[str | Link]": (*NOTHING, *STRANGE, *NUMBER, b"udpin:0.0.0.0:14550", [1, 2]),
    "str | Link | Sequence[str | Link] | Connection": (
        *NOTHING,
        *STRANGE,
        *NUMBER,
        b"udpin:0.0.0.0:14550",
        [1, 2],
    ),
    "str | Link | Connection": (*NOTHING, *STRANGE, *NUMBER, b"udpin:0.0.0.0:14550"),
}
"""Maps an annotation to values that it does not allow."""
WRONG["type[ItemT]"] = WRONG["type[MessageT]"] = WRONG["type[Message]"]
_SETPOINTS = (
    *("Velocity", "BodyVelocity", "Acceleration", "LocalPosition", "Position", "Attitude"),
    *("AttitudeRate", "Trajectory", "Actuator"),
)
for _value in (*(f"{kind}Setpoint" for kind in _SETPOINTS), "StickInput"):
    WRONG[_value] = (*NOTHING, *STRANGE, *TEXT, *NUMBER, PLACE)
WRONG["TargetSource"] = (*NOTHING, [PLACE], (47.0, 8.0), {"a": "b"}, 1j, *TEXT, *NUMBER, PLACE)
WRONG["StickInput | None"] = (*STRANGE, *TEXT, *NUMBER, PLACE)
WRONG["FollowTarget"] = (*NOTHING, 1j, *TEXT, *NUMBER, PLACE)
WRONG["CacheChoice"] = (*NOTHING, *STRANGE, *NUMBER)
WRONG["Capture"] = (*NOTHING, *STRANGE, *TEXT, *NUMBER)
for _literal in (
    "ModeName",
    "AutoFocus",
    "SourceName",
    "DownloadMethod",
    "UploadMethod",
    "PlanMethod",
    "LogMethod",
    "Overflow",
    "Subject",
    "Facing",
    "FlightState",
    "TerminationIntent",
    "ShutdownIntent",
    "EscIntent",
    "SpinIntent",
    "ReleaseIntent",
    "FailureIntent",
    "FailingUnit",
    "FailureKind",
    "Severity",
):
    WRONG[_literal] = (*STRANGE, *NUMBER, "quick")

RIGHT: dict[str, object] = {
    "float": 1.0,
    "int": 1,
    "bool": False,
    "str": "A",
    "bytes": b"",
    "float | str | bytes": 1.0,
    "str | int": "GUIDED",
    "str | os.PathLike[str]": "/nowhere/at/all",
    "CameraDefinition | str | os.PathLike[str]": "/nowhere/at/all",
    "str | None": None,
    "str | Link": "udpin:127.0.0.1:0",
    "str | Link | Sequence[str | Link]": "udpin:127.0.0.1:0",
    "str | Link | Sequence[str | Link] | Connection": "udpin:127.0.0.1:0",
    "str | Link | Connection": "udpin:127.0.0.1:0",
    "Position": PLACE,
    "Position | Home": PLACE,
    "Position | Home | None": PLACE,
    "Message": messages.Heartbeat(6, 8, 0, 0, 4),
    "type[Message]": messages.Heartbeat,
    "type[MessageT]": messages.Heartbeat,
    "Mapping[str, float]": {"A": 1.0},
    "ParameterSource": {"A": 1.0},
    "Callable[[T], object]": bool,
    "Callable[[T | None, T], None]": print,
    "LogEntry | int": 1,
    "Signing | None": None,
    "OwnHeartbeat | None": None,
    **{kind.__name__: kind() for kind in (Mission, Fence, RallyPoints)},
    "PlanT": Mission(),
    "SourceName": "rgb",
    "FlightState": "fixed_wing",
    "FollowTarget": lambda: PLACE,
    "TerminationIntent": "terminate flight",
    "ShutdownIntent": "shut down",
    "ModeName": "photo",
    "SpinIntent": "spin motor",
    "ReleaseIntent": "release parachute",
    "FailureIntent": "inject failure",
    "FailingUnit": "gps",
    "FailureKind": "off",
    "SetpointT": VelocitySetpoint(),
    "PositionSetpoint": PositionSetpoint(PLACE),
    "LocalPositionSetpoint": LocalPositionSetpoint(0, 0, -5),
    "TrajectorySetpoint": TrajectorySetpoint(0, 0, -5),
    "ActuatorSetpoint": ActuatorSetpoint((0.0,) * 8),
    "StickInput": StickInput(),
    "TargetSource": lambda: None,
    "AttitudeSetpoint": AttitudeSetpoint(0, 0, 0, thrust=0.5),
}
"""Maps an annotation to a valid value, for required parameters in a call whose wrong value is another parameter."""


class Misuse(NamedTuple):
    """A method, one of its parameters, and the call with a wrong value for it."""

    method: str
    parameter: str
    value: object
    call: Callable[[], Any]

    def __repr__(self) -> str:
        return f"{self.method}({self.parameter}=<{type(self.value).__name__}>)"


def misuses(owner: object, *, leave_out: frozenset[str] = frozenset()) -> Iterator[Misuse]:
    """Yield calls of each public method of an object, with one wrong value in each."""
    for name, _ in inspect.getmembers(type(owner), inspect.isfunction):
        if not name.startswith("_") and name not in leave_out:
            yield from misuses_of(getattr(owner, name), f"{type(owner).__name__}.{name}")


def misuses_of(function: Callable[..., Any], name: str) -> Iterator[Misuse]:
    """Yield calls of a function, with one wrong value in each."""
    parameters = inspect.signature(function).parameters
    needed = [
        parameter
        for parameter in parameters.values()
        if parameter.default is parameter.empty and parameter.kind is not parameter.VAR_POSITIONAL
    ]
    for parameter in parameters.values():
        others = [needed_parameter for needed_parameter in needed if needed_parameter is not parameter]
        for value in (*WRONG[str(parameter.annotation)], *_impossible(name, parameter)):
            args, kwargs = _arguments(parameter, value, others)
            yield Misuse(name, parameter.name, value, partial(function, *args, **kwargs))


def _impossible(method: str, parameter: inspect.Parameter) -> tuple[object, ...]:
    """Return invalid values of the right type for a time. Cells and subscriptions allow 0, which does not wait."""
    name = parameter.name
    is_time = name == "timeout" or (name.endswith("_s") and not name.endswith(("m_s", "deg_s")))
    is_for_vehicles = not method.startswith(("StateCell.", "Subscription."))
    return (math.nan, -1.0, 0.0) if is_time and is_for_vehicles and "float" in str(parameter.annotation) else ()


def _arguments(
    wrong: inspect.Parameter, value: object, others: list[inspect.Parameter]
) -> tuple[list[object], dict[str, object]]:
    """Return positional and keyword arguments. Arguments are passed by name, except before a wrong ``*args``."""
    if wrong.kind is wrong.VAR_POSITIONAL:
        first = [RIGHT[str(other.annotation)] for other in others if other.kind is other.POSITIONAL_OR_KEYWORD]
        rest = {other.name: RIGHT[str(other.annotation)] for other in others if other.kind is other.KEYWORD_ONLY}
        return [*first, value], rest
    return [], {wrong.name: value} | {other.name: RIGHT[str(other.annotation)] for other in others}


def refusal_of(misuse: Misuse, error: BaseException | None) -> str | None:
    """Describe the problem with an error; None if the error is as documented."""
    if not isinstance(error, InvalidArgument):
        return f"{misuse!r}: {error!r}"
    return None if misuse.parameter in str(error) else f"{misuse!r}: the error does not name the parameter: {error}"
