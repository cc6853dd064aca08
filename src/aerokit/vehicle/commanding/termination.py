"""Flight termination, and shutdown of the autopilot."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Literal

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import LinkLost, NotSupported
from aerokit.mavlink.enums import MavCmd, MavState
from aerokit.vehicle.commanding.context import VehicleBase
from aerokit.vehicle.commanding.progress import MAX_SILENCE_S, await_progress
from aerokit.vehicle.commanding.sender import adding_clause

TerminationIntent = Literal["terminate flight"]
ShutdownIntent = Literal["shut down"]

ANSWER_TIMEOUT_S = 3.0
TERMINATE = 1.0
"""param1 of DO_FLIGHTTERMINATION that terminates the flight."""
SHUTDOWN = 2
"""param1 of PREFLIGHT_REBOOT_SHUTDOWN that switches the autopilot off."""
SEND_ONCE: dict[str, Any] = {"attempts": 1, "attempt_timeout": ANSWER_TIMEOUT_S}


@checks_arguments
class TerminationActions(VehicleBase):
    """Flight termination and shutdown. Each call has to state its intent, to prevent calls by mistake."""

    async def terminate(self, *, intent: TerminationIntent, timeout: float = 10.0) -> None:
        """Terminate the flight (MAV_CMD_DO_FLIGHTTERMINATION): **the motors stop, and the vehicle falls**.

        Returns when HEARTBEAT reports disarmed, PX4's mode TERMINATION, or MAV_STATE_FLIGHT_TERMINATION. The command is
        sent once and immediately, even to a silent vehicle. It is neither repeated nor sent later. A cancelled call may
        have terminated the flight. PX4 releases its parachute if it has one, and needs a restart afterwards. ArduPlane
        and Rover refuse the command unless AFS_ENABLE is 1 and AFS_TERM_ACTION is 42.

        Args:
            intent: must be ``"terminate flight"``.
            timeout: seconds for HEARTBEAT to report the termination after the command was accepted.

        Raises:
            InvalidArgument: the intent is another text. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has its status texts. PX4 refuses the command while
                disarmed.
            CommandTimeout: there was no acknowledgement; the flight may still have been terminated.
            OperationRejected: another order was given, or another party took over, before the acknowledgement; the
                flight may still have been terminated.
            HeartbeatTimeout: the vehicle accepted the command, but its last HEARTBEAT is ten seconds old.
            OperationTimeout: the vehicle accepted the command, but HEARTBEAT does not report the termination.
        """
        # The decorator `checks_arguments` has refused every other intent.
        modes = self.autopilot.modes_of_command(MavCmd.DO_FLIGHTTERMINATION, (TERMINATE,))
        self._arm_cleanup.stop_watching()
        order = self._arbiter.order(*modes, ends_flight=True)
        with adding_clause(order, "the flight may have been terminated nevertheless"):
            command = MavCmd.DO_FLIGHTTERMINATION
            await self._sender.send_long(order, command, TERMINATE, modes=modes, armed=False, **SEND_ONCE)
        armed, state = self.telemetry.armed, self.telemetry.system_status

        def is_terminated() -> bool:
            is_off = armed.latest is False or state.latest == MavState.FLIGHT_TERMINATION
            is_reported = is_off or any(map(self.telemetry.is_in, modes))
            return is_reported and armed.updated_at > order.given_at  # HEARTBEAT reports arming, state and mode.

        await await_progress(
            self._session,
            "terminate",
            is_done=is_terminated,
            failure_reason=lambda: None,
            describe=lambda: f"the vehicle is in {self.telemetry.mode_name}, still armed",
            timeout=timeout,
            max_silence_s=MAX_SILENCE_S,
        )

    async def shutdown(self, *, intent: ShutdownIntent, timeout: float = 15.0) -> None:
        """Switch the autopilot off, and wait until its HEARTBEATs end (MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN).

        Only a person at the vehicle can switch it on again. HEARTBEATs count as ended after 3.5 s without a HEARTBEAT,
        or when the link goes down after the acknowledgement. The command is sent once. A cancelled call may have
        switched the autopilot off.

        Args:
            intent: must be ``"shut down"``.
            timeout: seconds until the vehicle is silent.

        Raises:
            InvalidArgument: the intent is another text. Nothing was sent.
            NotSupported: this firmware cannot be switched off (ArduPilot). Nothing was sent.
            OperationRejected: the vehicle is armed, or not known to be disarmed, and nothing was sent; or another order
                was given before the acknowledgement, and the autopilot may still have switched off.
            CommandRejected: the vehicle refused, as PX4 does on boards that cannot switch their power off.
            CommandTimeout: there was no acknowledgement; the autopilot may still have switched off.
            OperationTimeout: the autopilot accepted the command, but still sends HEARTBEATs.
        """
        # The decorator `checks_arguments` has refused every other intent.
        if not self.autopilot.can_shut_down:
            raise NotSupported(f"shutdown: {self.autopilot.firmware} cannot be switched off; nothing was sent")
        self._session.check_disarmed("shutdown")
        with (
            self._arbiter.auxiliary_order(ends_with_actions=False) as order,
            adding_clause(order, "the autopilot may have switched off nevertheless"),
        ):
            await self._sender.send_long(order, MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, SHUTDOWN, **SEND_ONCE)
        with suppress(LinkLost):  # The link may go down with the autopilot.
            await await_progress(
                self._session,
                "shutdown",
                is_done=lambda: self._session.watch.is_silent,
                failure_reason=lambda: None,
                describe=lambda: "the autopilot still sends HEARTBEATs",
                timeout=timeout,
                max_silence_s=None,
            )
