"""Orders that get no answer are sent again, but not against a newer order, a pilot, or what they have brought about."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from flight_controller import FlightController, Received

import aerokit.dronekit as dronekit
from aerokit.dronekit.standing import Given
from aerokit.mavlink import messages as m

GUIDED, LOITER, RTL = 4, 5, 6
ARM, SET_MODE, TAKEOFF, REPOSITION = 400, 176, 22, 192
PX4_POSCTL, PX4_TAKEOFF, PX4_LOITER = 3 << 16, 4 << 16 | 2 << 24, 4 << 16 | 3 << 24
ARMED = 128
LIMIT_S = 10.0


@pytest.fixture
def copter() -> Iterator[FlightController]:
    with FlightController() as each:
        yield each


@pytest.fixture
def vehicle(copter: FlightController) -> Iterator[dronekit.Vehicle]:
    each = dronekit.connect(copter.address, rate=None)
    yield each
    each.close()


def lose_answers(copter: FlightController, *commands: int, does: bool) -> None:
    """The vehicle does what it is told, or not, and nobody hears its answers."""
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


def test_what_was_told_is_not_ordered_again_against_the_pilot(
    copter: FlightController, vehicle: dronekit.Vehicle
) -> None:
    lose_answers(copter, ARM, SET_MODE, does=True)
    vehicle.armed = True
    vehicle.mode = "GUIDED"
    wait_for(lambda: vehicle.armed and vehicle.mode == "GUIDED")
    copter.base_mode, copter.custom_mode = copter.base_mode & ~ARMED, LOITER
    copter.beat()
    vehicle._handler.orders.wait(LIMIT_S)
    assert [each.command for each in copter.commands()] == [ARM, SET_MODE]
    assert (vehicle.armed, vehicle.mode.name) == (False, "LOITER")


def test_arming_without_an_answer_says_that_it_may_still_be_carried_out(
    copter: FlightController, vehicle: dronekit.Vehicle, caplog: pytest.LogCaptureFixture
) -> None:
    lose_answers(copter, ARM, does=False)
    vehicle.armed = True
    vehicle._handler.orders.wait(LIMIT_S)
    (record,) = caplog.records
    assert record.message.endswith("; it may still be carried out, and nobody watches for that")


def test_a_pilot_who_takes_over_before_the_order_has_come_keeps_the_vehicle(
    copter: FlightController, vehicle: dronekit.Vehicle, caplog: pytest.LogCaptureFixture
) -> None:
    lose_answers(copter, SET_MODE, REPOSITION, does=False)
    vehicle.simple_goto(dronekit.LocationGlobalRelative(-35.0, 149.0, 20.0))
    vehicle.mode = "GUIDED"
    copter.wait_for_command(SET_MODE)
    copter.custom_mode = LOITER
    copter.beat()
    vehicle._handler.orders.wait(LIMIT_S)
    assert [each.command for each in copter.commands()] == [REPOSITION, SET_MODE]
    ends = sorted(each.message.partition("not sent again: ")[2].partition(";")[0] for each in caplog.records)
    assert ends == ["a newer order was given meanwhile", "the vehicle was put into another mode meanwhile"]


def test_disarming_waits_for_no_answer_to_arming(copter: FlightController, vehicle: dronekit.Vehicle) -> None:
    lose_answers(copter, ARM, does=False)
    vehicle.armed = True
    copter.wait_for_command(ARM)
    vehicle.armed = False  # HEARTBEAT has told nothing else, but the arming may still come
    copter.wait_for("COMMAND_LONG", lambda frame: frame.command == ARM and frame.param1 == 0)
    assert [each.param1 for each in copter.commands()] == [1, 0]
    copter.tell("COMMAND_ACK", command=ARM, result=2)
    copter.tell("COMMAND_ACK", command=ARM, result=2)  # so that closing does not wait


def test_disarm_waits_for_the_answer_when_arming_is_under_way(
    copter: FlightController, vehicle: dronekit.Vehicle
) -> None:
    lose_answers(copter, ARM, does=False)
    vehicle.armed = True
    copter.wait_for_command(ARM)
    disarming = threading.Thread(target=vehicle.disarm)
    disarming.start()
    copter.wait_for("COMMAND_LONG", lambda frame: frame.command == ARM and frame.param1 == 0)
    assert disarming.is_alive()
    acks: dict[str, Any] = {"target_system": 255, "target_component": 0}
    copter.tell("COMMAND_ACK", command=ARM, result=0, **acks)  # to the arming
    copter.tell("COMMAND_ACK", command=ARM, result=0, **acks)
    disarming.join(LIMIT_S)
    assert not disarming.is_alive()
    assert [each.param1 for each in copter.commands()] == [1, 0]


@pytest.mark.parametrize("wait", ["arm", "wait_for_mode"])
def test_what_is_not_waited_for_any_more_is_not_ordered_again(
    copter: FlightController, vehicle: dronekit.Vehicle, wait: str
) -> None:
    lose_answers(copter, ARM, SET_MODE, does=False)
    orders: dict[str, Any] = {
        "arm": vehicle.arm,
        "wait_for_mode": lambda timeout: vehicle.wait_for_mode("AUTO", timeout),
    }
    with pytest.raises(dronekit.TimeoutError):
        orders[wait](timeout=0.05)
    wait_for(lambda: not vehicle._handler.orders._pending)
    assert len(copter.commands()) == 1


# ------------------------------------------------------------------------------------------ the rules


def heartbeat(mode: int, armed: bool = False) -> Any:
    return m.Heartbeat(2, 3, ARMED if armed else 0, mode, 3, 3)


def told(standing: Any, *states: tuple[int, bool]) -> Any:
    for mode, armed in states:
        standing._take(mode, armed)
    return standing


def test_an_effect_is_a_change_to_it() -> None:
    assert told(Given().order("mode", mode=GUIDED), (0, False), (GUIDED, False)).is_done
    assert told(Given().order("mode", mode=GUIDED), (GUIDED, False), (GUIDED, False)).holds()
    assert told(Given().order("arm", armed=True), (0, False), (0, True), (0, False)).is_done
    assert told(Given().order("arm", armed=True), (0, False), (0, False)).holds()


def test_a_mode_that_nobody_here_ordered_is_somebody_elses() -> None:
    assert not told(Given().order("motion"), (GUIDED, False), (LOITER, False)).holds()
    assert not told(Given().order("arm", armed=True), (GUIDED, False), (LOITER, False)).holds()
    assert told(Given().order("arm", armed=False), (GUIDED, True), (LOITER, True)).holds()
    given = Given()
    mode, motion = given.order("mode", "motion", mode=GUIDED), given.order("motion")
    assert told(motion, (0, False), (GUIDED, False)).holds()
    assert told(mode, (0, False), (0, False)).holds()


def test_a_newer_order_overrules_those_of_its_subject() -> None:
    given = Given()
    going, mode = given.order("motion"), given.order("mode", "motion")
    assert (going.holds(), mode.holds()) == (False, True)
    again = given.order("motion")
    assert (mode.holds(), again.holds()) == (True, True)


@pytest.mark.parametrize(
    ("message", "overruled"),
    [
        (m.SetMode(1, 1, LOITER), {"mode", "motion"}),
        (m.CommandLong(1, 0, SET_MODE, 0, 1, 5, 0, 0, 0, 0, 0), {"mode", "motion"}),
        (m.CommandLong(1, 0, 21, 0, 0, 0, 0, 0, 0, 0, 0), {"mode", "motion"}),
        *((m.CommandLong(1, 0, each, 0, 0, 0, 0, 0, 0, 0, 0), {"motion"}) for each in (17, 18, 19, 193)),
        (m.CommandLong(1, 0, ARM, 0, 0, 0, 0, 0, 0, 0, 0), {"arm"}),
        (m.CommandLong(1, 0, 178, 0, 0, 5, 0, 0, 0, 0, 0), set()),
        (m.SetPositionTargetLocalNed(0, 1, 0, 8, 0x0DC7, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0), {"motion"}),
        (m.MissionItemInt(1, 0, 0, 6, 16, 2, 0, 0, 0, 0, 0, 0, 0, 10), {"motion"}),
        (m.MissionItemInt(1, 0, 0, 6, 16, 0, 1, 0, 0, 0, 0, 0, 0, 10), set()),
        (heartbeat(0), set()),
    ],
)
def test_what_the_program_sends_by_itself_counts(message: Any, overruled: set[str]) -> None:
    given = Given()
    orders = {subject: given.order(subject) for subject in ("mode", "motion", "arm")}
    given.note(message)
    assert {subject for subject, order in orders.items() if not order.holds()} == overruled
