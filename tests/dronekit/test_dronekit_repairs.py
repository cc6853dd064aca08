"""DroneKit's faults, each with the scene in which it showed: what its documentation promises happens instead."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
from dronekit_scenarios_data import FIRST, SECOND, TAKEOFF, THIRD, downloaded, kept, waypoint
from dronekit_scenarios_orders import HOME, channels_of
from dronekit_stage import Stage, caught, on_stage
from flight_controller import FlightController, message_of

import aerokit.dronekit as dronekit


@pytest.fixture
def copter() -> Iterator[Stage]:
    with on_stage(dronekit, {"mode": 4}) as stage:
        yield stage


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


# ------------------------------------------------------------------- whose messages are heard


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        pytest.param((255, 190), {"type": 6, "autopilot": 8}, id="ground station"),
        pytest.param((1, 154), {"type": 26, "autopilot": 8}, id="gimbal"),
        pytest.param((1, 156), {"type": 27, "autopilot": 8}, id="ADS-B receiver"),
        pytest.param((1, 191), {"type": 18, "autopilot": 8}, id="companion"),
        pytest.param((1, 191), {"type": 18, "autopilot": 0}, id="companion that says it is an autopilot"),
        pytest.param((2, 1), {"type": 2, "autopilot": 3}, id="another copter"),
        pytest.param((1, 1), {"type": 6, "autopilot": 8}, id="ground station that took the autopilot's ids"),
        pytest.param((1, 1), {"type": 18, "autopilot": 8}, id="companion that took the autopilot's ids"),
        pytest.param((51, 68), {"type": 6, "autopilot": 8}, id="radio"),
    ],
)
def test_heartbeats_of_others_change_nothing(
    copter: Stage, source: tuple[int, int], kind: dict[str, int]
) -> None:
    copter.fc.base_mode, copter.fc.system_status = 129, 4
    copter.beat()
    vehicle, events = copter.vehicle, copter.listen("armed", "mode", "system_status")
    copter.beat(source=source, base_mode=0, custom_mode=0, system_status=1, **kind)
    assert (vehicle.armed, vehicle.mode.name, vehicle.system_status.state) == (True, "GUIDED", "ACTIVE")
    assert str(vehicle.version).startswith("APM:Copter")
    assert events == []


def test_other_vehicles_do_not_move_this_one(copter: Stage) -> None:
    other = (2, 1)
    copter.beat(source=other)
    copter.tell("GLOBAL_POSITION_INT", lat=471000000, lon=85000000, alt=30, relative_alt=40)
    copter.tell("ATTITUDE", roll=0.5)
    events, heard = copter.listen("*"), []
    copter.vehicle.add_message_listener("VFR_HUD", lambda *_: heard.append(1))
    copter.reached()
    for name, fields in (
        ("GLOBAL_POSITION_INT", {"lat": 7}),
        ("ATTITUDE", {"roll": 0.25}),
        ("SYS_STATUS", {"voltage_battery": 1}),
        ("VFR_HUD", {"heading": 7}),
        ("GPS_RAW_INT", {"fix_type": 6}),
    ):
        copter.tell(name, source=other, **fields)
    assert (copter.vehicle.attitude.roll, copter.vehicle.location.global_frame.lat) == (0.5, 47.1)
    assert (copter.vehicle.heading, copter.vehicle.battery, copter.vehicle.gps_0.fix_type) == (
        None,
        None,
        None,
    )
    assert not {name for _, name, _ in events} & {"attitude", "heading", "battery", "gps_0", "location"}
    assert heard == []


def test_parameters_of_others_are_theirs(copter: Stage) -> None:
    parameters = copter.vehicle.parameters
    parameters.wait_ready()
    lists = len(copter.fc.received("PARAM_REQUEST_LIST"))
    for source in ((1, 154), (2, 1)):
        for name in ("FOO", "GMB_POS_HOLD"):
            copter.fc.parameters.tell(name, source=source, param_value=99.0, param_count=33, param_index=1)
    copter.settle()
    copter.reached()
    assert (parameters["FOO"], len(parameters), "GMB_POS_HOLD" in parameters) == (1.0, 3, False)
    assert len(copter.fc.received("PARAM_REQUEST_LIST")) == lists


def test_unknown_mode_number_stops_nothing(copter: Stage) -> None:
    copter.fc.base_mode, copter.fc.custom_mode, copter.fc.system_status = 129, 199, 4
    with copter.logged(having="HEARTBEAT") as lines:
        copter.beat()
    vehicle = copter.vehicle
    assert (vehicle.armed, vehicle.system_status.state, "199" in vehicle.mode.name) == (True, "ACTIVE", True)
    assert lines == []


# --------------------------------------------------------------------------------- MAVLink 2


def test_nothing_of_the_process_changes() -> None:
    before = dict(os.environ)
    with on_stage(dronekit, {"version": 2}) as two, on_stage(dronekit, {"version": 1}) as one:
        two.reached()
        one.reached()
        assert {frame.version for frame in one.fc.received("PING")} <= {1, 2}
        assert {frame.version for frame in two.fc.received("PING")} == {2}
    assert dict(os.environ) == before


def test_play_tune_of_text_and_bytes(copter: Stage) -> None:
    for tune in ("AAA", b"AAA"):
        (sent,) = copter.sent_by(partial(copter.vehicle.play_tune, tune), "PLAY_TUNE")
        assert (sent.target[0], sent.tune) == (1, "AAA")


def test_play_tune_of_a_vehicle_that_has_no_such_message() -> None:
    with on_stage(dronekit, {"version": 1}, prepare=lambda fc: setattr(fc, "capabilities", 0)) as stage:
        assert caught(lambda: stage.vehicle.play_tune("AAA")).startswith("APIException")


# ------------------------------------------------------------------------------------- modes


def test_old_firmware_is_told_its_mode_by_the_old_message(copter: Stage) -> None:
    copter.fc.results[176] = 3
    copter.vehicle.wait_for_mode("LOITER", timeout=20)
    old = copter.fc.wait_for("SET_MODE")
    assert (old.target[0], old.base_mode & 1, old.custom_mode) == (1, 1, 5)
    assert copter.vehicle.mode == "LOITER"


def test_refusals_are_warnings_with_the_reason(copter: Stage) -> None:
    copter.fc.results[400] = 4
    copter.fc.reasons[400] = "PreArm: Compass not healthy"
    with copter.logged(having="ARM") as lines:
        copter.vehicle.armed = True
        until(lambda: lines)
    assert lines[0].startswith("WARNING")
    assert "Compass not healthy" in lines[0]


def test_lost_orders_are_repeated(copter: Stage) -> None:
    copter.fc.results[246] = None
    copter.vehicle.reboot()
    first = copter.fc.wait_for_command(246)
    again = copter.fc.wait_for_command(246, since=copter.fc.received().index(first) + 1)
    copter.fc.tell("COMMAND_ACK", command=246, result=0)
    assert again.params == first.params


# -------------------------------------------------------------------------------- connecting


def tell_streams(fc: FlightController) -> None:
    for name in ("ATTITUDE", "GLOBAL_POSITION_INT", "VFR_HUD", "GPS_RAW_INT", "SYS_STATUS"):
        fc.tell(name)


@pytest.mark.parametrize("address", ["udpin:127.0.0.1:0", "udpin:127.0.0.1"])
def test_connecting_to_nobody_ends_and_leaves_nothing(address: str) -> None:
    before = threading.active_count()
    with pytest.raises((dronekit.APIException, ValueError)):
        dronekit.connect(address, heartbeat_timeout=0.2)
    until(lambda: threading.active_count() <= before)


def test_connecting_to_a_vehicle_without_parameters_returns() -> None:
    def prepare(fc: FlightController) -> None:
        fc.parameters.is_silent = True

    with on_stage(dronekit, {}, {"wait_ready": ["mode", "armed"], "heartbeat_timeout": 5}, prepare) as stage:
        assert stage.vehicle.mode.name == "STABILIZE"
        text = caught(lambda: stage.vehicle.wait_ready("parameters", timeout=0.2))
        assert text == "TimeoutError: wait_ready experienced a timeout after 0.2 seconds."


@pytest.mark.parametrize("names", ["mode", ["mode", "armed"], ("attitude",)])
def test_wait_ready_of_connect_takes_names(names: Any) -> None:
    def prepare(fc: FlightController) -> None:
        fc.answers["REQUEST_DATA_STREAM"] = lambda _: tell_streams(fc)

    with on_stage(dronekit, {}, {"rate": 4, "wait_ready": names, "timeout": 10}, prepare) as stage:
        assert stage.vehicle.wait_ready(*([names] if isinstance(names, str) else names), timeout=1)


def test_wait_ready_of_connect_has_its_timeout() -> None:
    missing: set[str] = set()
    with FlightController() as fc, pytest.raises(dronekit.TimeoutError, match=r"after 0\.3 seconds"):
        dronekit.connect(
            fc.address,
            rate=None,
            wait_ready=["nosuch", "mode"],
            timeout=0.3,
            still_waiting_callback=missing.update,
            still_waiting_interval=0.1,
        )
    assert "nosuch" in missing


def test_status_printer_ends_with_its_vehicle(copter: Stage) -> None:
    printed: list[str] = []
    with on_stage(dronekit, {}, {"status_printer": printed.append}) as stage:
        stage.tell("STATUSTEXT", severity=2, text=b"PreArm: no ")
    copter.tell("STATUSTEXT", severity=2, text=b"of another")
    assert printed == ["PreArm: no"]


def test_subclass_with_attributes_of_its_own() -> None:
    class Own(dronekit.Vehicle):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            self.pressure: float | None = None

            @self.on_message("SCALED_PRESSURE")
            def listener(vehicle: Any, name: str, message: Any) -> None:
                self.pressure = message.press_abs
                self.notify_attribute_listeners("pressure", self.pressure)

    with on_stage(dronekit, {}, {"vehicle_class": Own}) as stage:
        assert isinstance(stage.vehicle, Own)
        events = stage.listen("pressure")
        stage.tell("SCALED_PRESSURE", press_abs=1013.25)
        assert stage.vehicle.pressure == 1013.25
        assert events == [("Own", "pressure", "1013.25")]


def test_initializing_later() -> None:
    with FlightController(mode=5) as fc:
        fc.answers["REQUEST_DATA_STREAM"] = lambda _: tell_streams(fc)
        vehicle = dronekit.connect(fc.address, _initialize=False)
        assert (vehicle.armed, vehicle.is_armable, vehicle.system_status) == (False, False, None)
        vehicle.initialize(rate=7, heartbeat_timeout=10)
        assert vehicle.mode.name == "LOITER"
        assert fc.wait_for("REQUEST_DATA_STREAM").req_message_rate == 7
        vehicle.close()


# ------------------------------------------------------------------------------------ the link


def test_a_link_that_is_lost_comes_back() -> None:
    def prepare(fc: FlightController) -> None:
        fc.answers["REQUEST_DATA_STREAM"] = lambda _: tell_streams(fc)

    with on_stage(dronekit, {"link": "tcp", "mode": 4}, {"rate": 4}, prepare) as stage:
        streams = len(stage.fc.received("REQUEST_DATA_STREAM"))
        stage.fc.drop()
        stage.fc.custom_mode = 5
        until(lambda: stage.vehicle.mode == "LOITER")
        assert stage.commands_of(stage.assign("mode", "GUIDED"))[0][:3] == (176, 1, 4)
        until(lambda: len(stage.fc.received("REQUEST_DATA_STREAM")) > streams)


def test_closing_delivers_what_was_ordered() -> None:
    with FlightController(mode=4) as fc:
        vehicle = dronekit.connect(fc.address, rate=None)
        vehicle.mode = "RTL"
        vehicle.close()
        vehicle.close()
        assert fc.wait_for_command(176).params[:2] == (1, 6)


def test_closing_from_a_listener() -> None:
    closed = threading.Event()
    with on_stage(dronekit, {"mode": 4}) as stage:

        def close(vehicle: Any, name: str, value: Any) -> None:
            vehicle.close()
            closed.set()

        stage.vehicle.add_attribute_listener("heading", close)
        stage.fc.tell("VFR_HUD", heading=271)
        assert closed.wait(10)
        with pytest.raises(dronekit.APIException):
            stage.vehicle.mode = "RTL"


# ------------------------------------------------------------------------------------ listeners


def test_a_listener_that_blocks_stops_neither_reception_nor_heartbeat(copter: Stage) -> None:
    blocks, go_on = threading.Event(), threading.Event()

    def block(*_: Any) -> None:
        blocks.set()
        assert go_on.wait(20)

    copter.vehicle.add_attribute_listener("heading", block)
    copter.fc.tell("VFR_HUD", heading=271)
    assert blocks.wait(10)
    since = copter.fc.mark()
    copter.fc.tell("VFR_HUD", heading=5)
    until(lambda: copter.vehicle.heading == 5)
    copter.fc.wait_for("HEARTBEAT", since=since)
    go_on.set()
    copter.settle()


def test_listeners_may_call_whatever_blocks(copter: Stage) -> None:
    seen: list[Any] = []

    def use(vehicle: Any, name: str, value: Any) -> None:
        seen.append(vehicle.parameters["FOO"])
        seen.append(vehicle.parameters.set("FOO", 5))
        vehicle.wait_for_mode("LOITER", timeout=10)
        seen.append(vehicle.mode.name)
        seen.append(vehicle.wait_ready("mode", timeout=10))
        vehicle.arm(timeout=10)
        seen.append(vehicle.armed)

    copter.vehicle.add_attribute_listener("heading", use)
    copter.tell("VFR_HUD", heading=271)
    assert seen == [1.0, True, "LOITER", True, True]


def test_a_listener_that_removes_itself_hides_nothing_from_the_next(copter: Stage) -> None:
    calls: list[str] = []

    def once(vehicle: Any, name: str, value: Any) -> None:
        calls.append("once")
        vehicle.remove_attribute_listener("heading", once)

    copter.vehicle.add_attribute_listener("heading", once)
    copter.vehicle.add_attribute_listener("heading", lambda *_: calls.append("next"))
    for heading in (1, 2):
        copter.tell("VFR_HUD", heading=heading)
    assert calls == ["once", "next", "next"]


def test_long_texts_are_joined_and_odd_severities_logged(copter: Stage) -> None:
    with copter.logged("autopilot", having="d") as lines:
        copter.fc.tell("STATUSTEXT", severity=4, text=b"x" * 50, id=7, chunk_seq=0)
        copter.fc.tell("STATUSTEXT", severity=4, text=b" and the end", id=7, chunk_seq=1)
        copter.tell("STATUSTEXT", severity=9, text=b"odd")
    assert lines == [f"WARNING {'x' * 50} and the end", "DEBUG odd"]


# ----------------------------------------------------------------------------------- parameters


def test_what_is_set_while_the_list_comes_stays_set() -> None:
    def prepare(fc: FlightController) -> None:
        def tell_two(_: Any) -> None:
            fc.parameters.tell("FOO")
            fc.parameters.tell("BAR")

        fc.answers["PARAM_REQUEST_LIST"] = tell_two
        fc.answers["PARAM_REQUEST_READ"] = lambda _: None

    with on_stage(dronekit, prepare=prepare) as stage:
        stage.fc.wait_for("PARAM_REQUEST_LIST")
        assert stage.vehicle.parameters.set("FOO", 0.5)
        stage.fc.parameters.tell("THR_MIN")
        stage.vehicle.parameters.wait_ready()
        assert stage.vehicle.parameters["FOO"] == 0.5


def test_another_count_loses_nothing(copter: Stage) -> None:
    parameters = copter.vehicle.parameters
    parameters.wait_ready()
    copter.fc.parameters.values["NEW"] = 8.0
    copter.fc.parameters.tell("NEW")
    copter.settle()
    assert (parameters["NEW"], parameters["FOO"], len(parameters)) == (8.0, 1.0, 4)


def test_same_value_is_confirmed(copter: Stage) -> None:
    copter.vehicle.parameters.wait_ready()
    answer = copter.fc.answers["PARAM_SET"]
    results: list[bool] = []
    told_before: list[bool] = []

    def tell_later(frame: Any) -> None:
        told_before.append(bool(results))  # what is sent again may come later
        answer(frame)

    copter.fc.answers["PARAM_SET"] = tell_later
    results.append(copter.vehicle.parameters.set("FOO", 1.0))
    assert (results, told_before[0]) == ([True], False)
    assert copter.fc.received("PARAM_SET")


# ------------------------------------------------------------------------------------- missions


def test_upload_without_a_download_keeps_the_first_command(copter: Stage) -> None:
    copter.fc.missions.items = [HOME, THIRD]
    commands = copter.vehicle.commands
    commands.clear()
    for item in (TAKEOFF, FIRST, SECOND):
        commands.add(waypoint(copter, item))
    commands.upload()
    assert [command for command, *_ in kept(copter)] == [16, 22, 16, 16]
    assert (len(commands), commands[0].command, commands[-1].z) == (3, 22, SECOND.z)


@pytest.mark.parametrize("result", [4, 15], ids=["NO_SPACE", "DENIED"])
def test_refused_upload_raises_and_the_next_one_works(copter: Stage, result: int) -> None:
    commands = copter.vehicle.commands
    commands.clear()
    commands.add(waypoint(copter, TAKEOFF))
    copter.fc.missions.result = result
    with pytest.raises(dronekit.APIException):
        commands.upload()
    copter.fc.missions.result = 0
    commands.upload()
    assert [command for command, *_ in kept(copter)] == [16, 22]


def test_unanswered_upload_times_out_and_the_next_one_works(copter: Stage) -> None:
    commands = copter.vehicle.commands
    commands.clear()
    commands.add(waypoint(copter, TAKEOFF))
    copter.fc.missions.is_mute = True
    with pytest.raises(dronekit.TimeoutError):
        commands.upload(timeout=0.3)
    copter.fc.missions.is_mute = False
    commands.upload()
    assert [command for command, *_ in kept(copter)] == [16, 22]


@pytest.mark.parametrize("asks_int", [True, False])
def test_upload_answers_both_requests_and_is_exact(copter: Stage, asks_int: bool) -> None:
    copter.fc.missions.asks_int = asks_int
    commands = copter.vehicle.commands
    commands.clear()
    commands.add(dronekit.Command(0, 0, 0, 3, 16, 0, 0, 0, 0, 0, 0, -35.3632611, 149.1652301, 30))
    commands.upload()
    (x, y) = kept(copter)[1][1:3]
    assert (x, y) == ((-35.3632611, 149.1652301) if asks_int else pytest.approx((x, y)))


def test_lost_items_are_asked_for_again(copter: Stage) -> None:
    copter.fc.missions.items = [HOME, FIRST, SECOND, THIRD]
    copter.fc.missions.lost = {1: 1, 3: 1}
    assert [each.seq for each in downloaded(copter)] == [1, 2, 3]


@pytest.mark.parametrize("autopilot", [3, 12], ids=["ArduPilot", "PX4"])
def test_empty_mission(autopilot: int) -> None:
    mode = 3 << 16 if autopilot == 12 else 0
    with on_stage(dronekit, {"autopilot": autopilot, "mode": mode}) as stage:
        stage.fc.missions.has_home = autopilot == 3
        stage.fc.missions.items = [HOME] if autopilot == 3 else []
        assert len(downloaded(stage)) == 0


def test_a_download_that_fails_wedges_nothing(copter: Stage) -> None:
    copter.fc.missions.items = [HOME, FIRST]
    answer = copter.fc.answers.pop("MISSION_REQUEST_LIST")
    commands = copter.vehicle.commands
    commands.download()
    with pytest.raises(dronekit.TimeoutError):
        commands.wait_ready(timeout=0.2)
    copter.fc.answers["MISSION_REQUEST_LIST"] = answer
    assert len(downloaded(copter)) == 1


# -------------------------------------------------------------------------- channels and gimbal


def test_every_way_of_changing_overrides_sends(copter: Stage) -> None:
    overrides = copter.vehicle.channels.overrides
    assert channels_of(copter, lambda: overrides.update({"1": 1100, "2": 1200})) == [(1100, 1200, *(0,) * 6)]
    assert channels_of(copter, lambda: overrides.setdefault("3", 1300)) == [(1100, 1200, 1300, *(0,) * 5)]
    assert channels_of(copter, lambda: overrides.pop("1")) == [(0, 1200, 1300, *(0,) * 5)]
    assert channels_of(copter, overrides.clear) == [(0,) * 8]
    assert (len(overrides), bool(overrides), 3 in overrides) == (0, False, False)


@pytest.mark.parametrize("angles", [(-90, 0, 0), (-45.5, 0, 12.5)])
def test_gimbal_is_ordered_by_commands_that_firmware_knows(copter: Stage, angles: tuple[float, ...]) -> None:
    (sent,) = copter.sent_by(lambda: copter.vehicle.gimbal.rotate(*angles))
    assert (sent.command, sent.target[0], sent.params[:2]) == (1000, 1, (angles[0], angles[2]))


def test_gimbal_of_old_firmware(copter: Stage) -> None:
    copter.fc.results.update({1000: 3, 205: 3})
    copter.vehicle.gimbal.rotate(-90, 0, 0)
    configure, control = copter.fc.wait_for("MOUNT_CONFIGURE"), copter.fc.wait_for("MOUNT_CONTROL")
    assert (configure.target, configure.mount_mode, control.target, control.input_a) == (
        (1, 1),
        2,
        (1, 1),
        -9000,
    )


def test_gimbal_looks_at_places_above_the_sea_too(copter: Stage) -> None:
    place = dronekit.LocationGlobal(-35.1, 149.2, 600)
    copter.vehicle.gimbal.target_location(place)
    sent = copter.fc.wait_for("COMMAND_INT", lambda frame: frame.command == 195)
    assert (sent.frame, sent.x, sent.y, sent.z) == (5, -351000000, 1492000000, 600)


def test_any_message_of_pymavlink_is_sent(copter: Stage) -> None:
    message = message_of("PARAM_REQUEST_READ", param_id=b"FOO", param_index=-1, target_component=4)
    sent = copter.sent_by(lambda: copter.vehicle.send_mavlink(message), "PARAM_REQUEST_READ")
    assert [frame.param_id for frame in sent if frame.target == (1, 4)] == ["FOO"]
    assert message.target_system == 1
    rounded = copter.vehicle.message_factory.rc_channels_override_encode(0, 0, 1500.4, 0, 0, 0, 0, 0, 0, 0)
    (override,) = copter.sent_by(lambda: copter.vehicle.send_mavlink(rounded), "RC_CHANNELS_OVERRIDE")
    assert override.chan1_raw == 1500
