"""Mode changes in recordings: commanded, or the reaction to a failsafe."""

from __future__ import annotations

from pathlib import Path

import pytest

from aerokit import messages as m
from aerokit.logs.flights import FlightLog, failsafes, read_flight
from aerokit.logs.flights.codes import error_text, failsafe_action
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.mavlink.tlog import TlogWriter

AUTO, LAND = 3, 9
SET_LAND = m.CommandLong(1, 1, MavCmd.DO_SET_MODE, 0, 1, LAND, 0, 0, 0, 0, 0)
START_MISSION = m.CommandLong(1, 1, MavCmd.MISSION_START, 0, 0, 0, 0, 0, 0, 0, 0)


def heartbeat(mode: int) -> Message:
    return m.Heartbeat(2, 3, 0x80 | 0x51, mode, 4, 3)


def recorded(path: Path, command: Message, *, landing_s: float, speed: float = 1.0) -> FlightLog:
    """A copter in AUTO gets a command at 10 s, and changes to LAND just before a text about a failsafe."""
    rows: list[tuple[float, int, Message]] = [
        (0.0, 1, heartbeat(AUTO)),
        (10.0, 255, command),
        (landing_s, 1, heartbeat(LAND)),
        (landing_s + 0.01, 1, m.Statustext(2, "Battery 1 is low 10.44V used 80 mAh")),
        *((float(second), 1, m.Attitude(second * 1000, 0, 0, 0, 0, 0, 0)) for second in range(60)),
    ]
    encoders = {system: FrameEncoder(system, 1) for system in (1, 255)}
    with TlogWriter(path) as writer:
        for time_s, system, message in sorted(rows, key=lambda row: row[0]):
            writer.write(encoders[system].encode(message), 1.7e9 + time_s / speed)
    return read_flight(path)


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_failsafe_mode_long_after_command_is_reaction(tmp_path: Path, speed: float) -> None:
    """Twenty seconds of the vehicle are two of a recording at ten times real speed."""
    flight = recorded(tmp_path / "log.tlog", SET_LAND, landing_s=30.0, speed=speed)
    (failsafe,) = failsafes(flight)
    assert failsafe.reaction == "mode AUTO → LAND immediately"


def test_failsafe_mode_after_command_for_other_mode_is_reaction(tmp_path: Path) -> None:
    (failsafe,) = failsafes(recorded(tmp_path / "log.tlog", START_MISSION, landing_s=12.0))
    assert failsafe.reaction == "mode AUTO → LAND immediately"


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_commanded_mode_is_no_reaction(tmp_path: Path, speed: float) -> None:
    flight = recorded(tmp_path / "log.tlog", SET_LAND, landing_s=12.0, speed=speed)
    (failsafe,) = failsafes(flight)
    assert (flight.modes[-1].reason, failsafe.reaction) == ("ordered", "no reaction was logged")


PX4_HOLD, PX4_MISSION, PX4_RTL, PX4_LAND = (4 << 16 | sub_mode << 24 for sub_mode in (3, 4, 5, 6))


def written(path: Path, rows: list[tuple[float, Message]]) -> FlightLog:
    """A recording of these messages of one vehicle."""
    encoder = FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for time_s, message in sorted(rows, key=lambda row: row[0]):
            writer.write(encoder.encode(message), 1.7e9 + time_s)
    return read_flight(path)


def px4_heartbeat(mode: int) -> Message:
    return m.Heartbeat(2, 12, 0x80 | 0x5D, mode, 4, 3)


def fix(fix_type: int, satellites: int) -> Message:
    return m.GpsRawInt(0, fix_type, 0, 0, 0, eph=100, epv=100, vel=0, cog=0, satellites_visible=satellites)


def test_lost_fix_explains_later_failsafe(tmp_path: Path) -> None:
    """PX4 does not name the cause, and continues with dead reckoning for five seconds."""
    flight = written(tmp_path / "log.tlog", [
        *((float(second), px4_heartbeat(PX4_MISSION if second < 25 else PX4_LAND)) for second in range(60)),
        *((float(second), fix(3, 10) if second < 20 else fix(1, 0)) for second in range(60)),
        (25.0, m.Statustext(2, "Failsafe activated")),
    ])  # fmt: skip
    (failsafe,) = failsafes(flight)
    assert (failsafe.kind, failsafe.time_s, failsafe.acted) == ("gps", 20.0, True)
    assert failsafe.evidence[0].text == "receiver 1 has no 3D fix any more, 0 satellites instead of 10"
    assert failsafe.reaction == "mode MISSION → LAND 5.0 s later"


def test_receiver_without_any_fix_has_lost_none(tmp_path: Path) -> None:
    rows = [(float(second), message) for second in range(30) for message in (px4_heartbeat(PX4_MISSION), fix(1, 0))]
    assert failsafes(written(tmp_path / "log.tlog", rows)) == []


