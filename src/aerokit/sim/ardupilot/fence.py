"""Keeping an ArduCopter within its fence: which limits hold, when one is passed, and what it does then."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CopterMode,
    FenceBreach,
    FenceMitigate,
    MavMissionType,
    MavResult,
    MavSeverity,
)
from aerokit.sim.ardupilot.fence_zones import Zones

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.copter import SimulatedCopter
    from aerokit.sim.ardupilot.navigation import Ned
    from aerokit.sim.commands import Command

__all__ = ["Fence", "fence_status"]

MAX_ALT, CIRCLE, POLYGON, MIN_ALT = 1, 2, 4, 8
"""Bits of FENCE_TYPE."""

_NAMES = {MAX_ALT: "Max Alt", CIRCLE: "Circle", POLYGON: "Polygon", MIN_ALT: "Min Alt"}
_ALL = MAX_ALT | CIRCLE | POLYGON | MIN_ALT
_BACKUP_M = 20.0
"""So much farther out the next breach of the same kind counts as a new one."""
_GIVE_UP_M = 100.0
_RECOVERY_S = 10.0
_STATUS_PERIOD_S = 1.0
_UNION, _NO_MODE_CHANGE = 2, 1
_WHEN_ARMED = 3
_REPORT_ONLY = 0
_ACTIONS: dict[int, tuple[int, ...]] = {
    1: (CopterMode.RTL, CopterMode.LAND),
    2: (CopterMode.LAND,),
    3: (CopterMode.SMART_RTL, CopterMode.RTL, CopterMode.LAND),
    4: (CopterMode.BRAKE, CopterMode.LAND),
    5: (CopterMode.SMART_RTL, CopterMode.LAND),
}


class Fence:
    """Watches height, distance from home and the uploaded zones, armed or not; `update` is called 10 times a second.

    A breach is told with "... fence breached" and FENCE_STATUS, and FENCE_ACTION follows. Not simulated:
    slowing down before the fence (AVOID_ENABLE).
    """

    def __init__(self, copter: SimulatedCopter) -> None:
        self._copter = copter
        self.enabled = 0
        """Kinds in force, whether or not they are configured."""
        self.breached = 0
        """Kinds that are passed now."""
        self.breach_count = 0
        self.breach_time_ms = 0
        """When the present or latest breach began, in milliseconds since boot."""
        self.caused_mode = False
        """Whether the present mode is what FENCE_ACTION changed to."""
        self._switch = (0, 0)
        self._backup: dict[int, float] = {}
        self._floor_by_hand: bool | None = None
        self._recovering_since = -math.inf
        self._told_at = -math.inf
        self._zones = Zones((), copter.frame)
        self._zones_of: list[object] = []

    # ---------------------------------------------------------------------------------------- state

    @property
    def configured(self) -> int:
        """FENCE_TYPE."""
        return int(self._copter.parameters["FENCE_TYPE"]) & _ALL

    @property
    def present(self) -> int:
        """Kinds that are configured; a polygon only when one is uploaded."""
        return self.configured if self.zones else self.configured & ~POLYGON

    @property
    def active(self) -> int:
        """Kinds that are configured, there, and enabled."""
        return self.enabled & self.present

    @property
    def zones(self) -> Zones:
        """What is uploaded."""
        items = self._copter.missions.items(MavMissionType.FENCE)
        if items != self._zones_of:
            self._zones_of = list(items)
            self._zones = Zones(items, self._copter.frame)
        return self._zones

    @property
    def health(self) -> tuple[bool, bool, bool]:
        """Whether it is configured, enforced, and kept, as SYS_STATUS says it."""
        present = self.present != 0
        enforced = present and self.enabled != 0 and self._copter.parameters["FENCE_ACTION"] != _REPORT_ONLY
        return present, enforced, not (present and self.breached)

    # ----------------------------------------------------------------------------------- on and off

    def enable(self, on: bool, kinds: int = _ALL, *, by_hand: bool = True) -> int:
        """Switch kinds on or off; those that changed. Only what is configured can be changed."""
        kinds &= self.configured
        if by_hand and kinds & MIN_ALT:
            self._floor_by_hand = on
        before = self.enabled
        self.enabled = before | kinds if on else before & ~kinds
        if not on:
            self._clear(kinds)
        return before ^ self.enabled

    def command(self, command: Command) -> int:
        """MAV_CMD_DO_FENCE_ENABLE."""
        kinds = int(command.param2) or _ALL
        if command.param1 == 1.0:
            if not self.present & kinds:
                return MavResult.FAILED
            self.enable(True, kinds)
        elif command.param1 in (0.0, 2.0):
            self.enable(False, kinds if command.param1 == 0.0 else MIN_ALT)
        else:
            return MavResult.FAILED
        return MavResult.ACCEPTED

    def armed(self) -> None:
        """FENCE_AUTOENABLE 3 switches it on with the motors."""
        if self._copter.parameters["FENCE_AUTOENABLE"] == _WHEN_ARMED:
            self._floor_by_hand = None
            self._tell("auto-enabled", self.enable(True, _ALL & ~MIN_ALT, by_hand=False))

    def disarmed(self) -> None:
        """FENCE_AUTOENABLE 3 switches it off with the motors."""
        if self._copter.parameters["FENCE_AUTOENABLE"] == _WHEN_ARMED:
            self._tell("auto-disabled", self.enable(False, by_hand=False))

    def _follow_parameters(self) -> None:
        parameters = self._copter.parameters
        switch = (int(parameters["FENCE_ENABLE"]), int(parameters["FENCE_AUTOENABLE"]))
        if switch != self._switch:
            self._switch = switch
            self.enabled = self.configured & ~MIN_ALT if switch[0] else 0
        self._clear(_ALL & ~self.configured)

    # --------------------------------------------------------------------------------------- checks

    def update(self) -> None:
        """Look where the vehicle is and act on a new breach."""
        self._follow_parameters()
        if not self.enabled and not self.configured & MIN_ALT:
            return
        before = self.breached
        new = self._check() if self._copter.navigation.home is not None else 0
        copter = self._copter
        if before and not self.breached and not copter.is_landed:
            copter.send_text(MavSeverity.NOTICE, "Fence breach cleared")
        if copter.now - self._recovering_since < _RECOVERY_S:
            return
        if new and copter.is_armed:
            self._act(new)

    def _check(self) -> int:
        copter = self._copter
        down = copter.mode.is_landing or copter.is_landed or not copter.is_armed
        if down and self._floor_by_hand is not True and self.enabled & MIN_ALT:
            self._tell("auto-disabled", self.enable(False, MIN_ALT, by_hand=False))
        new = 0
        for kind, beyond in self._beyond(self._place()).items():
            new |= self._judge(kind, beyond) if self.active & kind else 0
        if not down:
            self._raise_floor()
        return new

    def _judge(self, kind: int, beyond: float) -> int:
        """The kind if it is newly breached; a backup fence farther out makes an old breach a new one."""
        if beyond < 0.0 or (kind == POLYGON and beyond == 0.0):
            self._clear(kind)
            return 0
        backup = self._backup.get(kind, math.inf)
        if self.breached & kind and (kind == POLYGON or beyond < backup):
            return 0
        self._record(kind)
        self._backup[kind] = beyond + _BACKUP_M
        return kind

    def _place(self) -> Ned:
        motion = self._copter.motion
        return (motion.north, motion.east, motion.down)

    def _beyond(self, place: Ned) -> dict[int, float]:
        """How many metres beyond each limit; negative within."""
        copter, parameters = self._copter, self._copter.parameters
        home = copter.navigation.home or (0.0, 0.0, 0.0)
        height = home[2] - place[2]
        union = bool(int(parameters["FENCE_OPTIONS"]) & _UNION)
        return {
            MAX_ALT: height - parameters["FENCE_ALT_MAX"],
            MIN_ALT: parameters["FENCE_ALT_MIN"] - height,
            CIRCLE: math.dist(home[:2], place[:2]) - parameters["FENCE_RADIUS"],
            POLYGON: self.zones.breach_m(place[:2], union=union),
        }

    def _raise_floor(self) -> None:
        """The lower limit comes into force once the vehicle is well above it."""
        parameters = self._copter.parameters
        wanted = self.configured & MIN_ALT and self._floor_by_hand is not False
        if not wanted or self.active & MIN_ALT or not (self._switch[0] or self._switch[1] > 1):
            return
        if self._copter.altitude_m >= parameters["FENCE_ALT_MIN"] + parameters["FENCE_MARGIN"]:
            self.enable(True, MIN_ALT, by_hand=False)
            self._copter.send_text(MavSeverity.NOTICE, "Min Alt fence enabled (auto enable)")

    def contains(self, place: Ned) -> bool:
        """Whether one may fly to a place."""
        return not any(self.active & kind and beyond > 0.0 for kind, beyond in self._beyond(place).items())

    def _record(self, kind: int) -> None:
        copter = self._copter
        self.breach_count += 1
        first, self.breached = not self.breached, self.breached | kind
        if first:
            self.breach_time_ms = copter.time_boot_ms
            if copter.now - self._told_at > _STATUS_PERIOD_S:
                self._told_at = copter.now
                if (status := fence_status(copter)) is not None:
                    copter.send(status)

    def _clear(self, kinds: int) -> None:
        self.breached &= ~kinds
        for kind in _NAMES:
            if kinds & kind:
                self._backup.pop(kind, None)

    # -------------------------------------------------------------------------------------- actions

    def _act(self, new: int) -> None:
        copter = self._copter
        if not copter.is_landed:
            self._tell("breached", new)
        action = int(copter.parameters["FENCE_ACTION"])
        if action == _REPORT_ONLY:
            return
        beyond = self._beyond(self._place())
        if copter.is_landed:
            copter.arming.disarm()
            return
        modes = _ACTIONS.get(action, _ACTIONS[1])
        if max(beyond[kind] for kind in _NAMES if new & kind) > _GIVE_UP_M:
            modes = (CopterMode.LAND,)
        self.caused_mode = any(copter.set_mode(mode) for mode in modes)

    def holds_mode(self) -> bool:
        """Whether FENCE_OPTIONS forbids to leave the mode that a breach has changed to."""
        copter = self._copter
        forbidden = int(copter.parameters["FENCE_OPTIONS"]) & _NO_MODE_CHANGE
        in_the_air = copter.is_armed and not copter.is_landed
        return bool(forbidden and self.enabled and self.breached and self.caused_mode and in_the_air)

    def mode_changed(self) -> None:
        """Whoever changes the mode outside the fence has ten seconds before the fence acts again."""
        self.caused_mode = False
        if self.breached and self._copter.parameters["FENCE_ACTION"] != _REPORT_ONLY:
            self._recovering_since = self._copter.now
            self._copter.info("Manual recovery started")

    def _tell(self, what: str, kinds: int) -> None:
        if kinds:
            self._copter.send_text(MavSeverity.NOTICE, f"{names(kinds)} {what}")

    # --------------------------------------------------------------------------------------- arming

    def reason_not_to_arm(self) -> str | None:
        """What the arming checks say of the fence."""
        self._follow_parameters()
        parameters = self._copter.parameters
        if parameters["FENCE_ENABLE"] and not self.present:
            return "Fences enabled, but none selected"
        if not (self.enabled or parameters["FENCE_AUTOENABLE"]) or not self.configured:
            return None
        if self.configured & (CIRCLE | POLYGON) and self._copter.navigation.home is None:
            return "Fence requires position"
        return self._bad_setting() or self._breach_reason() or self._bad_limits()

    def _bad_setting(self) -> str | None:
        parameters = self._copter.parameters
        radius, margin = parameters["FENCE_RADIUS"], parameters["FENCE_MARGIN"]
        checks = (
            (
                self.configured & POLYGON and self.zones.smallest_inclusion_m < margin,
                "Polygon fence margin is greater than inclusion circle radius",
            ),
            (radius < 0.0, "Invalid Circle FENCE_RADIUS value"),
            (radius < margin, "Circle FENCE_MARGIN is greater than FENCE_RADIUS"),
            (parameters["FENCE_ALT_MAX"] < 0.0, "Invalid FENCE_ALT_MAX value"),
            (parameters["FENCE_ALT_MIN"] < -100.0, "Invalid FENCE_ALT_MIN value"),
        )
        return next((text for failed, text in checks if failed), None)

    def _breach_reason(self) -> str | None:
        return f"Vehicle breaching {names(self.breached)}" if self.breached else None

    def _bad_limits(self) -> str | None:
        parameters = self._copter.parameters
        high, low, margin = (parameters[f"FENCE_{name}"] for name in ("ALT_MAX", "ALT_MIN", "MARGIN"))
        if margin < 0.0:
            return "Invalid FENCE_MARGIN value"
        if high < low:
            return "FENCE_ALT_MAX < FENCE_ALT_MIN"
        return "FENCE_MARGIN too big" if high - low <= 2.0 * margin else None


def names(kinds: int) -> str:
    """The kinds as the firmware joins them: Max Alt, Circle and Polygon fences."""
    words = [name for kind, name in _NAMES.items() if kinds & kind]
    text = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    return f"{text} fence" + "s" * (len(words) > 1)


def fence_status(copter: SimulatedCopter) -> m.FenceStatus | None:
    """FENCE_STATUS; nothing while the fence is off."""
    fence = copter.fence
    if not fence.enabled:
        return None
    breach = FenceBreach.NONE
    if fence.breached & (CIRCLE | POLYGON):
        breach = FenceBreach.BOUNDARY
    elif fence.breached & MAX_ALT:
        breach = FenceBreach.MAXALT
    elif fence.breached & MIN_ALT:
        breach = FenceBreach.MINALT
    return m.FenceStatus(
        int(fence.breached != 0), fence.breach_count, breach, fence.breach_time_ms, FenceMitigate.NONE
    )
