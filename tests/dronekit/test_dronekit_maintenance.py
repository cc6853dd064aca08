"""Calibrations, tunes, reboots and capability requests: messages and rejections."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from dronekit_stage import Stage, on_stage
from flight_controller import FlightController

from aerokit import dronekit
from aerokit.dronekit import flight_orders as maintenance

CALIBRATION, MAG_CALIBRATION, REBOOT, CAPABILITIES = 241, 42424, 246, 520
FAILED, IN_PROGRESS = 4, 5


@pytest.fixture
def stage() -> Iterator[Stage]:
    with on_stage(dronekit, connect={"rate": None}) as opened:
        yield opened


def test_calibrations_send_commands(stage: Stage) -> None:
    vehicle = stage.vehicle
    orders: tuple[tuple[Callable[[], object], tuple[int, ...]], ...] = (
        (vehicle.send_calibrate_gyro, (CALIBRATION, 1, 0, 0, 0, 0, 0, 0)),
        (vehicle.send_calibrate_barometer, (CALIBRATION, 0, 0, 1, 0, 0, 0, 0)),
        (vehicle.send_calibrate_vehicle_level, (CALIBRATION, 0, 0, 0, 0, 2, 0, 0)),
        (vehicle.send_calibrate_accelerometer, (CALIBRATION, 0, 0, 0, 0, 1, 0, 0)),
        (lambda: vehicle.send_calibrate_accelerometer(simple=True), (CALIBRATION, 0, 0, 0, 0, 4, 0, 0)),
        (vehicle.send_calibrate_magnetometer, (MAG_CALIBRATION, 0, 1, 1, 0, 0, 0, 0)),
    )
    for order, expected in orders:
        assert stage.commands_of(order) == [expected]


def test_compass_calibration_px4_uses_other_command() -> None:
    with on_stage(dronekit, {"autopilot": 12}, {"rate": None}) as stage:
        sent = stage.commands_of(stage.vehicle.send_calibrate_magnetometer)
        assert sent == [(CALIBRATION, 0, 1, 0, 0, 0, 0, 0)]


def test_rejected_calibration_is_a_warning_with_reason(stage: Stage) -> None:
    stage.fc.results[CALIBRATION] = FAILED
    stage.fc.reasons[CALIBRATION] = "Disarm to allow calibration"
    with stage.logged() as lines:
        stage.vehicle.send_calibrate_gyro()
        stage.vehicle._handler.calls.wait(10.0)
    assert [line for line in lines if "FAILED" in line and "Disarm to allow calibration" in line]


def test_long_calibration_is_sent_once(stage: Stage) -> None:
    stage.fc.results[CALIBRATION] = IN_PROGRESS
    since = stage.fc.mark()
    with stage.logged() as lines:
        stage.vehicle.send_calibrate_gyro()
        stage.fc.wait_for_command(CALIBRATION, since=since)
        stage.settle()
        stage.report("COMMAND_ACK", command=CALIBRATION, result=0)
        stage.vehicle._handler.calls.wait(10.0)
    assert len(stage.fc.commands(CALIBRATION, since=since)) == 1
    assert not [line for line in lines if line.startswith("WARNING")]


ONCE = [name for name in vars(maintenance.Maintenance) if name.startswith("send_calibrate_")] + ["reboot"]


@pytest.mark.parametrize("name", ONCE)
def test_maintenance_with_lost_answer_is_sent_once(stage: Stage, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for limit in ("CALIBRATION_TIMEOUT_S", "REBOOT_TIMEOUT_S"):
        monkeypatch.setattr(maintenance, limit, 0.4)  # eight heartbeats, after each of which it could be sent again
    stage.fc.results.update(dict.fromkeys((CALIBRATION, MAG_CALIBRATION, REBOOT)))
    since = stage.fc.mark()
    with stage.logged() as lines:
        getattr(stage.vehicle, name)()
        stage.vehicle._handler.calls.wait(10.0)
    stage.settle()
    assert len(stage.fc.commands(since=since)) == 1
    assert [line for line in lines if line.startswith("WARNING") and "COMMAND_ACK" in line]


def test_reboot_sends_command(stage: Stage) -> None:
    assert stage.commands_of(stage.vehicle.reboot) == [(REBOOT, 1, 0, 0, 0, 0, 0, 0)]


def test_send_capabilities_request_has_listener_arguments(stage: Stage) -> None:
    vehicle = stage.vehicle
    stage.reached()  # connecting asks for them, too
    for request in (vehicle.send_capabilities_request, vehicle.send_capabilties_request):
        since = stage.fc.mark()
        request(vehicle, "HEARTBEAT", None)
        stage.reached()
        (sent,) = stage.fc.commands(CAPABILITIES, since=since)
        assert (sent.target, sent.param1) == ((1, 0), 1)


# ---------------------------------------------------------------------------------------- tunes


def played(stage: Stage, tune: str | bytes) -> tuple[str, str]:
    (sent,) = stage.sent_by(lambda: stage.vehicle.play_tune(tune), "PLAY_TUNE")
    assert sent.target == (1, 0)
    return sent.tune, sent.tune2


def test_play_tune_accepts_str_and_bytes(stage: Stage) -> None:
    assert played(stage, "AAAA") == ("AAAA", "")
    assert played(stage, b"MFT240L8 O4aO5dc\0") == ("MFT240L8 O4aO5dc", "")


def test_long_tune_has_two_parts(stage: Stage) -> None:
    tune = "abcdefghij" * 23
    assert played(stage, tune) == (tune[:30], tune[30:])


def test_invalid_tune_is_rejected(stage: Stage) -> None:
    wrong: tuple[tuple[Any, str], ...] = (
        ("A" * 231, "231 characters"),
        ("ä", "ASCII"),
        (b"\xe4", "ASCII"),
        ("A\0B", "NUL"),
        (5, "ASCII"),
        (None, "ASCII"),
    )

    def play() -> None:
        for tune, text in wrong:
            with pytest.raises(ValueError, match=text):
                stage.vehicle.play_tune(tune)

    assert stage.sent_by(play, "PLAY_TUNE") == []


def test_play_tune_with_mavlink_1_raises() -> None:
    def prepare(controller: FlightController) -> None:
        controller.capabilities &= ~8192

    with on_stage(dronekit, {"version": 1}, {"rate": None}, prepare) as stage:
        stage.reached()
        with pytest.raises(dronekit.APIException, match="MAVLink 2"):
            stage.vehicle.play_tune("A")


def test_maintenance_after_close_raises(stage: Stage) -> None:
    vehicle = stage.vehicle
    vehicle.close()
    for order in (
        vehicle.send_calibrate_gyro,
        vehicle.send_calibrate_magnetometer,
        vehicle.send_calibrate_vehicle_level,
        vehicle.send_calibrate_barometer,
        vehicle.send_calibrate_accelerometer,
        vehicle.reboot,
        lambda: vehicle.play_tune("A"),
        lambda: vehicle.send_capabilities_request(vehicle, "HEARTBEAT", None),
    ):
        with pytest.raises(dronekit.APIException):
            order()
