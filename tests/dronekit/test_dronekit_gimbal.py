"""``vehicle.gimbal``: attitude, and commands by firmware."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
from dronekit_stage import Stage, on_stage
from flight_controller import Received

from aerokit import dronekit
from aerokit.dronekit import LocationGlobal, LocationGlobalRelative

PITCHYAW, CONFIGURE, MOUNT_CONTROL = 1000, 1001, 205
ROI_LOCATION, ROI_NONE, ROI = 195, 197, 201
DENIED, UNSUPPORTED, FAILED, LONG_ONLY = 2, 3, 4, 7
IN_VEHICLE_FRAME, IN_EARTH_FRAME, YAW_LOCK = 32, 64, 16
NAN = math.nan
PLACE = (-35.1234567, 149.7654321, 10)


@pytest.fixture
def stage() -> Iterator[Stage]:
    with on_stage(dronekit, connect={"rate": None}) as opened:
        yield opened


def angles(stage: Stage) -> tuple[float | None, float | None, float | None]:
    gimbal = stage.vehicle.gimbal
    return gimbal.pitch, gimbal.roll, gimbal.yaw


def quaternion(pitch: float, roll: float, yaw: float) -> list[float]:
    p, r, y = (math.radians(angle) / 2 for angle in (pitch, roll, yaw))
    return [
        math.cos(r) * math.cos(p) * math.cos(y) + math.sin(r) * math.sin(p) * math.sin(y),
        math.sin(r) * math.cos(p) * math.cos(y) - math.cos(r) * math.sin(p) * math.sin(y),
        math.cos(r) * math.sin(p) * math.cos(y) + math.sin(r) * math.cos(p) * math.sin(y),
        math.cos(r) * math.cos(p) * math.sin(y) - math.sin(r) * math.sin(p) * math.cos(y),
    ]


def send_device_attitude(
    stage: Stage, pitch: float, roll: float, yaw: float, flags: int = IN_VEHICLE_FRAME, **fields: Any
) -> None:
    fields.setdefault("delta_yaw", NAN)
    stage.report("GIMBAL_DEVICE_ATTITUDE_STATUS", flags=flags, q=quaternion(pitch, roll, yaw), **fields)


def params(frame: Received) -> tuple[int, tuple[float | None, ...]]:
    """Number and parameters without the zeros at their end; None for NaN."""
    values = [None if math.isnan(param) else round(param, 4) for param in frame.params]
    while values and values[-1] == 0:
        values.pop()
    return frame.command, tuple(values)


def commands(stage: Stage, order: Any) -> list[tuple[int, tuple[float | None, ...]]]:
    """The commands of an order, until it is done or was refused."""
    since = stage.fc.mark()
    order()
    stage.vehicle._handler.calls.wait(10.0)
    stage.reached()
    frames = stage.fc.commands(since=since)
    assert {frame.target for frame in frames} <= {(1, 1)}
    return [params(frame) for frame in frames]


# --------------------------------------------------------------------------------- orientation


def test_gimbal_angles_without_gimbal_are_none(stage: Stage) -> None:
    assert angles(stage) == (None, None, None)
    assert stage.vehicle.mount_status == [None, None, None]
    assert str(stage.vehicle.gimbal) == "Gimbal: pitch=None, roll=None, yaw=None"


def test_mount_status_is_unchanged(stage: Stage) -> None:
    events = stage.listen("*")
    stage.report("MOUNT_STATUS", pointing_a=-4500, pointing_b=100, pointing_c=-9000)
    assert str(stage.vehicle.gimbal) == "Gimbal: pitch=-45.0, roll=1.0, yaw=-90.0"
    assert stage.vehicle.mount_status == [-45.0, -90.0, 1.0]
    notified = [(name, value) for _, name, value in events if name in ("mount", "gimbal")]
    assert notified == [
        ("mount", "[-45.0, -90.0, 1.0]"),
        ("gimbal", "Gimbal: pitch=-45.0, roll=1.0, yaw=-90.0"),
    ]


def test_mount_orientation_yaw_is_from_north(stage: Stage) -> None:
    events = stage.listen("mount", "gimbal")
    stage.report("MOUNT_ORIENTATION", pitch=-30, roll=2, yaw=-10, yaw_absolute=350)
    assert angles(stage) == (-30, 2, 350)
    assert [name for _, name, _ in events] == ["gimbal"]
    stage.report("MOUNT_ORIENTATION", pitch=-30, roll=NAN, yaw=-10)
    assert angles(stage) == (-30, None, None)  # the vehicle's heading is not known yet
    stage.report("ATTITUDE", yaw=math.radians(5))
    stage.report("MOUNT_ORIENTATION", pitch=-30, roll=0, yaw=-10)
    assert angles(stage) == (-30, 0, 355)


def test_gimbal_device_yaw_is_from_north(stage: Stage) -> None:
    events = stage.listen("mount", "gimbal")
    send_device_attitude(stage, -45, 1, 10)
    assert angles(stage) == (-45, 1, None)  # the vehicle's heading is not known yet
    assert [name for _, name, _ in events] == ["mount", "gimbal"]
    stage.report("ATTITUDE", yaw=math.radians(-90))
    send_device_attitude(stage, -45, 1, 10)
    assert angles(stage) == (-45, 1, 280)
    send_device_attitude(stage, -45, 1, 10, delta_yaw=math.radians(100))
    assert angles(stage) == (-45, 1, 110)
    send_device_attitude(stage, -45, 1, 10, delta_yaw=0.0)  # as PX4 does for every gimbal
    assert angles(stage) == (-45, 1, 280)
    send_device_attitude(stage, -45, 1, 10, IN_EARTH_FRAME | YAW_LOCK)
    assert angles(stage) == (-45, 1, 10)
    send_device_attitude(stage, -45, 1, -10, YAW_LOCK)
    assert angles(stage) == (-45, 1, 350)
    send_device_attitude(stage, -45, 1, -10, 0, delta_yaw=1.0)
    assert angles(stage) == (-45, 1, 260)


@pytest.mark.parametrize("yaw", [0, 30, -170])
def test_rotate_straight_down(stage: Stage, yaw: float) -> None:
    send_device_attitude(stage, -90, 0, yaw, IN_EARTH_FRAME)
    assert angles(stage) == (-90, 0, yaw % 360)
    send_device_attitude(stage, 90, 0, yaw, IN_EARTH_FRAME)
    assert angles(stage) == (90, 0, yaw % 360)


def test_gimbal_with_unknown_angles_is_none(stage: Stage) -> None:
    stage.report("GIMBAL_DEVICE_ATTITUDE_STATUS", flags=IN_EARTH_FRAME, q=[NAN] * 4)
    assert angles(stage) == (None, None, None)
    stage.report("GIMBAL_DEVICE_ATTITUDE_STATUS", flags=IN_EARTH_FRAME, q=[0.0] * 4)
    assert angles(stage) == (None, None, None)


def test_gimbal_is_the_first_of_several(stage: Stage) -> None:
    send_device_attitude(stage, -20, 0, 0, IN_EARTH_FRAME, gimbal_device_id=2)
    send_device_attitude(stage, -10, 0, 0, IN_EARTH_FRAME, gimbal_device_id=1)
    send_device_attitude(stage, -20, 0, 0, IN_EARTH_FRAME, gimbal_device_id=2)
    send_device_attitude(stage, -30, 0, 0, IN_EARTH_FRAME, source=(1, 154))
    stage.report("MOUNT_ORIENTATION", pitch=-40, yaw_absolute=90)
    send_device_attitude(stage, -50, 0, 0, IN_EARTH_FRAME, source=(2, 1))
    assert angles(stage) == (-10, 0, 0)


# --------------------------------------------------------------------------------------- rotate


def test_rotate_uses_gimbal_manager_command(stage: Stage) -> None:
    assert commands(stage, lambda: stage.vehicle.gimbal.rotate(-90.5, 0, 200)) == [
        (PITCHYAW, (-90.5, 200, None, None, 28))
    ]


def test_gimbal_manager_denial_claims_control(stage: Stage) -> None:
    stage.fc.results[PITCHYAW] = DENIED
    with stage.logged() as lines:
        sent = commands(stage, lambda: stage.vehicle.gimbal.rotate(-45, 0, 0))
    turn = (PITCHYAW, (-45, 0, None, None, 28))
    assert sent == [turn, (CONFIGURE, (255, 0, -1, -1)), turn]
    assert [line for line in lines if line.startswith("WARNING gimbal: MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW")]
    assert commands(stage, stage.vehicle.gimbal.release) == [
        (MOUNT_CONTROL, (0, 0, 0, 0, 0, 0, 3)),
        (CONFIGURE, (-3, -3, -1, -1)),
    ]
    assert commands(stage, stage.vehicle.gimbal.release) == [(MOUNT_CONTROL, (0, 0, 0, 0, 0, 0, 3))]


def test_rotate_with_roll_uses_mount_command(stage: Stage) -> None:
    stage.report("ATTITUDE", yaw=math.radians(100))
    assert commands(stage, lambda: stage.vehicle.gimbal.rotate(-45, 5, 90)) == [
        (MOUNT_CONTROL, (-45, 5, -10, 0, 0, 0, 2))
    ]


def test_rotate_falls_back_to_mount_command(stage: Stage) -> None:
    stage.fc.results[PITCHYAW] = UNSUPPORTED
    stage.report("ATTITUDE", yaw=math.radians(-170))
    assert commands(stage, lambda: stage.vehicle.gimbal.rotate(-45, 0, 180)) == [
        (PITCHYAW, (-45, 180, None, None, 28)),
        (MOUNT_CONTROL, (-45, 0, -10, 0, 0, 0, 2)),
    ]


def test_gimbal_fast_orders_use_answers_to_replaced_ones(stage: Stage) -> None:
    gimbal = stage.vehicle.gimbal
    stage.fc.results[PITCHYAW] = DENIED
    gimbal.rotate(-45, 0, 0)
    stage.settle()
    stage.fc.wait_for_command(PITCHYAW)
    stage.settle()
    del stage.fc.results[PITCHYAW]
    assert commands(stage, lambda: gimbal.rotate(-46, 0, 0)) == [
        (CONFIGURE, (255, 0, -1, -1)),
        (PITCHYAW, (-46, 0, None, None, 28)),
    ]
    assert commands(stage, lambda: gimbal.rotate(-47, 0, 0)) == [(PITCHYAW, (-47, 0, None, None, 28))]


def test_rotate_falls_back_to_mount_messages(stage: Stage) -> None:
    stage.report("ATTITUDE", yaw=0.0)
    stage.fc.results.update({PITCHYAW: UNSUPPORTED, MOUNT_CONTROL: UNSUPPORTED})
    since = stage.fc.mark()
    with stage.logged() as lines:
        commands(stage, lambda: stage.vehicle.gimbal.rotate(-45.5, 0, 90))
        commands(stage, stage.vehicle.gimbal.release)
    first, control, last = stage.fc.received("MOUNT_CONFIGURE", "MOUNT_CONTROL", since=since)
    assert (first.mount_mode, last.mount_mode) == (2, 3)
    assert (control.input_a, control.input_b, control.input_c) == (-4550, 0, 9000)
    assert {message.target for message in (first, control, last)} == {(1, 1)}
    assert not [line for line in lines if line.startswith("WARNING")]


@pytest.mark.parametrize("wrong", [NAN, math.inf, None, "down"])
def test_gimbal_angles_must_be_numbers(stage: Stage, wrong: Any) -> None:
    gimbal = stage.vehicle.gimbal
    for angles in ((wrong, 0, 0), (0, wrong, 0), (0, 0, wrong)):
        with pytest.raises(ValueError, match="must be a finite number of degrees"):
            gimbal.rotate(*angles)
    assert commands(stage, lambda: None) == []


# -------------------------------------------------------------------------------------- places


def test_target_location_above_home_or_sea_level(stage: Stage) -> None:
    for kind, frame in ((LocationGlobalRelative, 6), (LocationGlobal, 5)):
        since = stage.fc.mark()
        commands(stage, lambda kind=kind: stage.vehicle.gimbal.target_location(kind(*PLACE)))
        (sent,) = stage.fc.commands(since=since)
        assert (sent.name, sent.command, sent.frame) == ("COMMAND_INT", ROI_LOCATION, frame)
        assert (sent.x, sent.y, sent.z) == (-351234567, 1497654321, 10)


@pytest.mark.parametrize("result", [UNSUPPORTED, LONG_ONLY])
def test_target_location_falls_back_to_old_command(stage: Stage, result: int) -> None:
    stage.fc.results[ROI_LOCATION] = result
    for kind, altitude in ((LocationGlobalRelative, 10), (LocationGlobal, 10 - 584)):
        since = stage.fc.mark()
        commands(stage, lambda kind=kind: stage.vehicle.gimbal.target_location(kind(*PLACE)))
        sent = stage.fc.commands(since=since)[-1]
        assert (sent.name, *params(sent)) == ("COMMAND_LONG", ROI, (3, 0, 0, 0, -35.1235, 149.7654, altitude))


def test_target_location_px4_uses_amsl_altitude() -> None:
    with on_stage(dronekit, {"autopilot": 12}, {"rate": None}) as stage:
        since = stage.fc.mark()
        commands(stage, lambda: stage.vehicle.gimbal.target_location(LocationGlobalRelative(*PLACE)))
        commands(stage, lambda: stage.vehicle.gimbal.target_location(LocationGlobal(*PLACE)))
        places = [(frame.frame, frame.z) for frame in stage.fc.commands(since=since)]
        assert places == [(5, 594), (5, 10)]


def test_target_location_zeros_end_it(stage: Stage) -> None:
    gimbal = stage.vehicle.gimbal
    assert commands(stage, lambda: gimbal.target_location(LocationGlobalRelative(0, 0, 0))) == [(ROI_NONE, ())]
    stage.fc.results[ROI_NONE] = UNSUPPORTED
    assert commands(stage, lambda: gimbal.target_location(LocationGlobal(0, 0, 0))) == [
        (ROI_NONE, ()),
        (ROI, ()),
    ]


def test_target_location_invalid_location_sends_nothing(stage: Stage) -> None:
    gimbal = stage.vehicle.gimbal
    for wrong, text in (
        (None, "Expecting roi"),
        ((1, 2, 3), "Expecting roi"),
        (LocationGlobal(1, 2), "location.alt = None"),
        (LocationGlobalRelative(91, 2, 3), "location.lat = 91"),
        (LocationGlobalRelative(1, NAN, 3), "location.lon = nan"),
    ):
        with pytest.raises(ValueError, match=text):
            gimbal.target_location(wrong)
    assert commands(stage, lambda: None) == []


def test_gimbal_rejection_is_a_warning(stage: Stage) -> None:
    stage.fc.results[PITCHYAW] = FAILED
    with stage.logged() as lines:
        assert len(commands(stage, lambda: stage.vehicle.gimbal.rotate(-45, 0, 0))) == 1
    assert [line for line in lines if "PITCHYAW was refused: FAILED" in line]


def test_gimbal_orders_after_close_raise(stage: Stage) -> None:
    stage.vehicle.close()
    gimbal = stage.vehicle.gimbal
    for order in (
        lambda: gimbal.rotate(0, 0, 0),
        gimbal.release,
        lambda: gimbal.target_location(LocationGlobalRelative(*PLACE)),
    ):
        with pytest.raises(dronekit.APIException):
            order()


def test_gimbal_angles_beyond_360_are_reduced(stage: Stage) -> None:
    """Programs add them up: a heading of 359 and 90 degrees to the right."""
    sent = commands(stage, lambda: stage.vehicle.gimbal.rotate(-10, 0, 449))
    assert sent == [(PITCHYAW, (-10, 89, None, None, 28))]
    sent = commands(stage, lambda: stage.vehicle.gimbal.rotate(0, 0, 360))
    assert sent == [(PITCHYAW, (0, 360, None, None, 28))]
