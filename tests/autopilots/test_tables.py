"""Repeats the facts of each autopilot's class, so that a mistyped digit fails a test."""

from __future__ import annotations

import math
from typing import Any

import pytest
from for_each import for_each

from aerokit.autopilots import Autopilot, Mode, ModeTable, Reposition, SetpointRules, autopilot_for
from aerokit.autopilots import ardupilot as ardupilot_modes
from aerokit.autopilots.px4 import MODES, px4_custom_mode
from aerokit.autopilots.telemetry import ARDUPILOT_GROUPS, ESTIMATES, SENSORS, bit_names, version_text
from aerokit.mavlink import enums, messages
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Heartbeat

# ------------------------------------------------------------------------------------- modes

SPELT_OTHERWISE = {
    "FLY_BY_WIRE_A": "FBWA",
    "FLY_BY_WIRE_B": "FBWB",
    "LOITER_ALT_QLAND": "LOITERALTQLAND",
    "INITIALIZING": "INITIALISING",
    "MOTORDETECT": "MOTOR_DETECT",
    "SERVO_TEST": "SERVOTEST",
}
NOT_OF_THE_STANDARD = {
    ("CopterMode", 8): "POSITION",
    ("CopterMode", 10): "OF_LOITER",
    ("CopterMode", 29): "RATE_ACRO",
    ("RoverMode", 2): "LEARNING",
}


@pytest.mark.parametrize(
    ("name", "table"),
    [
        ("CopterMode", ardupilot_modes.COPTER),
        ("PlaneMode", ardupilot_modes.PLANE),
        ("RoverMode", ardupilot_modes.ROVER),
        ("SubMode", ardupilot_modes.SUB),
        ("TrackerMode", ardupilot_modes.TRACKER),
    ],
)
def test_ardupilot_modes_match_standard(name: str, table: ModeTable) -> None:
    theirs = {member.value: SPELT_OTHERWISE.get(member.name, member.name) for member in getattr(enums, name)} | {
        number: text for (kind, number), text in NOT_OF_THE_STANDARD.items() if kind == name
    }
    assert dict(table.numbers) == theirs


def test_px4_modes_table() -> None:
    main = "MANUAL ALTCTL POSCTL AUTO ACRO OFFBOARD STABILIZED RATTITUDE SIMPLE TERMINATION ALTITUDE_CRUISE"
    auto = "READY TAKEOFF LOITER MISSION RTL LAND RTGS FOLLOWME PRECLAND VTOL_TAKEOFF"
    expected = {px4_custom_mode(number): name for number, name in enumerate(main.split(), 1)}
    del expected[px4_custom_mode(4)]
    expected |= {4 << 16 | number << 24: name for number, name in enumerate(auto.split(), 1)}
    expected |= {4 << 16 | 10 + number << 24: f"EXTERNAL{number}" for number in range(1, 9)}
    expected |= {3 << 16 | 1 << 24: "ORBIT", 3 << 16 | 2 << 24: "POSITION_SLOW"}
    assert dict(MODES.numbers) == expected
    px4 = of(12, 2)
    for sub, is_external in ((10, False), (11, True), (18, True), (19, False)):
        mode = px4.mode(px4_custom_mode(4, sub), 1, {px4_custom_mode(4, sub): "Mine"})
        assert (mode.name == "Mine") is (is_external or sub == 19)  # 19 has no name of its own
        assert px4.learn_mode_name(px4_custom_mode(4, sub), "Mine") == (None if sub == 10 else "Mine")


def test_mode_has_name_and_number() -> None:
    assert Mode("AUTO", 3) == Mode("AUTO", 3, 209)
    assert Mode("AUTO", 3) != Mode("AUTO", 10)
    assert Mode("AUTO", 3) != Mode("MISSION", 3)
    assert Mode("AUTO", 3) != "AUTO"


# -------------------------------------------------------------------------------------- bits


def test_bit_names_match_standard() -> None:
    assert list(SENSORS) == [1 << bit for bit in range(31)]
    assert list(ESTIMATES) == [1 << bit for bit in range(10)]
    assert bit_names(0x8000_0000 | 4 | 0x0200_0000, SENSORS) == ("compass", "battery")


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [
        (0, "-dev"),
        (63, "-dev"),
        (64, "-alpha"),
        (127, "-alpha"),
        (128, "-beta"),
        (191, "-beta"),
        (192, "-rc"),
        (254, "-rc"),
        (255, ""),
    ],
)
def test_version_types_match_standard(kind: int, suffix: str) -> None:
    assert version_text(0x0102_0300 | kind) == (f"1.2.3{suffix}", (1, 2, 3))


