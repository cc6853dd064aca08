"""`aerokit params|mission|files|logs`: output, files and exit codes."""

from __future__ import annotations

import argparse
import json
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from flight_harness import open_flight
from served_copter import served

from aerokit.apps.cli import main
from aerokit.apps.cli.mission import upload_parts
from aerokit.apps.cli.terminal import progress_bar
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavAutopilot, MavType
from aerokit.missions import Mission, Plan, land, return_to_launch, take_off, waypoint, write_plan_file
from aerokit.protocols.exchange import TransferProgress
from aerokit.sim import SimulatedCopter
from aerokit.testing import run_virtual

WAYPOINTS = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.397742\t8.545594\t488\t1
1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t15\t1
2\t0\t3\t16\t0\t0\t0\t0\t47.398\t8.5456\t15\t1
3\t0\t3\t20\t0\t0\t0\t0\t0\t0\t0\t1
"""

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0)


@pytest.fixture(scope="module")
def address(copter: SimulatedCopter) -> Iterator[str]:
    with served([copter]) as address:
        yield address


@pytest.fixture
def run(address: str, capsys: pytest.CaptureFixture[str]) -> Run:
    return run_at(address, capsys)


@pytest.fixture
def run_elsewhere(capsys: pytest.CaptureFixture[str]) -> Iterator[Run]:
    """Run commands on a copter of this test."""
    with served([SimulatedCopter(boot_time_s=0.0)]) as address:
        yield run_at(address, capsys)


def run_at(address: str, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command on the copter; return exit code, stdout and stderr."""

    def run(*arguments: str) -> tuple[int, str, str]:
        code = main([*arguments, "--connect", address])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return run


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "aerokit.apps.cli.connecting._OTHER_VEHICLES_TIMEOUT_S", 0.0
    )  # there is one; tests/apps/cli has several


# ------------------------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    "arguments",
    [
        ["params"],
        ["params", "get"],
        ["params", "set", "WPNAV_SPEED"],
        ["params", "set", "WPNAV_SPEED=fast"],
        ["params", "get", "X", "--patience", "0"],
        ["mission", "fly"],
        ["mission", "show", "weather"],
        ["files", "get"],
        ["logs", "get", "one"],
        ["logs", "get", "--to", __file__],
    ],
    ids=" ".join,
)
def test_transfer_commands_invalid_arguments_exit_with_code_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    assert "error: " in capsys.readouterr().err


def test_params_get_with_invalid_name_exits_with_code_2(run: Run) -> None:
    code, _, err = run("params", "get", "A_NAME_OF_MORE_THAN_16")
    assert code == 2
    assert "A_NAME_OF_MORE_THAN_16" in err


# ------------------------------------------------------------------------------------ parameters


def test_params_set_and_get_round_trip(run: Run) -> None:
    assert run("params", "set", "WPNAV_SPEED=725.5", "LOG_BITMASK=0xFF")[0] == 0
    code, out, _ = run("params", "get", "WPNAV_SPEED", "LOG_BITMASK")
    assert code == 0
    assert [line.split() for line in out.splitlines()] == [["WPNAV_SPEED", "725.5"], ["LOG_BITMASK", "255"]]


def test_params_load_with_unknown_name_counts_it_as_not_set(run: Run) -> None:
    Path("mine.param").write_text("WPNAV_ACCEL_Z,110\nNO_SUCH,1\n")
    code, out, _ = run("params", "load", "mine.param")
    assert code == 5
    assert "2 parameters in mine.param, 1 of them differed, 1 were not set\n" in out


def test_params_set_with_unknown_name_sets_the_others(run: Run) -> None:
    code, out, _ = run("params", "set", "WPNAV_ACCEL=210", "NO_SUCH=1")
    assert code == 5
    assert "WPNAV_ACCEL      250 → 210    set\n" in out
    assert out.count("not checked") == 1
    assert "NO_SUCH          not set: " in out


