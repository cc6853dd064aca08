"""``vehicle.commands``: a list between download and upload, and what comes of it on the vehicle."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from flight_controller import FlightController
from flight_controller_services import Item
from pymavlink.dialects.v10 import all as mavlink_1
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from aerokit.dronekit.commands import Command, CommandSequence
from aerokit.dronekit.connect import connect
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name
from aerokit.dronekit.vehicle import Vehicle
from aerokit.errors import LocalProtocolError

HOME = Item(16, -35.363261, 149.16523, 584.0, 0)
FIRST, SECOND, THIRD = (Item(16, -35.5 - n / 8, 149.25, 20.0 + n) for n in range(3))
LIMIT_S = 10.0
TAKE_OFF, JUMP, SPEED, RETURN = 22, 177, 178, 20


def waypoint(latitude: float = -35.5, frame: int = 3, command: int = 16, **fields: Any) -> Command:
    cmd = Command(0, 0, 0, frame, command, 0, 0, 0, 0, 0, 0, latitude, 149.25, 30)
    for name, value in fields.items():
        setattr(cmd, name, value)
    return cmd


@contextmanager
def connected(*items: Item, **options: Any) -> Iterator[tuple[FlightController, Vehicle]]:
    with FlightController(heartbeat_s=0.02, **options) as controller:
        controller.missions.items = list(items)
        controller.missions.has_home = controller.autopilot == 3
        with connect(controller.address, rate=None) as vehicle:
            yield controller, vehicle


@pytest.fixture
def three() -> Iterator[tuple[FlightController, CommandSequence]]:
    """A vehicle with home and three waypoints, downloaded."""
    with connected(HOME, FIRST, SECOND, THIRD) as (controller, vehicle):
        vehicle.commands.download()
        assert vehicle.commands.wait_ready()
        yield controller, vehicle.commands


@pytest.fixture
def empty() -> Iterator[tuple[FlightController, CommandSequence]]:
    """A vehicle nothing is known of."""
    with connected(HOME, FIRST) as (controller, vehicle):
        yield controller, vehicle.commands


@pytest.fixture
def px4() -> Iterator[tuple[FlightController, Vehicle]]:
    with connected(FIRST, SECOND, autopilot=12) as pair:
        yield pair


def kept(controller: FlightController) -> list[tuple[int, float, float]]:
    return [(each.command, each.x, each.z) for each in controller.missions.items]


def transfers(controller: FlightController, since: int) -> list[str]:
    names = ("MISSION_COUNT", "MISSION_CLEAR_ALL", "MISSION_WRITE_PARTIAL_LIST", "MISSION_REQUEST_LIST")
    return [frame.name for frame in controller.received(*names, since=since)]


# -------------------------------------------------------------------------------------- Command


def test_a_command_is_a_mission_item_of_pymavlink_with_the_text_of_mavlink_1() -> None:
    cmd = Command(0, 0, 0, 3, 16, 0, 0, 0, 0, 0, 0, -34.3, 149.1, 30)
    assert isinstance(cmd, mavlink.MAVLink_mission_item_message)
    assert str(cmd) == (
        "MISSION_ITEM {target_system : 0, target_component : 0, seq : 0, frame : 3, command : 16, current : 0,"
        " autocontinue : 0, param1 : 0, param2 : 0, param3 : 0, param4 : 0, x : -34.3, y : 149.1, z : 30}"
    )
    assert (cmd.x, cmd.format_attr("y"), cmd.get_type()) == (-34.3, 149.1, "MISSION_ITEM")
    assert cmd.pack(mavlink.MAVLink(None, 1, 1))
    with pytest.raises(TypeError):
        Command(0, 0, 0, 3, 16, 0, 0, 0, 0, 0, 0, -34.3, 149.1, 30, 0)  # type: ignore[call-arg]


# ------------------------------------------------------------------------------------- download


def test_what_is_downloaded_are_commands_counted_without_home(
    three: tuple[FlightController, CommandSequence],
) -> None:
    _, cmds = three
    first = cmds[0]
    assert isinstance(first, Command)
    assert (len(cmds), cmds.count, [each.seq for each in cmds]) == (3, 3, [1, 2, 3])
    assert (first.x, first.y, first.z, first.frame, first.autocontinue) == (-35.5, 149.25, 20.0, 3, 1)
    assert (first.target_system, first.target_component) == (255, 0)
    assert str(cmds._vehicle.home_location) == "LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0"


def test_it_is_a_list(three: tuple[FlightController, CommandSequence]) -> None:
    _, cmds = three
    assert [each.seq for each in cmds[0:2]] == [1, 2]
    assert [each.seq for each in cmds[-2:]] == [2, 3]
    assert type(cmds[:]) is list
    assert cmds[-1].seq == 3
    assert cmds[2] in cmds
    for index in (3, -4):
        with pytest.raises(IndexError, match=f"^Index {index} out of range.$"):
            cmds[index]
    with pytest.raises(TypeError, match=r"^Invalid argument type.$"):
        cmds["a"]  # type: ignore[call-overload]


def test_nothing_is_there_before_a_download_and_nothing_is_waited_for(
    empty: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = empty
    before = controller.mark()
    assert (len(cmds), list(cmds), cmds.next, cmds.wait_ready(timeout=0)) == (0, [], 0, True)
    with pytest.raises(IndexError, match=r"^Index 0 out of range.$"):
        cmds[0]
    cmds.upload()
    cmds._vehicle.flush()
    assert transfers(controller, before) == []  # programs call flush() after anything


def test_lost_items_are_asked_for_again() -> None:
    with connected(HOME, FIRST, SECOND, THIRD) as (controller, vehicle):
        controller.missions.lost = {0: 1, 2: 1}
        vehicle.commands.download()
        assert vehicle.commands.wait_ready(timeout=LIMIT_S)
        assert len(vehicle.commands) == 3


@pytest.mark.parametrize(("autopilot", "items"), [(3, [HOME]), (3, []), (12, [])])
def test_empty_missions_are_complete_at_once(autopilot: int, items: list[Item]) -> None:
    with connected(*items, autopilot=autopilot) as (_, vehicle):
        vehicle.commands.download()
        assert vehicle.wait_ready("commands", timeout=LIMIT_S)
        assert len(vehicle.commands) == 0


def test_a_download_that_fails_says_why_and_the_next_one_works(
    empty: tuple[FlightController, CommandSequence], caplog: pytest.LogCaptureFixture
) -> None:
    controller, cmds = empty
    answer = controller.missions.answers["MISSION_REQUEST_LIST"]
    controller.answers["MISSION_REQUEST_LIST"] = lambda frame: controller.tell(
        "MISSION_ACK", type=1, target_system=frame.system, target_component=frame.component
    )
    cmds.download()
    with pytest.raises(APIException, match=r"could not be downloaded: .*refused"):
        cmds.wait_ready(timeout=LIMIT_S)
    assert not cmds.wait_ready(timeout=LIMIT_S, raise_exception=False)
    with pytest.raises(APIException, match=r"download\(\) again, or clear\(\)"):
        cmds.add(waypoint())
    assert [each.name for each in caplog.records if each.levelno >= logging.WARNING] == ["dronekit"]
    cmds.clear()
    assert cmds.wait_ready(timeout=0)
    cmds.add(waypoint())
    controller.answers["MISSION_REQUEST_LIST"] = answer
    cmds.download()
    assert cmds.wait_ready(timeout=LIMIT_S)
    assert [each.z for each in cmds] == [20.0]


def test_what_is_changed_after_download_comes_after_it(
    empty: tuple[FlightController, CommandSequence],
) -> None:
    _, cmds = empty
    cmds.download()
    cmds.add(waypoint())
    assert [each.z for each in cmds] == [20.0, 30]
    cmds.download()
    cmds.clear()
    assert cmds.wait_ready(timeout=LIMIT_S)
    assert len(cmds) == 0


def test_a_download_under_way_is_begun_anew(empty: tuple[FlightController, CommandSequence]) -> None:
    controller, cmds = empty
    controller.missions.lost = {1: 2}
    told: list[int] = []
    cmds._vehicle.add_attribute_listener("commands", lambda _, __, value: told.append(len(value)))
    for _ in range(5):
        cmds.download()
    assert cmds.wait_ready(timeout=LIMIT_S)
    cmds._vehicle._handler.listener_thread.call(lambda: None)
    assert (len(cmds), told) == (1, [1])


def test_blocking_calls_work_in_a_listener(empty: tuple[FlightController, CommandSequence]) -> None:
    controller, cmds = empty
    seen: list[Any] = []
    ended = threading.Event()

    def listener(vehicle: Any, _: str, commands: CommandSequence) -> None:
        vehicle.remove_attribute_listener("commands", listener)
        commands.add(waypoint())
        commands.upload(timeout=LIMIT_S)
        commands.download()
        seen.extend([commands is cmds, commands.wait_ready(timeout=LIMIT_S), len(commands)])
        ended.set()

    cmds._vehicle.add_attribute_listener("commands", listener)
    cmds.download()
    assert ended.wait(LIMIT_S)
    assert seen == [True, True, 2]
    assert kept(controller)[1:] == [(16, -35.5, 20.0), (16, -35.5, 30.0)]


# --------------------------------------------------------------------------------------- upload


def test_the_vehicle_gets_exactly_what_was_added_without_a_download_before(
    empty: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = empty
    cmds.clear()
    for cmd in (waypoint(command=TAKE_OFF), waypoint(-35.6), waypoint(-35.7)):
        cmds.add(cmd)
    cmds.upload()
    assert kept(controller)[1:] == [(22, -35.5, 30.0), (16, -35.6, 30.0), (16, -35.7, 30.0)]
    assert [each.command for each in cmds] == [22, 16, 16]
    assert {frame.name for frame in controller.received("MISSION_ITEM", "MISSION_ITEM_INT")} == {
        "MISSION_ITEM_INT"
    }


def test_add_copies_and_counts_and_writes_the_target_into_what_it_is_given(
    three: tuple[FlightController, CommandSequence],
) -> None:
    _, cmds = three
    cmd = waypoint()
    cmds.add(cmd)
    assert (cmds[3] is cmd, cmds[3].seq, cmd.seq) == (False, 4, 0)
    assert (cmd.target_system, cmds[3].target_system) == (1, 1)
    with pytest.raises(TypeError, match="None is not allowed: a Command"):
        cmds.add(None)


def test_messages_of_pymavlink_can_be_added(empty: tuple[FlightController, CommandSequence]) -> None:
    _, cmds = empty
    content = (0, 0, 0, 3, 16, 0, 1, 0, 0, 0, 0)
    cmds.add(mavlink_1.MAVLink_mission_item_message(*content, -35.5, 149.25, 30))
    cmds.add(mavlink.MAVLink_mission_item_int_message(*content, -355000000, 1492500000, 30))
    assert [(type(each), each.x, each.y) for each in cmds] == [(Command, -35.5, 149.25)] * 2


def test_what_is_edited_in_place_or_assigned_is_uploaded(
    three: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = three
    before = controller.mark()
    cmds.upload()
    assert transfers(controller, before) == []
    cmds[0].z = 77
    cmds.upload()
    assert [each.z for each in controller.missions.items[1:]] == [77, 21, 22]
    cmds[1] = replaced = waypoint()
    cmds[3] = waypoint(-35.9)  # appended, as DroneKit does
    cmds.upload()
    assert (cmds[1] is replaced, replaced.seq, cmds[3].seq) == (True, 2, 4)
    assert [each.z for each in controller.missions.items[1:]] == [77, 30, 22, 30]
    with pytest.raises(IndexError, match=r"^Index 9 out of range.$"):
        cmds[9] = waypoint()
    with pytest.raises(TypeError):
        cmds[0] = 5


def test_a_refusal_is_raised_with_its_reason_and_what_was_to_be_uploaded_is_kept(
    three: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = three
    cmds[0].z = 77
    controller.missions.result = 4
    with pytest.raises(APIException, match="refused") as caught:
        cmds.upload()
    assert type(caught.value) is APIException
    cmds[0].z = 20.0  # as before: the vehicle may hold a part of it nevertheless
    before = controller.mark()
    controller.missions.result = 0
    cmds.upload()
    assert "MISSION_COUNT" in transfers(controller, before)
    assert len(cmds) == 3


def test_a_vehicle_that_does_not_answer_is_a_timeout_and_the_next_upload_works(
    three: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = three
    cmds.clear()
    cmds.add(waypoint())
    controller.missions.is_mute = True
    with pytest.raises(TimeoutError):
        cmds.upload(timeout=0.3)
    controller.missions.is_mute = False
    cmds.upload(timeout=LIMIT_S)
    assert kept(controller)[1:] == [(16, -35.5, 30.0)]


def test_an_emptied_mission_is_emptied_on_the_vehicle(
    three: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = three
    cmds.clear()
    assert len(controller.missions.items) == 4
    cmds.upload()
    assert len(controller.missions.items) <= 1


def test_what_cannot_be_right_is_told_before_anything_is_sent(
    three: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = three
    before = controller.mark()
    wrong: dict[str, Any] = {"x": 91.0, "y": "east", "param1": None, "frame": 99, "command": "go"}
    told = ("latitude", "could not convert", "NoneType", "MAV_FRAME", "invalid literal")
    for (field, value), text in zip(wrong.items(), told, strict=True):
        cmds[0] = waypoint(**{field: value})
        with pytest.raises(LocalProtocolError, match=text):
            cmds.upload()
    assert transfers(controller, before) == []


def test_places_go_out_in_full_precision_in_every_frame(
    empty: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = empty
    frames = [0, 3, 10, 5, 6, 11]
    for frame in frames:
        cmds.add(waypoint(-35.12345675, frame, y=149.7654321, z=30))
    cmds.upload()
    sent = controller.received("MISSION_ITEM_INT")[-6:]
    assert [(each.x, each.y, each.frame) for each in sent] == [
        (-351234568, 1497654321, frame) for frame in frames
    ]
    cmds.download()
    cmds.wait_ready()
    assert {(each.x, each.y) for each in cmds} == {(-35.1234568, 149.7654321)}
    assert [each.frame for each in cmds] == [0, 3, 10, 0, 3, 10]


def test_numbers_that_are_no_places(empty: tuple[FlightController, CommandSequence]) -> None:
    controller, cmds = empty
    cmds.add(waypoint(frame=1, x=1.5, y=-2.00005, param4=math.nan))
    cmds.add(waypoint(command=JUMP, param1=1, param2=3, x=0, y=0, z=0))
    cmds.add(waypoint(command=RETURN, x=0, y=149.25, z=11))  # ArduPilot cuts it off, and does not use it
    cmds.upload()
    sent = controller.received("MISSION_ITEM_INT")[-3:]
    assert [(frame.x, frame.y) for frame in sent] == [(15000, -20000), (0, 0), (0, 149)]
    assert math.isnan(sent[0].param4)
    assert sent[1].param1 == 1  # home is 0


def test_jumps_come_back_as_they_were_written(three: tuple[FlightController, CommandSequence]) -> None:
    _, cmds = three
    cmds.add(waypoint(command=JUMP, param1=2, param2=3, x=0, y=0, z=0))
    cmds.upload()
    cmds.download()
    cmds.wait_ready()
    assert (cmds[3].command, cmds[3].param1, cmds[3].param2) == (JUMP, 2, 3)


# ----------------------------------------------------------------------------- home as first row


def test_the_home_row_of_a_waypoint_file_is_not_flown_to(
    three: tuple[FlightController, CommandSequence],
) -> None:
    controller, cmds = three
    for row in (
        waypoint(-35.3, 0, current=1, z=584),  # any home, from a file of a ground station
        waypoint(0, 0, y=0, z=0),  # not known
        waypoint(-35.36327, 0, y=149.16524, z=584.09),  # this one
    ):
        cmds.clear()
        for cmd in (row, waypoint(), waypoint(-35.7)):
            cmds.add(cmd)
        assert ([each.x for each in cmds], [each.seq for each in cmds]) == ([-35.5, -35.7], [1, 2])
    cmds.upload()
    assert kept(controller)[1:] == [(16, -35.5, 30.0), (16, -35.7, 30.0)]


def test_other_first_commands_are_commands(three: tuple[FlightController, CommandSequence]) -> None:
    _, cmds = three
    for cmd in (
        waypoint(-35.3, 3, current=1),
        waypoint(-35.3, 0, z=584),
        waypoint(0, 3, y=0, z=0),
        waypoint(-35.36327, 0, y=149.16524, z=604),
        waypoint(-35.3, 0, command=TAKE_OFF, current=1),
        waypoint(-35.3, 0, x="south"),
    ):
        cmds.clear()
        cmds.add(cmd)
        assert len(cmds) == 1


# ---------------------------------------------------------------------------------------- next


def next_becomes(cmds: CommandSequence, number: int, tell: Callable[[], None]) -> bool:
    tried = threading.Event()
    for _ in range(int(LIMIT_S / 0.02)):
        tell()
        if cmds.next == number:
            return True
        tried.wait(0.02)
    return False


def test_next_is_told_and_chosen(three: tuple[FlightController, CommandSequence]) -> None:
    controller, cmds = three
    cmds.next = 2
    assert controller.wait_for("MISSION_SET_CURRENT").seq == 2
    assert next_becomes(cmds, 2, lambda: None)
    assert next_becomes(cmds, 3, lambda: controller.tell("MISSION_CURRENT", seq=3))
    with pytest.raises(LocalProtocolError, match="next = -1"):
        cmds.next = -1
    with pytest.raises(TypeError):
        cmds.next = "x"  # type: ignore[assignment]


def test_next_is_chosen_by_command_where_the_message_is_not_heard(
    three: tuple[FlightController, CommandSequence], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aerokit.dronekit.current_command.CONFIRMED_S", 0.3)
    controller, cmds = three
    controller.answers["MISSION_SET_CURRENT"] = lambda frame: None
    cmds.next = 2
    assert controller.wait_for_command(224).param1 == 2


# ---------------------------------------------------------------------------------------- PX4


def test_px4_hides_nothing_and_counts_alike(px4: tuple[FlightController, Vehicle]) -> None:
    controller, vehicle = px4
    cmds = vehicle.commands
    cmds.download()
    cmds.wait_ready()
    assert [(each.seq, each.z) for each in cmds] == [(1, 20.0), (2, 21.0)]
    assert (vehicle._wploader.count(), vehicle._wploader.wp(1).z) == (3, 20.0)
    cmds.next = 2
    assert controller.wait_for("MISSION_SET_CURRENT").seq == 1
    assert next_becomes(cmds, 2, lambda: None)


def test_on_px4_next_is_0_unless_it_flies_as_on_ardupilot(px4: tuple[FlightController, Vehicle]) -> None:
    controller, vehicle = px4
    cmds = vehicle.commands

    def tell(**fields: int) -> Callable[[], None]:
        told: dict[str, Any] = {"total": 2, "mission_state": 3, **fields}
        return lambda: controller.tell("MISSION_CURRENT", **told)

    assert next_becomes(cmds, 2, tell(seq=1))
    assert next_becomes(cmds, 0, tell(seq=0))
    cmds.next = 1
    assert next_becomes(cmds, 1, lambda: None)
    assert next_becomes(cmds, 0, tell(seq=1, mission_state=5))
    assert next_becomes(cmds, 2, tell(seq=1))
    assert next_becomes(cmds, 0, tell(seq=1, total=65535))
    controller.base_mode |= 128
    controller.beat()
    assert next_becomes(cmds, 1, tell(seq=0))


def test_px4_is_given_what_ardupilot_works_out_by_itself(px4: tuple[FlightController, Vehicle]) -> None:
    controller, vehicle = px4
    controller.tell("GLOBAL_POSITION_INT", lat=470000000, lon=85000000, alt=500000)
    controller.tell("GPS_RAW_INT", fix_type=3, lat=470000000, lon=85000000)
    vehicle.wait_ready("location", timeout=LIMIT_S)
    for cmd in (
        waypoint(0, command=TAKE_OFF, y=0),
        waypoint(command=SPEED, param1=1, param2=5, x=0, y=0, z=0),
        waypoint(47.1, y=8.6),
        waypoint(0, command=21, y=0, z=0),
    ):
        cmd.autocontinue = 1
        vehicle.commands.add(cmd)
    vehicle.commands.upload()
    assert [(each.command, each.frame, each.x, each.y) for each in controller.missions.items] == [
        (TAKE_OFF, 3, 47.0, 8.5),
        (SPEED, 2, 0, 0),
        (16, 3, 47.1, 8.6),
        (21, 3, 47.1, 8.6),
    ]


# ------------------------------------------------------------------------------------ the rest


def test_the_waypoint_loader_counts_home(three: tuple[FlightController, CommandSequence]) -> None:
    _, cmds = three
    loader = cmds._vehicle._wploader
    assert (loader.count(), loader.wp(0).z, loader.wp(3).z) == (4, 584.0, 22.0)
    with pytest.raises(IndexError):
        loader.wp(4)
    cmds.clear()
    assert loader.count() == 1


def test_threads_that_add_at_once_lose_nothing(empty: tuple[FlightController, CommandSequence]) -> None:
    _, cmds = empty
    cmds.clear()

    def add() -> None:
        for _ in range(50):
            cmds.add(waypoint())

    threads = [threading.Thread(target=add) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [each.seq for each in cmds] == list(range(1, 201))


def test_a_closed_vehicle_says_so() -> None:
    with connected(HOME) as (_, vehicle):
        cmds = vehicle.commands
        cmds.add(waypoint())
    for call in (cmds.upload, cmds.download, lambda: setattr(cmds, "next", 1)):
        with pytest.raises(APIException, match="closed"):
            call()
    cmds.clear()
    assert len(cmds) == 0
