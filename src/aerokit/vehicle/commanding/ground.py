"""Distinguishes a landing from a fall, after which the vehicle is on the ground, too."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.vehicle.commanding.progress import FALL_SINK_M_S, FALL_STOP_S, POSITION_MAX_AGE_S

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.vehicle.session.session import VehicleSession

FALL_EVIDENT_S = 0.5
"""Free fall for this time exceeds ``FALL_SINK_M_S``, also with the resistance of the air."""

IMPACT_M_S = 6.0
"""Sink rate that no landing has right before the ground: autopilots descend at 5 m/s at most, and slow down."""

STILL_M_S = 0.5


class ImpactDetector:
    """Detects that a vehicle hits the ground: it sinks at ``IMPACT_M_S`` or faster, and stops within 1.5 s."""

    def __init__(self, session: VehicleSession) -> None:
        self._session = session
        self._fast_at, self._max_sink_m_s = -math.inf, 0.0
        self._impact_m_s: float | None = None

    def update(self) -> None:
        """Evaluate the last velocity."""
        cell = self._session.telemetry.velocity
        velocity = cell.latest
        if velocity is None:
            return
        if velocity.down_m_s >= IMPACT_M_S:
            is_new = cell.updated_at - self._fast_at > FALL_STOP_S
            self._max_sink_m_s = velocity.down_m_s if is_new else max(self._max_sink_m_s, velocity.down_m_s)
            self._fast_at = cell.updated_at
        elif abs(velocity.down_m_s) >= STILL_M_S:
            self._impact_m_s = None
        elif cell.updated_at - self._fast_at <= FALL_STOP_S:
            self._impact_m_s = self._max_sink_m_s

    def text(self) -> str:
        """Return the impact as a clause; empty if there was none, or the vehicle has moved up or down since."""
        return "" if self._impact_m_s is None else f"the vehicle hit the ground at {self._impact_m_s:.1f} m/s"


class GroundCheck:
    """Distinguishes a vehicle that has landed from one that falls or has fallen.

    ArduCopter and PX4 report ON_GROUND whenever they are disarmed (AP_Arming_Copter.cpp, MulticopterLandDetector.cpp).
    """

    def __init__(self, session: VehicleSession) -> None:
        self._session = session
        self._impact = ImpactDetector(session)
        self._reported_at: float | None = None

    def confirms(self, is_reported: bool) -> bool:
        """Return True if the vehicle is reported on the ground, does not sink half a second later, and did not fall.

        If no velocity is received, the report is accepted as it is.
        """
        now, velocity = self._session.connection.now(), self._session.telemetry.velocity
        self._impact.update()
        if not is_reported:
            self._reported_at = None
            return False
        if self._reported_at is None:
            self._reported_at = now
        if now - velocity.updated_at > POSITION_MAX_AGE_S:
            return not self._impact.text()
        is_settled = velocity.updated_at >= self._reported_at + FALL_EVIDENT_S and self._sink_m_s() < FALL_SINK_M_S
        return is_settled and not self._impact.text()

    def trouble(self, before: Callable[[], str | None]) -> str | None:
        """Return a clause if a vehicle that is reported on the ground falls or fell; until then, ``before()``."""
        if self._reported_at is None:
            return before()
        telemetry = self._session.telemetry
        if telemetry.velocity.updated_at <= self._reported_at or self._sink_m_s() < FALL_SINK_M_S:
            return self._impact.text() or None
        if not telemetry.is_confirmed_disarmed:
            return None
        return f"the vehicle was disarmed in the air and sinks at {self._sink_m_s():.1f} m/s"

    def _sink_m_s(self) -> float:
        velocity = self._session.telemetry.velocity.latest
        return 0.0 if velocity is None else velocity.down_m_s
