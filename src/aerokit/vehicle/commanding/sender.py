"""`OrderSender`: sends the commands of orders: single commands, mode changes, arming."""

from __future__ import annotations

import math
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import anyio

from aerokit._internal.arguments import check_range
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.protocols.command import ATTEMPT_TIMEOUT_S, BROADCAST, MAX_ATTEMPTS, allowed_attempts, rejection
from aerokit.vehicle.commanding.arbiter import ARM_HEARTBEAT_DELAY_S, MODE_GRACE_S, MODE_MAX_AGE_S, STEERING
from aerokit.vehicle.commanding.ground import ImpactDetector
from aerokit.vehicle.commanding.order import ARM_ALONE, CHANGED_BY_COMMAND, MOTION, REQUEST_COMMANDS, SUPERSEDED
from aerokit.vehicle.commanding.progress import MAX_SILENCE_S, await_progress
from aerokit.vehicle.session.commands import PENDING_ACK_TIMEOUT_S

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterator

    from aerokit.autopilots import Mode, Purpose
    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.commanding.arbiter import CommandArbiter
    from aerokit.vehicle.commanding.order import Order, SentCommand
    from aerokit.vehicle.session.session import VehicleSession

FORCE = 21196
"""param2 of COMPONENT_ARM_DISARM that skips the pre-arm checks."""
# HEARTBEAT reports the effect of a command to disarm within this many seconds, even if one HEARTBEAT is lost.
DISARM_REPORT_TIMEOUT_S = 3.5
ACCEPTANCE_REVOKED = "the vehicle accepted the command and then refused it"


def add_clause(error: AerokitError, clause: str) -> None:
    """Append a clause to the error's text, in front of the vehicle's reasons."""
    text, newline, reasons = str(error).partition("\n")
    error.args = (f"{text}; {clause}{newline}{reasons}",)


@contextmanager
def adding_clause(order: Order, clause: str) -> Iterator[None]:
    """Append a clause to the error of a command that was sent, but neither refused nor acknowledged."""
    try:
        yield
    except CommandRejected:  # The vehicle certainly does not execute the command.
        raise
    except (CommandTimeout, OperationRejected) as error:
        if order.was_sent:
            add_clause(error, clause)
        raise


def revoked_acceptance(operation: str, command: int, result: int) -> CommandRejected:
    """Return the error of a command that the vehicle has refused after an earlier acceptance."""
    error = rejection(command, result)
    error.args = (f"{operation}: {ACCEPTANCE_REVOKED}: {error}",)
    return error


class AcceptedDisarm(NamedTuple):
    accepted_at: float
    effect_reported_after: float  # A HEARTBEAT that reports disarmed shows the effect if it arrives after this time.


