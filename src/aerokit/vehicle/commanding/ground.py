"""Distinguishes a landing from a fall. After both, the vehicle is on the ground."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit.vehicle.commanding.progress import FALL_SINK_M_S, HIT_GROUND, POSITION_MAX_AGE_S
from aerokit.vehicle.state.telemetry import altitude_amsl

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.vehicle.session.session import VehicleSession
    from aerokit.vehicle.state.telemetry import Telemetry

SETTLING_S, SETTLED_M_S = 0.5, 2.0
"""A vehicle on the ground, even on a ship, moves up or down slower than SETTLED_M_S for at least SETTLING_S seconds.

A vehicle whose motors stop while it climbs is slower than SETTLED_M_S for 0.4 s at most.
"""

STANDING_S, STANDING_M = 5.0, 2.0
"""A vehicle reported on the ground is there if its height changes by at most STANDING_M metres in STANDING_S seconds.

This applies whatever velocity the vehicle reports, because the velocity may be wrong.
"""

IMPACT_M_S = 6.0
"""A vehicle that sinks this fast right before it stops does not land, but falls.

Autopilots descend at 5 m/s at most, and slow down before the touchdown.
"""

IMPACT_STOP_S = 0.7
"""A vehicle that sinks at ``IMPACT_M_S`` and stops within this many seconds has hit the ground.

Autopilots need longer to brake.
"""

MAX_INTERVAL_S = 3.5
"""After a longer interval between two velocities, nothing is known about what happened in between."""

STILL_M_S = 1.0
"""A vehicle that moves up or down slower than this has stopped."""

VELOCITY_MAX_AGE_S = 4.0
"""Maximum age in seconds of a velocity that describes the present movement."""

IMPACT_HEIGHT_M = 3.0
"""If the height changes by this distance after a sudden stop, the stop was not on the ground."""

MIN_DROP_M = 1.0
"""A vehicle that has lost less height than this has not fallen: only its reported velocity has jumped.

A vehicle that falls until it sinks at ``IMPACT_M_S`` loses 1.8 m of height.
"""

MAX_SLIDE_M_S = 8.0
"""A vehicle that is faster than this over ground is not on the ground yet: a fixed wing may have levelled off."""


class ImpactDetector:
    """Detects that a vehicle hits the ground: it sinks at ``IMPACT_M_S`` or faster, and suddenly stops.

    A vehicle whose height has not decreased, or that flies on, has not hit the ground.
    """

    def __init__(self, telemetry: Telemetry) -> None:
        self._telemetry = telemetry
        # Time of the last velocity that was processed, and of the last one that was a fast descent.
        self._updated_at = -math.inf
        self._sank_fast_at = -math.inf
        # Maximum sink rate of the present or last fast descent.
        self._max_sink_m_s = 0.0
        # Sink rate before the impact (None if there was none), and altitude of the vehicle at the impact.
        self._impact_sink_m_s: float | None = None
        self._impact_altitude_m: float | None = None
        self._altitude_before_descent_m: float | None = None
        # True once the vehicle was slow over ground after the impact.
        self._has_slowed = False

    def update(self) -> None:
        """Process the vehicle's last reported velocity. Call this repeatedly."""
        cell = self._telemetry.velocity
        velocity, updated_at = cell.latest, cell.updated_at
        if velocity is None or updated_at == self._updated_at:
            return  # There is no new velocity.
        if updated_at < self._updated_at:  # The computer slept, and aerokit has moved the times of all values back.
            self._updated_at, self._sank_fast_at = updated_at, -math.inf
            return
        # An impact may be shorter than the interval between two velocities, so consecutive velocities are compared even
        # if the interval is long.
        interval_s = min(updated_at - self._updated_at, MAX_INTERVAL_S)
        max_stop_s = max(IMPACT_STOP_S, 1.5 * interval_s)
        self._updated_at = updated_at
        has_just_sunk_fast = updated_at - self._sank_fast_at <= max_stop_s
        if velocity.down_m_s >= IMPACT_M_S:
            self._on_fast_descent(velocity.down_m_s, is_continued=has_just_sunk_fast)
        elif has_just_sunk_fast and abs(velocity.down_m_s) < STILL_M_S:
            self._on_sudden_stop()
        elif _has_changed(self._impact_altitude_m, altitude_amsl(self._telemetry), IMPACT_HEIGHT_M):
            # The vehicle flies on, so it did not hit the ground.
            self._impact_sink_m_s = None
            self._impact_altitude_m = None
        # The next descent begins at the altitude of the last report without a descent.
        if velocity.down_m_s < STILL_M_S and not has_just_sunk_fast:
            self._altitude_before_descent_m = self.current_altitude()
        is_slow = math.hypot(velocity.north_m_s, velocity.east_m_s) <= MAX_SLIDE_M_S
        self._has_slowed = self._impact_sink_m_s is not None and (self._has_slowed or is_slow)

    def _on_fast_descent(self, sink_m_s: float, *, is_continued: bool) -> None:
        max_sink_before_m_s = self._max_sink_m_s if is_continued else 0.0
        self._max_sink_m_s = max(max_sink_before_m_s, sink_m_s)
        self._sank_fast_at = self._updated_at

    def _on_sudden_stop(self) -> None:
        top_m, altitude_m = self._altitude_before_descent_m, self.current_altitude()
        drop_m = None if top_m is None or altitude_m is None else top_m - altitude_m
        # A vehicle that has lost less height than MIN_DROP_M did not fall: its reported velocity was wrong.
        if drop_m is None or drop_m >= MIN_DROP_M:
            self._impact_sink_m_s = self._max_sink_m_s
            # Store even an old altitude, because only the difference from a later one shows that the vehicle flies on.
            self._impact_altitude_m = altitude_amsl(self._telemetry)

    def describe(self) -> str:
        """Return a text about the impact; empty if there was none."""
        if self._impact_sink_m_s is None or not self._has_slowed:
            return ""
        return f"{HIT_GROUND} at {self._impact_sink_m_s:.1f} m/s"

    def current_altitude(self) -> float | None:
        """Return the altitude above mean sea level in metres; None if no recent position reports it."""
        is_recent = self._telemetry.position.age <= POSITION_MAX_AGE_S
        return altitude_amsl(self._telemetry) if is_recent else None


