"""``Flight``: what a log tells of a flight, in one shape, whoever wrote the log."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.logs.flights.columns import Columns
from aerokit.position import Position

if TYPE_CHECKING:
    from pathlib import Path


_HOME_AFTER_ARMING_S = 2.0


class ModeChange(Snapshot):
    """The mode from then on."""

    time_s: float
    name: str
    reason: str = ""
    """Why, as far as the log tells it: ``"battery failsafe"``."""
    by_autopilot: bool | None = None
    """Whether the autopilot changed it by itself; None: the log does not tell."""


class Said(Snapshot):
    """A status text."""

    time_s: float
    severity: int | None
    """MAV_SEVERITY: 0 is an emergency, 7 is for debugging; None: not known, as in a ``.bin``."""
    text: str


class ParameterChange(Snapshot):
    """A parameter that was changed during the log."""

    time_s: float
    name: str
    before: float
    after: float


class Waypoint(Snapshot):
    """An item of the mission."""

    number: int
    command: int
    """MAV_CMD."""
    latitude_deg: float
    """NaN for items without a place, as the others are."""
    longitude_deg: float
    altitude_m: float
    frame: int
    """MAV_FRAME, which says what the altitude is above."""


class Sign(Snapshot):
    """Something that says that a failsafe acted, or that something was wrong."""

    time_s: float
    kind: str
    """A key of `aerokit.logs.flights.failsafes.KINDS`: ``"battery"``, ``"fence"`` …"""
    text: str
    """What the log says."""
    is_action: bool = False
    """Whether it says that the autopilot acted, and not just that something was wrong."""


@dataclass(slots=True)
class Flight:
    """A flight as columns and lists. Times are seconds since ``begins_at``. What the log does not tell is empty."""

    path: Path
    """The log."""
    begins_at: float = 0.0
    """UTC of the first entry, seconds since 1970; below a year where no clock told it."""
    ends_at: float = 0.0
    """UTC of the last entry."""
    vehicle: str = ""
    """Firmware with its version, as far as known: ``"ArduCopter V4.5.7"``."""
    autopilot: str = ""
    """``"ArduPilot"``, ``"PX4"``."""
    system_id: int = 1
    home: Position | None = None
    """Of the first flight in the log, as the vehicle told it; else where it was first armed."""
    track: Columns = field(
        default_factory=lambda: Columns(
            "latitude_deg", "longitude_deg", "altitude_amsl_m", "altitude_relative_m"
        )
    )
    velocity: Columns = field(default_factory=lambda: Columns("north_m_s", "east_m_s", "down_m_s"))
    attitude: Columns = field(default_factory=lambda: Columns("roll_deg", "pitch_deg", "yaw_deg"))
    air: Columns = field(default_factory=lambda: Columns("air_speed_m_s", "throttle_percent"))
    position_target: Columns = field(
        default_factory=lambda: Columns(
            "latitude_deg", "longitude_deg", "altitude_amsl_m", "altitude_relative_m"
        )
    )
    """Where it was to be."""
    velocity_target: Columns = field(default_factory=lambda: Columns("north_m_s", "east_m_s", "down_m_s"))
    attitude_target: Columns = field(default_factory=lambda: Columns("roll_deg", "pitch_deg", "yaw_deg"))
    batteries: dict[int, Columns] = field(default_factory=dict)
    """By number: ``voltage_v``, ``current_a``, ``used_mah``, ``remaining_percent``."""
    gps: dict[int, Columns] = field(default_factory=dict)
    """By number: ``fix_type`` (GPS_FIX_TYPE), ``satellites``, ``hdop``, ``accuracy_m``."""
    vibration: Columns = field(default_factory=lambda: Columns("x_m_s2", "y_m_s2", "z_m_s2", "clips"))
    """Levels, and how often an accelerometer reached its limit; of PX4, which has one level, as ``x_m_s2``."""
    estimator: Columns = field(
        default_factory=lambda: Columns(
            "velocity", "horizontal_position", "vertical_position", "compass", "height_or_airspeed"
        )
    )
    """How far measurements are from what the estimator expects: above 1 they are not believed."""
    link: Columns = field(default_factory=lambda: Columns("lost_percent", "received_hz"))
    """Each second: of what the other side sent, how much never came."""
    radio: Columns = field(default_factory=lambda: Columns("rssi", "remote_rssi", "noise", "remote_noise"))
    """In the radio's own units."""
    station: array[float] = field(default_factory=lambda: array("d"))
    """When a ground station sent a heartbeat, as far as a ``.tlog`` has what was sent."""
    modes: list[ModeChange] = field(default_factory=list)
    armed: list[tuple[float, float]] = field(default_factory=list)
    """Begin and end of each span in which it was armed."""
    texts: list[Said] = field(default_factory=list)
    signs: list[Sign] = field(default_factory=list)
    """What `aerokit.logs.flights.failsafes.failsafes` judges."""
    parameters: dict[str, float] = field(default_factory=dict)
    """As they were first told."""
    parameter_changes: list[ParameterChange] = field(default_factory=list)
    mission: list[Waypoint] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What was wrong with the log, or is missing for a reason that is known."""
    _latest: dict[str, float] = field(default_factory=dict, repr=False)

    @property
    def duration_s(self) -> float:
        """From the first entry to the last."""
        return max(self.ends_at - self.begins_at, 0.0)

    def battery(self, number: int) -> Columns:
        """The columns of a battery, made when first asked for."""
        if number not in self.batteries:
            self.batteries[number] = Columns("voltage_v", "current_a", "used_mah", "remaining_percent")
        return self.batteries[number]

    def receiver(self, number: int) -> Columns:
        """The columns of a satellite receiver, made when first asked for."""
        if number not in self.gps:
            self.gps[number] = Columns("fix_type", "satellites", "hdop", "accuracy_m")
        return self.gps[number]

    def mode_at(self, time_s: float) -> str:
        """The mode at that time, empty when it is not known."""
        return next((change.name for change in reversed(self.modes) if change.time_s <= time_s), "")

    def mode_spans(self) -> list[tuple[ModeChange, float]]:
        """Each mode, and when it ended."""
        ends = [change.time_s for change in self.modes[1:]] + [self.duration_s]
        return list(zip(self.modes, ends))  # noqa: B905 - no mode, no end

    def parameter_at(self, name: str, time_s: float) -> float:
        """The value of a parameter at that time, NaN when it is not known."""
        value = self.parameters.get(name, math.nan)
        for change in self.parameter_changes:
            if change.name == name and change.time_s <= time_s:
                value = change.after
        return value

    # ------------------------------------------------------------------------- used while a log is read

    def note_mode(self, time_s: float, name: str, reason: str = "", by_autopilot: bool | None = None) -> bool:
        """Take the mode that was told; whether it is another one than before."""
        if self.modes and self.modes[-1].name == name:
            return False
        self.modes.append(ModeChange(time_s, name, reason, by_autopilot))
        return True

    def note_armed(self, time_s: float, armed: bool) -> None:
        """Take what was told; a span that is not over ends at infinity until then."""
        is_open = bool(self.armed) and math.isinf(self.armed[-1][1])
        if armed and not is_open:
            self.armed.append((time_s, math.inf))
        elif not armed and is_open:
            self.armed[-1] = (self.armed[-1][0], time_s)

    def note_home(self, time_s: float, latitude_deg: float, longitude_deg: float, amsl_m: float) -> None:
        """Take what was told. The first flight's counts: while it is disarmed, ArduPilot's home goes along."""
        is_place = abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180 and (latitude_deg or longitude_deg)
        if not is_place:  # NaN is none, either
            return
        home = Position(latitude_deg, longitude_deg, amsl_m if math.isfinite(amsl_m) else None)
        if self.home is None or not self.armed or time_s <= self.armed[0][0] + _HOME_AFTER_ARMING_S:
            self.home = home

    def note_parameter(self, time_s: float, name: str, value: float) -> None:
        """Take a value that was told: the first one, or a change."""
        before = self._latest.get(name)
        self._latest[name] = value
        if name not in self.parameters:
            self.parameters[name] = value
            return
        before = self.parameters[name] if before is None else before
        if value != before and not (math.isnan(value) and math.isnan(before)):
            self.parameter_changes.append(ParameterChange(time_s, name, before, value))
