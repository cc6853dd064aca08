"""Mission items as messages and packed files: round trips, and pymavlink's layout."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.mavlink import messages
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.missions import Fence, Mission, MissionItem
from aerokit.missions.wire import (
    HEADER,
    MAGIC,
    NO_CLEAR,
    from_wire,
    pack_items,
    to_wire,
    to_wire_float,
    unpack_items,
)

float32 = st.floats(width=32) | st.just(math.nan)
int32 = st.integers(-(2**31), 2**31 - 1)
items = st.builds(
    MissionItem,
    st.integers(0, 0xFFFF),
    st.integers(0, 255),
    float32,
    float32,
    float32,
    float32,
    int32,
    int32,
    float32,
    st.booleans(),
)


@given(items, st.integers(0, 65534))
def test_integer_form_round_trip(item: MissionItem, seq: int) -> None:
    message = to_wire(item, seq, target_system=1, target_component=1, mission_type=1, current=True)
    assert (message.seq, message.current, message.mission_type, message.target_system) == (seq, 1, 1, 1)
    assert from_wire(messages.MissionItemInt.decode(message.encode())) == item


def test_float_form_uses_degrees() -> None:
    item = MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL_RELATIVE_ALT, x=473977419, y=-85455940, z=30.0)
    message = to_wire_float(item, 3, target_system=1, target_component=1)
    assert (message.x, message.y, message.seq) == (47.3977419, -8.545594, 3)
    assert from_wire(message) == item
    received = from_wire(messages.MissionItem.decode(message.encode()))
    assert abs(received.x - item.x) < 40  # some metres as a 32-bit float
    assert isinstance(received.x, int)


@pytest.mark.parametrize(
    ("item", "x"),
    [
        (MissionItem(MavCmd.DO_DIGICAM_CONTROL, 0, x=1), 1.0),
        (MissionItem(MavCmd.DO_DIGICAM_CONTROL, 2, x=1), 1.0),
        (MissionItem(MavCmd.DO_SET_ACTUATOR, 2, x=0.5), 0.5),
        (MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.LOCAL_NED, x=125000), 12.5),
        (MissionItem(31999, 3, x=10_000_000), 1.0),  # an unknown command is taken as a place
        (MissionItem(MavCmd.NAV_LAND, 3, x=0x7FFFFFFF), math.nan),
    ],
)
def test_float_form_scales_x(item: MissionItem, x: float) -> None:
    message = to_wire_float(item, 0, target_system=1, target_component=1)
    assert message.x == x or (math.isnan(x) and math.isnan(message.x))
    assert from_wire(message) == item


@given(float32, float32)
def test_float_form_decodes_any_numbers(x: float, y: float) -> None:
    from_wire(messages.MissionItem(1, 1, 0, 3, 16, 0, 1, 0, 0, 0, 0, x, y, 0, 0))


def test_integer_form_rejects_fraction() -> None:
    with pytest.raises(InvalidArgument, match=r"MISSION_ITEM_INT.x = 0.5"):
        to_wire(MissionItem(MavCmd.DO_SET_ACTUATOR, 2, x=0.5), 0, target_system=1, target_component=1).encode()


@given(st.lists(items, max_size=5), st.integers(0, 2))
def test_packed_plan_round_trip(plan: list[MissionItem], mission_type: int) -> None:
    data = pack_items(plan, mission_type)
    assert len(data) == 10 + 38 * len(plan)
    assert unpack_items(data, mission_type) == tuple(plan)


def test_packed_plan_matches_firmware_layout() -> None:
    item = MissionItem(MavCmd.NAV_WAYPOINT, 3, 1.0, 2.0, 3.0, 4.0, 473977419, 85455940, 30.0)
    data = pack_items([item], first=5, options=NO_CLEAR)
    assert data[:10] == struct.pack("<5H", 0x763D, 0, 1, 5, 1)
    link = ardupilotmega.MAVLink(None)
    theirs = ardupilotmega.MAVLink_mission_item_int_message(
        0, 0, 5, 3, 16, 0, 1, 1.0, 2.0, 3.0, 4.0, 473977419, 85455940, 30.0, 0
    )
    payload = theirs.pack(link)[10:-2]
    assert data[10:] == payload.ljust(38, b"\0")


GOOD = pack_items([MissionItem(16, 3), MissionItem(20, 2)])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "header of 10 bytes, received 0"),
        (GOOD[:9], "header of 10 bytes"),
        (b"\x1b" + GOOD[1:], "0x763D, found 0x761B"),
        (GOOD[:-1], "86 bytes for 2 items, received 85"),
        (GOOD + b"\0", "86 bytes for 2 items, received 87"),
        (HEADER.pack(MAGIC, 1, 0, 0, 0), "expected MAV_MISSION_TYPE 0, found 1"),
    ],
)
def test_damaged_packed_plan_is_rejected(data: bytes, message: str) -> None:
    with pytest.raises(RemoteProtocolError, match=message):
        unpack_items(data, 0)


@given(st.binary(max_size=200))
def test_unpack_accepts_any_bytes_or_raises(data: bytes) -> None:
    for content in (data, HEADER.pack(MAGIC, 0, 0, 0, 2) + data):
        try:
            unpack_items(content)
        except RemoteProtocolError:
            continue


def test_pack_rejects_too_many_items() -> None:
    with pytest.raises(InvalidArgument, match="65536 items are too many"):
        pack_items([MissionItem(20, 2)] * 65_535, first=1)


@given(st.lists(items, max_size=6), st.booleans())
def test_vehicle_item_indices_round_trip(plan: list[MissionItem], home_is_item_0: bool) -> None:
    mission = Mission([item.replace(param1=1.0) for item in plan])
    listed = mission.to_items(home_is_item_0=home_is_item_0)
    assert len(listed) == len(plan) + home_is_item_0
    assert Mission.from_items(listed, home_is_item_0=home_is_item_0) == mission


@given(st.lists(items, max_size=6))
def test_fence_from_any_items_or_error(plan: list[MissionItem]) -> None:
    for command in (5000, 5001, 5003, None):
        try:
            Fence.from_items([item if command is None else item.replace(command=command) for item in plan])
        except RemoteProtocolError:
            continue


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ([4, 4, 4], "item 0 .* 4 vertices"),
        ([math.nan, 3, 3], "item 0"),
        ([2, 2], "a polygon of 2 vertices, but 3 to 65535 are possible"),
        ([3, 3, 3, 3], "item 3"),
    ],
)
def test_incomplete_polygon_is_rejected(counts: list[float], message: str) -> None:
    with pytest.raises(RemoteProtocolError, match=message):
        Fence.from_items([MissionItem(5001, 0, count, x=1, y=1) for count in counts])


def test_fence_rejects_other_items() -> None:
    with pytest.raises(RemoteProtocolError, match=r"item 0 \(NAV_WAYPOINT\) does not belong"):
        Fence.from_items([MissionItem(16, 0)])
    with pytest.raises(RemoteProtocolError, match=r"item 0 .* radius_m = -1"):
        Fence.from_items([MissionItem(5003, 0, -1.0)])
    with pytest.raises(RemoteProtocolError, match=r"item 0 .* latitude"):
        Fence.from_items([MissionItem(5003, 0, 1.0, x=10**9)])
