"""Invalid, lost and repeated rows in the logs of flight controllers."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import log_files
import pytest

from aerokit.logs.convert import convert
from aerokit.logs.flights import FlightLog, read_flight
from aerokit.logs.flights.flight_controllers import BinReader, UlogReader
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.position import Position
from aerokit.vehicle.state.movement import Velocity

Row = tuple[float, str, Sequence[Any]]
LATITUDE_E7, LONGITUDE_E7 = round(log_files.LATITUDE * 1e7), round(log_files.LONGITUDE * 1e7)


class Logs:
    """Writes a log of the usual flight, without the rows of some tables and with other rows."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._folder, self._monkeypatch = folder, monkeypatch

    def read_bin(self, *rows: Row, without: str) -> FlightLog:
        rows = (*(row for row in log_files._bin_rows() if row[1] not in without.split()), *rows)
        self._monkeypatch.setattr(log_files, "_bin_rows", lambda: rows)
        path = self._folder / "flight.bin"
        log_files.write_bin(path)
        return read_flight(path)

    def write_ulog(self, *rows: Row, **topics: str) -> Path:
        pytest.importorskip("pyulog")
        rows = (*(row for row in log_files._ulog_rows() if row[1] not in topics), *rows)
        self._monkeypatch.setattr(log_files, "_ulog_rows", lambda: rows)
        self._monkeypatch.setattr(log_files, "TOPICS", {**log_files.TOPICS, **topics})
        path = self._folder / "flight.ulg"
        log_files.write_ulog(path)
        return path


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Logs:
    return Logs(tmp_path, monkeypatch)


def command(time_s: float, total: int, number: int, kind: int = MavCmd.NAV_WAYPOINT, x: int = LATITUDE_E7) -> Row:
    return time_s, "CMD", (total, number, kind, 0, 0, 0, 0, x, LONGITUDE_E7, 10.0, MavFrame.GLOBAL_RELATIVE_ALT)


def test_items_of_longer_mission_before_are_dropped(logs: Logs) -> None:
    before = [command(1.0, 3, number) for number in range(3)]
    flight = logs.read_bin(*before, *(command(2.0, 2, number, 17) for number in range(2)), without="CMD")
    assert [(item.number, item.command) for item in flight.mission] == [(0, 17), (1, 17)]


def test_item_without_place_has_no_position(logs: Logs) -> None:
    """ArduPilot logs parameters 5 and 6 of DO_DIGICAM_CONTROL as latitude and longitude."""
    flight = logs.read_bin(command(1.0, 1, 0, MavCmd.DO_DIGICAM_CONTROL, x=1), without="CMD")
    assert [math.isnan(item.latitude_deg) for item in flight.mission] == [True]


def fix(time_s: float, receiver: int, status: int) -> Row:
    latitude = LATITUDE_E7 + 1000 * receiver
    return time_s, "GPS", (receiver, status, 0, log_files.GPS_WEEK, 14, 80, latitude, LONGITUDE_E7, 50_000)


@pytest.mark.parametrize(("status", "used"), [(3, 0), (1, 1)], ids=["both have a fix", "first has none"])
def test_track_has_positions_of_one_receiver(status: int, used: int, logs: Logs) -> None:
    rows = [fix(float(second), *receiver) for second in range(1, 9) for receiver in ((0, status), (1, 3))]
    track = logs.read_bin(*rows, without="POS GPS").track
    assert list(track["latitude_deg"]) == pytest.approx([(LATITUDE_E7 + 1000 * used) / 1e7] * 8, abs=1e-9)


