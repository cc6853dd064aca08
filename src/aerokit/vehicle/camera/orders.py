"""Commands to one camera, and requests for its messages."""

from __future__ import annotations

import asyncio
import logging
import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit.errors import AerokitError, CommandRejected, CommandTimeout, ConnectionClosed, OperationTimeout
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.message import Message
from aerokit.protocols.command import command_name
from aerokit.vehicle.commanding.order import REBOOTED, SUPERSEDED
from aerokit.vehicle.commanding.progress import MAX_SILENCE_S

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from contextlib import AbstractContextManager

    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order, SentCommand, Topic
    from aerokit.vehicle.components.component import Component
    from aerokit.vehicle.session.session import VehicleSession

MessageT = TypeVar("MessageT", bound=Message)
logger: logging.Logger = logging.getLogger("aerokit")

# Camera device ids of cameras that are attached to the autopilot and have no component id of their own.
AUTOPILOT_CAMERA_IDS = range(1, 7)

# Maximum number of transmissions of an order that must not be executed twice. Such an order is sent again only if the
# camera reports that the previous transmission had no effect.
MAX_ORDER_ATTEMPTS = 8


class _ResendGuard:
    """Decides whether a command to a camera may be sent again.

    For a camera with its own component id, the camera's HEARTBEAT counts instead of the autopilot's, which does not
    show that the camera is present.
    """

    def __init__(self, link: CameraOrders, sent: SentCommand) -> None:
        self._link, self._sent = link, sent

    @property
    def end(self) -> str:
        return self._sent.end

    @property
    def heartbeat_at(self) -> float:
        return self._sent.heartbeat_at if self._link.is_autopilot_attached else self._link.heartbeat_at()

    @property
    def heartbeat_name(self) -> str:
        has_own_heartbeat = not self._link.is_autopilot_attached and self._link.is_autopilot_present
        return f"HEARTBEAT of component {self._link.component.component_id}" if has_own_heartbeat else "HEARTBEAT"


