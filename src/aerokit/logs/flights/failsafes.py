"""Detects failsafes of a flight by status texts, modes, errors and flags, and collects the values before each."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.values import Snapshot
from aerokit.autopilots.failsafes import failsafe_kind
from aerokit.logs.flights.codes import failsafe_action
from aerokit.logs.flights.flight import FailsafeEvidence, TangentPlane, battery_name
from aerokit.mavlink.enums import GpsFixType

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from aerokit.logs.flights.flight import FlightLog, LoggedText, ModeChange, TimeSeries

# Pieces of evidence of the same kind belong to one failsafe if they are at most this time apart.
_SAME_KIND_GAP_S = 8.0
# Evidence that does not name the failure (kind "general") is added to a failsafe that is at most this time away.
_GENERAL_GAP_S = 3.0
# _GENERAL_GAP_S is too short if the autopilot delays its reaction: by dead reckoning after a loss of satellites (PX4:
# five seconds), or by COM_FAIL_ACT_T (usually five seconds), for which PX4 holds before it returns.
_DELAYED_REACTION_GAP_S = 10.0
# A mode change or disarming is a reaction if it follows the last evidence of a failsafe within this time.
_REACTION_TIMEOUT_S, _DISARMING_TIMEOUT_S = 12.0, 3.0
# The reaction may be logged this long before the first evidence of the failsafe.
_EARLY_MODE_CHANGE_S, _EARLY_DISARMING_S = 2.5, 0.5
# Evidence of a failsafe counts from this long before arming until this long after disarming.
_BEFORE_ARMING_S, _AFTER_DISARMING_S = 1.0, 2.0
# A failsafe is shown with values that were measured in this time before it.
_BEFORE_S = 10.0
# Of the status texts before a failsafe, the last few are shown. Texts less than _TEXT_GAP_S before it are left out.
_TEXTS_BEFORE_S, _TEXT_GAP_S, _MAX_TEXTS = 15.0, 0.05, 4
# A mode change within this time after a failsafe is attributed to the autopilot, even if the log has no cause.
_AUTOPILOT_REACTION_S = 3.0
# The kinds of failsafes (crashes and failures) at which autopilots disarm.
CRASH_KINDS: frozenset[str] = frozenset(("crash", "thrust", "motor", "termination"))


class Failsafe(Snapshot):
    """A failsafe or, if ``acted`` is False, a warning to which the autopilot may not have reacted."""

    time_s: float
    kind: str
    """The kind of failsafe, a key of `KINDS`."""
    acted: bool
    """True if the autopilot reacted: it changed the mode, disarmed, or reported an action."""
    evidence: tuple[FailsafeEvidence, ...]
    reaction: str
    """Description of the autopilot's reaction."""
    context: tuple[str, ...]
    """Descriptions of the values before the failsafe and of the configured limits."""

    @property
    def title(self) -> str:
        """Title of the kind."""
        return KINDS[self.kind]


KINDS = {
    "battery": "Battery",
    "fence": "Fence",
    "radio": "Radio control lost",
    "ground station": "Ground station lost",
    "estimator": "Position or attitude estimator",
    "gps": "Satellite receiver",
    "compass": "Compass",
    "vibration": "Vibration",
    "crash": "Crash or loss of control",
    "thrust": "Thrust loss",
    "motor": "Motor failure",
    "terrain": "Terrain data",
    "avoidance": "Avoidance",
    "offboard": "Offboard set-points lost",
    "mission": "Mission",
    "mode": "Mode change refused",
    "take-off": "Take-off",
    "transition": "Transition",
    "termination": "Termination",
    "leak": "Leak",
    "depth": "Depth",
    "wind": "Wind",
    "time": "Flight time limit",
    "general": "Failsafe",
}
"""Maps the kind of a failsafe to its title in reports."""

_ACTION_PATTERN = re.compile(
    r"failsafe activated|changed to|switch|fail-?safe.*[-:] *(rtl|land|hold|brake|disarm)", re.I
)

