"""`FaultInjector`: injects faults into a simulated vehicle, at once or at a simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from aerokit.errors import InvalidArgument
from aerokit.sim.faults import Faults
from aerokit.sim.motion import SimulatedWind
from aerokit.testing.stage import FlightScheduler
from aerokit.testing.track import true_point
from aerokit.testing.track_points import TrackPoint

# A function that passes the flight's scheduler to its argument, which schedules faults.
ScheduleWith = Callable[[Callable[[FlightScheduler], None]], None]


class FaultInjector:
    """Injects faults at once or after ``after_s`` simulated seconds, permanently or for ``for_s`` simulated seconds.

    If a fault is injected before the flight is opened, its times count from the opening. Scheduled faults survive a
    reboot of the vehicle. Raises InvalidArgument for a time or share out of range.
    """

    # With slots, an attempt to set an attribute of `Faults` here raises AttributeError instead of having no effect.
    __slots__ = ("_vehicle", "_with_scheduler")

    def __init__(self, vehicle: Any, schedule_with: ScheduleWith) -> None:
        self._vehicle = vehicle
        self._with_scheduler = schedule_with

    def when(self, condition: Callable[[TrackPoint], bool]) -> FaultInjector:
        """Return an injector that starts its faults when the true state of the vehicle first meets a condition.

        ``after_s`` counts from that moment. The condition is checked ten times per simulated second:
        ``faults.when(lambda point: point.altitude_m > 15).lose_gps()``.
        """

        def is_true() -> bool:
            return condition(true_point(self._vehicle))

        # `schedule` is called when the condition is first true, so the times of its faults count from then on.
        def with_scheduler_when_true(schedule: Callable[[FlightScheduler], None]) -> None:
            self._with_scheduler(lambda scheduler: scheduler.do_when(is_true, partial(schedule, scheduler)))

        return FaultInjector(self._vehicle, with_scheduler_when_true)

    @property
    def all(self) -> Faults:
        """The vehicle's `aerokit.sim.Faults`, to set faults that have no method here, such as refused commands."""
        faults: Faults = self._vehicle.faults
        return faults

    def lose_gps(self, *, after_s: float = 0.0, for_s: float | None = None) -> None:
        """Lose the GPS fix. Some seconds later, the estimator has no position any more."""
        self._set("gps_lost", True, after_s, for_s)

    def lose_rc(self, *, after_s: float = 0.0, for_s: float | None = None) -> None:
        """Switch the pilot's transmitter off."""
        self._set("rc_lost", True, after_s, for_s)

    def fail_motor(self, *, after_s: float = 0.0) -> None:
        """Stop a motor, so that the vehicle cannot fly any more."""
        self._set("motor_failed", True, after_s)

    def drop_packets(self, share: float, *, after_s: float = 0.0, for_s: float | None = None) -> None:
        """Lose a share of the packets, from 0 to 1, in both directions. The vehicle's seed determines which ones."""
        if not 0.0 <= share <= 1.0:
            raise InvalidArgument(f"share = {share!r} is not allowed: it must be 0 to 1")
        self._set("loss", share, after_s, for_s, healthy_value=0.0)
        self._set("loss_incoming", share, after_s, for_s, healthy_value=0.0)

    def go_silent(self, for_s: float | None = None, *, after_s: float = 0.0) -> None:
        """Interrupt the radio in both directions, by default until :meth:`end`. The vehicle flies on."""
        self._set("silent", True, after_s, for_s)

    def hang(self, for_s: float | None = None, *, after_s: float = 0.0) -> None:
        """Freeze the autopilot, by default until :meth:`end`. A frozen autopilot does not receive, move or send."""
        self._set("frozen", True, after_s, for_s)

    def fail_prearm(self, reason: str, *, after_s: float = 0.0, for_s: float | None = None) -> None:
        """Make an arming check fail for this reason."""
        reasons = self.all.prearm_failures
        self._schedule(partial(reasons.append, reason), after_s)
        if for_s is not None:
            self._schedule(partial(reasons.remove, reason), after_s + _duration(for_s))

    def reboot(self, *, after_s: float = 0.0) -> None:
        """Reboot the vehicle, also in flight."""
        self._schedule(self._vehicle.restart, after_s)

    def set_wind(
        self, *, north_m_s: float = 0.0, east_m_s: float = 0.0, gusts_m_s: float = 0.0, after_s: float = 0.0
    ) -> None:
        """Set the velocity of the air, in m/s. ``gusts_m_s`` is the standard deviation of gusts."""
        wind = SimulatedWind(north_m_s, east_m_s, gusts_m_s)
        self._schedule(partial(setattr, self._vehicle.motion, "wind", wind), after_s)

    def set_battery(self, percent: float, *, after_s: float = 0.0) -> None:
        """Set the remaining battery charge in percent. The battery then continues to drain."""
        if not 0.0 <= percent <= 100.0:
            raise InvalidArgument(f"percent = {percent!r} is not allowed: it must be 0 to 100")
        self._schedule(partial(setattr, self._vehicle.battery, "percent", percent), after_s)

    def end(self, *, after_s: float = 0.0) -> None:
        """End the faults of GPS, radios, motor and autopilot. Wind, battery and failing arming checks stay."""
        for name in ("gps_lost", "rc_lost", "motor_failed", "silent", "frozen"):
            self._set(name, False, after_s)
        self.drop_packets(0.0, after_s=after_s)

    def _set(
        self, name: str, value: object, after_s: float, for_s: float | None = None, *, healthy_value: object = False
    ) -> None:
        """Set an attribute of `Faults` after ``after_s`` seconds, and to ``healthy_value`` ``for_s`` seconds
        after that.
        """
        faults = self.all
        end_s = None if for_s is None else after_s + _duration(for_s)
        self._schedule(partial(setattr, faults, name, value), after_s)
        if end_s is not None:
            self._schedule(partial(setattr, faults, name, healthy_value), end_s)

    def _schedule(self, action: Callable[[], None], after_s: float) -> None:
        if not (math.isfinite(after_s) and after_s >= 0.0):
            raise InvalidArgument(f"after_s = {after_s!r} is not allowed: it must be 0 or more, and finite")
        self._with_scheduler(lambda scheduler: scheduler.do(action, after_s=after_s))


def _duration(for_s: float) -> float:
    if not for_s > 0.0:
        raise InvalidArgument(f"for_s = {for_s!r} is not allowed: it must be above 0")
    return for_s
