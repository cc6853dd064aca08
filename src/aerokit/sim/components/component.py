"""What each device beside an autopilot is made of: an address, a heartbeat, handlers, streams, faults."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, ClassVar, NamedTuple

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavResult, MavState
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandInt, CommandLong, Heartbeat, MessageInterval, Statustext
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler, CommandServer, whole
from aerokit.sim.faults import Faults
from aerokit.sim.file_tree import FileTree
from aerokit.sim.ftp import FtpServer
from aerokit.sim.local_frame import GlobalPoint, true_place
from aerokit.sim.vehicle import SimulatedVehicle


class Pose(NamedTuple):
    """Angles in radians."""

    place: GlobalPoint
    height_m: float
    """Above home."""
    roll: float
    pitch: float
    yaw: float


def pose_of(vehicle: SimulatedVehicle) -> Pose | None:
    """None of a vehicle that is nowhere, such as a recording."""
    try:
        place = true_place(vehicle)
    except InvalidArgument:
        return None
    motion = vehicle.motion  # type: ignore[attr-defined]
    height = getattr(vehicle, "altitude_m", -motion.down)
    return Pose(place, height, motion.roll, motion.pitch, motion.yaw)


def serve_files(component: SimulatedComponent, files: FileTree) -> FtpServer:
    """Have a component serve these files by MAVFTP under its own address, as PX4 does; call it in ``listen()``.

    The tree may change at any time: `FileTree.put` makes a file and its folders. Sessions end when the power goes,
    files stay. ``faults.no_ftp`` of the component makes it deaf.
    """
    from aerokit.sim.px4.ftp import Px4Ftp  # what it takes to import is for those who serve files

    server = Px4Ftp(component, files)
    component.vehicle.when_powered_on(server.restart)
    return server


_HEARTBEAT_S = 1.0
_MAVLINK_VERSION = 3

Builder = Callable[["Command | None"], "Iterable[Message]"]
"""Makes the messages of one id that are due now; of a REQUEST_MESSAGE when that command is given."""


class SimulatedComponent:
    """A device of its own on a vehicle's links; it is switched on, and reboots, with the vehicle.

    Messages reach it by its own address or as broadcasts; those of other components it does not see. A broadcast
    command that it does not know is left to the others; one that is for it alone is UNSUPPORTED. `faults` mistreats
    what it alone hears and says: what happens to the vehicle's link happens to it besides.

    A component belongs to one vehicle: InvalidArgument when it is given to a second one.
    """

    TYPE: ClassVar[int]
    """MAV_TYPE of its heartbeat."""

    def __init__(self, component_id: int, *, system_id: int | None = None) -> None:
        self.component_id = component_id
        self.faults: Faults = Faults()
        """What goes wrong with it: commands, ``silent``, ``heartbeats_stopped``, losses."""
        self._system_id = system_id
        self._vehicle: SimulatedVehicle | None = None
        self._commands: dict[int, CommandHandler] = {}
        self._builders: dict[int, Builder] = {}
        self._streams: dict[tuple[Channel | None, int], _Stream] = {}

    def commands(self) -> dict[int, CommandHandler]:
        """MAV_CMD → handler, besides those for messages."""
        return {}

    def builders(self) -> dict[int, Builder]:
        """Message id → what REQUEST_MESSAGE and streams send."""
        return {}

    def listen(self) -> None:
        """Hear messages other than commands, with `on`."""

    def start(self) -> None:
        """The power comes on: begin anew, and say what is said without being asked."""

    @property
    def vehicle(self) -> SimulatedVehicle:
        """Whose links it is on; InvalidArgument before there is one."""
        if self._vehicle is None:
            raise InvalidArgument("the component is not on a vehicle yet: pass it as one of components=")
        return self._vehicle

    @property
    def system_id(self) -> int:
        """That of the vehicle unless it was given one of its own."""
        return self.vehicle.system_id if self._system_id is None else self._system_id

    @property
    def now(self) -> float:
        """Simulated seconds."""
        return self.vehicle.now

    @property
    def time_boot_ms(self) -> int:
        """For the messages."""
        return self.vehicle.time_boot_ms

    def join(self, vehicle: SimulatedVehicle) -> None:
        """Called by the vehicle that it is given to."""
        if self._vehicle is not None:
            raise InvalidArgument("the component is on another vehicle already")
        self._vehicle = vehicle
        self._builders = self.builders()
        self._commands = {
            MavCmd.REQUEST_MESSAGE: self._request_message,
            MavCmd.SET_MESSAGE_INTERVAL: self._set_interval,
            MavCmd.GET_MESSAGE_INTERVAL: self._get_interval,
            **self.commands(),
        }
        CommandServer(self, self._commands)
        self.listen()
        vehicle.when_powered_on(self._power_on)

    def _power_on(self) -> None:
        self._streams.clear()
        self.vehicle.every(_HEARTBEAT_S, self._beat)
        self.start()

    def _beat(self) -> None:
        self.send(Heartbeat(self.TYPE, MavAutopilot.INVALID, 0, 0, MavState.ACTIVE, _MAVLINK_VERSION))

    def on(self, message_class: type[Message], handler: Callable[[Any, Channel], None]) -> None:
        """Hear such messages from now on, when they are for this component."""

        def hear(message: Message, channel: Channel) -> None:
            if self._is_for_me(message) and not self._is_unheard():
                handler(message, channel)

        self.vehicle.overhear(message_class, hear)

    def send(self, message: Message, channel: Channel | None = None) -> None:
        """Send on one channel, or on all."""
        if not self._is_unsaid(message):
            self.vehicle.send(message, channel, (self.system_id, self.component_id))

    def send_text(self, severity: int, text: str) -> None:
        """A STATUSTEXT of at most 50 characters."""
        self.send(Statustext(severity, text[:50], 0, 0))

    def call_later(self, delay: float, action: Callable[[], None]) -> None:
        """Do something after ``delay`` seconds; a reboot forgets it."""
        self.vehicle.call_later(delay, action)

    def call_at(self, when: float, action: Callable[[], None]) -> None:
        """Do something at this time; a reboot forgets it."""
        self.vehicle.call_at(when, action)

    def stream(self, message_id: int, interval_s: float, channel: Channel | None = None) -> None:
        """Send messages of an id again and again from now on, on one channel or on all; 0 ends it."""
        key = (channel, message_id)
        if interval_s <= 0.0:
            self._streams.pop(key, None)
            return
        before = self._streams.get(key)
        if before is None or before.interval_s != interval_s:
            self._streams[key] = _Stream(interval_s)
            self._send_stream(key, self._streams[key])

    def _send_stream(self, key: tuple[Channel | None, int], stream: _Stream) -> None:
        if self._streams.get(key) is not stream:  # another one has taken its place, perhaps just as fast
            return
        channel, message_id = key
        for message in self._builders[message_id](None):
            self.send(message, channel)
        self.call_later(stream.interval_s, lambda: self._send_stream(key, stream))

    def _is_for_me(self, message: Message) -> bool:
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if system not in (0, self.system_id) or component not in (0, self.component_id):
            return False
        if component == 0 and isinstance(message, CommandLong | CommandInt):
            return message.command in self._commands
        return True

    def _is_unheard(self) -> bool:
        faults = self.faults
        if faults.silent or faults.frozen:
            return True
        if faults.drop_incoming > 0:
            faults.drop_incoming -= 1
            return True
        return faults.loss_incoming > 0.0 and self.vehicle.rng.random() < faults.loss_incoming

    def _is_unsaid(self, message: Message) -> bool:
        faults = self.faults
        stopped = faults.heartbeats_stopped and message.ID == Heartbeat.ID
        if faults.silent or faults.frozen or stopped:
            return True
        if faults.lost_messages and faults.loses(message):
            return True
        if faults.drop_outgoing > 0:
            faults.drop_outgoing -= 1
            return True
        return faults.loss > 0.0 and self.vehicle.rng.random() < faults.loss

    def answer_with(self, message_id: int, command: Command) -> int:
        """Send what is asked for; a MAV_RESULT: DENIED of an unknown message, FAILED when there is nothing."""
        builder = self._builders.get(message_id)
        if builder is None:
            return MavResult.DENIED
        messages = list(builder(command))
        for message in messages:
            self.send(message, command.channel)
        return MavResult.ACCEPTED if messages else MavResult.FAILED

    def _request_message(self, command: Command) -> int:
        return self.answer_with(whole(command.param1), command)

    def _set_interval(self, command: Command) -> int:
        """0 and -1 stop it: nothing but what `start` began has a default rate."""
        message_id = whole(command.param1)
        if message_id not in self._builders:
            return MavResult.DENIED
        self._streams.pop((None, message_id), None)
        self.stream(message_id, whole(command.param2) / 1e6, command.channel)
        return MavResult.ACCEPTED

    def _get_interval(self, command: Command) -> int:
        message_id = whole(command.param1)
        if message_id not in self._builders:
            return MavResult.DENIED
        of_all = self._streams.get((None, message_id), _Stream(0.0))
        interval = self._streams.get((command.channel, message_id), of_all).interval_s
        self.send(MessageInterval(message_id, round(interval * 1e6) or -1), command.channel)
        return MavResult.ACCEPTED


class _Stream:
    """One order to send messages again and again."""

    def __init__(self, interval_s: float) -> None:
        self.interval_s = interval_s
