"""`VehicleSession`: all communication with one vehicle."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.autopilots import autopilot_for
from aerokit.connection.bus import EndSignal
from aerokit.connection.cells import Source, StateCell
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    ConnectionClosed,
    OperationRejected,
)
from aerokit.events import (
    ArmedChanged,
    ComputerSlept,
    LandedStateChanged,
    LinkReport,
    LinkRestored,
    LinkSelected,
    ModeChanged,
    StatusTextReceived,
)
from aerokit.mavlink.enums import MavCmd, MavResult, MavSeverity
from aerokit.mavlink.messages import (
    AutopilotVersion,
    AvailableModes,
    CommandAck,
    GpsGlobalOrigin,
    HomePosition,
)
from aerokit.protocols.command import MAX_HEARTBEAT_AGE_S
from aerokit.protocols.exchange import RoundTrip
from aerokit.vehicle.session.commands import CommandSender
from aerokit.vehicle.session.rates import MessageRates
from aerokit.vehicle.session.subscriber import ComponentSubscriber, WatchedStream
from aerokit.vehicle.session.transfers import Transfers
from aerokit.vehicle.session.watch import LinkWatch, VehicleWatch
from aerokit.vehicle.state.field import MESSAGE_IDS
from aerokit.vehicle.state.states import STATES
from aerokit.vehicle.state.telemetry import Telemetry

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from aerokit.autopilots import Autopilot
    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.events import Event
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import Heartbeat


# Seconds between requests for constants that are not known yet.
RETRY_INTERVAL_S = 3.0

# The modes are not requested any more after this many acknowledgements without a mode. A single one does not suffice,
# because it may be a copy: PX4 acknowledges a command over each of its ports.
MAX_MODE_REQUESTS = 3

# The first requests for the version: maximum number, and seconds to wait for each acknowledgement and each message.
EAGER_REQUESTS, EAGER_INTERVAL_S = 4, 0.3


async def learn_constants(connection: Connection, commands: CommandSender, telemetry: Telemetry) -> None:
    """Request version, home, origin and modes while they are unknown.

    Runs until the link closes, because a reboot makes version, home and origin unknown again.
    """
    mode_requests_left = MAX_MODE_REQUESTS
    await _learn_version(commands, telemetry)
    while connection.is_open:
        for message_id, cell in (
            (AutopilotVersion.ID, telemetry.version),
            (HomePosition.ID, telemetry.home),
            (GpsGlobalOrigin.ID, telemetry.origin),
        ):
            if not cell.is_known:
                await _request(commands, message_id)
        if mode_requests_left and not telemetry.has_available_modes:
            is_answered = await _request(commands, AvailableModes.ID)
            if is_answered:
                mode_requests_left -= 1
        await anyio.sleep(RETRY_INTERVAL_S)


async def _learn_version(commands: CommandSender, telemetry: Telemetry) -> None:
    version = telemetry.version
    # AUTOPILOT_VERSION is requested at short intervals, because the first transfer waits for its capabilities.
    for _ in range(EAGER_REQUESTS):
        if version.is_known:
            return
        await _request(commands, AutopilotVersion.ID, attempt_timeout=EAGER_INTERVAL_S)
        with anyio.move_on_after(EAGER_INTERVAL_S):
            await version.wait_until(lambda _: True)


async def _request(commands: CommandSender, message_id: int, *, attempt_timeout: float = 1.0) -> bool:
    """Request one message. Return True if the vehicle answered, even if it refused."""
    try:
        await commands.send_long(MavCmd.REQUEST_MESSAGE, message_id, attempts=2, attempt_timeout=attempt_timeout)
    except CommandTimeout:
        return False
    except CommandRejected:
        pass
    return True


STATUS_TEXT_DELAY_S = 0.3
"""Seconds to wait for status texts after a refusal."""

ACTION_HZ = 5.0
"""Rate in Hz of the messages that an action waits for.

