"""Getting ready, arming, disarming, rebooting."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.commanding.cleanup import LATE_S
from aerokit.vehicle.commanding.context import Part
from aerokit.vehicle.commanding.progress import LONGEST_SILENCE_S, Arrivals, await_progress

if TYPE_CHECKING:
    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.order import Order

FORCE_REBOOT = 20190226
SAID_AGAIN_S = 35.0
"""ArduPilot says every 30 s why it would not arm."""
LOOK_S = 0.1
"""So often it is looked whether a vehicle is back."""
BOOTING = (1, 2)
"""MAV_STATE: booting, calibrating."""
REBOOT_ANSWER_S = 3.0
READY_IN_MODE_S = 3.0
"""How long a vehicle that was put into another mode may take to be ready in it."""

logger: logging.Logger = logging.getLogger("aerokit")


@checks_arguments
class ArmingActions(Part):
    """From standing there to running motors, and back."""

    def missing_for_flight(self) -> list[str]:
        """What is still missing before the vehicle can fly, as far as it is known already; talks to nobody."""
        return self._health.missing_for_flight()

    async def why_not_armable(self) -> list[str]:
        """Return the reasons why arming would be refused now; an empty list means that none is known.

        Asks the vehicle to run its checks (MAV_CMD_RUN_PREARM_CHECKS) where it can do so on request and listens to
        what it says; reads SYS_STATUS and the estimator's flags (ArduPilot EKF_STATUS_REPORT, PX4 ESTIMATOR_STATUS).
        Takes about a second. The vehicle is not armed by it.
        """
        return await self._health.why_not_armable()

    async def wait_ready(self, *, timeout: float = 90.0) -> None:
        """Wait until position and home are known, the estimator is healthy and the pre-arm checks pass.

        The mode does not count: :meth:`arm` leaves one in which the vehicle does not arm. :meth:`why_not_armable`
        names it.

        Raises:
            OperationTimeout: not within ``timeout`` seconds; the text says what is still missing, and what the vehicle
                said of it lately.
        """
        told = self.telemetry
        cells = (told.sensors, told.estimator, told.position, told.home, told.armed)
        with (
            self._talk.streaming("sensors", "estimator", "position"),
            Arrivals(self._talk, *cells, every_arrival=True) as news,
            anyio.move_on_after(timeout),
        ):
            while self._health.missing_for_flight():
                self.connection.raise_if_ended()
                await news.next(timeout)
            return
        said = dict.fromkeys(self._health.arming_texts(self.connection.now() - SAID_AGAIN_S))
        still = [*self._health.missing_for_flight(), *said] or ["nothing any more"]
        missing = "\n  - ".join([*still, *self._health.unarmable_mode()])
        raise OperationTimeout(
            f"the vehicle was not ready within {timeout:g} s ({self._talk.describe_link()}); still missing:\n"
            f"  - {missing}"
        )

    async def arm(
        self,
        *,
        mode: str | int | None = None,
        force: bool = False,
        timeout: float = 10.0,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Arm the motors and wait until HEARTBEAT says armed: **propellers may start to turn**.

        A vehicle that stands in a mode in which it does not arm (RTL or LAND after a flight, OFFBOARD) is put into
        another one first. The order is sent once: a HEARTBEAT that says disarmed does not tell whether a pilot has
        disarmed it since. Cancelled, or ended by any error but a refusal, it may still be carried out: for 15 seconds
        the vehicle is watched, and disarmed if this order arms it (the vehicle accepts it, or is armed at the next
        HEARTBEAT and nobody else has taken it), as long as the connection is there. Logger "aerokit" warns of what
        came of it, also of an arming that nothing shows to be this order's: that one is left alone.

        Args:
            mode: where to arm; None: the present mode, or one that ``take_off`` begins in if it cannot be armed there.
            force: skip the vehicle's own arming checks. Dangerous.
            timeout: seconds for HEARTBEAT to say so after the command was accepted.
            max_silence_s: give up when no heartbeat has come for so many seconds; None: wait on until ``timeout``.

        Raises:
            InvalidArgument: there is no such mode, or the vehicle does not arm in it. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has its pre-arm texts, failing sensors and what the
                estimator lacks. They are asked for again where the vehicle can run its checks on request.
            CommandTimeout: there was no answer, and it did not arm; the text says whether the order may still arrive.
            OperationRejected: it is armed already, in another mode than ``mode``, and nothing was sent; or somebody
                else has disarmed it, or changed its mode, meanwhile.
            HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds.
            OperationTimeout: it accepted and did not arm.
        """
        wanted = self._mode_to_arm_in(mode)
        if wanted is not None:
            await self._go_to_arming_mode(wanted)
        self._late_arming.stop()
        started, was_armed = self.connection.now(), self.telemetry.is_armed
        with self._arbiter.aside() as order:
            try:
                await self._sender.give_arm(order, True, force=force)
                await self._await_armed(True, order, started, timeout, max_silence_s)
            except CommandRejected as error:
                reasons = await self._health.arming_reasons(started)
                raise self._talk.explained(error, started, reasons) from None
            except CommandTimeout as error:
                self._late_arming.watch(order, was_armed)
                raise CommandTimeout(f"{error}; {self._late_arming.text()}") from None
            except (anyio.get_cancelled_exc_class(), AerokitError):
                self._late_arming.watch(order, was_armed)
                raise

    async def disarm(
        self,
        *,
        force: bool = False,
        timeout: float = 10.0,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Stop the motors and wait until HEARTBEAT says disarmed.

        Args:
            force: also in the air: **the vehicle falls**.
            timeout: seconds for HEARTBEAT to say so after the command was accepted.
            max_silence_s: give up when no heartbeat has come for so many seconds; None: wait on until ``timeout``.

        Raises:
            CommandRejected: the vehicle refused, usually because it flies.
            CommandTimeout: there was no answer.
            HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds.
            OperationTimeout: it accepted and did not disarm.
        """
        self._late_arming.stop()
        started = self.connection.now()
        with self._arbiter.aside(ends_flight=True) as order:
            await self._sender.give_arm(order, False, force=force)
            await self._await_armed(False, order, started, timeout, max_silence_s)

    async def _await_armed(
        self, armed: bool, order: Order, started: float, timeout: float, max_silence_s: float | None
    ) -> None:
        cell = self.telemetry.armed
        await await_progress(
            self._talk,
            "arm()" if armed else "disarm()",
            is_done=lambda: cell.latest is armed and cell.updated_at > started,
            trouble=lambda: order.taken_by if armed else None,
            describe=lambda: (
                "; ".join(self._talk.texts_since(started)) or "the vehicle said nothing about it"
            ),
            timeout=timeout,
            max_silence_s=max_silence_s,
        )

    # ------------------------------------------------------------------------ where it arms

    def _mode_to_arm_in(self, mode: str | int | None) -> Mode | None:
        """The mode to change to before arming; None: the present one will do."""
        if mode is not None:
            wanted = self.autopilot.find_mode(mode, self.telemetry.mode_names)
            if wanted.name in self.autopilot.unarmable_modes:
                raise InvalidArgument(
                    f"mode = {mode!r} is not allowed: {self._health.unarmable_text(wanted)}"
                )
            if self.telemetry.is_armed and wanted != self.telemetry.mode.latest:
                raise OperationRejected(
                    f"arm: the vehicle is armed already, in {self.telemetry.mode_name}; nothing was sent"
                )
            return wanted
        is_booting = self.telemetry.system_status.latest in BOOTING
        if (
            self._holding.end_stream is not None
            or is_booting
            or not self.telemetry.is_surely_disarmed
            or not self._health.unarmable_mode()
        ):
            return None
        return self.autopilot.mode_to_arm_in()

    async def _go_to_arming_mode(self, wanted: Mode) -> None:
        """Afterwards the order to arm is not meant any more, or not yet, if anything has come between."""
        order, count = self._arbiter.order(wanted), self._arbiter.arming_orders
        await self._sender.ensure_mode(wanted, order)
        await self._settle_in_mode()
        self._sender.raise_if_over(order)
        if self._arbiter.arming_orders != count:
            raise OperationRejected("arm(): another order to arm or disarm was given; it was not told to arm")
        if not self._arbiter.is_known:
            raise HeartbeatTimeout(f"arm(): {self._talk.describe_link()}; it was not told to arm")

    async def _settle_in_mode(self) -> None:
        """PX4 tells by SYS_STATUS, some times a second, whether it could be armed in its new mode."""
        sensors = self.telemetry.sensors
        with self._talk.streaming("sensors"), anyio.move_on_after(READY_IN_MODE_S):
            since = self.connection.now()
            await sensors.wait_until(
                lambda each: sensors.updated_at > since and each.prearm_checks_pass is not False
            )

    # ------------------------------------------------------------------------------ rebooting

    async def reboot(self, *, force: bool = False, timeout: float = 60.0) -> None:
        """Reboot the autopilot and wait until it is back: its time since boot has started anew.

        Args:
            force: also while armed: **a flying vehicle falls**.
            timeout: seconds until it is back.

        Raises:
            OperationRejected: it is armed, or not known to be disarmed. Nothing was sent.
            CommandRejected: it refused.
            CommandTimeout: there was no answer, and it did not reboot.
            LinkLost: the link goes down with the vehicle (USB, TCP); connect again.
            OperationTimeout: it did not come back.
        """
        if not force and not self.telemetry.is_surely_disarmed:
            state = "armed" if self.telemetry.is_armed else "not known to be disarmed"
            raise OperationRejected(f"reboot: the vehicle is {state}; nothing was sent")
        reboots = self._talk.watch.reboots
        self._talk.link_watch.ask()  # its time before
        unanswered: CommandTimeout | None = None
        with self._talk.watch.expecting_reboot():
            try:
                await self._order_reboot(force)
            except CommandTimeout as error:
                unanswered = error
            with anyio.move_on_after(timeout if unanswered is None else min(timeout, LATE_S)):
                await self._await_reboot(reboots)
                return
        if unanswered is not None:
            raise CommandTimeout(f"{unanswered}; it is sent once only, and may still be carried out")
        raise OperationTimeout(f"reboot: not back within {timeout:g} s; {self._talk.describe_link()}")

    async def _order_reboot(self, force: bool) -> None:
        """Once: a vehicle that has rebooted, and whose answer was lost, would do it again."""
        params = (1, *(0.0,) * 4, FORCE_REBOOT if force else 0)
        options: dict[str, Any] = {"attempts": 1, "attempt_timeout": REBOOT_ANSWER_S}
        with self._arbiter.aside() as order:
            await self._sender.give(
                order, self._talk.commands.send_long, MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, *params, **options
            )

    async def _await_reboot(self, reboots: int) -> None:
        """Asks for its time, often at first: a fast simulation is soon older than it was before."""
        accepted_at = ask_at = self.connection.now()
        while self._talk.watch.reboots == reboots:
            self.connection.raise_if_ended()
            now = self.connection.now()
            if now >= ask_at:
                self._talk.link_watch.ask()
                ask_at = now + LOOK_S + (now - accepted_at) / 10
            await anyio.sleep(LOOK_S)
