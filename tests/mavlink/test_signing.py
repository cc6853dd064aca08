"""Signatures: known bytes, interoperability with pymavlink, and what receivers must reject."""

from __future__ import annotations

import hashlib
import io
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as peer

from aerokit.errors import InvalidArgument
from aerokit.mavlink import Frame, FrameEncoder, Framer
from aerokit.mavlink.messages import Heartbeat, ParamValue, RadioStatus
from aerokit.mavlink.signing import Refusal, Signing, SigningKey, timestamp_at

KEY = SigningKey.from_passphrase("a long secret")
OTHER = SigningKey(bytes(range(32)))
HEARTBEAT = Heartbeat(2, 3, 81, 0, 4)
NOW = 1_790_000_000.0
STAMP = 36_992_960_000_000
"""``NOW`` as a timestamp."""
GOLDEN = bytes.fromhex("fd09010007ffbe000000000000000203510403749c0500703d18a521409a061af9bb")
"""HEARTBEAT from 255/190, sequence 7, link 5, at `NOW`, signed with `KEY` by pymavlink 2.4."""


def signed(signing: Signing, *, system_id: int = 1, now: float = 0.0, sequence: int = 0) -> bytes:
    encoder = FrameEncoder(system_id, 1)
    encoder.signing, encoder.sequence = signing, sequence
    return encoder.encode(HEARTBEAT, now)


def framed(raw: bytes) -> Frame:
    (frame,) = Framer().receive(raw)
    return frame


def pymavlink(key: SigningKey = KEY, *, link_id: int = 0, timestamp: int = 0) -> Any:
    mav = peer.MAVLink(io.BytesIO(), srcSystem=255, srcComponent=190)
    mav.signing.secret_key = key.secret
    mav.signing.sign_outgoing = True
    mav.signing.link_id = link_id
    mav.signing.timestamp = timestamp
    return mav


# ------------------------------------------------------------------------------------------- keys


def test_passphrase_hash_matches_ground_stations() -> None:
    assert KEY.secret == hashlib.sha256(b"a long secret").digest()
    assert SigningKey.from_text(" a long secret\n") == KEY
    assert SigningKey.from_text(KEY.secret.hex().upper()) == KEY
    assert SigningKey.from_text("x" * 64) == SigningKey.from_passphrase("x" * 64)
    assert KEY != OTHER
    assert len({KEY, SigningKey.from_passphrase("a long secret")}) == 1


@pytest.mark.parametrize("secret", [b"", bytes(31), bytes(32), bytes(33), "a" * 32])
def test_invalid_key_is_rejected(secret: Any) -> None:
    with pytest.raises(InvalidArgument, match="key"):
        SigningKey(secret)


def test_key_is_never_shown() -> None:
    signing = Signing(KEY)
    for text in (repr(KEY), str(KEY), repr(signing), f"{signing}"):
        assert KEY.fingerprint in text
        assert KEY.secret.hex()[:8] not in text
        assert "secret" not in text
    assert OTHER.fingerprint != KEY.fingerprint


@pytest.mark.parametrize("options", [{"link_id": -1}, {"link_id": 256}, {"timestamp": -1}, {"timestamp": 1 << 48}])
def test_signing_rejects_options_out_of_range(options: Any) -> None:
    with pytest.raises(InvalidArgument, match=next(iter(options))):
        Signing(KEY, **options)


# ---------------------------------------------------------------- known bytes and interoperability


def test_signature_golden_bytes() -> None:
    assert timestamp_at(NOW) == STAMP
    encoder = FrameEncoder(255, 190)
    encoder.sequence = 7
    encoder.signing = Signing(KEY, link_id=5)
    assert encoder.encode(HEARTBEAT, NOW) == GOLDEN


def test_signature_matches_pymavlink() -> None:
    mav = pymavlink(link_id=5, timestamp=STAMP)
    mav.seq = 7
    message = mav.heartbeat_encode(2, 3, 81, 0, 4)
    assert message.pack(mav) == GOLDEN


