"""What keeps a vehicle from flying, in words: beforehand, and after it has refused."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.events import LinkRestored, LinkState
from aerokit.mavlink.enums import MavCmd

if TYPE_CHECKING:
    from aerokit.autopilots import Mode
    from aerokit.vehicle.session.session import Talk

TEXTS_S = 1.0
"""How long texts are collected after the vehicle was asked to run its checks."""
FRESH_S = 5.0
"""What is older says nothing about now."""


class Health:
    """Pre-arm checks, failing sensors and what the estimator lacks."""

    def __init__(self, talk: Talk) -> None:
        self._talk, self._telemetry, self._autopilot = talk, talk.telemetry, talk.autopilot
        self._restored_at = -math.inf
        talk.at_close(talk.connection.bus.attach_event(LinkRestored, self._on_restored))

    def _on_restored(self, event: LinkRestored) -> None:
        """The vehicle may have rebooted meanwhile: only what it tells from now on counts."""
        self._restored_at = event.at

    def missing_for_flight(self) -> list[str]:
        """What is still missing before the vehicle can fly, as far as it is known already; talks to nobody."""
        telemetry = self._telemetry
        missing = [
            f"{cell.name} ({cell.waits_for} has not come)"
            for cell in (telemetry.sensors, telemetry.estimator, telemetry.position, telemetry.home)
            if not cell.is_known
        ]
        return [*missing, *self._out_of_date(), *self._failing()]

    def _out_of_date(self) -> list[str]:
        """What has been told, but too long ago to say anything about now."""
        telemetry = self._telemetry
        is_lost = self._talk.watch.link_state.latest is LinkState.LOST
        why = f"the last one {self._talk.heartbeat_age:.1f} s ago{', the link is lost' if is_lost else ''}"
        heartbeats = [f"heartbeats ({why})"] if is_lost or self._talk.watch.is_silent else []
        cells = (telemetry.sensors, telemetry.estimator, telemetry.position)
        old = [
            f"{cell.name} (no {cell.waits_for} for {cell.age:.0f} s)"
            for cell in cells
            if FRESH_S < cell.age < math.inf
        ]
        before = [
            f"{cell.name} (no {cell.waits_for} since the link was restored)"
            for cell in cells
            if cell.is_known and cell.updated_at < self._restored_at and cell.age <= FRESH_S
        ]
        return [*heartbeats, *old, *before]

    async def why_not_armable(self) -> list[str]:
        """Why arming would be refused now; the vehicle is asked to run its checks where it can do so on request."""
        if self._telemetry.is_armed:
            return []
        return list(await self.arming_reasons(self._talk.connection.now()))

    async def arming_reasons(self, since: float) -> tuple[str, ...]:
        """Texts about arming since then; those asked for again where there are none; then failing bits and flags."""
        with self._talk.streaming("sensors", "estimator"):
            await self._talk.settle()
            if not self.arming_texts(since) and self._autopilot.runs_prearm_checks:
                await self._run_prearm_checks()
            await self._hear_of_health()
        found = (self.arming_texts(since), self.unarmable_mode(), self._out_of_date(), self._failing())
        return self._talk.each_reason_once(*(reason for reasons in found for reason in reasons))

    def unarmable_mode(self) -> list[str]:
        """That it does not arm in its present mode, if it does not."""
        mode = self._telemetry.mode.latest
        is_unarmable = mode is not None and mode.name in self._autopilot.unarmable_modes
        return [self.unarmable_text(mode)] if mode is not None and is_unarmable else []

    def unarmable_text(self, mode: Mode) -> str:
        """Where it does arm instead."""
        others = sorted({*self._autopilot.modes.names} - self._autopilot.unarmable_modes)
        text = f"{self._autopilot.firmware} does not arm in {mode.name}, but in {', '.join(others)}"
        better = self._autopilot.mode_to_arm_in()
        return text if better is None else f"{text}; arm() goes to {better.name} first"

    async def _hear_of_health(self) -> None:
        """Give the vehicle a moment to tell what it has not told lately."""
        with anyio.move_on_after(TEXTS_S):
            await self._telemetry.sensors.wait_until(lambda _: self._telemetry.sensors.age <= FRESH_S)
            await self._telemetry.estimator.wait_until(lambda _: self._telemetry.estimator.age <= FRESH_S)

    async def _run_prearm_checks(self) -> None:
        try:
            await self._talk.commands.send_long(MavCmd.RUN_PREARM_CHECKS, attempts=2)
        except (CommandRejected, CommandTimeout):
            return
        await anyio.sleep(TEXTS_S)

    def arming_texts(self, since: float) -> list[str]:
        """What it has said about arming since then."""
        return [
            text for text in self._talk.texts_since(since) if self._autopilot.arming_reason(text) is not None
        ]

    def _failing(self) -> list[str]:
        """Failing sensors, failing pre-arm checks, missing estimates.

        When the vehicle says that it could be armed, a failing sensor is one it can do without (PX4: no RC receiver).
        In a mode in which it does not arm, PX4 judges what that mode needs: that says nothing.
        """
        failing: list[str] = []
        sensors, estimator = self._telemetry.sensors.latest, self._telemetry.estimator.latest
        says_nothing = self._autopilot.judges_by_mode and self.unarmable_mode()
        if sensors is not None and sensors.prearm_checks_pass is not True and not says_nothing:
            failing += [f"{name} is not healthy (SYS_STATUS)" for name in sensors.failing]
            if sensors.prearm_checks_pass is False:
                failing.append("the vehicle's pre-arm checks do not pass (SYS_STATUS)")
        if estimator is not None:
            failing += [f"the estimator has no {name} ({estimator.message})" for name in estimator.missing]
        return failing
