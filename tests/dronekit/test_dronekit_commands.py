"""``vehicle.commands``: a list between download and upload."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from flight_controller_services import Item
from mission_stage import FIRST, HOME, LIMIT_S, SECOND, THIRD, Pair, connected, kept, transfers, waypoint
from pymavlink.dialects.v10 import all as mavlink_1
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from aerokit.dronekit.commands import Command, CommandSequence
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name

TAKE_OFF = 22


@pytest.fixture
def three() -> Iterator[Pair]:
    """A vehicle with home and three waypoints, downloaded."""
    with connected(HOME, FIRST, SECOND, THIRD) as (controller, vehicle):
        vehicle.commands.download()
        assert vehicle.commands.wait_ready()
        yield controller, vehicle.commands


@pytest.fixture
def empty() -> Iterator[Pair]:
    """A vehicle nothing is known of."""
    with connected(HOME, FIRST) as (controller, vehicle):
        yield controller, vehicle.commands


# -------------------------------------------------------------------------------------- Command


def test_command_is_pymavlink_mission_item_with_mavlink_1_text() -> None:
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


def test_downloaded_commands_are_counted_without_home(
    three: Pair,
) -> None:
    _, cmds = three
    first = cmds[0]
    assert isinstance(first, Command)
    assert (len(cmds), cmds.count, [command.seq for command in cmds]) == (3, 3, [1, 2, 3])
    assert (first.x, first.y, first.z, first.frame, first.autocontinue) == (-35.5, 149.25, 20.0, 3, 1)
    assert (first.target_system, first.target_component) == (255, 0)
    vehicle: Any = cmds._vehicle
    assert str(vehicle.home_location) == "LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0"


def test_commands_work_like_a_list(three: Pair) -> None:
    _, cmds = three
    assert [command.seq for command in cmds[0:2]] == [1, 2]
    assert [command.seq for command in cmds[-2:]] == [2, 3]
    assert type(cmds[:]) is list
    assert cmds[-1].seq == 3
    assert cmds[2] in cmds
    for index in (3, -4):
        with pytest.raises(IndexError, match=f"^Index {index} out of range.$"):
            cmds[index]
    with pytest.raises(TypeError, match=r"^Invalid argument type.$"):
        cmds["a"]  # type: ignore[call-overload]


def test_commands_before_download_are_empty(
    empty: Pair,
) -> None:
    controller, cmds = empty
    before = controller.mark()
    assert (len(cmds), list(cmds), cmds.next, cmds.wait_ready(timeout=0)) == (0, [], 0, True)
    with pytest.raises(IndexError, match=r"^Index 0 out of range.$"):
        cmds[0]
    cmds.upload()
    vehicle: Any = cmds._vehicle
    vehicle.flush()
    assert transfers(controller, before) == []  # programs call flush() after anything


def test_lost_mission_items_are_requested_again() -> None:
    with connected(HOME, FIRST, SECOND, THIRD) as (controller, vehicle):
        controller.missions.lost = {0: 1, 2: 1}
        vehicle.commands.download()
        assert vehicle.commands.wait_ready(timeout=LIMIT_S)
        assert len(vehicle.commands) == 3


@pytest.mark.parametrize(("autopilot", "items"), [(3, [HOME]), (3, []), (12, [])])
def test_empty_mission_download_completes(autopilot: int, items: list[Item]) -> None:
    with connected(*items, autopilot=autopilot) as (_, vehicle):
        vehicle.commands.download()
        assert vehicle.wait_ready("commands", timeout=LIMIT_S)
        assert len(vehicle.commands) == 0


def test_failed_download_raises_reason_and_can_be_repeated(empty: Pair, caplog: pytest.LogCaptureFixture) -> None:
    controller, cmds = empty
    answer = controller.missions.answers["MISSION_REQUEST_LIST"]
    controller.answers["MISSION_REQUEST_LIST"] = lambda frame: controller.report(
        "MISSION_ACK", type=1, target_system=frame.system, target_component=frame.component
    )
    cmds.download()
    with pytest.raises(APIException, match=r"could not be downloaded: .*refused"):
        cmds.wait_ready(timeout=LIMIT_S)
    assert not cmds.wait_ready(timeout=LIMIT_S, raise_exception=False)
    with pytest.raises(APIException, match=r"download\(\) again, or clear\(\)"):
        cmds.add(waypoint())
    assert [record.name for record in caplog.records if record.levelno >= logging.WARNING] == ["dronekit"]
    cmds.clear()
    assert cmds.wait_ready(timeout=0)
    cmds.add(waypoint())
    controller.answers["MISSION_REQUEST_LIST"] = answer
    cmds.download()
    assert cmds.wait_ready(timeout=LIMIT_S)
    assert [command.z for command in cmds] == [20.0]


def test_changes_after_download_wait_for_it(
    empty: Pair,
) -> None:
    _, cmds = empty
    cmds.download()
    cmds.add(waypoint())
    assert [command.z for command in cmds] == [20.0, 30]
    cmds.download()
    cmds.clear()
    assert cmds.wait_ready(timeout=LIMIT_S)
    assert len(cmds) == 0


def test_running_download_is_restarted(empty: Pair) -> None:
    controller, cmds = empty
    controller.missions.lost = {1: 2}
    notified: list[int] = []
    cmds._vehicle.add_attribute_listener("commands", lambda _, __, value: notified.append(len(value)))
    for _ in range(5):
        cmds.download()
    assert cmds.wait_ready(timeout=LIMIT_S)
    cmds._vehicle._handler.loop.call(lambda: None)  # wait_ready() may return before the loop has notified the listener.
    cmds._vehicle._handler.listener_thread.call(lambda: None)
    assert (len(cmds), notified) == (1, [1])


def test_blocking_calls_work_in_listener(empty: Pair) -> None:
    controller, cmds = empty
    observed: list[Any] = []
    ended = threading.Event()

    def listener(vehicle: Any, _: str, commands: CommandSequence) -> None:
        vehicle.remove_attribute_listener("commands", listener)
        commands.add(waypoint())
        commands.upload(timeout=LIMIT_S)
        commands.download()
        observed.extend([commands is cmds, commands.wait_ready(timeout=LIMIT_S), len(commands)])
        ended.set()

    cmds._vehicle.add_attribute_listener("commands", listener)
    cmds.download()
    assert ended.wait(LIMIT_S)
    assert observed == [True, True, 2]
    assert kept(controller)[1:] == [(16, -35.5, 20.0), (16, -35.5, 30.0)]


# --------------------------------------------------------------------------------------- upload


def test_upload_without_download_sends_added_commands(
    empty: Pair,
) -> None:
    controller, cmds = empty
    cmds.clear()
    for cmd in (waypoint(command=TAKE_OFF), waypoint(-35.6), waypoint(-35.7)):
        cmds.add(cmd)
    cmds.upload()
    assert kept(controller)[1:] == [(22, -35.5, 30.0), (16, -35.6, 30.0), (16, -35.7, 30.0)]
    assert [command.command for command in cmds] == [22, 16, 16]
    assert {frame.name for frame in controller.received("MISSION_ITEM", "MISSION_ITEM_INT")} == {"MISSION_ITEM_INT"}


def test_add_copies_command_and_sets_target(
    three: Pair,
) -> None:
    _, cmds = three
    cmd = waypoint()
    cmds.add(cmd)
    assert (cmds[3] is cmd, cmds[3].seq, cmd.seq) == (False, 4, 0)
    assert (cmd.target_system, cmds[3].target_system) == (1, 1)
    with pytest.raises(TypeError, match="None is not a Command"):
        cmds.add(None)


def test_add_accepts_pymavlink_messages(empty: Pair) -> None:
    _, cmds = empty
    content = (0, 0, 0, 3, 16, 0, 1, 0, 0, 0, 0)
    cmds.add(mavlink_1.MAVLink_mission_item_message(*content, -35.5, 149.25, 30))
    cmds.add(mavlink.MAVLink_mission_item_int_message(*content, -355000000, 1492500000, 30))
    assert [(type(command), command.x, command.y) for command in cmds] == [(Command, -35.5, 149.25)] * 2


def test_edited_and_assigned_commands_are_uploaded(
    three: Pair,
) -> None:
    controller, cmds = three
    before = controller.mark()
    cmds.upload()
    assert transfers(controller, before) == []
    cmds[0].z = 77
    cmds.upload()
    assert [item.z for item in controller.missions.items[1:]] == [77, 21, 22]
    cmds[1] = replaced = waypoint()
    cmds[3] = waypoint(-35.9)  # appended, as DroneKit does
    cmds.upload()
    assert (cmds[1] is replaced, replaced.seq, cmds[3].seq) == (True, 2, 4)
    assert [item.z for item in controller.missions.items[1:]] == [77, 30, 22, 30]
    with pytest.raises(IndexError, match=r"^Index 9 out of range.$"):
        cmds[9] = waypoint()
    with pytest.raises(TypeError):
        cmds[0] = 5


def test_rejected_upload_raises_reason_and_keeps_commands(
    three: Pair,
) -> None:
    controller, cmds = three
    cmds[0].z = 77
    controller.missions.result = 4
    with pytest.raises(APIException, match="refused") as caught:
        cmds.upload()
    assert type(caught.value) is APIException
    cmds[0].z = 20.0  # as before; the vehicle may have stored a part of it
    before = controller.mark()
    controller.missions.result = 0
    cmds.upload()
    assert "MISSION_COUNT" in transfers(controller, before)
    assert len(cmds) == 3


def test_unanswered_upload_raises_timeout_and_can_be_repeated(
    three: Pair,
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


def test_cleared_mission_is_cleared_on_vehicle(
    three: Pair,
) -> None:
    controller, cmds = three
    cmds.clear()
    assert len(controller.missions.items) == 4
    cmds.upload()
    assert len(controller.missions.items) <= 1


# ------------------------------------------------------------------------------------ the rest


def test_add_from_several_threads_keeps_all_commands(empty: Pair) -> None:
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
    assert [command.seq for command in cmds] == list(range(1, 201))


def test_commands_of_closed_vehicle_raise() -> None:
    with connected(HOME) as (_, vehicle):
        cmds = vehicle.commands
        cmds.add(waypoint())
    for call in (cmds.upload, cmds.download, lambda: setattr(cmds, "next", 1)):
        with pytest.raises(APIException, match="closed"):
            call()
    cmds.clear()
    assert len(cmds) == 0