class CameraOrders:
    """Base class of `CameraLink`: sends commands to one camera. A newer order ends the retries of an earlier one."""

    context: VehicleContext
    session: VehicleSession
    _component: Component | None
    # Number of the camera: 1 to 6 if attached to the autopilot, otherwise its component id; None until bound.
    number: int | None

    # Topics of the orders given by this object.
    _ordered_topics: set[Topic]
    # Set once `number` is known to be right. Before that, it is None or a guess.
    _is_number_confirmed: anyio.Event

    @property
    def is_autopilot_attached(self) -> bool:
        return self.number in AUTOPILOT_CAMERA_IDS

    @property
    def device_id(self) -> int:
        """Camera device id for commands; 0 means the component itself."""
        return self.number if self.number is not None and self.is_autopilot_attached else 0

    @property
    def component(self) -> Component:
        assert self._component is not None, "the camera is not bound yet"
        return self._component

    def now(self) -> float:
        return self.session.connection.now()

    def heartbeat_at(self) -> float:
        """Loop time of the camera's last HEARTBEAT; -inf while the autopilot is silent."""
        received_at = self.session.connection.last_heartbeat_at(self.session.system_id, self.component.component_id)
        return received_at if self.is_autopilot_present else -math.inf

    @property
    def is_autopilot_present(self) -> bool:
        return self.context.arbiter.is_state_recent

    def topic(self, subject: str) -> Topic:
        """Return the key of one function, such as ``"video"``. A new order replaces earlier ones with its key."""
        return ("camera", self.component.component_id, self.device_id, subject)

    def begin_order(self, subject: str) -> Order:
        return self.context.arbiter.device_order(self._ordered_topic(subject), may_be_withdrawn=True)

    def latest_order(self, subject: str) -> Order | None:
        return self.context.arbiter.latest(self.topic(subject))

    def new_order(self, subject: str) -> AbstractContextManager[Order]:
        """Begin an order for a `with` block. If the block raises, the order is withdrawn.

        During the block, no camera that is found late takes the place of a guess.
        """
        return self.context.arbiter.withdrawable_order(self._ordered_topic(subject))

    def _ordered_topic(self, subject: str) -> Topic:
        topic = self.topic(subject)
        self._ordered_topics.add(topic)
        return topic

    async def command(
        self,
        command: int,
        *params: float,
        order: Order | None = None,
        attempts: int | None = None,
        is_stop: bool = False,
        **options: Any,
    ) -> None:
        """Send a command, retried according to docs/reliability.md.

        A newer order about the same topic ends the retries of ``order``. So does a newer action, unless the command is
        sent only once or ``is_stop`` is True.
        """
        if order is not None and not order.is_newest:
            raise CommandTimeout(f"{command_name(command)} was not sent: {SUPERSEDED}", was_sent=False)
        if order is not None and not self.session.is_closed:
            order.was_sent = True
        session, started_at = self.session, self.session.connection.now()
        arbiter = self.context.arbiter
        ends_with_actions = attempts != 1 and not is_stop
        with (
            arbiter.auxiliary_order(order, ends_with_actions=ends_with_actions) as sent_order,
            arbiter.sending(sent_order) as sent,
        ):
            try:
                await session.commands.send_long(
                    command,
                    *params,
                    component_id=self.component.component_id,
                    order_status=_ResendGuard(self, sent),
                    attempts=attempts,
                    **options,
                )
                self._is_number_confirmed.set()  # The accepted command shows that this camera exists.
            except CommandRejected as error:
                # The status texts with the reasons may arrive after the answer.
                await session.wait_for_status_texts()
                raise session.with_reasons(error, started_at) from None

    async def order_once(
        self,
        order: Order,
        send: Callable[[], Awaitable[None]],
        check_effect: Callable[[], Awaitable[bool | None]],
    ) -> None:
        """Send an order. It is sent again only if the camera reports that it had no effect.

        ``check_effect`` asks the camera, and returns None if there is no answer. A newer order and a reboot of the
        vehicle end the retries.
        """
        reboots = self.session.watch.reboots
        for attempt in range(1, MAX_ORDER_ATTEMPTS + 1):
            try:
                await send()
                return
            except CommandRejected:
                # A repetition may be refused because the camera is executing an earlier transmission.
                if attempt > 1 and await check_effect():
                    return
                raise
            except CommandTimeout as error:
                error.was_sent = error.was_sent or attempt > 1
                had_effect = await check_effect() if order.is_newest else None
                # A newer order may have been given while `check_effect` waited for its answer. After a reboot, no order
                # is repeated.
                if not order.is_newest or self.session.watch.reboots != reboots:
                    reason = SUPERSEDED if not order.is_newest else REBOOTED
                    error.args = (f"{error}; not sent again: {reason}",)
                    raise
                if had_effect:
                    return
                if had_effect is None or attempt == MAX_ORDER_ATTEMPTS:
                    raise

    def send_now(self, command: int, *params: float) -> bool:
        """Send a command once, without waiting for the acknowledgement. Return False if it was not sent."""
        session = self.session
        # A link that is reopened may lead to another vehicle.
        if self._component is None or not session.is_open or session.is_held_back:
            return False
        session.commands.send_unconfirmed(command, *params, component_id=self._component.component_id)
        return True

    async def end_operation(self, order: Order, command: int, *params: float, is_awaited: bool) -> None:
        """Send the stop command of an operation, and repeat it in the background until it is acknowledged.

        Does nothing if a newer order was given. With ``is_awaited``, this call waits for the acknowledgement and
        raises as :meth:`command`. Otherwise a failure is logged.
        """
        if not order.is_newest or self.session.is_closed:
            return
        was_just_sent = self.send_now(command, *params)
        failure: AerokitError | None = None

        async def confirm() -> None:
            nonlocal failure
            try:
                await self._confirm_stop(order, command, *params, is_awaited=is_awaited, was_just_sent=was_just_sent)
            except AerokitError as error:
                # If a newer order has been given meanwhile, this order is obsolete and its failure is no error.
                if order.is_newest:
                    failure = error
                    if not is_awaited:
                        logger.warning("camera %s may not have stopped: %s", self.number, error)

        task = self.session.background.start(confirm, "aerokit end of a camera's block")
        if task is None or not is_awaited:
            return
        await asyncio.wait((task,))  # The task continues if this call is cancelled.
        if task.cancelled():
            raise ConnectionClosed("the async with block of this vehicle was left")
        if failure is not None:
            raise failure

    async def _confirm_stop(
        self, order: Order, command: int, *params: float, is_awaited: bool, was_just_sent: bool
    ) -> None:
        """Wait for the acknowledgement of a stop command, and repeat the command if necessary."""
        if not was_just_sent:
            with anyio.move_on_after(MAX_SILENCE_S if is_awaited else None):
                await self.session.wait_for_heartbeat()
        if not order.is_newest:
            return
        try:
            await self.command(command, *params, order=order, is_stop=True, was_just_sent=was_just_sent)
        except CommandTimeout:
            if is_awaited:
                raise
            await self.session.wait_for_heartbeat()  # The command may have been lost in a silence.
            await self.command(command, *params, order=order, is_stop=True)


