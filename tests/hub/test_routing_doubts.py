"""Vehicles reachable at several ports: messages for them use one port, regardless of other components there."""

from __future__ import annotations

import pytest
from test_routing import CAMERA, COPTER, STATION, Stage, order

from aerokit.connection.routes import MAX_ROUTES, ROUTE_TIMEOUT_S
from aerokit.hub.senders import REPEAT_WINDOW_S
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.messages import Attitude, Heartbeat, LandingTarget, ParamRequestList


def vehicle_and_camera() -> Stage:
    """Vehicle and camera are received at ports a and b, in a different order."""
    stage = Stage()
    stage.receive("a", COPTER)
    stage.receive("b", CAMERA, 1, 100)
    for _ in range(2):  # the first is like the other port's: a copy
        stage.receive("b", COPTER)
        stage.receive("a", CAMERA, 1, 100)
    stage.receive("c", STATION, 255, 190)
    return stage


def test_system_message_goes_to_its_autopilot_once() -> None:
    stage = vehicle_and_camera()
    assert stage.receive("c", order(1, 0), 255, 190) == {"a"}
    assert stage.receive("c", order(1, 1), 255, 190) == {"a"}
    assert stage.receive("c", order(1, 100), 255, 190) == {"b"}
    assert len(stage.receive("c", order(1, 77), 255, 190)) == 1, "for an unknown component"


def test_system_message_follows_a_moved_autopilot() -> None:
    stage = Stage()
    for port in "ab":
        stage.receive(port, COPTER)
        stage.receive(port, CAMERA, 1, 100)
    stage.receive("c", STATION, 255, 190)
    stage.now += 1.0
    stage.receive("a", CAMERA, 1, 100)
    stage.now += ROUTE_TIMEOUT_S - 0.5
    stage.receive("b", COPTER)
    stage.receive("b", CAMERA, 1, 100)
    assert stage.receive("c", order(1, 1), 255, 190) == {"b"}
    assert stage.receive("c", order(1, 0), 255, 190) == {"b"}


def test_camera_at_own_port_gets_system_messages() -> None:
    stage = Stage()
    stage.receive("a", COPTER)
    stage.receive("b", CAMERA, 1, 100)
    stage.receive("c", STATION, 255, 190)
    assert stage.receive("c", order(1, 0), 255, 190) == {"a", "b"}


def test_returning_port_is_used_again() -> None:
    """The vehicle was last received there long ago; the camera is reached there until the vehicle returns."""
    stage = Stage()
    stage.receive("b", COPTER)
    stage.receive("a", COPTER)
    stage.now += ROUTE_TIMEOUT_S + 1
    stage.receive("a", COPTER)
    stage.now += ROUTE_TIMEOUT_S + 1
    stage.receive("a", COPTER)
    stage.receive("b", CAMERA, 1, 100)
    stage.receive("c", STATION, 255, 190)
    assert stage.receive("c", order(1, 0), 255, 190) == {"a", "b"}
    stage.receive("b", COPTER)
    assert stage.receive("c", order(1, 0), 255, 190) == {"a"}


def test_broadcast_order_reaches_a_vehicle_once() -> None:
    stage = vehicle_and_camera()
    assert stage.receive("c", order(0, 0), 255, 190) == {"a", "d"}
    assert stage.receive("c", ParamRequestList(0, 0), 255, 190) == {"a", "b", "d"}, "it is not a command"
    assert stage.receive("c", STATION, 255, 190) == {"a", "b", "d"}
    stage.now += ROUTE_TIMEOUT_S + 1
    stage.receive("b", COPTER)
    assert stage.receive("c", order(0, 0), 255, 190) >= {"b"}, "it is reached there now"


def test_landing_target_reaches_a_vehicle_once() -> None:
    stage = vehicle_and_camera()
    stage.receive("c", STATION, 255, 190)
    assert stage.receive("c", LandingTarget(0, 0, 0, 0.1, 0.1, 5.0, 0, 0), 255, 190) == {"a", "d"}


def test_broadcast_command_of_vehicle_does_not_return_by_second_radio() -> None:
    stage = vehicle_and_camera()
    stage.receive("b", COPTER)
    assert stage.receive("a", order(0, 0)) == {"c", "d"}
    assert stage.receive("b", order(0, 0)) == {"c", "d"}


