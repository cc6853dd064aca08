"""Log readers: each is checked against the known content of its file."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import log_files as wanted
import pytest

from aerokit import messages as m
from aerokit.errors import FileFormatError
from aerokit.logs.convert.topics import log_entry
from aerokit.logs.flights import FlightLog, failsafes, read_flight
from aerokit.logs.flights.codes import clean_text
from aerokit.logs.flights.flight_controllers import BinReader, UlogReader
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.tlog import TlogWriter, read_tlog
from aerokit.protocols.exchange import TransferProgress
from aerokit.vehicle.state.equipment import Battery

RECORDINGS = Path(__file__).parents[2] / "recordings"


@pytest.fixture(params=[".bin", ".ulg"])
def own_log(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == ".ulg":
        pytest.importorskip("pyulog")
    path = tmp_path / f"flight{request.param}"
    writers: dict[str, Callable[[Path], None]] = {".bin": wanted.write_bin, ".ulg": wanted.write_ulog}
    writers[request.param](path)
    return path


def test_flight_controller_log_matches_flight(own_log: Path) -> None:
    flight = read_flight(own_log)
    is_px4 = own_log.suffix == ".ulg"
    assert flight.vehicle == ("PX4 1.16.0" if is_px4 else "ArduCopter V4.6.1")
    assert flight.begins_at == pytest.approx(wanted.UNIX_AT_0 + 1, abs=0.01)
    assert flight.home is not None
    assert (flight.home.latitude_deg, flight.home.altitude_amsl_m) == pytest.approx((wanted.LATITUDE, 500.0))
    ((armed, disarmed),) = flight.armed
    assert (armed, disarmed) == pytest.approx((wanted.ARMED_S - 1, wanted.DISARMED_S - 1), abs=0.01)
    assert [change.name for change in flight.modes][-2:] == (["MISSION", "RTL"] if is_px4 else ["AUTO", "RTL"])
    assert flight.modes[-1].by_autopilot is True

    for at in (8.0, 14.0, 30.0):  # of the log, whose clock was 1 s when it began
        assert flight.track.at("altitude_relative_m", at) == pytest.approx(wanted.height_m(at + 1), abs=0.35)
        assert flight.position_target.at("altitude_relative_m", at) == pytest.approx(
            wanted.height_m(at + 1) + 0.5, abs=0.35
        )
        north = (flight.track.at("latitude_deg", at) - wanted.LATITUDE) * 111_177
        assert north == pytest.approx(wanted.north_m(at + 1), abs=0.5)
        east = (flight.position_target.at("longitude_deg", at) - wanted.LONGITUDE) * 75_950
        assert east == pytest.approx(2.0, abs=0.05)
        assert flight.batteries[0].at("voltage_v", at) == pytest.approx(wanted.voltage_v(at + 1), abs=0.03)
        assert flight.batteries[0].at("remaining_percent", at) == pytest.approx(99 - at, abs=1.1)
    assert {round(roll, 4) for roll in flight.attitude["roll_deg"]} == {2.0}
    assert flight.attitude_target["roll_deg"][5] == (0.0 if is_px4 else 1.0)
    assert flight.velocity["down_m_s"][5] == -3.0
    assert flight.velocity_target["north_m_s"][5] == 4.5
    assert max(flight.vibration["x_m_s2" if is_px4 else "z_m_s2"]) == 12.0
    assert flight.estimator["horizontal_position"][7] == pytest.approx(0.2)
    assert max(flight.estimator["velocity"]) == pytest.approx(0.1)
    assert flight.gps[0]["satellites"][3] == 14
    (change,) = flight.parameter_changes
    assert (change.name, change.before, change.after) == (
        ("BAT_LOW_THR", 0.25, 0.5) if is_px4 else ("WP_YAW_BEHAVIOR", 2.0, 0.0)
    )
    if is_px4:
        assert change.time_s == pytest.approx(11.0, abs=1.1)
    else:
        assert change.time_s == pytest.approx(11.0)
        assert [(item.number, item.command, item.altitude_m) for item in flight.mission] == [
            (0, 16, 0.0),
            (1, 16, 30.0),
        ]
        assert flight.attitude["yaw_deg"][0] == pytest.approx(-5.0)


def test_failsafe_in_flight_controller_log_is_explained(own_log: Path) -> None:
    (failsafe,) = failsafes(read_flight(own_log))
    assert failsafe.kind == "battery"
    assert failsafe.acted
    assert failsafe.time_s == pytest.approx(wanted.FAILSAFE_S - 1, abs=0.1)
    assert "→ RTL" in failsafe.reaction
    context = "\n".join(failsafe.context)
    assert "15.40 V" in context
    assert "30.0 m above home" in context
    assert ("BAT_LOW_THR = 0.5" if own_log.suffix == ".ulg" else "BATT_LOW_VOLT = 15.4") in context


@pytest.fixture(scope="module")
def px4() -> FlightLog:
    return read_flight(RECORDINGS / "px4-quad.tlog")


def test_tlog_of_real_vehicle_is_read(px4: FlightLog) -> None:
    decoded = [
        message
        for _, raw in read_tlog(px4.path)
        for message in [m.GlobalPositionInt.decode(raw[10:-2]) if raw[7:10] == b"\x21\0\0" else None]
        if message is not None
    ]
    assert len(px4.track) == len(decoded)
    assert list(px4.track["latitude_deg"]) == [each.lat / 1e7 for each in decoded]
    assert list(px4.track["altitude_relative_m"]) == [each.relative_alt / 1e3 for each in decoded]
    assert px4.autopilot == "PX4"
    assert px4.notes == [] or all("damaged" not in note for note in px4.notes)


def test_sequence_gaps_count_as_lost_messages(tmp_path: Path) -> None:
    path, encoder = tmp_path / "link.tlog", FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for i in range(400):
            raw = encoder.encode(m.Heartbeat(2, 3, 81, 0, 3, 3))
            if i < 100 or (i >= 200 and i % 4):  # two seconds well, two seconds silence, then three of four
                writer.write(raw, 1_700_000_000 + i / 50)
    flight = read_flight(path)
    by_second = dict(zip(flight.link.times, flight.link["lost_percent"], strict=True))
    assert by_second[0] == by_second[1] == 0
    assert by_second[2] == by_second[3] == 100
    assert by_second[6] == pytest.approx(25, abs=3)


def test_system_id_selects_vehicle_of_tlog(tmp_path: Path) -> None:
    path, encoders = tmp_path / "two.tlog", (FrameEncoder(1, 1), FrameEncoder(7, 1))
    station = FrameEncoder(255, 190)
    with TlogWriter(path) as writer:
        for i in range(20):
            for number, encoder in enumerate(encoders):
                raw = encoder.encode(m.Heartbeat(2, 3, 81 + 128 * number, 4 * number, 3, 3))
                writer.write(raw, 1_700_000_000 + i)
            writer.write(station.encode(m.Heartbeat(6, 8, 0, 0, 4, 3)), 1_700_000_000 + i)
    first, second = read_flight(path), read_flight(path, system_id=7)
    assert (first.system_id, first.modes[0].name, first.armed) == (1, "STABILIZE", [])
    assert (second.system_id, second.modes[0].name, second.armed) == (7, "GUIDED", [(0.0, 19.0)])
    assert any("system 7" in note for note in first.notes)
    assert any("ends while the vehicle is armed" in note for note in second.notes)
    with pytest.raises(FileFormatError, match="system id 9"):
        read_flight(path, system_id=9)


def test_damaged_messages_are_counted(tmp_path: Path, px4: FlightLog) -> None:
    data = bytearray(px4.path.read_bytes())
    at = data.index(b"\x21\0\0", len(data) // 2)
    data[at + 6] ^= 0x55
    path = tmp_path / "damaged.tlog"
    path.write_bytes(data[:-5])
    flight = read_flight(path)
    assert len(flight.track) in (len(px4.track) - 1, len(px4.track) - 2)
    assert any("1 messages are damaged" in note for note in flight.notes)


@pytest.mark.parametrize("suffix", [".tlog", ".bin", ".ulg", ".txt"])
def test_invalid_log_raises(tmp_path: Path, suffix: str) -> None:
    if suffix == ".ulg":
        pytest.importorskip("pyulog")
    path = tmp_path / f"no{suffix}"
    for content in (b"", b"no log at all", b"\xa3\x95" + bytes(500), b"ULog\x01\x12\x35\x01" + bytes(8)):
        path.write_bytes(content)
        with pytest.raises(FileFormatError):
            read_flight(path)


def test_progress_reaches_total(own_log: Path) -> None:
    reports: list[TransferProgress] = []
    read_flight(own_log, on_progress=reports.append)
    done = [each.done for each in reports]
    assert done == sorted(done)
    assert done[-1] == reports[-1].total == own_log.stat().st_size


def test_damaged_log_is_read_or_raises_file_format_error(own_log: Path) -> None:
    data, seeded = own_log.read_bytes(), random.Random(4)
    for _ in range(12):
        damaged = bytearray(data[: seeded.choice([len(data), seeded.randrange(len(data))])])
        for _ in range(seeded.choice([1, 5, 40])):
            damaged[seeded.randrange(min(len(damaged), 6000))] = seeded.randrange(256)
        own_log.write_bytes(damaged)
        with suppress(FileFormatError):
            failsafes(read_flight(own_log))


def test_truncated_heartbeat_is_ignored(tmp_path: Path) -> None:
    path, encoder = tmp_path / "short.tlog", FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for i in range(10):
            writer.write(encoder.encode(m.Heartbeat(2, 3, 81, 0, 3, 3)), 1_700_000_000 + i)
            writer.write(bytes((0xFD, 0, 0, 0, i, 255, 190, 0, 0, 0, 1, 2)), 1_700_000_000.5 + i)
    assert read_flight(path).modes[0].name == "STABILIZE"


def test_bin_texts_have_no_severity_and_no_colours(own_log: Path) -> None:
    texts = read_flight(own_log).texts
    if own_log.suffix == ".bin":
        assert {text.severity for text in texts} == {None}
    else:
        said = [(text.severity, text.text) for text in texts]
        assert said[1:] == [(4, "Failsafe activated"), (6, "[commander] Ready for takeoff!")]


@pytest.mark.parametrize(
    ("said", "read"),
    [
        ("\x1b[1;31mPreflight Fail\x1b[0m: no GPS\t", "Preflight Fail: no GPS"),
        ("a\x1b]0;title\x07b\x1b]2;x\x1b\\c", "abc"),
        ("bell\x07 \x9b1mand \x1bc the rest", "bell and c the rest"),
        ("two\nlines [32m of å text", "two\nlines [32m of å text"),
    ],
)
def test_control_characters_are_removed_from_texts(said: str, read: str) -> None:
    assert clean_text(said) == read


def test_unknown_battery_values_of_ardupilot_are_nan(tmp_path: Path) -> None:
    path = tmp_path / "flight.bin"
    wanted.write_bin(path)
    battery = read_flight(path).batteries[1]
    assert battery.has_values("voltage_v")
    assert not any(battery.has_values(name) for name in ("current_a", "used_mah", "remaining_percent"))


def test_unknown_battery_values_of_px4_are_nan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"
    rows = [row for row in wanted._ulog_rows() if row[1] != "battery_status"]
    rows += [(float(at), "battery_status", (0.0, -1.0, -1.0, -1.0)) for at in (2, 3)]
    monkeypatch.setattr(wanted, "_ulog_rows", lambda: rows)
    wanted.write_ulog(path)
    battery = read_flight(path).batteries[0]
    assert not any(battery.has_values(name) for name in battery)
    states = [dict(entry.states) for entry in UlogReader(path).entries(lambda _: None)]
    assert {state["batteries"] for state in states if "batteries" in state} == {(Battery(0, None, None, None),)}


def test_bin_entries_have_same_battery_states(tmp_path: Path) -> None:
    path = tmp_path / "flight.bin"
    wanted.write_bin(path)
    states = [dict(entry.states) for entry in BinReader(path).entries(lambda _: None)]
    said = [state["status_text"] for state in states if "status_text" in state]
    assert [(text.severity, text.text[:10]) for text in said] == [(None, "ArduCopter"), (None, "Battery 1 ")]
    assert log_entry(0.0, 1, said[0])["level"] == 0


def test_local_setpoints_without_recent_position_are_unknown(tmp_path: Path) -> None:
    path, encoder = tmp_path / "log.tlog", FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for second in range(10):
            messages = [m.Heartbeat(2, 12, 209, 4, 4, 3), m.LocalPositionNed(0, 10.0 * second, 0, 0, 0, 0, 0)]
            if second < 5:
                messages.append(m.GlobalPositionInt(0, 470_000_000, 80_000_000, 500_000, 20_000, 0, 0, 0, 0))
            messages.append(m.PositionTargetLocalNed(0, 1, 0xFF8, 10.0 * second, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
            for message in messages:
                writer.write(encoder.encode(message), 1.7e9 + second)
    target = read_flight(path).position_target
    for name in ("latitude_deg", "altitude_relative_m"):
        assert [math.isnan(value) for value in target[name]] == [False] * 7 + [True] * 3


def test_battery_voltage_of_zero_is_unknown_in_tlog(tmp_path: Path) -> None:
    path, encoder = tmp_path / "log.tlog", FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for message in (
            m.Heartbeat(2, 12, 209, 4, 4, 3),
            m.BatteryStatus(0, 0, 0, 32767, (0, *(65535,) * 9), 100, 10, -1, 90),
            m.SysStatus(0, 0, 0, 0, 12_000, -1, 90, 0, 0, 0, 0, 0, 0),
        ):
            writer.write(encoder.encode(message), 1.7e9)
    voltages = read_flight(path).batteries[0]["voltage_v"]
    assert math.isnan(voltages[0])
    assert voltages[1] == 12.0


@pytest.mark.parametrize(("ends_s", "is_noted"), [(60, True), (6, False)])
def test_missing_heartbeats_of_armed_vehicle_are_noted(ends_s: int, is_noted: bool, tmp_path: Path) -> None:
    """While no message arrives at all, the vehicle is silent, which the report says by itself."""
    path, encoder = tmp_path / "log.tlog", FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for second in (*range(ends_s + 1), 61):
            if second <= 5 or second == 61:
                writer.write(encoder.encode(m.Heartbeat(2, 3, 209, 4, 4, 3)), 1.7e9 + second)
            writer.write(encoder.encode(m.Attitude(second * 1000, 0, 0, 0, 0, 0, 0)), 1.7e9 + second)
    notes = read_flight(path).notes
    assert any(note.startswith("for 56 s, other messages arrived, but no HEARTBEAT") for note in notes) is is_noted
    assert any("HEARTBEAT" in note for note in notes) is is_noted
