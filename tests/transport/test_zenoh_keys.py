from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import InvalidArgument
from aerokit.transport.zenoh.keys import (
    Beacon,
    KeySpace,
    RefusalNotice,
    SendTime,
    Stamp,
    check_name,
)

u32 = st.integers(0, 2**32 - 1)
names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}", fullmatch=True)


def test_keys() -> None:
    keys = KeySpace("north", "alpha")
    assert keys.to_all_clients == "aerokit/north/alpha/from/all"
    assert keys.to_server("ground") == "aerokit/north/alpha/to/ground"
    assert keys.server_token(255) == "aerokit/north/alpha/alive/000000ff"
    assert keys.state("1/position") == "aerokit/north/alpha/state/1/position"


@pytest.mark.parametrize("name", ["", "*", "**", "a/b", "$x", "a b", "ä", "-a", ".a", "#", "a?", "x" * 64, "a\n"])
def test_names_with_meaning_in_zenoh_are_refused(name: str) -> None:
    with pytest.raises(InvalidArgument, match="is not allowed"):
        check_name("fleet", name)


@given(u32, u32, st.floats(0, 1e9), st.none() | names)
def test_beacon_round_trip(epoch: int, number: int, clock: float, lease_holder: str | None) -> None:
    beacon = Beacon(epoch, number, clock, lease_holder)
    assert Beacon.decode(beacon.encode()) == beacon


@given(u32, u32, u32, u32, st.sampled_from(["free", "take", "never"]))
def test_stamp_round_trip(epoch: int, number: int, nonce: int, sequence: int, mode: str) -> None:
    stamp = Stamp(epoch, number, nonce, sequence, mode)
    assert Stamp.decode(stamp.encode()) == stamp


@given(st.text(), st.text(), st.none() | names, st.binary(), st.integers(1, 2**31), st.none() | u32)
def test_notice_round_trip(
    message: str, reason: str, lease_holder: str | None, answer: bytes, count: int, nonce: int | None
) -> None:
    notice = RefusalNotice(message, reason, lease_holder, answer, count, nonce)
    assert RefusalNotice.decode(notice.encode()) == notice


@pytest.mark.parametrize("field", ["message", "reason"])
def test_notice_without_text_is_none(field: str) -> None:
    fields = json.loads(RefusalNotice("COMMAND_LONG", "read-only").encode())
    assert RefusalNotice.decode(json.dumps({**fields, field: None}).encode()) is None


@given(u32, st.floats(0, 1e9))
def test_send_time_round_trip(epoch: int, clock: float) -> None:
    read = SendTime.decode(SendTime(epoch, clock).encode())
    assert read is not None
    assert read.epoch == epoch
    assert read.clock_s == pytest.approx(clock, abs=0.001)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)
fields = st.dictionaries(
    st.sampled_from(["version", "epoch", "number", "clock_s", "holder", "refused", "message", "answer", "count"]),
    json_values | st.just(1) | st.just("order_refused"),
)


@given(st.binary() | fields.map(lambda content: json.dumps(content).encode()))
def test_decoding_never_raises(data: bytes) -> None:
    Beacon.decode(data)
    RefusalNotice.decode(data)
    Stamp.decode(data)
    SendTime.decode(data)


def test_other_version_is_ignored() -> None:
    beacon = Beacon(1, 1, 1.0)
    assert Beacon.decode(beacon.encode().replace(b'"version":1', b'"version":2')) is None
    assert Stamp.decode(b"\x02" + Stamp(1, 1, 1, 1).encode()[1:]) is None
    assert SendTime.decode(b"\x02" + SendTime(1, 1.0).encode()[1:]) is None


@pytest.mark.parametrize("clock", ["NaN", "Infinity", "-Infinity", "1" + 400 * "0"])
def test_beacon_with_invalid_clock_is_none(clock: str) -> None:
    data = Beacon(1, 1, 1.5).encode()
    assert Beacon.decode(data) is not None
    assert Beacon.decode(data.replace(b"1.5", clock.encode())) is None


def test_client_name_all_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="client = 'all' is not allowed"):
        check_name("client", "all")
    assert check_name("name", "all") == "all"
