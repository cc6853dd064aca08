"""Geofence of a simulated ArduPilot: limits, uploaded zones, breaches and their reports."""

from __future__ import annotations

import math
from typing import ClassVar, Generic

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import FenceBreach, FenceMitigate, FenceType, MavMissionType, MavResult, MavSeverity
from aerokit.sim.ardupilot.host import ArduPilotMode, HostT
from aerokit.sim.commands import ReceivedCommand, to_int
from aerokit.sim.missions import FenceZones
from aerokit.sim.motion import Ned

_MAX_ALT, _CIRCLE = int(FenceType.ALT_MAX), int(FenceType.CIRCLE)
_POLYGON, _MIN_ALT = int(FenceType.POLYGON), int(FenceType.ALT_MIN)
_NAMES = {_MAX_ALT: "Max Alt", _CIRCLE: "Circle", _POLYGON: "Polygon", _MIN_ALT: "Min Alt"}
_ALL = _MAX_ALT | _CIRCLE | _POLYGON | _MIN_ALT
# FENCE_STATUS reports the first of these breaches that exists.
_BREACHES = (
    (_CIRCLE | _POLYGON, FenceBreach.BOUNDARY), (_MAX_ALT, FenceBreach.MAXALT), (_MIN_ALT, FenceBreach.MINALT),
)  # fmt: skip
# Metres by which a breach must grow to count as a new breach.
_BACKUP_M = 20.0
_RECOVERY_DURATION_S = 10.0
_STATUS_INTERVAL_S = 1.0
_LOWEST_ALT_MIN_M = -100.0
_UNION, _NO_MODE_CHANGE = 2, 1  # bits of FENCE_OPTIONS
_WHEN_ARMED = 3  # value of FENCE_AUTOENABLE
_DEFAULTS = {"FENCE_ALT_MAX": 100.0, "FENCE_ALT_MIN": -10.0, "FENCE_AUTOENABLE": 0.0}

REPORT_ONLY = 0
"""Value of FENCE_ACTION that only reports a breach, on every kind of vehicle."""