_PX4_PREFIXES = ("BAT_", "COM_", "FD_", "GF_", "NAV_")
# Maps kinds of failsafes to the parameters for their limits and actions.
_LIMIT_PARAMETERS: dict[str, tuple[str, ...]] = {
    "battery": (
        *("BATT_LOW_VOLT", "BATT_CRT_VOLT", "BATT_LOW_TIMER", "BATT_LOW_MAH", "BATT_CRT_MAH"),
        *("BATT_FS_LOW_ACT", "BATT_FS_CRT_ACT"),
        *("BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR", "COM_LOW_BAT_ACT"),
    ),
    "fence": (
        *("FENCE_ENABLE", "FENCE_TYPE", "FENCE_RADIUS", "FENCE_ALT_MAX", "FENCE_ALT_MIN", "FENCE_MARGIN"),
        "FENCE_ACTION",
        *("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST", "GF_ACTION"),
    ),
    "radio": ("FS_THR_ENABLE", "FS_THR_VALUE", "RC_FS_TIMEOUT", "THR_FAILSAFE", "NAV_RCL_ACT", "COM_RC_LOSS_T"),
    "ground station": ("FS_GCS_ENABLE", "FS_GCS_TIMEOUT", "FS_GCS_ENABL", "NAV_DLL_ACT", "COM_DL_LOSS_T"),
    "estimator": ("FS_EKF_ACTION", "FS_EKF_THRESH", "FS_DR_ENABLE", "COM_POS_FS_EPH"),
    "gps": ("GPS_HDOP_GOOD", "EK3_SRC1_POSXY", "COM_POS_FS_EPH"),
    "vibration": ("FS_VIBE_ENABLE",),
    "crash": ("FS_CRASH_CHECK", "FD_FAIL_R", "FD_FAIL_P"),
    "offboard": ("COM_OF_LOSS_T", "COM_OBL_RC_ACT"),
}  # fmt: skip


def evidence_in_texts(texts: Iterable[LoggedText]) -> list[FailsafeEvidence]:
    evidence = []
    for text in texts:
        kind = failsafe_kind(text.text)
        if kind is not None:
            is_action = bool(_ACTION_PATTERN.search(text.text))
            evidence.append(FailsafeEvidence(text.time_s, kind, f"text: {text.text}", is_action))
    return evidence


def evidence_in_fixes(flight: FlightLog) -> list[FailsafeEvidence]:
    """Return evidence for each loss of a 3D fix."""
    evidence = []
    for number, gps in flight.gps.items():
        had_fix, satellites_before = False, math.nan
        for time_s, fix_type, satellites in zip(gps.times, gps["fix_type"], gps["satellites"], strict=True):
            if math.isnan(fix_type):
                continue
            has_fix = fix_type >= GpsFixType.TYPE_3D_FIX
            if had_fix and not has_fix:
                text = f"receiver {number + 1} has no 3D fix any more"
                if not math.isnan(satellites):
                    text += f", {satellites:.0f} satellites"
                    if not math.isnan(satellites_before):
                        text += f" instead of {satellites_before:.0f}"
                evidence.append(FailsafeEvidence(time_s, "gps", text))
            had_fix, satellites_before = has_fix, satellites
    return evidence


def failsafes(flight: FlightLog) -> list[Failsafe]:
    """Return the failsafes and warnings of the armed vehicle, the oldest first.

    Those from shortly before arming or shortly after disarming are included.
    """
    groups: list[list[FailsafeEvidence]] = []
    recent_groups: list[list[FailsafeEvidence]] = []  # the groups to which the next evidence may belong
    for evidence in flight.failsafe_evidence:
        is_near_armed = any(
            begin - _BEFORE_ARMING_S <= evidence.time_s <= end + _AFTER_DISARMING_S for begin, end in flight.armed
        )
        if not is_near_armed:
            continue
        recent_groups = [
            group for group in recent_groups if evidence.time_s - group[-1].time_s <= _DELAYED_REACTION_GAP_S
        ]
        group = next((group for group in reversed(recent_groups) if _belongs_to(evidence, group)), None)
        if group is None:
            groups.append([evidence])
            recent_groups.append(groups[-1])
        else:
            group.append(evidence)
    kinds = [_kind_of(group) for group in groups]
    return [
        _explain(flight, group, is_first_of_kind=kind not in kinds[:index])
        for index, (kind, group) in enumerate(zip(kinds, groups, strict=True))
    ]


