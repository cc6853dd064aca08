"""Message signing of simulated vehicles, compared with ArduPilot and PX4."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as peer

from aerokit.mavlink import STANDARD, Frame, FrameEncoder, Framer
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavResult, MavType
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import ONE_MINUTE, Signing, SigningKey
from aerokit.sim import SimulatedCopter, SimulatedPx4
from aerokit.sim.channel import Channel

KEY = SigningKey.from_passphrase("right")
WRONG = SigningKey.from_passphrase("wrong")
# Later than the GPS time of the vehicles.
STAMP = 37_000_000_000_000


class Station:
    """A ground station on one port of a vehicle."""

    def __init__(
        self, vehicle: SimulatedCopter | SimulatedPx4, channel: Channel, signing: Signing | None = None
    ) -> None:
        self.vehicle, self.channel = vehicle, channel
        self.encoder = FrameEncoder(255, 190)
        self.encoder.signing = signing
        self.framer = Framer()
        self.frames: list[Frame] = []

    def send(self, message: Message) -> bytes:
        raw = self.encoder.encode(message)
        self.receive(raw)
        return raw

    def receive(self, raw: bytes) -> None:
        """Pass bytes of any sender to the vehicle."""
        self.vehicle.receive(raw, self.vehicle.now, None, self.channel)

    def setup(self, key: bytes, timestamp: int) -> None:
        self.send(m.SetupSigning(1, 1, key, timestamp))

    def answers_command(self) -> bool:
        """Return True if the vehicle answers a command."""
        self.read()
        self.send(m.CommandLong(1, 1, MavCmd.REQUEST_MESSAGE, 0, 148, *(0.0,) * 6))
        answers = [STANDARD.decode(frame) for frame in self.read() if frame.message_id == m.CommandAck.ID]
        return any(isinstance(ack, m.CommandAck) and ack.result == MavResult.ACCEPTED for ack in answers)

    def read(self) -> list[Frame]:
        """Return the messages that the vehicle sent since the last call."""
        found = self.framer.receive(self.channel.take_outbox())
        self.frames += found
        return found

    def run(self, seconds: float) -> list[Frame]:
        """Return the messages that the vehicle sends in this time."""
        self.read()
        self.vehicle.step(self.vehicle.now + seconds)
        return self.read()

    def stamps(self) -> list[int]:
        return [stamp_of(frame) for frame in self.frames if frame.signature]

    def texts(self) -> list[tuple[int, str]]:
        texts = [STANDARD.decode(frame) for frame in self.frames if frame.message_id == m.Statustext.ID]
        return [(text.severity, text.text) for text in texts if isinstance(text, m.Statustext)]


def stamp_of(frame: Frame) -> int:
    return int.from_bytes(frame.signature[1:7], "little")


def copter_on_two_ports(**options: Any) -> tuple[SimulatedCopter, Station, Station]:
    copter = SimulatedCopter(boot_time_s=0.0, **options)
    copter.open_channel()
    copter.step(0.0)
    first, second = (Station(copter, channel) for channel in copter.channels)
    return copter, first, second


def px4_with_station(**options: Any) -> tuple[SimulatedPx4, Station]:
    px4 = SimulatedPx4(boot_time_s=0.0, **options)
    px4.step(5.0)
    station = Station(px4, px4.channels[0])
    station.send(m.Heartbeat(MavType.GCS, MavAutopilot.INVALID, 0, 0, 4, 3))  # PX4 sends texts to ground stations only.
    return px4, station


# -------------------------------------------------------------------------------------- ArduPilot


def test_key_is_used_on_all_ports_with_offset() -> None:
    _, usb, radio = copter_on_two_ports()
    assert not any(frame.signature for frame in usb.run(2.0))
    usb.setup(KEY.secret, STAMP)
    for number, station in enumerate((usb, radio)):
        frames = station.run(2.0)
        assert len(frames) > 1
        assert {frame.signature[0] for frame in frames} == {number}
        assert all(Signing(KEY).has_signed(frame) for frame in frames)
        assert [stamp_of(frame) for frame in frames] == list(
            range(stamp_of(frames[0]), stamp_of(frames[0]) + len(frames))
        )
        assert station.stamps()[0] == STAMP + ONE_MINUTE


def test_only_first_port_accepts_unsigned_frames() -> None:
    copter, usb, radio = copter_on_two_ports()
    assert radio.answers_command()
    usb.setup(KEY.secret, STAMP)
    for signing, expected in ((None, False), (Signing(WRONG), False), (Signing(KEY, timestamp=STAMP), True)):
        radio.encoder.signing = usb.encoder.signing = signing
        assert usb.answers_command()
        assert radio.answers_command() is expected
    copter.signing.trusts_first_port = False
    copter.signing.load()
    usb.encoder.signing = None
    assert not usb.answers_command()


def test_old_frame_is_refused_on_every_port() -> None:
    copter, usb, radio = copter_on_two_ports()
    third = Station(copter, copter.open_channel())
    usb.setup(KEY.secret, STAMP)
    radio.encoder.signing = Signing(KEY, timestamp=STAMP + ONE_MINUTE)
    raw = radio.send(m.ParamSet(1, 1, "RTL_ALT", 1234.0, 9))
    assert copter.parameters["RTL_ALT"] == 1234.0
    copter.parameters["RTL_ALT"] = 1500.0
    for station in (radio, third):
        station.receive(raw)
        assert copter.parameters["RTL_ALT"] == 1500.0
    usb.receive(raw)  # The USB port accepts unsigned frames.
    assert copter.parameters["RTL_ALT"] == 1234.0


def test_new_sender_may_lag_a_minute() -> None:
    _, usb, radio = copter_on_two_ports()
    usb.setup(KEY.secret, STAMP)
    radio.encoder.signing = Signing(KEY, timestamp=STAMP - 1)
    assert not radio.answers_command()
    radio.encoder.signing = Signing(KEY, timestamp=STAMP + 100)
    assert radio.answers_command()


def test_key_cannot_change_while_armed() -> None:
    copter, usb, _ = copter_on_two_ports()
    usb.send(m.CommandLong(1, 1, MavCmd.COMPONENT_ARM_DISARM, 0, 1, 21196, *(0.0,) * 5))
    assert copter.is_armed
    usb.setup(KEY.secret, STAMP)
    frames = usb.run(0.5)
    assert not any(frame.signature for frame in frames)
    assert (4, "ERROR: Won't setup signing when armed") in usb.texts()


def test_key_and_time_stamp_survive_a_reboot() -> None:
    copter, usb, radio = copter_on_two_ports()
    usb.setup(KEY.secret, STAMP)
    radio.encoder.signing = Signing(KEY, timestamp=STAMP + 20 * ONE_MINUTE)
    assert radio.answers_command()
    radio.run(35.0)
    last = radio.stamps()[-1]
    assert last > STAMP + 20 * ONE_MINUTE
    copter.restart()
    radio.frames.clear()
    frames = radio.run(5.0)
    assert all(radio.encoder.signing.accepts(frame) for frame in frames)
    assert last < radio.stamps()[0] < last + 2 * ONE_MINUTE
    assert radio.answers_command()
    radio.encoder.signing = None
    assert not radio.answers_command()


def test_gps_time_advances_the_time_stamps() -> None:
    _, usb, _ = copter_on_two_ports()
    usb.setup(KEY.secret, 1)
    usb.run(1.0)
    assert usb.stamps()[0] == 1 + ONE_MINUTE  # GPS time was received before the key.
    copter = SimulatedCopter(boot_time_s=10.0, unix_time_at_boot=1_800_000_000.0)
    station = Station(copter, copter.channels[0])
    copter.step(1.0)
    station.setup(KEY.secret, 1)
    station.run(10.0)
    assert station.stamps()[0] == 1 + ONE_MINUTE
    assert station.stamps()[-1] >= (1_800_000_000 - 1_420_070_400) * 100_000


def test_key_of_zeros_removes_the_key() -> None:
    copter, usb, radio = copter_on_two_ports(signing_key=KEY)
    assert all(frame.signature for frame in usb.run(2.0))
    radio.setup(bytes(32), 0)
    assert copter.signing.key == KEY
    radio.encoder.signing = Signing(KEY, timestamp=STAMP)
    radio.setup(bytes(32), 0)
    assert not copter.signing.key
    radio.encoder.signing = None
    assert radio.answers_command()
    copter.restart()
    assert not any(frame.signature for frame in usb.run(5.0))


def test_signing_can_be_off_on_a_port() -> None:
    copter, usb, radio = copter_on_two_ports(signing_key=KEY)
    copter.parameters["MAV2_OPTIONS"] = 1
    assert not radio.answers_command()
    copter.restart()
    assert not any(frame.signature for frame in radio.run(5.0))
    assert all(frame.signature for frame in usb.read())
    assert radio.answers_command()


def test_mavlink_1_port_does_not_sign() -> None:
    copter, _, _ = copter_on_two_ports(signing_key=KEY)
    old = Station(copter, copter.open_channel(version=1))
    frames = old.run(2.0)
    assert frames
    assert {frame.version for frame in frames} == {1}
    assert old.answers_command()


def test_pymavlink_sets_up_a_key() -> None:
    copter, usb, radio = copter_on_two_ports()
    mav = peer.MAVLink(None, srcSystem=255, srcComponent=190)
    usb.receive(mav.setup_signing_encode(1, 1, list(KEY.secret), STAMP).pack(mav))
    mav.signing.secret_key, mav.signing.timestamp = KEY.secret, STAMP + 1
    mav.signing.sign_outgoing = True
    for frame in radio.run(1.0):
        message = mav.parse_char(frame.raw)
        assert message is not None
        assert message.get_signed()
    radio.receive(mav.param_set_encode(1, 1, b"RTL_ALT", 1234.0, 9).pack(mav))
    assert copter.parameters["RTL_ALT"] == 1234.0


@given(st.lists(st.integers(0, 5), max_size=12))
def test_replayed_setup_changes_nothing(order: list[int]) -> None:
    copter, _, radio = copter_on_two_ports(signing_key=KEY, parameter_count=20)
    radio.encoder.signing = Signing(KEY, timestamp=STAMP)
    sets = [radio.encoder.encode(m.ParamSet(1, 1, "RTL_ALT", 1000.0 + n, 9)) for n in range(6)]
    newest = -1
    for number in order:
        radio.receive(sets[number])
        newest = max(newest, number)
        assert copter.parameters["RTL_ALT"] == (1000.0 + newest)


# -------------------------------------------------------------------------------------------- PX4


def test_px4_announces_key_changes() -> None:
    _, station = px4_with_station()
    station.setup(KEY.secret, STAMP)
    frames = station.run(1.0)
    assert all(Signing(KEY).has_signed(frame) for frame in frames)
    assert station.stamps()[0] == STAMP
    assert station.texts()[-1] == (6, "MAVLink signing key accepted")
    station.encoder.signing = Signing(KEY, timestamp=STAMP + ONE_MINUTE)
    station.setup(bytes(32), 0)
    assert not any(frame.signature for frame in station.run(1.0))
    assert station.texts()[-1] == (6, "MAVLink signing disabled")
    station.encoder.signing = None
    assert station.answers_command()


def test_px4_accepts_unsigned_heartbeats_only() -> None:
    px4, station = px4_with_station(signing_key=KEY)
    received: list[int] = []
    px4.handlers[m.Heartbeat.ID] = lambda message, _: received.append(message.ID)
    for signing in (None, Signing(WRONG)):
        station.encoder.signing = signing
        assert not station.answers_command()
        station.send(m.Heartbeat(6, 8, 0, 0, 4))
    assert len(received) == 2
    station.setup(bytes(32), 0)
    assert px4.signing.key == KEY
    station.encoder.signing = Signing(KEY, timestamp=STAMP)
    assert station.answers_command()


def test_px4_refuses_a_key_while_armed() -> None:
    px4, station = px4_with_station()
    station.send(m.CommandLong(1, 1, MavCmd.COMPONENT_ARM_DISARM, 0, 1, *(0.0,) * 6))
    assert px4.is_armed
    station.setup(KEY.secret, STAMP)
    assert not any(frame.signature for frame in station.run(1.0))
    assert station.texts()[-1] == (2, "MAVLink signing: rejected while armed")


def test_px4_keeps_the_key() -> None:
    px4, station = px4_with_station()
    station.setup(KEY.secret, STAMP)
    px4.restart()
    station.frames.clear()
    station.run(5.0)
    assert station.stamps()[0] == STAMP


@pytest.mark.parametrize("key", [KEY, None])
def test_px4_1_16_does_not_sign(key: SigningKey | None) -> None:
    _, station = px4_with_station(version="1.16.1", signing_key=key)
    station.setup(KEY.secret, STAMP)
    assert not any(frame.signature for frame in station.run(1.0))
    assert station.answers_command()