class OrderSender:
    """Sends the MAVLink commands that carry out an order, and repeats them only as docs/reliability.md allows."""

    def __init__(self, session: VehicleSession, arbiter: CommandArbiter) -> None:
        self._session, self._arbiter = session, arbiter

    async def run_command(
        self,
        order: Order,
        send: Callable[..., Awaitable[CommandAck]],
        command: int,
        *params: float,
        modes: tuple[Mode, ...] = (),
        armed: bool | None = None,
        is_done: Callable[[], bool] = lambda: False,
        **options: Any,
    ) -> None:
        """Send one command of an order until it is acknowledged or its effect is reported.

        The effect is reported when HEARTBEAT changes to one of ``modes`` or to ``armed``, or when ``is_done()`` returns
        True. Before the second and later commands of a steering order, this call waits for a recent HEARTBEAT.

        Raises:
            OperationRejected: the order was superseded or taken over, or the computer slept.
            HeartbeatTimeout: the vehicle was silent before a second or later command.
            CommandRejected: the vehicle refused; ``reasons`` has its status texts.
            CommandTimeout: there was no acknowledgement, although the order was neither superseded nor taken over; the
                text says why the command was not sent again.
        """
        self.raise_if_ended(order)
        is_steering = STEERING in order.ending_topics
        if order.was_sent and is_steering:
            await self.await_recent_state(order)
        order.may_move = order.may_move or command in CHANGED_BY_COMMAND
        if CHANGED_BY_COMMAND.get(command) == MOTION:
            # PX4 ends a take-off or a mission by a change to HOLD, which does not confirm this command.
            late_modes = self._arbiter.late_modes()
            modes = () if self._is_taking_off else tuple(mode for mode in modes if mode not in late_modes)
        started, was_sent_before = self._session.connection.now(), order.was_sent
        sent: SentCommand | None = None
        try:
            with self._arbiter.sending(order, modes=modes, armed=armed, is_done=is_done) as sent:
                try:
                    await send(command, *params, order_status=sent, **options)
                except CommandRejected as error:
                    # The vehicle may refuse a repetition because the command has already taken effect.
                    if not sent.is_confirmed:
                        order.was_refused = True
                        await self._session.wait_for_status_texts()
                        raise self._session.with_reasons(error, started) from None
                except CommandTimeout:
                    if not sent.is_confirmed:  # If its effect was reported, only the acknowledgement was lost.
                        raise
        except CommandTimeout as error:
            order.was_sent = was_sent_before or error.was_sent
            raise self._error_without_answer(error, order, sent) from None

    @property
    def _is_taking_off(self) -> bool:
        telemetry = self._session.telemetry
        mode = self._session.autopilot.mode_for("take_off", is_vtol=telemetry.is_vtol)
        return mode is not None and telemetry.is_in(mode)

    async def send_long(self, order: Order, command: int, *params: float, **options: Any) -> None:
        """Send one command of an order as COMMAND_LONG; see :meth:`run_command`."""
        await self.run_command(order, self._session.commands.send_long, command, *params, **options)

    def raise_if_ended(self, order: Order) -> None:
        if order.end:
            raise OperationRejected(f"{order.end}; the rest of the order was not sent")

    async def await_recent_state(self, order: Order | None = None) -> None:
        """Wait for a recent HEARTBEAT. Pass ``order`` if one of its commands was already sent.

        Raises OperationRejected if the order has ended or the computer slept, and HeartbeatTimeout if there is no
        HEARTBEAT for ``MAX_SILENCE_S``.
        """
        if order:
            self.raise_if_slept(order)
        if self._arbiter.is_state_recent:
            return
        # After a silence of `MAX_SILENCE_S`, the command would be too late. HEARTBEATs that could not be read earlier,
        # because the event loop was blocked, do not extend this time.
        with anyio.move_on_after(max(0.0, MAX_SILENCE_S - self._session.telemetry.armed.age)) as scope:
            await self._session.wait_for_heartbeat()
        if scope.cancelled_caught:
            link = self._session.describe_link()
            unsent = "the rest of the order was not sent" if order else "nothing was sent to it"
            raise HeartbeatTimeout(f"the vehicle is silent; {link}; {unsent}")
        if order:
            self.raise_if_ended(order)
            self.raise_if_slept(order)

    def raise_if_slept(self, order: Order) -> None:
        # A step that only stops the vehicle is never too late.
        if not order.only_stops and self._arbiter.slept_since(order.given_at) > 0:
            raise OperationRejected("the computer slept; the rest of the order was not sent")

    def _error_without_answer(self, error: CommandTimeout, order: Order, sent: SentCommand | None) -> Exception:
        """Return OperationRejected if a newer order or another party ended the wait for the answer, else ``error``."""
        if order.takeover_reason or (order.failsafe and order.end):  # Another party has ended the order.
            text = str(error) if order.end in str(error) else f"{error}; {order.end}"
            return OperationRejected(text, reasons=self._session.texts_since(order.given_at))
        # A command to arm is overruled by one to disarm, and the reverse.
        is_overruled = sent is not None and sent.end == SUPERSEDED and order.is_newest
        if is_overruled or self._arbiter.is_replaced(order):
            # If the time-out ended the wait, `error` does not name the newer order yet.
            return OperationRejected(str(error) if SUPERSEDED in str(error) else f"{error}; {SUPERSEDED}")
        return error

    async def send_arm(self, order: Order, *, armed: bool, force: bool = False) -> None:
        # `ArmCleanup` must not take the ack of an earlier command for the ack of this one.
        self._session.commands.forget_result(MavCmd.COMPONENT_ARM_DISARM)
        params = (float(armed), FORCE if force else 0)
        await self.send_long(order, MavCmd.COMPONENT_ARM_DISARM, *params, armed=armed)

    async def send_disarm(self, order: Order, *, force: bool = False, timeout: float = math.inf) -> AcceptedDisarm:
        """Send the command to disarm until it is acknowledged.

        On a link that duplicates frames, a second COMMAND_ACK of an earlier command to arm looks like the one of this
        command. If this is possible, wait for HEARTBEAT, at most ``timeout`` seconds. If it still reports armed, send
        the command once more.
        """
        armed, now = self._session.telemetry.armed, self._session.connection.now
        started, was_armed = now(), armed.latest
        may_be_answer_to_arm = self._may_be_answer_to_arm()
        await self.send_arm(order, armed=False, force=force)
        accepted_at = now()
        if not may_be_answer_to_arm:
            return AcceptedDisarm(accepted_at, effect_reported_after=started)
        effect_due_at = accepted_at + ARM_HEARTBEAT_DELAY_S

        def effect_reported_after() -> float:
            # Until a HEARTBEAT has reported the arming, one that reports disarmed may be from before the arming.
            is_arming_reported = was_armed or self._arbiter.last_arming_at > started
            return started if is_arming_reported else effect_due_at

        is_still_armed = False
        with suppress(OperationTimeout):
            is_still_armed = await armed.wait_until(
                lambda is_armed: armed.updated_at > (effect_due_at if is_armed else effect_reported_after()),
                timeout=min(timeout, DISARM_REPORT_TIMEOUT_S),
            )
        is_current = self._arbiter.is_state_recent and not self._arbiter.slept_since(started)
        is_last_command_to_disarm = self._arbiter.last_arm_command is False
        may_repeat = is_current and is_last_command_to_disarm and not order.end
        if is_still_armed and may_repeat:
            await self.send_arm(order, armed=False, force=force)
            accepted_at = now()
        return AcceptedDisarm(accepted_at, effect_reported_after())

    def _may_be_answer_to_arm(self) -> bool:
        """Return True if the next answer to a command to disarm may answer an earlier command to arm."""
        commands, command = self._session.commands, MavCmd.COMPONENT_ARM_DISARM
        is_unanswered = commands.may_get_late_ack(command, self._session.component_id)
        answered_before_s = self._session.connection.now() - commands.accepted_at(command)
        return self._arbiter.is_arm_command_open or is_unanswered or answered_before_s <= PENDING_ACK_TIMEOUT_S

    # ----------------------------------------------------------------------------------- modes

    async def change_mode(
        self,
        mode: Mode,
        order: Order,
        timeout: float = 6.0,
        *,
        reported_since: float = -math.inf,
        is_over: Callable[[float], bool] = lambda _: False,
    ) -> None:
        """Order the mode and wait until a message received after ``reported_since`` reports it.

        ``is_over(acknowledged_at)`` returns True if the vehicle has left the mode again before HEARTBEAT reported it.
        """
        started = self._session.connection.now()
        was_in_doubt = self._arbiter.mode_is_in_doubt
        with self._session.refusals_of(MavCmd.DO_SET_MODE) as refusals, self._arbiter.changing_mode():
            # The request is sent up to four times, and all four attempts must fit into the time-out.
            await self.request_mode(mode, order, attempt_timeout=min(1.0, timeout / 4))
            acknowledged_at = self._session.connection.now()
            if was_in_doubt:  # HEARTBEATs before the ack may report an earlier mode change.
                reported_since = acknowledged_at
            remaining_s = timeout - (acknowledged_at - started)
            await self.await_mode(
                mode, order, refusals, remaining_s, reported_since, is_over=lambda: is_over(acknowledged_at)
            )
            self._arbiter.settle_mode()

    async def request_mode(
        self,
        mode: Mode,
        order: Order,
        *,
        attempt_timeout: float | None = None,
        base_mode: int | None = None,
        component_id: int | None = None,
    ) -> None:
        """Order a mode without waiting for HEARTBEAT to report it."""
        request = self._session.autopilot.mode_order(mode)
        if base_mode is not None:
            _, *mode_numbers = request.params
            request = request.replace(base_mode=base_mode, params=(base_mode, *mode_numbers))
        try:
            await self.send_long(
                order,
                MavCmd.DO_SET_MODE,
                *request.params,
                modes=(mode,),
                attempt_timeout=attempt_timeout,
                component_id=component_id,
            )
        except CommandRejected as error:
            # Firmware that does not support the command gets one SET_MODE instead, a message without a component id.
            is_for_autopilot = component_id in (None, BROADCAST, self._session.component_id)
            if error.result != MavResult.UNSUPPORTED or not is_for_autopilot:
                raise
            self.raise_if_ended(order)
            if not self._arbiter.is_state_recent:  # While the vehicle is silent, a takeover may be unreported.
                raise
            self._session.send(request.legacy(self._session.system_id))
            order.was_refused = False

    async def await_mode(
        self,
        mode: Mode,
        order: Order,
        refusals: list[CommandAck],
        timeout: float,
        reported_since: float,
        *,
        is_over: Callable[[], bool] = lambda: False,
    ) -> None:
        """Wait until a recent message received after ``reported_since`` reports the mode, or ``is_over()`` is true."""
        telemetry = self._session.telemetry

        def is_reported() -> bool:
            is_recent = telemetry.mode.updated_at > reported_since and telemetry.mode.age <= MODE_MAX_AGE_S
            return (telemetry.is_in(mode) and is_recent) or is_over()

        await self.await_effect(
            f"set_mode({mode.name})",
            order,
            refusals,
            is_done=is_reported,
            failure_reason=lambda: order.end or None,
            timeout=max(0.1, timeout),
        )

    async def await_effect(
        self,
        operation: str,
        order: Order,
        refusals: list[CommandAck],
        *,
        is_done: Callable[[], bool],
        failure_reason: Callable[[], str | None],
        timeout: float,
        max_silence_s: float | None = MAX_SILENCE_S,
    ) -> None:
        """Wait until ``is_done()`` reports the effect of an accepted command.

        ``operation`` is the name for error texts. ``refusals`` is the list that ``VehicleSession.refusals_of`` fills:
        PX4 acknowledges some commands twice, first always with ACCEPTED, then perhaps with a refusal.

        Raises:
            CommandRejected: the vehicle first accepted and then refused the command.
            OperationRejected: ``failure_reason()`` returned a reason.
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
            OperationTimeout: the effect was not reported within ``timeout`` seconds.
        """
        telemetry, started = self._session.telemetry, self._session.connection.now()
        try:
            await await_progress(
                self._session,
                operation,
                is_done=is_done,
                failure_reason=lambda: ACCEPTANCE_REVOKED if refusals else failure_reason(),
                describe=lambda: (
                    f"the vehicle is in {telemetry.mode_name}, {'' if telemetry.is_armed else 'not '}armed"
                ),
                timeout=timeout,
                max_silence_s=max_silence_s,
            )
        except OperationRejected:
            if not refusals:
                raise
            order.was_refused = True
            last_refusal = refusals[-1]
            error = revoked_acceptance(operation, last_refusal.command, last_refusal.result)
            raise self._session.with_reasons(error, started) from None

    async def ensure_mode(self, mode: Mode, order: Order) -> None:
        """Change the mode if it is in doubt, or if no recent HEARTBEAT reports it."""
        is_reported = self._session.telemetry.is_in(mode) and self._session.telemetry.mode.age <= MODE_MAX_AGE_S
        if self._arbiter.mode_is_in_doubt or not is_reported:
            await self.change_mode(mode, order)

    def mode_for(self, action: str, purpose: Purpose) -> Mode:
        """Return the autopilot's mode for this purpose. Raises NotSupported if there is none."""
        mode = self._session.autopilot.mode_for(purpose, is_vtol=self._session.telemetry.is_vtol)
        if mode is None:
            raise NotSupported(f"{action}: {self._session.autopilot.firmware} has no mode for this action")
        return mode

    def mode_failure(self, order: Order, *modes: Mode) -> Callable[[], str | None]:
        """Return a function that returns the reason why the order has failed, or None while it may succeed.

        Possible reasons are a newer order, an impact on the ground, disarming, and a mode that is not one of
        ``modes``. The vehicle has three seconds to report one of the modes.
        """
        describe_impact = self.impact_failure(order)
        grace_until = self._session.connection.now() + MODE_GRACE_S
        settles_at = max(order.settles_at, self._arbiter.mode_settles_at)
        was_reported = was_in_mode = False

        def failure_reason() -> str | None:
            nonlocal was_reported, was_in_mode
            reason = describe_impact() or order.end
            if reason:
                return reason
            if self._session.telemetry.is_confirmed_disarmed:
                return "the vehicle disarmed"
            mode = self._session.telemetry.mode.latest
            was_reported = was_reported or mode in modes
            if self._session.connection.now() < settles_at:  # The mode of an abandoned order may still be reported.
                return None
            if mode in modes:
                was_in_mode = True
                return None
            if was_in_mode:
                return f"the mode changed to {mode}"
            if self._session.connection.now() <= grace_until:
                return None
            return f"the mode changed to {mode}" if was_reported else f"the vehicle stayed in {mode}"

        return failure_reason

    def impact_failure(self, order: Order) -> Callable[[], str]:
        """Return a function that describes an impact on the ground; its text is empty if there is none."""
        detector = ImpactDetector(self._session.telemetry)

        def failure_reason() -> str:
            detector.update()
            order.impact = detector.describe() if order.is_newest else ""  # `FlightCleanup.flying` reads it.
            return order.impact

        return failure_reason

    def landing_failure(self, order: Order) -> Callable[[], str | None]:
        """Like :meth:`mode_failure`, for an order that the vehicle completes by disarming."""
        mode_failure, armed = self.mode_failure(order, *order.modes), self._session.telemetry.armed

        def failure_reason() -> str | None:
            if order.has_lost_mode and armed.updated_at < order.mode_lost_at:
                # The mode change was reported by CURRENT_MODE. The next HEARTBEAT may report that the vehicle has
                # landed and disarmed, so wait for it.
                return None
            return mode_failure()

        return failure_reason

    async def auxiliary_command(
        self, command: int, *params: float, device_order: Order | None = None, **options: Any
    ) -> None:
        """Send a command that changes a setting or a device and does not steer, as a part of ``device_order``."""
        is_repeatable = allowed_attempts(command, params) > 1
        with self._arbiter.auxiliary_order(device_order, ends_with_actions=is_repeatable) as order:
            await self.send_long(order, command, *params, **options)

    # ---------------------------------------------------------------------------- raw commands

    async def send_raw(
        self,
        send: Callable[..., Awaitable[CommandAck]],
        command: int,
        *params: float,
        retries: int | None,
        **options: Any,
    ) -> CommandAck:
        """Send a raw command of the program. ``send`` is a method of `CommandSender`."""
        started = self._session.connection.now()
        if retries is None:
            # Only requests are repeated. A repetition would execute any other command twice if only the acknowledgement
            # of the first transmission was lost.
            retries = MAX_ATTEMPTS - 1 if command in REQUEST_COMMANDS else 0
        check_range("retries", retries, 0, 1000)
        options["attempts"] = 1 + retries
        if options["attempt_timeout"] is None and not retries:
            # A command that is sent only once waits as long as a repeated command does in all its attempts.
            options["attempt_timeout"] = MAX_ATTEMPTS * ATTEMPT_TIMEOUT_S
        try:
            if command in REQUEST_COMMANDS:
                return await send(command, *params, **options)
            names = self._session.telemetry.mode_names
            modes = self._session.autopilot.modes_of_command(command, params, names)
            armed: bool | None = None  # True if the command arms the vehicle, False if it disarms the vehicle.
            if command == MavCmd.COMPONENT_ARM_DISARM:
                armed = bool(params) and params[0] == 1  # A missing parameter is sent as 0.
            with (
                self._raw_order(command, modes, is_repeatable=retries > 0) as order,
                self._arbiter.sending(order, modes=modes, armed=armed) as sent,
            ):
                return await send(command, *params, order_status=sent, **options)
        except CommandRejected as error:
            await self._session.wait_for_status_texts()
            raise self._session.with_reasons(error, started) from None

    @contextmanager
    def _raw_order(self, command: int, modes: Collection[Mode], *, is_repeatable: bool) -> Iterator[Order]:
        subjects = CHANGED_BY_COMMAND.get(command, ())
        if subjects and subjects != ARM_ALONE:
            yield self._arbiter.raw_order(subjects, modes=modes)
        else:
            with self._arbiter.auxiliary_order(ends_with_actions=is_repeatable) as order:
                yield order