@pytest.mark.parametrize(
    ("autopilot", "needed"),
    [
        (12, {1: "attitude", 2: "horizontal velocity", 4: "vertical velocity", 32: "absolute altitude"}),
        (3, {1: "attitude", 32: "absolute altitude"}),
        (0, {1: "attitude", 32: "absolute altitude"}),
    ],
)
def test_missing_estimate_is_named(autopilot: int, needed: dict[int, str]) -> None:
    for bit in (1, 2, 4, 8, 32, 64, 128, 256):
        missing = of(autopilot, 2).missing_estimates(0x3FF & ~bit)
        assert missing == ((needed[bit],) if bit in needed else ())


def test_prearm_check_is_single_bit() -> None:
    for autopilot in (3, 12):
        table = of(autopilot, 2)
        assert table.failing_sensors(0x7FFF_FFFF, 0x7FFF_FFFF, 0x7FFF_FFFF & ~(1 << 28 | 1)) == ("gyroscope",)
        assert table.prearm_checks_pass(0x7FFF_FFFF, 0x7FFF_FFFF, 0x7FFF_FFFF & ~(1 << 28)) is False
        assert table.prearm_checks_pass(1 << 28, 1 << 28, 1 << 28) is True


# ---------------------------------------------------------------------------------- take-off


def test_take_off_parameters_have_only_altitude() -> None:
    for vehicle_type in (2, 20):
        plan = of(3, vehicle_type).take_off(7.0, None, is_vtol=False)
        assert plan is not None
        assert plan.params == (0, 0, 0, 0, 0, 0, 7.0)
    plan = of(12, 2).take_off(7.0, 500.0, is_vtol=False)
    assert plan is not None
    assert [param for param in plan.params if not math.isnan(param)] == [0, 0, 507.0]
    assert [place for place, param in enumerate(plan.params) if math.isnan(param)] == [0, 3, 4, 5]


def test_only_plane_must_complete_take_off() -> None:
    """The hold mode of a QuadPlane flies forward, too."""
    for vehicle_type, must_complete in ((2, False), (1, True), (20, True)):
        assert of(3, vehicle_type).must_complete_take_off is must_complete


@pytest.mark.parametrize(
    ("autopilot", "vehicle_type", "name"),
    [(3, 2, "GUIDED"), (3, 1, "FBWA"), (3, 10, "HOLD"), (12, 2, "LOITER"), (3, 12, None), (0, 2, None)],
)
def test_arming_mode_of_each_vehicle(autopilot: int, vehicle_type: int, name: str | None) -> None:
    mode = of(autopilot, vehicle_type).mode_to_arm_in()
    assert (None if mode is None else mode.name) == name


# ------------------------------------------------------------------------------------ streams


def test_stream_group_numbers() -> None:
    first_of: dict[int, type[Message]] = {
        1: messages.RawImu,
        2: messages.SysStatus,
        3: messages.ServoOutputRaw,
        4: messages.RcChannelsScaled,
        6: messages.LocalPositionNed,
        10: messages.EscTelemetry1To4,
        11: messages.VfrHud,
        12: messages.Vibration,
    }
    assert {ARDUPILOT_GROUPS[message.ID]: message for message in first_of.values()} == first_of
    assert set(ARDUPILOT_GROUPS.values()) == set(first_of)


# -------------------------------------------------------------------------------- other facts


def of(autopilot: int, vehicle_type: int) -> Autopilot:
    return autopilot_for(Heartbeat(vehicle_type, autopilot, 0, 0, 3))


