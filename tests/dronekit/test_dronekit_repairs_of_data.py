"""DroneKit's faults with parameters, missions, channels, gimbals and messages, and the corrected behaviour."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from dronekit_scenarios_data import FIRST, SECOND, TAKEOFF, THIRD, downloaded, kept, waypoint
from dronekit_scenarios_orders import HOME, channels_of
from dronekit_stage import Stage, on_stage
from flight_controller import FlightController, message_of

import aerokit.dronekit as dronekit


@pytest.fixture
def copter() -> Iterator[Stage]:
    with on_stage(dronekit, {"mode": 4}) as stage:
        yield stage


# ----------------------------------------------------------------------------------- parameters


def test_parameter_set_during_download_is_kept() -> None:
    def prepare(fc: FlightController) -> None:
        def report_two(_: Any) -> None:
            fc.parameters.report("FOO")
            fc.parameters.report("BAR")

        fc.answers["PARAM_REQUEST_LIST"] = report_two
        fc.answers["PARAM_REQUEST_READ"] = lambda _: None

    with on_stage(dronekit, prepare=prepare) as stage:
        stage.fc.wait_for("PARAM_REQUEST_LIST")
        assert stage.vehicle.parameters.set("FOO", 0.5)
        stage.fc.parameters.report("THR_MIN")
        stage.vehicle.parameters.wait_ready()
        assert stage.vehicle.parameters["FOO"] == 0.5


def test_changed_parameter_count_loses_nothing(copter: Stage) -> None:
    parameters = copter.vehicle.parameters
    parameters.wait_ready()
    copter.fc.parameters.values["NEW"] = 8.0
    copter.fc.parameters.report("NEW")
    copter.settle()
    assert (parameters["NEW"], parameters["FOO"], len(parameters)) == (8.0, 1.0, 4)


def test_unchanged_parameter_value_is_confirmed(copter: Stage) -> None:
    copter.vehicle.parameters.wait_ready()
    copter.reached()  # no value of the download can confirm it now
    answer = copter.fc.answers["PARAM_SET"]
    results: list[bool] = []
    told_before: list[bool] = []

    def report_later(frame: Any) -> None:
        told_before.append(bool(results))  # retries may arrive later
        answer(frame)

    copter.fc.answers["PARAM_SET"] = report_later
    results.append(copter.vehicle.parameters.set("FOO", 1.0))
    assert (results, told_before[0]) == ([True], False)
    assert copter.fc.received("PARAM_SET")


# ------------------------------------------------------------------------------------- missions


def test_upload_without_download_keeps_first_command(copter: Stage) -> None:
    copter.fc.missions.items = [HOME, THIRD]
    commands = copter.vehicle.commands
    commands.clear()
    for item in (TAKEOFF, FIRST, SECOND):
        commands.add(waypoint(copter, item))
    commands.upload()
    assert [command for command, *_ in kept(copter)] == [16, 22, 16, 16]
    assert (len(commands), commands[0].command, commands[-1].z) == (3, 22, SECOND.z)


@pytest.mark.parametrize("result", [4, 15], ids=["NO_SPACE", "DENIED"])
def test_rejected_upload_raises_and_next_works(copter: Stage, result: int) -> None:
    commands = copter.vehicle.commands
    commands.clear()
    commands.add(waypoint(copter, TAKEOFF))
    copter.fc.missions.result = result
    with pytest.raises(dronekit.APIException):
        commands.upload()
    copter.fc.missions.result = 0
    commands.upload()
    assert [command for command, *_ in kept(copter)] == [16, 22]


def test_unanswered_upload_times_out_and_next_works(copter: Stage) -> None:
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
def test_upload_answers_both_request_types_exactly(copter: Stage, asks_int: bool) -> None:
    copter.fc.missions.asks_int = asks_int
    commands = copter.vehicle.commands
    commands.clear()
    commands.add(dronekit.Command(0, 0, 0, 3, 16, 0, 0, 0, 0, 0, 0, -35.3632611, 149.1652301, 30))
    commands.upload()
    (x, y) = kept(copter)[1][1:3]
    assert (x, y) == ((-35.3632611, 149.1652301) if asks_int else pytest.approx((x, y)))


def test_lost_mission_items_are_requested_again(copter: Stage) -> None:
    copter.fc.missions.items = [HOME, FIRST, SECOND, THIRD]
    copter.fc.missions.lost = {1: 1, 3: 1}
    assert [item.seq for item in downloaded(copter)] == [1, 2, 3]


@pytest.mark.parametrize("autopilot", [3, 12], ids=["ArduPilot", "PX4"])
def test_empty_mission(autopilot: int) -> None:
    mode = 3 << 16 if autopilot == 12 else 0
    with on_stage(dronekit, {"autopilot": autopilot, "mode": mode}) as stage:
        stage.fc.missions.has_home = autopilot == 3
        stage.fc.missions.items = [HOME] if autopilot == 3 else []
        assert len(downloaded(stage)) == 0


def test_failed_download_does_not_block_next(copter: Stage) -> None:
    copter.fc.missions.items = [HOME, FIRST]
    answer = copter.fc.answers.pop("MISSION_REQUEST_LIST")
    commands = copter.vehicle.commands
    commands.download()
    with pytest.raises(dronekit.TimeoutError):
        commands.wait_ready(timeout=0.2)
    copter.fc.answers["MISSION_REQUEST_LIST"] = answer
    assert len(downloaded(copter)) == 1


# -------------------------------------------------------------------------- channels and gimbal


def test_every_override_change_sends(copter: Stage) -> None:
    overrides = copter.vehicle.channels.overrides
    assert channels_of(copter, lambda: overrides.update({"1": 1100, "2": 1200})) == [(1100, 1200, *(0,) * 6)]
    assert channels_of(copter, lambda: overrides.setdefault("3", 1300)) == [(1100, 1200, 1300, *(0,) * 5)]
    assert channels_of(copter, lambda: overrides.pop("1")) == [(0, 1200, 1300, *(0,) * 5)]
    assert channels_of(copter, overrides.clear) == [(0,) * 8]
    assert (len(overrides), bool(overrides), 3 in overrides) == (0, False, False)


@pytest.mark.parametrize("angles", [(-90, 0, 0), (-45.5, 0, 12.5)])
def test_gimbal_uses_supported_commands(copter: Stage, angles: tuple[float, ...]) -> None:
    (sent,) = copter.sent_by(lambda: copter.vehicle.gimbal.rotate(*angles))
    assert (sent.command, sent.target[0], sent.params[:2]) == (1000, 1, (angles[0], angles[2]))


def test_gimbal_old_firmware(copter: Stage) -> None:
    copter.report("ATTITUDE", yaw=0.0)
    copter.fc.results.update({1000: 3, 205: 3})
    copter.vehicle.gimbal.rotate(-90, 0, 0)
    configure, control = copter.fc.wait_for("MOUNT_CONFIGURE"), copter.fc.wait_for("MOUNT_CONTROL")
    assert (configure.target, configure.mount_mode, control.target, control.input_a) == (
        (1, 1),
        2,
        (1, 1),
        -9000,
    )


def test_gimbal_target_location_above_sea_level(copter: Stage) -> None:
    place = dronekit.LocationGlobal(-35.1, 149.2, 600)
    copter.vehicle.gimbal.target_location(place)
    sent = copter.fc.wait_for("COMMAND_INT", lambda frame: frame.command == 195)
    assert (sent.frame, sent.x, sent.y, sent.z) == (5, -351000000, 1492000000, 600)


def test_send_mavlink_any_pymavlink_message(copter: Stage) -> None:
    message = message_of("PARAM_REQUEST_READ", param_id=b"FOO", param_index=-1, target_component=4)
    sent = copter.sent_by(lambda: copter.vehicle.send_mavlink(message), "PARAM_REQUEST_READ")
    assert [frame.param_id for frame in sent if frame.target == (1, 4)] == ["FOO"]
    assert message.target_system == 1
    rounded = copter.vehicle.message_factory.rc_channels_override_encode(0, 0, 1500.4, 0, 0, 0, 0, 0, 0, 0)
    (override,) = copter.sent_by(lambda: copter.vehicle.send_mavlink(rounded), "RC_CHANNELS_OVERRIDE")
    assert override.chan1_raw == 1500
