"""What everything about one vehicle rests on: its address, its commands, its telemetry, its texts."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit.arguments import checks_arguments
from aerokit.autopilots import autopilot_for
from aerokit.autopilots.streams import subscription_rate_hz
from aerokit.errors import CommandRejected, ConnectionClosed
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandAck, CommandInt, CommandLong, Heartbeat, SetMode
from aerokit.runtime.background import Background
from aerokit.runtime.cells import Source, StateCell
from aerokit.runtime.events import (
    ArmedChanged,
    LandedStateChanged,
    LinkReport,
    LinkRestored,
    ModeChanged,
    StatusTextReceived,
)
from aerokit.runtime.subscription import Overflow, Subscription
from aerokit.vehicle.commands import CommandSender
from aerokit.vehicle.helm import Helm
from aerokit.vehicle.orders import MOVING_COMMANDS, QUESTIONS
from aerokit.vehicle.rates import MessageRates, check_rate
from aerokit.vehicle.telemetry import Telemetry
from aerokit.vehicle.transfers import Transfers
from aerokit.vehicle.watch import LinkWatch, VehicleWatch

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from aerokit.protocols.command import Standing
    from aerokit.runtime.bus import Detach, Sink
    from aerokit.runtime.connection import Connection
    from aerokit.runtime.events import Event
    from aerokit.runtime.link_state import LinkState
    from aerokit.vehicle.orders import Order

__all__ = ["COMPONENT_ARM_DISARM", "VehicleCore"]

ItemT = TypeVar("ItemT", bound="Message | Event")
MessageT = TypeVar("MessageT", bound=Message)

SETTLE_S = 0.3
"""How long after a refusal the vehicle's texts about it are waited for."""
ACTION_HZ = 4.0
"""How fast an action wants to be told what it waits for."""
COMPONENT_ARM_DISARM = 400
RESULT_ACCEPTED = 0
RESULTS_OF_REFUSAL = (1, 2, 4)


