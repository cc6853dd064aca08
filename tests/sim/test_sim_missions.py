"""Mission protocol of simulated vehicles, message by message; expectations were observed on real firmware."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mission_client import (
    CIRCLE,
    EAST,
    HOME,
    LAND,
    NORTH,
    RALLY,
    RETURN,
    TAKE_OFF,
    VERTEX,
    WAYPOINT,
    download,
    item,
    results,
    upload,
)
from simulated_client import Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavMissionResult
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedCopter, SimulatedPx4

R = MavMissionResult
Vehicle = SimulatedCopter | SimulatedPx4
FENCE_TYPE, RALLY_TYPE, ALL_TYPES = 1, 2, 255


def copter_and_client() -> tuple[SimulatedCopter, Client]:
    copter = SimulatedCopter(boot_time_s=0.0)
    client = Client(copter)
    client.run(2.0)
    client.clear()
    return copter, client


def px4_and_client(version: str = "1.17.0-alpha") -> tuple[SimulatedPx4, Client]:
    px4 = SimulatedPx4(fast_rate_hz=1.0, boot_time_s=0.5, version=version)
    client = Client(px4)
    client.run(1.0)
    client.clear()
    return px4, client


def is_open(vehicle: Vehicle) -> bool:
    return vehicle.missions.transfer_is_open


def square(radius: int = 1000) -> list[MissionItem]:
    corners = [(NORTH, EAST), (NORTH + radius, EAST), (NORTH + radius, EAST + radius), (NORTH, EAST + radius)]
    return [item(VERTEX, 0, 4.0, x=x, y=y) for x, y in corners]


# ------------------------------------------------------------------------------------------- ArduPilot


def test_ardupilot_download_has_storage_precision() -> None:
    copter, client = copter_and_client()
    sent = [
        item(WAYPOINT, 0),
        item(TAKE_OFF, 6, z=10.239),
        item(WAYPOINT, 3, 3.9, 5.0, 6.0, 90.0, NORTH, EAST, -3.456),
        item(MavCmd.NAV_LOITER_TURNS, 11, 0.5, 0.0, -300.0, 1.0, NORTH, EAST, 20.0),
        item(MavCmd.NAV_LOITER_TIME, 3, 70_000.0, 0.0, -5.0, 0.0, NORTH, EAST, 20.0),
        item(MavCmd.DO_SET_SERVO, 2, 5.0, 1500.7, 9.0, 9.0, 7, 8, 9.0),
        item(LAND, 3, z=0.0, autocontinue=False),
        item(RETURN, 3, 1.0, x=5, z=30.0),
    ]
    assert upload(client, sent) == R.ACCEPTED
    assert "Flight plan received" in client.texts
    home, take_off, waypoint, turns, time, servo, land, rtl = download(client)
    assert (home.command, home.frame, home.x) == (16, 0, NORTH)
    assert home.z == pytest.approx(584.09)
    assert take_off.frame == 3
    assert take_off.z == pytest.approx(10.23)
    assert waypoint == item(WAYPOINT, 3, 3.0, x=NORTH, y=EAST, z=waypoint.z)
    assert waypoint.z == pytest.approx(-3.45)
    assert (turns.frame, turns.param1, turns.param3, turns.param4) == (10, 0.5, -300.0, 1.0)
    assert (time.param1, time.param3) == (70_000 % 65536, -1.0)
    assert servo == item(MavCmd.DO_SET_SERVO, 0, 5.0, 1500.0)
    assert (land.param4, land.autocontinue) == (1.0, True)
    assert rtl == item(RETURN, 0)
    assert copter.missions.items(0) == [home, take_off, waypoint, turns, time, servo, land, rtl]


@pytest.mark.parametrize(
    ("sent", "result"),
    [
        (item(31000, 3), R.UNSUPPORTED),
        (item(0, 3), R.INVALID),
        (item(WAYPOINT, 1, x=1, y=1), R.UNSUPPORTED_FRAME),
        (item(WAYPOINT, 3, x=910_000_000), R.INVALID_PARAM5_X),
        (item(WAYPOINT, 3, y=-1_900_000_000), R.INVALID_PARAM6_Y),
        (item(WAYPOINT, 3, z=math.nan), R.INVALID_PARAM7),
        (item(WAYPOINT, 3, z=83_000.0), R.INVALID_PARAM7),
        (item(WAYPOINT, 3, math.nan), R.INVALID_PARAM1),
        (item(WAYPOINT, 3, param4=math.inf), R.INVALID_PARAM4),
        (item(WAYPOINT, 3, param4=math.nan), R.ACCEPTED),
        (item(MavCmd.DO_JUMP, 2, 9.0, 1.0), R.ERROR),
        (item(MavCmd.DO_JUMP, 2, 1.0, 1.0), R.ACCEPTED),
    ],
)
def test_ardupilot_refuses_invalid_item_and_keeps_previous_ones(sent: MissionItem, result: int) -> None:
    _, client = copter_and_client()
    assert upload(client, [HOME, item(RETURN, 0), item(RETURN, 0), item(RETURN, 0)]) == R.ACCEPTED
    assert upload(client, [HOME, item(TAKE_OFF, 3, z=5.0), sent]) == result
    assert len(download(client)) == 3
    assert download(client)[1].command == TAKE_OFF


def test_ardupilot_capacity_before_and_after_boot() -> None:
    copter = SimulatedCopter(boot_time_s=100.0)
    client = Client(copter)
    client.run(3.0)
    client.send(m.MissionCount(1, 1, 2, 0))
    client.send(m.MissionRequestInt(1, 1, 0, 0))
    assert client.last(m.MissionAck).type == R.NO_SPACE
    assert client.texts[-1] == "Only 0 items are supported"
    assert client.last(m.MissionItemInt).x == 0
    client.run(4.0)
    for mission_type, capacity in ((0, 650), (FENCE_TYPE, 70), (RALLY_TYPE, 46)):
        client.send(m.MissionCount(1, 1, capacity + 1, mission_type))
        client.run(0.1)
        assert client.texts[-1] == f"Only {capacity} items are supported"
        assert client.last(m.MissionAck).type == R.NO_SPACE


def test_ardupilot_count_includes_home() -> None:
    _, client = copter_and_client()
    client.send(m.MissionRequestList(1, 1, 0))
    assert client.last(m.MissionCount).count == 1
    client.send(m.MissionClearAll(1, 1, 0))
    client.send(m.MissionRequestList(1, 1, 0))
    assert client.last(m.MissionCount).count == 0
    assert upload(client, [HOME]) == R.ACCEPTED
    assert [one.command for one in download(client)] == [16, 16]  # Home appears twice.
    assert upload(client, [HOME, item(RETURN, 0)]) == R.ACCEPTED
    assert [one.command for one in download(client)] == [16, 20]


def test_ardupilot_retries_each_second_for_eight_seconds() -> None:
    copter, client = copter_and_client()
    client.send(m.MissionCount(1, 1, 2, 0))
    client.run(5.0)
    client.send(item_message(1))
    assert client.last(m.MissionAck).type == R.INVALID_SEQUENCE
    assert is_open(copter)
    client.run(3.1)
    assert not is_open(copter)
    assert [request.seq for request in client.all(m.MissionRequest)] == [0] * 8
    assert client.last(m.MissionAck).type == R.OPERATION_CANCELLED
    assert client.texts[-1] == "Mission upload timeout"
    client.send(item_message(0))
    assert client.last(m.MissionAck).type == R.ERROR


def item_message(seq: int, mission_type: int = 0, command: int = RETURN) -> m.MissionItemInt:
    return m.MissionItemInt(1, 1, seq, 0, command, 0, 1, 0.0, 0.0, 0.0, 0.0, 0, 0, 0.0, mission_type)


def test_ardupilot_denies_others_during_an_upload() -> None:
    copter, client = copter_and_client()
    other = Client(copter, system_id=255, component_id=77)
    client.send(m.MissionCount(1, 1, 2, 0))
    other.clear()
    for message in (
        m.MissionCount(1, 1, 2, 0),
        m.MissionRequestList(1, 1, 0),
        m.MissionRequestInt(1, 1, 0, 0),
    ):
        other.send(message)
        assert other.last(m.MissionAck).type == R.DENIED
    other.send(m.MissionClearAll(1, 1, 0))
    assert [ack.type for ack in other.all(m.MissionAck)[-2:]] == [R.DENIED, R.ERROR]
    other.send(item_message(0))
    assert other.last(m.MissionAck).type == R.DENIED
    other.send(m.MissionCount(1, 1, 2, RALLY_TYPE))
    assert (other.last(m.MissionRequest).seq, other.last(m.MissionRequest).mission_type) == (0, RALLY_TYPE)
    client.send(m.MissionCount(1, 1, 3, 0))  # The client of the running upload may start it again.
    assert client.last(m.MissionRequest).target_component == 190


def test_ardupilot_accepts_partial_list() -> None:
    _, client = copter_and_client()
    upload(client, [HOME, item(TAKE_OFF, 3, z=5.0), item(RETURN, 0)])
    client.send(m.MissionWritePartialList(1, 1, 1, 3, 0))
    assert client.last(m.MissionRequest).seq == 1
    for seq in (1, 2, 3):
        client.send(item_message(seq, command=MavCmd.DO_LAND_START))
    assert client.last(m.MissionAck).type == R.ACCEPTED
    assert [one.command for one in download(client)] == [16, 189, 189, 189]
    client.send(m.MissionWritePartialList(1, 1, 2, 5, 0))
    assert client.last(m.MissionAck).type == R.ERROR


def test_ardupilot_warns_about_float_messages() -> None:
    _, client = copter_and_client()
    client.send(m.MissionCount(1, 1, 2, 0))
    for seq in (0, 1):
        client.send(m.MissionItem(1, 1, seq, 3, WAYPOINT, 0, 1, 0, 0, 0, 0, NORTH / 1e7, EAST / 1e7, 10.0))
    client.send(m.MissionRequest(1, 1, 1, 0))
    client.send(m.MissionRequest(1, 1, 1, 0))
    client.run(0.1)
    assert client.last(m.MissionAck).type == R.ACCEPTED
    assert client.last(m.MissionItem).x == pytest.approx(NORTH / 1e7, abs=1e-5)
    assert client.texts == [
        "got MISSION_ITEM; GCS should send MISSION_ITEM_INT",
        "Flight plan received",
        "got MISSION_REQUEST; use MISSION_REQUEST_INT!",
    ]


def test_ardupilot_accepts_complete_fences_only() -> None:
    copter, client = copter_and_client()
    fence = [*square(), item(CIRCLE, 6, 20.5, x=NORTH, y=EAST, z=3.0)]
    assert upload(client, fence, FENCE_TYPE) == R.ACCEPTED
    back = download(client, FENCE_TYPE)
    assert [(one.command, one.frame, one.param1, one.z, one.autocontinue) for one in back] == [
        *[(VERTEX, 0, 4.0, 0.0, False)] * 4,
        (CIRCLE, 0, 20.5, 0.0, False),
    ]
    assert upload(client, square()[:3], FENCE_TYPE) == R.ERROR
    client.run(0.1)
    assert client.texts[-2:] == ["Incorrect item count", "Fence validation failed"]
    assert copter.missions.items(FENCE_TYPE) == back
    client.send(m.MissionCount(1, 1, 2, FENCE_TYPE))
    client.run(9.0)
    assert client.texts[-1] == "Fence upload timeout"
    assert download(client, FENCE_TYPE) == back
    client.send(m.MissionClearAll(1, 1, FENCE_TYPE))
    assert download(client, FENCE_TYPE) == []


@pytest.mark.parametrize(
    ("fence", "text"),
    [
        ([item(VERTEX, 0, 2.0)] * 2, "Invalid vertex count (2)"),
        ([*square()[:3], item(CIRCLE, 0, 5.0)], "Received incorrect type (want=98 got=92)"),
        ([*square()[:3], item(VERTEX, 0, 5.0)], "Unexpected vertex count want=4 got=5"),
        ([*square()[:3], item(5002, 0, 4.0)], "Received incorrect vertex type (want=98 got=97)"),
        ([item(CIRCLE, 0, 0.0)], "Non-positive circle radius"),
        ([item(5000, 0)] * 2, "Multiple return points"),
        ([item(CIRCLE, 0, 5.0, x=910_000_000)], "Bad lat or lon"),
        ([item(VERTEX, 0, 70.0)] * 70, "Fence exceeds storage size"),
    ],
)
def test_ardupilot_reports_invalid_fences(fence: list[MissionItem], text: str) -> None:
    _, client = copter_and_client()
    assert upload(client, fence, FENCE_TYPE) == R.ERROR
    client.run(0.1)
    assert text in client.texts


def test_ardupilot_rounds_rally_altitudes() -> None:
    _, client = copter_and_client()
    points = [item(RALLY, 6, 1.0, x=NORTH, y=EAST, z=20.9), item(RALLY, 0, x=NORTH, y=EAST, z=600.0)]
    assert upload(client, points, RALLY_TYPE) == R.ACCEPTED
    assert download(client, RALLY_TYPE) == [
        item(RALLY, 3, x=NORTH, y=EAST, z=20.0, autocontinue=False),
        item(RALLY, 0, x=NORTH, y=EAST, z=600.0, autocontinue=False),
    ]
    assert upload(client, [item(WAYPOINT, 3)], RALLY_TYPE) == R.UNSUPPORTED


def test_ardupilot_fence_and_rally_need_mavlink_2() -> None:
    copter, client = copter_and_client()
    client.send(m.MissionCount(1, 1, 1, 3))
    client.send(m.MissionRequestList(1, 1, 9))
    client.send(m.MissionClearAll(1, 1, ALL_TYPES))
    client.send(item_message(0, 4))
    assert results(client) == [R.UNSUPPORTED] * 4
    first = len(client.received)
    client.send(m.MissionRequestInt(1, 1, 0, 7))
    assert len(client.received) == first
    copter.channels[0].version = 1
    client.send(m.MissionRequestList(1, 1, FENCE_TYPE))
    client.run(0.1)
    assert client.texts[-1] == "Need mavlink2 for item transfer"


def test_ardupilot_answers_wrong_index_with_the_count() -> None:
    _, client = copter_and_client()
    upload(client, [HOME, item(RETURN, 0)])
    client.send(m.MissionRequestInt(1, 1, 5, 0))
    assert client.last(m.MissionCount).count == 2
    assert client.last(m.MissionAck).type == R.INVALID_SEQUENCE


def test_an_item_with_current_2_is_a_guided_target() -> None:
    _, client = copter_and_client()
    client.send(m.MissionItemInt(1, 1, 0, 3, WAYPOINT, 2, 1, 0, 0, 0, 0, NORTH, EAST, 10.0))
    assert client.last(m.MissionAck).type == R.ERROR
    client.command(MavCmd.DO_SET_MODE, 1, 4)
    client.send(m.MissionItemInt(1, 1, 0, 3, WAYPOINT, 2, 1, 0, 0, 0, 0, NORTH, EAST, 10.0))
    assert client.last(m.MissionAck).type == R.ACCEPTED


# ------------------------------------------------------------------------------------------------- PX4


def test_px4_download_has_int_frames_and_stored_params() -> None:
    px4, client = px4_and_client()
    sent = [
        item(TAKE_OFF, 3, 1.0, 2.0, 3.0, math.nan, NORTH, EAST, 10.0),
        item(WAYPOINT, 6, 2.0, 3.0, 4.0, -90.0, NORTH, EAST, 10.0),
        item(WAYPOINT, 0, x=NORTH, y=EAST, z=500.0, autocontinue=False),
        item(MavCmd.DO_JUMP, 2, 1.9, 70_000.0, 3.0, 4.0, 5, 6, 7.0),
        item(RETURN, 2),
    ]
    assert upload(client, sent) == R.ACCEPTED
    back = download(client)
    assert back[0] == item(TAKE_OFF, 6, param4=math.nan, x=NORTH, y=EAST, z=10.0)
    assert back[1] == item(WAYPOINT, 6, 2.0, 3.0, 0.0, 270.0, NORTH, EAST, 10.0)
    assert back[2] == item(WAYPOINT, 5, x=NORTH, y=EAST, z=500.0, autocontinue=False)
    assert back[3] == item(MavCmd.DO_JUMP, 2, 1.0, 70_000.0 - 65_536, 3.0, 4.0, 5, 6, 7.0)
    assert back[4] == item(RETURN, 2)
    assert px4.missions.items(0) == back
    assert upload(client, [item(RALLY, 6, x=NORTH, y=EAST, z=5.0)], RALLY_TYPE) == R.ACCEPTED
    assert download(client, RALLY_TYPE)[0].frame == 6


@pytest.mark.parametrize(
    ("sent", "result"),
    [
        (item(WAYPOINT, 10), R.UNSUPPORTED_FRAME),
        (item(WAYPOINT, 2), R.UNSUPPORTED),
        (item(RETURN, 3), R.UNSUPPORTED),
        (item(MavCmd.NAV_SPLINE_WAYPOINT, 3), R.UNSUPPORTED),
        (item(MavCmd.DO_SET_ROI, 3, 7.0), R.INVALID_PARAM1),
        (item(RALLY, 3), R.ERROR),
    ],
)
def test_px4_refused_item_keeps_the_old_mission(sent: MissionItem, result: int) -> None:
    _, client = px4_and_client()
    assert upload(client, [item(RETURN, 2)]) == R.ACCEPTED
    assert upload(client, [item(TAKE_OFF, 3, z=5.0), sent, item(RETURN, 2)]) == result
    assert download(client) == [item(RETURN, 2)]


def test_px4_capacities() -> None:
    _, client = px4_and_client()
    for mission_type, capacity in ((0, 10_000), (FENCE_TYPE, 64), (RALLY_TYPE, 32), (3, 0)):
        client.send(m.MissionCount(1, 1, capacity + 1, mission_type))
    assert results(client) == [R.NO_SPACE] * 4


def test_px4_sends_opaque_ids() -> None:
    _, client = px4_and_client()
    upload(client, [item(RETURN, 2)])
    opaque_id = client.last(m.MissionAck).opaque_id
    assert opaque_id
    client.send(m.MissionRequestList(1, 1, 0))
    assert client.last(m.MissionCount).opaque_id == opaque_id


def test_px4_retries_four_times_a_second_for_five_seconds() -> None:
    px4, client = px4_and_client()
    client.send(m.MissionCount(1, 1, 2, 0))
    client.run(5.2)
    assert len(client.all(m.MissionRequestInt)) == pytest.approx(20, abs=1)
    assert client.texts == ["Mission sync timeout\t"]
    assert not is_open(px4)
    assert client.all(m.MissionAck) == []
    client.send(item_message(0))
    assert client.last(m.MissionAck).type == R.ERROR


def test_px4_repeats_its_count_until_the_first_request() -> None:
    px4, client = px4_and_client()
    upload(client, [item(RETURN, 2)])
    client.clear()
    client.send(m.MissionRequestList(1, 1, 0))
    client.run(1.0)
    assert len(client.all(m.MissionCount)) == 4
    client.send(m.MissionRequestInt(1, 1, 0, 0))
    client.run(1.0)
    assert len(client.all(m.MissionCount)) == 4
    client.run(4.5)
    assert not is_open(px4)


def test_px4_downloads_in_order_only() -> None:
    px4, client = px4_and_client()
    upload(client, [item(RETURN, 2)] * 3)
    client.clear()
    client.send(m.MissionRequestList(1, 1, 0))
    for seq in (0, 0, 1, 1, 2):
        client.send(m.MissionRequestInt(1, 1, seq, 0))
    assert [message.seq for message in client.all(m.MissionItemInt)] == [0, 0, 1, 1, 2]
    client.send(m.MissionRequestInt(1, 1, 0, 0))
    client.run(0.1)
    assert results(client) == [R.ERROR]
    assert client.texts == ["WPM: REJ. CMD: Req. WP was unexpected\t"]
    assert not is_open(px4)
    client.clear()
    client.send(m.MissionRequestInt(1, 1, 0, 0))
    assert client.all(m.MissionItemInt) == []


def test_px4_refuses_other_stations_during_a_transfer() -> None:
    px4, client = px4_and_client()
    upload(client, [item(RETURN, 2)])
    client.send(m.MissionCount(1, 1, 2, 0))
    other = Client(px4, component_id=77)
    other.now = client.now
    other.send(m.MissionCount(1, 1, 2, 0))
    assert other.last(m.MissionAck).type == R.ERROR
    other.clear()
    other.send(item_message(0))
    other.send(m.MissionRequestList(1, 1, 0))
    other.send(m.MissionClearAll(1, 1, 0))
    other.send(m.MissionAck(1, 1, 0, 0))
    other.run(0.1)
    assert other.texts == [
        "REJ. MIS ITEM: partner id mismatch\t",
        "Mission download request ignored, already active\t",
        "WPM: IGN CLEAR CMD: Busy\t",
        "REJ. WP CMD: partner id mismatch\t",
    ]
    channel = px4.open_channel()
    px4.receive(FrameEncoder(255, 78).encode(m.MissionCount(1, 1, 2, 0)), other.now, channel=channel)
    answers = [STANDARD.decode(frame) for frame in Framer().receive(channel.take_outbox())]
    assert m.MissionAck(255, 78, R.ERROR, 0) in answers


def test_px4_repeats_a_lost_last_acknowledgement() -> None:
    _, client = px4_and_client()
    upload(client, [item(RETURN, 2)] * 2)
    client.clear()
    client.send(item_message(1))
    assert results(client) == [R.ACCEPTED]


def test_px4_switches_item_type_and_cancels_on_request() -> None:
    px4, client = px4_and_client()
    client.send(m.MissionCount(1, 1, 2, 0))
    client.send(m.MissionAck(1, 1, R.UNSUPPORTED, 0))
    assert client.last(m.MissionRequest).seq == 0
    client.send(m.MissionItem(1, 1, 0, 3, WAYPOINT, 0, 1, 0, 0, 0, 0, NORTH / 1e7, EAST / 1e7, 10.0))
    assert client.last(m.MissionRequest).seq == 1
    client.send(m.MissionAck(1, 1, R.OPERATION_CANCELLED, 0))
    assert not is_open(px4)
    _, old = px4_and_client("1.16.1")
    old.send(m.MissionCount(1, 1, 2, 0))
    assert old.last(m.MissionRequest).seq == 0


def test_px4_list_request_during_upload_can_block() -> None:
    px4, client = px4_and_client()
    upload(client, [item(RETURN, 2)] * 2)
    client.send(m.MissionCount(1, 1, 3, 0))
    client.send(item_message(0))  # Frame 0 is refused.
    assert not is_open(px4)
    client.send(m.MissionCount(1, 1, 3, 0))
    for seq in (0, 1):
        client.send(m.MissionItemInt(1, 1, seq, 2, RETURN, 0, 1, 0, 0, 0, 0, 0, 0, 0.0))
    client.send(m.MissionRequestList(1, 1, 0))
    assert client.last(m.MissionCount).count == 2
    client.send(m.MissionAck(1, 1, 0, 0))
    client.run(20.0)
    client.send(m.MissionCount(1, 1, 1, 0))
    assert client.last(m.MissionAck).type == R.ERROR
    client.send(m.MissionRequestList(1, 1, 0))
    client.run(6.0)
    assert upload(client, [item(RETURN, 2)]) == R.ACCEPTED


def test_px4_fence_drops_the_altitude_frame() -> None:
    _, client = px4_and_client()
    fence = [one.replace(frame=6, z=30.0) for one in square()]
    assert upload(client, fence, FENCE_TYPE) == R.ACCEPTED
    assert {(one.frame, one.z, one.param1) for one in download(client, FENCE_TYPE)} == {(5, 30.0, 4.0)}
    assert upload(client, [item(VERTEX, 3, 2.0)] * 2, FENCE_TYPE) == R.ERROR
    client.send(m.MissionClearAll(1, 1, ALL_TYPES))
    assert download(client, FENCE_TYPE) == []


# ------------------------------------------------------------------------------------------------ both


def both() -> list[tuple[Vehicle, Client]]:
    return [copter_and_client(), px4_and_client()]


def test_reboot_keeps_items_and_drops_transfers() -> None:
    for vehicle, client in both():
        upload(client, [HOME, item(RETURN, 2)] if isinstance(vehicle, SimulatedCopter) else [item(RETURN, 2)])
        before = vehicle.missions.items(0)
        client.send(m.MissionCount(1, 1, 5, RALLY_TYPE))
        assert is_open(vehicle)
        client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1)
        client.run(8.0)
        assert not is_open(vehicle)
        assert [one.command for one in vehicle.missions.items(0)] == [one.command for one in before]


def test_replace_stores_a_whole_list() -> None:
    for vehicle, client in both():
        mission = [HOME, item(TAKE_OFF, 3, z=5.0)]
        fence = square()
        assert vehicle.missions.replace(0, mission) == R.ACCEPTED
        assert vehicle.missions.replace(FENCE_TYPE, fence) == R.ACCEPTED
        assert vehicle.missions.replace(RALLY_TYPE, [item(RALLY, 3, x=1, y=1, z=5.0)]) == R.ACCEPTED
        assert vehicle.missions.replace(0, [item(31000, 3)]) == R.UNSUPPORTED
        assert [len(download(client, kind)) for kind in (FENCE_TYPE, RALLY_TYPE)] == [4, 1]
        assert vehicle.missions.items(9) == []
    copter, client = copter_and_client()
    assert copter.missions.replace(0, [HOME, item(RETURN, 0), item(RETURN, 0)]) == R.ACCEPTED
    assert copter.missions.replace(0, [item(TAKE_OFF, 3, z=5.0)], start=1, clear=False) == R.ACCEPTED
    assert [one.command for one in download(client)] == [16, 22, 20]
    assert copter.missions.replace(FENCE_TYPE, square(), clear=False) == R.ERROR
    assert copter.missions.replace(0, [HOME, item(MavCmd.DO_JUMP, 2, 2.0)]) == R.ERROR


types = st.sampled_from([0, 0, 0, 1, 2, 3, 255])
numbers = st.integers(0, 4)
commands = st.sampled_from([16, 16, 20, 21, 22, 177, 5001, 5003, 5100, 0, 31000])
floats = st.sampled_from([0.0, 1.0, 3.0, -1.0, 0.5, 300.0, math.nan, math.inf, 1e20])
coordinates = st.sampled_from([0, NORTH, 910_000_000, -(1 << 31), (1 << 31) - 1])
frames = st.sampled_from([0, 2, 3, 5, 6, 10, 77])


@st.composite
def any_item(draw: st.DrawFn) -> Message:
    head = (1, 1, draw(numbers), draw(frames), draw(commands), draw(st.integers(0, 3)), 1)
    params = (draw(floats), draw(floats), draw(floats), draw(floats))
    if draw(st.booleans()):
        return m.MissionItem(*head, *params, draw(floats), draw(floats), draw(floats), draw(types))
    return m.MissionItemInt(*head, *params, draw(coordinates), draw(coordinates), draw(floats), draw(types))


messages = st.one_of(
    any_item(),
    st.builds(lambda n, t: m.MissionCount(1, 1, n, t), st.integers(0, 70), types),
    st.builds(lambda n, t: m.MissionRequestInt(1, 1, n, t), numbers, types),
    st.builds(lambda n, t: m.MissionRequest(1, 1, n, t), numbers, types),
    st.builds(lambda t: m.MissionRequestList(1, 1, t), types),
    st.builds(lambda t: m.MissionClearAll(1, 1, t), types),
    st.builds(lambda n, t: m.MissionAck(1, 1, n, t), st.integers(0, 20), types),
    st.builds(lambda n: m.MissionSetCurrent(1, 1, n), numbers),
    st.builds(lambda a, b, t: m.MissionWritePartialList(1, 1, a, b, t), numbers, numbers, types),
    st.builds(lambda n: m.CommandLong(1, 1, 300, 0, n, 0, 0, 0, 0, 0, 0), floats),
    st.builds(lambda n: m.CommandLong(1, 1, 224, 0, n, 1, 0, 0, 0, 0, 0), floats),
)
conversation = st.lists(st.tuples(messages, st.booleans(), st.sampled_from([0.0, 0.0, 0.3])), max_size=30)


def hold(vehicle: Vehicle, client: Client, talk: Sequence[tuple[Message, bool, float]]) -> None:
    other = Client(vehicle, component_id=77)
    for message, by_other, pause in talk:
        speaker = other if by_other else client
        speaker.now = client.now = max(client.now, other.now)
        speaker.send(message)
        speaker.run(pause)
    client.now = max(client.now, other.now)
    client.run(9.0)


@given(conversation)
def test_ardupilot_handles_random_messages_without_open_transfers(
    talk: list[tuple[Message, bool, float]],
) -> None:
    copter, client = copter_and_client()
    hold(copter, client, talk)
    assert not is_open(copter)
    assert len(copter.missions.items(0)) <= 650


@pytest.mark.exhaustive
@given(conversation)
def test_px4_handles_random_messages_without_open_transfers(
    talk: list[tuple[Message, bool, float]],
) -> None:
    px4, client = px4_and_client()
    hold(px4, client, talk)
    client.send(m.MissionRequestList(1, 1, 0))  # This transfer ends by its time-out in the next 6 s.
    client.run(6.0)
    assert not is_open(px4)
    assert upload(client, [item(RETURN, 2)]) == R.ACCEPTED
