"""``FlightWatch``: notices that a vehicle hits the ground, or disarms without an order before it was in the air."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from aerokit.mavlink.enums import MavLandedState, MavType
from aerokit.vehicle.commanding.ground import IMPACT_M_S, STILL_M_S, ImpactDetector
from aerokit.vehicle.state.telemetry import height_above_home

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.vehicle.state.movement import Velocity
    from aerokit.vehicle.vehicle import Vehicle

SURFACE_TYPES = (MavType.GROUND_ROVER, MavType.SURFACE_BOAT, MavType.SUBMARINE)
DISARM_PARAMETERS: Mapping[str, str] = {"ArduCopter": "DISARM_DELAY", "PX4": "COM_DISARM_PRFLT"}
"""Maps firmware to the parameter with the seconds after which it disarms a vehicle that does not take off."""
DISARM_DELAY_TOLERANCE_S = 1.5
DISARM_ORDER_MAX_AGE_S = 5.0

CRASH_STILL_S, CRASH_STILL_SAMPLES = 2.0, 3
"""After an impact, a crashed vehicle does not move for this time, in at least this many reports of its velocity."""
CRASH_STILL_WITHIN_S = 3.0
"""A crashed vehicle comes to rest within this time after the impact."""
CRASH_EVIDENCE_WITHIN_S = 10.0
"""A vehicle that reports later that it is on the ground has perhaps landed there."""
CRASH_HEIGHT_M = 3.0
"""A vehicle that still reports that it flies is taken for crashed only below this height above home."""
CRASH_STILL_CLIMB_M_S = 0.3
"""A vehicle that moves up or down faster after an impact is landing, or flies."""
CRASH_STILL_HEIGHT_M = 2.5
"""PX4's estimate of the height jumps by up to 2 m in the 5 s after an impact, while the vehicle lies there."""
CRASH_STOP_M_S2 = 20.0
"""Such a vehicle must also have stopped with this deceleration, which motors do not reach close to the ground."""
CRASH_ARMED_WITHIN_S = 30.0
"""Estimates of a vehicle that has not been armed for this time may jump, for example after a reboot."""
MOVING_M_S = 2.0
_IN_AIR = (MavLandedState.IN_AIR, MavLandedState.TAKEOFF, MavLandedState.LANDING)


