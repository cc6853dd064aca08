"""The values of parameters: under any of their names, and set as programs mean it."""

from __future__ import annotations

from typing import TYPE_CHECKING, SupportsFloat, SupportsIndex

from aerokit.errors import AerokitError, LocalProtocolError, ParameterRejected, ParameterTimeout
from aerokit.parameters import checked_value
from aerokit.parameters.parameter import MOST_PARAMETERS, same_value
from aerokit.vehicle.parameters.names import found_among

if TYPE_CHECKING:
    from aerokit.parameters import Parameter, ParameterType
    from aerokit.vehicle.parameters.names import Found
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["ParameterValues", "number_of", "set_parameter"]

TRY_S = 1.0
"""How long one attempt waits, unless the link is slower."""
LAST_TRY = 0.5
"""The share of that for the answer to the last one."""
ROUND_TRIPS = 3
ALMOST = 0.01
"""ArduPilot adds it before it cuts off the fraction."""


class ParameterValues:
    """What the vehicle has told, through reboots, too. One thread writes, any thread reads."""

    def __init__(self) -> None:
        self._known: dict[str, Parameter] = {}
        self._spelled: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._known)

    def copy(self) -> dict[str, float]:
        """Name → value as the vehicle spells and counts them, in a dict of the caller's own."""
        return {name: float(each.value) for name, each in self._known.copy().items()}

    def find(self, name: str) -> Found | None:
        """What is known of an upper-cased name."""
        known = self._known
        return found_among(name if name in known else self._spelled.get(name, name), known)

    def get(self, name: str) -> float | None:
        """The value of an upper-cased name, if it is the vehicle's own and known."""
        known = self._known.get(name)
        return None if known is None else float(known.value)

    def take(self, parameter: Parameter) -> bool:
        """One has come; says whether that is news."""
        name, before = parameter.name, self._known.get(parameter.name)
        if before is None and len(self._known) >= MOST_PARAMETERS:
            return False
        if before is None and name != name.upper():
            self._spelled[name.upper()] = name
        self._known[name] = parameter
        return before is None or not same_value(before.value, parameter.value)


def number_of(name: str, value: object) -> int | float:
    """The value, when it is a number: of Python, numpy or alike.

    Raises:
        LocalProtocolError: a ValueError; it is text, None or anything else.
    """
    if isinstance(value, (int, float)):
        return value
    if isinstance(value, SupportsIndex):
        return value.__index__()
    if isinstance(value, SupportsFloat):
        return float(value)
    raise LocalProtocolError(f"{name} = {value!r} is no number")


async def set_parameter(aio: AsyncVehicle, name: str, value: float, retries: int) -> AerokitError | None:
    """Have the vehicle take a value; returns why it has not, None when it has confirmed it.

    A fraction given for an integer parameter is cut off, as by ArduPilot itself. A vehicle that answers nothing
    is sent PARAM_SET once, then asked what it has, for ``retries`` + 1 tries in all.
    """
    patience_s = (retries + LAST_TRY) * _try_s(aio)
    try:
        known = aio.parameters.known(name) or await aio.parameters.read(name, patience_s=patience_s)
        wanted = as_held(name, value, known.type)
        done = await aio.parameters.set(name, wanted, patience_s=patience_s)
    except (LocalProtocolError, ParameterRejected, ParameterTimeout) as error:
        return error
    if done.outcome == "clamped":
        return ParameterRejected(f"the vehicle made it {done.value:g}", name=name)
    return None


def as_held(name: str, value: float, type: ParameterType) -> int | float:  # noqa: A002
    """The value as a parameter of that type holds it; LocalProtocolError when it cannot."""
    if type.is_integer and isinstance(value, float) and abs(value) < float("inf"):
        value = int(value - ALMOST if value < 0 else value + ALMOST)
    return checked_value(name, value, type)


def _try_s(aio: AsyncVehicle) -> float:
    report = aio.link_quality.latest
    return max(TRY_S, ROUND_TRIPS * ((report and report.round_trip_s) or 0.0))
