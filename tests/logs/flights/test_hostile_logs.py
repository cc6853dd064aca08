"""Logs with impossible times, texts and values, of other vehicles, and with two batteries."""

from __future__ import annotations

import csv
import math
import random
import struct
from collections.abc import Callable, Iterable
from pathlib import Path

import log_files
import pytest

from aerokit.errors import FileFormatError
from aerokit.logs.convert import convert
from aerokit.logs.convert.tables import CsvTable
from aerokit.logs.flights import failsafes, read_flight
from aerokit.logs.flights.flight import TimeSeries
from aerokit.logs.flights.flight_controllers import BinReader
from aerokit.logs.flights.records import TableColumn, TlogReader
from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.mavlink.message import Message
from aerokit.mavlink.tlog import TlogWriter

BEGIN = 1_700_000_000
HEARTBEAT = m.Heartbeat(2, 3, 81, 0, 3, 3)


def write_tlog(path: Path, messages: Iterable[tuple[int, Message]]) -> Path:
    """Heartbeats of vehicle 1, then messages of these systems, one a second."""
    encoders: dict[int, FrameEncoder] = {}
    with TlogWriter(path) as writer:
        for second, (system, message) in enumerate([(1, HEARTBEAT), *messages]):
            encoder = encoders.setdefault(system, FrameEncoder(system, 190 if system == 255 else 1))
            writer.write(encoder.encode(message), BEGIN + second)
    return path


def place(latitude_e7: int = 470_000_000, longitude_e7: int = 80_000_000) -> Message:
    return m.GlobalPositionInt(1000, latitude_e7, longitude_e7, 500_000, 10_000, 0, 0, 0, 0)


def item(number: int, target: int, x: float = 47.0, z: float = 10.0) -> Message:
    return m.MissionItem(target, 1, number, 3, 16, 0, 1, 0.0, 0.0, 0.0, 0.0, x, 8.0, z)


def item_int(number: int, target: int, command: int = 16) -> Message:
    return m.MissionItemInt(target, 1, number, 6, command, 0, 1, 0.0, 0.0, 0.0, 0.0, 470_000_000, 80_000_000, 10.0)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("suffix", "write"), [(".bin", log_files.write_bin), (".ulg", log_files.write_ulog)], ids=["bin", "ulg"]
)
@pytest.mark.parametrize("target", ["out.mcap", "out"])
def test_row_with_damaged_time_is_skipped(
    suffix: str, write: Callable[[Path], None], target: str, tmp_path: Path
) -> None:
    for package in ("pyulog", "mcap", "pymavlink"):
        pytest.importorskip(package)
    path = tmp_path / f"log{suffix}"
    write(path)
    at = struct.pack("<Q", 20_000_000)
    whole = path.read_bytes()
    assert at in whole
    path.write_bytes(whole.replace(at, struct.pack("<Q", 1 << 62), 1))
    done = convert(path, tmp_path / target)
    assert done.entries > 100
    assert any("1 damaged row was skipped" in note for note in done.notes)


def test_damaged_formats_raise_and_print_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pymavlink")
    path, seeded = tmp_path / "log.bin", random.Random(1)
    log_files.write_bin(path)
    data = bytearray(path.read_bytes())
    for _ in range(60):
        data[seeded.randrange(3, 1500)] ^= 0x55
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="cannot be read"):
        convert(path, tmp_path / "out.csv")
    assert capsys.readouterr().out == ""