def _belongs_to(evidence: FailsafeEvidence, group: Sequence[FailsafeEvidence]) -> bool:
    group_kind, gap_s = _kind_of(group), evidence.time_s - group[-1].time_s
    if "general" in (group_kind, evidence.kind):
        # Without satellites, autopilots continue with dead reckoning before they react. PX4 announces "entering Hold
        # for 5 seconds" before its reaction.
        is_reaction_delayed = group_kind == "gps" or "entering Hold" in group[-1].text
        return gap_s <= (_DELAYED_REACTION_GAP_S if is_reaction_delayed else _GENERAL_GAP_S)
    if (group_kind, evidence.kind) == ("gps", "estimator"):  # The estimator fails because the satellites are missing.
        return gap_s <= _DELAYED_REACTION_GAP_S
    return group_kind == evidence.kind and gap_s <= _SAME_KIND_GAP_S


def _kind_of(group: Sequence[FailsafeEvidence]) -> str:
    return next((evidence.kind for evidence in group if evidence.kind != "general"), "general")


def _explain(flight: FlightLog, group: Sequence[FailsafeEvidence], *, is_first_of_kind: bool) -> Failsafe:
    kind, time_s = _kind_of(group), group[0].time_s
    reaction = _mode_change_after(flight, group) or _disarming_after(flight, group)
    is_sure = reaction is not None and reaction.is_sure
    acted = is_sure or any(evidence.is_action for evidence in group)
    context_of_kind = _CONTEXTS.get(kind, _general_context)
    facts = [*_location(flight, time_s), *context_of_kind(flight, time_s)]
    parameters = _limit_parameters(flight, kind, time_s)
    if not parameters and is_first_of_kind:
        parameters = _missing_parameters(flight, kind)
    facts += parameters
    facts += _texts_before(flight, time_s)
    if reaction is not None:
        reaction_text = reaction.text
    else:
        reaction_text = "the autopilot reported an action" if acted else "no reaction was logged"
    return Failsafe(time_s, kind, acted, evidence=tuple(group), reaction=reaction_text, context=tuple(facts))


class _Reaction(NamedTuple):
    text: str
    is_sure: bool  # True if the reaction certainly came from the autopilot


def _mode_change_after(flight: FlightLog, group: Sequence[FailsafeEvidence]) -> _Reaction | None:
    time_s, last_s = group[0].time_s, group[-1].time_s
    for change in flight.modes:
        is_near = time_s - _EARLY_MODE_CHANGE_S <= change.time_s <= last_s + _REACTION_TIMEOUT_S
        # Some autopilots always change the mode after disarming. Such a change is no reaction to a failsafe.
        was_armed = any(begin <= change.time_s < end for begin, end in flight.armed)
        was_commanded = change.by_autopilot is False  # `by_autopilot` is None if the log does not contain the cause
        previous_mode = flight.mode_at(change.time_s - 1e-6)  # just before the change
        if is_near and was_armed and not was_commanded and previous_mode:
            # If the log lacks the cause, an early change counts as the autopilot's. A later one may be the pilot's.
            is_sure = change.by_autopilot is True or change.time_s - last_s <= _AUTOPILOT_REACTION_S
            cause = "" if is_sure else "; cause not logged"
            return _Reaction(_mode_change_text(change, previous_mode, time_s) + cause, is_sure)
    return None


def _disarming_after(flight: FlightLog, group: Sequence[FailsafeEvidence]) -> _Reaction | None:
    time_s, until_s = group[0].time_s, group[-1].time_s + _DISARMING_TIMEOUT_S
    disarmed_s = next((end for _, end in flight.armed if time_s - _EARLY_DISARMING_S <= end <= until_s), None)
    # A span of `flight.armed` that ends with the log does not end with a disarming.
    if disarmed_s is None or disarmed_s >= flight.duration_s:
        return None
    # Disarming counts as the autopilot's reaction only after evidence of a crash.
    is_sure = _kind_of(group) in CRASH_KINDS
    cause = "" if is_sure else "; cause not logged"
    return _Reaction(f"disarmed {max(disarmed_s - time_s, 0):.1f} s later{cause}", is_sure)


def _mode_change_text(change: ModeChange, previous_mode: str, time_s: float) -> str:
    delay_s = change.time_s - time_s
    when = "immediately" if delay_s < 0.5 else f"{delay_s:.1f} s later"
    reason = f" ({change.reason})" if change.reason else ""
    return f"mode {previous_mode} → {change.name} {when}{reason}"


