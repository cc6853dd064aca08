"""The key for signing that a simulated vehicle was given: on all of its ports, and stored for the next boot."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import MavSeverity
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.messages import AdsbVehicle, Collision, Heartbeat, SetupSigning
from aerokit.mavlink.signing import LAST_TIMESTAMP, ONE_MINUTE, Signing, SigningKey, timestamp_at

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.autopilot import SimulatedAutopilot
    from aerokit.sim.channel import Channel
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["ArduPilotSigning", "Px4Signing", "VehicleSigning"]


class VehicleSigning:
    """What both makes do: take a key by SETUP_SIGNING while disarmed, sign and check on all ports, keep it.

    ``key`` and ``timestamp`` (10 µs since 2015) were stored before. What an accepted frame told of time stamps counts
    on every port, as long as the vehicle is on.
    """

    AHEAD: ClassVar[int] = 0
    """By how much the time stamps begin behind the stored one."""

    def __init__(self, vehicle: SimulatedAutopilot, key: SigningKey | None, timestamp: int) -> None:
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
        """Use what is stored, on all ports."""
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


_SAVE_EVERY_S = 30.0
_SIGNING_OFF = 1


class ArduPilotSigning(VehicleSigning):
    """It says nothing when a key is taken, stores its time stamp every 30 seconds, and begins a minute behind it.

    The first port counts as secure, as USB is on a flight controller: it signs, and lets everything in; set
    ``trusts_first_port`` to False, and call `load`, for a vehicle whose only link is a radio. Bit 0 of MAV1_OPTIONS,
    MAV2_OPTIONS … turns signing off on the first, second … port from the next boot or SETUP_SIGNING on.
    """

    AHEAD: ClassVar[int] = ONE_MINUTE

    def __init__(self, vehicle: ArduPilotVehicle, key: SigningKey | None, timestamp: int) -> None:
        super().__init__(vehicle, key, timestamp)
        self.trusts_first_port = True
        self._ardupilot = vehicle
        vehicle.when_powered_on(self._keep_time)

    def is_for(self, link_id: int) -> bool:
        """Signing can be turned off for a port."""
        name, parameters = f"MAV{link_id + 1}_OPTIONS", self._ardupilot.parameters
        return not (name in parameters and int(parameters[name]) & _SIGNING_OFF)

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        """Everything on the first port."""
        return _everything if link_id == 0 and self.trusts_first_port else None

    def may_change(self) -> bool:
        """Not while armed."""
        if self._ardupilot.is_armed:
            self._ardupilot.send_text(MavSeverity.WARNING, "ERROR: Won't setup signing when armed")
            return False
        return True

    def _keep_time(self) -> None:
        self._ardupilot.every(_SAVE_EVERY_S, self._save)
        self._ardupilot.call_later(self._ardupilot.timeline.gps_fix, self._hear_gps)

    def _hear_gps(self) -> None:
        """GPS knows the time: stamps are not before it."""
        stamp = timestamp_at(int(self._ardupilot.unix_time))
        for channel in self._ardupilot.channels:
            if channel.signing is not None:
                channel.signing.timestamp = max(channel.signing.timestamp, stamp)
        self._save()

    def _save(self) -> None:
        if self.key is not None:
            used = [each.signing.timestamp for each in self._ardupilot.channels if each.signing is not None]
            self.timestamp: int = max([self.timestamp, *used])


def _everything(_: Frame) -> bool:
    return True


_UNSIGNED = frozenset((Heartbeat.ID, AdsbVehicle.ID, Collision.ID))


class Px4Signing(VehicleSigning):
    """It tells when a key is taken, and lets heartbeats in without a signature; 1.16 knows no signing.

    The time stamp is stored when a key is taken, and not again.
    """

    def __init__(self, vehicle: SimulatedPx4, key: SigningKey | None, timestamp: int) -> None:
        super().__init__(vehicle, key, timestamp)
        self._px4 = vehicle

    def is_for(self, link_id: int) -> bool:
        """Since 1.17."""
        return not self._px4.version.startswith("1.16")

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        """Heartbeats and the traffic around, on every port."""
        return _may_be_unsigned

    def may_change(self) -> bool:
        """Not while armed."""
        if not self.is_for(0):
            return False
        if self._px4.is_armed:
            self._px4.send_text(MavSeverity.CRITICAL, "MAVLink signing: rejected while armed")
            return False
        return True

    def changed(self) -> None:
        """Say so."""
        self._px4.info("MAVLink signing disabled" if self.key is None else "MAVLink signing key accepted")


def _may_be_unsigned(frame: Frame) -> bool:
    return frame.message_id in _UNSIGNED