def test_second_battery_is_not_taken_for_first(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    path = tmp_path / "log.bin"
    log_files.write_bin(path)
    number, form, _ = log_files.TABLES["BAT"]
    size = struct.calcsize("<QBfffB")
    data = bytearray(path.read_bytes())
    head = b"\xa3\x95" + bytes((number,))
    first = data.index(head, 4000)
    data[first:first] = head + struct.pack("<QBfffB", 1_000_000, 1, 3.3, 0.1, 0.0, 9)
    path.write_bytes(data)
    assert (form, size) == ("QBfffB", 22)
    messages = [
        value[0]
        for each in BinReader(path).entries(lambda _: None)
        for name, value in each.states
        if name == "batteries"
    ]
    assert len(messages) > 50
    assert all(battery.voltage_v > 14 for battery in messages)


def test_newline_in_text_starts_no_csv_row(tmp_path: Path) -> None:
    log = write_tlog(
        tmp_path / "log.tlog",
        [(1, m.Statustext(severity=4, text="well\rnot a row")), (1, m.Statustext(4, "fine"))],
    )
    convert(log, tmp_path / "out")
    with (tmp_path / "out" / "STATUSTEXT.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert [row[4] for row in rows] == ["text", "well\rnot a row", "fine"]
    assert b"\r\n" not in (tmp_path / "out" / "STATUSTEXT.csv").read_bytes()


@pytest.mark.parametrize(("text", "cell"), [("well\rnot", '"well\rnot"'), ("=1\r", '"\'=1\r"')])
def test_carriage_return_in_csv_is_quoted(text: str, cell: str, tmp_path: Path) -> None:
    log = write_tlog(tmp_path / "log.tlog", [(1, m.Statustext(severity=4, text=text))])
    convert(log, tmp_path / "out")
    assert cell in (tmp_path / "out" / "STATUSTEXT.csv").read_bytes().decode()


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("=cmd|' /C calc'!A0", "'=cmd|' /C calc'!A0"),
        ('+HYPERLINK("http://x","y")', '\'+HYPERLINK("http://x","y")'),
        ("-2+3", "'-2+3"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("\t=1", "'\t'=1"),
        ("\r=1", "'\r=1"),
        (" =1", "' =1"),
        ("a;=1", "a;'=1"),
        ("\uff1d1", "'\uff1d1"),
        ("EKF3 lane 1 - fine", "EKF3 lane 1 - fine"),
    ],
)
def test_text_in_csv_is_no_formula(text: str, cell: str, tmp_path: Path) -> None:
    messages = [
        m.Statustext(4, text),
        m.ParamValue(text[:16], -1.5, 9, 1, 0),
        m.Attitude(1, -0.25, 0, 0, 0, 0, 0),
    ]
    convert(write_tlog(tmp_path / "log.tlog", [(1, each) for each in messages]), tmp_path / "out")
    rows = {}
    for name in ("STATUSTEXT", "PARAM_VALUE", "ATTITUDE"):
        with (tmp_path / "out" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            (rows[name],) = csv.DictReader(file)
    assert rows["STATUSTEXT"]["text"] == cell
    assert rows["PARAM_VALUE"]["param_id"] == cell[: len(rows["PARAM_VALUE"]["param_id"])]
    assert float(rows["PARAM_VALUE"]["param_value"]) == -1.5  # a number, and no text after an apostrophe
    assert float(rows["ATTITUDE"]["roll_rad"]) == -0.25


def test_column_name_in_csv_is_no_formula(tmp_path: Path) -> None:
    table = CsvTable(tmp_path / "out.csv", [TableColumn("=1+1", "a", "str"), TableColumn("b", "b", "int")])
    table.close()
    assert (tmp_path / "out.csv").read_text() == "'=1+1,b\n"


def test_recording_of_fast_simulation_says_so(tmp_path: Path) -> None:
    def notes(boot_ms: Iterable[int]) -> str:
        messages = [(1, m.Attitude(ms, 0, 0, 0, 0, 0, 0)) for ms in boot_ms]
        return " ".join(read_flight(write_tlog(tmp_path / "log.tlog", messages)).notes)

    assert "simulation at 20 times real speed" in notes(range(0, 600_000, 20_000))
    assert "simulation at 2000 times real speed" in notes(range(0, 60_000_000, 2_000_000))
    assert "simulation at 0.5 times real speed" in notes(range(0, 60_000, 500))
    assert "simulation" not in notes(range(0, 60_000, 1000))
    # Reboots and delayed messages are no sign of another speed.
    assert "simulation" not in notes([*range(0, 60_000, 1000), *range(0, 60_000, 1000)])
    assert "simulation" not in notes([second * 1000 + second % 3 * 300 for second in range(60)])


@pytest.mark.exhaustive
def test_progress_begins_before_first_record(tmp_path: Path) -> None:
    """Also for a log that takes long to index, a bar is on the screen at once."""
    log = write_tlog(tmp_path / "log.tlog", [(1, place()) for _ in range(40_000)])
    seen: list[int] = []
    read_flight(log, on_progress=lambda progress: seen.append(progress.done))
    assert (seen[0], seen[-1]) == (0, log.stat().st_size)
    assert seen == sorted(seen)
    assert len(seen) > 3


@pytest.mark.parametrize("suffix", [".bin", ".ulg"])
def test_progress_of_controller_log_begins_at_zero(suffix: str, tmp_path: Path) -> None:
    for package in ("pyulog", "pymavlink"):
        pytest.importorskip(package)
    path = tmp_path / f"log{suffix}"
    (log_files.write_bin if suffix == ".bin" else log_files.write_ulog)(path)
    seen: list[int] = []
    read_flight(path, on_progress=lambda progress: seen.append(progress.done))
    assert (seen[0], seen[-1]) == (0, path.stat().st_size)
    assert len(seen) > 3


@pytest.mark.parametrize("suffix", [".gpx", ".kml"])
def test_mission_items_without_position_are_skipped(suffix: str, tmp_path: Path) -> None:
    pytest.importorskip({".gpx": "gpxpy", ".kml": "simplekml"}[suffix])
    messages = [(1, place()), *((1, item(i, 255, x)) for i, x in enumerate((math.nan, 95.0, 47.5)))]
    messages += [(1, item(3, 255, z=math.inf)), (1, item_int(4, 255, MavCmd.DO_DIGICAM_CONTROL))]
    convert(write_tlog(tmp_path / "log.tlog", messages), tmp_path / f"out{suffix}")
    text = (tmp_path / f"out{suffix}").read_text()
    assert "47.5" in text
    assert not any(each in text for each in ("nan", "inf", "95.0", "DIGICAM"))


def test_nan_attitude_does_not_end_conversion(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    messages = [(1, place()), (1, m.Attitude(1000, math.inf, math.nan, 0.0, 0.0, 0.0, 0.0)), (1, place())]
    assert convert(write_tlog(tmp_path / "log.tlog", messages), tmp_path / "out.mcap").entries == 4


def test_invalid_positions_are_skipped(tmp_path: Path) -> None:
    messages = [(1, place()), (1, place(2**31 - 1, -(2**31))), (1, place())]
    assert len(read_flight(write_tlog(tmp_path / "log.tlog", messages)).track) == 2


def test_mission_is_latest_of_this_vehicle(tmp_path: Path) -> None:
    before = [(255, m.MissionCount(1, 1, 3)), *((255, item_int(i, 1)) for i in range(3))]
    now = [(255, m.MissionCount(1, 1, 2)), *((255, item_int(i, 1, 17)) for i in range(2))]
    other = [
        (255, m.MissionCount(7, 1, 5)),
        *((255, item_int(i, 7, 21)) for i in range(5)),
        (7, item_int(6, 255)),
    ]
    flight = read_flight(write_tlog(tmp_path / "log.tlog", [*before, *now, *other]))
    assert [(each.number, each.command) for each in flight.mission] == [(0, 17), (1, 17)]


@pytest.mark.parametrize(
    ("command", "frame", "has_position"),
    [
        (MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL_TERRAIN_ALT, True),
        (MavCmd.NAV_WAYPOINT, MavFrame.LOCAL_NED, False),
        (MavCmd.DO_DIGICAM_CONTROL, MavFrame.GLOBAL, False),
    ],
)
def test_only_items_with_place_have_position(command: int, frame: int, has_position: bool, tmp_path: Path) -> None:
    sent = m.MissionItemInt(1, 1, 0, frame, command, 0, 1, 0.0, 0.0, 0.0, 0.0, 100_000, 200_000, 5.0)
    (read,) = read_flight(write_tlog(tmp_path / "log.tlog", [(255, sent)])).mission
    assert math.isnan(read.latitude_deg) is not has_position
    assert math.isnan(read.longitude_deg) is not has_position


@pytest.mark.parametrize(
    ("frame", "amsl_m", "relative_m"),
    [
        (MavFrame.GLOBAL_INT, 5.0, math.nan),
        (MavFrame.GLOBAL_RELATIVE_ALT_INT, math.nan, 5.0),
        (MavFrame.GLOBAL_TERRAIN_ALT_INT, math.nan, math.nan),
    ],
)
def test_destination_height_depends_on_frame(frame: int, amsl_m: float, relative_m: float, tmp_path: Path) -> None:
    target = m.PositionTargetGlobalInt(0, frame, 0xFF8, 470_000_000, 80_000_000, 5.0, 0, 0, 0, 0, 0, 0, 0, 0)
    read = read_flight(write_tlog(tmp_path / "log.tlog", [(1, target)])).position_target
    assert read["altitude_amsl_m"][0] == pytest.approx(amsl_m, nan_ok=True)
    assert read["altitude_relative_m"][0] == pytest.approx(relative_m, nan_ok=True)


def test_radio_status_has_ids_of_radio(tmp_path: Path) -> None:
    flight = read_flight(write_tlog(tmp_path / "log.tlog", [(51, m.RadioStatus(200, 150, 100, 40, 50, 0, 0))]))
    assert list(flight.radio["rssi"]) == [200]


def test_loss_begins_with_first_frame(tmp_path: Path) -> None:
    """Before, the vehicle may have been off."""
    path, station, vehicle = tmp_path / "log.tlog", FrameEncoder(255, 190), FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for second in range(20):
            writer.write(station.encode(m.Heartbeat(6, 8, 0, 0, 4, 3)), BEGIN + second)
            if second >= 10:
                writer.write(vehicle.encode(HEARTBEAT), BEGIN + second)
    link = read_flight(path).link
    assert list(link.times) == list(range(10, 20))
    assert set(link["lost_percent"]) == {0.0}


def test_status_texts_of_recording_are_written_once(tmp_path: Path) -> None:
    """The texts are two seconds apart. The first one is cut off, and published together with the second one."""
    texts = [m.Statustext(4, "x" * 50, 7, 0), HEARTBEAT, HEARTBEAT, m.Statustext(4, "two"), m.Statustext(4, "three")]
    log = write_tlog(tmp_path / "log.tlog", [(1, message) for message in texts])
    states = [state for record in TlogReader(log).entries(lambda _: None) for state in record.states]
    assert [value.text for name, value in states if name == "status_text"] == [f"{'x' * 50}…", "two", "three"]


def test_mode_command_to_other_vehicle_is_ignored(tmp_path: Path) -> None:
    def by_autopilot(target: int) -> bool | None:
        messages = [(255, m.SetMode(target, 1, 6)), (1, m.Heartbeat(2, 3, 81, 6, 3, 3))]
        return read_flight(write_tlog(tmp_path / f"{target}.tlog", messages)).modes[-1].by_autopilot

    assert (by_autopilot(1), by_autopilot(7)) == (False, None)


def test_between_excludes_values_before_span() -> None:
    columns = TimeSeries("a")
    for time_s, value in ((0.0, 9.0), (60.0, 1.0), (61.0, 2.0)):
        columns.add(time_s, value)
    assert list(columns.between("a", 51.0, 61.0)) == [1.0, 2.0]
    assert list(columns.between("a", 60.0, 60.5)) == [1.0]


@pytest.mark.parametrize(("seconds", "acted"), [(1, True), (7, False)])
def test_delayed_return_with_low_battery_is_no_failsafe(seconds: int, acted: bool, tmp_path: Path) -> None:
    """The log of a ground station has no cause of a mode change; an immediate one is attributed to the autopilot."""
    flying, returning = m.Heartbeat(2, 3, 209, 5, 4, 3), m.Heartbeat(2, 3, 209, 6, 4, 3)
    low = m.Statustext(severity=4, text="Battery 1 is low 14.20V used 900 mAh")
    messages: list[tuple[int, Message]] = [*[(1, flying)] * 5, (1, low), *[(1, flying)] * (seconds - 1)]
    flight = read_flight(write_tlog(tmp_path / "log.tlog", [*messages, *[(1, returning)] * 20]))
    (found,) = failsafes(flight)
    assert found.acted is acted
    assert found.reaction.startswith("mode LOITER → RTL")
    assert found.reaction.endswith("cause not logged") is not acted


def test_landing_with_low_battery_is_no_failsafe(tmp_path: Path) -> None:
    flying, landed = m.Heartbeat(2, 3, 209, 5, 4, 3), m.Heartbeat(2, 3, 81, 5, 3, 3)
    low = m.Statustext(severity=4, text="Battery 1 is low 14.20V used 900 mAh")
    flight = read_flight(write_tlog(tmp_path / "log.tlog", [*[(1, flying)] * 5, (1, low), *[(1, landed)] * 5]))
    (found,) = failsafes(flight)
    assert (found.acted, found.reaction) == (False, "disarmed 1.0 s later; cause not logged")
