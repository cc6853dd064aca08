"""Which failsafes acted in a flight, and what led to each: by texts, modes, errors, flags, and values before."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.logs.flights.columns import Plane
from aerokit.logs.flights.flight import Sign

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from aerokit.logs.flights.columns import Columns
    from aerokit.logs.flights.flight import Flight, ModeChange, Said

_TOGETHER_S = 8.0
"""Signs of one kind that follow each other so soon are of one failsafe."""
_BESIDE_S = 3.0
"""A general sign so near to a special one is of the same failsafe."""
_REACTION_S = 12.0
_BEFORE_S = 10.0
_AT_ONCE_S = 3.0
_DISARMING = frozenset(("crash", "thrust", "motor", "termination"))
"""What autopilots disarm for."""


class Failsafe(Snapshot):
    """One failsafe, or one thing that was wrong and nothing was done about."""

    time_s: float
    kind: str
    """A key of `KINDS`."""
    acted: bool
    """Whether the autopilot did something: changed the mode, disarmed, or says so."""
    signs: tuple[Sign, ...]
    reaction: str
    """What the autopilot did, in words."""
    led_to: tuple[str, ...]
    """What was measured before it, and the limits that are set, in words."""

    @property
    def title(self) -> str:
        """The kind in words."""
        return KINDS[self.kind]


KINDS = {
    "battery": "Battery",
    "fence": "Fence",
    "radio": "Radio control lost",
    "ground station": "Ground station lost",
    "estimator": "Estimator of position or attitude",
    "gps": "Satellite receiver",
    "compass": "Compass",
    "vibration": "Vibration",
    "crash": "Crash or loss of control",
    "thrust": "Thrust loss",
    "motor": "Motor failure",
    "terrain": "Terrain data",
    "avoidance": "Avoidance",
    "offboard": "Set-points of the program lost",
    "mission": "Mission",
    "mode": "Change of the mode refused",
    "take-off": "Take-off",
    "transition": "Transition",
    "termination": "Termination",
    "leak": "Leak",
    "depth": "Depth",
    "wind": "Wind",
    "time": "Time in the air",
    "general": "Failsafe",
}
"""Kinds of failsafes, and what a report calls them."""

_NO_SIGN = re.compile(
    r"clear|resolved|\boff$|prearm|pre-arm|preflight|^arm\b|arming|re-?gained|recovered|restored|compensation off"
    r"|connection .*established|fence enabled|fence disabled",
    re.I,
)
_TEXTS: tuple[tuple[re.Pattern[str], str], ...] = tuple(
    (re.compile(pattern, re.I), kind)
    for pattern, kind in (
        (r"battery.*(failsafe|is low|critical|unhealthy|emergency)", "battery"),
        (r"low battery|(critical|emergency|dangerous).*batter", "battery"),
        (r"fence.*(breach|violat)|breach.*fence|outside.*fence", "fence"),
        (r"(radio|rc|throttle|manual control).*(failsafe|lost)|no rc\b|(short|long) failsafe", "radio"),
        (r"gcs.*(failsafe|lost)|data ?link lost", "ground station"),
        (r"(connection|link) to ground.*lost|ground (control )?station.*lost", "ground station"),
        (r"ekf.*(failsafe|variance)|dead ?reckon|position estimate|navigation failure|estimator.*fail", "estimator"),
        (r"gps.*(glitch|lost|failsafe|spoof|jam)|gnss.*(stopped|spoof|not reliable|lost)", "gps"),
        (r"compass.*(error|fail|variance|inconsistent)", "compass"),
        (r"vibration", "vibration"),
        (r"crash|loss of control|attitude fail", "crash"),
        (r"thrust loss", "thrust"),
        (r"(motor|esc).*fail", "motor"),
        (r"terrain data missing|failsafe.*terrain", "terrain"),
        (r"avoid.*perform", "avoidance"),
        (r"offboard.*lost|no offboard", "offboard"),
        (r"parachute.*released|terminat", "termination"),
        (r"maximum flight time", "time"),
        (r"wind.*(limit|too)", "wind"),
        (r"fail-?safe", "general"),
    )
)  # fmt: skip
_ACTION = re.compile(
    r"failsafe activated|changed to|switch|fail-?safe.*[-:] *(rtl|land|hold|brake|disarm)", re.I
)

_LIMITS: dict[str, tuple[str, ...]] = {
    "battery": (
        *("BATT_LOW_VOLT", "BATT_CRT_VOLT", "BATT_LOW_MAH", "BATT_CRT_MAH", "BATT_FS_LOW_ACT", "BATT_FS_CRT_ACT"),
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
"""The parameters that say when a failsafe acts, and what it does."""


def signs_of_texts(texts: Iterable[Said]) -> list[Sign]:
    """What texts say of failsafes."""
    found = []
    for said in texts:
        if _NO_SIGN.search(said.text) is None:
            kind = next((kind for pattern, kind in _TEXTS if pattern.search(said.text)), None)
            if kind is not None:
                found.append(Sign(said.time_s, kind, f"said: {said.text}", bool(_ACTION.search(said.text))))
    return found


def failsafes(flight: Flight) -> list[Failsafe]:
    """The failsafes of a flight, oldest first: what was wrong while the vehicle was armed."""
    groups: list[list[Sign]] = []
    for sign in flight.signs:
        if not any(begin - 1 <= sign.time_s <= end + 2 for begin, end in flight.armed):
            continue
        group = next((each for each in reversed(groups) if _belongs(sign, each)), None)
        if group is None:
            groups.append([sign])
        else:
            group.append(sign)
    return [_explained(flight, group) for group in groups]


def _belongs(sign: Sign, group: Sequence[Sign]) -> bool:
    kind, gap = _kind(group), sign.time_s - group[-1].time_s
    if "general" in (kind, sign.kind):
        return gap <= _BESIDE_S
    return kind == sign.kind and gap <= _TOGETHER_S


def _kind(group: Sequence[Sign]) -> str:
    return next((sign.kind for sign in group if sign.kind != "general"), "general")


def _explained(flight: Flight, group: Sequence[Sign]) -> Failsafe:
    kind, time_s = _kind(group), group[0].time_s
    reaction, is_sure = _reaction(flight, time_s, group)
    acted = is_sure or any(sign.is_action for sign in group)
    facts = [*_where(flight, time_s), *_MEASURED.get(kind, _of_everything)(flight, time_s)]
    facts += _limits(flight, kind, time_s)
    facts += _texts_before(flight, time_s)
    return Failsafe(
        time_s, kind, acted, tuple(group), reaction or "no change of the mode followed", tuple(facts)
    )


def _reaction(flight: Flight, time_s: float, group: Sequence[Sign]) -> tuple[str, bool]:
    """The first change of the mode that nobody ordered, or disarming; whether that was the autopilot's doing.

    Where a log does not tell who it was, what comes at once is taken for its doing; later it may have been a pilot.
    """
    last = group[-1].time_s
    for change in flight.modes:
        if time_s - 2.5 <= change.time_s <= last + _REACTION_S and change.by_autopilot is not False:
            before = flight.mode_at(change.time_s - 1e-6)
            if before:
                is_sure = change.by_autopilot is True or change.time_s - last <= _AT_ONCE_S
                who = "" if is_sure else "; the log does not tell by whom"
                return _told(change, before, time_s) + who, is_sure
    ended = next((end for _, end in flight.armed if time_s - 0.5 <= end <= last + 3), None)
    if ended is not None and ended < flight.duration_s:
        is_sure = _kind(group) in _DISARMING
        who = "" if is_sure else "; the log does not tell by whom"
        return f"disarmed {max(ended - time_s, 0):.1f} s later{who}", is_sure
    return "", False


def _told(change: ModeChange, before: str, time_s: float) -> str:
    after = change.time_s - time_s
    when = "at once" if after < 0.5 else f"{after:.1f} s later"
    reason = f" ({change.reason})" if change.reason else ""
    return f"mode {before} → {change.name} {when}{reason}"


# ------------------------------------------------------------------------------------ what led to it


def _where(flight: Flight, time_s: float) -> list[str]:
    track, facts = flight.track, []
    height = track.at("altitude_relative_m", time_s)
    if height == height:
        facts.append(f"{height:.1f} m above home")
    distance = distance_from_home_m(flight, time_s)
    if distance is not None:
        facts.append(f"{distance:.0f} m from home")
    mode = flight.mode_at(time_s - 0.5)
    return [", ".join([*facts, *([f"in {mode}"] if mode else [])])] if facts or mode else []


def distance_from_home_m(flight: Flight, time_s: float) -> float | None:
    """Along the ground at that time; None when it is not known."""
    place = flight.track.at("latitude_deg", time_s), flight.track.at("longitude_deg", time_s)
    if flight.home is None or math.isnan(place[0]):
        return None
    return math.hypot(*Plane(flight.home.latitude_deg, flight.home.longitude_deg).metres(*place))


def _of_battery(flight: Flight, time_s: float) -> list[str]:
    facts = []
    for number, battery in sorted(flight.batteries.items()):
        now, before = battery.at("voltage_v", time_s), battery.at("voltage_v", time_s - 60, not_older_s=30)
        if now != now:
            continue
        told = f"battery {number + 1}: {now:.2f} V"
        if before == before:
            told += f", {before:.2f} V a minute before"
        for name, form in (
            ("current_a", "{:.1f} A"),
            ("remaining_percent", "{:.0f} % left"),
            ("used_mah", "{:.0f} mAh used"),
        ):
            value = battery.at(name, time_s)
            told += f", {form.format(value)}" if value == value else ""
        facts.append(told)
    return facts


def _of_fence(flight: Flight, time_s: float) -> list[str]:
    track = flight.velocity
    climb = -track.at("down_m_s", time_s)
    speed = math.hypot(track.at("north_m_s", time_s), track.at("east_m_s", time_s))
    return [f"moving at {speed:.1f} m/s, climbing at {climb:.1f} m/s"] if speed == speed else []


def _of_estimator(flight: Flight, time_s: float) -> list[str]:
    highest = {name: _most(flight.estimator, name, time_s) for name in flight.estimator}
    told = [f"{name.replace('_', ' ')} {value:.2f}" for name, value in highest.items() if value is not None]
    facts = (
        [f"worst ratios in the {_BEFORE_S:.0f} s before (1 is not believed): {', '.join(told)}"]
        if told
        else []
    )
    return facts + _of_gps(flight, time_s) + _of_vibration(flight, time_s)


def _of_gps(flight: Flight, time_s: float) -> list[str]:
    facts = []
    for number, gps in sorted(flight.gps.items()):
        satellites, fix = gps.at("satellites", time_s), gps.at("fix_type", time_s)
        before = gps.at("satellites", time_s - _BEFORE_S)
        if satellites == satellites or fix == fix:
            told = f"receiver {number + 1}: {satellites:.0f} satellites, fix type {fix:.0f}"
            hdop = gps.at("hdop", time_s)
            told += f", HDOP {hdop:.1f}" if hdop == hdop else ""
            told += f"; {before:.0f} satellites {_BEFORE_S:.0f} s before" if before == before else ""
            facts.append(told)
    return facts


def _of_vibration(flight: Flight, time_s: float) -> list[str]:
    levels = [_most(flight.vibration, f"{axis}_m_s2", time_s) for axis in "xyz"]
    known = [level for level in levels if level is not None]
    return [f"vibration up to {max(known):.0f} m/s² in the {_BEFORE_S:.0f} s before"] if known else []


def _of_link(flight: Flight, time_s: float) -> list[str]:
    lost, facts = _most(flight.link, "lost_percent", time_s), []
    if lost is not None:
        facts.append(f"up to {lost:.0f} % of the messages lost in the {_BEFORE_S:.0f} s before")
    for name in ("rssi", "remote_rssi"):
        value = flight.radio.at(name, time_s)
        if value == value:
            facts.append(f"radio: {name.replace('_', ' ')} {value:.0f}")
    return facts


def _of_station(flight: Flight, time_s: float) -> list[str]:
    heard = [each for each in flight.station if each <= time_s]
    if not heard:
        return _of_link(flight, time_s)
    told = f"the last heartbeat of a ground station in the log came {time_s - heard[-1]:.1f} s before"
    return [told, *_of_link(flight, time_s)]


def _of_attitude(flight: Flight, time_s: float) -> list[str]:
    facts = []
    for name in ("roll_deg", "pitch_deg"):
        flown = flight.attitude.between(name, time_s - 3, time_s)
        if len(flown):
            most = max(flown, key=abs)
            wanted = flight.attitude_target.at(name, time_s, not_older_s=2)
            told = f"{name[:-4]} up to {most:.0f}° in the 3 s before"
            facts.append(told + (f", {wanted:.0f}° was wanted" if wanted == wanted else ""))
    return facts + _of_vibration(flight, time_s)


def _of_offboard(flight: Flight, time_s: float) -> list[str]:
    ages = [
        time_s - columns.times[row]
        for columns in (flight.position_target, flight.velocity_target)
        if (row := columns.index_at(time_s)) >= 0
    ]
    return [f"the last set-point that the log has came {min(ages):.1f} s before"] if ages else []


def _of_everything(flight: Flight, time_s: float) -> list[str]:
    return [*_of_battery(flight, time_s), *_of_gps(flight, time_s), *_of_link(flight, time_s)]


_MEASURED: dict[str, Callable[[Flight, float], list[str]]] = {
    "battery": _of_battery,
    "fence": _of_fence,
    "radio": _of_link,
    "ground station": _of_station,
    "estimator": _of_estimator,
    "gps": _of_gps,
    "compass": _of_estimator,
    "vibration": _of_vibration,
    "crash": _of_attitude,
    "thrust": _of_attitude,
    "motor": _of_attitude,
    "offboard": _of_offboard,
    "mode": lambda flight, time_s: [],
}


def _most(columns: Columns, name: str, time_s: float) -> float | None:
    values = columns.between(name, time_s - _BEFORE_S, time_s)
    return max(values) if len(values) else None


def _limits(flight: Flight, kind: str, time_s: float) -> list[str]:
    values = ((name, flight.parameter_at(name, time_s)) for name in _LIMITS.get(kind, ()))
    told = [f"{name} = {value:g}" for name, value in values if value == value]
    return [f"set: {', '.join(told)}"] if told else []


def _texts_before(flight: Flight, time_s: float) -> list[str]:
    said = [each for each in flight.texts if time_s - 15 <= each.time_s < time_s - 0.05]
    return [f"{time_s - each.time_s:.1f} s before it said: {each.text}" for each in said[-4:]]
