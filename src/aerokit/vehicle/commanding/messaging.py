"""Raw commands, messages and subscriptions, and the quality of the vehicle's link."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, TypeVar

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.autopilots.modes import CUSTOM_MODE_ENABLED
from aerokit.connection.bus import Overflow, Subscription
from aerokit.connection.cells import StateCell
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import InvalidArgument
from aerokit.events import Event, LinkRestored, LinkSelected, VehicleRebooted, VehicleRecovered
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandAck, CommandInt, CommandLong, SetMode
from aerokit.vehicle.commanding.context import VehicleBase
from aerokit.vehicle.commanding.order import ARM_ALONE, Subject, subjects_of
from aerokit.vehicle.commanding.posted import PostedOrder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.autopilots import Mode
    from aerokit.events import LinkState
    from aerokit.vehicle.session.session import VehicleSession

# In REQUEST_DATA_STREAM, 0 means all groups of messages (``req_stream_id``) and all components (``target_component``),
# and 1 starts the streams (``start_stop``).
ALL_GROUPS = ALL_COMPONENTS = 0
START_STREAMS = 1

# Seconds until the first streamed message must arrive after a request.
FIRST_MESSAGE_TIMEOUT_S = 3.0

# While no message arrives, the interval between requests doubles up to this many seconds.
MAX_RETRY_INTERVAL_S = 60.0

# The arrival of any of these messages shows that the vehicle streams.
REQUESTED_STREAMS: tuple[type[Message], ...] = (
    m.Attitude,
    m.GlobalPositionInt,
    m.SysStatus,
    m.VfrHud,
    m.GpsRawInt,
)

# States that every vehicle should stream.
REQUIRED_STATES = (
    "attitude",
    "position",
    "ground_speed_m_s",
    "gps",
    "sensors",
    "local_position",
    "estimator",
    "rc_channels",
)


@contextmanager
def every_stream(session: VehicleSession, rate_hz: float) -> Iterator[None]:
    """Request all streams during a `with` block, and again if the vehicle may have lost the request."""
    check_range("rate_hz", rate_hz, 0, 1000, above=True)
    tasks = BackgroundTasks(session.connection.fail)
    with ExitStack() as cleanup:
        # Cancel the tasks when the session ends: their next request would fail, and that would end the connection
        # for other vehicles, too.
        cleanup.callback(session.end.on_end(lambda _: tasks.cancel()))
        if session.autopilot.stream_groups:
            monitor = _StreamMonitor(session, cleanup)
            tasks.start(lambda: _request_repeatedly(session, rate_hz, monitor), "aerokit streams")
        else:
            tasks.start(lambda: _request_missing(session, rate_hz, cleanup), "aerokit streams")
        try:
            yield
        finally:
            tasks.cancel()


async def _request_repeatedly(session: VehicleSession, rate_hz: float, monitor: _StreamMonitor) -> None:
    retry_interval_s = FIRST_MESSAGE_TIMEOUT_S
    request = m.RequestDataStream(
        target_system=session.system_id,
        target_component=ALL_COMPONENTS,
        req_stream_id=ALL_GROUPS,
        req_message_rate=max(1, round(rate_hz)),
        start_stop=START_STREAMS,
    )
    while True:
        session.send(request)
        monitor.reset()
        with anyio.move_on_after(retry_interval_s):
            await monitor.must_request.wait()
        if monitor.has_received:  # The vehicle streams, so the request need not be repeated.
            await monitor.must_request.wait()
        if monitor.must_request.is_set():
            retry_interval_s = FIRST_MESSAGE_TIMEOUT_S
        else:
            retry_interval_s = min(2 * retry_interval_s, MAX_RETRY_INTERVAL_S)


async def _request_missing(session: VehicleSession, rate_hz: float, cleanup: ExitStack) -> None:
    await anyio.sleep(FIRST_MESSAGE_TIMEOUT_S)
    telemetry = session.telemetry
    missing = [name for name in REQUIRED_STATES if not telemetry.cells[name].is_known]
    required = (message_type for name in missing for message_type in telemetry.required_messages(name))
    for message_type in dict.fromkeys(required):  # Several states may require the same message.
        cleanup.callback(session.rates.request(message_type, rate_hz))


class _StreamMonitor:
    """Tracks whether streamed messages arrive, and sets ``must_request`` when the vehicle may have lost the request."""

    def __init__(self, session: VehicleSession, cleanup: ExitStack) -> None:
        self.has_received = False
        self.must_request = asyncio.Event()
        self._system_id = session.system_id
        bus = session.connection.bus
        for message_type in REQUESTED_STREAMS:
            cleanup.callback(bus.attach(message_type, self._on_message, system_id=session.system_id))
        for event_type in (LinkSelected, LinkRestored, VehicleRecovered, VehicleRebooted):
            cleanup.callback(bus.attach_event(event_type, self._on_event))

    def reset(self) -> None:
        self.has_received = False
        self.must_request = asyncio.Event()

    def _on_message(self, message: Message) -> None:
        self.has_received = True

    def _on_event(self, event: Event) -> None:
        if event.system_id in (0, self._system_id):
            self.must_request.set()


# Value of ``target_system`` in a message to all systems.
ALL_SYSTEMS = 0

ItemT = TypeVar("ItemT", bound="Message | Event")

MessageT = TypeVar("MessageT", bound=Message)


@checks_arguments
class MessagingActions(VehicleBase):
    """Commands, messages, subscriptions, and descriptions of the vehicle."""

    # ---------------------------------------------------------------------------- commands

    async def command(
        self,
        command: int,
        *params: float,
        component_id: int | None = None,
        retries: int | None = None,
        attempt_timeout: float | None = None,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
    ) -> CommandAck:
        """Send any MAV_CMD as COMMAND_LONG and return its ACCEPTED ack.

        See https://mavlink.io/en/services/command.html.

        Args:
            command: the number, or a member of ``enums.MavCmd``.
            params: param1 to param7; missing ones are sent as 0, never as NaN.
            component_id: the target component, by default the autopilot. 0: all components; the autopilot's ack counts.
            retries: maximum number of retransmissions without an ack, from 0; ``confirmation`` increments each time.
                None: 3 for a request for data, 0 for all other commands, because a retry after a lost ack would execute
                the command twice. aerokit retries a command other than a request only right after a HEARTBEAT, and only
                if the mode has not changed, no failsafe is active and there is no newer order (docs/reliability.md).
            attempt_timeout: seconds to wait for an ack after each transmission, above 0, extended to two measured round
                trips if necessary. None: 1, or 4 if the command is sent only once.
            progress_timeout: seconds to wait for the next ack after each IN_PROGRESS; calibrations can take long.
            on_progress: called for each IN_PROGRESS with the progress, 1–100 or None if unknown.

        Raises:
            InvalidArgument: a parameter has the wrong type or is too large for its field. Nothing was sent.
            CommandRejected: the result is not ACCEPTED; ``reasons`` has the status texts received meanwhile.
            CommandTimeout: there was no ack. The error text has the attempts, the seconds, the age of the last
                heartbeat and the packet loss.
        """
        return await self._sender.send_raw(
            self._session.commands.send_long,
            command,
            *params,
            component_id=component_id,
            retries=retries,
            attempt_timeout=attempt_timeout,
            progress_timeout=progress_timeout,
            on_progress=on_progress,
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
        retries: int | None = None,
        attempt_timeout: float | None = None,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
        or_long: bool = False,
    ) -> CommandAck:
        """Send any MAV_CMD as COMMAND_INT: param1 to param4, ``x``, ``y``, ``z`` in ``frame`` (MAV_FRAME).

        ``x`` and ``y`` are latitude and longitude in 1e-7 degrees, or 1e-4 m in local frames; ``z`` is in metres. With
        ``or_long``, firmware that does not support the command as COMMAND_INT gets a COMMAND_LONG with ``x`` and ``y``
        in degrees. Because COMMAND_LONG has no frame, ``or_long`` requires ``frame=0``, and is only for commands whose
        altitude is always above mean sea level. Other arguments and errors are those of :meth:`command`.
        """
        if or_long and frame != MavFrame.GLOBAL:
            raise InvalidArgument(f"frame = {frame} is not allowed with or_long: it must be MAV_FRAME_GLOBAL (0)")
        commands = self._session.commands
        send = commands.send_place if or_long else commands.send_int
        frame_option = {} if or_long else {"frame": frame}  # `send_place` has a fixed frame.
        return await self._sender.send_raw(
            send,
            command,
            *params,
            **frame_option,
            x=x,
            y=y,
            z=z,
            component_id=component_id,
            retries=retries,
            attempt_timeout=attempt_timeout,
            progress_timeout=progress_timeout,
            on_progress=on_progress,
        )

    def send(self, message: Message) -> None:
        """Send one message unchanged, once; never blocks. The caller sets its ``target_system``.

        If the message is a command (or SET_MODE) that changes the mode or the motion, it ends the action in progress,
        as :meth:`command` does. A set-point, a guided mission item or MISSION_SET_CURRENT does not end the action in
        progress, only the orders about motion that were given by :meth:`posted`. A message to another system ends
        nothing.

        Raises:
            InvalidArgument: a field is out of range; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended, or this vehicle's `async with` block was left.
        """
        self._session.send(message)
        self.note_sent(message)

    def note_sent(self, message: Message) -> None:
        """Tell aerokit about a message that you sent by ``connection.send``, because it may replace earlier orders.

        :meth:`send` does this itself.
        """
        target = getattr(message, "target_system", self.system_id)  # All steering messages have this field.
        subjects = subjects_of(message) if target in (ALL_SYSTEMS, self.system_id) else ()
        if not subjects:
            return
        if subjects == ARM_ALONE and isinstance(message, (CommandInt, CommandLong)):
            self._arbiter.record_own_arming(message.param1 == 1)
        elif isinstance(message, (CommandInt, CommandLong, SetMode)):
            order = self._arbiter.raw_order(subjects, modes=self._modes_of(message))
            order.was_sent = True
        else:  # Set-points and mission messages end orders of `Vehicle.posted`, but not the action in progress.
            self._arbiter.supersede(subjects)

    def _modes_of(self, message: CommandInt | CommandLong | SetMode) -> tuple[Mode, ...]:
        """Return the modes to which the message may change the vehicle; an empty tuple if that may be any mode."""
        names = self.telemetry.mode_names
        if isinstance(message, SetMode):
            has_custom_mode = message.base_mode & CUSTOM_MODE_ENABLED
            return (self.autopilot.mode(message.custom_mode, message.base_mode, names),) if has_custom_mode else ()
        params = (message.param1, message.param2, message.param3, message.param4)
        return self.autopilot.modes_of_command(message.command, params, names)

    @contextmanager
    def posted(
        self, *subjects: Subject, modes: tuple[Mode, ...] = (), armed: bool | None = None
    ) -> Iterator[PostedOrder]:
        """Open an order without waiting for its effect, so that orders for mode, arming and take-off can overlap.

        In the ``with`` block, aerokit sends each command of the order again right after a HEARTBEAT, until the vehicle
        acknowledges it or reports its effect. The retries also end in these cases:

        - You give a newer order about the first of ``subjects``.
        - The vehicle reboots or, if the first subject is ``"motion"``, disarms.
        - A failsafe becomes active. This does not end an order to land, to return or to disarm.
        - The mode changes to one that neither this order nor an order of the ten seconds before it asked for. This does
          not end an order to disarm.

        If you leave the block early, aerokit neither makes the vehicle hold nor disarms it if it arms later. Use the
        actions for that.

        Args:
            subjects: ``"mode"``, ``"motion"`` or ``"arm"``. If the first subject is mode or motion, the order also ends
                the action in progress.
            modes: the modes that the vehicle may change to because of the order.
            armed: True if the order arms the vehicle, False if it disarms it; required for ``"arm"``.

        Raises:
            InvalidArgument: there is no subject, or ``"arm"`` was given without ``armed``. Nothing was sent.
        """
        if not subjects:
            raise InvalidArgument("posted() needs at least one subject: 'mode', 'motion' or 'arm'")
        if "arm" in subjects and armed is None:
            raise InvalidArgument("posted(): the subject 'arm' requires armed=True or armed=False")
        with (
            self._arbiter.posted_order(subjects, modes=modes, armed=armed) as order,
            PostedOrder(self._session, self._arbiter, self._sender, order) as posted,
        ):
            yield posted

    # ----------------------------------------------------------------------- subscriptions

    def subscribe(
        self,
        *types: type[ItemT],
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
        rate_hz: float | None = None,
    ) -> Subscription[ItemT]:
        """Return a stream of messages or events of this vehicle, for use in a ``with`` block.

        Messages of all components of the vehicle are delivered. ``capacity=1`` keeps only the latest message;
        ``missed`` counts the dropped messages. For the duration of the block, aerokit requests these messages from the
        autopilot at ``rate_hz`` (above 0, at most 1000), or faster if another subscriber needs it. With
        ``rate_hz=None``, streamed messages are requested at their default rate. Messages that are not streamed
        (STATUSTEXT, acks), and HEARTBEAT, are not requested. To request messages from a camera or another component,
        use ``vehicle.component(100).subscribe(...)``.

        Raises:
            InvalidArgument: no type was given, the rate is out of range, or the dialect does not contain a message.
        """
        return self._session.subscriber.subscribe(types, capacity, overflow, rate_hz, entire_system=True)

    @contextmanager
    def rate(self, message_type: type[Message], rate_hz: float) -> Iterator[None]:
        """Request ``message_type`` at ``rate_hz`` or faster for the duration of the ``with`` block."""
        release = self._session.rates.request(message_type, rate_hz)
        try:
            yield
        finally:
            release()

    @contextmanager
    def streams(self, rate_hz: float) -> Iterator[None]:
        """Request all streams of the vehicle at ``rate_hz`` for the duration of the ``with`` block.

        Use this for recordings, ground stations, and firmware that cannot set the rate of a single message. ArduPilot
        gets REQUEST_DATA_STREAM (whole Hz, at least 1). aerokit repeats it after a reboot or a silence, and while no
        message arrives. ArduPilot continues to stream after the block. Other autopilots stream by themselves; aerokit
        requests only those common states that are missing.

        Raises:
            InvalidArgument: the rate is out of range: it must be above 0 and at most 1000. Nothing was sent.
        """
        with every_stream(self._session, rate_hz):
            yield

    # ------------------------------------------------------------------------------- state

    def message(self, message_type: type[MessageT], *, rate_hz: float | None = None) -> StateCell[MessageT]:
        """Return the cell with the latest message of a type: ``vehicle.message(messages.RawImu).value.xacc``.

        The first call requests the message at ``rate_hz`` (None: the default rate of a streamed message) for the
        lifetime of the vehicle object. Later calls return the same cell and may change the rate. Only messages of the
        autopilot count; use ``vehicle.component(100).message(...)`` for a camera or another component.

        Raises:
            InvalidArgument: the rate is out of range, or the dialect does not contain the message.
        """
        return self._session.subscriber.cell(message_type, rate_hz)

    @property
    def mode_name(self) -> str:
        """Name of the flight mode, ``"unknown"`` before the first heartbeat."""
        return self.telemetry.mode_name

    @property
    def is_armed(self) -> bool:
        """True if the last heartbeat reports armed; False while the state is unknown."""
        return self.telemetry.is_armed

    @property
    def is_confirmed_disarmed(self) -> bool:
        """True if the last heartbeat reports disarmed; False while the state is unknown."""
        return self.telemetry.is_confirmed_disarmed

    @property
    def is_vtol(self) -> bool:
        """True for a VTOL vehicle, which can hover and cruise on wings (EXTENDED_SYS_STATE reports a VTOL state)."""
        return self.telemetry.is_vtol

    @property
    def heartbeat_age(self) -> float:
        """Seconds since the last heartbeat of the autopilot."""
        return self._session.heartbeat_age

    @property
    def is_silent(self) -> bool:
        """True if no heartbeat was received for more than 3.5 seconds, or the link is lost."""
        return self._session.watch.is_silent

    @property
    def link_state(self) -> StateCell[LinkState]:
        """CONNECTED, SILENT (no heartbeat for more than 3.5 seconds) or LOST (the link failed or was closed)."""
        return self._session.watch.link_state

    def describe_link(self) -> str:
        """Return one line about the link's quality, for error texts."""
        return self._session.describe_link()

    def describe_now(self) -> str:
        """Return a text about the reported state.

        For example: ``holding in BRAKE, still armed, 9.0 m above home, last heartbeat 0.3 s ago``.
        """
        return self._context.describe_now()

    def texts_since(self, at: float) -> tuple[str, ...]:
        """Return the status texts (STATUSTEXT) received since ``at``, a time of the loop's clock, oldest first."""
        return self._session.texts_since(at)