@checks_arguments
class VehicleCore:
    """One remote system: system id, autopilot component, and what was heard of it."""

    def __init__(
        self, connection: Connection, system_id: int, component_id: int, heartbeat: Heartbeat
    ) -> None:
        self.connection = connection
        """The connection it is reached by."""
        self.system_id = system_id
        """MAVLink system id, 1–255."""
        self.component_id = component_id
        """Component id of its autopilot, usually 1."""
        self.vehicle_type = heartbeat.type
        """MAV_TYPE of the first heartbeat (https://mavlink.io/en/messages/minimal.html#MAV_TYPE)."""
        self.autopilot = autopilot_for(heartbeat)
        """What differs between ArduPilot, PX4 and others."""
        self.telemetry = Telemetry(
            connection.now, system_id=system_id, component_id=component_id, autopilot=self.autopilot
        )
        """The state cells; most are properties of the vehicle too."""
        self.link_quality: StateCell[LinkReport] = StateCell(
            "link_quality", connection.now, "second of traffic"
        )
        """Loss, delay and rates of the last second."""
        self._commands = CommandSender(
            connection, system_id, component_id, self.describe_link, lambda: self._link_watch.round_trip_s
        )
        self._rates = MessageRates(
            connection, self._commands, system_id, component_id, self.autopilot.stream_groups
        )
        self._watch = VehicleWatch(connection, system_id, component_id, self._on_reboot)
        self._link_watch = LinkWatch(
            connection, system_id, component_id, self._on_link_report, self._watch.note_answer
        )
        self._background = Background(connection.fail)
        self._transfers = Transfers(
            connection,
            system_id,
            component_id,
            autopilot=self.autopilot,
            version=self.telemetry.version,
            background=self._background,
            describe=self.describe_link,
            round_trip_s=lambda: self._link_watch.round_trip_s,
            send_command=self._commands.send_long,
        )
        self._is_closed = False
        self._helm = Helm(connection.now, self.telemetry)
        self._detach: list[Detach] = [self._helm.close]
        self._messages: dict[type[Message], StateCell[Any]] = {}
        self._message_rates: dict[type[Message], Detach] = {}
        self._attach_telemetry()

    # ---------------------------------------------------------------------------- commands

    async def command(
        self,
        command: int,
        *params: float,
        component_id: int | None = None,
        attempts: int = 4,
        attempt_timeout: float = 1.0,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
        standing: Standing | None = None,
    ) -> CommandAck:
        """Send any MAV_CMD as COMMAND_LONG and return its ACCEPTED ack.

        Args:
            command: the number, or a member of ``enums.MavCmd``.
            params: param1 to param7; missing ones are 0, NaN where the command says so.
            component_id: to another component than the autopilot; 0: to all, and the autopilot's answer counts.
            attempts: how often it is sent at most; ``confirmation`` rises with each. What changes something is sent
                again only right after a HEARTBEAT that tells of no other mode, and no newer order; see
                docs/reliability.md.
            attempt_timeout: seconds to wait for an ack after each, and at least two measured round trips.
            progress_timeout: seconds to wait after each IN_PROGRESS for the next answer; calibrations can take long.
            on_progress: called with 0–100, or None, for each IN_PROGRESS.
            standing: says whether it may be sent again, instead of these rules: for programs that keep orders of their
                own. The order is no newer one then.

        See https://mavlink.io/en/services/command.html.

        Raises:
            LocalProtocolError: a parameter is no number or does not fit. Nothing was sent.
            CommandRejected: any other result; ``reasons`` has the status texts seen meanwhile.
            CommandTimeout: no ack; the text names attempts, seconds, the last heartbeat and the loss.
        """
        return await self._answered(
            self._commands.send_long,
            command,
            *params,
            component_id=component_id,
            attempts=attempts,
            attempt_timeout=attempt_timeout,
            progress_timeout=progress_timeout,
            on_progress=on_progress,
            standing=standing,
        )

    async def command_int(
        self,
        command: int,
        *params: float,
        frame: int,
        x: int = 0,
        y: int = 0,
        z: float = 0.0,
        component_id: int | None = None,
        attempts: int = 4,
        attempt_timeout: float = 1.0,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
        standing: Standing | None = None,
    ) -> CommandAck:
        """Send any MAV_CMD as COMMAND_INT: param1 to param4, ``x``, ``y``, ``z`` in ``frame`` (MAV_FRAME).

        ``x`` and ``y`` are latitude and longitude in 1e-7 degrees, or 1e-4 m in local frames; ``z`` metres. The rest
        is as for :meth:`command`.
        """
        return await self._answered(
            self._commands.send_int,
            command,
            *params,
            frame=frame,
            x=x,
            y=y,
            z=z,
            component_id=component_id,
            attempts=attempts,
            attempt_timeout=attempt_timeout,
            progress_timeout=progress_timeout,
            on_progress=on_progress,
            standing=standing,
        )

    def send(self, message: Message) -> None:
        """Send one message as it is, once; never blocks. Its ``target_system`` is yours to set.

        A command that steers (as by :meth:`command`) and SET_MODE are newer orders: those of the actions end.

        Raises:
            LocalProtocolError: a field is out of range; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended, or the block of this vehicle was left.
        """
        if self._is_closed:
            raise ConnectionClosed("the block of this vehicle was left; nothing was sent")
        self.connection.send(message)
        is_command = isinstance(message, (CommandInt, CommandLong)) and message.command in MOVING_COMMANDS
        if is_command or isinstance(message, SetMode):
            self._helm.order_of_the_programs_own()

    # ----------------------------------------------------------------------- subscriptions

    def subscribe(
        self,
        *types: type[ItemT],
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
        rate_hz: float | None = None,
    ) -> Subscription[ItemT]:
        """Return a stream of messages or events of this vehicle, for use in a ``with`` block.

        ``capacity=1`` gives the latest only, ``missed`` counts the others.

        Subscribing is the rate request: while the block lasts, the vehicle is asked to send these messages at
        ``rate_hz`` (above 0, at most 1000), or faster if others want it. None means the default rate of a message that
        comes in a stream; one that is sent when there is need (HEARTBEAT, STATUSTEXT, acks) is not asked for.

        Raises:
            LocalProtocolError: no type, a rate out of range, or a message that the dialect does not hold.
        """
        self.connection.check_types(types)
        messages: list[type[Message]] = [each for each in types if issubclass(each, Message)]
        if rate_hz is not None:
            for message in messages:
                check_rate(message, rate_hz)

        def attach(sink: Sink) -> list[Detach]:
            detach = self.connection.attach(types, sink, system_id=self.system_id)
            detach.append(self.connection.on_end(subscription.close))
            for each in messages:
                hz = subscription_rate_hz(each.__name__) if rate_hz is None else rate_hz
                if hz is not None:
                    detach.append(self._rates.want(each, hz))
            return detach

        subscription: Subscription[ItemT] = Subscription(attach, capacity=capacity, overflow=overflow)
        return subscription

    @contextmanager
    def rate(self, message_type: type[Message], rate_hz: float) -> Iterator[None]:
        """Have the vehicle send ``message_type`` at ``rate_hz`` or faster for the time of the ``with`` block."""
        release = self._rates.want(message_type, rate_hz)
        try:
            yield
        finally:
            release()

    @contextmanager
    def _streaming(self, *names: str) -> Iterator[None]:
        """Have what feeds these cells sent, also when the program asked for no rates of its own."""
        releases = [
            self._rates.want(message_type, ACTION_HZ, is_optional=True)
            for name in names
            for message_type in self.telemetry.required_messages(name)
        ]
        try:
            yield
        finally:
            for release in releases:
                release()

    # ------------------------------------------------------------------------------- state

    def message(self, message_type: type[MessageT], *, rate_hz: float | None = None) -> StateCell[MessageT]:
        """The latest message of a kind as it came, in a cell: ``vehicle.message(messages.RawImu).value.xacc``.

        The first call registers it, and has the vehicle send it at ``rate_hz`` (None: the default rate of a message
        that comes in a stream) for as long as the vehicle object lives; later calls give the same cell, and may change
        the rate. Only messages of the autopilot count.

        Raises:
            LocalProtocolError: the rate is out of range, or the dialect does not hold the message.
        """
        cell = self._messages.get(message_type)
        if cell is None:
            self.connection.check_types((message_type,))
            cell = self._messages[message_type] = self._message_cell(message_type)
            rate_hz = subscription_rate_hz(message_type.__name__) if rate_hz is None else rate_hz
        if rate_hz is not None:
            release = self._message_rates.pop(message_type, None)
            self._message_rates[message_type] = self._rates.want(message_type, rate_hz)
            if release is not None:
                release()
        return cell

    def _message_cell(self, message_type: type[Message]) -> StateCell[Any]:
        arrived_at = 0.0
        cell: StateCell[Any] = StateCell(
            message_type.NAME, self.connection.now, message_type.NAME, stamp=lambda: arrived_at
        )
        source = Source(self.system_id, self.component_id, message_type.NAME)

        def take(message: Message) -> None:
            nonlocal arrived_at
            frame = message.received_frame
            if frame is not None and self.telemetry.accepts(frame):
                arrived_at = frame.received_at
                cell.set(message, source)

        self._detach.append(self.connection.bus.attach(message_type, take, system_id=self.system_id))
        return cell

    @property
    def heartbeat_age(self) -> float:
        """Seconds since the last heartbeat of the autopilot."""
        return self.connection.now() - self._watch.last_heartbeat_at

    @property
    def is_silent(self) -> bool:
        """Whether no heartbeat comes: none for more than 3.5 seconds, or the link has gone."""
        return self._watch.is_silent

    @property
    def link_state(self) -> StateCell[LinkState]:
        """CONNECTED, SILENT (no heartbeat for more than 3.5 seconds) or LOST (the link has gone)."""
        return self._watch.link_state

    def describe_link(self) -> str:
        """One line on how well the vehicle is heard, for error texts."""
        received, lost = self.connection.counts(self.system_id)
        loss = (
            f"{100 * lost / (received + lost):.0f} % of its frames lost"
            if received + lost
            else "nothing heard"
        )
        if signatures := self.connection.describe_signatures(self.system_id, self.component_id):
            loss = f"{loss}, {signatures}"
        texts = self.texts_since(self.connection.now() - 10.0)
        said = f", it said: {'; '.join(texts[-3:])}" if texts else ""
        return f"last heartbeat {self.heartbeat_age:.1f} s ago, {loss}{said}"

    def texts_since(self, at: float) -> tuple[str, ...]:
        """What the vehicle said (STATUSTEXT) since this time on the loop's clock, oldest first."""
        return tuple(each.text for each in self.telemetry.texts_since(at))

    # ------------------------------------------------------------------------------ inside

    def _attach_telemetry(self) -> None:
        bus, streams = self.connection.bus, self.telemetry.streams
        for message_id, handler in self.telemetry.handles.items():
            message_type = bus.dialect.get(message_id)
            if message_type is None:
                continue
            if message_id in streams:
                detach = bus.attach_frames(message_type, streams[message_id].take, system_id=self.system_id)
            else:
                detach = bus.attach(message_type, handler, system_id=self.system_id)
            self._detach.append(detach)
        self._detach += [
            self.telemetry.mode.observe(self._on_mode),
            self.telemetry.armed.observe(self._on_armed),
            self.telemetry.landed_state.observe(self._on_landed_state),
            self.telemetry.status_text.observe(self._on_status_text, every_arrival=True),
        ]
        self._detach += [
            self.connection.bus.attach_event(LinkRestored, lambda _: self._rates.ask_again()),
            self.connection.on_end(self._on_end),
        ]

    async def _answered(
        self,
        send: Callable[..., Awaitable[CommandAck]],
        command: int,
        *params: float,
        standing: Standing | None,
        **options: Any,
    ) -> CommandAck:
        """What the commands of the program itself have in common; ``send`` is one of the command sender's."""
        started = self.connection.now()
        try:
            if standing is not None or command in QUESTIONS:
                return await send(command, *params, standing=standing, **options)
            with self._own_order(command) as order:
                armed = params[0] == 1 if command == COMPONENT_ARM_DISARM and params else None
                with self._helm.sending(order, armed=armed) as sending:
                    return await send(command, *params, standing=sending, **options)
        except CommandRejected as error:
            await self._settle()
            raise self._explained(error, started) from None

    @contextmanager
    def _own_order(self, command: int) -> Iterator[Order]:
        """A program that steers past the actions gives a new order, which ends theirs."""
        if command in MOVING_COMMANDS:
            yield self._helm.order_of_the_programs_own()
        else:
            with self._helm.aside() as order:
                yield order

    def _close(self) -> None:
        self._is_closed = self._transfers.is_closed = True
        self._on_end(ConnectionClosed("the block of this vehicle was left"))
        for detach in self._detach:
            detach()
        self._commands.close()
        self._watch.close()
        self._link_watch.close()
        self._rates.close()

    @contextmanager
    def _refusals_of(self, command: int) -> Iterator[list[CommandAck]]:
        """Collect later acks of a command that refuse what an earlier one accepted (PX4 acks some twice)."""
        refusals: list[CommandAck] = []

        def note(ack: CommandAck) -> None:
            frame = ack.received_frame
            is_its = frame is not None and frame.component_id == self.component_id
            if ack.command != command or not is_its or not self._commands.is_for_us(ack):
                return
            if ack.result == RESULT_ACCEPTED:
                refusals.clear()
            elif ack.result in RESULTS_OF_REFUSAL:
                refusals.append(ack)

        detach = self.connection.bus.attach(CommandAck, note, system_id=self.system_id)
        try:
            yield refusals
        finally:
            detach()

    async def _settle(self) -> None:
        await anyio.sleep(SETTLE_S)

    def _explained(
        self, error: CommandRejected, since: float, reasons: tuple[str, ...] = ()
    ) -> CommandRejected:
        texts = tuple(text for text in self.texts_since(since) if text not in reasons)
        return CommandRejected(
            str(error), command=error.command, result=error.result, reasons=(*texts, *reasons)
        )

    # ------------------------------------------------------------------------------ events

    def _on_mode(self, before: Any, after: Any) -> None:
        self._publish(ModeChanged, None if before is None else before.name, after.name)

    def _on_armed(self, before: bool | None, after: bool) -> None:
        self._publish(ArmedChanged, after)

    def _on_landed_state(self, before: int | None, after: int) -> None:
        self._publish(LandedStateChanged, before, after)

    def _on_status_text(self, before: Any, after: Any) -> None:
        self._publish(StatusTextReceived, after.severity, after.text)

    def _publish(self, event_type: type[Event], *fields: Any) -> None:
        self.connection.bus.publish(event_type(self.connection.now(), self.system_id, *fields))

    def _on_link_report(self, report: LinkReport) -> None:
        self.link_quality.set(report, Source(self.system_id, self.component_id, "link"))

    def _on_reboot(self) -> None:
        self._helm.note_reboot()
        self.telemetry.forget()
        for cell in self._messages.values():
            cell.forget()
        self._rates.ask_again()

    def _on_end(self, error: Exception) -> None:
        self._background.cancel()
        self._watch.end(error)
        self.telemetry.close(error)
        self.link_quality.close(error)
        for cell in self._messages.values():
            cell.close(error)
