"""Reads and writes the altitude of a return to launch, whose parameter and unit depend on the firmware."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.arguments import check_range
from aerokit.errors import NotSupported, ParameterRejected, ParameterTimeout

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot
    from aerokit.parameters import Parameter
    from aerokit.vehicle.parameters.parameters import Parameters
    from aerokit.vehicle.session.session import VehicleSession

MAX_RETURN_ALTITUDE_M = 3000
"""Upper limit of ArduCopter's RTL_ALT. The parameters of other firmware have no limit."""


async def read_return_altitude(parameters: Parameters, session: VehicleSession) -> float:
    found = await _find_parameter("return_altitude", parameters, session)
    return round(found.parameter.value / found.units_per_metre, 3)


def known_return_altitude(parameters: Parameters, autopilot: Autopilot, *, is_vtol: bool) -> float | None:
    """Return the altitude in metres from a parameter that is already known, or None. Sends nothing."""
    for name, units_per_metre in autopilot.return_altitude_parameters(is_vtol=is_vtol):
        if (known := parameters.known(name)) is not None:
            return round(known.value / units_per_metre, 3)
    return None


async def write_return_altitude(parameters: Parameters, session: VehicleSession, altitude_m: float) -> None:
    check_range("altitude_m", altitude_m, 0, MAX_RETURN_ALTITUDE_M, above=True)
    found = await _find_parameter("set_return_altitude", parameters, session)
    value = altitude_m if found.units_per_metre == 1 else round(altitude_m * found.units_per_metre)
    await parameters.set(found.parameter.name, value)


class _AltitudeParameter(NamedTuple):
    parameter: Parameter
    units_per_metre: float


async def _find_parameter(action: str, parameters: Parameters, session: VehicleSession) -> _AltitudeParameter:
    autopilot = session.autopilot
    names_and_units = autopilot.return_altitude_parameters(is_vtol=session.telemetry.is_vtol)
    if not names_and_units:
        raise NotSupported(f"{action}: {autopilot.firmware} does not climb for a return; nothing was sent")
    answers = await parameters.probe(*(name for name, _ in names_and_units))
    failures: list[ParameterRejected | ParameterTimeout] = []
    for name, units_per_metre in names_and_units:
        answer = answers[name]
        if not isinstance(answer, (ParameterRejected, ParameterTimeout)):
            return _AltitudeParameter(answer, units_per_metre)
        failures.append(answer)
    # A time-out takes precedence, because the vehicle may have this parameter.
    raise next((failure for failure in failures if isinstance(failure, ParameterTimeout)), failures[0])
