"""``SimpleOrder``: an order that is one command, declared as one table row.

A row has the command, its parameters with units and ranges, and the message that reports its effect. Whether a firmware
has the command is in `aerokit.autopilots` (``unsupported_commands``), and whether it may be repeated in
`aerokit.protocols.command`. A method that gives the order documents its arguments, as in ``devices/actuators.py``.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit._internal.arguments import check_range
from aerokit._internal.formatting import short_repr
from aerokit._internal.values import Snapshot
from aerokit.errors import CommandRejected, CommandTimeout, InvalidArgument, NotSupported, OperationTimeout
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.commanding.order import SUPERSEDED
from aerokit.vehicle.commanding.progress import await_progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order, Topic

MessageT = TypeVar("MessageT", bound="Message")

EFFECT_TIMEOUT_S = 5.0
"""Seconds after the acknowledgement until a message must report the effect."""
EFFECT_POLL_S = 0.4
"""Seconds between requests for the message that reports the effect."""


class Argument(Snapshot):
    """One parameter of a command that the caller chooses.

    ``name`` has the unit, as the argument of the public method. ``scale`` converts it to the unit of the command. With
    ``above``, ``minimum`` itself is invalid. ``whole`` numbers have no fraction.
    """

    name: str
    minimum: float
    maximum: float
    scale: float = 1.0
    above: bool = False
    whole: bool = False

    def to_wire(self, value: float) -> float:
        """Check the value and convert it to the unit of the command.

        Raises:
            InvalidArgument: it is out of range, or has a fraction.
        """
        check_range(self.name, value, self.minimum, self.maximum, above=self.above)
        if self.whole and value != int(value):
            raise InvalidArgument(f"{self.name} = {short_repr(value)} is not allowed: a whole number")
        return float(value) * self.scale


class Effect(Snapshot):
    """The message that reports the effect of an order, by its class name, and a predicate.

    ``is_reported`` is called with each message and the values of the arguments.
    """

    message: str
    is_reported: Callable[..., bool]


class SimpleOrder(Snapshot):
    """One command with its parameters and its effect.

    ``name`` is that of the public method, for error texts. In ``params``, an `Argument` takes the next value that
    ``send`` is called with; a number is sent as it is. Without ``effect``, the acknowledgement ends the order, because
    no message reports its effect.
    """

    name: str
    command: int
    params: tuple[Argument | float, ...] = ()
    effect: Effect | None = None

    def check_supported(self, context: VehicleContext) -> None:
        """Raise NotSupported if the firmware does not have the command."""
        autopilot = context.session.autopilot
        if self.command in autopilot.unsupported_commands:
            raise NotSupported(
                f"{self.name}: {autopilot.firmware} has no MAV_CMD_{MavCmd(self.command).name}; nothing was sent"
            )

    def wire_params(self, *values: float) -> tuple[float, ...]:
        """Check the values of the arguments and return the parameters of the command.

        Raises:
            InvalidArgument: a value is out of range; the text names the argument.
        """
        rest = iter(values)
        params = tuple(param.to_wire(next(rest)) if isinstance(param, Argument) else param for param in self.params)
        if left := tuple(rest):
            raise TypeError(f"{self.name}: {len(left)} values too many")
        return params

    async def send(
        self,
        context: VehicleContext,
        *values: float,
        of: Order | None = None,
        topic: Topic | None = None,
        component_id: int | None = None,
        timeout: float = EFFECT_TIMEOUT_S,
        **options: Any,
    ) -> None:
        """Send the command and wait for its effect.

        Args:
            context: the vehicle.
            values: one for each `Argument`, in order; a message that reports the effect is compared with them.
            of: the order to a device of which this is a further command.
            topic: the device that the command is for. A newer order with the same topic ends the wait for this one.
            component_id: the target component; None: the autopilot.
            timeout: seconds after the acknowledgement until a message must report the effect.
            options: further arguments of `CommandSender.send_long`.

        Raises:
            InvalidArgument: a value is out of range. Nothing was sent.
            NotSupported: the command is for the autopilot, which does not have it. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: a newer order for the same device was given.
            HeartbeatTimeout: the vehicle was silent for ten seconds while its effect was awaited.
            OperationTimeout: the effect was not reported in time.
        """
        params = self.wire_params(*values)
        if component_id in (None, context.session.component_id):
            self.check_supported(context)
        if topic is not None and of is None:
            of = context.arbiter.of_device(topic)
        with context.arbiter.auxiliary_order(of) as order:
            await context.sender.run_command(
                order, context.session.commands.send_long, self.command, *params, component_id=component_id, **options
            )
        if self.effect is not None:
            await self._await_effect(context, self.effect, values, of, component_id, timeout)

    async def _await_effect(
        self,
        context: VehicleContext,
        effect: Effect,
        values: tuple[float, ...],
        order: Order | None,
        component_id: int | None,
        timeout: float,
    ) -> None:
        """Request the message until it reports the effect. The ack must do if the vehicle does not have the message."""
        session, message_type = context.session, getattr(m, effect.message)
        target = session.component_id if component_id is None else component_id
        reports: list[Message] = []
        is_reported = False
        requested_at = session.connection.now()

        def on_message(message: Message) -> None:
            nonlocal is_reported
            frame = message.received_frame
            if frame is None or frame.component_id == target:
                reports[:] = [message]
                is_reported = is_reported or effect.is_reported(message, *values)

        def is_done() -> bool:
            nonlocal requested_at
            if not is_reported and session.connection.now() - requested_at >= EFFECT_POLL_S:
                requested_at = session.connection.now()
                session.commands.send_unconfirmed(MavCmd.REQUEST_MESSAGE, message_type.ID, component_id=target)
            return is_reported

        detach = session.connection.bus.attach(message_type, on_message, system_id=session.system_id)
        try:
            if await self._is_available(context, message_type.ID, target) or reports:
                await await_progress(
                    session,
                    self.name,
                    is_done=is_done,
                    trouble=lambda: SUPERSEDED if order is not None and not order.is_newest else None,
                    describe=lambda: str(reports[0]) if reports else f"no {message_type.NAME} was received",
                    timeout=timeout,
                )
        finally:
            detach()

    async def _is_available(self, context: VehicleContext, message_id: int, component_id: int) -> bool:
        """Request a message; return False if the vehicle refuses, because it does not have it."""
        try:
            await context.session.commands.send_long(
                MavCmd.REQUEST_MESSAGE, message_id, component_id=component_id, attempts=2, attempt_timeout=1.0
            )
        except CommandRejected:
            return False
        except CommandTimeout:  # It may have the message nevertheless.
            pass
        return True


async def receive_once(
    context: VehicleContext, message_type: type[MessageT], component_id: int | None = None, *, timeout: float = 1.0
) -> MessageT | None:
    """Request one message and return it; None if the vehicle refuses or does not send it within ``timeout`` seconds."""
    session = context.session
    target = session.component_id if component_id is None else component_id
    with (
        session.connection.subscribe(message_type, system_id=session.system_id, capacity=8) as messages,
        suppress(CommandRejected, CommandTimeout, OperationTimeout),
    ):
        await session.commands.send_long(
            MavCmd.REQUEST_MESSAGE, message_type.ID, component_id=target, attempts=1, attempt_timeout=timeout
        )
        while True:
            message = await messages.get(timeout)
            if message.received_frame is None or message.received_frame.component_id == target:
                return message
    return None
