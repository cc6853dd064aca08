"""Simulated vehicles survive malformed input; tests/fuzz searches for more of it."""

from __future__ import annotations

import math

import pytest

from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import x25
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import LAST_TIMESTAMP, Signing, SigningKey
from aerokit.sim.channel import fitted
from aerokit.sim.kinds import kind_names, simulated
from aerokit.sim.vehicle import SimulatedVehicle

KEY = SigningKey(bytes(range(32)))


def replies_of(vehicle: SimulatedVehicle, *frames: bytes) -> list[Message]:
    """Return the messages that the vehicle sends in the three seconds after these bytes."""
    vehicle.step(vehicle.now + 3.0)
    vehicle.take_outbox()
    for frame in frames:
        vehicle.receive(frame, vehicle.now)
    vehicle.step(vehicle.now + 3.0)
    said = Framer().receive(vehicle.take_outbox(), vehicle.now)
    assert any(frame.message_id == m.Heartbeat.ID for frame in said)
    return [m.ParamError.decode(frame.payload) for frame in said if frame.message_id == m.ParamError.ID]


def framed(message: Message, signing: Signing | None = None) -> bytes:
    encoder = FrameEncoder(255, 190)
    encoder.signing = signing
    return encoder.encode(message)


@pytest.mark.parametrize("kind", kind_names())
@pytest.mark.parametrize("timestamp", [LAST_TIMESTAMP, LAST_TIMESTAMP + 1, (1 << 64) - 1])
def test_setup_signing_with_last_timestamp_is_survived(kind: str, timestamp: int) -> None:
    vehicle = simulated(kind, boot_time_s=0.0)
    replies_of(vehicle, framed(m.SetupSigning(1, 1, KEY.secret, timestamp)))


@pytest.mark.parametrize("kind", kind_names())
def test_frame_signed_with_last_timestamp_is_survived(kind: str) -> None:
    vehicle = simulated(kind, boot_time_s=0.0, signing_key=KEY)
    signing = Signing(KEY, link_id=7, timestamp=LAST_TIMESTAMP)
    replies_of(vehicle, framed(m.Heartbeat(6, 8, 0, 0, 4), signing))


@pytest.mark.parametrize("kind", ["px4", "px4_plane"])
@pytest.mark.parametrize("message", [m.ParamSet(1, 1, "A" * 16, 1.0, 9), m.ParamRequestRead(1, 1, "A" * 16, -1)])
def test_invalid_utf8_name_is_survived(kind: str, message: Message) -> None:
    """Each byte that is not UTF-8 becomes three, and the answer contains the name."""
    body = framed(message)[:-2].replace(b"A" * 16, b"\xff" * 16)
    crc = x25(body[1:] + bytes((message.CRC_EXTRA,)))
    (error,) = replies_of(simulated(kind, boot_time_s=0.0), body + crc.to_bytes(2, "little"))
    assert isinstance(error, m.ParamError)
    assert error.param_id == "\ufffd" * 5


def test_position_out_of_range_is_survived() -> None:
    far = fitted(m.GlobalPositionInt(0, 10**10, -(10**10), 5, 10**12, 0, 0, 0, 70_000))
    assert (far.lat, far.lon, far.alt, far.relative_alt, far.hdg) == (
        2**31 - 1,
        -(2**31),
        5,
        2**31 - 1,
        65535,
    )
    assert far.encode()


def test_float_beyond_the_range_becomes_infinite() -> None:
    assert fitted(m.VfrHud(-1e300, 1e39, 400_000, 5, math.nan, 0.0)).airspeed == -math.inf


def test_value_of_wrong_type_raises() -> None:
    wrong = m.Heartbeat("six", 8, 0, 0, 4)  # type: ignore[arg-type]
    assert fitted(wrong) == wrong
