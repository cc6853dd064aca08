"""Texts about what a vehicle lacks, either to arm, or to fly by itself after arming."""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, Literal, NamedTuple

from aerokit.errors import AerokitError
from aerokit.events import LinkState
from aerokit.vehicle.commanding.health import REPORTS_ABOUT_ARMING
from aerokit.vehicle.commanding.order import FAILSAFE_STATES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.vehicle.vehicle import Vehicle

_OWN_FLIGHT_PURPOSES: tuple[Literal["setpoint", "mission", "return"], ...] = ("setpoint", "mission", "return")
# The texts of one failsafe may be this many seconds apart, because PX4 holds for COM_FAIL_ACT_T before some actions.
_FAILSAFE_REPORT_DURATION_S = 10.0


def active_failsafe(vehicle: Vehicle) -> list[str] | None:
    """Return the vehicle's texts about its active failsafe; None if no failsafe is active.

    The oldest text is the first. Texts more than ten seconds older than the newest one are left out.
    """
    # ArduPilot and PX4 report a failsafe as MAV_STATE_CRITICAL, which means nothing while the vehicle is disarmed
    # (vehicle_system_status in GCS_MAVLink_Copter.cpp, HEARTBEAT.hpp).
    if not vehicle.armed.latest or vehicle.system_status.latest not in FAILSAFE_STATES:
        return None
    texts = vehicle.telemetry.texts_about_failsafes()
    if not texts:
        return ["no text about its cause was received"]
    begins_at = max(text.at for text in texts) - _FAILSAFE_REPORT_DURATION_S
    return list(dict.fromkeys(text.text for text in texts if text.at >= begins_at))


class Readiness(NamedTuple):
    """Reasons why a disarmed vehicle cannot arm or fly, in two groups without duplicates."""

    against_arming: tuple[str, ...]
    """Reasons why the vehicle refuses to arm in its present mode."""
    against_flight: tuple[str, ...]
    """Other reasons, which prevent a take-off and modes that need a position."""
    is_known: bool = True
    """False if it is unknown whether the vehicle arms. ``against_arming`` then names the reports that are missing."""

    @property
    def prefix(self) -> str:
        """Words to print before the reasons in ``against_arming``."""
        return "cannot arm" if self.is_known else "not known whether it arms"


def readiness(vehicle: Vehicle, reported: Sequence[str] | None = None, *, changes_mode: bool = False) -> Readiness:
    """Return the reasons why a vehicle cannot arm, and why it cannot fly. Nothing is sent.

    ``reported`` is the result of ``vehicle.why_not_armable()``. With None, the reasons against arming are derived from
    the received states. With ``changes_mode``, the present mode is not checked, because `Vehicle.arm` will change it.
    """
    grouped = _group_reasons(vehicle, reported)
    if reported is not None or changes_mode:  # `reported` includes a refusal because of the mode
        return grouped
    against_arming = dict.fromkeys([*_refused_mode(vehicle), *grouped.against_arming])
    return grouped._replace(against_arming=tuple(against_arming))


def _group_reasons(vehicle: Vehicle, reported: Sequence[str] | None) -> Readiness:
    """Group the reasons into those against arming and those against flight. The mode itself is not checked."""
    missing = vehicle.missing_for_flight()
    against_arming = tuple(_needed_to_arm(vehicle, missing) if reported is None else reported)
    sensors = vehicle.sensors.latest
    checks_pass = sensors is not None and sensors.prearm_checks_pass is True
    if checks_pass and all(map(_is_about_estimates, against_arming)):
        # The pre-arm checks pass, so only the mode decides whether missing estimates prevent arming: ArduCopter without
        # a position arms in STABILIZE, but not in GUIDED.
        refusals = tuple(arm_refusals(vehicle, missing)) if reported is None else ()
        all_reasons = dict.fromkeys([*missing, *against_arming])
        return Readiness(refusals, tuple(text for text in all_reasons if text not in refusals))
    is_known = not any(text.startswith(REPORTS_ABOUT_ARMING) for text in against_arming)
    # No reason is listed twice: "PreArm: X" in `against_arming` is the same reason as "X" in `missing`.
    without_prefix = {vehicle.autopilot.arming_reason(text) for text in against_arming}
    against_flight = tuple(text for text in missing if text not in against_arming and text not in without_prefix)
    return Readiness(against_arming, against_flight, is_known)


def _is_about_estimates(text: str) -> bool:
    return text.startswith(("the estimator has no ", "no GPS receiver has ", "position (", "home ("))


def _needed_to_arm(vehicle: Vehicle, missing: Sequence[str]) -> list[str]:
    """Return the missing conditions that prevent arming in the present mode."""
    mode = vehicle.mode.latest
    needs_position = mode is None or mode.name not in vehicle.autopilot.modes_without_position
    needed = []
    for text in missing:
        is_missing_position = text.startswith(("the estimator has no ", "no GPS receiver has "))
        # If only the report of an estimate is missing, the vehicle itself may have the estimate and arm.
        is_missing_report = text.startswith(("estimator (", "position (", "home (")) and text.endswith(" not received)")
        arms_without_position = is_missing_position and not needs_position
        if not arms_without_position and not is_missing_report:
            needed.append(text)
    return needed