# A state value is polled for this many seconds after the program has read it.
INTEREST_TIMEOUT_S = 10.0

POLL_INTERVAL_S = 1.0

# Commands that requested a message before MAV_CMD_REQUEST_MESSAGE existed, and their parameters. In a request for one
# of NUMBERED_MESSAGES, the first parameter is the number of the item.
LEGACY_REQUESTS: dict[type[Message], tuple[int, tuple[float, ...]]] = {
    m.CameraInformation: (MavCmd.REQUEST_CAMERA_INFORMATION, (1,)),
    m.CameraSettings: (MavCmd.REQUEST_CAMERA_SETTINGS, (1,)),
    m.CameraCaptureStatus: (MavCmd.REQUEST_CAMERA_CAPTURE_STATUS, (1,)),
    m.StorageInformation: (MavCmd.REQUEST_STORAGE_INFORMATION, (0, 1)),
    m.CameraImageCaptured: (MavCmd.REQUEST_CAMERA_IMAGE_CAPTURE, (0,)),
    m.VideoStreamInformation: (MavCmd.REQUEST_VIDEO_STREAM_INFORMATION, (0,)),
    m.VideoStreamStatus: (MavCmd.REQUEST_VIDEO_STREAM_STATUS, (0,)),
}

NUMBERED_MESSAGES = (
    m.StorageInformation,
    m.CameraImageCaptured,
    m.VideoStreamInformation,
    m.VideoStreamStatus,
)

# After these results, a message is not requested again before the next reboot. Other results are temporary.
UNSUPPORTED = (MavResult.UNSUPPORTED, MavResult.DENIED)

# FAILED means that the message is not supported (ArduPilot), or that it cannot be sent now (other firmware). After
# FAILED, the message is therefore still requested, but rarely.
MAYBE_UNSUPPORTED = (*UNSUPPORTED, MavResult.FAILED)
DOUBTFUL_POLL_INTERVAL_S = 60.0