def _location(flight: FlightLog, time_s: float) -> list[str]:
    facts = []
    height = flight.track.at("altitude_relative_m", time_s)
    if not math.isnan(height):
        facts.append(f"{height:.1f} m above home")
    distance = distance_from_home_m(flight, time_s)
    if distance is not None:
        facts.append(f"{distance:.0f} m from home")
    mode = flight.mode_at(time_s - 0.5)  # before the failsafe changed the mode
    if mode:
        facts.append(f"in {mode}")
    return [", ".join(facts)] if facts else []


def distance_from_home_m(flight: FlightLog, time_s: float) -> float | None:
    latitude, longitude = flight.track.at("latitude_deg", time_s), flight.track.at("longitude_deg", time_s)
    if flight.home is None or math.isnan(latitude):
        return None
    plane = TangentPlane(flight.home.latitude_deg, flight.home.longitude_deg)
    return math.hypot(*plane.metres(latitude, longitude))


# Each of the following functions describes the values that may explain a failsafe at `time_s`.


def _battery_context(flight: FlightLog, time_s: float) -> list[str]:
    facts = []
    for number, battery in sorted(flight.batteries.items()):
        voltage = battery.at("voltage_v", time_s)
        if math.isnan(voltage):
            continue
        text = f"{battery_name(number)}: {voltage:.2f} V"
        earlier_voltage = battery.at("voltage_v", time_s - 60, max_age_s=30)
        if not math.isnan(earlier_voltage):
            text += f", {earlier_voltage:.2f} V one minute before"
        for name, template in (
            ("current_a", "{:.1f} A"),
            ("remaining_percent", "{:.0f} % left"),
            ("used_mah", "{:.0f} mAh used"),
        ):
            value = battery.at(name, time_s)
            if not math.isnan(value):
                text += f", {template.format(value)}"
        facts.append(text)
    return facts


def _fence_context(flight: FlightLog, time_s: float) -> list[str]:
    velocity = flight.velocity
    climb = -velocity.at("down_m_s", time_s)
    speed = math.hypot(velocity.at("north_m_s", time_s), velocity.at("east_m_s", time_s))
    return [] if math.isnan(speed) else [f"moving at {speed:.1f} m/s, climbing at {climb:.1f} m/s"]


def _estimator_context(flight: FlightLog, time_s: float) -> list[str]:
    maxima = {name: _max_before(flight.estimator, name, time_s) for name in flight.estimator}
    ratios = [f"{name.replace('_', ' ')} {value:.2f}" for name, value in maxima.items() if value is not None]
    facts = []
    if ratios:
        facts.append(f"highest ratios in the {_BEFORE_S:.0f} s before (above 1: rejected): {', '.join(ratios)}")
    return facts + _gps_context(flight, time_s) + _vibration_context(flight, time_s)


def _gps_context(flight: FlightLog, time_s: float) -> list[str]:
    facts = []
    for number, gps in sorted(flight.gps.items()):
        satellites, fix_type = gps.at("satellites", time_s), gps.at("fix_type", time_s)
        if math.isnan(satellites) and math.isnan(fix_type):
            continue
        values = (
            (satellites, "{:.0f} satellites"),
            (fix_type, "fix type {:.0f}"),
            (gps.at("hdop", time_s), "HDOP {:.1f}"),
        )
        known_texts = [template.format(value) for value, template in values if not math.isnan(value)]
        text = f"receiver {number + 1}: {', '.join(known_texts)}"
        earlier_satellites = gps.at("satellites", time_s - _BEFORE_S)
        if not math.isnan(earlier_satellites):
            text += f"; {earlier_satellites:.0f} satellites {_BEFORE_S:.0f} s before"
        facts.append(text)
    return facts


def _vibration_context(flight: FlightLog, time_s: float) -> list[str]:
    maxima = [_max_before(flight.vibration, f"{axis}_m_s2", time_s) for axis in "xyz"]
    levels = [level for level in maxima if level is not None]
    return [f"vibration up to {max(levels):.0f} m/s² in the {_BEFORE_S:.0f} s before"] if levels else []


