"""``FlightWatch``: detects crashes, and disarming without an order before a vehicle was in the air."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit.mavlink.enums import MavLandedState, MavType
from aerokit.vehicle.commanding.ground import IMPACT_M_S, STILL_M_S, ImpactDetector
from aerokit.vehicle.state.telemetry import altitude_amsl, height_above_home, is_reported_on_ground

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.vehicle.state.movement import Velocity
    from aerokit.vehicle.vehicle import Vehicle

SURFACE_TYPES = (MavType.GROUND_ROVER, MavType.SURFACE_BOAT, MavType.SUBMARINE)
DISARM_DELAY_TOLERANCE_S = 1.5
DISARM_ORDER_MAX_AGE_S = 5.0

CRASH_STILL_S = 2.0
"""A crashed vehicle does not move for this many seconds."""
CRASH_STILL_SAMPLES = 3
"""Minimum number of velocity reports in ``CRASH_STILL_S`` that show that a vehicle does not move."""
CRASH_STILL_WITHIN_S = 3.0
"""A crashed vehicle comes to rest at most this many seconds after the impact."""
CRASH_EVIDENCE_WITHIN_S = 10.0
"""Evidence of a crash must arrive within this many seconds after the impact. Later, the vehicle may have landed."""
CRASH_HEIGHT_M = 3.0
"""If a vehicle still reports that it flies, it counts as crashed only if it is less than this high above home."""
CRASH_STILL_CLIMB_M_S = 0.3
"""A vehicle that moves up or down at this speed or faster after an impact is landing or flying."""
CRASH_STILL_HEIGHT_M = 2.5
"""A vehicle that lies still may report heights that differ by this much from that at the impact. PX4's estimate jumps
by up to 2 m in the 5 s after an impact."""
CRASH_STOP_M_S2 = 20.0
"""If a vehicle still reports that it flies, it counts as crashed only if it stopped with this deceleration. Motors do
not reach it close to the ground."""
CRASH_ARMED_WITHIN_S = 30.0
"""Impacts count only if the vehicle was armed in this many seconds before. Estimates of other vehicles may jump, for
example after a reboot."""
MOVING_M_S = 2.0
"""An armed vehicle that moves at this speed after a crash flies again. At a lower speed, it must move for
``CRASH_STILL_S``."""
CLIMBED_M = 0.3
"""A vehicle flies again after a crash if it reports a take-off, and then climbs by this much."""
CRASH_LANDED_MAX_AGE_S = 3.0
"""Maximum age in seconds of a landed state that counts as evidence of a crash."""
_IN_AIR = (MavLandedState.IN_AIR, MavLandedState.TAKEOFF, MavLandedState.LANDING)


class _Disarming(NamedTuple):
    disarmed_at: float
    armed_for_s: float


class FlightWatch:
    """Detects a crash of one vehicle, and disarming without an order. Sends nothing.

    A vehicle has crashed if ``ImpactDetector`` reports an impact, and the vehicle does not move afterwards. One of
    these must also be true: the vehicle is disarmed; it reports that it is on the ground; or it is near the altitude
    of home, and the impact stopped it more abruptly than its motors could.

    The conditions are strict, because the page offers to stop the motors of a crashed vehicle.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._restart_detection()
        # The last descent at IMPACT_M_S or faster.
        self._last_sink_at = -math.inf
        self._last_sink_m_s = 0.0
        self._was_sudden_stop = False  # True if the vehicle stopped suddenly at the last impact
        self._armed_at: float | None = None  # None if the time of arming is unknown
        self._disarmed_at = -math.inf
        self._was_in_air = False  # True if the vehicle was in the air since the last arming
        self._disarm_ordered_at = -math.inf
        self._disarming: _Disarming | None = None
        self._detachments: tuple[Callable[[], None], ...] = (
            vehicle.velocity.observe(self._on_velocity, every_arrival=True),
            vehicle.armed.observe(self._on_armed),
            vehicle.landed_state.observe(self._on_landed),
        )

    def _forget_impact(self) -> None:
        self._crash: dict[str, Any] | None = None
        self._impact_at: float | None = None
        self._impact_altitude_m: float | None = None
        self._is_impact_dismissed = False  # True once the vehicle flies again or no evidence of a crash was found
        self._still_since = math.inf  # when the vehicle stopped after the impact
        self._still_samples = 0  # number of velocity reports after `_still_since`
        self._moving_since = math.inf  # when the crashed vehicle began to move
        self._take_off_altitude_m: float | None = None  # altitude at which the crashed vehicle reported a take-off

    def _restart_detection(self) -> None:
        self._forget_impact()
        self._detector = ImpactDetector(self._vehicle.telemetry)

    def close(self) -> None:
        for detach in self._detachments:
            detach()

    @property
    def crash(self) -> dict[str, Any] | None:
        """The crash: ``text``, such as "hit the ground at 11.6 m/s", and ``at_unix_s``, the time of the impact.

        It is None without a crash. It becomes None again when the vehicle flies or is armed again.
        """
        return self._crash

    @property
    def disarming(self) -> dict[str, Any] | None:
        """The last disarming; None if the vehicle had taken off, or if this server had ordered the disarming.

        ``age_s`` is the time since the disarming. ``armed_for_s`` is the time from arming to disarming. ``parameter``
        is the autopilot's parameter for automatic disarming, and ``delay_s`` its value.
        """
        if self._disarming is None:
            return None
        disarmed_at, armed_for_s = self._disarming
        delay_s = self.disarm_delay_s
        is_automatic = delay_s is not None and delay_s > 0.0 and abs(armed_for_s - delay_s) <= DISARM_DELAY_TOLERANCE_S
        return {
            "age_s": round(self._now() - disarmed_at, 1),
            "armed_for_s": round(armed_for_s, 1),
            "parameter": self.disarm_parameter,
            "delay_s": delay_s,
            "is_automatic": is_automatic,
        }

    @property
    def disarm_parameter(self) -> str | None:
        return self._vehicle.autopilot.auto_disarm_parameter

    @property
    def disarm_delay_s(self) -> float | None:
        """Delay of the automatic disarming; 0 or less if it is off, None if it has not been read."""
        known = None if self.disarm_parameter is None else self._vehicle.parameters.known(self.disarm_parameter)
        return None if known is None else float(known.value)

    def on_order(self, order: str) -> None:
        # A disarming within DISARM_ORDER_MAX_AGE_S after this order is not an automatic one.
        if order == "disarm":
            self._disarm_ordered_at = self._now()

    def _on_armed(self, was_armed: bool | None, is_armed: bool) -> None:
        now = self._now()
        if is_armed:
            # If `was_armed` is None, this is the first report, and the vehicle may have been armed long ago.
            self._armed_at = now if was_armed is False else None
            self._was_in_air = self._vehicle.landed_state.latest in _IN_AIR
            self._disarming = None
            self._restart_detection()
        elif was_armed:
            self._disarmed_at = now
            was_ordered = now - self._disarm_ordered_at <= DISARM_ORDER_MAX_AGE_S
            is_expected = self._was_in_air or was_ordered or self._crash is not None
            if self._armed_at is not None and not is_expected:
                self._disarming = _Disarming(disarmed_at=now, armed_for_s=now - self._armed_at)

    def _on_landed(self, previous_state: int | None, landed: int) -> None:
        self._was_in_air = self._was_in_air or landed in _IN_AIR
        has_taken_off = previous_state == MavLandedState.ON_GROUND and landed in _IN_AIR
        if has_taken_off and self._crash is not None and self._vehicle.armed.latest:
            # A crashed vehicle with running motors may report a take-off although it lies still. The report is believed
            # when the vehicle has climbed from its present altitude, or at once if this altitude is unknown.
            self._take_off_altitude_m = altitude_amsl(self._vehicle.telemetry)
            if self._take_off_altitude_m is None:
                self._dismiss_impact()

    def _on_velocity(self, _: Velocity | None, velocity: Velocity) -> None:
        if self._vehicle.autopilot.vehicle_type in SURFACE_TYPES:
            return
        reported_at = self._vehicle.velocity.updated_at
        self._update_impact(reported_at, velocity.down_m_s)
        if self._impact_at is None or self._is_impact_dismissed:
            return
        ground_speed_m_s, vertical_speed_m_s = velocity.ground_speed_m_s, abs(velocity.down_m_s)
        is_still = ground_speed_m_s < STILL_M_S and vertical_speed_m_s < CRASH_STILL_CLIMB_M_S
        if self._crash is None:
            self._check_crashed(reported_at, self._impact_at, is_still=is_still)
        else:
            is_fast = max(ground_speed_m_s, vertical_speed_m_s) >= MOVING_M_S
            self._check_flies_again(reported_at, is_still=is_still, is_fast=is_fast)

    def _update_impact(self, reported_at: float, down_m_s: float) -> None:
        """Start an impact when a fast descent ends suddenly. Forget it if the vehicle did not hit the ground."""
        self._detector.update()
        if down_m_s >= IMPACT_M_S:
            self._last_sink_at = reported_at
            self._last_sink_m_s = down_m_s
            return
        has_hit_ground = bool(self._detector.describe())
        # A vehicle may have a second impact, for example if it hits a tree and then falls out of it.
        is_new_impact = self._impact_at is None or self._impact_at < self._last_sink_at
        if not has_hit_ground:
            self._forget_impact()
        elif is_new_impact and self._crash is None:  # after a crash, no further impact is detected
            self._start_impact(reported_at, down_m_s)

    def _start_impact(self, reported_at: float, down_m_s: float) -> None:
        self._forget_impact()
        self._impact_at = reported_at
        self._impact_altitude_m = altitude_amsl(self._vehicle.telemetry)
        self._was_sudden_stop = self._last_sink_m_s - down_m_s >= CRASH_STOP_M_S2 * (reported_at - self._last_sink_at)
        armed = self._vehicle.armed.latest
        self._is_impact_dismissed = not armed and reported_at - self._disarmed_at > CRASH_ARMED_WITHIN_S

    def _check_flies_again(self, reported_at: float, *, is_still: bool, is_fast: bool) -> None:
        """Forget the crash if the armed vehicle moves or has climbed."""
        self._moving_since = math.inf if is_still else min(self._moving_since, reported_at)
        # A slow vehicle counts as flying only after it has moved for CRASH_STILL_S. It had to lie still for the same
        # time before it counted as crashed.
        is_moving = is_fast or reported_at - self._moving_since >= CRASH_STILL_S
        if self._vehicle.armed.latest and (is_moving or self._has_climbed):
            self._dismiss_impact()

    def _check_crashed(self, reported_at: float, impact_at: float, *, is_still: bool) -> None:
        """Record a crash if there is evidence. Dismiss the impact if the evidence is missing for too long."""
        if is_still and self._is_at_impact_height():
            self._still_since = min(self._still_since, reported_at)
            self._still_samples += 1
        elif reported_at - impact_at <= CRASH_STILL_WITHIN_S:  # the vehicle may still come to rest
            self._still_since = math.inf
            self._still_samples = 0
        else:
            self._dismiss_impact()
            return
        if reported_at - impact_at > CRASH_EVIDENCE_WITHIN_S:
            self._dismiss_impact()
        elif self._has_crashed(reported_at):
            ago_s = self._now() - impact_at
            self._crash = {
                "text": self._detector.describe(),
                "at_unix_s": round(self._vehicle.connection.unix_time() - ago_s, 1),
            }

    @property
    def _has_climbed(self) -> bool:
        altitude_m = altitude_amsl(self._vehicle.telemetry)
        if altitude_m is None or self._take_off_altitude_m is None:
            return False
        return altitude_m - self._take_off_altitude_m >= CLIMBED_M

    def _has_crashed(self, reported_at: float) -> bool:
        if reported_at - self._still_since < CRASH_STILL_S or self._still_samples < CRASH_STILL_SAMPLES:
            return False
        is_on_ground = is_reported_on_ground(self._vehicle, max_age_s=CRASH_LANDED_MAX_AGE_S)
        if self._vehicle.armed.latest is False or is_on_ground:
            return True
        height_m = height_above_home(self._vehicle.telemetry)
        return self._was_sudden_stop and height_m is not None and abs(height_m) < CRASH_HEIGHT_M

    def _is_at_impact_height(self) -> bool:
        altitude_m = altitude_amsl(self._vehicle.telemetry)
        if altitude_m is None or self._impact_altitude_m is None:
            return True
        return abs(altitude_m - self._impact_altitude_m) <= CRASH_STILL_HEIGHT_M

    def _dismiss_impact(self) -> None:
        self._is_impact_dismissed = True
        self._crash = None

    def _now(self) -> float:
        return self._vehicle.connection.now()