def arm_refusals(vehicle: Vehicle, missing: list[str]) -> list[str]:
    """Return the known reasons why `Vehicle.arm` would fail. Sends nothing.

    ``missing`` is the result of `Vehicle.missing_for_flight`.
    """
    if vehicle.link_state.latest is not LinkState.CONNECTED or vehicle.armed.latest is not False:
        return []  # only a connected, disarmed vehicle reports what prevents arming
    autopilot = vehicle.autopilot
    unarmable = unarmable_mode(vehicle)
    if unarmable is not None and unarmable["arms_in"] is None:  # `arm` cannot change to a mode that allows arming
        return [*_refused_mode(vehicle), *_needed_to_arm(vehicle, missing)]
    sensors = vehicle.sensors.latest
    if sensors is not None and sensors.prearm_checks_pass is False:
        return _needed_to_arm(vehicle, missing)
    mode = vehicle.mode.latest
    current_mode = None if mode is None else mode.name
    arms_in = current_mode if unarmable is None else unarmable["arms_in"]
    # An empty `modes_without_position` means that it is unknown which modes of this autopilot need a position.
    needs_position = bool(autopilot.modes_without_position) and arms_in not in autopilot.modes_without_position
    estimator = vehicle.estimator.latest
    lacks_estimates = estimator is not None and bool(estimator.missing)
    if arms_in is not None and needs_position and lacks_estimates:
        change = "" if unarmable is None else ", to which arming would change the mode"
        headline = f"{autopilot.firmware} needs a position to arm in {arms_in}{change}"
        # A value that was not received is not named as a reason, because the vehicle itself may have it.
        return [headline, *(text for text in missing if not text.endswith(" not received)"))]
    return []


def unarmable_mode(vehicle: Vehicle) -> dict[str, str | None] | None:
    """Return data about the current mode if it does not allow arming; otherwise None.

    ``mode`` is the name of the mode. ``arms_in`` is the mode to which ``arm`` would change, or None. ``unless`` is the
    autopilot's parameter that can permit arming in the current mode, or None. Its value is not checked.
    """
    autopilot = vehicle.autopilot
    mode = vehicle.mode.latest
    if mode is None or mode.name not in autopilot.unarmable_modes.union(autopilot.armable_by_option):
        return None
    arming_mode = autopilot.mode_to_arm_in()
    return {
        "mode": mode.name,
        "arms_in": None if arming_mode is None else arming_mode.name,
        "unless": autopilot.armable_by_option.get(mode.name),
    }


def _refused_mode(vehicle: Vehicle) -> list[str]:
    """Return one text if the mode does not allow arming, otherwise nothing."""
    unarmable = None if vehicle.armed.latest else unarmable_mode(vehicle)
    if unarmable is None:
        return []
    unless = f" unless {unarmable['unless']} allows it" if unarmable["unless"] else ""
    change = f" (Vehicle.arm changes the mode to {unarmable['arms_in']})" if unarmable["arms_in"] else ""
    return [f"{vehicle.autopilot.firmware} cannot arm in {unarmable['mode']}{unless}{change}"]


def own_flight_modes(vehicle: Vehicle) -> str:
    """Return the names of the modes in which the vehicle flies by itself, such as ``GUIDED, AUTO, RTL``."""
    modes = [vehicle.autopilot.mode_for(purpose, is_vtol=vehicle.is_vtol) for purpose in _OWN_FLIGHT_PURPOSES]
    return ", ".join(dict.fromkeys(mode.name for mode in modes if mode is not None))


def arms_but_cannot_fly_text(vehicle: Vehicle) -> str:
    """Return text such as "arms in STABILIZE, but cannot take off by itself or fly GUIDED, AUTO, RTL"."""
    return f"arms in {vehicle.mode_name}, but cannot take off by itself or fly {own_flight_modes(vehicle)}"


def readiness_lines(vehicle: Vehicle, checks: Readiness) -> list[str]:
    lines = []
    for index, text in enumerate(checks.against_arming):
        lines.append(f"{checks.prefix}: {text}" if index == 0 else f"  {text}")
    if checks.against_flight:
        words = "also missing for flight" if lines else arms_but_cannot_fly_text(vehicle)
        lines += [f"{words}:", *(f"  {text}" for text in checks.against_flight)]
    return lines


MIN_CHECK_INTERVAL_S = 5.0
"""Minimum seconds between two requests for arming checks, because the failing sensors of a vehicle may alternate."""


class ArmingCheckRequests:
    """Decides when to request arming checks: when they begin to fail, and when the set of failing sensors changes."""

    def __init__(self) -> None:
        self._failing: dict[Vehicle, tuple[str, ...]] = {}
        self._requested_at: dict[Vehicle, float] = {}

    def claim_if_due(self, vehicle: Vehicle) -> bool:
        """Return True if `run_arming_checks` is due for the vehicle. The checks then count as requested."""
        failing = _failing_checks(vehicle)
        if failing is None:
            self._failing.pop(vehicle, None)
            return False
        now = vehicle.connection.now()
        is_early = now - self._requested_at.get(vehicle, -math.inf) < MIN_CHECK_INTERVAL_S
        if failing == self._failing.get(vehicle) or is_early:
            return False
        self._failing[vehicle] = failing
        self._requested_at[vehicle] = now
        return True


async def run_arming_checks(vehicle: Vehicle) -> None:
    """Ask a vehicle why it cannot arm. It answers with status texts."""
    with contextlib.suppress(AerokitError):  # the vehicle is silent, which its state shows
        await vehicle.why_not_armable()


def _failing_checks(vehicle: Vehicle) -> tuple[str, ...] | None:
    """Return the failing sensors if the vehicle is connected and disarmed, and its arming checks fail; else None."""
    sensors = vehicle.sensors.latest
    is_disarmed = vehicle.armed.latest is False
    if vehicle.link_state.latest is not LinkState.CONNECTED or not is_disarmed or sensors is None:
        return None
    return tuple(sensors.failing) if sensors.prearm_checks_pass is False else None
