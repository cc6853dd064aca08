"""Base of simulated devices that are separate components: heartbeat, commands, streams, settings, faults."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavAutopilot, MavState
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandInt, CommandLong, Heartbeat, Statustext
from aerokit.parameters import SettingValue
from aerokit.protocols.servers.files import FileTree
from aerokit.protocols.servers.ftp import SessionFtpServer
from aerokit.protocols.servers.intervals import Builder as Builder
from aerokit.protocols.servers.intervals import MessageStreams
from aerokit.protocols.servers.parameters import DefinedParameterServer
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, CommandServer, ReceivedCommand
from aerokit.sim.faults import Faults
from aerokit.sim.motion import GlobalPoint, true_place
from aerokit.sim.vehicle import SimulatedVehicle


class Pose(NamedTuple):
    """Position and attitude (radians) of a vehicle."""

    place: GlobalPoint
    height_m: float
    """Metres above home."""
    roll: float
    pitch: float
    yaw: float


def pose_of(vehicle: SimulatedVehicle) -> Pose | None:
    """Return the true pose of a vehicle, or None for a vehicle without a pose, such as a recording."""
    try:
        place = true_place(vehicle)
    except InvalidArgument:
        return None
    motion = vehicle.motion  # type: ignore[attr-defined]
    # Only simulated autopilots have `altitude_m`, the height above home. For other vehicles, the origin is the home.
    height_m = getattr(vehicle, "altitude_m", -motion.down)
    return Pose(place, height_m, *motion.angles)


def serve_files(component: SimulatedComponent, files: FileTree) -> SessionFtpServer[FileTree]:
    """Serve files of a component by MAVFTP, as PX4 does. Call this function in ``listen()``.

    The files may change at any time, see `FileTree.put`. A power cycle ends the sessions, but keeps the files. The
    component's ``faults.no_ftp`` turns the server off.
    """
    from aerokit.sim.px4.storage import Px4Ftp  # imported only when needed, because most components serve no files

    server = Px4Ftp(component, files)
    component.on_power_on(server.restart)
    return server


_HEARTBEAT_INTERVAL_S = 1.0
_MIN_STREAM_INTERVAL_S = 0.005  # as for the components of aerokit.onboard
_MAVLINK_VERSION = 3


class SimulatedComponent:
    """Base of a device on a vehicle's links. The device is switched on with the vehicle, but does not reboot with it.

    The component receives broadcasts, and messages that are addressed to it. An unknown command is UNSUPPORTED if it is
    addressed to the component, and ignored if it is a broadcast. The component's `faults` apply in addition to those of
    the vehicle.

    A component belongs to one vehicle. Adding it again raises InvalidArgument.
    """

    TYPE: ClassVar[int]
    """MAV_TYPE of its heartbeat."""

    def __init__(self, component_id: int, *, system_id: int | None = None) -> None:
        self.component_id = component_id
        self.faults: Faults = Faults()
        """Faults of the component: commands, ``silent``, ``heartbeats_stopped``, losses."""
        self._system_id = system_id
        self._vehicle: SimulatedVehicle | None = None
        self._booted_at = math.nan
        self._at_power_on: list[Callable[[], None]] = []
        self._commands: dict[int, CommandHandler] = {}
        self._streams: MessageStreams = MessageStreams(self, min_interval_s=_MIN_STREAM_INTERVAL_S)

    def commands(self) -> dict[int, CommandHandler]:
        """Return the handlers of the component's own commands by MAV_CMD."""
        return {}

    def builders(self) -> dict[int, Builder]:
        """Return the functions that build messages for REQUEST_MESSAGE and for streams, by message id."""
        return {}

    def listen(self) -> None:
        """Called when the component joins a vehicle: register handlers of messages other than commands with `on`."""

    def start(self) -> None:
        """Called at power-on and at each `reboot`: reset, and start the default streams."""

    @property
    def vehicle(self) -> SimulatedVehicle:
        """The vehicle that carries the component. Raises InvalidArgument if there is none yet."""
        if self._vehicle is None:
            raise InvalidArgument(
                "the component is not on a vehicle yet; pass the component in components= of a vehicle"
            )
        return self._vehicle

    @property
    def system_id(self) -> int:
        """The system id that was passed to the component or, if none was passed, that of the vehicle."""
        return self.vehicle.system_id if self._system_id is None else self._system_id

    @property
    def now(self) -> float:
        """Simulated seconds."""
        return self.vehicle.now

    @property
    def time_boot_ms(self) -> int:
        """Milliseconds since the component booted."""
        return int((self.now - self._booted_at) * 1000.0) & 0xFFFFFFFF

    def join(self, vehicle: SimulatedVehicle) -> None:
        """Add the component to a vehicle. The vehicle calls this method."""
        if self._vehicle is not None:
            raise InvalidArgument("the component already belongs to a vehicle; create a component for each vehicle")
        self._vehicle = vehicle
        self._streams.builders = self.builders()
        self._commands = {**self._streams.commands(), **self.commands()}
        CommandServer(self, self._commands)
        self.listen()
        vehicle.on_power_on(self._on_vehicle_power_on)

    def _on_vehicle_power_on(self) -> None:
        if math.isnan(self._booted_at):  # A reboot of the vehicle calls this method, too.
            self.reboot()

    def reboot(self) -> None:
        """Boot now. The first boot, when the vehicle is switched on, also calls this method."""
        self.vehicle.cancel_timers(self)
        self._booted_at = self.now
        self._streams.clear()
        self.vehicle.every(_HEARTBEAT_INTERVAL_S, self._send_heartbeat, owner=self)
        self.start()
        for action in self._at_power_on:
            action()

    def on_power_on(self, action: Callable[[], None]) -> None:
        """Call a function at each boot of the component."""
        self._at_power_on.append(action)

    def _send_heartbeat(self) -> None:
        self.send(
            Heartbeat(
                self.TYPE, MavAutopilot.INVALID, base_mode=0, custom_mode=0, system_status=MavState.ACTIVE,
                mavlink_version=_MAVLINK_VERSION,
            )
        )  # fmt: skip

    def on(self, message_class: type[Message], handler: Callable[[Any, Channel], None]) -> None:
        """Handle messages of a class that are addressed to this component."""

        def on_message(message: Message, channel: Channel) -> None:
            faults = self.faults
            if not self._is_addressed(message) or faults.silent or faults.frozen:
                return
            if not faults.drops_incoming(self.vehicle.rng):
                handler(message, channel)

        self.vehicle.observe(message_class, on_message)

    def send(self, message: Message, channel: Channel | None = None) -> None:
        """Send a message on one channel, or on all channels if ``channel`` is None."""
        is_forwarded = self.vehicle.is_on and not self.faults.frozen
        if is_forwarded and not self.faults.drops_outgoing(message, self.vehicle.rng):
            self.vehicle.send(message, channel, (self.system_id, self.component_id))

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT with the first 50 characters of the text."""
        self.send(Statustext(severity, text[:50], id=0, chunk_seq=0))

    def call_later(self, delay: float, action: Callable[[], None]) -> None:
        """Call a function after ``delay`` simulated seconds. A reboot of the component cancels the call."""
        self.call_at(self.now + delay, action)

    def call_at(self, when: float, action: Callable[[], None]) -> None:
        """Call a function at a simulated time. A reboot of the component cancels the call."""
        self.vehicle.call_at(when, action, owner=self)

    def stream(self, message_id: int, interval_s: float, channel: Channel | None = None) -> None:
        """Stream messages on one channel, or on all channels if ``channel`` is None. The interval 0 stops them."""
        self._streams.stream(message_id, interval_s, channel)

    def _is_addressed(self, message: Message) -> bool:
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if system not in (0, self.system_id) or component not in (0, self.component_id):
            return False
        if component == 0 and isinstance(message, CommandLong | CommandInt):
            return message.command in self._commands  # Leave an unknown broadcast command to other components.
        return True

    def answer_with(self, message_id: int, command: ReceivedCommand) -> int:
        """Send the requested messages. Return DENIED for an unknown id, FAILED if there is no message at present."""
        return self._streams.answer_with(message_id, command)


class ExtendedParameters(DefinedParameterServer):
    """Serves the settings of a camera definition by PARAM_EXT. Create the server in ``listen()``.

    Values survive a reboot. ``mute_parameters`` and ``parameter_limits`` of the component's faults apply.
    """

    _host: SimulatedComponent  # pyright: ignore[reportIncompatibleVariableOverride]

    def send(self, name: str, index: int, channel: Channel | None) -> None:
        if name not in self._host.faults.mute_parameters:
            super().send(name, index, channel)

    def limited(self, name: str, value: SettingValue) -> SettingValue:
        low, high = self._host.faults.parameter_limits.get(name, (None, None))
        if low is not None and high is not None and isinstance(value, (int, float)):
            return type(value)(max(low, min(high, value)))
        return value
