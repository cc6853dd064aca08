from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import InvalidArgument
from aerokit.transport.zenoh.keys import Beacon, Place, Stamp, Told, check_name, read_sent_at, sent_at

u32 = st.integers(0, 2**32 - 1)
names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}", fullmatch=True)


def test_keys() -> None:
    place = Place("north", "alpha")
    assert place.everybody == "aerokit/north/alpha/from/all"
    assert place.to_vehicle("ground") == "aerokit/north/alpha/to/ground"
    assert place.alive(255) == "aerokit/north/alpha/alive/000000ff"
    assert place.state("1/position") == "aerokit/north/alpha/state/1/position"


@pytest.mark.parametrize(
    "name", ["", "*", "**", "a/b", "$x", "a b", "ä", "-a", ".a", "#", "a?", "x" * 64, "a\n"]
)
def test_names_that_zenoh_would_understand_otherwise(name: str) -> None:
    with pytest.raises(InvalidArgument, match="is not allowed"):
        check_name("fleet", name)


@given(u32, u32, st.floats(0, 1e9), st.none() | names)
def test_beacons_come_back(epoch: int, number: int, clock: float, helm: str | None) -> None:
    beacon = Beacon(epoch, number, clock, helm)
    assert Beacon.decode(beacon.encode()) == beacon


@given(u32, u32, u32, u32, st.sampled_from(["free", "take", "never"]))
def test_stamps_come_back(epoch: int, number: int, nonce: int, sequence: int, wish: str) -> None:
    stamp = Stamp(epoch, number, nonce, sequence, wish)
    assert Stamp.decode(stamp.encode()) == stamp


@given(st.text(), st.text(), st.none() | names, st.binary(), st.integers(1, 2**31))
def test_what_is_told_comes_back(
    message: str, reason: str, helm: str | None, answer: bytes, count: int
) -> None:
    told = Told(message, reason, helm, answer, count)
    assert Told.decode(told.encode()) == told


@given(u32, st.floats(0, 1e9))
def test_times_come_back(epoch: int, clock: float) -> None:
    read = read_sent_at(sent_at(epoch, clock))
    assert read is not None
    assert read[0] == epoch
    assert read[1] == pytest.approx(clock, abs=0.001)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)
fields = st.dictionaries(
    st.sampled_from(["version", "epoch", "number", "clock_s", "helm", "told", "message", "answer", "count"]),
    json_values | st.just(1) | st.just("order_refused"),
)


@given(st.binary() | fields.map(lambda each: json.dumps(each).encode()))
def test_whatever_comes_never_raises(data: bytes) -> None:
    Beacon.decode(data)
    Told.decode(data)
    Stamp.decode(data)
    read_sent_at(data)


def test_another_version_is_not_listened_to() -> None:
    beacon = Beacon(1, 1, 1.0)
    assert Beacon.decode(beacon.encode().replace(b'"version":1', b'"version":2')) is None
    assert Stamp.decode(b"\x02" + Stamp(1, 1, 1, 1).encode()[1:]) is None
    assert read_sent_at(b"\x02" + sent_at(1, 1.0)[1:]) is None


@pytest.mark.parametrize("clock", ["NaN", "Infinity", "-Infinity", "1" + 400 * "0"])
def test_a_beacon_whose_clock_is_no_time_is_none(clock: str) -> None:
    data = Beacon(1, 1, 1.5).encode()
    assert Beacon.decode(data) is not None
    assert Beacon.decode(data.replace(b"1.5", clock.encode())) is None


def test_no_client_is_called_as_everybody_is() -> None:
    with pytest.raises(InvalidArgument, match="client = 'all' is not allowed"):
        check_name("client", "all")
    assert check_name("name", "all") == "all"
