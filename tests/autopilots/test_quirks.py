"""Differences between autopilots other than modes: take-off, health, texts, versions and streams."""

from __future__ import annotations

import math

import pytest

from aerokit.autopilots import Autopilot, autopilot_for
from aerokit.autopilots.telemetry import ARDUPILOT_GROUPS, PREARM_CHECK
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import AutopilotVersion, Heartbeat

GPS, RC, GYRO = 0x20, 0x10000, 0x1


def autopilot(number: int, vehicle_type: int = 2) -> Autopilot:
    return autopilot_for(Heartbeat(vehicle_type, number, 81, 0, 3))


copter, px4, plane = autopilot(3), autopilot(12), autopilot(3, 1)


# ------------------------------------------------------------------------------------- take-off


def test_copter_takes_off_in_guided_above_home() -> None:
    plan = copter.take_off(20, None, is_vtol=False)
    assert plan is not None
    assert plan.mode is not None
    assert (plan.mode.name, plan.command, plan.params[6], plan.mode_after) == ("GUIDED", 22, 20, None)
    assert not copter.take_off_needs_home()


def test_px4_takes_off_above_sea_level_and_loiters() -> None:
    plan = px4.take_off(20, 488, is_vtol=False)
    assert plan is not None
    assert plan.mode is None
    assert plan.params[6] == 508
    assert all(math.isnan(plan.params[i]) for i in (3, 4, 5))
    assert plan.mode_after == px4.find_mode("LOITER")
    assert px4.take_off_needs_home()
    with pytest.raises(InvalidArgument, match="altitude of home"):
        px4.take_off(20, None, is_vtol=False)


def test_plane_takes_off_in_takeoff_mode_unless_vtol() -> None:
    plan = plane.take_off(50, None, is_vtol=False)
    assert plan is not None
    assert plan.mode is not None
    assert (plan.mode.name, plan.command) == ("TAKEOFF", None)
    hovering = plane.take_off(50, None, is_vtol=True)
    assert hovering == autopilot(3, 20).take_off(50, None, is_vtol=False)
    assert hovering is not None
    assert (hovering.command, hovering.params[6]) == (22, 50)


@pytest.mark.parametrize(("number", "vehicle_type"), [(3, 10), (3, 12), (3, 5), (12, 10), (12, 12), (0, 2)])
def test_surface_vehicles_have_no_take_off(number: int, vehicle_type: int) -> None:
    assert autopilot(number, vehicle_type).take_off(10, 0, is_vtol=False) is None


@pytest.mark.parametrize(("status", "landed"), [(3, 1), (4, 2), (5, None), (0, None)])
def test_landed_state_from_system_status(status: int, landed: int | None) -> None:
    for kind in (copter, plane):
        assert kind.landed_state_of(Heartbeat(2, 3, 81, 4, status)) == landed
    assert px4.landed_state_of(Heartbeat(2, 12, 81, 4, status)) is None
    assert autopilot(3, 10).landed_state_of(Heartbeat(10, 3, 81, 4, status)) is None


# --------------------------------------------------------------------------------------- health


def test_failing_sensors_are_present_enabled_and_unhealthy() -> None:
    present, enabled, healthy = GPS | RC | GYRO, GPS | GYRO | PREARM_CHECK, GYRO
    assert copter.failing_sensors(present | PREARM_CHECK, enabled, healthy) == ("GPS",)


def test_px4_missing_sensors_are_enabled_but_absent() -> None:
    assert px4.failing_sensors(GPS, GPS | RC, 0) == ("GPS", "RC receiver (missing)")
    assert copter.failing_sensors(GPS, GPS | RC, 0) == ("GPS",)


@pytest.mark.parametrize(
    ("kind", "present", "enabled", "healthy", "passes"),
    [
        (copter, True, True, True, True),
        (copter, True, True, False, False),
        (copter, True, False, True, None),  # all checks are disabled
        (px4, False, False, True, True),
        (px4, False, False, False, False),
    ],
)
def test_prearm_bit(kind: Autopilot, present: bool, enabled: bool, healthy: bool, passes: bool | None) -> None:
    assert kind.prearm_checks_pass(*(PREARM_CHECK * bit for bit in (present, enabled, healthy))) is passes


