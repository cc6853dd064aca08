"""Missions on the vehicle: items, home, jumps and the current command, on ArduPilot and PX4."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from flight_controller import FlightController
from mission_stage import FIRST, HOME, LIMIT_S, SECOND, THIRD, Pair, connected, kept, transfers, waypoint
from served_copter import served_copter

from aerokit.dronekit.commands import CommandSequence
from aerokit.dronekit.values import LocationGlobal
from aerokit.dronekit.vehicle import Vehicle, connect
from aerokit.errors import InvalidArgument

TAKE_OFF, LAND, RETURN, JUMP, SPEED = 22, 21, 20, 177, 178


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


@pytest.fixture
def px4() -> Iterator[tuple[FlightController, Vehicle]]:
    with connected(FIRST, SECOND, autopilot=12) as pair:
        yield pair


# --------------------------------------------------------------------------------------- items


def test_upload_invalid_commands_sends_nothing(
    three: Pair,
) -> None:
    controller, cmds = three
    before = controller.mark()
    wrong: dict[str, Any] = {"x": 91.0, "y": "east", "param1": None, "frame": 99, "command": "go"}
    notified = ("latitude", "could not convert", "NoneType", "MAV_FRAME", "invalid literal")
    for (field, value), text in zip(wrong.items(), notified, strict=True):
        cmds[0] = waypoint(**{field: value})
        with pytest.raises(InvalidArgument, match=text):
            cmds.upload()
    assert transfers(controller, before) == []


def test_mission_positions_have_full_precision(
    empty: Pair,
) -> None:
    controller, cmds = empty
    frames = [0, 3, 10, 5, 6, 11]
    for frame in frames:
        cmds.add(waypoint(-35.12345675, frame, y=149.7654321, z=30))
    cmds.upload()
    sent = controller.received("MISSION_ITEM_INT")[-6:]
    assert [(message.x, message.y, message.frame) for message in sent] == [
        (-351234568, 1497654321, frame) for frame in frames
    ]
    cmds.download()
    cmds.wait_ready()
    assert {(command.x, command.y) for command in cmds} == {(-35.1234568, 149.7654321)}
    assert [command.frame for command in cmds] == [0, 3, 10, 0, 3, 10]


def test_mission_params_5_and_6_that_are_no_positions(empty: Pair) -> None:
    controller, cmds = empty
    cmds.add(waypoint(frame=1, x=1.5, y=-2.00005, param4=math.nan))
    cmds.add(waypoint(command=JUMP, param1=1, param2=3, x=0, y=0, z=0))
    cmds.add(waypoint(command=RETURN, x=0, y=149.25, z=11))  # ArduPilot drops the fraction of y.
    cmds.upload()
    sent = controller.received("MISSION_ITEM_INT")[-3:]
    assert [(frame.x, frame.y) for frame in sent] == [(15000, -20000), (0, 0), (0, 149)]
    assert math.isnan(sent[0].param4)
    assert sent[1].param1 == 1  # home is 0


def test_mission_jumps_round_trip(three: Pair) -> None:
    _, cmds = three
    cmds.add(waypoint(command=JUMP, param1=2, param2=3, x=0, y=0, z=0))
    cmds.upload()
    cmds.download()
    cmds.wait_ready()
    assert (cmds[3].command, cmds[3].param1, cmds[3].param2) == (JUMP, 2, 3)


# ----------------------------------------------------------------------------- home as first row


def test_home_row_of_waypoint_file_is_not_flown(
    three: Pair,
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
        assert ([command.x for command in cmds], [command.seq for command in cmds]) == ([-35.5, -35.7], [1, 2])
    cmds.upload()
    assert kept(controller)[1:] == [(16, -35.5, 30.0), (16, -35.7, 30.0)]


def test_first_command_that_is_not_home(three: Pair) -> None:
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


def next_becomes(cmds: CommandSequence, number: int, report: Callable[[], None]) -> bool:
    def is_next() -> bool:
        report()
        return cmds.next == number

    return becomes(is_next)


def becomes(is_true: Callable[[], bool]) -> bool:
    tried = threading.Event()
    for _ in range(int(LIMIT_S / 0.02)):
        if is_true():
            return True
        tried.wait(0.02)
    return False


def test_next_is_read_and_set(three: Pair) -> None:
    controller, cmds = three
    cmds.next = 2
    assert controller.wait_for("MISSION_SET_CURRENT").seq == 2
    assert next_becomes(cmds, 2, lambda: None)
    assert next_becomes(cmds, 3, lambda: controller.report("MISSION_CURRENT", seq=3))
    with pytest.raises(InvalidArgument, match="next = -1"):
        cmds.next = -1
    with pytest.raises(TypeError):
        cmds.next = "x"  # type: ignore[assignment]


def test_next_unconfirmed_message_is_followed_by_command(three: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.dronekit.flight_orders.MISSION_CURRENT_TIMEOUT_S", 0.3)
    controller, cmds = three
    controller.answers["MISSION_SET_CURRENT"] = lambda frame: None
    cmds.next = 2
    assert controller.wait_for_command(224).param1 == 2


def test_next_is_not_confirmed_by_older_message(three: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.dronekit.flight_orders.MISSION_CURRENT_TIMEOUT_S", 0.3)
    controller, cmds = three
    controller.answers["MISSION_SET_CURRENT"] = lambda frame: None
    assert next_becomes(cmds, 2, lambda: controller.report("MISSION_CURRENT", seq=2))
    cmds.next = 2
    assert controller.wait_for_command(224).param1 == 2


def test_next_is_not_repeated_while_vehicle_is_silent(
    three: Pair, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("aerokit.dronekit.flight_orders.MISSION_CURRENT_TIMEOUT_S", 0.3)
    monkeypatch.setattr("aerokit.dronekit.flight_orders.MODE_MAX_AGE_S", 0.2)
    controller, cmds = three
    controller.answers["MISSION_SET_CURRENT"] = lambda frame: None
    controller.heartbeat_s = None
    cmds.next = 2
    assert becomes(lambda: "may or may not have set the next command to 2" in caplog.text)
    assert not controller.commands(224)


# ---------------------------------------------------------------------------------------- PX4


def test_mission_px4_indices_match_ardupilot(px4: tuple[FlightController, Vehicle]) -> None:
    controller, vehicle = px4
    cmds = vehicle.commands
    cmds.download()
    cmds.wait_ready()
    assert [(command.seq, command.z) for command in cmds] == [(1, 20.0), (2, 21.0)]
    assert (vehicle._wploader.count(), vehicle._wploader.wp(1).z) == (3, 20.0)
    cmds.next = 2
    assert controller.wait_for("MISSION_SET_CURRENT").seq == 1
    assert next_becomes(cmds, 2, lambda: None)


def test_next_px4_is_0_unless_flying(px4: tuple[FlightController, Vehicle]) -> None:
    controller, vehicle = px4
    cmds = vehicle.commands

    def report(**fields: int) -> Callable[[], None]:
        values: dict[str, Any] = {"total": 2, "mission_state": 3, **fields}
        return lambda: controller.report("MISSION_CURRENT", **values)

    assert next_becomes(cmds, 2, report(seq=1))
    assert next_becomes(cmds, 0, report(seq=0))
    cmds.next = 1
    assert next_becomes(cmds, 1, lambda: None)
    assert next_becomes(cmds, 0, report(seq=1, mission_state=5))
    assert next_becomes(cmds, 2, report(seq=1))
    assert next_becomes(cmds, 0, report(seq=1, total=65535))
    controller.base_mode |= 128
    controller.beat()
    assert next_becomes(cmds, 1, report(seq=0))


def test_mission_px4_gets_explicit_positions(px4: tuple[FlightController, Vehicle]) -> None:
    controller, vehicle = px4
    controller.report("GLOBAL_POSITION_INT", lat=470000000, lon=85000000, alt=500000)
    controller.report("GPS_RAW_INT", fix_type=3, lat=470000000, lon=85000000)
    vehicle.wait_ready("location", timeout=LIMIT_S)
    for cmd in (
        waypoint(0, command=TAKE_OFF, y=0),
        waypoint(command=SPEED, param1=1, param2=5, x=0, y=0, z=0),
        waypoint(47.1, y=8.6),
        waypoint(0, command=LAND, y=0, z=0),
    ):
        cmd.autocontinue = 1
        vehicle.commands.add(cmd)
    vehicle.commands.upload()
    assert [(item.command, item.frame, item.x, item.y) for item in controller.missions.items] == [
        (TAKE_OFF, 3, 47.0, 8.5),
        (SPEED, 2, 0, 0),
        (16, 3, 47.1, 8.6),
        (LAND, 3, 47.1, 8.6),
    ]


# ------------------------------------------------------------------------------------ the rest


def test_waypoint_loader_counts_home(three: Pair) -> None:
    _, cmds = three
    vehicle: Any = cmds._vehicle
    loader = vehicle._wploader
    assert (loader.count(), loader.wp(0).z, loader.wp(3).z) == (4, 584.0, 22.0)
    with pytest.raises(IndexError):
        loader.wp(4)
    cmds.clear()
    assert loader.count() == 1


# -------------------------------------------------------------------------- the simulated copter


def test_long_mission_round_trip() -> None:
    with served_copter() as address, connect(address, rate=None) as vehicle:
        cmds = vehicle.commands
        cmds.clear()
        cmds.add(waypoint(0, command=TAKE_OFF, y=0))
        for number in range(100):
            cmds.add(waypoint(round(-35.3 + number * 1e-7, 7), (0, 3, 10)[number % 3]))
        cmds.add(waypoint(command=SPEED, param1=1, param2=5, x=0, y=0, z=0))
        cmds.add(waypoint(command=JUMP, param1=2, param2=3, x=0, y=0, z=0))
        written = [(command.command, command.x, command.param1, command.seq) for command in cmds]
        cmds.upload(timeout=LIMIT_S)
        cmds.download()
        assert cmds.wait_ready(timeout=LIMIT_S)
        assert [(command.command, command.x, command.param1, command.seq) for command in cmds] == written
        cmds[50].z = 77
        cmds.upload(timeout=LIMIT_S)
        cmds.download()
        assert cmds.wait_ready(timeout=LIMIT_S)
        assert [command.seq for command in cmds if command.z == 77] == [51]
        assert str(vehicle.home_location).startswith("LocationGlobal:lat=-35.36326")


def test_mission_float_vehicle_keeps_precision() -> None:
    with connected(HOME, FIRST, version=1, capabilities=1) as (controller, vehicle):
        controller.missions.asks_int = False
        for latitude, longitude in ((-34.3, 149.1662345), (47.3977419, -178.545594)):
            vehicle.commands.clear()
            vehicle.commands.add(waypoint(latitude, y=longitude))
            vehicle.commands.upload(timeout=LIMIT_S)
        assert not controller.received("MISSION_ITEM_INT")
        vehicle.commands.download()
        vehicle.commands.wait_ready()
        assert vehicle.commands[0].x == pytest.approx(47.3977419, abs=4e-6)


def test_rejected_home_location_is_restored() -> None:
    with connected(HOME, FIRST) as (controller, vehicle):
        vehicle.wait_ready("home_location", timeout=LIMIT_S)
        before = str(vehicle.home_location)
        controller.results[179] = 4
        vehicle.home_location = LocationGlobal(10, 20, 30)
        vehicle.wait_for(lambda: str(vehicle.home_location) == before, timeout=LIMIT_S, interval=0.01)


def test_rejected_home_location_restores_accepted_one() -> None:
    """The vehicle has the accepted home, although it did not report it."""
    with connected(HOME, FIRST) as (controller, vehicle):
        vehicle.wait_ready("home_location", timeout=LIMIT_S)
        vehicle.home_location = accepted = LocationGlobal(10, 20, 30.0)
        vehicle._handler.calls.wait(LIMIT_S)
        controller.results[179] = 4
        vehicle.home_location = LocationGlobal(11, 20, 30)
        vehicle.wait_for(lambda: vehicle.home_location.lat != 11, timeout=LIMIT_S, interval=0.01)
        assert str(vehicle.home_location) == str(accepted)


@pytest.mark.parametrize(
    "order",
    [
        lambda vehicle: setattr(vehicle, "home_location", LocationGlobal(10, 20, 1e300)),
        lambda vehicle: vehicle.simple_takeoff(1e300),
        lambda vehicle: setattr(vehicle, "groundspeed", 1e300),
    ],
)
def test_numbers_beyond_32_bit_floats_are_refused(order: Callable[[Any], object]) -> None:
    """They cannot be sent, and home_location would keep the number."""
    with connected(HOME, FIRST) as (_, vehicle):
        vehicle.wait_ready("home_location", timeout=LIMIT_S)
        before = str(vehicle.home_location)
        with pytest.raises(ValueError, match=r"number"):
            order(vehicle)
        assert str(vehicle.home_location) == before


def test_next_without_confirmation_is_sent_once(three: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A message that is not answered could be repeated against a pilot: the order that follows has an answer."""
    monkeypatch.setattr("aerokit.dronekit.flight_orders.MISSION_CURRENT_TIMEOUT_S", 2.5)
    controller, cmds = three
    controller.answers["MISSION_SET_CURRENT"] = lambda frame: None
    cmds.next = 2
    controller.wait_for_command(224)
    assert len(controller.received("MISSION_SET_CURRENT")) == 1
