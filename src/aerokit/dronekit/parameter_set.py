"""Setting one parameter as a program means it: any number, sent in the parameter's own type, confirmed."""

from __future__ import annotations

from typing import TYPE_CHECKING, SupportsFloat, SupportsIndex

from aerokit.errors import AerokitError, LocalProtocolError, ParameterRejected, ParameterTimeout
from aerokit.parameters import checked_value

if TYPE_CHECKING:
    from aerokit.parameters import ParameterType
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["number_of", "set_parameter"]

TRY_S = 1.0
"""How long one attempt waits, unless the link is slower."""
LAST_TRY = 0.5
"""The share of that for the answer to the last one."""
ROUND_TRIPS = 3
ALMOST = 0.01
"""ArduPilot adds it before it cuts off the fraction."""


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
