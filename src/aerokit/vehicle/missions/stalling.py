"""Detection of a vehicle that has stopped in the middle of its mission."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MissionState
from aerokit.vehicle.commanding.progress import StallDetector
from aerokit.vehicle.state.telemetry import height_above_home, is_reported_on_ground

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aerokit.autopilots.modes import Mode
    from aerokit.missions.item import MissionItem
    from aerokit.vehicle.missions.context import MissionTracker
    from aerokit.vehicle.session.session import VehicleSession

MISSION_STALL_TIMEOUT_S = 60.0
"""A vehicle has stalled if it does not move for this many seconds during a mission.

The time is longer than ``STALL_TIMEOUT_S``, because obstacle avoidance and strong wind may stop a vehicle between
waypoints.
"""

GROUND_HEIGHT_M = 3.0
"""A vehicle that stands still below this height above home after a fast descent counts as fallen."""

_TAKEOFFS = (MavCmd.NAV_TAKEOFF, MavCmd.NAV_VTOL_TAKEOFF)
_WAYPOINTS = (MavCmd.NAV_WAYPOINT, MavCmd.NAV_SPLINE_WAYPOINT)


class MissionStallDetector:
    """Detects a fall, and a vehicle that does not move although its mission item requires movement.

    A fall is a fast descent that is followed at once by 12 s of standstill. It is reported on the ground, and at an
    item that requires movement. At such an item, a standstill of ``MISSION_STALL_TIMEOUT_S`` is reported even without
    a descent. A paused or disarmed vehicle is never reported.

    Items are known only after an upload or a download, and require movement only in the mission mode.
    """

    def __init__(
        self,
        session: VehicleSession,
        tracker: MissionTracker,
        mode: Mode,
        items: Sequence[MissionItem] | None,
        is_paused: Callable[[], bool],
    ) -> None:
        self._session = session
        self._tracker = tracker
        self._mode = mode
        self._items = items or ()
        self._is_paused = is_paused
        self._stall_detector = StallDetector(session)
        # The item at which the vehicle had to move at the last call; None if it was allowed to stand still.
        self._moving_item: int | None = None
        self._should_move_since = session.connection.now()

    def __call__(self) -> str | None:
        """Return a clause for an error text if the vehicle has fallen or is stuck, else None."""
        progress, current = self._tracker.progress.latest, self._tracker.current.latest
        is_paused = self._is_paused() or (progress is not None and progress.state == MissionState.PAUSED)
        if is_paused or not self._session.telemetry.is_armed:
            self._stall_detector = StallDetector(self._session)
            return None
        should_move = self._should_move(current)
        standstill = self._stall_detector()  # None unless the vehicle has stood still for 12 s
        # A standstill after a fast descent is a fall. In the air, the vehicle may instead hover at its current item.
        may_have_fallen = standstill is not None and self._stall_detector.follows_fast_descent
        if may_have_fallen and (should_move or self._is_on_ground):
            return standstill
        if not should_move or current != self._moving_item:  # The vehicle may stand still here, or has moved on.
            self._moving_item = current if should_move else None
            self._should_move_since = self._session.connection.now()
            return None
        is_late = self._session.connection.now() - self._should_move_since >= MISSION_STALL_TIMEOUT_S
        return self._stall_detector(MISSION_STALL_TIMEOUT_S) if is_late else None

    def _should_move(self, current: int | None) -> bool:
        if current is None or current >= len(self._items):
            return False
        if self._tracker.is_complete or not self._session.telemetry.is_in(self._mode):
            return False
        item = self._items[current]
        # A take-off or a waypoint without a hold requires movement.
        has_hold = item.param1 > 0  # False for NaN.
        return item.command in _TAKEOFFS or (item.command in _WAYPOINTS and not has_hold)

    @property
    def _is_on_ground(self) -> bool:
        telemetry = self._session.telemetry
        height_m = height_above_home(telemetry)
        is_low = height_m is not None and height_m < GROUND_HEIGHT_M
        return is_low or is_reported_on_ground(telemetry)
