"""Reasons why a vehicle cannot arm or fly, as texts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import anyio

from aerokit.autopilots.telemetry import SENSORS
from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.events import LinkRestored, LinkState
from aerokit.mavlink.enums import MavBatteryChargeState, MavCmd, MavSysStatusSensor

if TYPE_CHECKING:
    from aerokit.autopilots import Mode
    from aerokit.vehicle.session.session import VehicleSession

# Seconds to collect status texts after the vehicle was requested to run its checks, and to wait for missing states.
REPORT_WAIT_S = 1.0
# Values older than this many seconds do not describe the present state.
HEALTH_MAX_AGE_S = 5.0
PREARM_REPORT_INTERVAL_S = 35.0
"""ArduPilot repeats its pre-arm failures every 30 s, so each one is reported within this many seconds."""
PREARM_REPORT_DURATION_S = 3.0
"""Seconds within which the texts of one report about failing pre-arm checks arrive, also over a slow link."""
CHECKS_FAIL = "the vehicle's pre-arm checks do not pass (SYS_STATUS)"
"""The reason for a refusal to arm if no other reason is known."""
REPORTS_ABOUT_ARMING = ("heartbeats (", "sensors (")
"""Beginnings of the reasons about missing or old reports that show whether the vehicle can arm."""
RC_RECEIVER = SENSORS[MavSysStatusSensor.RC_RECEIVER]


def ordered_reasons(report_reasons: list[str], other_reasons: list[str]) -> list[str]:
    """Join the reasons about missing or old reports with the others. Reports that decide about arming come first."""
    about_arming = [reason for reason in report_reasons if reason.startswith(REPORTS_ABOUT_ARMING)]
    other_reports = [reason for reason in report_reasons if reason not in about_arming]
    return [*about_arming, *other_reasons, *other_reports]


class Health:
    """Pre-arm checks, failing sensors and missing estimates."""

    def __init__(self, session: VehicleSession) -> None:
        self._session, self._telemetry, self._autopilot = session, session.telemetry, session.autopilot
        self._restored_at = -math.inf
        self._checks_requested_at = -math.inf
        session.at_close(session.connection.bus.attach_event(LinkRestored, self._on_restored))

    def _on_restored(self, event: LinkRestored) -> None:
        # The vehicle may have rebooted, so states that were received before are distrusted.
        self._restored_at = event.at

    def missing_for_flight(self) -> list[str]:
        """Return what the vehicle still needs for a flight. Sends nothing."""
        telemetry = self._telemetry
        missing = [
            f"{cell.name} ({cell.waits_for} not received)"
            for cell in (telemetry.sensors, telemetry.estimator, telemetry.position, telemetry.home)
            if not cell.is_known
        ]
        texts = self._recent_arming_reasons()
        preventing_estimates = self._missing_estimates() if self._mode_needs_position() else []
        is_explained = bool(texts or self._failing_sensors() or preventing_estimates)
        is_unexplained = self._prearm_checks_fail() and not is_explained
        unexplained = self._unexplained_failures() if is_unexplained else []
        other_reasons = [*texts, *self._health_problems(), *unexplained]
        return ordered_reasons([*missing, *self._outdated_states()], other_reasons)

    def _recent_arming_reasons(self) -> list[str]:
        """Return why pre-arm checks fail, from recent status texts."""
        if not self._prearm_checks_fail() or self._telemetry.is_armed:
            return []
        now = self._session.connection.now()
        # Texts from before the last request to run the checks, or from before the link was restored, may be outdated.
        since = max(now - PREARM_REPORT_INTERVAL_S, self._checks_requested_at, self._restored_at)
        timed_reasons = [
            (text.at, reason)
            for text in self._telemetry.texts_since(since)
            if (reason := self._autopilot.arming_reason(text.text))
        ]
        if self._autopilot.runs_prearm_checks and timed_reasons:
            # ArduPilot reports all failing checks together, so older texts may be about checks that pass now.
            report_began_at = max(received_at for received_at, _ in timed_reasons) - PREARM_REPORT_DURATION_S
            timed_reasons = [(at, reason) for at, reason in timed_reasons if at >= report_began_at]
        return list(dict.fromkeys(reason for _, reason in timed_reasons))  # without duplicates

    def _outdated_states(self) -> list[str]:
        telemetry = self._telemetry
        is_lost = self._session.watch.link_state.latest is LinkState.LOST
        lost_link = ", the link is lost" if is_lost else ""
        last_heartbeat = f"the last one {self._session.heartbeat_age:.1f} s ago{lost_link}"
        heartbeats = [f"heartbeats ({last_heartbeat})"] if is_lost or self._session.watch.is_silent else []
        cells = (telemetry.sensors, telemetry.estimator, telemetry.position)
        too_old = [
            f"{cell.name} (no {cell.waits_for} for {cell.age:.0f} s)"
            for cell in cells
            if HEALTH_MAX_AGE_S < cell.age < math.inf
        ]
        from_before_silence = [
            f"{cell.name} (no {cell.waits_for} since the link was restored)"
            for cell in cells
            if cell.is_known and cell.updated_at < self._restored_at and cell.age <= HEALTH_MAX_AGE_S
        ]
        return [*heartbeats, *too_old, *from_before_silence]

    async def why_not_armable(self) -> list[str]:
        if self._telemetry.is_armed:
            return []
        return list(await self.arming_reasons(self._session.connection.now()))

    async def arming_reasons(self, since: float) -> tuple[str, ...]:
        """Return the reasons against arming, among them the status texts received since the time ``since``.

        If there are no such texts, aerokit requests the vehicle to run its pre-arm checks.
        """
        with self._session.streaming("sensors", "estimator"):
            await self._session.wait_for_status_texts()
            await self._request_checks_unless_reported(since)
            await self._await_recent_health()
        problems = self._health_problems() if self._mode_needs_position() else self._failing_sensors()
        other_reasons = [*self.arming_texts(since), *self.unarmable_mode(), *problems]
        reasons = self._session.deduplicate_reasons(*ordered_reasons(self._outdated_states(), other_reasons))
        if not reasons and self._prearm_checks_fail():
            return tuple(self._unexplained_failures())
        return reasons

    def _unexplained_failures(self) -> list[str]:
        """Return reasons for failing checks that the vehicle does not explain: low batteries, else a general text."""
        low_batteries = []  # from BATTERY_STATUS, because PX4 sends its status text about a low battery only once
        for battery in self._telemetry.batteries.latest or ():
            # With these charge states (critical, emergency, failed, unhealthy), vehicles refuse to arm.
            if MavBatteryChargeState.CRITICAL <= battery.charge_state <= MavBatteryChargeState.UNHEALTHY:
                state = MavBatteryChargeState(battery.charge_state).name.lower()
                charge = "" if battery.remaining_percent is None else f" ({battery.remaining_percent} %)"
                # The parameters of ArduPilot and PX4 count batteries from 1, BATTERY_STATUS from 0.
                low_batteries.append(f"battery {battery.id + 1} reports the charge state {state}{charge}")
        return low_batteries or [CHECKS_FAIL]

    def _mode_needs_position(self) -> bool:
        mode = self._telemetry.mode.latest
        return mode is None or mode.name not in self._autopilot.modes_without_position

    def unarmable_mode(self) -> list[str]:
        """Return a list with one text if the present mode does not allow arming, otherwise an empty list."""
        mode = self._telemetry.mode.latest
        return [self.unarmable_text(mode)] if mode is not None and mode.name in self._unarmable_modes() else []

    def unarmable_text(self, mode: Mode) -> str:
        firmware, option = self._autopilot.firmware, self._autopilot.armable_by_option.get(mode.name)
        armable_modes = ", ".join(sorted({*self._autopilot.modes.names} - self._unarmable_modes()))
        if option is None:
            text, when = f"{firmware} cannot arm in {mode.name}, only in {armable_modes}", "first"
        else:
            text, when = f"{firmware} cannot arm in {mode.name} unless {option} allows it", "after a refusal"
        arming_mode = self._autopilot.mode_to_arm_in()
        return text if arming_mode is None else f"{text}; arm() changes to {arming_mode.name} {when}"

    def _unarmable_modes(self) -> frozenset[str]:
        return self._autopilot.unarmable_modes.union(self._autopilot.armable_by_option)

    async def _await_recent_health(self) -> None:
        """Wait briefly for states that are missing or too old."""
        with anyio.move_on_after(REPORT_WAIT_S):
            await self._telemetry.sensors.wait_until(lambda _: self._telemetry.sensors.age <= HEALTH_MAX_AGE_S)
            await self._telemetry.estimator.wait_until(lambda _: self._telemetry.estimator.age <= HEALTH_MAX_AGE_S)

    async def request_reasons(self, since: float) -> None:
        """Request the status texts about failing pre-arm checks, unless some have arrived since the time ``since``."""
        sensors = self._telemetry.sensors.latest
        if sensors is not None and sensors.prearm_checks_pass is False and not self._telemetry.is_armed:
            await self._request_checks_unless_reported(since)

    async def _request_checks_unless_reported(self, since: float) -> None:
        """Let the vehicle run its pre-arm checks, unless it has sent texts about arming since the time ``since``."""
        if self.arming_texts(since) or not self._autopilot.runs_prearm_checks:
            return
        requested_at = self._session.connection.now()
        try:
            await self._session.commands.send_long(MavCmd.RUN_PREARM_CHECKS, attempts=2)
        except (CommandRejected, CommandTimeout):
            return
        self._checks_requested_at = requested_at
        await anyio.sleep(REPORT_WAIT_S)

    def arming_texts(self, since: float) -> list[str]:
        return [text for text in self._session.texts_since(since) if self._autopilot.arming_reason(text) is not None]

    def _health_problems(self) -> list[str]:
        return [*self._failing_sensors(), *self._missing_estimates()]

    def _missing_estimates(self) -> list[str]:
        estimator = self._telemetry.estimator.latest
        if estimator is None or not estimator.missing:
            return []
        receivers = self._telemetry.gps.latest or ()
        has_no_fix = receivers and not any(receiver.has_3d_fix for receiver in receivers)
        causes = ["no GPS receiver has a 3D fix (GPS_RAW_INT)"] if has_no_fix else []
        # The probable cause comes first.
        return [*causes, *(f"the estimator has no {name} ({estimator.message})" for name in estimator.missing)]

    def _prearm_checks_fail(self) -> bool:
        sensors = self._telemetry.sensors.latest
        return sensors is not None and sensors.prearm_checks_pass is False and not self._reports_mode_requirements()

    def _failing_sensors(self) -> list[str]:
        sensors = self._telemetry.sensors.latest
        if sensors is None or sensors.prearm_checks_pass is True or self._reports_mode_requirements():
            return []
        return [f"{name} is not healthy (SYS_STATUS)" for name in sensors.failing if self._is_required(name)]

    def _reports_mode_requirements(self) -> bool:
        # In a mode that does not allow arming, PX4 reports what this mode requires, and not what arming requires.
        return self._autopilot.prearm_depends_on_mode and bool(self.unarmable_mode())

    def _is_required(self, sensor: str) -> bool:
        mode, modes_with_rc = self._telemetry.mode.latest, self._autopilot.modes_with_rc
        # PX4 reports a missing RC receiver as failing in all modes, also in those that do not require it.
        needs_rc = mode is None or modes_with_rc is None or mode.name in modes_with_rc
        return needs_rc or not sensor.startswith(RC_RECEIVER)