def test_setpoint_without_east_row_is_skipped(logs: Logs) -> None:
    rows: list[Row] = []
    for step in range(20, 60):
        rows.append((step / 10, "PSCN", (0.0, 0.0, float(step))))
        if step != 30:
            rows.append((step / 10 + 2e-5, "PSCE", (float(step), 0.0, float(step))))
    flight = logs.read_bin(*rows, without="PSCN PSCE CTUN")
    target = flight.position_target
    assert len(target) == 39
    east_m = [(longitude - log_files.LONGITUDE) * 75_950 for longitude in target["longitude_deg"]]
    assert east_m == pytest.approx([10 * (time_s + 1) for time_s in target.times], rel=2e-3)
    velocity = flight.velocity_target
    pairs = list(zip(velocity["north_m_s"], velocity["east_m_s"], strict=True))
    assert [north for north, east in pairs if math.isnan(east)] == [30.0]
    assert len([north for north, east in pairs if north == east]) == 39


def test_velocity_setpoints_need_no_origin(logs: Logs) -> None:
    flight = logs.read_bin(without="ORGN")
    assert flight.velocity_target["north_m_s"][5] == 4.5
    assert not flight.position_target.has_values("latitude_deg")


GLOBAL = "Q:timestamp d:lat d:lon f:alt ?:lat_lon_valid ?:alt_valid"
LOCAL = "Q:timestamp f:vx f:vy f:vz ?:v_xy_valid ?:v_z_valid"


def test_invalid_px4_estimates_are_unknown(logs: Logs) -> None:
    path = logs.write_ulog(
        (2.0, "vehicle_global_position", (47.0, 8.0, 510.0, True, False)),
        (3.0, "vehicle_global_position", (47.0, 8.0, 510.0, False, True)),
        (2.0, "vehicle_local_position", (1.0, 2.0, 3.0, True, False)),
        (3.0, "vehicle_local_position", (1.0, 2.0, 3.0, False, True)),
        vehicle_global_position=GLOBAL,
        vehicle_local_position=LOCAL,
    )
    flight = read_flight(path)
    columns = [flight.track[name] for name in ("latitude_deg", "longitude_deg", "altitude_amsl_m")]
    columns += [flight.velocity[name] for name in flight.velocity]
    nan = pytest.approx(math.nan, nan_ok=True)
    assert [list(column) for column in columns] == [
        [47.0, nan],
        [8.0, nan],
        [nan, 510.0],
        [1.0, nan],
        [2.0, nan],
        [nan, 3.0],
    ]

    states = [state for record in UlogReader(path).entries(lambda _: None) for state in record.states]
    assert [value for name, value in states if name == "position"] == [Position(47.0, 8.0)]
    velocities = [value for name, value in states if name == "velocity"]
    assert [str(value) for value in velocities] == [
        str(Velocity(1.0, 2.0, math.nan)), str(Velocity(math.nan, math.nan, 3.0)),
    ]  # fmt: skip


