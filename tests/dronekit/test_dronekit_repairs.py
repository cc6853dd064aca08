"""DroneKit's faults, each in the situation that showed it, and the documented behaviour."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
import serial
from dronekit_stage import Stage, caught, on_stage, until
from flight_controller import FlightController

import aerokit.dronekit as dronekit


@pytest.fixture
def copter() -> Iterator[Stage]:
    with on_stage(dronekit, {"mode": 4}) as stage:
        yield stage


# ------------------------------------------------------------------ messages of other systems


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
def test_heartbeats_of_other_components_are_ignored(
    copter: Stage, source: tuple[int, int], kind: dict[str, int]
) -> None:
    copter.fc.base_mode, copter.fc.system_status = 129, 4
    copter.beat()
    vehicle, events = copter.vehicle, copter.listen("armed", "mode", "system_status")
    copter.beat(source=source, base_mode=0, custom_mode=0, system_status=1, **kind)
    assert (vehicle.armed, vehicle.mode.name, vehicle.system_status.state) == (True, "GUIDED", "ACTIVE")
    assert str(vehicle.version).startswith("APM:Copter")
    assert events == []


def test_other_vehicles_do_not_change_attributes(copter: Stage) -> None:
    other = (2, 1)
    copter.beat(source=other)
    copter.report("GLOBAL_POSITION_INT", lat=471000000, lon=85000000, alt=30, relative_alt=40)
    copter.report("ATTITUDE", roll=0.5)
    events, received = copter.listen("*"), []
    copter.vehicle.add_message_listener("VFR_HUD", lambda *_: received.append(1))
    copter.reached()
    for name, fields in (
        ("GLOBAL_POSITION_INT", {"lat": 7}),
        ("ATTITUDE", {"roll": 0.25}),
        ("SYS_STATUS", {"voltage_battery": 1}),
        ("VFR_HUD", {"heading": 7}),
        ("GPS_RAW_INT", {"fix_type": 6}),
    ):
        copter.report(name, source=other, **fields)
    assert (copter.vehicle.attitude.roll, copter.vehicle.location.global_frame.lat) == (0.5, 47.1)
    assert (copter.vehicle.heading, copter.vehicle.battery, copter.vehicle.gps_0.fix_type) == (
        None,
        None,
        None,
    )
    assert not {name for _, name, _ in events} & {"attitude", "heading", "battery", "gps_0", "location"}
    assert received == []


def test_parameters_of_other_systems_are_ignored(copter: Stage) -> None:
    parameters = copter.vehicle.parameters
    parameters.wait_ready()
    lists = len(copter.fc.received("PARAM_REQUEST_LIST"))
    for source in ((1, 154), (2, 1)):
        for name in ("FOO", "GMB_POS_HOLD"):
            copter.fc.parameters.report(name, source=source, param_value=99.0, param_count=33, param_index=1)
    copter.settle()
    copter.reached()
    assert (parameters["FOO"], len(parameters), "GMB_POS_HOLD" in parameters) == (1.0, 3, False)
    assert len(copter.fc.received("PARAM_REQUEST_LIST")) == lists


def test_unknown_mode_number_does_not_freeze_attributes(copter: Stage) -> None:
    copter.fc.base_mode, copter.fc.custom_mode, copter.fc.system_status = 129, 199, 4
    with copter.logged(having="HEARTBEAT") as lines:
        copter.beat()
    vehicle = copter.vehicle
    assert (vehicle.armed, vehicle.system_status.state, "199" in vehicle.mode.name) == (True, "ACTIVE", True)
    assert lines == []


# --------------------------------------------------------------------------------- MAVLink 2


def test_connect_leaves_process_unchanged() -> None:
    before = dict(os.environ)
    with on_stage(dronekit, {"version": 2}) as two, on_stage(dronekit, {"version": 1}) as one:
        two.reached()
        one.reached()
        assert {frame.version for frame in one.fc.received("PING")} <= {1, 2}
        assert {frame.version for frame in two.fc.received("PING")} == {2}
    assert dict(os.environ) == before


def test_play_tune_str_and_bytes(copter: Stage) -> None:
    for tune in ("AAA", b"AAA"):
        (sent,) = copter.sent_by(partial(copter.vehicle.play_tune, tune), "PLAY_TUNE")
        assert (sent.target[0], sent.tune) == (1, "AAA")


def test_play_tune_mavlink_1_raises() -> None:
    with on_stage(dronekit, {"version": 1}, prepare=lambda fc: setattr(fc, "capabilities", 0)) as stage:
        assert caught(lambda: stage.vehicle.play_tune("AAA")).startswith("APIException")


# ------------------------------------------------------------------------------------- modes


def test_old_firmware_gets_set_mode_message(copter: Stage) -> None:
    copter.fc.results[176] = 3
    copter.vehicle.wait_for_mode("LOITER", timeout=100)
    old = copter.fc.wait_for("SET_MODE")
    assert (old.target[0], old.base_mode & 1, old.custom_mode) == (1, 1, 5)
    assert copter.vehicle.mode == "LOITER"


def test_rejections_are_warnings_with_reason(copter: Stage) -> None:
    copter.fc.results[400] = 4
    copter.fc.reasons[400] = "PreArm: Compass not healthy"
    with copter.logged(having="ARM") as lines:
        copter.vehicle.armed = True
        until(lambda: lines)
    assert lines[0].startswith("WARNING")
    assert "Compass not healthy" in lines[0]


def test_altitude_of_home_unknown_sends_no_goto(copter: Stage) -> None:
    copter.vehicle._home_location = dronekit.LocationGlobal(47.0, 8.0)  # as programs do that use DroneKit's privates
    since = copter.fc.mark()
    with pytest.raises(dronekit.APIException, match="home"):
        copter.vehicle.simple_goto(dronekit.LocationGlobal(47.1, 8.1, 600))
    copter.reached()
    assert not [frame for frame in copter.fc.received("COMMAND_INT", since=since) if frame.command == 192]


def test_lost_orders_are_repeated(copter: Stage) -> None:
    copter.fc.results[178] = None
    copter.vehicle.groundspeed = 5
    first = copter.fc.wait_for_command(178)
    again = copter.fc.wait_for_command(178, since=copter.fc.received().index(first) + 1)
    copter.fc.report("COMMAND_ACK", command=178, result=0)
    assert again.params == first.params


# -------------------------------------------------------------------------------- connecting


def send_streams(fc: FlightController) -> None:
    for name in ("ATTITUDE", "GLOBAL_POSITION_INT", "VFR_HUD", "GPS_RAW_INT", "SYS_STATUS"):
        fc.report(name)


def test_connect_without_vehicle_raises_and_closes() -> None:
    before = threading.active_count()
    with pytest.raises(dronekit.APIException, match="Timeout in initializing connection"):
        dronekit.connect("udpin:127.0.0.1:0", heartbeat_timeout=0.2)
    until(lambda: threading.active_count() <= before)


@pytest.mark.parametrize(
    ("address", "error"),
    [
        ("tcp:no-such-host.invalid:5760", socket.gaierror),
        ("tcp:127.0.0.1", ValueError),
        ("udpin:127.0.0.1", ValueError),
        ("/dev/no-such-device", serial.SerialException),
        ("/dev/no-such-device,57600", serial.SerialException),
    ],
)
def test_address_errors(address: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        dronekit.connect(address, heartbeat_timeout=1)


def test_connect_vehicle_without_parameters_returns() -> None:
    def prepare(fc: FlightController) -> None:
        fc.parameters.is_silent = True

    with on_stage(dronekit, {}, {"wait_ready": ["mode", "armed"], "heartbeat_timeout": 5}, prepare) as stage:
        assert stage.vehicle.mode.name == "STABILIZE"
        text = caught(lambda: stage.vehicle.wait_ready("parameters", timeout=0.2))
        assert text == "TimeoutError: wait_ready experienced a timeout after 0.2 seconds."


@pytest.mark.parametrize("names", ["mode", ["mode", "armed"], ("attitude",)])
def test_connect_wait_ready_accepts_names(names: Any) -> None:
    def prepare(fc: FlightController) -> None:
        fc.answers["REQUEST_DATA_STREAM"] = lambda _: send_streams(fc)

    with on_stage(dronekit, {}, {"rate": 4, "wait_ready": names, "timeout": 10}, prepare) as stage:
        assert stage.vehicle.wait_ready(*([names] if isinstance(names, str) else names), timeout=1)


def test_connect_wait_ready_uses_timeout() -> None:
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


def test_status_printer_is_removed_on_close(copter: Stage) -> None:
    printed: list[str] = []
    with on_stage(dronekit, {}, {"status_printer": printed.append}) as stage:
        stage.report("STATUSTEXT", severity=2, text=b"PreArm: no ")
    copter.report("STATUSTEXT", severity=2, text=b"of another")
    assert printed == ["PreArm: no"]


def test_subclass_with_own_attributes() -> None:
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
        stage.report("SCALED_PRESSURE", press_abs=1013.25)
        assert stage.vehicle.pressure == 1013.25
        assert events == [("Own", "pressure", "1013.25")]


def test_initialize_later() -> None:
    with FlightController(mode=5) as fc:
        fc.answers["REQUEST_DATA_STREAM"] = lambda _: send_streams(fc)
        vehicle = dronekit.connect(fc.address, _initialize=False)
        assert (vehicle.armed, vehicle.is_armable, vehicle.system_status) == (False, False, None)
        vehicle.initialize(rate=7, heartbeat_timeout=100)
        assert vehicle.mode.name == "LOITER"
        assert fc.wait_for("REQUEST_DATA_STREAM").req_message_rate == 7
        vehicle.close()


# ------------------------------------------------------------------------------------ the link


def test_lost_link_reconnects() -> None:
    def prepare(fc: FlightController) -> None:
        fc.answers["REQUEST_DATA_STREAM"] = lambda _: send_streams(fc)

    with on_stage(dronekit, {"link": "tcp", "mode": 4}, {"rate": 4}, prepare) as stage:
        streams = len(stage.fc.received("REQUEST_DATA_STREAM"))
        stage.fc.drop()
        stage.fc.custom_mode = 5
        until(lambda: stage.vehicle.mode == "LOITER")
        assert stage.commands_of(stage.assign("mode", "GUIDED"))[0][:3] == (176, 1, 4)
        until(lambda: len(stage.fc.received("REQUEST_DATA_STREAM")) > streams)


def test_close_delivers_recent_orders() -> None:
    with FlightController(mode=4) as fc:
        vehicle = dronekit.connect(fc.address, rate=None)
        vehicle.mode = "RTL"
        vehicle.close()
        vehicle.close()
        assert fc.wait_for_command(176).params[:2] == (1, 6)


def test_close_in_listener() -> None:
    closed = threading.Event()
    with on_stage(dronekit, {"mode": 4}) as stage:

        def close(vehicle: Any, name: str, value: Any) -> None:
            vehicle.close()
            closed.set()

        stage.vehicle.add_attribute_listener("heading", close)
        stage.fc.report("VFR_HUD", heading=271)
        assert closed.wait(100)
        with pytest.raises(dronekit.APIException):
            stage.vehicle.mode = "RTL"


# ------------------------------------------------------------------------------------ listeners


def test_blocking_listener_does_not_stop_reception_or_heartbeat(copter: Stage) -> None:
    blocks, go_on = threading.Event(), threading.Event()

    def block(*_: Any) -> None:
        blocks.set()
        assert go_on.wait(100)

    copter.vehicle.add_attribute_listener("heading", block)
    copter.fc.report("VFR_HUD", heading=271)
    assert blocks.wait(100)
    since = copter.fc.mark()
    copter.fc.report("VFR_HUD", heading=5)
    until(lambda: copter.vehicle.heading == 5)
    copter.fc.wait_for("HEARTBEAT", since=since)
    go_on.set()
    copter.settle()


def test_listeners_may_call_blocking_methods(copter: Stage) -> None:
    observed: list[Any] = []

    def use(vehicle: Any, name: str, value: Any) -> None:
        observed.append(vehicle.parameters["FOO"])
        observed.append(vehicle.parameters.set("FOO", 5))
        vehicle.wait_for_mode("LOITER", timeout=100)
        observed.append(vehicle.mode.name)
        observed.append(vehicle.wait_ready("mode", timeout=100))
        vehicle.arm(timeout=100)
        observed.append(vehicle.armed)

    copter.vehicle.add_attribute_listener("heading", use)
    copter.report("VFR_HUD", heading=271)
    assert observed == [1.0, True, "LOITER", True, True]


def test_listener_removing_itself_hides_nothing_from_next(copter: Stage) -> None:
    calls: list[str] = []

    def once(vehicle: Any, name: str, value: Any) -> None:
        calls.append("once")
        vehicle.remove_attribute_listener("heading", once)

    copter.vehicle.add_attribute_listener("heading", once)
    copter.vehicle.add_attribute_listener("heading", lambda *_: calls.append("next"))
    for heading in (1, 2):
        copter.report("VFR_HUD", heading=heading)
    assert calls == ["once", "next", "next"]


def test_long_texts_are_joined_and_odd_severities_logged(copter: Stage) -> None:
    with copter.logged("autopilot", having="d") as lines:
        copter.fc.report("STATUSTEXT", severity=4, text=b"x" * 50, id=7, chunk_seq=0)
        copter.fc.report("STATUSTEXT", severity=4, text=b" and the end", id=7, chunk_seq=1)
        copter.report("STATUSTEXT", severity=9, text=b"odd")
    assert lines == [f"WARNING {'x' * 50} and the end", "DEBUG odd"]
