"""The key for signing that a simulated vehicle was given: on all of its ports, and stored for the next boot."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from aerokit.mavlink.frame import Frame
from aerokit.mavlink.messages import SetupSigning
from aerokit.mavlink.signing import LAST_TIMESTAMP, Signing, SigningKey
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import SimulatedVehicle


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
