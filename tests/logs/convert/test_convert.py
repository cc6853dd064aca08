"""Converted logs are read by third-party libraries, and compared with the log."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import struct
import sys
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest
from defusedxml import ElementTree

from aerokit import messages as m
from aerokit.apps.cli import main
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.logs.convert import convert
from aerokit.logs.convert.mcap import McapWriter
from aerokit.logs.convert.tables import CsvTable
from aerokit.logs.flights.records import TableColumn, TlogReader
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message
from aerokit.mavlink.tlog import TlogWriter, read_tlog
from aerokit.protocols.exchange import TransferProgress

RECORDING = Path(__file__).parents[2] / "recordings" / "px4-quad.tlog"
BEGIN = 1_700_000_000.25
PLACES = [(47.4 + i * 1e-4, 8.5 - i * 1e-4, 500.0 + i, float(i)) for i in range(5)]
"""Degrees, and metres above the sea and above home: one a second."""


def flight() -> Iterator[tuple[float, Message]]:
    for i, (latitude, longitude, amsl, relative) in enumerate(PLACES):
        at = BEGIN + i
        yield at, m.Heartbeat(2, 3, 81 | (128 if i > 1 else 0), 4 if i > 1 else 0, 4, 3)
        yield at, m.Attitude(i * 1000, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
        yield (
            at + 0.1,
            m.GlobalPositionInt(
                i * 1000,
                round(latitude * 1e7),
                round(longitude * 1e7),
                round(amsl * 1e3),
                round(relative * 1e3),
                100,
                200,
                -300,
                9000,
            ),
        )
    yield BEGIN + 4.2, m.Statustext(4, "hello <sea> & sky")
    yield BEGIN + 4.3, m.SetupSigning(1, 1, b"s" * 32, 5)
    for item in (
        m.MissionItemInt(255, 0, 1, 3, 16, 0, 1, 0, 0, 0, 0, 474010000, 85010000, 30.0),  # above home
        m.MissionItemInt(255, 0, 2, 0, 16, 0, 1, 0, 0, 0, 0, 474020000, 85020000, 555.0),  # above the sea
        m.MissionItemInt(255, 0, 3, 10, 16, 0, 1, 0, 0, 0, 0, 474030000, 85030000, 7.0),  # above the ground
    ):
        yield BEGIN + 4.4, item


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "a & b.tlog"
    encoder = FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for at, message in flight():
            writer.write(encoder.encode(message), at)
    return path


def mcap_messages(path: Path) -> list[tuple[str, str, float, dict[str, Any]]]:
    reader = pytest.importorskip("mcap.reader")
    with path.open("rb") as file:
        return [
            (channel.topic, schema.name, message.log_time / 1e9, json.loads(message.data))
            for schema, channel, message in reader.make_reader(file).iter_messages()
        ]


def test_mcap_has_foxglove_topics_and_messages(log: Path, tmp_path: Path) -> None:
    done = convert(log, tmp_path / "out.mcap")
    read = mcap_messages(tmp_path / "out.mcap")
    assert done.written == len(read)
    assert (done.begins_at, done.ends_at) == pytest.approx((BEGIN, BEGIN + 4.4), abs=1e-5)
    fixes = [(at, fields) for topic, _, at, fields in read if topic == "/vehicle/1/location"]
    for i, ((at, fix), place) in enumerate(zip(fixes, PLACES, strict=True)):
        assert at == pytest.approx(BEGIN + i + 0.1, abs=1e-5)
        assert (fix["latitude"], fix["longitude"], fix["altitude"]) == pytest.approx(place[:3], abs=1e-7)
        assert fix["velocity"] == pytest.approx({"x": 2.0, "y": 1.0, "z": 3.0})
        assert fix["timestamp"]["sec"] == int(at)
    names = {topic: schema for topic, schema, _, _ in read}
    assert names["/vehicle/1/location"] == "foxglove.LocationFix"
    assert names["/vehicle/1/transform"] == "foxglove.FrameTransform"
    assert names["/vehicle/1/pose"] == "foxglove.PoseInFrame"
    by_topic = {topic: fields for topic, _, _, fields in read}
    assert by_topic["/vehicle/1/log"]["message"] == "hello <sea> & sky"
    assert by_topic["/vehicle/1/log"]["level"] == 3
    assert by_topic["/vehicle/1/armed"] == {"value": True}
    assert by_topic["/vehicle/1/mode"]["name"] == "GUIDED"
    assert by_topic["/vehicle/1/pose"]["pose"]["position"]["z"] == pytest.approx(4.0)
    assert by_topic["/mavlink/1/1/GLOBAL_POSITION_INT"]["alt"] == 504_000
    assert "secret_key" not in by_topic["/mavlink/1/1/SETUP_SIGNING"]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_flight_table_has_row_per_position(log: Path, tmp_path: Path, suffix: str) -> None:
    done = convert(log, tmp_path / f"out{suffix}")
    rows = read_table(tmp_path / f"out{suffix}")
    assert done.written == len(rows) == len(PLACES)
    for i, (row, place) in enumerate(zip(rows, PLACES, strict=True)):
        assert row["time_utc"].timestamp() == pytest.approx(BEGIN + i + 0.1, abs=2e-6)
        columns = ("latitude_deg", "longitude_deg", "altitude_amsl_m", "altitude_relative_m")
        assert [float(row[name]) for name in columns] == pytest.approx(place, abs=1e-7)
        assert float(row["down_m_s"]) == -3.0
        assert float(row["yaw_deg"]) == pytest.approx(17.188734)
        assert str(row["armed"]) == str(i > 1)
        assert row["mode"] == ("GUIDED" if i > 1 else "STABILIZE")
        assert row["satellites"] in (None, "")


def read_table(path: Path) -> list[dict[str, Any]]:
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", newline="") as file:
            return [{**row, "time_utc": datetime.fromisoformat(row["time_utc"])} for row in csv.DictReader(file)]
    rows: list[dict[str, Any]] = pytest.importorskip("pyarrow.parquet").read_table(path).to_pylist()
    return rows


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_folder_has_table_per_message_type(tmp_path: Path, kind: str) -> None:
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    done = convert(RECORDING, tmp_path / "all", tables=kind)
    decoded = [
        (at, STANDARD.decode(frame))
        for at, raw in read_tlog(RECORDING)
        if (frame := Frame.parse(raw)).message_id in STANDARD
    ]
    assert done.written == len(decoded)
    tables = {path.stem: read_table(path) for path in (tmp_path / "all").iterdir()}
    assert tables.keys() == {message.NAME for _, message in decoded}
    positions = [(at, each) for at, each in decoded if isinstance(each, m.GlobalPositionInt)]
    for row, (at, position) in zip(tables["GLOBAL_POSITION_INT"], positions, strict=True):
        assert row["time_utc"].timestamp() == pytest.approx(at, abs=2e-6)
        assert int(row["lat_degE7"]) == position.lat
        assert int(row["alt_mm"]) == position.alt
        assert int(row["vx_cm_s"]) == position.vx
        assert int(row["time_boot_ms"]) == position.time_boot_ms
        assert int(row["system_id"]) == 1


def test_csv_cells_of_rare_values(tmp_path: Path) -> None:
    columns = [TableColumn("time_utc", "", "time"), TableColumn("x", "x", "float"), TableColumn("y", "y", "float")]
    table = CsvTable(tmp_path / "values.csv", columns)
    for values in ((None, 3), ("=1+1", 4), ("a\r\nb", math.nan)):
        table.add(0.0, values)
    for add in (table.add, table.add_numbers):
        for numbers in ((1, math.inf), (math.inf, -math.inf), (2, math.nan), (-0.0, 0.1)):
            add(0.0, numbers)
    table.close()
    time = "1970-01-01T00:00:00.000000+00:00"
    of_numbers = [f"{time},{row}" for row in ("1,inf", "inf,-inf", "2,", "-0.0,0.1")]
    rows = ["time_utc,x,y", f"{time},,3", f"{time},'=1+1,4", f'{time},"a\r\nb",', *of_numbers, *of_numbers, ""]
    assert (tmp_path / "values.csv").read_bytes().decode() == "\n".join(rows)


@pytest.mark.parametrize(
    ("unix_s", "expected"),
    [
        (1.7e9 + 0.25, "2023-11-14T22:13:20.250000"),
        (0.9999996, "1970-01-01T00:00:01.000000"),
        (-0.25, "1969-12-31T23:59:59.750000"),
    ],
)
def test_csv_time_has_microseconds(tmp_path: Path, unix_s: float, expected: str) -> None:
    table = CsvTable(tmp_path / "times.csv", [TableColumn("time_utc", "", "time")])
    table.add(unix_s, ())
    table.close()
    assert (tmp_path / "times.csv").read_text().splitlines()[1] == f"{expected}+00:00"


def test_integer_parameters_of_px4_are_written_as_numbers(tmp_path: Path) -> None:
    """PX4 sends the bits of an integer in the float field. A parameter of another system stays as it is."""
    bits_of_2 = struct.unpack("<f", struct.pack("<i", 2))[0]
    encoders = {system_id: FrameEncoder(system_id, 1) for system_id in (1, 9, 255)}
    with TlogWriter(tmp_path / "log.tlog") as writer:
        for system_id, message in (
            (1, m.Heartbeat(2, 12, 0, 0, 4, 3)),
            (1, m.ParamValue("NAV_RCL_ACT", bits_of_2, 6, 2, 0)),
            (1, m.ParamValue("BAT_LOW_THR", 0.25, 9, 2, 1)),
            (255, m.ParamSet(1, 1, "NAV_RCL_ACT", bits_of_2, 6)),
            (9, m.ParamValue("NAV_RCL_ACT", bits_of_2, 6, 2, 0)),
        ):
            writer.write(encoders[system_id].encode(message), 1.7e9)
    convert(tmp_path / "log.tlog", tmp_path / "all")
    values = [float(row["param_value"]) for row in read_table(tmp_path / "all" / "PARAM_VALUE.csv")]
    assert values == [2.0, 0.25, bits_of_2]
    assert [float(row["param_value"]) for row in read_table(tmp_path / "all" / "PARAM_SET.csv")] == [2.0]


def test_parameters_of_other_components_stay_as_sent(tmp_path: Path) -> None:
    """A camera of the vehicle has its own encoding, and does not change that of the autopilot."""
    bits_of_2 = struct.unpack("<f", struct.pack("<i", 2))[0]
    c_cast, unknown = 1 << 17, (0, 0, 0, 0, b"", b"", b"", 0, 0, 0)
    autopilot, camera = FrameEncoder(1, 1), FrameEncoder(1, 100)
    with TlogWriter(tmp_path / "log.tlog") as writer:
        for encoder, message in (
            (autopilot, m.Heartbeat(2, 12, 0, 0, 4, 3)),
            (camera, m.AutopilotVersion(c_cast, *unknown)),
            (camera, m.ParamValue("CAM_MODE", 2.0, 6, 1, 0)),
            (autopilot, m.ParamValue("NAV_RCL_ACT", bits_of_2, 6, 2, 0)),
        ):
            writer.write(encoder.encode(message), 1.7e9)
    convert(tmp_path / "log.tlog", tmp_path / "all")
    values = [float(row["param_value"]) for row in read_table(tmp_path / "all" / "PARAM_VALUE.csv")]
    assert values == [2.0, 2.0]


@pytest.mark.parametrize("unix_s", [0.0, 1.0000005, 1764115200.9999998, 1764115200.25, -1.25])
def test_csv_times_have_rounded_microseconds(unix_s: float, tmp_path: Path) -> None:
    table = CsvTable(tmp_path / "times.csv", [])
    table.add(unix_s, [])
    table.close()
    expected = datetime.fromtimestamp(unix_s, timezone.utc).isoformat(timespec="microseconds")
    assert (tmp_path / "times.csv").read_text().splitlines()[1] == expected


def test_damaged_message_changes_no_time_of_later_ones(tmp_path: Path) -> None:
    """Its end looks like the start of a longer message."""
    encoder = FrameEncoder(1, 1)
    damaged = encoder.encode(m.Attitude(0, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0))[:-7] + b"\xfd\x3c\x00\x99\x3e\x47\xf1"
    with TlogWriter(tmp_path / "in.tlog") as writer:
        writer.write(damaged, BEGIN)
        for second in (1, 2):
            writer.write(encoder.encode(m.Statustext(4, "x" * 41)), BEGIN + second)
    records = TlogReader(tmp_path / "in.tlog").entries(lambda _: None)
    assert [record.unix_s - BEGIN for record in records] == [1, 2]


def test_gpx_has_times_elevations_and_mission(log: Path, tmp_path: Path) -> None:
    gpxpy = pytest.importorskip("gpxpy")
    convert(log, tmp_path / "out.gpx")
    read = gpxpy.parse((tmp_path / "out.gpx").read_text())
    points = read.tracks[0].segments[0].points
    for i, (point, place) in enumerate(zip(points, PLACES, strict=True)):
        assert (point.latitude, point.longitude, point.elevation) == pytest.approx(place[:3], abs=1e-7)
        assert point.time.timestamp() == pytest.approx(BEGIN + i + 0.1, abs=1e-3)
    assert [(each.name, each.elevation) for each in read.waypoints] == [
        ("1 NAV_WAYPOINT", 530.0),
        ("2 NAV_WAYPOINT", 555.0),
        ("3 NAV_WAYPOINT", None),
    ]


def test_gpx_has_last_mission_although_sent_before_positions(tmp_path: Path) -> None:
    gpxpy = pytest.importorskip("gpxpy")
    encoder = FrameEncoder(1, 1)

    def item(number: int, command: int = 16) -> Message:
        return m.MissionItemInt(255, 0, number, 3, command, 0, 1, 0, 0, 0, 0, 474010000, 85010000, 30.0)

    jump = 177  # DO_JUMP has no position
    mission = [item(0), item(1), item(2), item(3), m.MissionCount(255, 0, 3), item(0), item(1, jump), item(2)]
    place = m.GlobalPositionInt(0, 474000000, 85000000, 500000, 0, 0, 0, 0, 0)
    with TlogWriter(tmp_path / "in.tlog") as writer:
        for second, message in enumerate([m.Heartbeat(2, 3, 81, 4, 4, 3), *mission, place]):
            writer.write(encoder.encode(message), BEGIN + second)
    convert(tmp_path / "in.tlog", tmp_path / "out.gpx")
    read = gpxpy.parse((tmp_path / "out.gpx").read_text())
    assert [waypoint.name for waypoint in read.waypoints] == ["0 NAV_WAYPOINT", "2 NAV_WAYPOINT"]


@pytest.mark.parametrize(("result", "names"), [(0, []), (1, ["0 NAV_WAYPOINT"])])
def test_gpx_has_no_guided_target_and_no_cleared_mission(result: int, names: list[str], tmp_path: Path) -> None:
    gpxpy = pytest.importorskip("gpxpy")
    vehicle, station = FrameEncoder(1, 1), FrameEncoder(255, 190)
    place = (474010000, 85010000, 30.0)
    with TlogWriter(tmp_path / "in.tlog") as writer:
        for encoder, message in (
            (vehicle, m.Heartbeat(2, 3, 81, 4, 4, 3)),
            (vehicle, m.GlobalPositionInt(0, 474000000, 85000000, 500000, 0, 0, 0, 0, 0)),
            (station, m.MissionItemInt(1, 1, 0, 3, 16, 0, 1, 0, 0, 0, 0, *place)),
            (vehicle, m.MissionAck(255, 190, 0)),
            (station, m.MissionClearAll(1, 1)),
            (station, m.MissionAck(1, 1, 0)),  # ends a download, and is no answer
            (vehicle, m.MissionAck(255, 190, result)),
            (station, m.MissionItemInt(1, 1, 0, 3, 22, 2, 1, 0, 0, 0, 0, *place)),
        ):
            writer.write(encoder.encode(message), BEGIN)
    convert(tmp_path / "in.tlog", tmp_path / "out.gpx")
    assert [waypoint.name for waypoint in gpxpy.parse((tmp_path / "out.gpx").read_text()).waypoints] == names


def test_gpx_has_mission_after_lost_request_to_clear(tmp_path: Path) -> None:
    gpxpy = pytest.importorskip("gpxpy")
    vehicle, station = FrameEncoder(1, 1), FrameEncoder(255, 190)
    with TlogWriter(tmp_path / "in.tlog") as writer:
        for encoder, message in (
            (vehicle, m.Heartbeat(2, 3, 81, 4, 4, 3)),
            (vehicle, m.GlobalPositionInt(0, 474000000, 85000000, 500000, 0, 0, 0, 0, 0)),
            (station, m.MissionClearAll(1, 1)),
            (station, m.MissionCount(1, 1, 1)),
            (station, m.MissionItemInt(1, 1, 0, 3, 16, 0, 1, 0, 0, 0, 0, 474010000, 85010000, 30.0)),
            (vehicle, m.MissionAck(255, 190, 0)),
        ):
            writer.write(encoder.encode(message), BEGIN)
    convert(tmp_path / "in.tlog", tmp_path / "out.gpx")
    assert len(gpxpy.parse((tmp_path / "out.gpx").read_text()).waypoints) == 1


def test_kml_has_altitude_modes(log: Path, tmp_path: Path) -> None:
    pytest.importorskip("simplekml")
    convert(log, tmp_path / "out.kml")
    root: Any = ElementTree.parse(tmp_path / "out.kml").getroot()
    spaces = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
    track = root.find(".//gx:Track", spaces)
    assert track.findtext("k:altitudeMode", namespaces=spaces) == "absolute"
    when = [datetime.fromisoformat(each.text.replace("Z", "+00:00")) for each in track.findall("k:when", spaces)]
    assert when[0] == datetime.fromtimestamp(BEGIN + 0.1, timezone.utc)
    where = [[float(each) for each in place.text.split()] for place in track.findall("gx:coord", spaces)]
    assert where == [pytest.approx((place[1], place[0], place[2]), abs=1e-7) for place in PLACES]
    points = [
        (
            mark.findtext(".//k:altitudeMode", namespaces=spaces),
            mark.findtext(".//k:coordinates", namespaces=spaces),
        )
        for mark in root.findall(".//k:Placemark", spaces)
        if mark.find("k:Point", spaces) is not None
    ]
    assert points == [
        ("absolute", "8.501,47.401,530.0"),
        ("absolute", "8.502,47.402,555.0"),
        ("relativeToGround", "8.503,47.403,7.0"),
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not allow such names")
@pytest.mark.parametrize("name", [b"a\x01b.tlog", b"a\xffb.tlog"])
def test_kml_of_log_with_unprintable_name_is_valid(name: bytes, log: Path, tmp_path: Path) -> None:
    pytest.importorskip("simplekml")
    convert(log.rename(tmp_path / os.fsdecode(name)), tmp_path / "out.kml")
    root: Any = ElementTree.parse(tmp_path / "out.kml").getroot()
    assert root[0][0].text == "a\N{REPLACEMENT CHARACTER}b.tlog"


def test_existing_target_needs_force_and_failure_leaves_nothing(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = tmp_path / "out.csv"
    there.write_text("mine")
    folder = tmp_path / "all"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    for target in (there, folder):
        with pytest.raises(InvalidArgument, match="exists; use force"):
            convert(log, target)
    assert there.read_text() == "mine"

    def break_off(progress: TransferProgress) -> None:
        raise OSError("the disk is full")

    for target in (there, folder):
        with pytest.raises(OSError, match="full"):
            convert(log, target, force=True, on_progress=break_off)
    assert there.read_text() == "mine"
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted([log.name, "all", "out.csv"])
    convert(log, there, force=True)
    convert(log, folder, force=True)
    assert there.read_text().startswith("time_utc,")
    assert (folder / "mine.txt").read_text() == "mine"
    assert (folder / "ATTITUDE.csv").exists()
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted([log.name, "all", "out.csv"])


def test_flushed_files_are_writable(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On Windows, os.fsync raises EBADF for a file that is open for reading only."""
    flushed: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: flushed.append(os.write(descriptor, b"")))
    convert(log, tmp_path / "out.csv")
    assert flushed == [0]