def test_forged_senders_do_not_evict_a_gimbal() -> None:
    stage = Stage()
    stage.receive("a", Heartbeat(26, 8, 0, 0, 3), 77, 154)
    stage.receive("c", STATION, 255, 190)
    stage.now += 0.1
    for number in range(MAX_ROUTES + 100):
        stage.receive("b", Attitude(0, 0, 0, 0, 0, 0, 0), 2 + number % 240, 1 + number // 240)
    assert stage.receive("c", order(77, 154), 255, 190) == {"a"}


FIRST_ORDER = FrameEncoder(255, 190).encode(order(1))
"""First order of a program; its sequence numbers start at 0, like those of an earlier program."""


def test_first_order_at_a_new_port_is_no_copy() -> None:
    """Several scripts run one after another and send the same order: the vehicle must receive the last one too."""
    stage = Stage()
    stage.receive("a", COPTER)
    assert stage.pass_on("c", FIRST_ORDER) == {"a"}
    for name in ("e", "f"):  # a client of TCP, a new port of UDP
        stage.now += 0.2
        stage.nodes[name] = stage.router.add(name)
        assert stage.pass_on(name, FIRST_ORDER) == {"a"}


@pytest.mark.parametrize("component", [0, 1])
def test_order_before_the_first_heartbeat_takes_one_path(component: int) -> None:
    """A hub starts beside a vehicle with two radios, whose first frames are no HEARTBEATs."""
    stage = Stage()
    for port in "abb":  # the first one at port b is a copy
        stage.receive(port, Attitude(0, 0, 0, 0, 0, 0, 0))
        stage.receive(port, Attitude(0, 0, 0, 0, 0, 0, 0), 1, 100)
    assert stage.receive("c", order(1, component), 255, 190) == {"a"}
    stage.receive("a", COPTER)
    assert stage.receive("c", order(1, component), 255, 190) == {"a"}


def test_stations_without_heartbeats_that_share_ids_all_receive() -> None:
    stage = Stage()
    for _ in range(5):
        stage.now += 1.0
        for port, message in (("b", ParamRequestList(1, 1)), ("c", order(1))):
            stage.receive(port, message, 255, 0)
    assert stage.receive("a", order(255, 0)) == {"b", "c"}


def test_copy_that_creates_its_port_is_dropped() -> None:
    """A station sends over two links; the port of the second link is made by the copy of an order."""
    stage = Stage()
    stage.receive("a", COPTER)
    assert stage.pass_on("c", FIRST_ORDER) == {"a"}
    stage.now += 0.05
    stage.nodes["e"] = stage.router.add("e")
    assert stage.pass_on("e", FIRST_ORDER) == set()
    assert stage.reason == "duplicate"


def test_first_order_after_port_removal_is_no_copy() -> None:
    stage = Stage()
    stage.receive("a", COPTER)
    assert stage.pass_on("c", FIRST_ORDER) == {"a"}
    assert stage.pass_on("d", FIRST_ORDER) == set(), "over another route that existed"
    stage.router.remove(stage.nodes.pop("c"))
    stage.now += 0.1
    assert stage.pass_on("d", FIRST_ORDER) == {"a"}


def test_first_order_at_same_port_later_is_no_copy() -> None:
    stage = Stage()
    stage.receive("a", COPTER)
    assert stage.pass_on("c", FIRST_ORDER) == {"a"}
    stage.now += REPEAT_WINDOW_S / 2
    assert stage.pass_on("c", FIRST_ORDER, is_out_of_order=True) == set(), "duplicated by the network"
    stage.now += REPEAT_WINDOW_S
    assert stage.pass_on("c", FIRST_ORDER, is_out_of_order=True) == {"a"}


@pytest.mark.parametrize("component", [0, 1])
def test_vehicle_on_two_links_does_not_get_own_order(component: int) -> None:
    """PX4 announces failsafes as commands to its whole system; a camera at another port receives them."""
    stage = Stage()
    stage.receive("a", COPTER)
    stage.receive("b", COPTER)  # like the other port's: a copy
    stage.receive("b", COPTER)
    stage.receive("c", CAMERA, 1, 100)
    assert stage.receive("b", order(1, component)) == ({"c"} if component == 0 else set())
    assert stage.receive("d", order(1, component), 255, 190) >= {"a"}
