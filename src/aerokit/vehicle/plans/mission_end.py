"""``MissionEnd``: whether a mission that is being flown has come to its end, or will not any more."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavLandedState, MissionState
from aerokit.position import Position
from aerokit.vehicle.orders.helm import MODE_GRACE_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.autopilots.modes import Mode
    from aerokit.missions.item import MissionItem
    from aerokit.vehicle.orders.bridge import Bridge
    from aerokit.vehicle.orders.order import Order
    from aerokit.vehicle.plans.mission_watch import MissionWatch

__all__ = ["MissionEnd"]

LANDINGS = (MavCmd.NAV_RETURN_TO_LAUNCH, MavCmd.NAV_LAND, MavCmd.NAV_VTOL_LAND)
END_GRACE_S = 2.0
"""MISSION_CURRENT comes at 1 Hz or faster, and may be lost."""
BACK_AT_LAST_S = 300.0
"""A return may go to a rally point, which is not known here: so long after its mission is complete it is over."""


class MissionEnd:
    """The ends a mission can have.

    The vehicle says that it is complete, or has landed and disarmed at its last item. A mission that ends with a
    landing, or with a return that ends in one, ends on the ground: PX4 calls it complete when the return begins, which
    it flies in another mode. A return that does not end in a landing ends at home. Vehicles that do not tell the state
    have reached the last item.
    """

    def __init__(
        self, bridge: Bridge, watch: MissionWatch, mode: Mode, items: Sequence[MissionItem] | None
    ) -> None:
        talk = bridge.talk
        self._bridge, self._talk = bridge, talk
        self._watch, self._mode = watch, mode
        self._order = bridge.helm.newest
        last = items[-1].command if items else None
        self._ends_by_landing = last in LANDINGS
        self._stays_up = last == MavCmd.NAV_RETURN_TO_LAUNCH and not talk.autopilot.lands_after_return
        self._returns_since: float | None = None
        self._landing_modes = tuple(
            talk.autopilot.mode_for(purpose, is_vtol=talk.telemetry.is_vtol) for purpose in ("return", "land")
        )
        self._grace_until = talk.connection.now() + MODE_GRACE_S
        self._was_in_mode = False
        self._left_at: float | None = None

    def is_reached(self) -> bool:
        """Whether it is over."""
        if self._watch.is_complete:
            at_home = self._stays_up and (self._talk.autopilot.completes_at_home or self._is_back)
            return not self._ends_by_landing or self._is_down or at_home
        if self._stays_up and self._is_landing:  # ArduPlane returns in another mode, and its mission stops
            return self._is_down or self._is_back
        self._returns_since = None
        if self._talk.telemetry.is_surely_disarmed and self._is_landing:
            return True
        progress = self._watch.progress.latest
        tells_state = progress is not None and progress.state != MissionState.UNKNOWN
        return not tells_state and self._watch.last is not None and self._watch.reached == self._watch.last

    def trouble(self, order: Order | None, *, is_paused: bool) -> str | None:
        """Why it will not come to its end any more. ``order`` is the last one that was given for the mission."""
        talk, now = self._talk, self._talk.connection.now()
        if self._bridge.helm.newest not in (self._order, order):
            return "another order was given"
        is_in_mode = talk.telemetry.is_in(self._mode)
        self._was_in_mode = self._was_in_mode or is_in_mode
        if not talk.telemetry.is_surely_disarmed and (
            is_paused or is_in_mode or self._is_landing or now < self._bridge.helm.mode_settles_at
        ):
            self._left_at = None
            return None
        if self._left_at is None:  # the end of the mission may be told after what it brings about
            self._left_at = now
        if now - self._left_at < END_GRACE_S or now < self._grace_until:
            return None
        if talk.telemetry.is_surely_disarmed:
            return f"the vehicle is not armed, {self.describe()}"
        if self._was_in_mode:
            return f"the mode changed to {talk.telemetry.mode_name}, {self.describe()}"
        return f"the vehicle does not fly its mission, it is in {talk.telemetry.mode_name}"

    def describe(self) -> str:
        """How far it is."""
        current, count = self._watch.current.latest, self._watch.count.latest
        where = "before its first item" if current is None else f"at item {current}"
        return f"{where} of {'?' if count is None else count}"

    @property
    def _is_landing(self) -> bool:
        """Whether it has left the mission's mode for that of its last item."""
        mode = self._talk.telemetry.mode.latest
        current, last = self._watch.current.latest, self._watch.last
        return (
            self._ends_by_landing and current is not None and current == last and mode in self._landing_modes
        )

    @property
    def _is_back(self) -> bool:
        """At home, or wherever else it has gone to in ``BACK_AT_LAST_S`` seconds."""
        talk, now = self._talk, self._talk.connection.now()
        if self._returns_since is None:
            self._returns_since = now
        home = talk.telemetry.home.latest
        place = None if home is None else Position(home.latitude_deg, home.longitude_deg)
        is_near = (
            place is not None and self._bridge.where.distance_to(place) <= talk.autopilot.arrival_radius_m
        )
        return is_near or now - self._returns_since > BACK_AT_LAST_S

    @property
    def _is_down(self) -> bool:
        landed = self._talk.telemetry.landed_state.latest
        return self._talk.telemetry.is_surely_disarmed or landed == MavLandedState.ON_GROUND
