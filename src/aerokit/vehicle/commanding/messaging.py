"""Talking to a vehicle past its actions: any command, any message, and how well it is heard."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, TypeVar

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.autopilots.modes import CUSTOM_MODE_ENABLED
from aerokit.connection.bus import Overflow, Subscription
from aerokit.connection.cells import StateCell
from aerokit.connection.tasks import Background
from aerokit.errors import InvalidArgument
from aerokit.events import Event, LinkChosen, LinkRestored, VehicleBack, VehicleRebooted
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandAck, CommandInt, CommandLong, SetMode
from aerokit.vehicle.commanding.context import Part
from aerokit.vehicle.commanding.order import ARM_ALONE, Subject, subjects_of
from aerokit.vehicle.commanding.posted import PostedOrder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.autopilots import Mode
    from aerokit.events import LinkState
    from aerokit.vehicle.session.session import Talk

EVERY_GROUP = EVERY_COMPONENT = 0

COMES_WITHIN_S = 3.0

LONGEST_S = 60.0

REQUESTED_STREAMS: tuple[type[Message], ...] = (
    m.Attitude,
    m.GlobalPositionInt,
    m.SysStatus,
    m.VfrHud,
    m.GpsRawInt,
)

NEEDED = (
    "attitude",
    "position",
    "ground_speed_m_s",
    "gps",
    "sensors",
    "local_position",
    "estimator",
    "rc_channels",
)
"""States that every vehicle should stream."""


@contextmanager
def every_stream(talk: Talk, rate_hz: float) -> Iterator[None]:
    """See ``Vehicle.streams``."""
    check_range("rate_hz", rate_hz, 0, 1000, above=True)
    tasks = Background(talk.connection.fail)
    with ExitStack() as ends:
        if talk.autopilot.stream_groups:
            heard = _Heard(talk, ends)
            tasks.start(lambda: _keep_asking(talk, rate_hz, heard), "aerokit streams")
        else:
            tasks.start(lambda: _want_missing(talk, rate_hz, ends), "aerokit streams")
        try:
            yield
        finally:
            tasks.cancel()


async def _keep_asking(talk: Talk, rate_hz: float, heard: _Heard) -> None:
    patience_s = COMES_WITHIN_S
    rate = max(1, round(rate_hz))
    while True:
        talk.send(m.RequestDataStream(talk.system_id, EVERY_COMPONENT, EVERY_GROUP, rate, 1))
        heard.forget()
        with anyio.move_on_after(patience_s):
            await heard.is_to_be_asked.wait()
            patience_s = COMES_WITHIN_S
            continue
        patience_s = min(2 * patience_s, LONGEST_S)
        if heard.something:
            await heard.is_to_be_asked.wait()
            patience_s = COMES_WITHIN_S


async def _want_missing(talk: Talk, rate_hz: float, ends: ExitStack) -> None:
    await anyio.sleep(COMES_WITHIN_S)
    telemetry = talk.telemetry
    missing = [name for name in NEEDED if not telemetry.cells[name].is_known]
    for message_type in dict.fromkeys(each for name in missing for each in telemetry.required_messages(name)):
        ends.callback(talk.rates.want(message_type, rate_hz))


class _Heard:
    """Whether streamed messages have come, and whether streams are to be asked for again."""

    def __init__(self, talk: Talk, ends: ExitStack) -> None:
        self.something = False
        self.is_to_be_asked = asyncio.Event()
        self._system_id = talk.system_id
        bus = talk.connection.bus
        for message_type in REQUESTED_STREAMS:
            ends.callback(bus.attach(message_type, self._on_message, system_id=talk.system_id))
        for event_type in (LinkChosen, LinkRestored, VehicleBack, VehicleRebooted):
            ends.callback(bus.attach_event(event_type, self._on_event))

    def forget(self) -> None:
        self.something, self.is_to_be_asked = False, asyncio.Event()

    def _on_message(self, message: Message) -> None:
        self.something = True

    def _on_event(self, event: Event) -> None:
        if event.system_id in (0, self._system_id):
            self.is_to_be_asked.set()


EVERYBODY = 0
"""``target_system`` of a message to all systems."""

ItemT = TypeVar("ItemT", bound="Message | Event")

MessageT = TypeVar("MessageT", bound=Message)


@checks_arguments
class TalkActions(Part):
    """Commands, messages, subscriptions; what is known of the vehicle beside its cells."""

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

        Args:
            command: the number, or a member of ``enums.MavCmd``.
            params: param1 to param7; missing ones are 0, NaN where the command says so.
            component_id: to another component than the autopilot; 0: to all, and the autopilot's answer counts.
            retries: how often it is sent again while it is not answered, from 0; ``confirmation`` rises with each. An
                order is sent again only right after a HEARTBEAT that tells of no other mode, no failsafe, and no newer
                order (docs/reliability.md). None: 3 for a request that changes nothing but streams, 0 for all others,
                because what they do would be done twice if only the answer was lost.
            attempt_timeout: seconds to wait for an ack after each, above 0, and at least two measured round trips;
                None: 1, or 4 if it is sent once.
            progress_timeout: seconds to wait after each IN_PROGRESS for the next answer; calibrations can take long.
            on_progress: called with 0–100, or None, for each IN_PROGRESS.

        See https://mavlink.io/en/services/command.html.

        Raises:
            InvalidArgument: a parameter is no number or does not fit. Nothing was sent.
            CommandRejected: any other result; ``reasons`` has the status texts seen meanwhile.
            CommandTimeout: no ack; the text names attempts, seconds, the last heartbeat and the loss.
        """
        return await self._sender.answered(
            self._talk.commands.send_long,
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

        ``x`` and ``y`` are latitude and longitude in 1e-7 degrees, or 1e-4 m in local frames; ``z`` metres. With
        ``or_long``, firmware that does not know it so is sent a COMMAND_LONG with degrees, in frame 0 only. The
        rest is as for :meth:`command`.
        """
        if or_long and frame != MavFrame.GLOBAL:
            raise InvalidArgument(f"frame = {frame} is not allowed with or_long: MAV_FRAME_GLOBAL (0)")
        kind = {} if or_long else {"frame": frame}
        return await self._sender.answered(
            self._talk.commands.send_place if or_long else self._talk.commands.send_int,
            command,
            *params,
            **kind,
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
        """Send one message as it is, once; never blocks. Its ``target_system`` is yours to set.

        A command that steers (as by :meth:`command`) and SET_MODE are newer orders: those of the actions end. A
        set-point is newer than what was :meth:`posted` about motion. Neither is, to another system than this vehicle.

        Raises:
            InvalidArgument: a field is out of range; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended, or the block of this vehicle was left.
        """
        self._talk.send(message)
        self.note_sent(message)

    def note_sent(self, message: Message) -> None:
        """The program has sent this to the vehicle past it (``connection.send``): it counts as by :meth:`send`."""
        target = getattr(message, "target_system", self.system_id)
        subjects = subjects_of(message) if target in (EVERYBODY, self.system_id) else ()
        if subjects == ARM_ALONE and isinstance(message, (CommandInt, CommandLong)):
            self._arbiter.note_own_arming(message.param1 == 1)
        elif subjects and isinstance(message, (CommandInt, CommandLong, SetMode)):
            names = self.telemetry.mode_names
            modes: tuple[Mode, ...] = ()
            if not isinstance(message, SetMode):
                params = (message.param1, message.param2, message.param3, message.param4)
                modes = self.autopilot.modes_of_command(message.command, params, names)
            elif message.base_mode & CUSTOM_MODE_ENABLED:
                modes = (self.autopilot.mode(message.custom_mode, message.base_mode, names),)
            self._arbiter.order_of_the_programs_own(subjects, modes=modes)
        elif subjects:
            self._arbiter.overrule(subjects)

    @contextmanager
    def posted(
        self, *subjects: Subject, modes: tuple[Mode, ...] = (), armed: bool | None = None
    ) -> Iterator[PostedOrder]:
        """An order that the next one need not wait for: mode, arming and take-off go out one after another.

        Within the block, its commands are sent again right after a HEARTBEAT until they are answered, or their effect
        is told; not when an order about the same subject has followed, nor when HEARTBEAT tells a mode that neither
        this order nor one of the ten seconds before it brings about, or, if it is about motion first of all, that the
        vehicle has disarmed. Nothing is held when it is given up, and nobody watches for an order to arm that comes
        late: the actions do that.

        Args:
            subjects: what it is about, ``"mode"``, ``"motion"`` or ``"arm"``; orders about any more that are named are
                ended by it, too. One about mode or motion ends the action under way.
            modes: the modes that it brings about.
            armed: whether it arms or disarms; one about ``"arm"`` has to say.

        Raises:
            InvalidArgument: no subject, or one about ``"arm"`` without ``armed``. Nothing was sent.
        """
        if not subjects:
            raise InvalidArgument("posted: no subject is named: mode, motion or arm")
        if "arm" in subjects and armed is None:
            raise InvalidArgument("posted: an order about arm needs armed=True or armed=False")
        with (
            self._arbiter.post(subjects, modes=modes, armed=armed) as order,
            PostedOrder(self._talk, self._arbiter, self._sender, order) as posted,
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

        ``capacity=1`` gives the latest only, ``missed`` counts the others.

        Subscribing is the rate request: while the block lasts, the autopilot is asked to send these messages at
        ``rate_hz`` (above 0, at most 1000), or faster if others want it. None means the default rate of a message that
        comes in a stream; one that is sent when there is need (HEARTBEAT, STATUSTEXT, acks) is not asked for. What a
        camera or another component is to be asked for: ``vehicle.component(100).subscribe(...)``.

        Raises:
            InvalidArgument: no type, a rate out of range, or a message that the dialect does not hold.
        """
        return self._talk.hearing.subscribe(types, capacity, overflow, rate_hz, whole_system=True)

    @contextmanager
    def rate(self, message_type: type[Message], rate_hz: float) -> Iterator[None]:
        """Have the vehicle send ``message_type`` at ``rate_hz`` or faster for the time of the ``with`` block."""
        release = self._talk.rates.want(message_type, rate_hz)
        try:
            yield
        finally:
            release()

    @contextmanager
    def streams(self, rate_hz: float) -> Iterator[None]:
        """Have the vehicle send all that it streams at ``rate_hz`` for the time of the ``with`` block: for recordings,
        ground stations and firmware that knows no rates of single messages.

        ArduPilot is asked by REQUEST_DATA_STREAM (whole Hz, 1 at least), again after a reboot or a silence and while
        nothing comes; it goes on streaming afterwards. Others stream by themselves: of them, what is missing of the
        common states is asked for as by :meth:`rate`.

        Raises:
            InvalidArgument: the rate is not above 0 and at most 1000. Nothing was sent.
        """
        with every_stream(self._talk, rate_hz):
            yield

    # ------------------------------------------------------------------------------- state

    def message(self, message_type: type[MessageT], *, rate_hz: float | None = None) -> StateCell[MessageT]:
        """The latest message of a kind as it came, in a cell: ``vehicle.message(messages.RawImu).value.xacc``.

        The first call registers it, and has the vehicle send it at ``rate_hz`` (None: the default rate of a message
        that comes in a stream) for as long as the vehicle object lives; later calls give the same cell, and may change
        the rate. Only messages of the autopilot count; those of a camera or another component are in
        ``vehicle.component(100).message(...)``.

        Raises:
            InvalidArgument: the rate is out of range, or the dialect does not hold the message.
        """
        return self._talk.hearing.cell(message_type, rate_hz)

    @property
    def mode_name(self) -> str:
        """Name of the flight mode, ``"unknown"`` before the first heartbeat."""
        return self.telemetry.mode_name

    @property
    def is_armed(self) -> bool:
        """Whether the last heartbeat says armed; False before the first, and after a reboot until the next one."""
        return self.telemetry.is_armed

    @property
    def is_surely_disarmed(self) -> bool:
        """Whether the last heartbeat says disarmed; False while it is not known."""
        return self.telemetry.is_surely_disarmed

    @property
    def is_vtol(self) -> bool:
        """Whether it can hover and cruise on wings: EXTENDED_SYS_STATE tells a VTOL state."""
        return self.telemetry.is_vtol

    @property
    def heartbeat_age(self) -> float:
        """Seconds since the last heartbeat of the autopilot."""
        return self._talk.heartbeat_age

    @property
    def is_silent(self) -> bool:
        """Whether no heartbeat comes: none for more than 3.5 seconds, or the link has gone."""
        return self._talk.watch.is_silent

    @property
    def link_state(self) -> StateCell[LinkState]:
        """CONNECTED, SILENT (no heartbeat for more than 3.5 seconds) or LOST (the link has gone)."""
        return self._talk.watch.link_state

    def describe_link(self) -> str:
        """One line on how well the vehicle is heard, for error texts."""
        return self._talk.describe_link()

    def describe_now(self) -> str:
        """What it does, as far as it was heard: ``holding in BRAKE, still armed, 9 m above home, heard 0.3 s ago``."""
        return self._bridge.describe_now()

    def texts_since(self, at: float) -> tuple[str, ...]:
        """What the vehicle said (STATUSTEXT) since this time on the loop's clock, oldest first."""
        return self._talk.texts_since(at)
