"""Arming checks of Plane, Rover and Sub; see test_copter_arming for those of Copter."""

from __future__ import annotations

import pytest
from simulated_client import Client, set_mode
from vehicles import ARM, arm, driving_rover, flying_plane, ready, ready_plane, ready_rover, ready_sub

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavModeFlag, MavResult, PlaneMode, RoverMode, SubMode
from aerokit.sim import SimulatedPlane, SimulatedRover, SimulatedSub
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

KINDS = [SimulatedPlane, SimulatedRover, SimulatedSub]


def arming_refusals(client: Client) -> list[str]:
    """Try to arm and return the reasons of the refusal."""
    client.clear()
    result = client.command(ARM, 1)
    assert (result == MavResult.ACCEPTED) != any(text.startswith("Arm: ") for text in client.texts)
    return [text.removeprefix("Arm: ") for text in client.texts if text.startswith("Arm: ")]


# -------------------------------------------------------------------------------- every kind


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"BATT_ARM_VOLT": 13.0}, "Battery 1 below minimum arming voltage"),
        ({"BATT_ARM_MAH": 4000.0}, "Battery 1 below minimum arming capacity"),
        ({"BATT_LOW_VOLT": 13.0}, "Battery 1 low voltage failsafe"),
        ({"BATT_LOW_MAH": 4000.0}, "Battery 1 low capacity failsafe"),
        ({"BATT_CRT_VOLT": 12.9, "BATT_LOW_VOLT": 9.0}, "Battery 1 critical voltage failsafe"),
        ({"BATT_CRT_VOLT": 9.5, "BATT_LOW_VOLT": 9.0}, "Battery 1 voltage failsafe critical >= low"),
        ({"FENCE_ENABLE": 1.0, "FENCE_TYPE": 4.0}, "Fences enabled, but none selected"),
        ({"FENCE_ENABLE": 1.0, "FENCE_TYPE": 2.0, "FENCE_RADIUS": -1.0}, "Invalid Circle FENCE_RADIUS value"),
    ],
)
def test_battery_and_fence_failures_prevent_arming(
    kind: type[ArduPilotVehicle], parameters: dict[str, float], reason: str
) -> None:
    client = ready(kind(boot_time_s=0.0, parameters={"BATT_CAPACITY": 3300.0, **parameters}))
    assert arming_refusals(client) == [reason]


@pytest.mark.parametrize("kind", KINDS)
def test_arming_check_can_be_disabled(kind: type[ArduPilotVehicle]) -> None:
    vehicle = kind(boot_time_s=0.0, parameters={"BATT_ARM_VOLT": 13.0, "ARMING_CHECK": 64.0})
    assert arming_refusals(ready(vehicle)) == []


@pytest.mark.parametrize("kind", KINDS)
def test_arming_without_checks_warns(kind: type[ArduPilotVehicle]) -> None:
    vehicle = kind(boot_time_s=0.0, parameters={"BATT_ARM_VOLT": 13.0, "ARMING_CHECK": 0.0})
    client = ready(vehicle)
    assert arming_refusals(client) == []
    client.run(0.1)
    assert client.texts == ["Warning: Arming Checks Disabled", vehicle.arming.ARMED_TEXT]


@pytest.mark.parametrize("kind", KINDS)
def test_moved_sticks_prevent_arming(kind: type[ArduPilotVehicle]) -> None:
    vehicle = kind(boot_time_s=0.0)
    client = ready(vehicle)
    vehicle.rc[0], vehicle.rc[3] = 1600, 1400
    assert arming_refusals(client) == ["Roll (RC1) is not neutral", "Yaw (RC4) is not neutral"]
    vehicle.rc[0] = vehicle.rc[3] = 1525
    assert arming_refusals(client) == [], "within the dead zone"


@pytest.mark.parametrize("kind", [SimulatedPlane, SimulatedRover])
def test_raised_throttle_prevents_arming_if_checked(kind: type[ArduPilotVehicle]) -> None:
    vehicle = kind(boot_time_s=0.0)
    client = ready(vehicle)
    vehicle.rc[2] = 1700
    assert arming_refusals(client) == ["Throttle (RC3) is not neutral"]
    vehicle.parameters["RC_OPTIONS"] = 0.0
    assert arming_refusals(client) == []


def test_sub_arming_ignores_throttle_stick() -> None:
    sub, client = ready_sub()
    sub.rc[2] = 1700
    assert arming_refusals(client) == []


@pytest.mark.parametrize("kind", KINDS)
def test_forced_arming_skips_checks(kind: type[ArduPilotVehicle]) -> None:
    vehicle = kind(boot_time_s=0.0, parameters={"BATT_ARM_VOLT": 13.0})
    vehicle.faults.prearm_failures = ["Compass not healthy"]
    client = ready(vehicle)
    assert client.command(ARM, 1, 21196.0) == MavResult.ACCEPTED


@pytest.mark.parametrize("kind", KINDS)
def test_new_prearm_failure_is_reported_immediately_then_periodically(kind: type[ArduPilotVehicle]) -> None:
    vehicle = kind(boot_time_s=0.0)
    client = ready(vehicle)
    client.run(5.0)
    vehicle.parameters["BATT_ARM_VOLT"] = 13.0
    client.run(1.5)
    text = "PreArm: Battery 1 below minimum arming voltage"
    assert client.texts == [text]
    client.run(27.0)
    assert client.texts == [text]
    client.run(3.0)
    assert client.texts == [text] * 2