class ArduPilotFence(Generic[HostT]):
    """Checks the height, the distance from home and the uploaded zones. `update` is called ten times a second.

    FENCE_STATUS reports a breach. In `act`, a subclass adds the reaction of its firmware. This class itself is the
    fence of ArduSub: it has no reaction and is checked only while armed. Braking before the fence (AVOID_ENABLE) is
    not simulated.
    """

    PERIOD_S: ClassVar[float] = 1.0 / 3.0
    """Minimum interval between two checks."""
    CIRCLE_BACKUP_M: ClassVar[float] = 20.0
    """Metres by which a breach of the circle must grow to count as a new breach."""
    MITIGATION: ClassVar[int] = FenceMitigate.UNKNOWN
    """FENCE_MITIGATE that FENCE_STATUS reports; UNKNOWN for firmwares without AVOID_ENABLE."""

    def __init__(self, vehicle: HostT) -> None:
        self.vehicle = vehicle
        self.enabled: int = 0  # Enabled kinds of fences (bits of FENCE_TYPE), including kinds that are not configured.
        self.breached: int = 0  # Kinds of fences that are breached at present.
        self.breach_count: int = 0
        self.breach_time_ms: int = 0  # Start of the present or last breach, in ms since boot.
        self.caused_mode: bool = False  # True while the present mode is the result of FENCE_ACTION.
        self._enabling_parameters = (0, 0)  # FENCE_ENABLE and FENCE_AUTOENABLE when they were read last.
        # How many metres beyond the fence a vehicle must be to cause the next breach, by kind of fence.
        self._new_breach_m: dict[int, float] = {}
        self._floor_enabled_by_command: bool | None = None  # value of the last command; None without a command
        self._recovering_since = -math.inf  # time of the last mode change during a breach
        self._reported_at = -math.inf  # time of the last FENCE_STATUS about a breach
        self._checked_at = -math.inf
        self._zones = FenceZones((), vehicle.frame)
        self._zone_items: list[object] = []  # the items from which `_zones` was made

    @property
    def action(self) -> int:
        return int(self.vehicle.parameters["FENCE_ACTION"])

    @property
    def configured(self) -> int:
        return int(self.vehicle.parameters["FENCE_TYPE"]) & _ALL

    @property
    def present(self) -> int:
        return self.configured if self.zones else self.configured & ~_POLYGON

    @property
    def active(self) -> int:
        return self.enabled & self.present

    @property
    def zones(self) -> FenceZones:
        items = self.vehicle.missions.items(MavMissionType.FENCE)
        if items != self._zone_items:
            self._zone_items = list(items)
            self._zones = FenceZones(items, self.vehicle.frame)
        return self._zones

    @property
    def health(self) -> tuple[bool, bool, bool]:
        """The three bits of the fence in SYS_STATUS: present, enabled and healthy."""
        present = self.present != 0
        enforced = present and self.enabled != 0 and self.action != REPORT_ONLY
        return present, enforced, not (present and self.breached)

    def set_enabled(self, kinds: int, *, on: bool, by_command: bool = True) -> int:
        """Enable or disable those of ``kinds`` that are configured. Return the kinds that changed.

        ``by_command`` is False for an automatic change of the firmware.
        """
        kinds &= self.configured
        if by_command and kinds & _MIN_ALT:
            self._floor_enabled_by_command = on
        previous = self.enabled
        if on:
            self.enabled |= kinds
        else:
            self.enabled &= ~kinds
            self._clear(kinds)
        return previous ^ self.enabled

    def command(self, command: ReceivedCommand) -> int:
        kinds = to_int(command.param2) or _ALL  # The value 0 selects all kinds.
        if command.param1 == 1.0:
            if not self.present & kinds:
                return MavResult.FAILED
            self.set_enabled(kinds, on=True)
        elif command.param1 == 0.0:
            self.set_enabled(kinds, on=False)
        elif command.param1 == 2.0:
            self.set_enabled(_MIN_ALT, on=False)
        else:
            return MavResult.FAILED
        return MavResult.ACCEPTED

    def on_armed(self) -> None:
        if self._parameter("FENCE_AUTOENABLE") == _WHEN_ARMED:
            self._floor_enabled_by_command = None
            self.report("auto-enabled", self.set_enabled(_ALL & ~_MIN_ALT, on=True, by_command=False))

    def on_disarmed(self) -> None:
        if self._parameter("FENCE_AUTOENABLE") == _WHEN_ARMED:
            self.report("auto-disabled", self.set_enabled(_ALL, on=False, by_command=False))

    def _follow_parameters(self) -> None:
        enable = int(self.vehicle.parameters["FENCE_ENABLE"])
        auto_enable = int(self._parameter("FENCE_AUTOENABLE"))
        if (enable, auto_enable) != self._enabling_parameters:
            self._enabling_parameters = (enable, auto_enable)
            self.enabled = self.configured & ~_MIN_ALT if enable else 0
        self._clear(_ALL & ~self.configured)

    def update(self) -> None:
        vehicle = self.vehicle
        self._follow_parameters()
        # A configured lower limit (`_MIN_ALT`) is checked even if no kind is enabled, because `_check` may enable it.
        if not self.enabled and not self.configured & _MIN_ALT:
            return
        is_due = vehicle.now - self._checked_at > self.PERIOD_S - 1e-6  # tolerates rounding errors
        is_checked = vehicle.is_armed or vehicle.KIND != "sub"  # ArduSub checks its fence only while armed.
        if not is_due or not is_checked:
            return
        self._checked_at = vehicle.now
        breached_before = self.breached
        new_breaches = self._check() if vehicle.navigation.home is not None else 0
        if breached_before and not self.breached:
            self.on_cleared()
        is_recovering = vehicle.now - self._recovering_since < _RECOVERY_DURATION_S
        if new_breaches and vehicle.is_armed and not is_recovering:
            self.act(new_breaches)

    def _check(self) -> int:
        """Return the kinds of fences with a new breach."""
        vehicle = self.vehicle
        may_be_low = vehicle.mode.is_landing or vehicle.is_landed or not vehicle.is_armed  # near the ground on purpose
        is_floor_kept = self._floor_enabled_by_command is True  # A command enabled the floor.
        if may_be_low and not is_floor_kept and self.enabled & _MIN_ALT:
            self.report("auto-disabled", self.set_enabled(_MIN_ALT, on=False, by_command=False))
        new_breaches = 0
        for kind, beyond_m in self._distances_beyond(vehicle.motion.place).items():
            if self.active & kind and self._update_breach(kind, beyond_m):
                new_breaches |= kind
        if not may_be_low:
            self._enable_floor_if_above()
        return new_breaches

    def _update_breach(self, kind: int, beyond_m: float) -> bool:
        """Record whether a limit is breached. Return True for a new breach."""
        is_on_border_of_polygon = kind == _POLYGON and beyond_m == 0.0  # The border is still allowed.
        if beyond_m < 0.0 or is_on_border_of_polygon:
            self._clear(kind)
            return False
        has_grown = kind != _POLYGON and beyond_m >= self._new_breach_m.get(kind, math.inf)
        if self.breached & kind and not has_grown:
            return False
        self._record_breach(kind)
        self._new_breach_m[kind] = beyond_m + (self.CIRCLE_BACKUP_M if kind == _CIRCLE else _BACKUP_M)
        return True

    def _distances_beyond(self, place: Ned) -> dict[int, float]:
        """Return the metres beyond the limit of each kind. They are negative within the limit."""
        parameters = self.vehicle.parameters
        home_north, home_east, home_down = self.vehicle.navigation.home or (0.0, 0.0, 0.0)
        north, east, down = place
        height = home_down - down
        union = bool(int(parameters["FENCE_OPTIONS"]) & _UNION)
        return {
            _MAX_ALT: height - self._parameter("FENCE_ALT_MAX"),
            _MIN_ALT: self._parameter("FENCE_ALT_MIN") - height,
            _CIRCLE: math.hypot(north - home_north, east - home_east) - parameters["FENCE_RADIUS"],
            _POLYGON: self.zones.breach_m((north, east), union=union),
        }

    def _enable_floor_if_above(self) -> None:
        enable, auto_enable = self._enabling_parameters
        has_floor = bool(self.configured & _MIN_ALT)
        enables_floor = enable != 0 or auto_enable > 1
        is_disabled_by_command = self._floor_enabled_by_command is False
        if not has_floor or not enables_floor or is_disabled_by_command or self.active & _MIN_ALT:
            return
        floor = self._parameter("FENCE_ALT_MIN") + self.vehicle.parameters["FENCE_MARGIN"]
        if self.vehicle.altitude_m >= floor:
            self.set_enabled(_MIN_ALT, on=True, by_command=False)
            self.vehicle.send_text(MavSeverity.NOTICE, "Min Alt fence enabled (auto enable)")

    def contains(self, place: Ned) -> bool:
        return not any(self.active & kind and beyond > 0.0 for kind, beyond in self._distances_beyond(place).items())

    def _record_breach(self, kind: int) -> None:
        vehicle = self.vehicle
        self.breach_count += 1
        was_any_breached = self.breached != 0
        self.breached |= kind
        if was_any_breached:  # Like the firmware, keep the time of the first breach (AC_Fence.cpp, record_breach).
            return
        self.breach_time_ms = vehicle.time_boot_ms
        if vehicle.now - self._reported_at > _STATUS_INTERVAL_S:
            self._reported_at = vehicle.now
            vehicle.send_built(m.FenceStatus.ID)

    def _clear(self, kinds: int) -> None:
        self.breached &= ~kinds
        for kind in _NAMES:
            if kinds & kind:
                self._new_breach_m.pop(kind, None)

    def act(self, new_breaches: int) -> None: ...

    def on_cleared(self) -> None: ...

    def refusal(self, mode: ArduPilotMode) -> tuple[int, str] | None:
        """Return (severity, text) if the fence forbids the mode, otherwise None."""
        return None

    def on_mode_changed(self) -> None:
        """Suspend the reactions to breaches for ten seconds, because the pilot recovers by hand."""
        self.caused_mode = False
        has_reactions = self.vehicle.KIND != "sub" and (self.vehicle.KIND != "copter" or self.action != REPORT_ONLY)
        if self.breached and has_reactions:
            self._recovering_since = self.vehicle.now
            self.vehicle.info("Manual recovery started")

    def beyond_m(self, kinds: int) -> float:
        """Return the largest distance beyond the limits of ``kinds``."""
        beyond = self._distances_beyond(self.vehicle.motion.place)
        return max(beyond[kind] for kind in _NAMES if kinds & kind)

    def forbids_modes(self) -> bool:
        """Return True while FENCE_OPTIONS forbids leaving the mode that a breach caused."""
        forbidden = int(self.vehicle.parameters["FENCE_OPTIONS"]) & _NO_MODE_CHANGE
        return bool(forbidden and self.enabled and self.breached and self.caused_mode)

    def _parameter(self, name: str) -> float:
        """Return a parameter, or its default if the vehicle does not have it."""
        return self.vehicle.parameters.get(name, _DEFAULTS[name])

    def report(self, event: str, kinds: int) -> None:
        if kinds:
            self.vehicle.send_text(MavSeverity.NOTICE, f"{_joined_names(kinds)} {event}")

    def reason_not_to_arm(self) -> str | None:
        self._follow_parameters()
        if self.vehicle.parameters["FENCE_ENABLE"] and not self.present:
            return "Fences enabled, but none selected"
        may_be_enabled = self.enabled or self._parameter("FENCE_AUTOENABLE")
        if not may_be_enabled or not self.configured:
            return None
        if self.configured & (_CIRCLE | _POLYGON) and self.vehicle.navigation.home is None:
            return "Fence requires position"
        return next((text for failed, text in self._arming_checks() if failed), None)

    def _arming_checks(self) -> tuple[tuple[bool, str], ...]:
        """Return (True if the check fails, text) for each check, in the order of the firmware."""
        parameters = self.vehicle.parameters
        radius, margin = parameters["FENCE_RADIUS"], parameters["FENCE_MARGIN"]
        high, low = self._parameter("FENCE_ALT_MAX"), self._parameter("FENCE_ALT_MIN")
        # Uploaded circles belong to the kind POLYGON. The kind CIRCLE is the limit of the distance from home.
        has_small_circle = bool(self.configured & _POLYGON) and self.zones.smallest_inclusion_m < margin
        breached = f"Vehicle breaching {_joined_names(self.breached)}" if self.breached else ""
        return (
            (has_small_circle, "Polygon fence margin is greater than inclusion circle radius"),
            (radius < 0.0, "Invalid Circle FENCE_RADIUS value"),
            (radius < margin, "Circle FENCE_MARGIN is greater than FENCE_RADIUS"),
            (high < 0.0, "Invalid FENCE_ALT_MAX value"),
            (low < _LOWEST_ALT_MIN_M, "Invalid FENCE_ALT_MIN value"),
            (bool(breached), breached),
            (margin < 0.0, "Invalid FENCE_MARGIN value"),
            (high < low, "FENCE_ALT_MAX < FENCE_ALT_MIN"),
            (high - low <= 2.0 * margin, "FENCE_MARGIN too big"),
        )

    def status(self) -> m.FenceStatus | None:
        if not self.enabled:
            return None
        breach = next((reason for kinds, reason in _BREACHES if self.breached & kinds), FenceBreach.NONE)
        is_breached = int(self.breached != 0)
        return m.FenceStatus(is_breached, self.breach_count, breach, self.breach_time_ms, self.MITIGATION)


def _joined_names(kinds: int) -> str:
    """Join the names of fences as the firmware does, for example "Max Alt, Circle and Polygon fences"."""
    *first_names, last_name = (name for kind, name in _NAMES.items() if kinds & kind)
    if not first_names:
        return f"{last_name} fence"
    return f"{', '.join(first_names)} and {last_name} fences"
