"""Whatever arrives, simulated vehicles go on; tests/fuzz looks for what does not yet."""

from __future__ import annotations

import math

import pytest

from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import x25
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import LAST_TIMESTAMP, Signing, SigningKey
from aerokit.sim.fitting import fitted
from aerokit.sim.kinds import kind_names, simulated
from aerokit.sim.vehicle import SimulatedVehicle

KEY = SigningKey(bytes(range(32)))


def hearing(vehicle: SimulatedVehicle, *frames: bytes) -> list[Message]:
    """What it says in the three seconds after it has heard them."""
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
def test_a_time_stamp_at_the_end_of_time(kind: str, timestamp: int) -> None:
    vehicle = simulated(kind, boot_time_s=0.0)
    hearing(vehicle, framed(m.SetupSigning(1, 1, KEY.secret, timestamp)))


@pytest.mark.parametrize("kind", kind_names())
def test_a_frame_that_is_signed_at_the_end_of_time(kind: str) -> None:
    vehicle = simulated(kind, boot_time_s=0.0, signing_key=KEY)
    signing = Signing(KEY, link_id=7, timestamp=LAST_TIMESTAMP)
    hearing(vehicle, framed(m.Heartbeat(6, 8, 0, 0, 4), signing))


@pytest.mark.parametrize("kind", ["px4", "px4_plane"])
@pytest.mark.parametrize(
    "message", [m.ParamSet(1, 1, "A" * 16, 1.0, 9), m.ParamRequestRead(1, 1, "A" * 16, -1)]
)
def test_a_name_that_is_no_text(kind: str, message: Message) -> None:
    """Each byte that is no UTF-8 becomes three, and the name is told in the answer."""
    body = framed(message)[:-2].replace(b"A" * 16, b"\xff" * 16)
    crc = x25(body[1:] + bytes((message.CRC_EXTRA,)))
    (error,) = hearing(simulated(kind, boot_time_s=0.0), body + crc.to_bytes(2, "little"))
    assert isinstance(error, m.ParamError)
    assert error.param_id == "\ufffd" * 5


def test_a_place_beyond_the_world() -> None:
    far = fitted(m.GlobalPositionInt(0, 10**10, -(10**10), 5, 10**12, 0, 0, 0, 70_000))
    assert (far.lat, far.lon, far.alt, far.relative_alt, far.hdg) == (
        2**31 - 1,
        -(2**31),
        5,
        2**31 - 1,
        65535,
    )
    assert far.encode()


def test_a_number_beyond_all_numbers() -> None:
    assert fitted(m.VfrHud(-1e300, 1e39, 400_000, 5, math.nan, 0.0)).airspeed == -math.inf


def test_what_is_of_a_wrong_type_is_a_mistake_and_stays_one() -> None:
    wrong = m.Heartbeat("six", 8, 0, 0, 4)  # type: ignore[arg-type]
    assert fitted(wrong) == wrong
