"""Mode names and numbers: lookups, and comparison with pymavlink's tables where those are right."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

import pytest
from for_each import for_each
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil

from aerokit.autopilots import Autopilot, Mode, ModeOrder, Purpose, autopilot_for, px4_custom_mode
from aerokit.autopilots.modes import base_mode_name, is_armed
from aerokit.errors import InvalidArgument
from aerokit.mavlink.messages import Heartbeat

ARDUPILOT, PX4 = 3, 12
TYPES = {
    "copter": 2,
    "heli": 4,
    "plane": 1,
    "quadplane": 20,
    "rover": 10,
    "boat": 11,
    "sub": 12,
    "blimp": 7,
    "tracker": 5,
}


def ardupilot(kind: str) -> Autopilot:
    return autopilot_for(heartbeat(TYPES[kind]))


def heartbeat(vehicle_type: int, autopilot: int = ARDUPILOT, base_mode: int = 81, custom_mode: int = 0) -> Heartbeat:
    return Heartbeat(vehicle_type, autopilot, base_mode, custom_mode, 3)


px4 = autopilot_for(heartbeat(2, PX4))
EVERY_AUTOPILOT = [*(ardupilot(kind) for kind in TYPES), px4]


@pytest.mark.parametrize("kind", TYPES)
def test_mode_names_match_pymavlink(kind: str) -> None:
    theirs: Mapping[int, str] = mavutil.AP_MAV_TYPE_MODE_MAP_DEFAULT[TYPES[kind]]
    ours = ardupilot(kind).modes.numbers
    assert {number: ours.get(number) for number in theirs} == theirs


NEWER = {"sub": {20: "MOTOR_DETECT", 21: "SURFTRAK"}, "tracker": {3: "SERVOTEST"}}
"""Modes in ArduPilot 4.7's mode.h that pymavlink's tables lack."""


@pytest.mark.parametrize("kind", TYPES)
def test_further_mode_names_match_firmware(kind: str) -> None:
    theirs = mavutil.AP_MAV_TYPE_MODE_MAP_DEFAULT[TYPES[kind]]
    ours = ardupilot(kind).modes.numbers
    assert {n: name for n, name in ours.items() if n not in theirs} == NEWER.get(kind, {})


@for_each("name", mavutil.px4_map)
def test_px4_modes_match_pymavlink(name: str) -> None:
    _, main, sub = mavutil.px4_map[name]
    assert px4.find_mode(name).custom_mode == px4_custom_mode(main, sub)


def test_px4_modes_match_recorded_firmware() -> None:
    assert px4.find_mode("LOITER").custom_mode == 50593792
    assert px4.mode(50593792, 157) == Mode("LOITER", 50593792)
    assert px4.mode(px4_custom_mode(6), 157).name == "OFFBOARD"


@for_each("autopilot", EVERY_AUTOPILOT)
def test_mode_name_round_trip(autopilot: Autopilot) -> None:
    for number, name in autopilot.modes.numbers.items():
        for spelling in (name, name.lower(), name.replace("_", " ").title(), f" {name} "):
            assert autopilot.find_mode(spelling) == Mode(name, number)
        assert autopilot.find_mode(number).name == autopilot.mode(number, 1).name == name


@for_each("autopilot", EVERY_AUTOPILOT)
def test_purposes_name_existing_modes(autopilot: Autopilot) -> None:
    for purpose in get_args(Purpose):
        for is_vtol in (False, True):
            mode = autopilot.mode_for(purpose, is_vtol=is_vtol)
            assert mode is None or mode.name in autopilot.modes.names
    assert autopilot.unarmable_modes <= set(autopilot.modes.names)


@pytest.mark.parametrize(
    ("kind", "purpose", "is_vtol", "name"),
    [
        ("copter", "hold", False, "BRAKE"),
        ("copter", "land", False, "LAND"),
        ("copter", "setpoint", False, "GUIDED"),
        ("plane", "hold", False, "LOITER"),
        ("plane", "land", False, "AUTOLAND"),
        ("plane", "land", True, "QLAND"),
        ("quadplane", "return", False, "QRTL"),
        ("rover", "hold", False, "HOLD"),
        ("boat", "hold", False, "LOITER"),
        ("rover", "land", False, None),
        ("sub", "hold", False, "POSHOLD"),
        ("sub", "land", False, "SURFACE"),
        ("blimp", "setpoint", False, None),
    ],
)
def test_mode_for_purpose(kind: str, purpose: Purpose, is_vtol: bool, name: str | None) -> None:
    mode = ardupilot(kind).mode_for(purpose, is_vtol=is_vtol)
    assert (mode.name if mode else None) == name


@pytest.mark.parametrize(
    ("kind", "is_vtol", "modes"),
    [
        ("copter", True, {"RTL": True}),
        ("plane", False, {"RTL": False}),
        ("plane", True, {"QRTL": True, "RTL": False}),
        ("quadplane", False, {"QRTL": True, "RTL": False}),
        ("rover", False, {"RTL": False}),
        ("sub", False, {}),
    ],
)
def test_return_modes_and_which_of_them_land(kind: str, is_vtol: bool, modes: dict[str, bool]) -> None:
    autopilot = ardupilot(kind)
    assert {mode.name: autopilot.lands_at_home(mode) for mode in autopilot.return_modes(is_vtol=is_vtol)} == modes


@pytest.mark.parametrize("alias", ["AUTO.LOITER", "hold", "Auto Loiter"])
def test_px4_aliases(alias: str) -> None:
    assert px4.find_mode(alias).name == "LOITER"


@given(st.integers(0, 0xFFFF_FFFF))
def test_unknown_mode_number_name_parses(number: int) -> None:
    for autopilot in EVERY_AUTOPILOT:
        mode = autopilot.mode(number, 1)
        assert autopilot.find_mode(mode.name).custom_mode == number


def test_unknown_mode_error_lists_known_names() -> None:
    with pytest.raises(InvalidArgument, match=r"'guidde' is not known \(did you mean 'GUIDED'\?\).*RTL, CIRCLE"):
        ardupilot("copter").find_mode("guidde")
    with pytest.raises(InvalidArgument, match="0 to 4294967295"):
        ardupilot("copter").find_mode(-1)
    with pytest.raises(InvalidArgument):
        ardupilot("copter").find_mode("")


def test_reported_modes_are_found_by_name() -> None:
    copter = ardupilot("copter")
    assert copter.learn_mode_name(127, "Drone show") == "Drone show"
    assert copter.learn_mode_name(21, "SMARTRTL") is None  # already known with another spelling
    extra = {127: "Drone show"}
    assert copter.find_mode("drone_show", extra) == Mode("Drone show", 127)
    assert copter.mode(127, 81, extra).name == "Drone show"
    with pytest.raises(InvalidArgument, match="Drone show"):
        copter.find_mode("nonsense", extra)


def test_px4_external_modes_use_registered_names() -> None:
    number = px4_custom_mode(4, 11)
    assert px4.mode(number, 1).name == "EXTERNAL1"
    assert px4.learn_mode_name(number, "(Mode not available)") is None
    assert px4.learn_mode_name(px4_custom_mode(4, 3), "") is None  # standard modes have no name
    extra = {number: px4.learn_mode_name(number, "Precise landing") or ""}
    assert px4.mode(number, 1, extra).name == "Precise landing"
    assert px4.find_mode("precise landing", extra) == px4.find_mode("EXTERNAL1", extra)
    assert px4.find_mode("EXTERNAL1", extra).name == "Precise landing"


def test_mode_order_parameters() -> None:
    copter = ardupilot("copter")
    order = copter.mode_order(copter.find_mode("GUIDED"))
    assert order == ModeOrder((1, 4, 0), 1, 4)
    px4_order = px4.mode_order(px4.find_mode("RTL"))
    assert px4_order == ModeOrder((1, 4, 5), 1, px4_custom_mode(4, 5))
    message = px4_order.legacy(target_system=7)
    assert (message.target_system, message.base_mode, message.custom_mode) == (7, 1, px4_custom_mode(4, 5))


def test_mode_equality_ignores_arming() -> None:
    copter = ardupilot("copter")
    assert copter.mode(4, 81) == copter.mode(4, 209)
    assert len({copter.mode(4, 81), copter.mode(4, 209)}) == 1
    assert str(copter.mode(4, 81)) == "GUIDED"


def test_unknown_autopilot_mode_from_base_mode() -> None:
    other = autopilot_for(heartbeat(2, autopilot=0))
    names = {other.mode_of(heartbeat(2, 0, base_mode)).name for base_mode in (0, 4, 8, 16, 64)}
    assert names == {"PREFLIGHT", "AUTO", "GUIDED", "STABILIZE", "MANUAL"}
    assert other.mode(5, 1).name == "MODE 5"
    assert other.mode_for("hold") is None
    assert other.take_off(10, None, is_vtol=False) is None


def test_unknown_ardupilot_type_is_ardupilot() -> None:
    other = autopilot_for(heartbeat(200))
    assert other.home_is_item_0
    assert other.mode(5, 1).name == "MODE 5"


@pytest.mark.parametrize("others", [0, 1, 2, 32, 128, 1 | 2 | 32 | 128])
def test_base_mode_name_is_most_automatic_flag(others: int) -> None:
    """AUTO is 4, GUIDED 8, STABILIZE 16, MANUAL 64; the other flags do not depend on the mode."""
    names = {flags: base_mode_name(flags | others) for flags in (0, 4, 8, 16, 64)}
    assert names == {0: "PREFLIGHT", 4: "AUTO", 8: "GUIDED", 16: "STABILIZE", 64: "MANUAL"}
    assert [base_mode_name(flags | others) for flags in (92, 88, 80)] == ["AUTO", "GUIDED", "STABILIZE"]


def test_armed_flag_of_base_mode() -> None:
    assert [is_armed(flags) for flags in range(256)] == [False] * 128 + [True] * 128


@pytest.mark.parametrize("number", [0, (1 << 32) - 1])
def test_custom_mode_must_fit_32_bits(number: int) -> None:
    assert autopilot_for(heartbeat(2)).find_mode(number).custom_mode == number
    for wrong in (-1, 1 << 32):
        with pytest.raises(InvalidArgument, match=f"mode = {wrong} .* from 0 to 4294967295"):
            autopilot_for(heartbeat(2)).find_mode(wrong)


def test_mode_of_thousands_of_digits_is_refused() -> None:
    with pytest.raises(InvalidArgument, match=r"is not known; this vehicle's modes are"):
        ardupilot("copter").find_mode("9" * 5000)