def test_missing_mcap_package_leaves_no_open_file(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    target = tmp_path / "out.mcap"
    with pytest.raises(ModuleNotFoundError):
        McapWriter(target, TlogReader(log))
    assert not target.exists()


def test_damaged_log_is_converted_as_far_as_readable(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(log.read_bytes())
    at = data.index(struct.pack(">Q", round((BEGIN + 2.1) * 1e6))) + 25
    data[at] ^= 0xFF  # inside the payload of a position
    damaged = tmp_path / "damaged.tlog"
    damaged.write_bytes(data[:-9])
    assert main(["convert", str(damaged), str(tmp_path / "out.csv"), "--json"]) == 0
    captured = capsys.readouterr()
    printed = json.loads(captured.out)
    assert printed["type"] == "conversion"
    assert printed["written"] == len(PLACES) - 1 == len(read_table(tmp_path / "out.csv"))
    assert len(printed["notes"]) == 1
    assert "1 of" in captured.err
    assert "damaged" in captured.err


def test_unknown_log_or_format_raises(log: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.tlog"
    text.write_text("no log at all")
    for source, target, error, message in [
        (text, "out.csv", FileFormatError, "no MAVLink"),
        (tmp_path / "log.txt", "out.csv", FileFormatError, ".tlog"),
        (log, "out.xlsx", InvalidArgument, ".mcap"),
        (tmp_path / "missing.tlog", "out.csv", FileNotFoundError, "missing"),
    ]:
        with pytest.raises(error, match=message):
            convert(source, tmp_path / target)
    for suffix in (".bin", ".ulg"):
        other = shutil.copy(text, tmp_path / f"text{suffix}")
        with pytest.raises(FileFormatError, match=r"is not an? \w+ log"):
            convert(other, tmp_path / "out.csv")
    assert not list(tmp_path.glob("out*"))
    assert not list(tmp_path.glob(".out*"))


def test_convert_command_prints_result(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(log), str(tmp_path / "out.gpx")]) == 0
    assert "2023-11-14 22:13:20" in capsys.readouterr().out
    assert main(["convert", str(log), str(tmp_path / "out.gpx")]) == 6
    assert "--force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("out.csv", "5 rows from 20 entries, "),
        ("out.mcap", "messages from 20 entries, "),
        ("out.gpx", "5 points from 20 entries, "),
        ("folder", "20 rows from 20 entries, "),
    ],
)
def test_written_counts_match_output(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, text: str
) -> None:
    assert main(["convert", str(log), str(tmp_path / name)]) == 0
    printed = capsys.readouterr().out
    assert text in printed
    assert " kB, 2023" in printed
    assert main(["convert", str(log), str(tmp_path / name), "--force", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert f": {record['written']} " in printed
    assert record["entries"] == 20
