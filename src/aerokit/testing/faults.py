"""`FaultInjector`: what goes wrong with a simulated vehicle, in readable verbs, at once or at a simulated second."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from aerokit.errors import InvalidArgument
from aerokit.sim.faults import Faults
from aerokit.sim.motion import Wind
from aerokit.sim.track import true_point
from aerokit.sim.track_points import TrackPoint
from aerokit.testing.stage import Stagehand

OnStage = Callable[[Callable[[Stagehand], None]], None]
"""Lets a stagehand plan something, as of now."""


class FaultInjector:
    """Every verb acts at once, or ``after_s`` simulated seconds from now, and, where it says so, for ``for_s``.

    Before the flight is opened, seconds count from its opening. Raises InvalidArgument for times and shares
    that make no sense. What is planned happens even if the vehicle reboots meanwhile.
    """

    def __init__(self, vehicle: Any, on_stage: OnStage) -> None:
        self._vehicle = vehicle
        self._on_stage = on_stage

    def when(self, condition: Callable[[TrackPoint], bool]) -> FaultInjector:
        """The same verbs, acting once this is true of where the vehicle is; seconds count from there.

        It is asked ten times a simulated second: ``faults.when(lambda here: here.altitude_m > 15).lose_gps()``.
        """

        def is_true() -> bool:
            return condition(true_point(self._vehicle))

        def wait(use: Callable[[Stagehand], None]) -> None:
            self._on_stage(lambda hand: hand.do_when(is_true, partial(use, hand)))

        return FaultInjector(self._vehicle, wait)

    @property
    def all(self) -> Faults:
        """Everything that can go wrong, such as refused commands; see `aerokit.sim.Faults`."""
        faults: Faults = self._vehicle.faults
        return faults

    def lose_gps(self, *, after_s: float = 0.0, for_s: float | None = None) -> None:
        """No GPS fix any more; the estimator gives its position up seconds later."""
        self._set("gps_lost", True, False, after_s, for_s)

    def lose_rc(self, *, after_s: float = 0.0, for_s: float | None = None) -> None:
        """The pilot's transmitter is off."""
        self._set("rc_lost", True, False, after_s, for_s)

    def fail_motor(self, *, after_s: float = 0.0) -> None:
        """A motor stands still: it comes down."""
        self._set("motor_failed", True, False, after_s, None)

    def drop_packets(self, share: float, *, after_s: float = 0.0, for_s: float | None = None) -> None:
        """Lose this share of the packets, 0 to 1, in both directions; the same ones for the same seed."""
        if not 0.0 <= share <= 1.0:
            raise InvalidArgument(f"share = {share!r} is not allowed: 0 to 1")
        self._set("loss", share, 0.0, after_s, for_s)
        self._set("loss_incoming", share, 0.0, after_s, for_s)

    def go_silent(self, for_s: float | None = None, *, after_s: float = 0.0) -> None:
        """The radio is out: nothing gets through in either direction, the vehicle flies on. None is for ever."""
        self._set("silent", True, False, after_s, for_s)

    def hang(self, for_s: float | None = None, *, after_s: float = 0.0) -> None:
        """The autopilot neither hears, moves nor sends. None is for ever."""
        self._set("frozen", True, False, after_s, for_s)

    def fail_prearm(self, reason: str, *, after_s: float = 0.0, for_s: float | None = None) -> None:
        """Its arming checks give this reason besides the real ones."""
        reasons = self.all.prearm_failures
        self._plan(partial(reasons.append, reason), after_s)
        if for_s is not None:
            self._plan(partial(reasons.remove, reason), after_s + _duration(for_s))

    def reboot(self, *, after_s: float = 0.0) -> None:
        """It reboots, in the air as on the ground."""
        self._plan(self._vehicle.restart, after_s)

    def set_wind(
        self, *, north_m_s: float = 0.0, east_m_s: float = 0.0, gusts_m_s: float = 0.0, after_s: float = 0.0
    ) -> None:
        """Where the air goes from now on, in m/s; gusts as their standard deviation."""
        wind = Wind(north_m_s, east_m_s, gusts_m_s)
        self._plan(partial(setattr, self._vehicle.motion, "wind", wind), after_s)

    def set_battery(self, percent: float, *, after_s: float = 0.0) -> None:
        """So much charge is left, 0 to 100; it is drained from there."""
        if not 0.0 <= percent <= 100.0:
            raise InvalidArgument(f"percent = {percent!r} is not allowed: 0 to 100")
        self._plan(partial(setattr, self._vehicle.battery, "percent", percent), after_s)

    def end(self, *, after_s: float = 0.0) -> None:
        """Everything that a vehicle can recover from is well again: GPS, radios, motor, processor."""
        for name in ("gps_lost", "rc_lost", "motor_failed", "silent", "frozen"):
            self._set(name, False, False, after_s, None)
        self.drop_packets(0.0, after_s=after_s)

    def _set(self, name: str, value: object, well: object, after_s: float, for_s: float | None) -> None:
        end_s = None if for_s is None else after_s + _duration(for_s)
        self._plan(partial(setattr, self.all, name, value), after_s)
        if end_s is not None:
            self._plan(partial(setattr, self.all, name, well), end_s)

    def _plan(self, action: Callable[[], None], after_s: float) -> None:
        if not (math.isfinite(after_s) and after_s >= 0.0):
            raise InvalidArgument(f"after_s = {after_s!r} must be 0 or more seconds")
        self._on_stage(lambda hand: hand.do(action, after_s=after_s))


def _duration(for_s: float) -> float:
    if not for_s > 0.0:
        raise InvalidArgument(f"for_s = {for_s!r} must be above 0 seconds")
    return for_s