This is half the rate of the position, so that the vehicle can send these messages in the same datagrams.
"""

RESULTS_OF_REFUSAL = (MavResult.TEMPORARILY_REJECTED, MavResult.DENIED, MavResult.FAILED)


class VehicleSession:
    """Communication with the autopilot of one system: state, commands, message rates, transfers, silence.

    ``on_reboot`` holds callbacks that are called when the vehicle reboots.
    """

    def __init__(self, connection: Connection, system_id: int, component_id: int, heartbeat: Heartbeat) -> None:
        self.connection: Connection = connection
        self.system_id: int = system_id
        self.component_id: int = component_id
        self.vehicle_type: int = heartbeat.type
        self.autopilot: Autopilot = autopilot_for(heartbeat)
        self.end: EndSignal = EndSignal()
        """Signals the end of the connection, or of the vehicle's `async with` block."""
        self.telemetry: Telemetry = Telemetry(
            connection.now, system_id=system_id, component_id=component_id, autopilot=self.autopilot
        )
        self.link_quality: StateCell[LinkReport] = StateCell("link_quality", connection.now, "second of traffic")
        self.commands: CommandSender = CommandSender(
            connection,
            system_id,
            component_id,
            describe=self.describe_link,
            round_trip_s=lambda: self.link_watch.round_trip_s,
            acks_per_command=self.autopilot.acks_per_command,
        )
        self.rates: MessageRates = MessageRates(
            connection, self.commands, system_id, component_id, self.autopilot.stream_groups
        )
        self.subscriber: ComponentSubscriber = ComponentSubscriber(
            connection,
            system_id,
            component_id,
            self.rates,
            register_cell=self.register_cell,
            at_close=self.at_close,
            end=self.end,
        )
        frame = heartbeat.received_frame
        heartbeat_at = connection.now() if frame is None else frame.received_at
        self.watch: VehicleWatch = VehicleWatch(connection, system_id, component_id, self._on_reboot, heartbeat_at)
        self.link_watch: LinkWatch = LinkWatch(
            connection, system_id, component_id, self._on_link_report, self.watch.on_time_answer
        )
        self.background: BackgroundTasks = BackgroundTasks(connection.fail)
        self.transfers: Transfers = Transfers(
            connection,
            system_id,
            component_id,
            autopilot=self.autopilot,
            version=self.telemetry.version,
            background=self.background,
            end=self.end,
            describe=self.describe_link,
            round_trip_s=lambda: self.link_watch.round_trip_s,
            round_trip=RoundTrip(link_s=lambda: self.link_watch.round_trip_s),
            send_command=self.commands.send_long,
        )
        self.is_closed: bool = False
        # Cells that are not part of the telemetry.
        self._cells: list[StateCell[Any]] = [self.link_quality]
        self._detach_callbacks: list[Detach] = []
        self.on_reboot: list[Callable[[], None]] = [
            self.rates.request_again,
            self.commands.forget_results,
        ]
        self._attach_telemetry()

    # ------------------------------------------------------------------------- begin and end

    def start(self, heartbeat: Heartbeat, rates: Mapping[type[Message], float] | None) -> None:
        self.telemetry.receive(heartbeat)
        # Only messages that the program itself has named are reported as missing.
        are_default = rates is None
        requested_rates = self.telemetry.default_rates if rates is None else rates
        for message_type, hz in requested_rates.items():
            self.rates.request(message_type, hz, is_optional=are_default)
        for task in (self.rates.run, self.rates.watch, self._run_link_watch, self._learn_constants):
            self.background.start(task, f"aerokit {task.__qualname__}")

    def close(self) -> None:
        """Stop sending and receiving. Waiting calls raise ConnectionClosed."""
        self.is_closed = True
        self._on_end(ConnectionClosed("the async with block of this vehicle was left"))
        for detach in self._detach_callbacks:
            detach()
        self.commands.close()
        self.watch.close()
        self.link_watch.close()
        self.rates.close()

    def at_close(self, *functions: Detach) -> None:
        """Call these functions when the vehicle's `async with` block ends, or now if it has already ended."""
        self._detach_callbacks += functions
        if self.is_closed:
            for function in functions:
                function()

    def register_cell(self, cell: StateCell[Any]) -> None:
        """Reset this cell when the vehicle reboots, and close it with the session."""
        self._cells.append(cell)
        self.add_timeout_hint(cell)
        self.on_reboot.append(cell.forget)
        if self.end.error is not None:
            cell.close(self.end.error)

    @property
    def is_open(self) -> bool:
        """True while messages can be sent."""
        return self.connection.is_open and not self.is_closed

    def add_timeout_hint(self, *cells: StateCell[Any]) -> None:
        """Make time-out errors of these state cells mention frames that were dropped for their signature."""
        for cell in cells:
            cell._explain_timeout = self._describe_signatures

    def send(self, message: Message) -> None:
        """Send one message unchanged. Raises ConnectionClosed after :meth:`close`."""
        if self.is_closed:
            raise ConnectionClosed("the async with block of this vehicle was left; nothing was sent")
        self.connection.send(message)

    # ----------------------------------------------------------------------------- receiving

    @contextmanager
    def streaming(self, *names: str, hz: float = ACTION_HZ) -> Iterator[None]:
        """Request the messages of these states during a `with` block."""
        release_requests = [
            self.rates.request(message_type, hz, is_optional=True)
            for name in names
            for message_type in self.telemetry.required_messages(name)
        ]
        try:
            yield
        finally:
            for release in release_requests:
                release()

    def check_disarmed(self, action: str, *, is_state_recent: bool = True) -> None:
        """Raise OperationRejected unless the vehicle is known to be disarmed and ``is_state_recent`` is true."""
        if not self.telemetry.is_confirmed_disarmed or not is_state_recent:
            state = "armed" if self.telemetry.is_armed else "not known to be disarmed"
            raise OperationRejected(f"{action}: the vehicle is {state}; nothing was sent")

    @property
    def is_held_back(self) -> bool:
        """True from a loss of the link until the vehicle's clock shows that it is the same boot of the same vehicle."""
        return self.connection.is_held_back(self.system_id)

    async def wait_for_heartbeat(self, since: float | None = None) -> None:
        """Wait for a HEARTBEAT received after ``since``, by default after this call.

        Raises OperationRejected if the link was reopened meanwhile and may lead to another vehicle.
        """
        other_boots = self.watch.other_boots
        # Every HEARTBEAT updates `armed`.
        armed = self.telemetry.armed
        start = self.connection.now() if since is None else since
        # A HEARTBEAT that waited long while the event loop was blocked does not count.
        await armed.wait_until(
            lambda _: armed.updated_at > start and armed.age <= MAX_HEARTBEAT_AGE_S, description="the next HEARTBEAT"
        )
        self.watch.raise_if_other_boot(other_boots, "nothing was sent over this link")

    def is_answer(self, ack: CommandAck, command: int) -> bool:
        frame = ack.received_frame
        is_from_autopilot = frame is not None and self.telemetry.accepts(frame)
        return is_from_autopilot and ack.command == command and self.commands.is_for_us(ack)

    @contextmanager
    def refusals_of(self, command: int) -> Iterator[list[CommandAck]]:
        """Collect the acks that refuse a command during a `with` block."""
        refusals: list[CommandAck] = []

        def collect(ack: CommandAck) -> None:
            if not self.is_answer(ack, command):
                return
            # PX4 acknowledges some commands twice, and may first accept and then refuse them. If it accepts the command
            # again, for example because the command was repeated, the refusals so far do not count.
            if ack.result == MavResult.ACCEPTED:
                refusals.clear()
            elif ack.result in RESULTS_OF_REFUSAL:
                refusals.append(ack)

        detach = self.connection.bus.attach(CommandAck, collect, system_id=self.system_id)
        try:
            yield refusals
        finally:
            detach()

    async def wait_for_status_texts(self) -> None:
        # The status texts that explain a refusal may arrive after it.
        await anyio.sleep(STATUS_TEXT_DELAY_S)

    def with_reasons(self, error: CommandRejected, since: float, reasons: tuple[str, ...] = ()) -> CommandRejected:
        """Return the error with ``reasons`` and with the vehicle's status texts from ``since`` on."""
        # Informational texts such as "ArduPilot Ready" are left out, unless they are known refusals.
        texts = [
            text.text
            for text in self.telemetry.texts_since(since)
            if text.severity <= MavSeverity.WARNING or self.autopilot.is_refusal(text.text)
        ]
        return CommandRejected(
            str(error).partition("\n")[0],  # Only the first line, because the constructor adds the reasons again.
            command=error.command,
            result=error.result,
            reasons=self.deduplicate_reasons(*error.reasons, *texts, *reasons),
        )

    def deduplicate_reasons(self, *texts: str) -> tuple[str, ...]:
        # ArduPilot sends the same text once as "PreArm: …" and once as "Arm: …".
        reasons: dict[str, str] = {}
        for text in texts:
            reasons.setdefault(self.autopilot.arming_reason(text) or text, text)
        return tuple(reasons.values())

    def texts_since(self, at: float) -> tuple[str, ...]:
        """Return the status texts (STATUSTEXT) received since ``at``, a time of the loop's clock, oldest first."""
        return tuple(text.text for text in self.telemetry.texts_since(at))

    @property
    def heartbeat_age(self) -> float:
        """Seconds since the last heartbeat of the autopilot."""
        return self.connection.now() - self.watch.last_heartbeat_at

    def describe_link(self) -> str:
        received, lost = self.connection.counts(self.system_id)
        sent = received + lost
        loss = f"{100 * lost / sent:.0f} % of the vehicle's frames lost" if sent else "nothing received"
        signatures = self._describe_signatures()
        signature_problems = f"{signatures}; " if signatures else ""
        texts = self.texts_since(self.connection.now() - 10.0)
        recent_texts = f", status texts: {'; '.join(texts[-3:])}" if texts else ""
        return f"{signature_problems}last heartbeat {self.heartbeat_age:.1f} s ago, {loss}{recent_texts}"

    def _describe_signatures(self) -> str:
        return self.connection.describe_signature_problems(self.system_id)

    # -------------------------------------------------------------------------------- events

    def publish(self, event_type: type[Event], *fields: Any) -> None:
        """Publish an event with the present time and this vehicle's system id."""
        self.connection.bus.publish(event_type(self.connection.now(), self.system_id, *fields))

    def _attach_telemetry(self) -> None:
        bus = self.connection.bus
        self._attach_messages()
        self._attach_watched_streams()
        self.add_timeout_hint(*self.telemetry.cells.values(), self.link_quality, self.watch.link_state)
        self._detach_callbacks += [
            *self._publish_changes(),
            bus.attach_event(LinkRestored, self._on_link_restored),
            bus.attach_event(LinkSelected, self._on_link_selected),
            bus.attach_event(ComputerSlept, self._on_computer_slept),
            self.connection.on_end(self._on_end),
        ]

    def _attach_messages(self) -> None:
        bus, streams = self.connection.bus, self.telemetry.streams
        for message_id, handler in self.telemetry.handles.items():
            message_type = bus.dialect.get(message_id)
            if message_type is None:
                continue
            if message_id in streams:  # The frames of this message are decoded only when a state is read.
                detach = bus.attach_lazily(message_type, streams[message_id].receive, system_id=self.system_id)
            else:
                detach = bus.attach(message_type, handler, system_id=self.system_id)
            self._detach_callbacks.append(detach)

    def _publish_changes(self) -> list[Detach]:
        """Publish changes of states as events, until the returned functions are called."""
        telemetry, publish = self.telemetry, self.publish
        return [
            telemetry.mode.observe(
                lambda before, mode: publish(ModeChanged, None if before is None else before.name, mode.name)
            ),
            telemetry.armed.observe(lambda _, armed: publish(ArmedChanged, armed)),
            telemetry.landed_state.observe(lambda before, after: publish(LandedStateChanged, before, after)),
            telemetry.status_text.observe(
                lambda _, text: publish(StatusTextReceived, text.severity, text.text), every_arrival=True
            ),
        ]

    def _attach_watched_streams(self) -> None:
        """Make each state with a ``watched_hz`` request its message while the program waits for it or follows it."""
        for name, state in STATES.items():
            cell = self.telemetry.cells[name]
            for source in state.sources:
                message_type = self.connection.bus.dialect.get(MESSAGE_IDS[source.message])
                if source.watched_hz is None or message_type is None:
                    continue
                if self.autopilot.sends(message_type):
                    request = partial(self.rates.request, message_type, source.watched_hz, is_optional=True)
                    cell._feed_from(*cell._feeds, WatchedStream(cell, request))  # in addition to its present feeds

    def _on_link_selected(self, event: LinkSelected) -> None:
        # An autopilot keeps separate rates for each of its ports, and may receive the new link on another port.
        if event.system_id == self.system_id and event.before is not None:
            self.rates.request_again()

    def _on_link_restored(self, event: LinkRestored) -> None:
        self.rates.request_again()
        # The answers show whether the link leads to the same boot of the same vehicle.
        self.link_watch.request_time()

    def _on_computer_slept(self, event: ComputerSlept) -> None:
        # The loop's clock stood still while the computer slept, so the ages do not include this time yet.
        self.watch.last_heartbeat_at -= event.seconds
        for cell in (*self.telemetry.cells.values(), *self._cells):
            cell._add_age(event.seconds)

    def _on_link_report(self, report: LinkReport) -> None:
        self.link_quality.set(report, Source(self.system_id, self.component_id, "link"))

    async def _run_link_watch(self) -> None:
        await self.link_watch.run(self._on_second)

    def _on_second(self) -> None:
        self.watch.check()
        if self.is_held_back:
            self.link_watch.request_time()
        self.telemetry.expire(self.connection.now())

    async def _learn_constants(self) -> None:
        await learn_constants(self.connection, self.commands, self.telemetry)

    def _on_reboot(self) -> None:
        self.telemetry.forget()
        for callback in self.on_reboot:
            callback()

    def _on_end(self, error: Exception) -> None:
        self.background.cancel()
        self.watch.end(error)
        self.telemetry.close(error)
        for cell in self._cells:
            cell.close(error)
        if self.end.error is None:
            self.end.error = error
            self.end.notify(error)
