"""Keeping a simulated ArduPilot within its fence: which limits hold, when one is passed, and who is told."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    FenceBreach,
    FenceMitigate,
    FenceType,
    MavCmd,
    MavMissionType,
    MavResult,
    MavSeverity,
)
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.commands import Command, whole
from aerokit.sim.local_frame import LocalFrame, Ned

_IN, _OUT = MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION, MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION
_CIRCLE_IN, _CIRCLE_OUT = MavCmd.NAV_FENCE_CIRCLE_INCLUSION, MavCmd.NAV_FENCE_CIRCLE_EXCLUSION
Point = tuple[float, float]


class Zones:
    """Made of the items of a stored fence; places are metres north and east in the same frame."""

    def __init__(self, items: Sequence[MissionItem], frame: LocalFrame) -> None:
        self._inside: list[PolygonZone | CircleZone] = []
        self._outside: list[PolygonZone | CircleZone] = []
        corners: list[Point] = []
        for item in items:
            place = frame.to_local(int(item.x), int(item.y))
            if item.command in (_CIRCLE_IN, _CIRCLE_OUT):
                zones = self._inside if item.command == _CIRCLE_IN else self._outside
                zones.append(CircleZone(place, item.param1))
            elif item.command in (_IN, _OUT):
                corners.append(place)
                if len(corners) == int(item.param1):
                    (self._inside if item.command == _IN else self._outside).append(PolygonZone(corners))
                    corners = []

    def __bool__(self) -> bool:
        """Whether there is any; a return point alone is none."""
        return bool(self._inside or self._outside)

    @property
    def smallest_inclusion_m(self) -> float:
        """Radius of the smallest circle to stay in; infinity without one."""
        return min((zone.radius for zone in self._inside if isinstance(zone, CircleZone)), default=math.inf)

    def breach_m(self, place: Point, *, union: bool = False) -> float:
        """Metres beyond the border; negative while all is well. ``union``: one inclusion zone is enough."""
        kept_in = [zone.outside_m(place) for zone in self._inside]
        kept_out = [-zone.outside_m(place) for zone in self._outside]
        if union and kept_in:
            kept_in = [min(kept_in)]
        return max(kept_in + kept_out, default=-math.inf)


class CircleZone:
    """A circle; its radius in metres."""

    def __init__(self, centre: Point, radius: float) -> None:
        self.radius = radius
        self._centre = centre

    def outside_m(self, place: Point) -> float:
        """Metres from the border to a place outside; negative inside."""
        return math.dist(place, self._centre) - self.radius


class PolygonZone:
    """Corners in order; the last is joined to the first."""

    def __init__(self, corners: Sequence[Point]) -> None:
        self._sides = list(zip(corners, [*corners[1:], corners[0]], strict=True))

    def outside_m(self, place: Point) -> float:
        """Metres from the border to a place outside; negative inside."""
        distance = min(_distance(place, start, end) for start, end in self._sides)
        crossings = sum(_crosses(place, start, end) for start, end in self._sides)
        return -distance if crossings % 2 else distance


def _distance(place: Point, start: Point, end: Point) -> float:
    north, east = end[0] - start[0], end[1] - start[1]
    length2 = north * north + east * east
    along = 0.0
    if length2 > 0.0:
        along = ((place[0] - start[0]) * north + (place[1] - start[1]) * east) / length2
    share = min(1.0, max(0.0, along))
    return math.dist(place, (start[0] + share * north, start[1] + share * east))


def _crosses(place: Point, start: Point, end: Point) -> bool:
    """Whether a ray to the north meets the side."""
    if (start[1] > place[1]) == (end[1] > place[1]):
        return False
    share = (place[1] - start[1]) / (end[1] - start[1])
    return place[0] < start[0] + share * (end[0] - start[0])


MAX_ALT, CIRCLE = int(FenceType.ALT_MAX), int(FenceType.CIRCLE)
POLYGON, MIN_ALT = int(FenceType.POLYGON), int(FenceType.ALT_MIN)
"""Bits of FENCE_TYPE."""

_NAMES = {MAX_ALT: "Max Alt", CIRCLE: "Circle", POLYGON: "Polygon", MIN_ALT: "Min Alt"}
_ALL = MAX_ALT | CIRCLE | POLYGON | MIN_ALT
_BACKUP_M = 20.0
"""So much farther out the next breach of the same kind counts as a new one."""
_RECOVERY_S = 10.0
_STATUS_PERIOD_S = 1.0
_UNION, _NO_MODE_CHANGE = 2, 1
_WHEN_ARMED = 3
REPORT_ONLY = 0
"""Of FENCE_ACTION, on every kind of vehicle."""
_ELSEWHERE = {"FENCE_ALT_MAX": 100.0, "FENCE_ALT_MIN": -10.0, "FENCE_AUTOENABLE": 0.0}
"""What holds for a kind that has no such parameter."""


class Fence:
    """Watches height, distance from home and the uploaded zones, armed or not; `update` is called 10 times a second.

    A breach is told with FENCE_STATUS; a kind says in `act` what else follows. This one, ArduSub's, does nothing else
    and looks only while it is armed. Not simulated: slowing down before the fence (AVOID_ENABLE).
    """

    breached: int
    breach_count: int

    PERIOD_S: ClassVar[float] = 1.0 / 3.0
    """How often it looks, at most."""
    CIRCLE_BACKUP_M: ClassVar[float] = 20.0
    """So much farther from home an old breach counts as a new one."""
    WATCHES_DISARMED: ClassVar[bool] = False
    MITIGATION: ClassVar[int] = FenceMitigate.UNKNOWN
    """What FENCE_STATUS says of slowing down before the fence; UNKNOWN by a kind that cannot."""

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self.enabled: int = 0
        """Kinds in force, whether or not they are configured."""
        self.breached = 0
        """Kinds that are passed now."""
        self.breach_count = 0
        self.breach_time_ms: int = 0
        """When the present or latest breach began, in milliseconds since boot."""
        self.caused_mode: bool = False
        """Whether the present mode is what FENCE_ACTION changed to."""
        self._switch = (0, 0)
        self._backup: dict[int, float] = {}
        self._floor_by_hand: bool | None = None
        self._recovering_since = -math.inf
        self._told_at = self._looked_at = -math.inf
        self._zones = Zones((), vehicle.frame)
        self._zones_of: list[object] = []

    @property
    def configured(self) -> int:
        """FENCE_TYPE."""
        return int(self._vehicle.parameters["FENCE_TYPE"]) & _ALL

    @property
    def present(self) -> int:
        """Kinds that are configured; a polygon only when one is uploaded."""
        return self.configured if self.zones else self.configured & ~POLYGON

    @property
    def active(self) -> int:
        return self.enabled & self.present

    @property
    def zones(self) -> Zones:
        items = self._vehicle.missions.items(MavMissionType.FENCE)
        if items != self._zones_of:
            self._zones_of = list(items)
            self._zones = Zones(items, self._vehicle.frame)
        return self._zones

    @property
    def health(self) -> tuple[bool, bool, bool]:
        """Whether it is configured, enforced, and kept, as SYS_STATUS says it."""
        present = self.present != 0
        enforced = present and self.enabled != 0 and self._vehicle.parameters["FENCE_ACTION"] != REPORT_ONLY
        return present, enforced, not (present and self.breached)

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
        kinds = whole(command.param2) or _ALL
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
        if self._value("FENCE_AUTOENABLE") == _WHEN_ARMED:
            self._floor_by_hand = None
            self.tell("auto-enabled", self.enable(True, _ALL & ~MIN_ALT, by_hand=False))

    def disarmed(self) -> None:
        """FENCE_AUTOENABLE 3 switches it off with the motors."""
        if self._value("FENCE_AUTOENABLE") == _WHEN_ARMED:
            self.tell("auto-disabled", self.enable(False, by_hand=False))

    def _follow_parameters(self) -> None:
        parameters = self._vehicle.parameters
        switch = (int(parameters["FENCE_ENABLE"]), int(self._value("FENCE_AUTOENABLE")))
        if switch != self._switch:
            self._switch = switch
            self.enabled = self.configured & ~MIN_ALT if switch[0] else 0
        self._clear(_ALL & ~self.configured)

    def update(self) -> None:
        """Look where the vehicle is and act on a new breach."""
        vehicle = self._vehicle
        self._follow_parameters()
        if not self.enabled and not self.configured & MIN_ALT:
            return
        due = vehicle.now - self._looked_at > self.PERIOD_S - 1e-6
        if not due or not (self.WATCHES_DISARMED or vehicle.is_armed):
            return
        self._looked_at, before = vehicle.now, self.breached
        new = self._check() if vehicle.navigation.home is not None else 0
        if before and not self.breached:
            self.cleared()
        if new and vehicle.is_armed and vehicle.now - self._recovering_since >= _RECOVERY_S:
            self.act(new)

    def _check(self) -> int:
        vehicle = self._vehicle
        down = vehicle.mode.is_landing or vehicle.is_landed or not vehicle.is_armed
        if down and self._floor_by_hand is not True and self.enabled & MIN_ALT:
            self.tell("auto-disabled", self.enable(False, MIN_ALT, by_hand=False))
        new = 0
        for kind, beyond in self._beyond(self._vehicle.motion.place).items():
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
        self._backup[kind] = beyond + (self.CIRCLE_BACKUP_M if kind == CIRCLE else _BACKUP_M)
        return kind

    def _beyond(self, place: Ned) -> dict[int, float]:
        """How many metres beyond each limit; negative within."""
        vehicle, parameters = self._vehicle, self._vehicle.parameters
        home = vehicle.navigation.home or (0.0, 0.0, 0.0)
        height = home[2] - place[2]
        union = bool(int(parameters["FENCE_OPTIONS"]) & _UNION)
        return {
            MAX_ALT: height - self._value("FENCE_ALT_MAX"),
            MIN_ALT: self._value("FENCE_ALT_MIN") - height,
            CIRCLE: math.dist(home[:2], place[:2]) - parameters["FENCE_RADIUS"],
            POLYGON: self.zones.breach_m(place[:2], union=union),
        }

    def _raise_floor(self) -> None:
        """The lower limit comes into force once the vehicle is well above it."""
        parameters = self._vehicle.parameters
        wanted = self.configured & MIN_ALT and self._floor_by_hand is not False
        if not wanted or self.active & MIN_ALT or not (self._switch[0] or self._switch[1] > 1):
            return
        if self._vehicle.altitude_m >= self._value("FENCE_ALT_MIN") + parameters["FENCE_MARGIN"]:
            self.enable(True, MIN_ALT, by_hand=False)
            self._vehicle.send_text(MavSeverity.NOTICE, "Min Alt fence enabled (auto enable)")

    def contains(self, place: Ned) -> bool:
        """Whether one may fly to a place."""
        return not any(self.active & kind and beyond > 0.0 for kind, beyond in self._beyond(place).items())

    def _record(self, kind: int) -> None:
        vehicle = self._vehicle
        self.breach_count += 1
        first, self.breached = not self.breached, self.breached | kind
        if first:
            self.breach_time_ms = vehicle.time_boot_ms
            if vehicle.now - self._told_at > _STATUS_PERIOD_S:
                self._told_at = vehicle.now
                if (status := self.status()) is not None:
                    vehicle.send(status)

    def _clear(self, kinds: int) -> None:
        self.breached &= ~kinds
        for kind in _NAMES:
            if kinds & kind:
                self._backup.pop(kind, None)

    def act(self, new: int) -> None:
        """A breach of these kinds has begun, and the vehicle is armed."""

    def cleared(self) -> None:
        """No limit is passed any more."""

    def refusal(self, mode: VehicleMode) -> tuple[int, str] | None:
        """Severity and text with which the fence forbids a mode; None when it does not."""
        return None

    def mode_changed(self) -> None:
        """The vehicle is in another mode now, whoever wanted it."""
        self.caused_mode = False

    def beyond_m(self, kinds: int) -> float:
        """How many metres beyond the limits of these kinds it is, the farthest counts."""
        beyond = self._beyond(self._vehicle.motion.place)
        return max(beyond[kind] for kind in _NAMES if kinds & kind)

    def forbids_modes(self) -> bool:
        """Whether FENCE_OPTIONS forbids to leave the mode that a breach has changed to."""
        forbidden = int(self._vehicle.parameters["FENCE_OPTIONS"]) & _NO_MODE_CHANGE
        return bool(forbidden and self.enabled and self.breached and self.caused_mode)

    def recover_by_hand(self) -> None:
        """Whoever changes the mode outside the fence has ten seconds before the fence acts again."""
        if self.breached:
            self._recovering_since = self._vehicle.now
            self._vehicle.info("Manual recovery started")

    def _value(self, name: str) -> float:
        parameters = self._vehicle.parameters
        return parameters[name] if name in parameters else _ELSEWHERE[name]

    def tell(self, what: str, kinds: int) -> None:
        """Say what has happened to some kinds, if there are any."""
        if kinds:
            self._vehicle.send_text(MavSeverity.NOTICE, f"{names(kinds)} {what}")

    def reason_not_to_arm(self) -> str | None:
        """What the arming checks say of the fence."""
        self._follow_parameters()
        parameters = self._vehicle.parameters
        if parameters["FENCE_ENABLE"] and not self.present:
            return "Fences enabled, but none selected"
        if not (self.enabled or self._value("FENCE_AUTOENABLE")) or not self.configured:
            return None
        if self.configured & (CIRCLE | POLYGON) and self._vehicle.navigation.home is None:
            return "Fence requires position"
        return self._bad_setting() or self._breach_reason() or self._bad_limits()

    def _bad_setting(self) -> str | None:
        parameters = self._vehicle.parameters
        radius, margin = parameters["FENCE_RADIUS"], parameters["FENCE_MARGIN"]
        checks = (
            (
                self.configured & POLYGON and self.zones.smallest_inclusion_m < margin,
                "Polygon fence margin is greater than inclusion circle radius",
            ),
            (radius < 0.0, "Invalid Circle FENCE_RADIUS value"),
            (radius < margin, "Circle FENCE_MARGIN is greater than FENCE_RADIUS"),
            (self._value("FENCE_ALT_MAX") < 0.0, "Invalid FENCE_ALT_MAX value"),
            (self._value("FENCE_ALT_MIN") < -100.0, "Invalid FENCE_ALT_MIN value"),
        )
        return next((text for failed, text in checks if failed), None)

    def _breach_reason(self) -> str | None:
        return f"Vehicle breaching {names(self.breached)}" if self.breached else None

    def _bad_limits(self) -> str | None:
        parameters = self._vehicle.parameters
        high, low = self._value("FENCE_ALT_MAX"), self._value("FENCE_ALT_MIN")
        margin = parameters["FENCE_MARGIN"]
        if margin < 0.0:
            return "Invalid FENCE_MARGIN value"
        if high < low:
            return "FENCE_ALT_MAX < FENCE_ALT_MIN"
        return "FENCE_MARGIN too big" if high - low <= 2.0 * margin else None

    def status(self) -> m.FenceStatus | None:
        """FENCE_STATUS; nothing while the fence is off."""
        if not self.enabled:
            return None
        breach = FenceBreach.NONE
        if self.breached & (CIRCLE | POLYGON):
            breach = FenceBreach.BOUNDARY
        elif self.breached & MAX_ALT:
            breach = FenceBreach.MAXALT
        elif self.breached & MIN_ALT:
            breach = FenceBreach.MINALT
        return m.FenceStatus(
            int(self.breached != 0), self.breach_count, breach, self.breach_time_ms, self.MITIGATION
        )


def names(kinds: int) -> str:
    """The kinds as the firmware joins them: Max Alt, Circle and Polygon fences."""
    words = [name for kind, name in _NAMES.items() if kinds & kind]
    text = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    return f"{text} fence" + "s" * (len(words) > 1)