def test_signatures_are_compatible_with_pymavlink() -> None:
    mav = pymavlink(timestamp=STAMP)
    signing = Signing(KEY)
    for number in range(5):
        raw = signed(signing, now=NOW, sequence=number)
        assert mav.parse_char(raw).get_signed()
        theirs = mav.param_value_encode(b"NAME", 1.0, 9, 10, number).pack(mav)
        assert signing.check(framed(theirs), NOW) is None


def test_pymavlink_rejects_other_key() -> None:
    mav = pymavlink(timestamp=STAMP)
    with pytest.raises(peer.MAVError, match="signature"):
        mav.parse_char(signed(Signing(OTHER), now=NOW))


def test_version_1_is_not_signed() -> None:
    encoder = FrameEncoder(1, 1, version=1)
    encoder.signing = Signing(KEY)
    frame = framed(encoder.encode(HEARTBEAT))
    assert (frame.version, frame.signature) == (1, b"")
    assert Signing(KEY).check(frame) is Refusal.UNSIGNED


# ------------------------------------------------------------------------------------- timestamps


@given(st.lists(st.floats(0, 4e9), max_size=20))
@example([NOW, 0.0, NOW - 100, NOW + 1, NOW])
def test_timestamps_always_increase(clock: list[float]) -> None:
    signing = Signing(KEY)
    stamps = [int.from_bytes(signing.sign(b"frame", now)[1:7], "little") for now in clock]
    assert stamps == sorted(set(stamps))
    assert all(stamp >= timestamp_at(now) for stamp, now in zip(stamps, clock, strict=True))
    assert signing.timestamp == (stamps[-1] + 1 if stamps else 0)


def test_stored_timestamp_precedes_clock() -> None:
    before = Signing(KEY)
    signed(before, now=NOW)
    after = Signing(KEY, timestamp=before.timestamp)
    listener = Signing(KEY)
    assert listener.accepts(framed(signed(before, now=NOW + 1)))
    assert listener.check(framed(signed(after, now=0.0))) is Refusal.REPLAYED
    after = Signing(KEY, timestamp=before.timestamp)
    assert listener.accepts(framed(signed(after, now=0.0)))


def test_received_timestamps_advance_ours() -> None:
    ahead, listener = Signing(KEY, timestamp=STAMP), Signing(KEY)
    assert listener.accepts(framed(signed(ahead)), NOW - 1000)
    assert listener.timestamp == STAMP
    assert framed(signed(listener)).signature[1:7] == STAMP.to_bytes(6, "little")


def test_exhausted_timestamps_raise() -> None:
    signing = Signing(KEY, timestamp=(1 << 48) - 1)
    signed(signing)
    with pytest.raises(InvalidArgument, match="exhausted"):
        signed(signing)


def test_frame_that_cannot_be_signed_is_not_counted() -> None:
    encoder = FrameEncoder(1, 1)
    encoder.signing = Signing(KEY, timestamp=(1 << 48) - 1)
    encoder.encode(HEARTBEAT)
    with pytest.raises(InvalidArgument, match="exhausted"):
        encoder.encode(HEARTBEAT)
    assert encoder.sequence == 1


# -------------------------------------------------------------------------------- rejected frames


