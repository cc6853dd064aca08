"""Base of simulated devices that are separate components: heartbeat, commands, streams, settings, faults."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, ClassVar, NamedTuple

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavParamExtType, MavResult, MavState, ParamAck
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandInt, CommandLong, Heartbeat, MessageInterval, Statustext
from aerokit.parameters import CameraDefinition, SettingValue
from aerokit.parameters.parameter import setting_bytes, setting_value, settings_equal
from aerokit.protocols.servers.files import FileTree
from aerokit.protocols.servers.ftp import SessionFtpServer
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, CommandServer, ReceivedCommand, whole
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
    """Return the true pose of a vehicle; None for a vehicle without one, such as a recording."""
    try:
        place = true_place(vehicle)
    except InvalidArgument:
        return None
    motion = vehicle.motion  # type: ignore[attr-defined]
    height = getattr(vehicle, "altitude_m", -motion.down)
    return Pose(place, height, motion.roll, motion.pitch, motion.yaw)


def serve_files(component: SimulatedComponent, files: FileTree) -> SessionFtpServer[FileTree]:
    """Serve files by MAVFTP under the component's address, as PX4 does; call it in ``listen()``.

    The files may change at any time, see `FileTree.put`. Power-off ends sessions and keeps files. The component's
    ``faults.no_ftp`` turns the server off.
    """
    from aerokit.sim.px4.ftp import Px4Ftp  # Imported here because most components serve no files.

    server = Px4Ftp(component, files)
    component.vehicle.on_power_on(server.restart)
    return server


_HEARTBEAT_INTERVAL_S = 1.0
_MAVLINK_VERSION = 3

# Returns the current messages of one id; the argument is the REQUEST_MESSAGE command, None for a stream.
Builder = Callable[["ReceivedCommand | None"], "Iterable[Message]"]


class SimulatedComponent:
    """A device on a vehicle's links that is switched on and rebooted with the vehicle.

    The component receives broadcasts and messages addressed to it. It ignores an unknown broadcast command and answers
    UNSUPPORTED to an unknown command with its address. Its `faults` apply in addition to those of the vehicle.

    A component belongs to one vehicle; adding it to a second vehicle raises InvalidArgument.
    """

    TYPE: ClassVar[int]
    """MAV_TYPE of its heartbeat."""

    def __init__(self, component_id: int, *, system_id: int | None = None) -> None:
        self.component_id = component_id
        self.faults: Faults = Faults()
        """Faults of the component: commands, ``silent``, ``heartbeats_stopped``, losses."""
        self._system_id = system_id
        self._vehicle: SimulatedVehicle | None = None
        self._commands: dict[int, CommandHandler] = {}
        self._builders: dict[int, Builder] = {}
        self._streams: dict[tuple[Channel | None, int], _Stream] = {}

    def commands(self) -> dict[int, CommandHandler]:
        """Return handlers by MAV_CMD, in addition to the message requests."""
        return {}

    def builders(self) -> dict[int, Builder]:
        """Return builders by message id, for REQUEST_MESSAGE and streams."""
        return {}

    def listen(self) -> None:
        """Register handlers of other messages with `on`."""

    def start(self) -> None:
        """Called at power-on: reset, and start the default streams."""

    @property
    def vehicle(self) -> SimulatedVehicle:
        """The vehicle that carries the component; raises InvalidArgument before it is added to a vehicle."""
        if self._vehicle is None:
            raise InvalidArgument("the component is not on a vehicle yet; pass it in components= of a vehicle")
        return self._vehicle

    @property
    def system_id(self) -> int:
        """The system id passed to the component, or else the vehicle's."""
        return self.vehicle.system_id if self._system_id is None else self._system_id

    @property
    def now(self) -> float:
        """Simulated seconds."""
        return self.vehicle.now

    @property
    def time_boot_ms(self) -> int:
        """Milliseconds since the vehicle booted."""
        return self.vehicle.time_boot_ms

    def join(self, vehicle: SimulatedVehicle) -> None:
        """Join a vehicle; the vehicle calls this."""
        if self._vehicle is not None:
            raise InvalidArgument("the component is on another vehicle already; create one for each vehicle")
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
        vehicle.on_power_on(self._power_on)

    def _power_on(self) -> None:
        self._streams.clear()
        self.vehicle.every(_HEARTBEAT_INTERVAL_S, self._send_heartbeat)
        self.start()

    def _send_heartbeat(self) -> None:
        self.send(Heartbeat(self.TYPE, MavAutopilot.INVALID, 0, 0, MavState.ACTIVE, _MAVLINK_VERSION))

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
        """Send on one channel, or on all if ``channel`` is None."""
        if not (self.faults.frozen or self.faults.drops_outgoing(message, self.vehicle.rng)):
            self.vehicle.send(message, channel, (self.system_id, self.component_id))

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT of at most 50 characters."""
        self.send(Statustext(severity, text[:50], 0, 0))

    def call_later(self, delay: float, action: Callable[[], None]) -> None:
        """Call a function after ``delay`` simulated seconds; a reboot cancels it."""
        self.vehicle.call_later(delay, action)

    def call_at(self, when: float, action: Callable[[], None]) -> None:
        """Call a function at a simulated time; a reboot cancels it."""
        self.vehicle.call_at(when, action)

    def stream(self, message_id: int, interval_s: float, channel: Channel | None = None) -> None:
        """Stream messages of this id on one channel, or on all if None; an interval of 0 stops the stream."""
        key = (channel, message_id)
        if interval_s <= 0.0:
            self._streams.pop(key, None)
            return
        before = self._streams.get(key)
        if before is None or before.interval_s != interval_s:
            self._streams[key] = _Stream(interval_s)
            self._send_stream(key, self._streams[key])

    def _send_stream(self, key: tuple[Channel | None, int], stream: _Stream) -> None:
        if self._streams.get(key) is not stream:  # Replaced by another stream, perhaps with the same interval.
            return
        channel, message_id = key
        for message in self._builders[message_id](None):
            self.send(message, channel)
        self.call_later(stream.interval_s, lambda: self._send_stream(key, stream))

    def _is_addressed(self, message: Message) -> bool:
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if system not in (0, self.system_id) or component not in (0, self.component_id):
            return False
        if component == 0 and isinstance(message, CommandLong | CommandInt):
            return message.command in self._commands
        return True

    def answer_with(self, message_id: int, command: ReceivedCommand) -> int:
        """Send the requested messages; return DENIED for an unknown id, FAILED if there is no message."""
        builder = self._builders.get(message_id)
        if builder is None:
            return MavResult.DENIED
        messages = list(builder(command))
        for message in messages:
            self.send(message, command.channel)
        return MavResult.ACCEPTED if messages else MavResult.FAILED

    def _request_message(self, command: ReceivedCommand) -> int:
        return self.answer_with(whole(command.param1), command)

    def _set_interval(self, command: ReceivedCommand) -> int:
        """Set or stop a stream. 0 (default rate) stops it as -1 does, because streams have no default rate."""
        message_id = whole(command.param1)
        if message_id not in self._builders:
            return MavResult.DENIED
        self._streams.pop((None, message_id), None)
        self.stream(message_id, whole(command.param2) / 1e6, command.channel)
        return MavResult.ACCEPTED

    def _get_interval(self, command: ReceivedCommand) -> int:
        message_id = whole(command.param1)
        if message_id not in self._builders:
            return MavResult.DENIED
        of_all = self._streams.get((None, message_id), _Stream(0.0))
        interval = self._streams.get((command.channel, message_id), of_all).interval_s
        self.send(MessageInterval(message_id, round(interval * 1e6) or -1), command.channel)
        return MavResult.ACCEPTED


class _Stream:
    def __init__(self, interval_s: float) -> None:
        self.interval_s = interval_s


_LIST_INTERVAL_S = 0.01
_ZEROS: dict[str, SettingValue] = {"bool": False, "float": 0.0, "double": 0.0, "string": "", "custom": ""}


class ExtendedParameters:
    """Settings that a camera definition defines and PARAM_EXT serves; create it in ``listen()``.

    A list is sent at a hundred parameters a second, without write-only parameters. The answer to a value that the
    definition does not allow is VALUE_UNSUPPORTED, to setting a read-only or excluded parameter FAILED. Values survive
    a reboot. ``mute_parameters`` and ``parameter_limits`` of the component's faults apply.

    https://mavlink.io/en/services/parameter_ext.html
    """

    def __init__(self, component: SimulatedComponent, definition: CameraDefinition) -> None:
        self.definition = definition
        self.values: dict[str, SettingValue] = {}
        """Current values; assign them at any time."""
        self.slow: dict[str, float] = {}
        """Name → seconds that setting the parameter takes; the answer is IN_PROGRESS until then."""
        self._component = component
        self._pending: set[str] = set()
        self._list_number = 0
        self.reset()
        component.on(m.ParamExtRequestList, self._on_list)
        component.on(m.ParamExtRequestRead, self._on_read)
        component.on(m.ParamExtSet, self._on_set)

    def reset(self) -> None:
        """Restore all defaults."""
        for name, setting in self.definition.settings.items():
            self.values[name] = _ZEROS.get(setting.type, 0) if setting.default is None else setting.default

    def refresh(self) -> None:
        """Called before a value is sent or set; overridden to update values that the device changes."""

    def can_set(self, name: str) -> bool:
        """Return True if a setting can be changed now; otherwise the answer is FAILED."""
        return True

    def on_set(self, name: str, value: SettingValue) -> None:
        """Called when the value of a setting has changed."""

    def restart(self) -> None:
        """Drop pending changes, as a reboot does."""
        self._pending.clear()
        self._list_number += 1

    @property
    def _names(self) -> list[str]:
        return [name for name, setting in self.definition.settings.items() if not setting.write_only]

    def _on_list(self, _: m.ParamExtRequestList, channel: Channel) -> None:
        self._list_number += 1
        self._send_from(0, self._list_number, channel)

    def _send_from(self, index: int, number: int, channel: Channel) -> None:
        if number == self._list_number and index < len(self._names):
            self._send_value(self._names[index], channel)
            self._component.call_later(_LIST_INTERVAL_S, lambda: self._send_from(index + 1, number, channel))

    def _on_read(self, request: m.ParamExtRequestRead, channel: Channel) -> None:
        names = self._names
        if 0 <= request.param_index < len(names):
            self._send_value(names[request.param_index], channel)
        elif request.param_index < 0 and request.param_id in names:
            self._send_value(request.param_id, channel)

    def _send_value(self, name: str, channel: Channel | None) -> None:
        if name in self._component.faults.mute_parameters:
            return
        self.refresh()
        kind, names = self.definition.settings[name].wire_type, self._names
        data = setting_bytes(self.values[name], kind)
        self._component.send(m.ParamExtValue(name, data, kind, len(names), names.index(name)), channel)

    def _on_set(self, request: m.ParamExtSet, _: Channel) -> None:
        name, kind = request.param_id, request.param_type
        own = self.definition.settings.get(name)
        if own is None:
            self._acknowledge(name, request.param_value, kind, ParamAck.VALUE_UNSUPPORTED)
            return
        result, value = self._verdict(name, setting_value(request.param_value, kind), kind)
        if result == ParamAck.ACCEPTED and name in self.slow and name not in self._pending:
            self._pending.add(name)
            self._component.call_later(self.slow[name], lambda: self._finish(name, value))
        if name in self._pending:
            self._acknowledge_setting(name, ParamAck.IN_PROGRESS)
        elif result == ParamAck.ACCEPTED:
            self._finish(name, value)
        else:
            self._acknowledge_setting(name, result)

    def _verdict(self, name: str, value: SettingValue, kind: int) -> tuple[ParamAck, SettingValue]:
        self.refresh()
        own, definition = self.definition.settings[name], self.definition
        if own.read_only or not self.can_set(name) or definition.excluded_by(name, self.values):
            return ParamAck.FAILED, value
        if kind != own.wire_type:
            return ParamAck.VALUE_UNSUPPORTED, value
        low, high = self._component.faults.parameter_limits.get(name, (None, None))
        if low is not None and high is not None and isinstance(value, (int, float)):
            value = type(value)(max(low, min(high, value)))
        try:
            return ParamAck.ACCEPTED, definition.checked(name, value, self.values)
        except InvalidArgument:
            return ParamAck.VALUE_UNSUPPORTED, value

    def _finish(self, name: str, value: SettingValue) -> None:
        self._pending.discard(name)
        is_new = not settings_equal(self.values[name], value)
        self.values[name] = value
        if is_new:
            self.on_set(name, value)
        self._acknowledge_setting(name, ParamAck.ACCEPTED)

    def _acknowledge_setting(self, name: str, result: int) -> None:
        kind = self.definition.settings[name].wire_type
        self._acknowledge(name, setting_bytes(self.values[name], kind), kind, result)

    def _acknowledge(self, name: str, data: bytes, kind: int, result: int) -> None:
        known = kind if kind in MavParamExtType.__members__.values() else int(MavParamExtType.CUSTOM)
        self._component.send(m.ParamExtAck(name, data, known, result))