UNKNOWN: dict[str, Any] = {
    **dict.fromkeys(("mission_completes_at_home", "condition_yaw", "has_parameter_hash"), False),
    **dict.fromkeys(("has_upper_case_parameters", "home_is_item_0", "prearm_depends_on_mode"), False),
    **dict.fromkeys(("lands_after_return", "prefers_log_messages", "mission_starts_by_command"), False),
    "holds_after_mission": False,
    **dict.fromkeys(("repeats_item_reached", "runs_prearm_checks", "mission_needs_take_off"), False),
    **dict.fromkeys(("sets_current_by_command", "silent_without_logs", "is_surface_vehicle"), False),
    **dict.fromkeys(("accepts_ftp_session_ids", "reports_mission_checksum", "writes_partial_missions"), False),
    "arrival_radius_m": 2.0,
    "first_log_id": 0,
    "parameter_interval_s": None,
    "reposition": None,
    "mission_download_window": 1,
    "mission_upload_window": 1,
    "overwrites_plans_in_place": {0, 1, 2},
    "unknown_currents_ca": {-1},
    "mode_when_landed": None,
    "reposition_purpose": "setpoint",
    "setpoints": SetpointRules(False, False, False, False, False, False, False, False, False, False),
}
ARDUPILOT = UNKNOWN | {
    **dict.fromkeys(("mission_completes_at_home", "has_upper_case_parameters", "home_is_item_0"), True),
    **dict.fromkeys(("prefers_log_messages", "mission_starts_by_command", "runs_prearm_checks"), True),
    **dict.fromkeys(("sets_current_by_command",), True),
    **dict.fromkeys(("accepts_ftp_session_ids", "writes_partial_missions"), True),
    "first_log_id": 1,
    "mission_download_window": 10,
    "mission_upload_window": 6,
    "parameter_interval_s": 0.02,
    "overwrites_plans_in_place": {0, 2},
}
STEERED = ARDUPILOT | {
    "reposition": Reposition(relative_altitude=True, yaw=False, speed=False),
}
COPTER = STEERED | {
    "mission_needs_take_off": True,
    "condition_yaw": True,
    "lands_after_return": True,
    "setpoints": SetpointRules(True, True, True, True, True, False, True, False, True, True),
}
PLANE = STEERED | {
    "arrival_radius_m": 90.0,
    "setpoints": SetpointRules(False, False, False, False, True, False, False, False, False, False),
}
ROVER = STEERED | {
    "arrival_radius_m": 4.0,
    "is_surface_vehicle": True,
    "setpoints": SetpointRules(True, True, True, False, True, False, True, False, False, False),
}
SUB = STEERED | {
    "condition_yaw": True,
    "mode_when_landed": "ALT_HOLD",
    "setpoints": SetpointRules(True, True, True, False, True, False, False, True, False, False),
}
PX4 = UNKNOWN | {
    **dict.fromkeys(("has_parameter_hash", "prearm_depends_on_mode", "lands_after_return"), True),
    "holds_after_mission": True,
    **dict.fromkeys(("repeats_item_reached", "silent_without_logs", "reports_mission_checksum"), True),
    "runs_prearm_checks": True,
    "mission_upload_window": 6,
    "overwrites_plans_in_place": set(),
    "unknown_currents_ca": {-1, -100},
    "reposition": Reposition(relative_altitude=False, yaw=True, speed=True),
    "reposition_purpose": "hold",
    "setpoints": SetpointRules(True, True, True, True, True, True, False, False, True, True),
}
PX4_DOWN = PX4 | {"lands_after_return": False}


@for_each(
    "autopilot, vehicle_type, firmware, habits",
    [
        (0, 2, "unknown", UNKNOWN),
        (3, 200, "ArduPilot", ARDUPILOT),
        *((3, kind, "ArduCopter", COPTER) for kind in (2, 3, 4, 13, 14, 15, 29, 35)),
        *((3, kind, "ArduPlane", PLANE) for kind in (1, 19, 20, 21, 22, 23, 24, 25)),
        *((3, kind, "Rover", ROVER) for kind in (10, 11)),
        (3, 12, "ArduSub", SUB),
        (3, 7, "Blimp", ARDUPILOT),
        (3, 5, "AntennaTracker", ARDUPILOT),
        (3, 18, "ArduPilot", ARDUPILOT),
        (3, 26, "ArduPilot", ARDUPILOT),
        (12, 2, "PX4", PX4),
        (12, 22, "PX4", PX4),
        (12, 1, "PX4", PX4_DOWN | {"arrival_radius_m": 120.0}),
        *((12, kind, "PX4", PX4_DOWN | {"is_surface_vehicle": True}) for kind in (10, 11)),
        (12, 12, "PX4", PX4_DOWN),
    ],
)
def test_autopilot_attributes(autopilot: int, vehicle_type: int, firmware: str, habits: dict[str, Any]) -> None:
    table = of(autopilot, vehicle_type)
    assert table.firmware == firmware
    assert {name: getattr(table, name) for name in habits} == habits