def test_ardupilot_missing_estimates() -> None:
    assert copter.missing_estimates(831) == ()  # reported in flight
    assert copter.missing_estimates(1 | 4 | 32 | 512) == ()  # on the ground a predicted position is enough
    assert copter.missing_estimates(1 | 4 | 32 | 128) == ("absolute horizontal position",)
    assert copter.missing_estimates(1024) == (
        "attitude",
        "absolute altitude",
        "absolute horizontal position",
        "initialisation",
    )
    assert copter.missing_estimates(831 | 0x8000) == ("GPS without glitches",)


def test_px4_missing_estimates() -> None:
    assert px4.missing_estimates(895) == ()  # reported in flight
    assert px4.missing_estimates(0xFF & ~16) == ("absolute horizontal position",)
    assert px4.missing_estimates(895 | 1024) == ("GPS without glitches",)


@pytest.mark.parametrize(
    ("kind", "text", "reason"),
    [
        (copter, "PreArm: RC not found", "RC not found"),
        (copter, "Arm: Compass not calibrated", "Compass not calibrated"),
        (copter, "Arming motors", None),
        (px4, "Preflight Fail: heading estimate not stable", "heading estimate not stable"),
        (px4, "Arming denied: Resolve system health failures first", "Resolve system health failures first"),
        (px4, "Armed by external command", None),
        (px4, "PreArm: of another autopilot", None),
    ],
)
def test_arming_reason_texts(kind: Autopilot, text: str, reason: str | None) -> None:
    assert kind.arming_reason(text) == reason


def test_refusal_texts() -> None:
    assert copter.is_refusal("Mode change to AUTO failed: init failed")
    assert copter.is_refusal("PreArm: RC not found")
    assert px4.is_refusal("Mission start denied! No valid mission")
    assert px4.is_refusal("Orbit command rejected")
    assert not copter.is_refusal("EKF3 IMU0 is using GPS")


# -------------------------------------------------------------------------------------- version


def version(flight_sw_version: int, custom: bytes) -> AutopilotVersion:
    return AutopilotVersion(0xFBEF, flight_sw_version, 0, 0, 5, custom, bytes(8), bytes(8), 6, 7, 8)


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0x0407_0000, "4.7.0-dev"),
        (0x0406_01C0, "4.6.1-rc"),
        (0x0406_02FF, "4.6.2"),
        (0x0111_0040, "1.17.0-alpha"),
        (0x0110_0180, "1.16.1-beta"),
        (0x0110_01FF, "1.16.1"),
    ],
)
def test_version_texts(number: int, text: str) -> None:
    assert copter.version_of(version(number, bytes(8))).firmware == text


def test_git_hashes() -> None:
    ardupilot = copter.version_of(version(0x0407_0000, b"21910f24"))
    assert (ardupilot.git_hash, ardupilot.number, str(ardupilot)) == (
        "21910f24",
        (4, 7, 0),
        "4.7.0-dev (21910f24)",
    )
    recorded = px4.version_of(version(0x0111_0040, bytes.fromhex("000000fdafded659")))
    assert recorded.git_hash == "59d6deaffd"
    assert px4.version_of(version(0, bytes(8))).git_hash == ""


def test_parameter_encoding_from_capabilities() -> None:
    assert px4.encodes_parameters_bytewise(0xE8FF)
    assert not copter.encodes_parameters_bytewise(0xFBEF & ~16)
    assert (px4.encodes_parameters_bytewise(None), copter.encodes_parameters_bytewise(None)) == (True, False)
    assert not px4.encodes_parameters_bytewise(0x20000)


# -------------------------------------------------------------------------------------- streams


def test_ardupilot_stream_groups() -> None:
    groups: dict[type[Message], int] = {
        messages.SysStatus: 2,
        messages.GpsRawInt: 2,
        messages.RcChannels: 3,
        messages.GlobalPositionInt: 6,
        messages.Attitude: 10,
        messages.VfrHud: 11,
        messages.EkfStatusReport: 12,
        messages.RawImu: 1,
    }
    assert {message: ARDUPILOT_GROUPS[message.ID] for message in groups} == groups
    assert copter.stream_groups == ARDUPILOT_GROUPS
    assert px4.stream_groups == {}


def test_estimator_message_of_each_autopilot() -> None:
    assert px4.sends(messages.EstimatorStatus)
    assert not px4.sends(messages.EkfStatusReport)
    assert not copter.sends(messages.EstimatorStatus)
