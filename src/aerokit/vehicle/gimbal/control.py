"""``GimbalControl``: control of a gimbal for the duration of a block."""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import (
    AerokitError,
    BusyError,
    CommandRejected,
    CommandTimeout,
    GimbalTaken,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.events import SILENT_AFTER_S, GimbalControlLost
from aerokit.mavlink.enums import MavResult
from aerokit.mavlink.messages import GimbalManagerStatus, Heartbeat
from aerokit.vehicle.gimbal.device import ControlRequest
from aerokit.vehicle.gimbal.orders import CONFIGURE, GimbalOrders

if TYPE_CHECKING:
    from collections.abc import Callable

    from typing_extensions import Self

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.gimbal.device import GimbalControllers, GimbalDevice

__all__ = ["GimbalControl"]

RELEASE_ATTEMPTS, ATTEMPT_TIMEOUT_S = 10, 0.5
# A message has no acknowledgement, so it is repeated.
STOP_MESSAGE_COUNT, STOP_MESSAGE_INTERVAL_S = 5, 0.1


class ReleaseCommand:
    """The command that stops or releases a gimbal at the end of a block. It is repeated until it is acknowledged.

    ``is_still_due`` is checked before each transmission, so that the command does not undo a newer order or the control
    of another station. If the vehicle or the gimbal manager is silent, the command is sent at the next HEARTBEAT.
    ``stop_message`` is sent several times after the acknowledgement.
    """

    def __init__(
        self,
        orders: GimbalOrders,
        command: int,
        params: tuple[float, ...],
        is_still_due: Callable[[], bool],
        stop_message: Message | None = None,
    ) -> None:
        self._orders = orders
        self._session = orders.session
        self._command = command
        self._params = params
        self._is_still_due = is_still_due
        self._stop_message = stop_message
        # Component id of the manager when this object was created; another manager may be known later.
        self._manager_id = orders.manager_id

    async def send_and_wait(self, description: str) -> None:
        """Send the command and wait for its acknowledgement.

        If the vehicle is silent, raises OperationTimeout. A background task then sends the command at the next
        HEARTBEAT.
        """
        if not self._is_still_due():
            return
        if not self._orders.context.arbiter.is_state_recent:
            self.send_soon()
            raise OperationTimeout(
                f"{description}: the command was not sent yet, because the vehicle is silent; it will be sent at the"
                " next HEARTBEAT;"
                f" {self._session.describe_link()}"
            )
        self._send()
        try:
            await self._repeat_until_acknowledged()
        except asyncio.CancelledError:
            self.send_soon(was_just_sent=True)  # The command may have been lost, so it is retried in the background.
            raise

    def send_soon(self, *, was_just_sent: bool = False) -> None:
        """Send the command without waiting, and repeat it if no ack arrives.

        ``was_just_sent`` means that the caller has sent the command already.
        """
        if not self._session.is_open or not self._is_still_due():
            return
        is_vehicle_silent = not self._orders.context.arbiter.is_state_recent
        if not is_vehicle_silent and not was_just_sent:
            self._send()
        self._session.background.start(
            lambda: self._finish_in_background(must_await_heartbeat=is_vehicle_silent), "aerokit gimbal"
        )

    async def _finish_in_background(self, *, must_await_heartbeat: bool) -> None:
        with suppress(AerokitError):  # No call waits for the errors of a background task.
            if must_await_heartbeat:
                await self._session.wait_for_heartbeat()
                if not self._is_still_due():
                    return
                self._send()
            try:
                await self._repeat_until_acknowledged()
            except CommandTimeout:
                if not self._is_manager_silent():
                    raise
                # The manager was silent, and may have missed the command. Send it again as soon as the manager is back.
                # A late command does no harm: the manager ignores it if this program has lost control.
                await self._orders.wait_for(lambda: not self._is_manager_silent(), Heartbeat, within_s=math.inf)
                if self._is_still_due():
                    self._send()
                    await self._repeat_until_acknowledged()

    def _send(self) -> None:
        self._session.commands.send_unconfirmed(self._command, *self._params, component_id=self._manager_id)

    async def _repeat_until_acknowledged(self) -> None:
        """Wait for the acknowledgement of the command that was just sent, and repeat the command if necessary."""
        began_at = self._session.connection.now()
        with self._orders.context.arbiter.auxiliary_order(ends_with_actions=False) as order:
            await self._orders.context.sender.send_long(
                order,
                self._command,
                *self._params,
                component_id=self._manager_id,
                is_done=lambda: not self._is_still_due(),
                attempts=RELEASE_ATTEMPTS,
                attempt_timeout=ATTEMPT_TIMEOUT_S,
                was_just_sent=True,
            )
        if self._stop_message is not None:
            await self._send_several_times(self._stop_message, command_sent_at=began_at)

    async def _send_several_times(self, message: Message, *, command_sent_at: float) -> None:
        arbiter = self._orders.context.arbiter
        for _ in range(STOP_MESSAGE_COUNT):
            # While the computer slept or the vehicle was silent, another station may have begun to use the gimbal.
            has_computer_slept = arbiter.slept_since(command_sent_at) > 0
            is_vehicle_silent = not arbiter.is_state_recent
            may_be_used_by_others = has_computer_slept or is_vehicle_silent
            if may_be_used_by_others or not self._session.is_open or not self._is_still_due():
                return
            self._session.connection.send(message)
            await asyncio.sleep(STOP_MESSAGE_INTERVAL_S)

    def _is_manager_silent(self) -> bool:
        is_autopilot = self._manager_id == self._session.component_id
        return not is_autopilot and self._orders.registry.silent_for_s(self._manager_id) > SILENT_AFTER_S


# Seconds after which the manager's confirmation of our control is requested, and seconds to wait for it in total.
STATUS_TIMEOUT_S, CONFIRM_TIMEOUT_S = 0.5, 3.0

STATUS_HZ = 1.0


@checks_arguments
class GimbalControl:
    """Control of a gimbal for the duration of its ``async with`` block (MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE).

    Entering takes control from any other station and returns when the manager confirms that you are in control. Leaving
    releases control, without waiting if the block exits by an error or cancellation.

    When another station takes control, aerokit publishes ``GimbalControlLost``, and orders to the gimbal, including
    running ones, raise :class:`GimbalTaken`. If neither an order nor :meth:`until_lost` has told your program of the
    loss, leaving the block raises GimbalTaken. Another station that uses your own system and component id cannot be
    detected.

    Entering raises:
        NotSupported: the vehicle has no gimbal manager, or its manager has no secondary control.
        BusyError: your program already has this control in another block. Nothing was sent.
        CommandRejected: the manager refused.
        CommandTimeout: there was no answer.
        OperationTimeout: the manager accepted the command, but does not confirm that you are in control.
    """

    def __init__(self, orders: GimbalOrders, is_primary: bool) -> None:
        self._orders = orders
        self._session = orders.session
        self._is_primary = is_primary
        # The gimbal, once the manager has confirmed our control.
        self._device: GimbalDevice | None = None
        self._control_request = ControlRequest(0, 0, is_primary=is_primary)  # `__aenter__` replaces it.
        # The error that describes the loss of control; None until control is lost.
        self._loss: GimbalTaken | None = None
        self._was_loss_raised = False
        self._was_entered = False
        self._is_ended = False
        # Set when control is lost, or when the block or the connection ends. `until_lost` waits for it.
        self._lost_or_ended = asyncio.Event()
        self._detach_callbacks: list[Callable[[], None]] = []

    @property
    def is_primary(self) -> bool:
        """True for primary control, False for secondary."""
        return self._is_primary

    @property
    def is_held(self) -> bool:
        """True while your program is in control."""
        return self._device is not None and self._loss is None and not self._is_ended

    @property
    def is_taken(self) -> bool:
        """True if another station has taken control, or has released your control."""
        return self._loss is not None

    async def until_lost(self) -> tuple[int, int]:
        """Wait until control is lost; return the system and component id of the new controller, (0, 0) for none.

        Raises:
            OperationRejected: the block ended.
            ConnectionClosed, LinkLost: the connection ended.
        """
        detach = self._session.end.on_end(lambda _: self._lost_or_ended.set())  # Stop waiting when the session ends.
        try:
            await self._lost_or_ended.wait()
        finally:
            detach()
        self._session.end.raise_if_ended()
        if self._loss is None:
            raise OperationRejected(f"{self._orders.name}: the block that had control has ended")
        self._was_loss_raised = True
        return self._loss.system_id, self._loss.component_id

    def raise_if_taken(self) -> None:
        """Raise GimbalTaken if control was lost.

        Raises:
            GimbalTaken: another station has taken control, or the manager reports that no station has it.
        """
        if self._loss is not None:
            self._was_loss_raised = True
            loss = self._loss
            # Create a new exception each time, because an exception that is raised again also keeps its old tracebacks.
            raise GimbalTaken(str(loss), system_id=loss.system_id, component_id=loss.component_id)

    async def __aenter__(self) -> Self:
        """Request control, and wait until the manager confirms it."""
        orders = self._orders
        if self._was_entered:
            raise BusyError("a GimbalControl can be entered only once: call control() again")
        if orders.device.has_control_block(is_primary=self._is_primary):
            raise BusyError(f"{orders.name}: another block of this program already has control; nothing was sent")
        if not self._is_primary and not orders.rules.has_secondary:
            raise orders.not_supported("has no secondary control")
        self._was_entered = True
        self._control_request = ControlRequest(orders.manager_id, orders.gimbal_id_param, is_primary=self._is_primary)
        orders.registry.control_requests.append(self._control_request)
        release = self._release_command()
        # The callback is registered before the request, so that control is also released if `async with connect(…)`
        # ends meanwhile.
        self._detach_callbacks.append(orders.context.on_finish(self._finish))
        since = self._session.connection.now()
        try:
            await self._request_control()
            await self._await_confirmation(since)
        except (CommandRejected, NotSupported, BusyError):
            # Control was not obtained. Another block that had the same control may have left its release to this block.
            self._end()
            if self._control_request.must_release:
                release.send_soon()
            raise
        except BaseException:  # The manager may have given us control without our knowing.
            self._end()
            release.send_soon()
            raise
        return self

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """Release control. If it was lost, and no call has reported that yet, raise GimbalTaken instead."""
        if self._loss is not None:
            self._end()
            if error is None and not self._was_loss_raised:
                self.raise_if_taken()
            return
        if self._is_ended:  # The vehicle's `async with` block has ended before this block.
            return
        release = self._release_command()
        self._end()
        if error is None:
            await release.send_and_wait(f"{self._orders.name}: releasing control")
        else:
            release.send_soon()

    async def _request_control(self) -> None:
        orders = self._orders
        params = orders.control_params(is_primary=self._is_primary)
        try:
            await orders.send(None, CONFIGURE, *params)
        except CommandRejected as error:
            if error.result == MavResult.UNSUPPORTED:
                raise orders.not_supported("has no gimbal manager whose control could be taken") from error
            raise

    async def _await_confirmation(self, since: float) -> None:
        """Wait for a GIMBAL_MANAGER_STATUS after ``since`` that confirms our control."""
        orders, session = self._orders, self._session
        reported = orders.public_device.controllers
        if orders.manager_id == session.component_id:  # Only the autopilot is asked for messages at a rate.
            self._detach_callbacks.append(session.rates.request(GimbalManagerStatus, STATUS_HZ, is_optional=True))

        async def wait(seconds: float) -> None:
            await reported.wait_until(
                lambda controllers: self._controller_in(controllers) == orders.own_ids and reported.updated_at >= since,
                timeout=seconds,
                description=f"{orders.name}: confirmation of our control",
            )

        try:
            await wait(STATUS_TIMEOUT_S)
        except OperationTimeout:  # The manager may not send its status by itself, or the message was lost.
            orders.ask_in_background(GimbalManagerStatus.ID)
            await wait(CONFIRM_TIMEOUT_S - STATUS_TIMEOUT_S)
        device = orders.device
        # During the wait, another block may have been entered, or another gimbal may have become the first one.
        if device.has_control_block(is_primary=self._is_primary):
            raise BusyError(f"{orders.name}: another block of this program already has control")
        self._device = device
        device.control_blocks.append(self)
        self._detach_callbacks.append(device.controllers.observe(self._on_controllers, every_arrival=True))

    def _on_controllers(self, _: GimbalControllers | None, controllers: GimbalControllers) -> None:
        controller = self._controller_in(controllers)
        if controller == self._orders.own_ids or self._loss is not None:
            return
        system_id, component_id = controller
        holder = f"{system_id}/{component_id}" if controller != (0, 0) else "no controller"
        self._loss = GimbalTaken(
            f"{self._orders.name}: control was lost: {holder} has control now",
            system_id=system_id,
            component_id=component_id,
        )
        device_id = 0 if self._device is None else self._device.device_id
        self._session.publish(GimbalControlLost, device_id, self._is_primary, system_id, component_id)
        self._lost_or_ended.set()

    def _controller_in(self, controllers: GimbalControllers) -> tuple[int, int]:
        return controllers.primary if self._is_primary else controllers.secondary

    def _release_command(self) -> ReleaseCommand:
        orders = self._orders
        params = orders.control_params(is_primary=self._is_primary, release=True)
        requests = orders.registry.control_requests

        def is_still_due() -> bool:
            # If another open block of this program has the same control, that block releases it when it ends.
            return self._loss is None and not self._control_request.leave_release_to(requests)

        return ReleaseCommand(orders, CONFIGURE, params, is_still_due)

    def _finish(self) -> None:
        release = self._release_command()
        self._end()
        release.send_soon()

    def _end(self) -> None:
        """Forget the control that this block has. Sends nothing."""
        self._is_ended = True
        self._lost_or_ended.set()  # This ends all calls of `until_lost`.
        requests = self._orders.registry.control_requests
        if self._control_request in requests:
            requests.remove(self._control_request)
        if self._device is not None and self in self._device.control_blocks:
            self._device.control_blocks.remove(self)
        for detach in self._detach_callbacks:
            detach()
        self._detach_callbacks.clear()