@pytest.mark.parametrize("kind", [SimulatedPlane, SimulatedRover])
def test_arming_require_zero_is_always_armed(kind: type[ArduPilotVehicle]) -> None:
    vehicle = kind(boot_time_s=0.0)
    client = ready(vehicle)
    vehicle.parameters["ARMING_REQUIRE"] = 0.0
    client.run(2.1)
    assert client.last(m.Heartbeat).base_mode & MavModeFlag.SAFETY_ARMED
    assert client.texts == []
    assert client.command(ARM, 0, 21196.0) == MavResult.FAILED
    vehicle.parameters["ARMING_REQUIRE"] = 1.0
    client.run(2.1)
    assert not vehicle.is_armed


# ------------------------------------------------------------------------------------------- plane


def test_plane_arming_depends_on_mode() -> None:
    _, client = ready_plane()
    not_armable = {}
    for mode in (0, 1, 2, 5, 6, 7, 11, 12, 13, 15):
        assert set_mode(client, mode) == MavResult.ACCEPTED
        not_armable[mode] = arming_refusals(client)
        client.command(ARM, 0, 21196.0)
    assert {mode: text for mode, text in not_armable.items() if text} == {11: ["RTL mode not armable"]}


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("FS_LONG_TIMEOUT", 1.0, "FS_LONG_TIMEOUT < FS_SHORT_TIMEOUT"),
        ("ROLL_LIMIT_DEG", 2.0, "ROLL_LIMIT_DEG too small (2.0)"),
        ("PTCH_LIM_MAX_DEG", 2.0, "PTCH_LIM_MAX_DEG too small (2.0)"),
        ("PTCH_LIM_MIN_DEG", -2.0, "PTCH_LIM_MIN_DEG too large (-2.0)"),
        ("AIRSPEED_MIN", 4.0, "AIRSPEED_MIN too low (4 < 5)"),
    ],
)
def test_plane_invalid_limits_prevent_arming(name: str, value: float, reason: str) -> None:
    _, client = ready_plane(**{name: value})
    assert arming_refusals(client) == [reason]


def test_plane_arming_needs_gps_in_every_mode() -> None:
    plane, client = ready_plane()
    plane.faults.gps_lost = True
    client.run(1.0)
    assert set_mode(client, PlaneMode.MANUAL) == MavResult.ACCEPTED
    assert arming_refusals(client) == ["GPS 1: Bad fix"]


def test_plane_in_air_refuses_disarming() -> None:
    plane, client = flying_plane()
    assert client.command(ARM, 0) == MavResult.FAILED
    assert client.command(ARM, 0, 21196.0) == MavResult.ACCEPTED
    assert not plane.is_armed


# ------------------------------------------------------------------------------------------- rover


def test_rover_arming_needs_gps_in_some_modes() -> None:
    rover, client = ready_rover()
    rover.faults.gps_lost = True
    client.run(1.0)
    assert set_mode(client, RoverMode.GUIDED) == MavResult.ACCEPTED
    assert arming_refusals(client) == ["GPS 1: Bad fix"]
    assert set_mode(client, RoverMode.MANUAL) == MavResult.ACCEPTED
    rover.parameters["ARMING_NEED_LOC"] = 1.0
    assert arming_refusals(client) == ["GPS 1: Bad fix"]
    rover.parameters["ARMING_NEED_LOC"] = 0.0
    assert arming_refusals(client) == []


def test_rover_arming_depends_on_mode() -> None:
    _, client = ready_rover()
    not_armable = {}
    for mode in (0, 1, 3, 4, 5, 7, 9, 11, 12, 15):
        assert set_mode(client, mode) == MavResult.ACCEPTED
        not_armable[mode] = arming_refusals(client)
        client.command(ARM, 0)
    refused = {mode for mode, text in not_armable.items() if text == ["Mode not armable"]}
    assert refused == {RoverMode.RTL, RoverMode.SMART_RTL}


def test_rover_without_waypoint_speed_refuses_arming() -> None:
    _, client = ready_rover(WP_SPEED=0.0)
    assert arming_refusals(client) == ["WP_SPEED too low"]


def test_rover_disarms_at_any_time_and_sets_home() -> None:
    rover, client = driving_rover()
    client.run(5.0)
    assert client.command(ARM, 0) == MavResult.ACCEPTED
    assert rover.navigation.home is not None
    assert rover.navigation.home[0] == pytest.approx(rover.motion.north, abs=0.5)


# --------------------------------------------------------------------------------------------- sub


def test_sub_arming_needs_disarm_button() -> None:
    sub, client = ready_sub(BTN4_FUNCTION=0.0)
    assert arming_refusals(client) == ["Must assign a disarm or arm_toggle button or "], (
        "texts are cut at 50 characters"
    )
    sub.parameters["BTN3_FUNCTION"] = 2.0
    assert arming_refusals(client) == []


def test_sub_disarm_button_can_need_shift_button() -> None:
    sub, client = ready_sub(BTN4_FUNCTION=0.0, BTN5_FUNCTION=0.0, BTN3_SFUNCTION=4.0)
    assert arming_refusals(client)
    sub.parameters["BTN5_FUNCTION"] = 1.0
    assert arming_refusals(client) == []


def test_sub_arming_needs_gps_only_if_checked() -> None:
    sub, client = ready_sub()
    sub.faults.gps_lost = True
    client.run(1.0)
    arm(client, SubMode.MANUAL)
    client.command(ARM, 0)
    sub.parameters["ARMING_CHECK"] = 1.0
    assert arming_refusals(client) == ["GPS 1: Bad fix"]


def test_run_prearm_checks_reports_failures() -> None:
    _, client = ready_sub(BATT_ARM_VOLT=13.0)
    assert client.command(MavCmd.RUN_PREARM_CHECKS) == MavResult.ACCEPTED
    client.run(0.1)
    assert client.texts == ["PreArm: Battery 1 below minimum arming voltage"]
