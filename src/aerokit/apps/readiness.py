"""Words for what a vehicle lacks: whether it cannot arm, or arms but is not ready to fly by itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.vehicle.vehicle import Vehicle

_OWN_FLIGHT_PURPOSES: tuple[Literal["setpoint", "mission", "return"], ...] = ("setpoint", "mission", "return")


class Readiness(NamedTuple):
    """Reasons of a disarmed vehicle, in two groups. A reason is in one of them."""

    against_arming: tuple[str, ...]
    """Why arming is refused in the present mode."""
    against_flight: tuple[str, ...]
    """The rest that is missing for take-off and for flight in the modes that need a position."""
    is_known: bool = True
    """False if the vehicle does not report whether it arms. ``against_arming`` then has the missing reports."""

    @property
    def prefix(self) -> str:
        """Words before the reasons against arming."""
        return "cannot arm" if self.is_known else "not known whether it arms"


def readiness(vehicle: Vehicle, reasons: Sequence[str] | None = None) -> Readiness:
    """Group what the vehicle lacks.

    Args:
        vehicle: its state is used; nothing is sent.
        reasons: result of ``why_not_armable()``. None: the vehicle was not asked, and SYS_STATUS decides.
    """
    missing, sensors = vehicle.missing_for_flight(), vehicle.sensors.latest
    passes = sensors is not None and sensors.prearm_checks_pass is True
    only_estimates = all(_is_about_estimates(text) for text in (missing if reasons is None else reasons))
    if passes and only_estimates:  # ArduCopter arms in STABILIZE without a position, for example
        return Readiness((), tuple(dict.fromkeys([*(reasons or ()), *missing])))
    against = tuple(missing if reasons is None else reasons)
    is_known = not any(text.startswith(("heartbeats (", "sensors (")) for text in against)
    bare = {vehicle.autopilot.arming_reason(text) for text in against}
    return Readiness(against, tuple(text for text in missing if text not in against and text not in bare), is_known)


def _is_about_estimates(text: str) -> bool:
    return text.startswith(("the estimator has no ", "no GPS receiver has ", "position (", "home ("))


def own_flight_modes(vehicle: Vehicle) -> str:
    """Return the names of the modes in which the vehicle flies by itself: ``GUIDED, AUTO, RTL``."""
    mode_for, is_vtol = vehicle.autopilot.mode_for, vehicle.is_vtol
    modes = (mode_for(purpose, is_vtol=is_vtol) for purpose in _OWN_FLIGHT_PURPOSES)
    return ", ".join(dict.fromkeys(mode.name for mode in modes if mode is not None))


def arms_but(vehicle: Vehicle) -> str:
    """Return the words for a vehicle that lacks something for flight only."""
    return f"arms in {vehicle.mode_name}, but cannot take off by itself or fly {own_flight_modes(vehicle)}"


def readiness_lines(vehicle: Vehicle, found: Readiness) -> list[str]:
    """Return lines of text. Empty if nothing is missing."""
    lines = [f"{f'{found.prefix}: ' if place == 0 else '  '}{text}" for place, text in enumerate(found.against_arming)]
    if found.against_flight:
        words = "also missing for flight" if lines else arms_but(vehicle)
        lines += [f"{words}:", *(f"  {text}" for text in found.against_flight)]
    return lines