class GroundCheck:
    """Distinguishes a vehicle on the ground from one that falls, and a landing from a fall.

    A report of ON_GROUND is not sufficient: ArduCopter and PX4 also send it when they were disarmed in the air
    (AP_Arming_Copter.cpp, MulticopterLandDetector.cpp).
    """

    def __init__(self, session: VehicleSession) -> None:
        self._session = session
        self._impact = ImpactDetector(session.telemetry)
        self._reboots_before = session.watch.reboots
        # Time of the report that the vehicle is on the ground, and altitude above sea level at that time.
        self._ground_reported_at: float | None = None
        self._ground_altitude_m: float | None = None
        # Time since which the vehicle moves up or down slower than SETTLED_M_S; infinite while it moves faster.
        self._settled_since = math.inf

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Process every velocity that arrives during a `with` block."""
        detach = self._session.telemetry.velocity.observe(lambda *_: self._impact.update())
        try:
            yield
        finally:
            detach()

    @property
    def is_reported_on_ground(self) -> bool:
        return self._ground_reported_at is not None

    def confirms(self, is_reported: bool) -> bool:
        """Return True if the vehicle is reported on the ground, has settled since, and did not fall."""
        now = self._session.connection.now()
        self._impact.update()
        if not is_reported:
            self._ground_reported_at = None
            return False
        if self._ground_reported_at is None:
            self._ground_reported_at = now
            self._settled_since = math.inf
            self._ground_altitude_m = self._impact.current_altitude()
        return self._has_settled(now) and not self._impact.describe() and not self._has_rebooted

    def failure_reason(self, in_flight: Callable[[], str | None]) -> str | None:
        """Return a text about a fall once the vehicle is reported on the ground; before that, ``in_flight()``."""
        return self.fall() if self.is_reported_on_ground else in_flight()

    def fall(self) -> str | None:
        """Return a text if the vehicle fell or is falling."""
        if self._has_rebooted:  # A reboot in flight stops the motors, and the vehicle does not report its fall.
            return "the vehicle rebooted"
        telemetry, reported_at = self._session.telemetry, self._ground_reported_at
        is_velocity_newer = reported_at is not None and telemetry.velocity.updated_at > reported_at
        if is_velocity_newer and telemetry.is_confirmed_disarmed and self._down_m_s() >= FALL_SINK_M_S:
            return f"the vehicle was disarmed in the air and sinks at {self._down_m_s():.1f} m/s"
        return self._impact.describe() or None

    @property
    def _has_rebooted(self) -> bool:
        return self._session.watch.reboots != self._reboots_before

    def _has_settled(self, now: float) -> bool:
        """Return True if the vehicle has stopped climbing or sinking."""
        velocity_at = self._session.telemetry.velocity.updated_at
        reported_at = now if self._ground_reported_at is None else self._ground_reported_at
        if now - velocity_at > VELOCITY_MAX_AGE_S:
            return True  # Without a recent velocity, the report that the vehicle is on the ground is sufficient.
        if abs(self._down_m_s()) >= SETTLED_M_S:
            self._settled_since = math.inf
            # The reported velocity may be wrong: a vehicle that reports to be on the ground stands there if its height
            # has not changed for STANDING_S. `current_altitude` is None if no new heights arrive.
            altitude_m = self._impact.current_altitude()
            is_known = altitude_m is not None and self._ground_altitude_m is not None
            is_still = is_known and not _has_changed(self._ground_altitude_m, altitude_m, STANDING_M)
            return is_still and now - reported_at >= STANDING_S
        self._settled_since = min(self._settled_since, max(velocity_at, reported_at))
        return velocity_at >= self._settled_since + SETTLING_S

    def _down_m_s(self) -> float:
        velocity = self._session.telemetry.velocity.latest
        return 0.0 if velocity is None else velocity.down_m_s


def _has_changed(before_m: float | None, now_m: float | None, min_change_m: float) -> bool:
    return before_m is not None and now_m is not None and abs(now_m - before_m) > min_change_m
