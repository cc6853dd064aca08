"""What keeps a vehicle from flying, in words: beforehand, and after it has refused."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.runtime.link_state import LinkState
from aerokit.vehicle.core import VehicleCore

if TYPE_CHECKING:
    from aerokit.autopilots import Mode

__all__ = ["VehicleHealth"]

RUN_PREARM_CHECKS = 401
TEXTS_S = 1.0
"""How long texts are collected after the vehicle was asked to run its checks."""
FRESH_S = 5.0
"""What is older says nothing about now."""


class VehicleHealth(VehicleCore):
    """Pre-arm checks, failing sensors and what the estimator lacks."""

    def missing_for_flight(self) -> list[str]:
        """What is still missing before the vehicle can fly, as far as it is known already; talks to nobody."""
        telemetry = self.telemetry
        missing = [
            f"{cell.name} ({cell.waits_for} has not come)"
            for cell in (telemetry.sensors, telemetry.estimator, telemetry.position, telemetry.home)
            if not cell.is_known
        ]
        return [*missing, *self._out_of_date(), *self._failing()]

    def _out_of_date(self) -> list[str]:
        """What has been told, but too long ago to say anything about now."""
        telemetry = self.telemetry
        is_lost = self.link_state.latest is LinkState.LOST
        why = f"the last one {self.heartbeat_age:.1f} s ago{', the link is lost' if is_lost else ''}"
        heartbeats = [f"heartbeats ({why})"] if is_lost or self.is_silent else []
        return heartbeats + [
            f"{cell.name} (no {cell.waits_for} for {cell.age:.0f} s)"
            for cell in (telemetry.sensors, telemetry.estimator, telemetry.position)
            if FRESH_S < cell.age < math.inf
        ]

    async def why_not_armable(self) -> list[str]:
        """Return the reasons why arming would be refused now; an empty list means that none is known.

        Asks the vehicle to run its checks (MAV_CMD_RUN_PREARM_CHECKS) where it can do so on request and listens to
        what it says; reads SYS_STATUS and the estimator's flags (ArduPilot EKF_STATUS_REPORT, PX4 ESTIMATOR_STATUS).
        Takes about a second. The vehicle is not armed by it.
        """
        if self.is_armed:
            return []
        return list(await self._arming_reasons(self.connection.now()))

    async def _arming_reasons(self, since: float) -> tuple[str, ...]:
        """Texts about arming since then; those asked for again where there are none; then failing bits and flags."""
        with self._streaming("sensors", "estimator"):
            await self._settle()
            if not self._arming_texts(since) and self.autopilot.runs_prearm_checks:
                await self._run_prearm_checks()
            await self._hear_of_health()
        found = (self._arming_texts(since), self._unarmable_mode(), self._out_of_date(), self._failing())
        return tuple(dict.fromkeys(reason for reasons in found for reason in reasons))

    def _unarmable_mode(self) -> list[str]:
        mode = self.telemetry.mode.latest
        is_unarmable = mode is not None and mode.name in self.autopilot.unarmable_modes
        return [self._unarmable_text(mode)] if mode is not None and is_unarmable else []

    def _unarmable_text(self, mode: Mode) -> str:
        others = sorted({*self.autopilot.modes.names} - self.autopilot.unarmable_modes)
        text = f"{self.autopilot.firmware} does not arm in {mode.name}, but in {', '.join(others)}"
        better = self.autopilot.mode_to_arm_in()
        return text if better is None else f"{text}; arm() goes to {better.name} first"

    async def _hear_of_health(self) -> None:
        """Give the vehicle a moment to tell what it has not told lately."""
        with anyio.move_on_after(TEXTS_S):
            await self.telemetry.sensors.wait_until(lambda _: self.telemetry.sensors.age <= FRESH_S)
            await self.telemetry.estimator.wait_until(lambda _: self.telemetry.estimator.age <= FRESH_S)

    async def _run_prearm_checks(self) -> None:
        try:
            await self._commands.send_long(RUN_PREARM_CHECKS, attempts=2)
        except (CommandRejected, CommandTimeout):
            return
        await anyio.sleep(TEXTS_S)

    def _arming_texts(self, since: float) -> list[str]:
        return [text for text in self.texts_since(since) if self.autopilot.arming_reason(text) is not None]

    def _failing(self) -> list[str]:
        """Failing sensors, failing pre-arm checks, missing estimates.

        When the vehicle says that it could be armed, a failing sensor is one it can do without (PX4: no RC receiver).
        In a mode in which it does not arm, PX4 judges what that mode needs: that says nothing.
        """
        failing: list[str] = []
        sensors, estimator = self.telemetry.sensors.latest, self.telemetry.estimator.latest
        says_nothing = self.autopilot.judges_by_mode and self._unarmable_mode()
        if sensors is not None and sensors.prearm_checks_pass is not True and not says_nothing:
            failing += [f"{name} is not healthy (SYS_STATUS)" for name in sensors.failing]
            if sensors.prearm_checks_pass is False:
                failing.append("the vehicle's pre-arm checks do not pass (SYS_STATUS)")
        if estimator is not None:
            failing += [f"the estimator has no {name} ({estimator.message})" for name in estimator.missing]
        return failing

    @property
    def is_armed(self) -> bool:
        """Whether the last heartbeat says armed; False before the first, and after a reboot until the next one."""
        return self.telemetry.armed.latest is True

    @property
    def is_surely_disarmed(self) -> bool:
        """Whether the last heartbeat says disarmed; False while it is not known."""
        return self.telemetry.armed.latest is False

    @property
    def mode_name(self) -> str:
        """Name of the flight mode, ``"unknown"`` before the first heartbeat."""
        mode = self.telemetry.mode.latest
        return "unknown" if mode is None else mode.name

    def describe_now(self) -> str:
        """What it does, as far as it was heard: ``holding in BRAKE, still armed, 9 m above home, heard 0.3 s ago``."""
        hold, mode = self.autopilot.mode_for("hold", is_vtol=self.is_vtol), self.telemetry.mode.latest
        armed = "still armed" if self.is_armed else "disarmed" if self.is_surely_disarmed else "perhaps armed"
        position = self.telemetry.position.latest
        height = None if position is None else position.altitude_relative_m
        return (
            f"{'holding in' if mode is not None and mode == hold else 'in'} {self.mode_name}, {armed},"
            f" {'' if height is None else f'{height:.1f} m above home, '}heard {self.heartbeat_age:.1f} s ago"
        )

    @property
    def is_vtol(self) -> bool:
        """Whether it can hover and cruise on wings: EXTENDED_SYS_STATE tells a VTOL state."""
        return bool(self.telemetry.vtol_state.latest)