class FlightWatch:
    """Follows one vehicle, from its velocity, its landed state and its heartbeats. Sends nothing.

    ``crash`` is strict: a vehicle that flies must not be taken for crashed, because the page then offers to stop its
    motors. A vehicle has crashed if ``ImpactDetector`` reports an impact, the vehicle does not move afterwards, and it
    is disarmed, reports that it is on the ground, or has stopped near its home's altitude faster than motors can.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._impact = ImpactDetector(vehicle.telemetry)
        self._crash: dict[str, Any] | None = None
        self._fast_at, self._fast_m_s = -math.inf, 0.0
        self._is_over = False
        self._impact_at: float | None = None
        self._impact_height_m: float | None = None
        self._is_sudden = False
        self._still_since, self._still_samples = math.inf, 0
        self._armed_at: float | None = None
        self._armed_until = -math.inf
        self._was_in_air = False
        self._ordered_at = -math.inf
        self._disarming: tuple[float, float] | None = None
        self._stops: tuple[Callable[[], None], ...] = (
            vehicle.velocity.observe(self._on_velocity, every_arrival=True),
            vehicle.armed.observe(self._on_armed),
            vehicle.landed_state.observe(self._on_landed),
        )

    def close(self) -> None:
        """Stop following the vehicle."""
        for stop in self._stops:
            stop()

    @property
    def crash(self) -> dict[str, Any] | None:
        """``text`` (a clause with the sink rate) and ``at_unix_s`` of an impact after which the vehicle has not moved.

        None if there was none, or the vehicle was armed again or has moved since.
        """
        return self._crash

    @property
    def disarming(self) -> dict[str, Any] | None:
        """The last disarming, if the vehicle was not in the air before it and no order of this server caused it.

        ``age_s``, ``armed_for_s``, and ``parameter`` and ``delay_s``: the setting of an automatic disarming. It is
        ``is_automatic`` if it happened that long after arming.
        """
        if self._disarming is None:
            return None
        at, armed_for_s = self._disarming
        parameter = self.disarm_parameter
        known = None if parameter is None else self._vehicle.parameters.known(parameter)
        delay_s = None if known is None else float(known.value)
        return {
            "age_s": round(self._now() - at, 1),
            "armed_for_s": round(armed_for_s, 1),
            "parameter": parameter,
            "delay_s": delay_s,
            "is_automatic": bool(delay_s) and abs(armed_for_s - (delay_s or 0.0)) <= DISARM_DELAY_TOLERANCE_S,
        }

    @property
    def disarm_parameter(self) -> str | None:
        """Name of the parameter with the delay of the automatic disarming; None if the firmware has none."""
        return DISARM_PARAMETERS.get(self._vehicle.autopilot.firmware)

    def on_order(self, order: str) -> None:
        """Record that this server orders something: a disarming shortly after ``disarm`` is its effect."""
        if order == "disarm":
            self._ordered_at = self._now()

    def _on_armed(self, before: bool | None, is_armed: bool) -> None:
        now = self._now()
        if is_armed:
            # After the start of this program, it is unknown since when the vehicle has been armed.
            self._armed_at = now if before is False else None
            self._was_in_air, self._disarming = self._vehicle.landed_state.latest in _IN_AIR, None
            self._reset()
        elif before:
            self._armed_until = now
            is_ordered = now - self._ordered_at <= DISARM_ORDER_MAX_AGE_S
            if self._armed_at is not None and not self._was_in_air and not is_ordered and self._crash is None:
                self._disarming = now, now - self._armed_at

    def _on_landed(self, before: int | None, landed: int) -> None:
        self._was_in_air = self._was_in_air or landed in _IN_AIR

    def _on_velocity(self, before: Velocity | None, velocity: Velocity) -> None:
        if self._vehicle.autopilot.vehicle_type in SURFACE_TYPES:
            return
        at, down_m_s = self._vehicle.velocity.updated_at, velocity.down_m_s
        had_impact = bool(self._impact.describe())
        self._impact.update()
        if down_m_s >= IMPACT_M_S:
            self._fast_at, self._fast_m_s = at, down_m_s
        elif not self._impact.describe():
            self._forget_impact()
        elif not had_impact:
            self._begin(at, down_m_s)
        if self._impact_at is not None:
            self._follow(at, velocity.ground_speed_m_s, abs(down_m_s))

    def _begin(self, at: float, down_m_s: float) -> None:
        self._forget_impact()
        self._impact_at, self._impact_height_m = at, height_above_home(self._vehicle.telemetry)
        self._is_sudden = self._fast_m_s - down_m_s >= CRASH_STOP_M_S2 * (at - self._fast_at)
        armed = self._vehicle.armed.latest
        self._is_over = not armed and at - self._armed_until > CRASH_ARMED_WITHIN_S

    def _follow(self, at: float, ground_speed_m_s: float, climb_m_s: float) -> None:
        if self._is_over or self._impact_at is None:
            return
        if self._crash is not None:
            if self._vehicle.armed.latest and max(ground_speed_m_s, climb_m_s) >= MOVING_M_S:
                self._end()
            return
        is_still = ground_speed_m_s < STILL_M_S and climb_m_s < CRASH_STILL_CLIMB_M_S
        if is_still and self._is_at_impact_height():
            self._still_since = min(self._still_since, at)
            self._still_samples += 1
        elif at - self._impact_at <= CRASH_STILL_WITHIN_S:
            self._still_since, self._still_samples = math.inf, 0
        else:
            self._end()
            return
        if at - self._impact_at > CRASH_EVIDENCE_WITHIN_S:
            self._end()
        elif self._is_crashed(at):
            ago_s = self._now() - self._impact_at
            self._crash = {
                "text": self._impact.describe(),
                "at_unix_s": round(self._vehicle.connection.unix_time() - ago_s, 1),
            }

    def _is_crashed(self, at: float) -> bool:
        if at - self._still_since < CRASH_STILL_S or self._still_samples < CRASH_STILL_SAMPLES:
            return False
        vehicle, height_m = self._vehicle, height_above_home(self._vehicle.telemetry)
        if vehicle.armed.latest is False or vehicle.landed_state.latest == MavLandedState.ON_GROUND:
            return True
        return self._is_sudden and height_m is not None and abs(height_m) < CRASH_HEIGHT_M

    def _is_at_impact_height(self) -> bool:
        height_m = height_above_home(self._vehicle.telemetry)
        if height_m is None or self._impact_height_m is None:
            return True
        return abs(height_m - self._impact_height_m) <= CRASH_STILL_HEIGHT_M

    def _end(self) -> None:
        self._is_over, self._crash = True, None

    def _forget_impact(self) -> None:
        self._crash = self._impact_at = self._impact_height_m = None
        self._still_since, self._still_samples, self._is_over = math.inf, 0, False

    def _reset(self) -> None:
        self._forget_impact()
        self._impact = ImpactDetector(self._vehicle.telemetry)

    def _now(self) -> float:
        return self._vehicle.connection.now()
