"""What simulated autopilots of every make have in common: version, files, clock, commands."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavProtocolCapability
from aerokit.mavlink.signing import SigningKey, timestamp_at
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler, CommandServer
from aerokit.sim.file_tree import FileTree
from aerokit.sim.signing import VehicleSigning
from aerokit.sim.vehicle import Component, SimulatedVehicle

__all__ = ["SimulatedAutopilot"]

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