def _link_context(flight: FlightLog, time_s: float) -> list[str]:
    facts = []
    lost_percent = _max_before(flight.link, "lost_percent", time_s)
    if lost_percent is not None:
        facts.append(f"up to {lost_percent:.0f} % of the messages lost in the {_BEFORE_S:.0f} s before")
    for name in ("rssi", "remote_rssi"):
        value = flight.radio.at(name, time_s)
        if not math.isnan(value):
            facts.append(f"radio: {name.replace('_', ' ')} {value:.0f}")
    return facts


def _ground_station_context(flight: FlightLog, time_s: float) -> list[str]:
    heartbeats = [heartbeat for heartbeat in flight.gcs_heartbeats if heartbeat <= time_s]
    if not heartbeats:
        return _link_context(flight, time_s)
    text = f"last logged ground station heartbeat {time_s - heartbeats[-1]:.1f} s before"
    return [text, *_link_context(flight, time_s)]


def _attitude_context(flight: FlightLog, time_s: float) -> list[str]:
    facts = []
    for name in ("roll_deg", "pitch_deg"):
        angles = flight.attitude.between(name, time_s - 3, time_s)
        if len(angles):
            maximum = max(angles, key=abs)
            setpoint = flight.attitude_target.at(name, time_s, max_age_s=2)
            text = f"{name.removesuffix('_deg')} up to {maximum:.0f}° in the 3 s before"
            if not math.isnan(setpoint):
                text += f", set-point {setpoint:.0f}°"
            facts.append(text)
    return facts + _vibration_context(flight, time_s)


def _offboard_context(flight: FlightLog, time_s: float) -> list[str]:
    ages = []
    for setpoints in (flight.position_target, flight.velocity_target):
        last_row = setpoints.index_at(time_s)
        if last_row >= 0:
            ages.append(time_s - setpoints.times[last_row])
    return [f"last logged set-point {min(ages):.1f} s before"] if ages else []


def _general_context(flight: FlightLog, time_s: float) -> list[str]:
    return [*_battery_context(flight, time_s), *_gps_context(flight, time_s), *_link_context(flight, time_s)]


_CONTEXTS: dict[str, Callable[[FlightLog, float], list[str]]] = {
    "battery": _battery_context,
    "fence": _fence_context,
    "radio": _link_context,
    "ground station": _ground_station_context,
    "estimator": _estimator_context,
    "gps": _gps_context,
    "compass": _estimator_context,
    "vibration": _vibration_context,
    "crash": _attitude_context,
    "thrust": _attitude_context,
    "motor": _attitude_context,
    "offboard": _offboard_context,
    "mode": lambda flight, time_s: [],
}


def _max_before(series: TimeSeries, name: str, time_s: float) -> float | None:
    values = series.between(name, time_s - _BEFORE_S, time_s)
    return max(values) if len(values) else None


def _limit_parameters(flight: FlightLog, kind: str, time_s: float) -> list[str]:
    values = ((name, flight.parameter_at(name, time_s)) for name in failsafe_parameters(flight, kind))
    known_texts = [_parameter_text(flight, name, value) for name, value in values if not math.isnan(value)]
    return [f"parameters: {', '.join(known_texts)}"] if known_texts else []


def _parameter_text(flight: FlightLog, name: str, value: float) -> str:
    action = failsafe_action(flight.vehicle, name, value)
    return f"{name} = {value:g} ({action})" if action else f"{name} = {value:g}"


def _missing_parameters(flight: FlightLog, kind: str) -> list[str]:
    names = failsafe_parameters(flight, kind)
    return [f"parameters to look at, which the log does not contain: {', '.join(names)}"] if names else []


def failsafe_parameters(flight: FlightLog, kind: str) -> list[str]:
    """Return the names of the parameters that configure this kind of failsafe."""
    names = _LIMIT_PARAMETERS.get(kind, ())
    if flight.autopilot == "PX4":
        return [name for name in names if name.startswith(_PX4_PREFIXES)]
    if flight.autopilot == "ArduPilot":
        return [name for name in names if not name.startswith(_PX4_PREFIXES)]
    return list(names)


def _texts_before(flight: FlightLog, time_s: float) -> list[str]:
    texts = [text for text in flight.texts if time_s - _TEXTS_BEFORE_S <= text.time_s < time_s - _TEXT_GAP_S]
    return [f"text {time_s - text.time_s:.1f} s before: {text.text}" for text in texts[-_MAX_TEXTS:]]
