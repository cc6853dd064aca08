"""The command line: output, exit codes, and the safe end of flights."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from cli_harness import run_on
from exhaustive import exhaustive
from served_copter import served, served_copter

import aerokit
import aerokit.sync
from aerokit.apps.cli import main
from aerokit.mavlink.tlog import read_tlog
from aerokit.sim import SimulatedCopter
from aerokit.testing import run_virtual

posix_only = pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")


@contextmanager
def program(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run ``aerokit`` in a subprocess with piped output."""
    with subprocess.Popen(
        [sys.executable, "-m", "aerokit", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def read_until(process: subprocess.Popen[str], text: str) -> str:
    assert process.stdout is not None
    read = ""
    for line in process.stdout:
        read += line
        if text in line:
            return read
    raise AssertionError(f"{text!r} was not printed:\n{read}")


def read_rest(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    rest = process.stdout.read()
    process.wait(200)
    assert "Traceback" not in rest
    return rest


# ---------------------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    "arguments",
    [
        ["fly"],
        ["demo", "--connect", "nonsense"],
        ["demo", "--altitude", "-3"],
        ["demo", "--altitude", "high"],
        ["demo", "--side", "nan"],
        ["demo", "--system-id", "256"],
        ["demo", "--record", "/there/is/no/such/directory/flight.tlog"],
        ["demo", "--speedup", "0"],
        ["sim", "nonsense"],
        ["sim", "--vehicle", "balloon"],
        ["sim", "--home", "91,0,0"],
        ["sim", "--home", "47.4,8.5"],
        ["sim", "--home", "47.4,8.5,nan"],
        ["sim", "--parameter", "MNT1_TYPE"],
        ["sim", "--parameter", "MNT1_TYPE=servo"],
        ["sim", "--parameter", "RTL_ALT=nan"],
        ["sim", "--parameter", "RTL_ALT=-inf"],
        ["sim", "--parameter", "RTL_ALT=1e39"],
        ["params", "set", "udpin:127.0.0.1:1", "RTL_ALT=nan"],
        ["params", "set", "udpin:127.0.0.1:1", "RTL_ALT"],
    ],
    ids=" ".join,
)
def test_invalid_arguments_exit_with_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    assert re.search(r"error: ", capsys.readouterr().err)


def test_version_option_prints_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["--version"])
    assert exit_.value.code == 0
    assert capsys.readouterr().out == f"aerokit {aerokit.__version__}\n"


def test_demo_on_refused_connection_exits_with_code_3(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["demo", "--connect", "tcp:127.0.0.1:1", "--record", str(tmp_path / "flight.tlog")]) == 3
    assert "aerokit: cannot open tcp:127.0.0.1:1" in capsys.readouterr().err


def test_sim_on_used_port_exits_with_code_3(capsys: pytest.CaptureFixture[str]) -> None:
    with served_copter() as address:
        assert main(["sim", address.replace("tcp:", "tcpin:")]) == 3
    assert capsys.readouterr().err.startswith("aerokit: cannot ")


# --------------------------------------------------------------------------------------- demo


@pytest.mark.parametrize("address", ["tcp:127.0.0.1:1", "/dev/no-such-device,57600"])
def test_demo_connection_failure_keeps_last_recording(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    last = tmp_path / "demo.tlog"
    last.write_bytes(b"the last flight")
    assert main(["demo", "--connect", address]) != 0
    assert last.read_bytes() == b"the last flight"


@pytest.mark.parametrize(("vehicle", "firmware"), [("copter", "ArduCopter"), exhaustive(pytest.param("px4", "PX4"))])
def test_demo_on_simulated_vehicle_flies_square_and_lands(
    vehicle: str, firmware: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    record = tmp_path / "flight.tlog"
    arguments = [
        "--vehicle",
        vehicle,
        "--altitude",
        "4",
        "--side",
        "5",
        "--speedup",
        "30",
        "--record",
        str(record),
    ]
    assert main(["demo", *arguments]) == 0
    printed = capsys.readouterr().out
    for text in (
        f"found {firmware}",
        "ready, home is",
        "reached the north-east corner",
        "disarmed",
        "flown ",
        f"recorded in {record}",
    ):
        assert text in printed
    assert sum(1 for _ in read_tlog(record)) > 100


@pytest.mark.exhaustive
def test_demo_arming_refusal_prints_reason(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.faults.refuse(400, text="Arm: Motors not spinning freely")
    with served([copter]) as address:
        assert main(["demo", "--connect", address, "--record", str(tmp_path / "flight.tlog")]) == 1
    assert "Arm: Motors not spinning freely" in capsys.readouterr().out


@posix_only
def test_demo_ctrl_c_while_connecting_exits_with_code_130(tmp_path: Path) -> None:
    record = str(tmp_path / "flight.tlog")
    with program("demo", "--connect", "udpin:127.0.0.1:0", "--record", record) as process:
        read_until(process, "connecting to")
        process.send_signal(signal.SIGINT)
        assert read_rest(process) == "interrupted\n"
        assert process.returncode == 130


@posix_only
def test_demo_ctrl_c_in_air_lands_vehicle(tmp_path: Path) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    with served([copter]) as address, in_the_air(address, tmp_path) as process:
        process.send_signal(signal.SIGINT)
        printed = read_rest(process)
        assert (
            "interrupted, in GUIDED, still armed, " in printed
            or "interrupted, holding in BRAKE, still armed" in printed
        )
        assert "landing here" in printed
        assert "disarmed" in printed
        assert process.returncode == 130
        assert (copter.is_armed, copter.is_landed) == (False, True)


@pytest.mark.exhaustive
@posix_only
def test_demo_second_ctrl_c_exits_while_landing(tmp_path: Path) -> None:
    with served_copter() as address, in_the_air(address, tmp_path) as process:
        process.send_signal(signal.SIGINT)
        read_until(process, "mode LAND")
        process.send_signal(signal.SIGINT)
        assert "interrupted again; no further commands: vehicle in LAND, still armed, " in read_rest(process)
        assert process.returncode == 130


@posix_only
@pytest.mark.parametrize("mode", ["LOITER", exhaustive("BRAKE")])
def test_demo_mode_change_by_pilot_is_not_overruled(mode: str, tmp_path: Path) -> None:
    with (
        served([SimulatedCopter(boot_time_s=0.0)], "tcpin:127.0.0.1:0") as address,
        in_the_air(address, tmp_path) as process,
        aerokit.sync.connect(address, source_system=254) as pilot,
    ):
        pilot.set_mode(mode)
        printed = read_until(process, "the recording goes on until the vehicle disarms")
        assert f"the mode changed to {mode}" in printed
        assert f"the vehicle itself or another party changed the mode to {mode}" in printed
        process.send_signal(signal.SIGINT)
        assert f"in {mode}, still armed" in read_rest(process)
        assert process.returncode == 1
        assert pilot.is_armed


@pytest.mark.exhaustive
def test_demo_records_flight_after_failsafe_to_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_virtual(run_on(None, "demo", "--speedup", "1", "--fault", "rc_lost@30", "--record", "x.tlog")) == 1
    out = capsys.readouterr().out
    assert "still armed: the recording goes on until the vehicle disarms" in out
    assert "end of the recording: in RTL, disarmed, 0.0 m above home" in out


@pytest.mark.exhaustive
def test_demo_on_flying_vehicle_sends_no_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with served_copter() as address, aerokit.sync.connect(address) as pilot:
        pilot.wait_ready()
        pilot.arm()
        pilot.take_off(5)
        pilot.set_mode("BRAKE")
        record = str(tmp_path / "flight.tlog")
        assert main(["demo", "--connect", address, "--record", record]) == 1
        assert "the vehicle was armed by another party (holding in BRAKE, still armed, " in capsys.readouterr().out
        assert (pilot.mode_name, pilot.is_armed) == ("BRAKE", True)


@pytest.mark.exhaustive
@posix_only
def test_demo_closed_stdout_does_not_end_flight(tmp_path: Path) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    with served([copter]) as address, in_the_air(address, tmp_path, side_m=3) as process:
        assert process.stdout is not None
        process.stdout.close()
        process.wait(200)
        assert copter.is_landed


@contextmanager
def in_the_air(address: str, directory: Path, *, side_m: float = 30) -> Iterator[subprocess.Popen[str]]:
    """Run the demo until it is at altitude."""
    arguments = ["--connect", address, "--altitude", "4", "--side", str(side_m)]
    with program("demo", *arguments, "--record", str(directory / "flight.tlog")) as process:
        read_until(process, "at altitude")
        yield process


# ---------------------------------------------------------------------------------------- sim


def test_sim_unknown_parameter_exits_with_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "--parameter", "NO_SUCH=1"]) == 2
    assert "NO_SUCH" in capsys.readouterr().err


@posix_only
def test_sim_serves_vehicle_until_ctrl_c() -> None:
    with program(
        "sim", "tcpin:127.0.0.1:0", "--system-id", "9", "--speedup", "20", "--parameter", "rtl_alt=2000"
    ) as process:
        address = read_until(process, "aerokit demo --connect").split()[-1]
        with aerokit.sync.connect(address) as vehicle:
            assert vehicle.system_id == 9
            assert vehicle.parameters.get("RTL_ALT") == 2000
        process.send_signal(signal.SIGINT)
        assert read_rest(process).endswith("stopped\n")
        assert process.returncode == 0
