"""What simulated autopilots of every make have in common: version, files, clock, commands, the key for signing."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavProtocolCapability
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.messages import SetupSigning
from aerokit.mavlink.signing import LAST_TIMESTAMP, Signing, SigningKey, timestamp_at
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler, CommandServer
from aerokit.sim.file_tree import FileTree
from aerokit.sim.vehicle import Component, SimulatedVehicle


class VehicleSigning:
    """What both makes do: take a key by SETUP_SIGNING while disarmed, sign and check on all ports, keep it.

    ``key`` and ``timestamp`` (10 µs since 2015) were stored before. What an accepted frame told of time stamps counts
    on every port, as long as the vehicle is on.
    """

    AHEAD: ClassVar[int] = 0
    """By how much the time stamps begin behind the stored one."""

    def __init__(self, vehicle: SimulatedVehicle, key: SigningKey | None, timestamp: int) -> None:
        self.key = key
        """The stored key; None: nothing is signed or checked. Call `load` after changing it by hand."""
        self.timestamp: int = timestamp if key is not None else 0
        """The stored time stamp."""
        self.trusts_first_port = False
        """Whether the first port lets everything in, as ArduPilot's does by default. Call `load` after changing it."""
        self._vehicle = vehicle
        self._streams: dict[tuple[int, int, int], int] = {}
        vehicle.on(SetupSigning, self._on_setup)
        vehicle.when_powered_on(self._power_on)

    def load(self) -> None:
        for channel in self._vehicle.channels:
            self.start(channel)

    def start(self, channel: Channel) -> None:
        """Use what is stored, on one port; its number is the link id."""
        link_id = self._vehicle.channels.index(channel)
        if self.key is None or channel.version == 1 or not self.is_for(link_id):
            channel.sign_with(None)
            return
        signing = _Signing(
            self.key,
            link_id=link_id,
            timestamp=(self.timestamp + self.AHEAD) & LAST_TIMESTAMP,
            allow_unsigned=self.unsigned_on(link_id),
        )
        signing.streams = self._streams
        channel.sign_with(signing)

    def is_for(self, link_id: int) -> bool:
        """Whether this port signs and checks at all."""
        return True

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        """What this port lets in without a good signature."""
        raise NotImplementedError

    def may_change(self) -> bool:
        """Whether a key is taken, or taken away, now; says why not."""
        raise NotImplementedError

    def changed(self) -> None:
        """A key was taken, or taken away."""

    def _power_on(self) -> None:
        self._streams = {}
        self.load()

    def _on_setup(self, message: SetupSigning, _: Channel) -> None:
        if not self.may_change():
            return
        self.key = SigningKey(message.secret_key) if any(message.secret_key) else None
        self.timestamp = message.initial_timestamp & LAST_TIMESTAMP  # all that a frame has room for
        self.load()
        self.changed()


class _Signing(Signing):
    """As firmwares count: behind the last time stamp of 48 bits comes the first."""

    def sign(self, frame: bytes, now: float = 0.0) -> bytes:
        if self.timestamp > LAST_TIMESTAMP:
            self.timestamp = 0
        return super().sign(frame, now)


_RELEASES = {"dev": 0, "alpha": 64, "beta": 128, "rc": 192, "": 255, "official": 255}
"""FIRMWARE_VERSION_TYPE, by what stands behind the version's dash."""


class SimulatedAutopilot(SimulatedVehicle):
    """A vehicle whose firmware has a version, a card with files, a clock, and commands.

    - ``version``: as "4.7.0-dev" or "1.16.0"; ``unix_time_at_boot``: what its GPS clock says at simulated second 0
    - ``unsupported_commands``: MAV_CMDs that this firmware does not know
    - ``signing_key``: was set up before; None: its frames are not signed, until SETUP_SIGNING
    """

    CAPABILITIES: ClassVar[int]
    """MAV_PROTOCOL_CAPABILITYs."""

    files: FileTree
    """What is on its card, and what it makes up when it is read; it survives a reboot."""
    signing: VehicleSigning
    """The key for signing that it was given; it survives a reboot."""

    def __init__(
        self,
        *,
        system_id: int,
        seed: int,
        components: Iterable[Component],
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

    def make_signing(self, key: SigningKey | None, timestamp: int) -> VehicleSigning:
        """What this firmware does with keys; this one and its time stamp are stored already."""
        raise NotImplementedError

    def open_channel(self, *, version: int = 2) -> Channel:
        """Another port with its own stream rates; ``version`` is the MAVLink version it speaks."""
        channel = super().open_channel(version=version)
        if len(self.channels) > 1:  # the first one is there before anything else
            self.signing.start(channel)
        return channel

    @property
    def capabilities(self) -> int:
        """MAV_PROTOCOL_CAPABILITYs, for AUTOPILOT_VERSION."""
        return self.CAPABILITIES & ~MavProtocolCapability.FTP if self.faults.no_ftp else self.CAPABILITIES

    @property
    def unix_time(self) -> float:
        """What the GPS says the time is."""
        return self._unix_time_at_start + self.now

    @property
    def version_number(self) -> int:
        """As AUTOPILOT_VERSION packs it."""
        numbers, _, release = self.version.partition("-")
        major, minor, patch = (int(part) for part in (*numbers.split("."), "0", "0")[:3])
        return major << 24 | minor << 16 | patch << 8 | _RELEASES.get(release, 0)

    def listen_to_clocks(self) -> None:
        """Answer TIMESYNC."""
        self.on(m.Timesync, self._on_timesync)

    def serve_commands(self, handlers: Mapping[int, CommandHandler]) -> CommandServer:
        """Answer these MAV_CMDs, but for those that are to be unknown."""
        known = {number: each for number, each in handlers.items() if number not in self.unsupported_commands}
        return CommandServer(self, known, self.refusal_of_command)

    def refusal_of_command(self, command: Command) -> int | None:
        """The MAV_RESULT of what this firmware refuses before it looks which command it is."""
        return None

    def _on_timesync(self, request: m.Timesync, channel: Channel) -> None:
        if request.tc1 == 0:
            self.send(m.Timesync(int(self.uptime * 1e9), request.ts1), channel)
