"""``SimpleOrder``: an order that consists of one command, declared as a row of a table.

A row has the command, its parameters with units and ranges, the message that reports its effect, and the firmwares that
do not have the command. `aerokit.protocols.command` lists the commands that must not be repeated. The method that gives
the order documents its arguments, as in ``devices/actuators.py``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeVar

import anyio

from aerokit._internal.arguments import check_range
from aerokit._internal.values import Snapshot
from aerokit.errors import CommandRejected, CommandTimeout, NotSupported
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.commanding.order import SUPERSEDED
from aerokit.vehicle.commanding.progress import await_progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Autopilot
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order, Topic
    from aerokit.vehicle.session.commands import CommandSender

Firmware = Literal["ArduPilot", "ArduCopter", "ArduPlane", "Rover", "ArduSub", "PX4"]
"""Name of one firmware, or of an autopilot with all its firmwares."""
MessageT = TypeVar("MessageT", bound="Message")

EFFECT_TIMEOUT_S = 5.0
"""Seconds after the acknowledgement within which a message must report the effect."""
EFFECT_POLL_S = 0.4
"""Seconds between requests for the message that reports the effect."""
RECEIVE_ATTEMPTS = 3
"""How often `receive_once` requests a message, because a request or the message may be lost."""


class Argument(Snapshot):
    """One parameter of a command whose value the caller chooses.

    ``name`` is the name of the public method's argument, including its unit. With ``above``, ``minimum`` itself is
    invalid.
    """

    name: str
    minimum: float
    maximum: float
    above: bool = False

    def check(self, value: float) -> float:
        """Return the value. Raises InvalidArgument if it is out of range."""
        check_range(self.name, value, self.minimum, self.maximum, above=self.above)
        return float(value)


class Effect(Snapshot):
    """Describes how the vehicle reports that a command has taken effect.

    ``message`` is the class name of the message with the report. ``is_reported(message, *values)`` is called with each
    such message, and returns True if it reports the effect. ``values`` are those passed to `SimpleOrder.send`.
    """

    message: str
    is_reported: Callable[..., bool]


class SimpleOrder(Snapshot):
    """One command with its parameters and its effect.

    ``name`` is the public method, for error texts. In ``params``, a number is sent unchanged, and an `Argument` stands
    for the next value that is passed to ``send``. Without ``effect``, the acknowledgement ends the order, because no
    message reports its effect. ``missing_on`` names the firmwares that do not have the command.
    """

    name: str
    command: int
    params: tuple[Argument | float, ...] = ()
    effect: Effect | None = None
    missing_on: tuple[Firmware, ...] = ()

    def is_supported(self, autopilot: Autopilot) -> bool:
        return not {autopilot.name, autopilot.firmware}.intersection(self.missing_on)

    def check_supported(self, context: VehicleContext) -> None:
        """Raise NotSupported if the firmware does not have the command."""
        autopilot = context.session.autopilot
        if not self.is_supported(autopilot):
            raise NotSupported(
                f"{self.name}: {autopilot.firmware} has no MAV_CMD_{MavCmd(self.command).name}; nothing was sent"
            )

    def wire_params(self, *values: float) -> tuple[float, ...]:
        """Return the parameters of the command. Raises InvalidArgument if a value is out of range."""
        remaining_values = iter(values)
        return tuple(
            param.check(next(remaining_values)) if isinstance(param, Argument) else param for param in self.params
        )

    async def send(
        self,
        context: VehicleContext,
        *values: float,
        device_order: Order | None = None,
        topic: Topic | None = None,
        component_id: int | None = None,
        timeout: float = EFFECT_TIMEOUT_S,
    ) -> None:
        """Send the command and wait for its effect.

        Args:
            context: the vehicle.
            values: one for each `Argument`, in order; they are also passed to `Effect.is_reported`.
            device_order: the order to which this command belongs, if the caller has already created it.
            topic: the device, e.g. ``("relay", 3)``, if there is no ``device_order``. A newer order with the same
                topic ends this call.
            component_id: the target component; None: the autopilot.
            timeout: seconds after the acknowledgement within which a message must report the effect.

        Raises:
            InvalidArgument: a value is out of range. Nothing was sent.
            NotSupported: the command is for the autopilot, whose firmware does not support it. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: a newer order for the same device was given.
            HeartbeatTimeout: the vehicle was silent for ten seconds after the acknowledgement.
            OperationTimeout: the effect was not reported in time.
        """
        params = self.wire_params(*values)
        if component_id in (None, context.session.component_id):
            self.check_supported(context)
        if topic is not None and device_order is None:
            device_order = context.arbiter.device_order(topic)
        await context.sender.auxiliary_command(
            self.command, *params, device_order=device_order, component_id=component_id
        )
        if self.effect is not None:
            target = context.session.component_id if component_id is None else component_id
            await self._await_effect(context, self.effect, values, device_order, target, timeout)

    async def send_until_text(
        self,
        context: VehicleContext,
        *values: float,
        topic: Topic,
        is_done: Callable[[str, float], bool],
        is_refusal: Callable[[str], bool] = lambda _: False,
        timeout: float,
    ) -> None:
        """Send the command and wait for a status text that reports its effect.

        ``is_done(text, seconds_since_ack)`` is called repeatedly for every text received so far, so it may accept a
        text only some time after the acknowledgement. Only for orders without ``effect``.

        Raises as :meth:`send`; also OperationRejected if ``is_refusal(text)``.
        """
        order, now = context.arbiter.device_order(topic), context.session.connection.now
        texts: list[str] = []
        detach = context.session.telemetry.status_text.observe(
            lambda _, status_text: texts.append(status_text.text), every_arrival=True
        )

        def failure_reason() -> str | None:
            refusals = [text for text in texts if is_refusal(text)]
            return f"the vehicle reports {refusals[0]!r}" if refusals else _superseded_reason(order)

        try:
            await self.send(context, *values, device_order=order)
            acknowledged_at = now()
            await await_progress(
                context.session,
                self.name,
                is_done=lambda: any(is_done(text, now() - acknowledged_at) for text in texts),
                failure_reason=failure_reason,
                describe=lambda: "no status text reported the effect",
                timeout=timeout,
            )
        finally:
            detach()

    async def _await_effect(
        self,
        context: VehicleContext,
        effect: Effect,
        values: tuple[float, ...],
        device_order: Order | None,
        target: int,
        timeout: float,
    ) -> None:
        """Request ``effect.message`` until it reports the effect. Returns early if the vehicle does not send it at all.

        ``target`` is the id of the component that sends the message.
        """
        session, message_type = context.session, getattr(m, effect.message)
        latest: Message | None = None
        is_reported = False
        requested_at = session.connection.now()

        def on_message(message: Message) -> None:
            nonlocal latest, is_reported
            frame = message.received_frame
            if frame is None or frame.component_id == target:
                latest = message
                is_reported = is_reported or effect.is_reported(message, *values)

        def poll_effect() -> bool:
            nonlocal requested_at
            if not is_reported and session.connection.now() - requested_at >= EFFECT_POLL_S:
                requested_at = session.connection.now()
                session.commands.send_unconfirmed(MavCmd.REQUEST_MESSAGE, message_type.ID, component_id=target)
            return is_reported

        detach = session.connection.bus.attach(message_type, on_message, system_id=session.system_id)
        try:
            # A vehicle that refuses requests for the message may still stream it.
            refusal = await request_refusal(
                session.commands, message_type.ID, component_id=target, attempts=2, attempt_timeout=1.0
            )
            if refusal is None or latest is not None:
                await await_progress(
                    session,
                    self.name,
                    is_done=poll_effect,
                    failure_reason=lambda: _superseded_reason(device_order),
                    describe=lambda: f"no {message_type.NAME} was received" if latest is None else str(latest),
                    timeout=timeout,
                )
        finally:
            detach()


def _superseded_reason(order: Order | None) -> str | None:
    return SUPERSEDED if order is not None and not order.is_newest else None


async def request_refusal(
    commands: CommandSender, message_id: int, *params: float, **options: Any
) -> CommandRejected | None:
    """Request a message. Returns the refusal; None if there was none, so that the message may arrive."""
    try:
        await commands.send_long(MavCmd.REQUEST_MESSAGE, message_id, *params, **options)
    except CommandTimeout:  # The message may arrive although the acknowledgement was lost.
        return None
    except CommandRejected as error:
        return error
    return None


async def receive_once(
    context: VehicleContext, message_type: type[MessageT], component_id: int | None = None
) -> MessageT | None:
    """Request one message. Returns None if the vehicle refuses or does not send it."""
    session = context.session
    target = session.component_id if component_id is None else component_id
    with session.connection.subscribe(message_type, system_id=session.system_id, capacity=8) as messages:
        for _ in range(RECEIVE_ATTEMPTS):
            may_get_late_ack = session.commands.may_get_late_ack(MavCmd.REQUEST_MESSAGE, target)
            refusal = await request_refusal(
                session.commands, message_type.ID, component_id=target, attempts=1, attempt_timeout=0.5
            )
            is_refused = refusal is not None and not may_get_late_ack  # A late ack may belong to an earlier request.
            # After a refusal, only a message that has already arrived is returned.
            with anyio.move_on_after(0 if is_refused else 0.5):
                async for message in messages:  # Other components may send the same message.
                    if message.received_frame is None or message.received_frame.component_id == target:
                        return message
            if is_refused:
                return None
    return None
