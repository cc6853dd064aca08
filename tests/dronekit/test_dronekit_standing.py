"""Unanswered orders are repeated, but not after a newer order, a pilot's takeover, or their effect.

The rules by themselves are in tests/vehicle/commanding/test_posted.py.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from flight_controller import FlightController, Received

import aerokit.dronekit as dronekit
from aerokit.dronekit import flight

LOITER = 5
ARM, SET_MODE, REPOSITION = 400, 176, 192
UNSUPPORTED = 3
ARMED = 128
LIMIT_S = 100.0


@pytest.fixture
def copter() -> Iterator[FlightController]:
    with FlightController() as controller:
        yield controller


@pytest.fixture
def vehicle(copter: FlightController) -> Iterator[dronekit.Vehicle]:
    connected = dronekit.connect(copter.address, rate=None)
    yield connected
    connected.close()


def lose_answers(copter: FlightController, *commands: int, does: bool) -> None:
    """The vehicle executes orders, or not, and its answers are lost."""
    answer = copter.answers["COMMAND_LONG"]

    def take(frame: Received) -> Any:
        if frame.command not in commands:
            return answer(frame)
        return copter._do(frame) if does else None

    copter.answers["COMMAND_LONG"] = copter.answers["COMMAND_INT"] = take


def wait_for(is_true: Any) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not is_true():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_confirmed_order_is_not_repeated_against_pilot(copter: FlightController, vehicle: dronekit.Vehicle) -> None:
    lose_answers(copter, ARM, SET_MODE, does=True)
    vehicle.armed = True
    vehicle.mode = "GUIDED"
    wait_for(lambda: vehicle.armed and vehicle.mode == "GUIDED")
    copter.base_mode, copter.custom_mode = copter.base_mode & ~ARMED, LOITER
    copter.beat()
    vehicle._handler.calls.wait(LIMIT_S)
    assert [command.command for command in copter.commands()] == [ARM, SET_MODE]
    assert (vehicle.armed, vehicle.mode.name) == (False, "LOITER")


def test_unanswered_arming_warns_about_late_effect(
    copter: FlightController, vehicle: dronekit.Vehicle, caplog: pytest.LogCaptureFixture
) -> None:
    lose_answers(copter, ARM, does=False)
    vehicle.armed = True
    vehicle._handler.calls.wait(LIMIT_S)
    (record,) = caplog.records
    assert record.message.endswith("; the vehicle may still execute the command, which is not monitored any more")


def test_arming_that_was_not_sent_warns_of_no_late_effect(
    copter: FlightController,
    vehicle: dronekit.Vehicle,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("aerokit.connection.routes.Routes.peers_of", lambda *_: ())  # no link leads to the vehicle
    vehicle.armed = True
    vehicle._handler.calls.wait(LIMIT_S)
    (record,) = caplog.records
    assert "was not sent, because there was no usable link" in record.message
    assert "may still" not in record.message


def test_pilot_takeover_before_order_arrives_is_kept(
    copter: FlightController, vehicle: dronekit.Vehicle, caplog: pytest.LogCaptureFixture
) -> None:
    lose_answers(copter, SET_MODE, REPOSITION, does=False)
    vehicle.simple_goto(dronekit.LocationGlobalRelative(-35.0, 149.0, 20.0))
    vehicle.mode = "GUIDED"
    copter.wait_for_command(SET_MODE)
    copter.custom_mode = LOITER
    copter.beat()
    vehicle._handler.calls.wait(LIMIT_S)
    assert [command.command for command in copter.commands()] == [REPOSITION, SET_MODE]
    ends = sorted(record.message.partition("not sent again: ")[2].partition(";")[0] for record in caplog.records)
    assert ends == ["another order was given", "the mode changed to LOITER"]


def test_disarming_does_not_wait_for_arming(copter: FlightController, vehicle: dronekit.Vehicle) -> None:
    lose_answers(copter, ARM, does=False)
    vehicle.armed = True
    copter.wait_for_command(ARM)
    vehicle.armed = False  # HEARTBEAT reports disarmed, but the arming may still be executed
    copter.wait_for("COMMAND_LONG", lambda frame: frame.command == ARM and frame.param1 == 0)
    assert [command.param1 for command in copter.commands()] == [1, 0]
    copter.report("COMMAND_ACK", command=ARM, result=2)
    copter.report("COMMAND_ACK", command=ARM, result=2)  # so that closing does not wait


def test_string_arms_as_in_dronekit(copter: FlightController, vehicle: dronekit.Vehicle) -> None:
    value: Any = "False"
    vehicle.armed = value
    copter.wait_for_command(ARM)
    assert [command.param1 for command in copter.commands()] == [1]


def test_disarm_during_arming_waits_for_answer(copter: FlightController, vehicle: dronekit.Vehicle) -> None:
    lose_answers(copter, ARM, does=False)
    vehicle.armed = True
    copter.wait_for_command(ARM)
    disarming = threading.Thread(target=vehicle.disarm)
    disarming.start()
    copter.wait_for("COMMAND_LONG", lambda frame: frame.command == ARM and frame.param1 == 0)
    assert disarming.is_alive()
    acks: dict[str, Any] = {"target_system": 255, "target_component": 0}
    copter.report("COMMAND_ACK", command=ARM, result=0, **acks)  # to the arming
    copter.report("COMMAND_ACK", command=ARM, result=0, **acks)
    disarming.join(LIMIT_S)
    assert not disarming.is_alive()
    assert [command.param1 for command in copter.commands()] == [1, 0]


def test_disarming_silent_vehicle_is_sent_and_not_taken_for_done(
    copter: FlightController, vehicle: dronekit.Vehicle, monkeypatch: pytest.MonkeyPatch
) -> None:
    lose_answers(copter, ARM, does=False)
    copter.heartbeat_s = None
    monkeypatch.setattr(flight, "MODE_MAX_AGE_S", -1.0)  # each HEARTBEAT is too old
    vehicle.armed = False  # HEARTBEAT has reported disarmed, but a pilot may have armed the vehicle since
    copter.wait_for_command(ARM)
    with pytest.raises(dronekit.TimeoutError, match="failed to disarm vehicle"):
        vehicle.disarm()
    assert {command.param1 for command in copter.commands()} == {0}


def test_wait_for_mode_is_not_ended_by_old_report(
    copter: FlightController, vehicle: dronekit.Vehicle, monkeypatch: pytest.MonkeyPatch
) -> None:
    lose_answers(copter, SET_MODE, does=False)
    copter.heartbeat_s = None
    monkeypatch.setattr(flight, "MODE_MAX_AGE_S", -1.0)  # each HEARTBEAT is too old
    assert vehicle.mode == "STABILIZE"
    with pytest.raises(dronekit.TimeoutError, match="failed to set flight mode"):
        vehicle.wait_for_mode("STABILIZE")


def test_px4_goto_refused_by_mode_changes_no_speed() -> None:
    mission = 4 << 16 | 4 << 24
    with FlightController(autopilot=12, mode=mission) as px4, dronekit.connect(px4.address, rate=None) as vehicle:
        vehicle.simple_goto(dronekit.LocationGlobal(-35.0, 149.0, 620.0), airspeed=15, groundspeed=15)
        vehicle._handler.calls.wait(LIMIT_S)
        assert vehicle.mode == "MISSION"
        assert not px4.commands()


@pytest.mark.parametrize("is_mission_ordered", [False, True])
def test_px4_armed_starts_only_ordered_mission(is_mission_ordered: bool) -> None:
    """PX4 stands in MISSION after a return that interrupted a mission."""
    mission, hold = 4 << 16 | 4 << 24, 4 << 16 | 3 << 24
    with FlightController(autopilot=12, mode=mission) as px4, dronekit.connect(px4.address, rate=None) as vehicle:
        if is_mission_ordered:
            vehicle.mode = dronekit.VehicleMode("MISSION")
        vehicle.armed = True
        px4.wait_for_command(ARM)
        assert px4.custom_mode == (mission if is_mission_ordered else hold)
        assert [command.command for command in px4.commands()] == [SET_MODE, ARM]


def test_goto_after_reboot_uses_new_home(copter: FlightController, vehicle: dronekit.Vehicle) -> None:
    copter.report("HOME_POSITION", altitude=584_000)
    wait_for(lambda: vehicle.home_location is not None)
    copter.home = (-353632610, 1491652300, 700_000)
    vehicle._handler.loop.call(vehicle.aio._session._on_reboot)
    home = vehicle.home_location
    assert home is None or home.alt == 700  # The new home may have been reported already.
    vehicle.simple_goto(dronekit.LocationGlobal(-35.36, 149.16, 720.0))
    copter.wait_for("COMMAND_INT", lambda frame: frame.command == REPOSITION and frame.z == 20.0)


@pytest.mark.parametrize("wait", ["arm", "wait_for_mode"])
def test_abandoned_order_is_not_repeated(copter: FlightController, vehicle: dronekit.Vehicle, wait: str) -> None:
    lose_answers(copter, ARM, SET_MODE, does=False)
    orders: dict[str, Any] = {
        "arm": vehicle.arm,
        "wait_for_mode": lambda timeout: vehicle.wait_for_mode("AUTO", timeout),
    }
    with pytest.raises(dronekit.TimeoutError):
        orders[wait](timeout=0.05)
    wait_for(lambda: not vehicle._handler.calls._pending)
    assert len(copter.commands()) <= 1  # On a busy machine, the call may end before the order is sent.


def test_raw_setpoint_overrules_simple_goto(
    copter: FlightController, vehicle: dronekit.Vehicle, caplog: pytest.LogCaptureFixture
) -> None:
    lose_answers(copter, REPOSITION, does=False)
    vehicle.simple_goto(dronekit.LocationGlobalRelative(-35.0, 149.0, 20.0))
    copter.wait_for("COMMAND_INT", lambda frame: frame.command == REPOSITION)
    vehicle.send_mavlink(
        vehicle.message_factory.set_position_target_local_ned_encode(
            0, 0, 0, 8, 0x0DC7, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0
        )
    )
    copter.wait_for("SET_POSITION_TARGET_LOCAL_NED", lambda _: True)
    copter.beat()
    vehicle._handler.calls.wait(LIMIT_S)
    assert [command.command for command in copter.commands()] == [REPOSITION]
    assert "not sent again: another order was given" in caplog.text


def test_simple_goto_ends_go_to(copter: FlightController, vehicle: dronekit.Vehicle) -> None:
    order = vehicle.aio._arbiter.order()
    vehicle.simple_goto(dronekit.LocationGlobalRelative(-35.0, 149.0, 20.0))
    vehicle._handler.calls.wait(LIMIT_S)
    assert order.end == "another order was given"


def test_fallback_for_old_firmware_belongs_to_order(copter: FlightController, vehicle: dronekit.Vehicle) -> None:
    """The unacknowledged fallback message is not sent after a newer order or a pilot's takeover."""
    copter.results = {REPOSITION: UNSUPPORTED, SET_MODE: UNSUPPORTED}
    vehicle.simple_goto(dronekit.LocationGlobalRelative(-35.0, 149.0, 20.0))
    copter.wait_for("COMMAND_INT", lambda frame: frame.command == REPOSITION)
    stop = (0, 0, 0, 8, 0x0DC7, *(0,) * 11)
    vehicle.send_mavlink(vehicle.message_factory.set_position_target_local_ned_encode(*stop))
    vehicle.mode = "AUTO"
    copter.wait_for_command(SET_MODE)
    copter.custom_mode = LOITER
    copter.beat()
    vehicle._handler.calls.wait(LIMIT_S)
    assert not copter.received("SET_POSITION_TARGET_GLOBAL_INT", "SET_MODE")
    vehicle.mode = "GUIDED"
    copter.wait_for("SET_MODE", lambda frame: frame.custom_mode == 4)
    vehicle.simple_goto(dronekit.LocationGlobalRelative(-35.0, 149.0, 20.0))
    copter.wait_for("SET_POSITION_TARGET_GLOBAL_INT", lambda _: True)
