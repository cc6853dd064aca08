"""Getting ready, arming, disarming, rebooting."""

from __future__ import annotations

import anyio

from aerokit.errors import CommandRejected, OperationRejected, OperationTimeout
from aerokit.vehicle.checks import check_seconds
from aerokit.vehicle.modes import ModeActions
from aerokit.vehicle.progress import await_progress

__all__ = ["ArmingActions"]

PREFLIGHT_REBOOT_SHUTDOWN = 246
COMPONENT_ARM_DISARM = 400
FORCE = 21196
FORCE_REBOOT = 20190226
SAID_AGAIN_S = 35.0
"""ArduPilot says every 30 s why it would not arm."""
LOOK_S = 0.1
"""So often it is looked whether a vehicle is back."""


class ArmingActions(ModeActions):
    """From standing there to running motors, and back."""

    async def wait_ready(self, *, timeout: float = 90.0) -> None:
        """Wait until position and home are known, the estimator is healthy and the pre-arm checks pass.

        Raises:
            OperationTimeout: not within ``timeout`` seconds; the text says what is still missing, and what the vehicle
                said of it lately.
        """
        check_seconds("timeout", timeout)
        with self._streaming("sensors", "estimator", "position"), anyio.move_on_after(timeout):
            while self.missing_for_flight():
                self.connection.raise_if_ended()
                await anyio.sleep(0.2)
            return
        said = dict.fromkeys(self._arming_texts(self.connection.now() - SAID_AGAIN_S))
        missing = "\n  - ".join([*self.missing_for_flight(), *said] or ["nothing any more"])
        raise OperationTimeout(
            f"the vehicle was not ready within {timeout:g} s ({self.describe_link()}); still missing:\n  - {missing}"
        )

    async def arm(self, *, force: bool = False, timeout: float = 10.0) -> None:
        """Arm the motors and wait until HEARTBEAT says armed: **propellers may start to turn**.

        Cancelled, the vehicle may arm all the same: the order is out.

        Args:
            force: skip the vehicle's own arming checks. Dangerous.
            timeout: seconds for HEARTBEAT to say so after the command was accepted.

        Raises:
            CommandRejected: the vehicle refused; ``reasons`` has its pre-arm texts, failing sensors and what the
                estimator lacks. They are asked for again where the vehicle can run its checks on request.
            OperationTimeout: it accepted and did not arm.
        """
        check_seconds("timeout", timeout)
        started = self.connection.now()
        try:
            await self._commands.send_long(COMPONENT_ARM_DISARM, 1, FORCE if force else 0)
        except CommandRejected as error:
            reasons = await self._arming_reasons(started)
            raise self._explained(error, started, reasons) from None
        await self._await_armed(True, started, timeout)

    async def disarm(self, *, force: bool = False, timeout: float = 10.0) -> None:
        """Stop the motors and wait until HEARTBEAT says disarmed.

        Args:
            force: also in the air: **the vehicle falls**.
            timeout: seconds for HEARTBEAT to say so after the command was accepted.

        Raises:
            CommandRejected: the vehicle refused, usually because it flies.
            OperationTimeout: it accepted and did not disarm.
        """
        check_seconds("timeout", timeout)
        started = self.connection.now()
        try:
            await self._commands.send_long(COMPONENT_ARM_DISARM, 0, FORCE if force else 0)
        except CommandRejected as error:
            await self._settle()
            raise self._explained(error, started) from None
        await self._await_armed(False, started, timeout)

    async def _await_armed(self, armed: bool, started: float, timeout: float) -> None:
        cell = self.telemetry.armed
        await await_progress(
            self,
            "arm()" if armed else "disarm()",
            is_done=lambda: cell.latest is armed and cell.updated_at > started,
            trouble=lambda: None,
            describe=lambda: "; ".join(self.texts_since(started)) or "the vehicle said nothing about it",
            timeout=timeout,
        )

    async def reboot(self, *, force: bool = False, timeout: float = 60.0) -> None:
        """Reboot the autopilot and wait until it is back: its time since boot has started anew.

        Args:
            force: also while armed: **a flying vehicle falls**.
            timeout: seconds until it is back.

        Raises:
            OperationRejected: it is armed, or not known to be disarmed. Nothing was sent.
            CommandRejected: it refused.
            LinkLost: the link goes down with the vehicle (USB, TCP); connect again.
            OperationTimeout: it did not come back.
        """
        check_seconds("timeout", timeout)
        if not force and not self.is_surely_disarmed:
            state = "armed" if self.is_armed else "not known to be disarmed"
            raise OperationRejected(f"reboot: the vehicle is {state}; nothing was sent")
        reboots = self._watch.reboots
        self._link_watch.ask()  # its time before
        await self._explained_command(PREFLIGHT_REBOOT_SHUTDOWN, 1, *(0.0,) * 4, FORCE_REBOOT if force else 0)
        with self._watch.expecting_reboot(), anyio.move_on_after(timeout):
            await self._await_reboot(reboots)
            return
        raise OperationTimeout(f"reboot: not back within {timeout:g} s; {self.describe_link()}")

    async def _await_reboot(self, reboots: int) -> None:
        """Asks for its time, often at first: a fast simulation is soon older than it was before."""
        accepted_at = ask_at = self.connection.now()
        while self._watch.reboots == reboots:
            self.connection.raise_if_ended()
            now = self.connection.now()
            if now >= ask_at:
                self._link_watch.ask()
                ask_at = now + LOOK_S + (now - accepted_at) / 10
            await anyio.sleep(LOOK_S)
