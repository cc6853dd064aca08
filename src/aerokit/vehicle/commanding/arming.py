"""Readiness checks, arming, disarming and rebooting."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.formatting import short_repr
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavCmd, MavLandedState, MavSeverity, MavState
from aerokit.mavlink.messages import Statustext
from aerokit.vehicle.commanding.arbiter import ARM_HEARTBEAT_DELAY_S, STEERING
from aerokit.vehicle.commanding.context import VehicleBase
from aerokit.vehicle.commanding.health import PREARM_REPORT_INTERVAL_S
from aerokit.vehicle.commanding.order import REBOOTED, SUPERSEDED
from aerokit.vehicle.commanding.progress import MAX_SILENCE_S, ChangeSignal, await_progress
from aerokit.vehicle.commanding.sender import add_clause
from aerokit.vehicle.state.status_text import CHUNK_LENGTH

if TYPE_CHECKING:
    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.order import Order

FORCE_REBOOT = 20190226
"""param6 of PREFLIGHT_REBOOT_SHUTDOWN that makes ArduPilot reboot even while armed (GCS_Common.cpp)."""
REASONS_TIMEOUT_S = 3.0
"""A vehicle that is requested to run its pre-arm checks reports the failures within this many seconds."""
POLL_INTERVAL_S = 0.1
"""Poll interval in seconds while waiting for a reboot."""
# Values of HEARTBEAT.system_status during a boot.
BOOT_STATES = (MavState.BOOT, MavState.CALIBRATING)
REBOOT_ACK_TIMEOUT_S = 3.0
"""Seconds to wait for the acknowledgement of a reboot command."""
LATE_REBOOT_TIMEOUT_S = 15.0
"""Seconds to wait for a reboot after a reboot command that was not acknowledged."""
MODE_READY_TIMEOUT_S = 3.0
"""Seconds to wait after a mode change until the vehicle can arm in the new mode."""

logger: logging.Logger = logging.getLogger("aerokit")


@checks_arguments
class ArmingActions(VehicleBase):
    """Arming, disarming and rebooting."""

    def missing_for_flight(self) -> list[str]:
        """Return what the vehicle still needs for a flight, according to the messages received so far. Sends nothing.

        If the vehicle's arming checks fail, the result includes the vehicle's status texts about them from the
        last 35 s; :meth:`why_not_armable` requests these texts. A vehicle that lacks something may still arm:
        ArduCopter arms in STABILIZE without a position.
        """
        return self._health.missing_for_flight()

    async def why_not_armable(self) -> list[str]:
        """Return the reasons why arming in the present mode would be refused now; an empty list if none is known.

        :meth:`missing_for_flight` also lists what is needed only for a flight.

        Asks the vehicle to run its checks (MAV_CMD_RUN_PREARM_CHECKS) if it supports that, and collects its status
        texts. Also reads SYS_STATUS and the estimator's flags (ArduPilot EKF_STATUS_REPORT, PX4 ESTIMATOR_STATUS).
        Takes about a second and does not arm the vehicle.
        """
        return await self._health.why_not_armable()

    async def wait_ready(self, *, timeout: float = 90.0) -> None:
        """Wait until position and home are known, the estimator is healthy and the pre-arm checks pass.

        The present mode does not matter: if the vehicle cannot arm in it, :meth:`arm` changes the mode first.
        :meth:`why_not_armable` reports a mode that does not allow arming.

        Raises:
            OperationTimeout: not ready within ``timeout`` seconds. The text lists what is missing, recent status texts
                and, at its end, a mode that does not allow arming. If pre-arm checks fail, aerokit asks the vehicle for
                the reasons three seconds before this error.
        """
        telemetry = self.telemetry
        cells = (telemetry.sensors, telemetry.estimator, telemetry.position, telemetry.home, telemetry.armed)
        with (
            self._session.streaming("sensors", "estimator", "position"),
            ChangeSignal(self._session, *cells, every_arrival=True) as changes,
            anyio.move_on_after(timeout),
        ):
            # Shortly before the time-out, ask the vehicle once for the reasons, so that the error can contain them.
            ask_at = self.connection.now() + timeout - REASONS_TIMEOUT_S
            while self._health.missing_for_flight():
                self._session.end.raise_if_ended()
                if self.connection.now() >= ask_at:
                    ask_at = math.inf
                    await self._health.request_reasons(since=self.connection.now() - PREARM_REPORT_INTERVAL_S)
                else:
                    await changes.next(min(timeout, ask_at - self.connection.now()))
            return  # The vehicle is ready.
        # The time-out has expired. The vehicle may have become ready just after the last check.
        if missing := self._health.missing_for_flight():
            raise OperationTimeout(
                f"the vehicle was not ready within {timeout:g} s ({self._session.describe_link()}); still missing:"
                f"{self._list_reasons(missing)}"
            )

    def _list_reasons(self, missing: list[str]) -> str:
        recent_texts = self._health.arming_texts(self.connection.now() - PREARM_REPORT_INTERVAL_S)
        reasons = self._session.deduplicate_reasons(*recent_texts, *missing)
        items = "".join(f"\n  - {reason}" for reason in reasons)
        # The mode does not count as missing, because `arm` changes it.
        mode_text = "".join(f"\n{text}" for text in self._health.unarmable_mode())
        return f"{items}{mode_text}"

    async def arm(
        self,
        *,
        mode: str | int | None = None,
        force: bool = False,
        reason: str = "",
        timeout: float = 10.0,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Arm the motors and wait until HEARTBEAT reports armed: **propellers may start to turn**.

        If the present mode does not allow arming (RTL or LAND after a flight, OFFBOARD), aerokit changes it first.
        ArduCopter's parameter AUTO_OPTIONS decides whether it arms in AUTO. If ArduCopter refuses in AUTO, and ``mode``
        is None, aerokit changes the mode and sends the command a second time. In all other cases, aerokit sends the
        command only once, because a repetition might arm a vehicle that a pilot has just disarmed.

        **PX4 takes off at once if it is armed in MISSION or TAKEOFF.** When it disarms after a return that interrupted
        a mission, it changes back to MISSION by itself. Without ``mode``, aerokit therefore changes to LOITER first,
        unless your program has ordered MISSION or TAKEOFF since the vehicle disarmed. If PX4 reports armed already,
        aerokit sends no command and waits for the next HEARTBEAT, because PX4 may disarm and change the mode meanwhile.
        aerokit treats ArduPlane in the same way: it changes TAKEOFF to FBWA.
        If another party changes to such a mode right before the command arrives, the call raises OperationRejected;
        aerokit then disarms the vehicle, or orders it to hold if it is flying.

        After a cancellation, or an error other than a refusal, the vehicle may still execute the command. aerokit
        therefore monitors the vehicle for 15 seconds, and disarms it if this command arms it after all. The monitoring
        ends with the vehicle's ``async with`` block. A vehicle that another party has armed stays armed. aerokit
        assumes that this command has armed the vehicle if the vehicle accepts the command, or if HEARTBEAT reports
        armed right after the command and no pilot has taken over. Logger "aerokit" warns about the outcome.

        Args:
            mode: the mode to arm in. None: the present mode; if it does not allow arming, or would start a flight, the
                mode in which ``take_off`` starts.
            force: skip the vehicle's own arming checks, which is dangerous.
            reason: why your program arms, at most 50 bytes. Logger "aerokit" reports the reason at INFO. It is also
                sent to the vehicle as a STATUSTEXT right before the command, and ArduPilot writes this text into its
                flight log. PX4 logs only texts that have the vehicle's own system id.
            timeout: seconds for HEARTBEAT to report armed after the command was accepted.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no such limit.

        Raises:
            InvalidArgument: there is no such mode, it does not allow arming, or the reason is too long. Nothing was
                sent.
            CommandRejected: the vehicle refused; ``reasons`` has its pre-arm texts, failing sensors and missing
                estimates. A vehicle that can run its checks on request runs them again for this.
            CommandTimeout: there was no acknowledgement, and the vehicle did not arm. The error text says whether it
                may still arm.
            OperationRejected: the vehicle is armed already in a mode other than ``mode`` (nothing was sent). Or, before
                it reported armed, another party changed its mode or disarmed it, or your program ordered to disarm. Or
                a PX4 or ArduPlane that reported armed has disarmed (nothing was sent; call again).
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: the vehicle accepted the command but did not arm.
        """
        if len(reason.encode()) > CHUNK_LENGTH:
            raise InvalidArgument(
                f"reason = {short_repr(reason)} is not allowed: it must have at most {CHUNK_LENGTH} bytes"
            )
        arming_mode = self._mode_to_arm_in(mode)
        if await self._is_armed_already(timeout, max_silence_s):
            return
        if mode is None:
            arming_mode = self._mode_to_arm_in(mode)  # The vehicle may have disarmed meanwhile.
        if arming_mode is not None:
            await self._change_to_arming_mode(arming_mode)
        self._arm_cleanup.stop_watching()
        if reason:
            logger.info("arming vehicle %d: %s", self.system_id, reason)
            self._session.send(Statustext(severity=MavSeverity.INFO, text=reason, id=0, chunk_seq=0))
        started = self.connection.now()
        try:
            await self._arm_with_fallback_mode(force, timeout, max_silence_s, may_change_mode=mode is None)
        except CommandRejected as error:
            reasons = await self._health.arming_reasons(started)
            raise self._session.with_reasons(error, started, reasons) from None

    async def _arm_with_fallback_mode(
        self, force: bool, timeout: float, max_silence_s: float | None, *, may_change_mode: bool
    ) -> None:
        """Arm. If the vehicle refuses in a mode in which a parameter may forbid arming, arm in another mode."""
        began_at = self.connection.now()
        order_before, arm_commands_before = self._arbiter.latest(STEERING), self._arbiter.arm_commands_sent
        try:
            await self._arm_in_present_mode(force, timeout, max_silence_s)
        except CommandRejected:
            has_computer_slept = self._arbiter.slept_since(began_at) > 0
            # False if another task has given an order meanwhile, above all to disarm. This call has sent one command.
            is_newest_order = (
                self._arbiter.latest(STEERING) is order_before
                and self._arbiter.arm_commands_sent == arm_commands_before + 1
            )
            may_retry_in_other_mode = (
                may_change_mode
                and not has_computer_slept
                and is_newest_order
                and not self._flight_cleanup.is_stream_open
                and self.telemetry.is_confirmed_disarmed  # False if another party has armed the vehicle meanwhile.
                and self._is_in_mode_armable_by_option()
            )
            other_mode = self.autopilot.mode_to_arm_in() if may_retry_in_other_mode else None
            if other_mode is None:
                raise
            await self._change_to_arming_mode(other_mode)
            await self._arm_in_present_mode(force, timeout, max_silence_s)

    async def _arm_in_present_mode(self, force: bool, timeout: float, max_silence_s: float | None) -> None:
        started, was_armed = self.connection.now(), self.telemetry.is_armed
        with self._arbiter.auxiliary_order() as order, self._arm_cleanup.arming(order, was_armed):
            try:
                await self._sender.send_arm(order, armed=True, force=force)
                await self._await_armed(
                    armed=True, order=order, started=started, timeout=timeout, max_silence_s=max_silence_s
                )
                if self._is_in_unordered_flight_mode():  # The HEARTBEAT that reports armed may report another mode.
                    raise OperationRejected(f"arm(): the mode changed to {self.telemetry.mode_name}")
            except CommandRejected:  # The vehicle will not execute the command, so no cleanup is needed.
                raise
            except (anyio.get_cancelled_exc_class(), AerokitError) as error:
                is_watched = order.was_sent and self._arm_cleanup.watch(order, was_armed)
                if is_watched and isinstance(error, CommandTimeout):
                    add_clause(error, self._arm_cleanup.late_arming_hint())
                elif is_watched and isinstance(error, AerokitError) and self._is_in_unordered_flight_mode():
                    mode = self.telemetry.mode_name
                    if_flying = "" if self.autopilot.must_complete_take_off else ", or orders a hold if it is flying"
                    add_clause(error, f"a vehicle armed in {mode} takes off: aerokit disarms it{if_flying}")
                raise

    def _is_in_unordered_flight_mode(self) -> bool:
        starting_modes = self.autopilot.modes_starting_flight
        return self.telemetry.mode_name in starting_modes and not self._arbiter.has_ordered_mode(starting_modes)

    async def disarm(
        self,
        *,
        force: bool = False,
        timeout: float = 10.0,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Stop the motors and wait until HEARTBEAT reports disarmed.

        Args:
            force: also disarm in flight: **the vehicle falls**.
            timeout: seconds for HEARTBEAT to report disarmed after the command was accepted.
            max_silence_s: seconds without a heartbeat after which HeartbeatTimeout is raised; None: no such limit.

        Raises:
            CommandRejected: the vehicle refused, usually because it is flying.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: your program ordered to arm before the vehicle reported disarmed.
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: the vehicle accepted the command but did not disarm.
        """
        self._arm_cleanup.stop_watching()
        started = self.connection.now()
        with self._arbiter.auxiliary_order(ends_flight=True) as order:
            try:
                accepted = await self._sender.send_disarm(order, force=force, timeout=timeout)
            except CommandRejected as error:
                # ArduCopter sends no status text when it refuses to disarm in the air (AP_Arming_Copter.cpp, disarm).
                raise self._session.with_reasons(error, started, self._reason_if_flying()) from None
            remaining_s = max(0.0, accepted.accepted_at + timeout - self.connection.now())
            await self._await_armed(
                armed=False,
                order=order,
                started=started,
                reported_after=accepted.effect_reported_after,
                timeout=remaining_s,
                max_silence_s=max_silence_s,
            )

    def _reason_if_flying(self) -> tuple[str, ...]:
        landed = self.telemetry.landed_state.latest
        if landed not in (MavLandedState.IN_AIR, MavLandedState.TAKEOFF, MavLandedState.LANDING):
            return ()
        return (f"the vehicle is not on the ground (landed state {MavLandedState(landed).name})",)

    async def _await_armed(
        self,
        *,
        armed: bool,
        order: Order,
        started: float,
        timeout: float,
        max_silence_s: float | None,
        reported_after: float = -math.inf,
    ) -> None:
        cell, reported_after = self.telemetry.armed, max(started, reported_after)

        def is_done() -> bool:
            is_reported = cell.latest is armed and cell.updated_at > reported_after
            return is_reported and self._arbiter.is_state_recent

        def failure_reason() -> str:
            if self._arbiter.last_arm_command is not armed:
                return SUPERSEDED
            # A mode change or a failsafe does not keep the vehicle from disarming.
            return order.takeover_reason if armed else ""

        await await_progress(
            self._session,
            "arm()" if armed else "disarm()",
            is_done=is_done,
            failure_reason=failure_reason,
            describe=lambda: "; ".join(self._session.texts_since(started)) or "the vehicle sent no status text",
            timeout=timeout,
            max_silence_s=max_silence_s,
        )

    # ------------------------------------------------------------------------ modes for arming

    async def _is_armed_already(self, timeout: float, max_silence_s: float | None) -> bool:
        """Return True if the vehicle needs no arm command. If it reports armed, wait for the next HEARTBEAT first.

        A vehicle that disarms before a command arrives might change to a mode in which the command starts a flight.
        For firmware without such modes, returns False at once.
        """
        if not self.autopilot.modes_starting_flight or not self.telemetry.is_armed:
            return False
        armed, started, reboots = self.telemetry.armed, self.connection.now(), self._session.watch.reboots
        replaces_disarm = self._arbiter.last_arm_command is False
        # Until this time, HEARTBEAT may not yet report the effect of an earlier command to disarm.
        is_certain_at = max(started, self._arbiter.last_disarm_command_at + ARM_HEARTBEAT_DELAY_S)
        self._arm_cleanup.stop_watching()
        self._arbiter.supersede_arm_commands(True)

        def is_done() -> bool:
            reported_at = armed.updated_at if self._arbiter.is_state_recent else -math.inf
            has_just_disarmed = reported_at > started and not armed.latest
            return reported_at > is_certain_at or has_just_disarmed

        def failure_reason() -> str:
            if self._arbiter.last_arm_command is not True:
                return SUPERSEDED
            return "" if self._session.watch.reboots == reboots else REBOOTED

        await await_progress(
            self._session,
            "arm()",
            is_done=is_done,
            failure_reason=failure_reason,
            describe=lambda: f"the vehicle reported armed; nothing was sent; {self._session.describe_link()}",
            timeout=timeout,
            max_silence_s=max_silence_s,
        )
        if not armed.latest and not replaces_disarm:  # A pilot may have disarmed it.
            raise OperationRejected("arm(): the vehicle was armed and has just disarmed; nothing was sent: call again")
        return bool(armed.latest)

    def _mode_instead_of_flight(self) -> Mode | None:
        """Return a safe mode to arm in if arming in the present mode would start an unordered flight; else None."""
        would_start_flight = self._is_in_unordered_flight_mode() and not self.telemetry.is_armed
        return self.autopilot.mode_to_arm_in() if would_start_flight else None

    def _mode_to_arm_in(self, mode: str | int | None) -> Mode | None:
        """Return the mode to change to before arming; None to arm in the present mode."""
        if mode is not None:
            arming_mode = self.autopilot.find_mode(mode, self.telemetry.mode_names)
            if arming_mode.name in self.autopilot.unarmable_modes:
                raise InvalidArgument(f"mode = {mode!r} is not allowed: {self._health.unarmable_text(arming_mode)}")
            if self.telemetry.is_armed and arming_mode != self.telemetry.mode.latest:
                raise OperationRejected(
                    f"arm: the vehicle is armed already, in {self.telemetry.mode_name}; nothing was sent"
                )
            return arming_mode
        if (safe_mode := self._mode_instead_of_flight()) is not None:
            return safe_mode
        # A booting vehicle still sets its mode by itself, and may undo a mode change of this program.
        is_booting = self.telemetry.system_status.latest in BOOT_STATES
        must_keep_mode = self._flight_cleanup.is_stream_open or is_booting
        # If a parameter decides whether the mode allows arming, try to arm first: `_arm_with_fallback_mode` changes
        # the mode after a refusal.
        may_arm_in_mode = not self._health.unarmable_mode() or self._is_in_mode_armable_by_option()
        if must_keep_mode or may_arm_in_mode or not self.telemetry.is_confirmed_disarmed:
            return None
        return self.autopilot.mode_to_arm_in()

    def _is_in_mode_armable_by_option(self) -> bool:
        mode = self.telemetry.mode.latest
        return mode is not None and mode.name in self.autopilot.armable_by_option

    async def _change_to_arming_mode(self, mode: Mode) -> None:
        """Change the mode. Raises if the arm command must not follow."""
        order = self._arbiter.order(mode)
        arm_commands_before = self._arbiter.arm_commands_sent
        await self._sender.ensure_mode(mode, order)
        await self._wait_until_armable()
        self._sender.raise_if_ended(order)
        self._sender.raise_if_slept(order)
        if self._arbiter.arm_commands_sent != arm_commands_before:
            raise OperationRejected("arm(): another arm or disarm command was given; the arm command was not sent")
        if not self._arbiter.is_state_recent:
            link = self._session.describe_link()
            raise HeartbeatTimeout(f"arm(): the vehicle is silent; {link}; the arm command was not sent")

    async def _wait_until_armable(self) -> None:
        """Wait briefly until SYS_STATUS no longer reports failing pre-arm checks."""
        sensors = self.telemetry.sensors
        with self._session.streaming("sensors"), anyio.move_on_after(MODE_READY_TIMEOUT_S):
            since = self.connection.now()
            await sensors.wait_until(
                lambda health: sensors.updated_at > since and health.prearm_checks_pass is not False
            )

    # ------------------------------------------------------------------------------ rebooting

    async def reboot(self, *, force: bool = False, timeout: float = 60.0) -> None:
        """Reboot the autopilot and wait until its time since boot has restarted.

        Args:
            force: also reboot while armed: **a flying vehicle falls**.
            timeout: seconds until the vehicle has restarted.

        Raises:
            OperationRejected: the vehicle is armed, or not known to be disarmed. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement, and the vehicle did not reboot in time.
            LinkLost: the link went down with the vehicle (USB, TCP); connect again.
            OperationTimeout: the vehicle did not restart in time.
        """
        if not force:
            self._session.check_disarmed("reboot")
        reboots_before = self._session.watch.reboots
        # aerokit detects a reboot by a decrease of the time since boot, so request the present time.
        self._session.link_watch.request_time()
        unanswered: CommandTimeout | OperationRejected | None = None
        with (
            self._session.watch.expecting_reboot(),
            self._arbiter.auxiliary_order(ends_with_actions=False) as order,
        ):
            try:
                await self._order_reboot(order, force)
            except CommandRejected:  # The vehicle will not reboot.
                raise
            except (CommandTimeout, OperationRejected) as error:
                # The reboot may have ended the order, and with it the wait for the acknowledgement.
                if not order.was_sent:
                    raise
                unanswered = error
            # A command that was not acknowledged was probably lost, so a wait shorter than the time-out is enough.
            wait_s = timeout if unanswered is None else min(timeout, LATE_REBOOT_TIMEOUT_S)
            with anyio.move_on_after(wait_s):
                await self._await_reboot(reboots_before)
                return
        # The vehicle has not rebooted in time.
        if unanswered is not None:
            add_clause(unanswered, "the command is sent only once, and may still be executed")
            raise unanswered
        raise OperationTimeout(
            f"reboot: the vehicle did not restart within {timeout:g} s; {self._session.describe_link()}"
        )

    async def _order_reboot(self, order: Order, force: bool) -> None:
        reboot_autopilot, unused = 1, (0.0,) * 4
        params = (reboot_autopilot, *unused, FORCE_REBOOT if force else 0)
        # If only the acknowledgement is lost, a repetition would cause another reboot.
        options: dict[str, Any] = {"attempts": 1, "attempt_timeout": REBOOT_ACK_TIMEOUT_S}
        await self._sender.send_long(order, MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, *params, **options)

    async def _await_reboot(self, reboots_before: int) -> None:
        started = self.connection.now()
        next_request_at = started
        while self._session.watch.reboots == reboots_before:
            self._session.end.raise_if_ended()
            now = self.connection.now()
            if now >= next_request_at:
                self._session.link_watch.request_time()
                # aerokit detects a reboot by a decrease of the time since boot. In a fast simulation, the time soon
                # exceeds the old one, so the requests are frequent at first.
                next_request_at = now + POLL_INTERVAL_S + (now - started) / 10
            await anyio.sleep(POLL_INTERVAL_S)