class _PolledCell:
    """Tells when to request the message of a state value: while the program reads or watches the value.

    The state value calls `pending`, `catch_up` and `watchers_changed`, which belong to the protocol `Feed`.
    """

    def __init__(
        self, now: Callable[[], float], cell: StateCell[Any], message_type: type[Message], period_s: float
    ) -> None:
        self._now, self._cell = now, cell
        self.message_type, self.period_s = message_type, period_s
        self.read_at = -math.inf
        self.requested_at = -math.inf
        # True if the camera does not support the message, so that it is not requested before the next reboot.
        self.is_refused = False
        # True if the camera may not support the message, so that it is requested rarely.
        self.is_doubtful = False
        cell._feed_from(self)

    @property
    def pending(self) -> bool:
        # The state cell reads this property on every access, so `read_at` is the last time at which the program used
        # the cell. The camera's messages are decoded on arrival, so none is ever pending.
        self.read_at = self._now()
        return False

    def catch_up(self) -> None:
        pass

    def watchers_changed(self) -> None:
        self.read_at = self._now()

    def is_due(self) -> bool:
        now = self._now()
        is_used = self._cell._is_watched or now - self.read_at <= INTEREST_TIMEOUT_S
        period_s = max(DOUBTFUL_POLL_INTERVAL_S, self.period_s) if self.is_doubtful else self.period_s
        requested_or_updated_at = max(self.requested_at, self._cell._updated_at)
        return is_used and not self.is_refused and now - requested_or_updated_at >= period_s


class MessageRequests:
    """Requests messages from one camera, by MAV_CMD_REQUEST_MESSAGE or the older commands, and polls state values."""

    def __init__(self, link: CameraOrders) -> None:
        self._link = link
        self._polled: list[_PolledCell] = []
        # Messages that this camera sends only if they are requested by the older commands.
        self._legacy_types: set[type[Message]] = set()

    async def request(
        self,
        message_type: type[MessageT],
        *params: float,
        where: Callable[[MessageT], bool] = lambda _: True,
        timeout: float = 3.0,
    ) -> MessageT | None:
        """Request one message. Returns None if it does not arrive in time.

        Raises CommandRejected if the camera does not support the message.
        """
        if message_type in self._legacy_types:
            return await self._request_legacy(message_type, params, where, timeout)
        try:
            return await self._link.component.request(message_type, *params, where=where, timeout=timeout)
        except OperationTimeout:
            return None
        except CommandRejected as error:
            has_legacy_request = message_type in LEGACY_REQUESTS and not self._link.is_autopilot_attached
            if not has_legacy_request or error.result not in MAYBE_UNSUPPORTED:
                raise
            refusal = error
        try:
            answer = await self._request_legacy(message_type, params, where, timeout)
        except CommandRejected:  # The camera supports neither request.
            raise refusal from None
        if answer is not None:
            self._legacy_types.add(message_type)
        return answer

    async def _request_legacy(
        self,
        message_type: type[MessageT],
        params: tuple[float, ...],
        where: Callable[[MessageT], bool],
        timeout: float,
    ) -> MessageT | None:
        command, legacy_params = LEGACY_REQUESTS[message_type]
        if message_type in NUMBERED_MESSAGES and params:  # The caller requests one item by its number.
            legacy_params = (params[0], *legacy_params[1:])
        with self._link.component.subscribe(message_type, capacity=100) as answers:
            with suppress(CommandTimeout):  # The message may arrive although the acknowledgement was lost.
                await self._link.component.command(command, *legacy_params, retries=1)
            with anyio.move_on_after(timeout):
                async for answer in answers:
                    if where(answer):
                        return answer
        return None

    def poll_for(self, cell: StateCell[Any], message_type: type[Message], period_s: float) -> None:
        """Every ``period_s`` seconds, request the message that sets ``cell``, while the program uses the cell."""
        self._polled.append(_PolledCell(self._link.now, cell, message_type, period_s))

    def forget_refusals(self) -> None:
        self._legacy_types.clear()
        for cell in self._polled:
            cell.is_refused = False
            cell.is_doubtful = False

    async def run(self) -> None:
        while True:
            await anyio.sleep(POLL_INTERVAL_S)
            for cell in self._polled:
                if self._link.number is not None and cell.is_due():
                    await self._refresh(cell)

    async def _refresh(self, cell: _PolledCell) -> None:
        cell.requested_at = self._link.now()
        try:
            await self.request(cell.message_type, timeout=POLL_INTERVAL_S)
        except CommandRejected as error:
            cell.is_refused = error.result in UNSUPPORTED
            cell.is_doubtful = error.result in MAYBE_UNSUPPORTED
        else:
            cell.is_doubtful = False
