"""Base of the simulated autopilots: version, files, clock, commands, message signing, battery."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from itertools import pairwise
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavProtocolCapability
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.messages import GpsRtcmData, SetupSigning
from aerokit.mavlink.signing import LAST_TIMESTAMP, Signing, SigningKey, timestamp_at
from aerokit.protocols.rtcm import FRAGMENT_SIZE, MAX_FRAGMENTS
from aerokit.protocols.servers.files import FileTree
from aerokit.protocols.servers.ftp import SessionFtpServer
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, CommandServer, ReceivedCommand
from aerokit.sim.logs import LogServer
from aerokit.sim.motion import LocalFrame, Motion
from aerokit.sim.parameter_server import ParameterServer
from aerokit.sim.parameters import SimParameters
from aerokit.sim.vehicle import AttachableComponent, SimulatedVehicle

_REBOOT_SILENCE_S = 1.5
_CORRECTIONS_MAX_AGE_S = 5.0
_MAX_CORRECTIONS = 1000


class VehicleSigning:
    """Message signing of ArduPilot and PX4. After SETUP_SIGNING has set the key, the ports sign and check frames.

    ``key`` and ``timestamp`` (units of 10 µs since 2015) are the stored values. All ports share one record of the time
    stamps of accepted frames. A power-on clears this record.
    """

    AHEAD: ClassVar[int] = 0
    """Number that is added to the stored time stamp when a port starts to sign."""

    def __init__(self, vehicle: SimulatedVehicle, key: SigningKey | None, timestamp: int) -> None:
        self.key = key
        """The stored key; None turns signing off. Call `load` after an assignment."""
        self.timestamp: int = timestamp if key is not None else 0
        self.trusts_first_port = False
        """True if the first port accepts unsigned frames, as ArduPilot does. Call `load` after an assignment."""
        self._vehicle = vehicle
        self._streams: dict[tuple[int, int, int], int] = {}
        vehicle.on(SetupSigning, self._on_setup)
        vehicle.on_power_on(self._power_on)

    def load(self) -> None:
        for channel in self._vehicle.channels:
            self.start(channel)

    def start(self, channel: Channel) -> None:
        """Apply the stored key to one port."""
        link_id = self._vehicle.channels.index(channel)
        if self.key is None or channel.version == 1 or not self.is_for(link_id):
            channel.sign_with(None)
            return
        first_timestamp = (self.timestamp + self.AHEAD) & LAST_TIMESTAMP
        signing = _Signing(
            self.key, link_id=link_id, timestamp=first_timestamp, allow_unsigned=self.unsigned_on(link_id)
        )
        signing.streams = self._streams  # All ports share the table of the senders' last time stamps.
        channel.sign_with(signing)

    def is_for(self, link_id: int) -> bool:
        """Return True if the port with this link id signs and checks frames."""
        return True

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        """Return the function that decides which unsigned frames a port accepts; None if the port accepts none."""
        raise NotImplementedError

    def may_change(self) -> bool:
        """Return True if the key can be changed now. If not, send a text with the reason."""
        raise NotImplementedError

    def on_key_changed(self) -> None: ...

    def _power_on(self) -> None:
        self._streams = {}
        self.load()

    def _on_setup(self, message: SetupSigning, _channel: Channel) -> None:
        if not self.may_change():
            return
        has_key = any(message.secret_key)  # A key whose bytes are all 0 turns signing off.
        self.key = SigningKey(message.secret_key) if has_key else None
        # The field has 64 bits, but the time stamp of a frame has only 48 bits.
        self.timestamp = message.initial_timestamp & LAST_TIMESTAMP
        self.load()
        self.on_key_changed()


class _Signing(Signing):
    """Message signing in which the 48-bit time stamp overflows to 0, as in the firmwares."""

    def sign(self, frame: bytes, now: float = 0.0) -> bytes:
        if self.timestamp > LAST_TIMESTAMP:
            self.timestamp = 0
        return super().sign(frame, now)


class ReceivedCorrections:
    """Assembles the fragments of RTCM messages as ArduPilot does (AP_GPS.cpp, handle_gps_rtcm_fragment).

    ``messages`` contains the last 1000 assembled messages. ``is_recent`` is True if the latest is less than 5 s old.
    """

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        self._vehicle = vehicle
        self.messages: list[bytes] = []
        self._received_at = -math.inf  # time of the last assembled message
        self._sequence = -1  # sequence id of the message that is being assembled; -1 before the first message
        self._fragments: dict[int, bytes] = {}  # by fragment id
        vehicle.on(GpsRtcmData, lambda message, _: self._on_fragment(message))

    @property
    def is_recent(self) -> bool:
        return self._vehicle.now - self._received_at < _CORRECTIONS_MAX_AGE_S

    def _on_fragment(self, message: GpsRtcmData) -> None:
        data = bytes(message.data[: message.len])
        # Bit 0 of the flags marks a fragment, bits 1 and 2 are the fragment's id, and bits 3 to 7 the sequence number.
        is_fragmented = message.flags & 1
        fragment_id = message.flags >> 1 & 3
        sequence = message.flags >> 3
        if not is_fragmented:
            self._add(data)
            return
        if sequence != self._sequence or fragment_id in self._fragments:  # A new message begins.
            self._fragments.clear()
        self._sequence = sequence
        self._fragments[fragment_id] = data
        # A fragment that is shorter than FRAGMENT_SIZE is the last one. If the message fills all MAX_FRAGMENTS
        # fragments, no fragment is short.
        has_short = any(len(fragment) < FRAGMENT_SIZE for fragment in self._fragments.values())
        has_last = has_short or len(self._fragments) == MAX_FRAGMENTS
        has_all = len(self._fragments) == max(self._fragments) + 1  # The ids of the fragments count from 0.
        if has_last and has_all:
            self._add(b"".join(self._fragments[index] for index in range(len(self._fragments))))
            self._fragments.clear()

    def _add(self, message: bytes) -> None:
        self.messages.append(message)
        del self.messages[:-_MAX_CORRECTIONS]
        self._received_at = self._vehicle.now


# Sizes of three kinds of MAVLink 2 frames in bytes, without a signature.
_PARAM_VALUE_FRAME, _FTP_FRAME, _LOG_DATA_FRAME = 37, 266, 109


class VehicleStorage:
    """Files, and the protocol servers of parameters, files and logs. A subclass creates the servers of its firmware."""

    parameters: ParameterServer
    ftp: SessionFtpServer[FileTree]
    logs: LogServer

    def __init__(self) -> None:
        self.files: FileTree = FileTree()

    def limit_rates(self, link_bytes_per_s: float | None, *, parameters: float, files: float, logs: float) -> None:
        """Limit the data rates of parameter lists, files and logs to these shares of ``link_bytes_per_s``.

        If ``link_bytes_per_s`` is None, nothing is limited.
        """
        if link_bytes_per_s is not None:
            self.parameters.list_rate_hz = parameters * link_bytes_per_s / _PARAM_VALUE_FRAME
            self.ftp.burst_interval_s = _FTP_FRAME / (files * link_bytes_per_s)
            self.logs.rate_hz = logs * link_bytes_per_s / _LOG_DATA_FRAME
            self.parameters.burst = self.ftp.burst = self.logs.burst = 1

    def restart(self) -> None:
        self.parameters.restart()
        self.ftp.restart()
        self.logs.restart()


# The FIRMWARE_VERSION_TYPE for each suffix of a version text.
_RELEASE_TYPES = {"dev": 0, "alpha": 64, "beta": 128, "rc": 192, "": 255, "official": 255}


class SimulatedAutopilot(SimulatedVehicle):
    """A vehicle with a firmware version, files, a clock and commands.

    - ``version``: such as "4.7.0-dev" or "1.16.0"
    - ``unix_time_at_boot``: GPS time at simulated second 0, in seconds since 1970; continues through a reboot
    - ``unsupported_commands``: MAV_CMDs that this firmware does not support
    - ``signing_key``: key that was set up earlier; None sends unsigned frames until SETUP_SIGNING
    """

    CAPABILITIES: ClassVar[int]
    """MAV_PROTOCOL_CAPABILITY flags."""

    storage: VehicleStorage
    """Protocol servers of files, logs and parameters."""
    signing: VehicleSigning
    """Message signing, whose key survives a reboot."""
    frame: LocalFrame
    """The world frame, which counts metres north and east of the power-on location."""
    motion: Motion
    battery: SimulatedBattery
    parameters: SimParameters
    """Parameters by name. A test may change them, and they survive a reboot."""

    def __init__(
        self,
        *,
        system_id: int,
        seed: int,
        components: Iterable[AttachableComponent],
        version: str,
        unsupported_commands: Collection[int],
        unix_time_at_boot: float,
        signing_key: SigningKey | None,
    ) -> None:
        super().__init__(system_id=system_id, component_id=1, seed=seed, components=components)
        self.version = version
        self.unsupported_commands: frozenset[int] = frozenset(unsupported_commands)
        self._unix_time_at_start = unix_time_at_boot
        self.signing = self.make_signing(signing_key, timestamp_at(unix_time_at_boot))
        self.corrections: ReceivedCorrections = ReceivedCorrections(self)
        self.on(m.Timesync, self._on_timesync)

    @property
    def files(self) -> FileTree:
        """Files on the memory card and generated files, which survive a reboot."""
        return self.storage.files

    @property
    def ftp(self) -> SessionFtpServer[FileTree]:
        """The file server."""
        return self.storage.ftp

    def make_signing(self, key: SigningKey | None, timestamp: int) -> VehicleSigning:
        """Create the signing of this firmware, with a stored key and time stamp."""
        raise NotImplementedError

    def restart(self) -> None:
        """Reboot, with the silence of the real firmware."""
        self.reboot(_REBOOT_SILENCE_S)

    def on_speedup(self, speedup: float) -> None:
        """Multiply the timeouts that are not parameters by ``speedup``. `aerokit.sim.kinds.scale_timeouts` calls it."""

    def open_channel(self, *, version: int = 2) -> Channel:
        """Open another port, which has its own stream rates. ``version`` is the MAVLink version of the port."""
        channel = super().open_channel(version=version)
        if len(self.channels) > 1:  # The base class opens the first channel, when `signing` does not exist yet.
            self.signing.start(channel)
        return channel

    @property
    def capabilities(self) -> int:
        """MAV_PROTOCOL_CAPABILITY flags of AUTOPILOT_VERSION."""
        return self.CAPABILITIES & ~MavProtocolCapability.FTP if self.faults.no_ftp else self.CAPABILITIES

    @property
    def is_steady(self) -> bool:
        return self.motion.is_steady

    @property
    def unix_time(self) -> float:
        """GPS time in seconds since 1970."""
        return self._unix_time_at_start + self.now

    @property
    def version_number(self) -> int:
        """Firmware version as AUTOPILOT_VERSION packs it."""
        numbers, _, release = self.version.partition("-")
        padded = (*numbers.split("."), "0", "0")  # The version "4.7" means 4.7.0.
        major, minor, patch = (int(number) for number in padded[:3])
        return major << 24 | minor << 16 | patch << 8 | _RELEASE_TYPES.get(release, 0)

    def serve_commands(self, handlers: Mapping[int, CommandHandler]) -> CommandServer:
        """Answer the MAV_CMDs with these handlers, except those in ``unsupported_commands``."""
        supported = {number: handler for number, handler in handlers.items() if number not in self.unsupported_commands}
        return CommandServer(self, supported, self.refusal_of_command)

    def refusal_of_command(self, command: ReceivedCommand) -> int | None:
        """Return the MAV_RESULT with which this command is refused before it is handled; None to handle it."""
        return None

    def send_command(self, target: tuple[int, int], command: int, param1: float = 0.0) -> None:
        """Send a COMMAND_LONG. ``target`` is (system id, component id); 0 selects all of them."""
        confirmation, unused_params = 0, (0.0,) * 6
        self.send(m.CommandLong(*target, command, confirmation, param1, *unused_params))

    def _on_timesync(self, request: m.Timesync, channel: Channel) -> None:
        if request.tc1 == 0:
            self.send(m.Timesync(int(self.uptime * 1e9), request.ts1), channel)


_DISCHARGE_CURVE = ((0.0, 3.0), (5.0, 3.3), (20.0, 3.6), (50.0, 3.75), (75.0, 3.95), (100.0, 4.2))


# Lines between the points of _DISCHARGE_CURVE, fullest first: percentage and volts of the lower end, volts per percent.
_DISCHARGE_SEGMENTS = tuple(
    (low, volts, (high_volts - volts) / (high - low)) for (low, volts), (high, high_volts) in pairwise(_DISCHARGE_CURVE)
)[::-1]
_RESISTANCE_OHM = 0.012


class SimulatedBattery:
    """A lithium battery pack. Its voltage depends on the charge, and sags under a current."""

    def __init__(self, capacity_mah: float = 3300.0, *, cells: int = 3, percent: float = 100.0) -> None:
        self.capacity_mah = capacity_mah
        self.cells = cells
        self.consumed_mah: float = 0.0
        """Charge in mAh that was consumed since power-on, as a current sensor counts it."""
        self.consumed_wh: float = 0.0
        self.current_a: float = 0.0
        self._charge_mah = capacity_mah * percent / 100.0

    @property
    def percent(self) -> float:
        return 100.0 * self._charge_mah / self.capacity_mah

    @percent.setter
    def percent(self, value: float) -> None:
        self._charge_mah = self.capacity_mah * value / 100.0

    @property
    def voltage_v(self) -> float:
        volts = self.cells * self._resting_cell_volts() - self.current_a * _RESISTANCE_OHM
        return volts if volts > 0.0 else 0.0

    def drain(self, current_a: float, dt: float) -> None:
        self.current_a = current_a
        used_mah = current_a * dt / 3.6  # 1 mAh is 3.6 ampere-seconds.
        self.consumed_mah += used_mah
        self.consumed_wh += used_mah * self.voltage_v / 1000.0
        self._charge_mah = max(0.0, self._charge_mah - used_mah)

    def _resting_cell_volts(self) -> float:
        percent = self.percent
        for low_percent, low_volts, volts_per_percent in _DISCHARGE_SEGMENTS:
            if percent >= low_percent:
                return low_volts + (min(percent, 100.0) - low_percent) * volts_per_percent
        _, empty_volts = _DISCHARGE_CURVE[0]
        return empty_volts