def test_charge_state_names_cause_without_texts(tmp_path: Path) -> None:
    """The return is PX4's own decision, although it sends a command, which informs its components."""

    def battery(state: int) -> Message:
        return m.BatteryStatus(0, 0, 0, 32767, (13000, *(65535,) * 9), -1, 0, -1, 6, charge_state=state)

    flight = written(tmp_path / "log.tlog", [
        *((float(second), px4_heartbeat(PX4_MISSION if second < 25 else PX4_RTL)) for second in range(60)),
        *((float(second), battery(1 if second < 25 else 3)) for second in range(60)),
        (24.9, m.CommandLong(1, 0, MavCmd.NAV_RETURN_TO_LAUNCH, 0, 0, 0, 0, 0, 0, 0, 0)),
    ])  # fmt: skip
    (failsafe,) = failsafes(flight)
    assert (failsafe.kind, failsafe.acted) == ("battery", True)
    assert failsafe.evidence[0].text == "charge state critical (BATTERY_STATUS)"
    assert failsafe.reaction == "mode MISSION → RTL immediately"
    assert "mAh" not in " ".join(failsafe.context)


def test_return_after_hold_belongs_to_battery_failsafe(tmp_path: Path) -> None:
    """PX4 names the cause only when it begins to hold, five seconds before it returns."""
    modes = [(25.0, PX4_MISSION), (30.2, PX4_HOLD), (60.0, PX4_RTL)]
    flight = written(tmp_path / "log.tlog", [
        *((float(second), px4_heartbeat(next(mode for end, mode in modes if second <= end))) for second in range(60)),
        (25.1, m.Statustext(2, "Critical battery")),
        (25.1, m.Statustext(2, "Failsafe activated: entering Hold for 5 seconds")),
        (30.1, m.Statustext(2, "Failsafe activated")),
    ])  # fmt: skip
    (failsafe,) = failsafes(flight)
    assert (failsafe.kind, failsafe.acted, len(failsafe.evidence)) == ("battery", True, 3)


def test_mode_change_after_disarming_is_no_reaction(tmp_path: Path) -> None:
    disarmed = m.Heartbeat(2, 12, 0x5D, PX4_HOLD, 3, 3)
    flight = written(tmp_path / "log.tlog", [
        *((float(second), px4_heartbeat(PX4_RTL) if second < 40 else disarmed) for second in range(60)),
        (41.5, m.Statustext(2, "Critical battery")),
    ])  # fmt: skip
    (failsafe,) = failsafes(flight)
    assert (failsafe.reaction, failsafe.acted) == ("no reaction was logged", False)


def test_estimator_failsafe_without_satellites_is_one_failsafe(tmp_path: Path) -> None:
    """ArduCopter names the estimator, which has failed because the receiver has no fix."""
    flight = written(tmp_path / "log.tlog", [
        *((float(second), heartbeat(AUTO if second < 28 else LAND)) for second in range(60)),
        *((float(second), fix(3, 10) if second < 20 else fix(1, 3)) for second in range(60)),
        (28.0, m.Statustext(2, "EKF Failsafe: changed to LAND Mode")),
    ])  # fmt: skip
    (failsafe,) = failsafes(flight)
    assert (failsafe.kind, failsafe.acted, failsafe.reaction) == ("gps", True, "mode AUTO → LAND 8.0 s later")


@pytest.mark.parametrize(("vehicle", "parameter", "value", "meaning"), [
    ("ArduCopter 4.7.0", "BATT_FS_LOW_ACT", 2, "RTL"),
    ("ArduPlane 4.7.0", "BATT_FS_LOW_ACT", 2, "LAND"),
    ("PX4 1.17.0", "COM_LOW_BAT_ACT", 3, "Return if critical, Land in an emergency"),
    ("PX4 1.17.0", "COM_LOW_BAT_ACT", 1, ""),
    ("PX4 1.17.0", "NAV_DLL_ACT", 3, "lands"),
        ("ArduCopter 4.7.0", "FS_GCS_ENABLE", 5, "lands"),
        ("ArduCopter 4.7.0", "BATT_FS_LOW_ACT", 99, ""),
    ("ArduCopter 4.7.0", "BATT_FS_LOW_ACT", -1, ""),
    ("ArduCopter 4.7.0", "BATT_LOW_VOLT", 2, ""),
    ("", "BATT_FS_LOW_ACT", 2, ""),
])  # fmt: skip
def test_values_of_failsafe_parameters_are_explained(vehicle: str, parameter: str, value: float, meaning: str) -> None:
    assert failsafe_action(vehicle, parameter, value) == meaning


def test_first_text_of_px4_is_joined(tmp_path: Path) -> None:
    """PX4 numbers its texts from 0, which by the standard is the id of texts without chunks."""
    begin, end = "Preflight Fail: the first text after the start of ", "this link has two chunks"
    chunks: list[tuple[float, Message]] = [(1.0, m.Statustext(2, begin, 0, 0)), (1.1, m.Statustext(2, end, 0, 1))]
    for alive, texts in ((px4_heartbeat(PX4_HOLD), [begin + end]), (heartbeat(AUTO), [begin.rstrip(), end])):
        flight = written(tmp_path / "log.tlog", [*((float(second), alive) for second in range(4)), *chunks])
        assert [text.text for text in flight.texts] == texts


@pytest.mark.parametrize(
    ("code", "text"), [(3, "fence: above the maximum altitude and outside the circle"), (64, "fence")]
)
def test_fence_error_names_known_fences(code: int, text: str) -> None:
    assert error_text(9, code, "fence") == text
