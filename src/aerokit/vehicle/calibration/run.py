"""`CalibrationRun`: starts, ends and cancels one calibration on the vehicle."""

from __future__ import annotations

import asyncio
import logging
import math
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import anyio
import anyio.lowlevel

from aerokit.errors import (
    BusyError,
    CommandRejected,
    ConnectionClosed,
    LinkLost,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavCmd, MavState
from aerokit.vehicle.calibration.values import CalibrationResult, CalibrationStep
from aerokit.vehicle.commanding.progress import await_progress

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.calibration.values import CompassFit
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import SentCommand
    from aerokit.vehicle.parameters.parameters import Parameters
    from aerokit.vehicle.session.session import VehicleSession

logger: logging.Logger = logging.getLogger("aerokit")

REPORT_TIMEOUT_S = 120.0
"""Seconds to wait for the vehicle's next report. PX4 waits up to two minutes for a pose (calibration_routines.cpp)."""
START_TIMEOUT_S = 40.0
"""Seconds to wait for the acknowledgement. ArduPilot calibrates its gyroscopes first, for at most 30 s."""
# The interval is longer than the time between two HEARTBEATs (1 s), because only HEARTBEAT shows that PX4 has ended the
# calibration.
MAX_CANCEL_ATTEMPTS, CANCEL_INTERVAL_S = 6, 2.5
CONFIRM_POLL_INTERVAL_S = 0.1


class CancelCommand(NamedTuple):
    """The command that cancels a calibration."""

    command: int
    params: tuple[float, ...]


class CalibrationRun:
    """One calibration, which counts as running from its first command until ``finish`` or a confirmed cancellation."""

    def __init__(
        self, context: VehicleContext, sensor: str, runs: list[CalibrationRun], parameters: Callable[[], Parameters]
    ) -> None:
        self.context: VehicleContext = context
        self.session: VehicleSession = context.session
        self.sensor: str = sensor
        self.parameters: Callable[[], Parameters] = parameters
        self.call_name: str = f"calibrate.{sensor}"  # how error texts name the call
        self._runs = runs  # all runs of this vehicle that may be in progress
        self.new_step: partial[CalibrationStep] = partial(CalibrationStep, sensor)
        self._cancel_command: CancelCommand | None = None
        self._cannot_cancel_reason = ""  # why the calibration cannot be cancelled, for the user; empty if it can be
        self._started_at = math.inf
        self._cancel_sent_at: float | None = None  # when the cancel command was last sent
        # Closed when the calibration has ended on the vehicle. Removes callbacks, and stops sending the cancel command.
        self._cleanup = ExitStack()
        self._has_rebooted = False
        self._is_abandoned = False
        # True from `abandon` on, until the vehicle has confirmed the cancellation.
        self._is_unconfirmed = False
        self._ended = asyncio.Event()  # set once the calibration has ended on the vehicle

    # ------------------------------------------------------------------------------- start and end

    def check_ready(self) -> None:
        """Raise NotSupported for unknown firmware, and OperationRejected if the vehicle may be armed."""
        autopilot = self.session.autopilot
        if not autopilot.calibration_protocol:
            raise NotSupported(
                f"{self.call_name}: aerokit does not know how to calibrate {autopilot.firmware}; nothing was sent"
            )
        self.session.check_disarmed(self.call_name, is_state_recent=self.context.arbiter.is_state_recent)

    async def begin(self, cancel: CancelCommand | None, cannot_cancel_reason: str = "") -> None:
        """Register this calibration as running, once the cancellation of earlier ones has ended.

        ``cancel`` is None if no command cancels this calibration. Raises BusyError if another calibration is in
        progress.
        """
        self.check_ready()
        # A deleted `Calibration` abandons its run in the next iteration of the event loop, so wait for that.
        await anyio.lowlevel.checkpoint()
        while self._runs:  # Another call may have begun a calibration during the wait.
            run = self._runs[0]
            if not run._is_abandoned:
                raise BusyError(f"{self.call_name}: {run.call_name} is in progress; nothing was sent")
            await run.wait_cancelled()
        self.check_ready()  # The vehicle may have been armed during the wait.
        self._cancel_command = cancel
        self._cannot_cancel_reason = cannot_cancel_reason
        self._started_at = self.session.connection.now()
        self._runs.append(self)
        self._cleanup.callback(self.context.on_finish(self.abandon))
        self.session.on_reboot.append(self._on_reboot)
        self._cleanup.callback(self.session.on_reboot.remove, self._on_reboot)

    async def command(self, command: int, *params: float, accepts: Collection[int] = ()) -> None:
        """Send a command and wait for its acknowledgement. Results in ``accepts`` raise no error."""
        # ArduPilot calibrates its gyroscopes before it acknowledges the start. None selects the usual time-out.
        attempt_timeout = START_TIMEOUT_S if command == MavCmd.PREFLIGHT_CALIBRATION else None
        try:
            await self.context.sender.auxiliary_command(command, *params, attempt_timeout=attempt_timeout)
        except CommandRejected as error:
            if error.result not in accepts:
                raise

    async def start(self, *params: float, command: int = MavCmd.PREFLIGHT_CALIBRATION) -> None:
        try:
            await self.command(command, *params)
        except CommandRejected:
            self.finish()
            raise

    def finish(self) -> None:
        """Record that the vehicle has ended the calibration."""
        if not self._ended.is_set():
            self._ended.set()
            self._cleanup.close()
            if self in self._runs:
                self._runs.remove(self)

    def _on_reboot(self) -> None:
        self._has_rebooted = True

    @property
    def is_running(self) -> bool:
        return self in self._runs

    # --------------------------------------------------------------------------------------- cancel

    def abandon(self) -> None:
        """Cancel the calibration on the vehicle, without waiting."""
        if not self.is_running or self._is_abandoned:
            return
        self._is_abandoned = True
        if self._cannot_cancel_reason:
            logger.warning("%s was left early: %s", self.call_name, self._cannot_cancel_reason)
        if self._cancel_command is None or self._has_rebooted or self.session.is_closed:
            self.finish()
            return
        arbiter = self.context.arbiter
        # When the pilot or another ground station takes over, the arbiter ends this order, and `_confirm_cancel` stops
        # sending the cancel command.
        order = self._cleanup.enter_context(arbiter.auxiliary_order(ends_with_actions=False))
        sent_command = self._cleanup.enter_context(arbiter.sending(order))
        if self.session.connection.is_open and arbiter.is_state_recent:
            self._send_cancel(self._cancel_command)
        self._is_unconfirmed = True
        self.session.background.start(lambda: self._confirm_cancel(sent_command), "aerokit calibration")

    async def wait_cancelled(self) -> None:
        """Wait until the vehicle has confirmed that the calibration was cancelled.

        Raises:
            NotSupported: the vehicle cannot cancel this calibration.
            OperationTimeout: the vehicle did not confirm the cancellation in time.
        """
        with anyio.move_on_after(MAX_CANCEL_ATTEMPTS * CANCEL_INTERVAL_S):
            await self._ended.wait()
        if self._cannot_cancel_reason:
            raise NotSupported(f"{self.call_name}: {self._cannot_cancel_reason}")
        if self._is_unconfirmed:
            raise OperationTimeout(
                f"{self.call_name}: the vehicle did not confirm the cancellation; {self.session.describe_link()}"
            )

    def _send_cancel(self, cancel: CancelCommand) -> None:
        # The callers have checked that the vehicle is not silent. It may receive this command twice without harm.
        self._cancel_sent_at = self.session.connection.now()
        self.session.commands.forget_result(cancel.command)
        self.session.commands.send_unconfirmed(cancel.command, *cancel.params)

    async def _confirm_cancel(self, sent_command: SentCommand) -> None:
        assert self._cancel_command is not None
        try:
            for attempt in range(MAX_CANCEL_ATTEMPTS):
                was_sent_by_abandon = attempt == 0 and self._cancel_sent_at is not None
                if not was_sent_by_abandon:
                    # Nothing is sent to a silent vehicle, so wait until it has sent a HEARTBEAT after the last attempt.
                    await self.session.wait_for_heartbeat(self._cancel_sent_at)
                    if self._has_rebooted:  # The reboot has ended the calibration.
                        self._is_unconfirmed = False
                        return
                    is_taken_over = bool(sent_command.end)
                    if is_taken_over:  # The command might disturb the pilot or the other ground station.
                        return
                    if not self.context.arbiter.is_state_recent:
                        continue
                    self._send_cancel(self._cancel_command)
                with anyio.move_on_after(CANCEL_INTERVAL_S):
                    while not self._is_cancel_confirmed():  # noqa: ASYNC110
                        await anyio.sleep(CONFIRM_POLL_INTERVAL_S)
                    self._is_unconfirmed = False
                    return
            logger.warning("%s: the vehicle did not confirm the cancellation", self.call_name)
        except OperationRejected:  # The reopened link may lead to another vehicle.
            self._is_unconfirmed = False
        except (ConnectionClosed, LinkLost):  # The vehicle can no longer be reached.
            pass
        finally:
            self.finish()

    def _is_cancel_confirmed(self) -> bool:
        if self._has_rebooted:
            return True
        assert self._cancel_command is not None
        assert self._cancel_sent_at is not None
        command = self._cancel_command.command
        if command != MavCmd.PREFLIGHT_CALIBRATION:
            return self.session.commands.accepted_at(command) >= self._cancel_sent_at
        # PREFLIGHT_CALIBRATION with zeros cancels every calibration of PX4, and ArduPilot's radio calibration.
        if self.session.autopilot.calibration_protocol != "texts":
            # ArduPilot executes the command, but answers UNSUPPORTED (GCS_Common.cpp). So any answer is a confirmation.
            return self.session.commands.last_result(command) is not None
        # PX4 acknowledges PREFLIGHT_CALIBRATION twice, with different results, so its HEARTBEAT is the confirmation.
        status = self.session.telemetry.system_status
        return status.updated_at > self._cancel_sent_at and status.latest != MavState.CALIBRATING

    # --------------------------------------------------------------------------------------- steps

    def is_from_autopilot(self, message: Message) -> bool:
        frame = message.received_frame
        return frame is None or self.session.telemetry.accepts(frame)

    async def wait(
        self,
        is_ready: Callable[[], object],
        timeout: float = REPORT_TIMEOUT_S,
        timeout_text: str = "the vehicle reported nothing about the calibration",
    ) -> None:
        """Wait until ``is_ready`` returns a true value. Raises the errors of `await_progress`."""
        await await_progress(
            self.session,
            self.call_name,
            is_done=lambda: bool(is_ready()),
            failure_reason=self._failure_reason,
            describe=lambda: timeout_text,
            timeout=timeout,
        )

    def _failure_reason(self) -> str | None:
        if self._has_rebooted:
            return "the vehicle rebooted"
        return "the vehicle was armed" if self.session.telemetry.is_armed else None

    def result(
        self, instruction: str = "done", *, reboot_due: bool = False, compasses: tuple[CompassFit, ...] = ()
    ) -> CalibrationStep:
        """Register the end of the calibration, and return the last step."""
        self.finish()
        texts = self.session.texts_since(self._started_at)
        return self.new_step(1.0, instruction, result=CalibrationResult(compasses, reboot_due, texts))

    def failure(self, reason: str) -> OperationRejected:
        return OperationRejected(f"{self.call_name}: {reason}", reasons=self.session.texts_since(self._started_at))