def test_unreadable_ulog_raises_os_error(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    path = tmp_path / "folder.ulg"
    path.mkdir()
    with pytest.raises(OSError, match=r"folder\.ulg"):
        read_flight(path)
    with pytest.raises(OSError, match=r"folder\.ulg"):
        next(UlogReader(path).entries(lambda _: None))


def test_missing_pyulog_raises_module_not_found(logs: Logs, monkeypatch: pytest.MonkeyPatch) -> None:
    path = logs.write_ulog()
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(ModuleNotFoundError):
        next(UlogReader(path).entries(lambda _: None))


@pytest.mark.parametrize("suffix", [".bin", ".ulg"])
def test_parquet_has_largest_integers(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    largest = (1 << 64) - 1
    logs = Logs(tmp_path, monkeypatch)
    if suffix == ".bin":
        monkeypatch.setitem(log_files.TABLES, "LONG", (0x95, "QQ", "TimeUS,value"))
        logs.read_bin((2.0, "LONG", (largest,)), without="")
    else:
        logs.write_ulog((2.0, "LONG", (largest,)), LONG="Q:timestamp Q:value")
    convert(tmp_path / f"flight{suffix}", tmp_path / "out", tables="parquet")
    assert parquet.read_table(tmp_path / "out" / "LONG.parquet")["value"].to_pylist() == [largest]


def test_tables_of_similar_names_lose_no_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("3_A_", "A_", "A!")  # "!" is not allowed in the name of a file
    for number, name in enumerate(names, 0x95):
        monkeypatch.setitem(log_files.TABLES, name, (number, "QB", "TimeUS,value"))
    rows = [(0.5 + number / 10, name, (1,)) for number, name in enumerate(names)]
    Logs(tmp_path, monkeypatch).read_bin((0.1, "MSG", (b"ArduCopter V4.6.1",)), *rows, (0.9, "3_A_", (2,)), without="")
    convert(tmp_path / "flight.bin", tmp_path / "out")
    lines = [line for path in (tmp_path / "out").glob("*A_.csv") for line in path.read_text().splitlines()[1:]]
    assert len(lines) == 4


@pytest.mark.parametrize("wrong_us", [10**15, 0])
@pytest.mark.parametrize("row", [(20.05, "POS", 0x83), (20.05, "ATT", 0x84), (38.0, "ARM", 0x87)])
def test_row_with_impossible_time_changes_nothing_else(
    row: tuple[float, str, int], wrong_us: int, logs: Logs, tmp_path: Path
) -> None:
    """A row has no checksum, so the time of a damaged row may be any number."""
    time_s, table, number = row
    values = {"POS": (0, 0, 0.0, 0.0), "ATT": (0.0,) * 6, "ARM": (1,)}[table]
    logs.read_bin((time_s, table, values), without="")
    path = tmp_path / "flight.bin"
    begin = b"\xa3\x95" + bytes((number,)) + round(time_s * 1e6).to_bytes(8, "little")
    wrong = begin[:3] + wrong_us.to_bytes(8, "little")
    assert path.read_bytes().count(begin) == 1
    path.write_bytes(path.read_bytes().replace(begin, wrong))
    flight = read_flight(path)
    ((armed_s, disarmed_s),) = flight.armed
    assert (armed_s, disarmed_s) == pytest.approx((4.0, 39.0), abs=0.1)
    assert flight.duration_s == pytest.approx(43.9, abs=0.1)
    assert flight.track.at("altitude_relative_m", 30.0) == pytest.approx(log_files.height_m(31.0), abs=0.35)
    assert list(flight.attitude.times) == sorted(flight.attitude.times)
    assert "1 damaged row was skipped: impossible time" in flight.notes


@pytest.mark.parametrize("wrong_us", [10**15, 0])
def test_ulog_row_with_impossible_time_changes_nothing_else(wrong_us: int, logs: Logs, tmp_path: Path) -> None:
    path = logs.write_ulog((20.05, "vehicle_status", (2, 3, 3, False)))
    right, wrong = (time_us.to_bytes(8, "little") + b"\2\3\3" for time_us in (20_050_000, wrong_us))
    assert path.read_bytes().count(right) == 1
    path.write_bytes(path.read_bytes().replace(right, wrong))
    flight = read_flight(path)
    assert flight.duration_s == pytest.approx(43.9, abs=0.2)
    assert [change.time_s for change in flight.modes] == sorted(change.time_s for change in flight.modes)
    assert "1 damaged row was skipped: impossible time" in flight.notes


@pytest.mark.parametrize(
    ("name", "value", "system_id"), [(b"MAV_SYSID", 7, 7), (b"SYSID_THISMAV", 7, 7), (b"MAV_SYSID", math.nan, 1)]
)
def test_system_id_of_bin_is_that_of_its_parameter(
    name: bytes, value: float, system_id: int, logs: Logs, tmp_path: Path
) -> None:
    flight = logs.read_bin((3.0, "PARM", (name, value)), (30.0, "PARM", (name, 9)), without="")
    assert flight.system_id == system_id
    records = list(BinReader(tmp_path / "flight.bin").entries(lambda done: None))
    assert {record.system_id for record in records} == {system_id}
    assert [record.table for record in records].count("POS") == len(log_files.times(10))