@given(st.integers(0, 8 * len(GOLDEN) - 1))
def test_flipped_bit_is_rejected(bit: int) -> None:
    raw = bytearray(GOLDEN)
    raw[bit // 8] ^= 1 << bit % 8
    listener = Signing(KEY)
    assert not any(listener.accepts(frame) for frame in Framer().receive(bytes(raw)))
    # An attacker who changes the frame can correct the checksum, but not the signature.
    if 1 <= bit // 8 < len(GOLDEN) and raw[0] == 0xFD and raw[1] == GOLDEN[1] and raw[2] == 1:
        assert listener.check(Frame.parse(bytes(raw))) is Refusal.WRONG_SIGNATURE
    assert listener.accepts(framed(GOLDEN))


@given(st.lists(st.integers(0, 9), min_size=1, max_size=40))
def test_replayed_frames_are_rejected(order: list[int]) -> None:
    sender, listener = Signing(KEY), Signing(KEY)
    frames = [framed(signed(sender, sequence=number)) for number in range(10)]
    newest = -1
    for number in order:
        expected = None if number > newest else Refusal.REPLAYED
        assert listener.check(frames[number]) is expected
        newest = max(newest, number)
    assert listener.refused[Refusal.REPLAYED] == listener.frames_refused


def test_timestamps_are_kept_for_each_stream() -> None:
    listener = Signing(KEY)
    assert listener.accepts(framed(signed(Signing(KEY, timestamp=100))))
    assert listener.accepts(framed(signed(Signing(KEY, timestamp=50, link_id=1))))
    assert listener.accepts(framed(signed(Signing(KEY, timestamp=50), system_id=2)))
    assert listener.check(framed(signed(Signing(KEY, timestamp=50)))) is Refusal.REPLAYED


@pytest.mark.parametrize(("behind", "expected"), [(6_000_000, None), (6_000_001, Refusal.TOO_OLD)])
def test_new_sender_may_lag_one_minute(behind: int, expected: Refusal | None) -> None:
    frame = framed(signed(Signing(KEY, timestamp=STAMP - behind)))
    assert Signing(KEY).check(frame, NOW) is expected
    assert Signing(KEY, timestamp=STAMP).check(frame) is expected


def test_replay_from_other_link_is_rejected() -> None:
    first = Signing(KEY)
    second = first.for_link(1)
    frame = framed(signed(Signing(KEY)))
    assert first.accepts(frame)
    assert second.check(frame) is Refusal.REPLAYED
    assert (first.link_id, second.link_id, second.key) == (0, 1, KEY)


def test_unsigned_frames_are_rejected_unless_allowed() -> None:
    plain = framed(FrameEncoder(1, 1).encode(HEARTBEAT))
    radio = framed(FrameEncoder(51, 68).encode(RadioStatus(1, 2, 3, 4, 5, 6, 7)))
    signing = Signing(KEY)
    assert signing.check(plain) is Refusal.UNSIGNED
    assert signing.accepts(radio)
    trusting = Signing(KEY, allow_unsigned=lambda frame: frame.component_id == 1)
    assert trusting.accepts(plain)
    assert trusting.accepts(framed(signed(Signing(OTHER))))
    assert trusting.check(framed(FrameEncoder(1, 2).encode(HEARTBEAT))) is Refusal.UNSIGNED
    assert trusting.refused == {**dict.fromkeys(Refusal, 0), Refusal.UNSIGNED: 1}


def test_invalid_signature_does_not_advance_timestamp() -> None:
    listener = Signing(KEY)
    assert not listener.accepts(framed(signed(Signing(OTHER, timestamp=STAMP))))
    assert listener.timestamp == 0
    assert listener.accepts(framed(signed(Signing(KEY))))


def test_own_frame_is_refused_as_replay_on_all_links() -> None:
    own = Signing(KEY)
    frame = framed(signed(own, now=NOW))
    assert own.check(frame, NOW) is Refusal.REPLAYED
    assert own.for_link(1).check(frame, NOW) is Refusal.REPLAYED
    assert own.check(framed(signed(Signing(KEY), now=NOW + 1)), NOW + 1) is None


def test_remembered_own_signatures_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.mavlink.signing.MAX_OWN_SIGNATURES", 10)
    own = Signing(KEY)
    frames = [framed(signed(own, sequence=number)) for number in range(11)]
    assert [own.would_accept(frame) for frame in frames] == [True] + [False] * 10


def test_trimmed_payload_is_signed_as_sent() -> None:
    encoder = FrameEncoder(1, 1)
    encoder.signing = Signing(KEY)
    frame = framed(encoder.encode(ParamValue("", 0.0, 0, 0, 0)))
    assert len(frame.payload) == 1
    assert Signing(KEY).accepts(frame)


def test_remembered_streams_are_bounded() -> None:
    """A sender with the key may invent system ids; the table of senders is limited to 1024."""
    listener = Signing(KEY)
    for number in range(1100):
        sender = Signing(KEY, timestamp=100 + number, link_id=number // 250)
        assert listener.accepts(framed(signed(sender, system_id=1 + number % 250)))
    assert len(listener.streams) == 1024