def test_params_load_with_invalid_values_names_all_and_sets_nothing(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "bad.param"
    file.write_text("RTL_ALT,1800\nNOSUCH,4\nFLTMODE1,3.5\nFLTMODE2,300\n")
    before = run("params", "get", "RTL_ALT")[1]
    code, out, err = run("params", "load", str(file))
    assert (code, out) == (2, "")
    assert err.splitlines() == [
        f"aerokit: {file}, line 3: FLTMODE1 = 3.5 must be a whole number (its type is INT8)",
        f"{file}, line 4: FLTMODE2 = 300 must be in -128..127 (its type is INT8)",
        f"{file}, line 2: the vehicle has no parameter NOSUCH",
        "nothing was set",
    ]
    assert run("params", "get", "RTL_ALT")[1] == before


def test_params_list_filters_by_pattern_and_changed(run: Run) -> None:
    run("params", "set", "WPNAV_RADIUS=333")
    code, out, _ = run("params", "list", "wpnav_r*", "--changed")
    assert code == 0
    assert out == "WPNAV_RADIUS     333           (default 200)\n"


@pytest.mark.sampled(3)
@pytest.mark.parametrize("format_", ["missionplanner", "mavproxy", "qgroundcontrol"])
def test_params_save_diff_and_load_round_trip(format_: str, run: Run) -> None:
    assert run("params", "save", "mine.param", "--format", format_)[0] == 0
    assert run("params", "diff", "mine.param")[0] == 0
    run("params", "set", "WPNAV_SPEED_UP=311")
    code, out, _ = run("params", "diff", "mine.param")
    assert code == 1
    assert "WPNAV_SPEED_UP" in out
    assert "1 of 1349 parameters differ" in out
    assert run("params", "load", "mine.param")[0] == 0
    assert run("params", "diff", "mine.param")[0] == 0


def test_params_load_of_damaged_file_sends_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine.param").write_text("WPNAV_SPEED,fast\n")
    assert main(["params", "load", "mine.param", "--connect", "tcp:127.0.0.1:1"]) == 6
    assert "mine.param" in capsys.readouterr().err


# -------------------------------------------------------------------------------------- missions


def test_mission_check_works_without_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(WAYPOINTS)
    assert main(["mission", "check", "m.waypoints"]) == 0
    assert "mission: 3 items\n    0  NAV_TAKEOFF" in capsys.readouterr().out


def test_mission_check_prints_parts_of_the_file_only(capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(WAYPOINTS.replace("\t22\t0\t0\t0\t0\t", "\t22\t0\t0\t0\tnan\t"))
    assert main(["mission", "check", "m.waypoints"]) == 0
    out = capsys.readouterr().out
    assert "    0  NAV_TAKEOFF                      0 0 0 – 0 0 " in out
    assert "fence" not in out
    assert "rally" not in out
    assert "nan" not in out


@pytest.mark.parametrize(
    ("old", "new"), [("47.398\t", "91\t"), ("QGC WPL 110", "something else"), ("2\t0\t3\t16", "2\t0\t77\t16")]
)
def test_mission_check_of_invalid_file_fails(old: str, new: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(WAYPOINTS.replace(old, new))
    assert main(["mission", "check", "m.waypoints"]) in (2, 6)  # an invalid item, or an invalid file
    assert capsys.readouterr().err.startswith("aerokit: ")


def test_mission_check_warns_of_unknown_command_and_missing_take_off(capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(WAYPOINTS.replace("\t3\t22\t", "\t3\t9999\t"))
    assert main(["mission", "check", "m.waypoints"]) == 0
    out = capsys.readouterr().out
    assert "warning: mission item 0: command 9999 is not a MAV_CMD" in out
    assert "warning: the mission does not begin with a take-off" in out
    assert out.endswith("m.waypoints has no errors, but 2 warnings\n")


@pytest.mark.parametrize(("vehicle_type", "warns"), [(MavType.QUADROTOR, True), (MavType.SUBMARINE, False)])
def test_mission_check_warns_of_altitudes_below_home(
    vehicle_type: MavType, warns: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    items = take_off(-5), waypoint(47.3, 8.5, altitude_relative_m=-20), land(47.3, 8.5, altitude_relative_m=-1)
    write_plan_file("m.plan", Plan(Mission(items), vehicle_type=vehicle_type))
    assert main(["mission", "check", "m.plan"]) == 0
    warnings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    expected = ["mission item 0: NAV_TAKEOFF at -5 m above home", "mission item 1: NAV_WAYPOINT at -20 m above home"]
    assert warnings == [f"warning: {text}" for text in expected if warns]


@pytest.mark.parametrize("text", ["", "[1]", '{"a":', "hello"])
def test_broken_plan_file_gives_error_about_plan(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("bad.plan").write_text(text)
    assert main(["mission", "check", "bad.plan"]) == 6
    err = capsys.readouterr().err
    assert "QGC WPL" not in err
    assert err.startswith("aerokit: bad.plan")


def test_mission_upload_gives_the_warnings_of_check(run: Run) -> None:
    Path("m.waypoints").write_text(WAYPOINTS.replace("\t3\t22\t", "\t3\t16\t"))
    out = run("mission", "upload", "m.waypoints")[1]
    assert "warning: the mission does not begin with a take-off" in out


def test_mission_check_of_plan_without_problems_has_no_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(WAYPOINTS)
    assert main(["mission", "check", "m.waypoints"]) == 0
    assert capsys.readouterr().out.endswith("m.waypoints has no errors\n")


@pytest.mark.parametrize(("firmware", "has_note"), [(0, True), (MavAutopilot.ARDUPILOTMEGA, False)])
def test_mission_check_notes_items_for_ardupilot_only(
    firmware: int, has_note: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    items = take_off(15), return_to_launch()
    write_plan_file("m.plan", Plan(Mission(items), firmware_type=firmware))
    assert main(["mission", "check", "m.plan"]) == 0
    note = "note: for vehicles other than ArduPilot: item 0 (NAV_TAKEOFF): x, y = 0, 0 is not allowed"
    out = capsys.readouterr().out
    assert (note in out) is has_note
    assert out.endswith("m.plan has no errors\n")


def test_mission_upload_of_far_item_names_item_and_option() -> None:
    async def scenario() -> None:
        async with open_flight() as flight:
            await flight.vehicle.wait_ready()
            options = argparse.Namespace(patience=10.0, max_distance_m=100_000.0, json=True)
            far = waypoint(17.398, 8.5456, altitude_relative_m=10)
            plan = Plan(Mission([take_off(altitude_relative_m=10), far]))
            with pytest.raises(InvalidArgument, match=r"^mission item 1 = 17\.39.*greater --max-distance-m"):
                await upload_parts(flight.vehicle, plan, options)
            options.max_distance_m = 1e8
            await upload_parts(flight.vehicle, plan, options)

    run_virtual(scenario())


def test_mission_upload_show_download_and_clear(run: Run) -> None:
    Path("m.waypoints").write_text(WAYPOINTS)
    code, out, _ = run("mission", "upload", "m.waypoints")
    assert (code, out) == (0, "mission: 3 items uploaded to vehicle 1\n")
    code, out, _ = run("mission", "show", "mission", "fence")
    assert "    1  NAV_WAYPOINT                     47.3980000 8.5456000 15 m" in out
    assert "fence: 0 items" in out
    assert run("mission", "download", "again.waypoints")[0] == 0
    assert run("mission", "download", "again.plan")[0] == 0
    assert len(json.loads(Path("again.plan").read_text())["mission"]["items"]) == 3
    assert run("mission", "upload", "again.plan")[0] == 0
    assert run("mission", "clear")[0] == 0
    assert run("mission", "show")[1] == "mission: 0 items\n"


def test_mission_start_on_disarmed_vehicle_is_refused(run: Run) -> None:
    code, _, err = run("mission", "start")
    assert code == 5
    assert "not armed; nothing was sent. `aerokit fly FILE`" in err
    assert "arm()" not in err


# ---------------------------------------------------------------------------------- files, logs


def test_files_actions_round_trip(run: Run) -> None:
    Path("here.txt").write_bytes(b"some bytes")
    assert run("files", "mkdir", "/box")[0] == 0
    assert run("files", "put", "here.txt", "/box/a.txt")[:2] == (0, "/box/a.txt: 10 bytes\n")
    assert run("files", "mv", "/box/a.txt", "/box/b.txt")[0] == 0
    assert run("files", "ls", "/box")[1].split() == ["10", "b.txt"]
    assert run("files", "get", "/box/b.txt")[0] == 0
    assert Path("b.txt").read_bytes() == b"some bytes"
    assert run("files", "get", "/box/b.txt")[0] == 6
    assert run("files", "get", "/box/b.txt", "--force")[0] == 0
    assert len(run("files", "crc", "/box/b.txt")[1].strip()) == 8
    assert run("files", "rm", "/box/b.txt")[0] == 0
    assert run("files", "rmdir", "/box")[0] == 0
    code, _, err = run("files", "rm", "/box/b.txt")
    assert code == 5
    assert "no such file" in err


def test_logs_get_downloads_newest_log_without_flight(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run("logs", "list")
    assert code == 0
    newest, size, *_ = out.splitlines()[-1].split()
    Path("there").mkdir()
    code, out, _ = run("logs", "get", "--to", "there")
    assert code == 0
    (log,) = Path("there").iterdir()
    assert log.stat().st_size == int(size)
    assert f"{int(newest):05}" in log.name
    assert run("logs", "get", "4711")[0] == 2
    assert main(["report", str(log)]) == 6
    assert "is a sample of aerokit's simulator and contains no flight" in capsys.readouterr().err


def test_logs_get_keeps_file_of_same_name(run: Run) -> None:
    """The vehicle counts from 1 again after its logs were erased."""
    newest = int(run("logs", "list")[1].splitlines()[-1].split()[0])
    other = Path(f"log{newest:05}.bin")
    other.write_bytes(b"another flight")
    code, _, err = run("logs", "get")
    assert code == 0
    assert f"{other} existed and was kept as log{newest:05}.1.bin" in err
    assert Path(f"log{newest:05}.1.bin").read_bytes() == b"another flight"


def test_logs_erase_without_yes_erases_nothing(run_elsewhere: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_elsewhere
    before = run("logs", "list")[1]
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    assert run("logs", "erase")[:2] == (1, "not confirmed; nothing was erased\n")
    assert run("logs", "list")[1] == before
    assert run("logs", "erase", "--yes")[:2] == (0, "erased\n")
    assert run("logs", "list")[1] == ""


# -------------------------------------------------------------------------------------- progress


def test_progress_bar_on_terminal_shows_percentage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    threads = threading.active_count()
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with progress_bar("flight.bin", unit="B") as show:
        show(TransferProgress(0, None, 0.0))
        show(TransferProgress(512 * 1024, 1024 * 1024, 1.0))
        show(TransferProgress(1024 * 1024, 1024 * 1024, 2.0))
    assert "flight.bin: 100%" in capsys.readouterr().err
    assert threading.active_count() == threads


def test_progress_bar_without_terminal_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("flight.bin", unit="B") as show:
        show(TransferProgress(512, 1024, 1.0))
    assert capsys.readouterr().err == ""
