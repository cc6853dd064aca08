"""Automatic tuning of the controllers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import CommandTimeout, NotSupported, OperationTimeout
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.messages import CommandAck
from aerokit.protocols.command import rejection
from aerokit.vehicle.commanding.context import VehicleBase

if TYPE_CHECKING:
    from collections.abc import Callable

POLL_INTERVAL_S, ANSWER_TIMEOUT_S = 1.0, 1.0
"""Seconds between polls, and seconds to wait for an answer.

PX4 reports the result for two seconds after the end of a tuning. A later poll would start another tuning.
"""
MAX_ANSWER_AGE_S = 1.5
"""Maximum age of PX4's last answer in seconds.

After a longer pause of the program or its event loop, the tuning may have ended.
"""
MAX_PERCENT = 100
"""Maximum of COMMAND_ACK.progress. The value 255 means that the progress is unknown."""
TUNED_PERCENT = 95
"""Progress in percent at which PX4 has finished, and waits for disarming to save its new gains."""


@checks_arguments
class TuningActions(VehicleBase):
    """Automatic tuning."""

    async def autotune(self, *, timeout: float = 120.0, on_progress: Callable[[int], object] | None = None) -> None:
        """Let PX4 tune its controllers in flight (MAV_CMD_DO_AUTOTUNE_ENABLE): **the vehicle shakes about each axis**.

        Call this while a multicopter hovers or a fixed wing circles. Returns when PX4 has finished. With MC_AT_APPLY 1,
        PX4 saves the new gains when it is disarmed. PX4 aborts if the mode changes or the sticks are moved. A cancelled
        call does not stop the tuning; change the mode for that.

        Args:
            timeout: seconds for all axes; PX4 needs about 40.
            on_progress: called with the progress in percent when it changes.

        Raises:
            NotSupported: the firmware is ArduPilot, whose mode AUTOTUNE a pilot controls. Nothing was sent.
            OperationRejected: the mode changed, or another party disarmed the vehicle.
            CommandRejected: PX4 was built without the autotune module, or the tuning failed.
            CommandTimeout: an answer is missing, or the program was paused for too long; PX4 may continue to tune.
            OperationTimeout: the tuning was not done in time; PX4 may continue to tune.
        """
        if not self.autopilot.tunes_by_command:
            raise NotSupported(
                f"autotune: {self.autopilot.firmware} needs a pilot for its mode AUTOTUNE; nothing was sent"
            )
        started = self.connection.now()
        percent = -1  # No progress was reported yet.
        answers: list[CommandAck] = []
        detach = self.connection.bus.attach(CommandAck, answers.append, system_id=self.system_id)
        try:
            with self._arbiter.auxiliary_order() as order:
                while percent < TUNED_PERCENT:
                    if self.connection.now() - started > timeout:
                        progress = "progress unknown" if percent < 0 else f"{percent} %"
                        raise OperationTimeout(
                            f"autotune: not done within {timeout:g} s ({progress}); PX4 may go on tuning"
                        )
                    answer = await self._poll(answers)
                    if answer.result not in (MavResult.IN_PROGRESS, MavResult.ACCEPTED):
                        raise rejection(MavCmd.DO_AUTOTUNE_ENABLE, answer.result)
                    if answer.progress <= MAX_PERCENT and answer.progress != percent:
                        percent = answer.progress
                        if on_progress is not None:
                            on_progress(percent)
                    is_tuned = percent >= TUNED_PERCENT
                    await anyio.sleep(0 if is_tuned else POLL_INTERVAL_S)
                    self._sender.raise_if_ended(order)
                    if not is_tuned:
                        self._raise_if_too_old(answer)
        finally:
            detach()

    async def _poll(self, answers: list[CommandAck]) -> CommandAck:
        """Send the command once, and return PX4's answer. ``answers`` collects every COMMAND_ACK."""
        self._session.end.raise_if_ended()
        answers.clear()
        self._session.commands.send_unconfirmed(MavCmd.DO_AUTOTUNE_ENABLE, 1)
        deadline = self.connection.now() + ANSWER_TIMEOUT_S
        while self.connection.now() < deadline:
            for answer in answers:
                if self._session.is_answer(answer, MavCmd.DO_AUTOTUNE_ENABLE):
                    return answer
            await anyio.sleep(POLL_INTERVAL_S / 20)
        link = self._session.describe_link()
        raise CommandTimeout(f"autotune: MAV_CMD_DO_AUTOTUNE_ENABLE was not acknowledged; PX4 may go on tuning; {link}")

    def _raise_if_too_old(self, answer: CommandAck) -> None:
        # If PX4 has ended this tuning since its answer, the next poll would start another one.
        frame = answer.received_frame
        received_at = self.connection.now() if frame is None else frame.received_at
        age_s = self.connection.now() - received_at + self.connection._slept_since(received_at)
        if age_s > MAX_ANSWER_AGE_S:
            raise CommandTimeout(
                "autotune: this program was blocked for too long and could not poll PX4; PX4 may go on tuning"
            )
