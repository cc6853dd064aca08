"""``import dronekit_sitl`` in a program, and ``aerokit run --sim``."""

from __future__ import annotations

import random
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from aerokit.dronekit import runner
from aerokit.dronekit.sitl import SITL, ServedVehicle, start_default
from aerokit.errors import InvalidArgument, LinkOpenError

LIMIT_S = 100.0
OWN = """\
import dronekit_sitl
from dronekit import connect
sitl = dronekit_sitl.SITL(instance={instance})
sitl.download("copter", "stable")
sitl.launch(["--model", "quad", "--home=-35.5,149.5,600,353"], await_ready=True, restart=True, speedup=20)
vehicle = connect(sitl.connection_string(), wait_ready=False)
vehicle.wait_ready("gps_0", "armed")
print(vehicle.version is not None, vehicle.armed)
vehicle.close()
sitl.stop()
print(sitl.poll())
"""
ADDRESSES_GIVEN = """\
import sys
from dronekit import connect
vehicle = connect(sys.argv[1], wait_ready=False)
vehicle.wait_ready("mode")
print(vehicle.mode.name)
vehicle.close()
"""


def free_instance() -> int:
    """Return an instance whose port is free: 5760 plus ten for each instance.

    A random one, because another run of the tests may be looking, too; below the ports that the system gives out.
    """
    for instance in random.SystemRandom().sample(range(1574, 2700), 50):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", 5760 + 10 * instance))
            except OSError:
                continue
            return instance
    raise AssertionError


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "aerokit", "run", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )


def test_program_starts_own_simulated_vehicle(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(OWN.format(instance=free_instance()))
    ended = run(program)
    assert (ended.returncode, ended.stdout.splitlines()) == (0, ["True False", "0"]), ended.stderr


def test_sitl_port_in_use_raises() -> None:
    instance = free_instance()
    sitl, other = SITL(instance=instance), SITL(instance=instance)
    sitl.launch([])
    try:
        assert sitl.connection_string() == f"tcp:127.0.0.1:{5760 + 10 * instance}"
        with pytest.raises(LinkOpenError):
            other.launch([])
        with pytest.raises(ChildProcessError):
            sitl.launch([])
        sitl.launch([], restart=True)
        assert sitl.block_until_ready() is None
    finally:
        sitl.stop()
    sitl.complete()
    assert sitl.poll() == 0


def test_sitl_invalid_position_or_system_raises() -> None:
    with pytest.raises(InvalidArgument, match="both lat and lon"):
        start_default(lat=1.0)
    with pytest.raises(InvalidArgument, match="one of copter"):
        SITL().download("boat", "stable")


def test_sim_option_serves_vehicle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program = tmp_path / "program.py"
    program.write_text(ADDRESSES_GIVEN)
    instance = free_instance()
    port = 5760 + 10 * instance
    monkeypatch.setattr("aerokit.dronekit.sitl.TCP_ADDRESS", f"tcpin:127.0.0.1:{port}")
    monkeypatch.setattr("aerokit.dronekit.sitl.UDP_ADDRESS", f"udpout:127.0.0.1:{port}")
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    monkeypatch.setattr(sys, "argv", [""])
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])
    from aerokit.dronekit.runner import uninstall

    try:
        code = runner.main(["--sim", "--speedup", "10", str(program), f"tcp:127.0.0.1:{port}"], "aerokit run")
    finally:
        uninstall()
    notified = capsys.readouterr()
    assert (code, notified.out) == (0, "STABILIZE\n")
    assert f"a simulated copter is on tcp:127.0.0.1:{port}" in notified.err


def simulated_vehicle_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "aerokit simulated vehicle"]


def test_sim_option_missing_module_stops_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.dronekit.sitl.TCP_ADDRESS", "tcpin:127.0.0.1:0")
    monkeypatch.setattr("aerokit.dronekit.sitl.UDP_ADDRESS", f"udpout:127.0.0.1:{5760 + 10 * free_instance()}")
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    try:
        assert runner.main(["--sim", "-m", "no_such_module"]) == 1
    finally:
        runner.uninstall()
    assert not simulated_vehicle_threads()


def test_sitl_start_timeout_ends_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    may_start = threading.Event()
    monkeypatch.setattr("aerokit.dronekit.sitl.scale_timeouts", lambda *_: may_start.wait(LIMIT_S))
    monkeypatch.setattr("aerokit.dronekit.sitl.START_TIMEOUT_S", 0.0)
    with pytest.raises(LinkOpenError, match="not started within 0 s"):
        ServedVehicle("copter", ["tcpin:127.0.0.1:0"])
    may_start.set()
    for thread in simulated_vehicle_threads():
        thread.join(LIMIT_S)
        assert not thread.is_alive()


def test_sitl_model_has_priority_over_sim_option(monkeypatch: pytest.MonkeyPatch) -> None:
    class Launched:
        kind, speedup, is_up = "copter", 1.0, False

        def __init__(self, kind: str, *_: Any, **__: Any) -> None:
            self.kind = kind

        def stop(self) -> None: ...

    monkeypatch.setattr("aerokit.dronekit.sitl.ServedVehicle", Launched)
    for arguments, kind in ((["--model", "plane"], "plane"), (["--model", "quad"], "rover")):
        monkeypatch.setattr("aerokit.dronekit.sitl._vehicle_for_program", Launched("rover"))
        sitl = SITL(instance=0)
        sitl.launch(arguments)
        assert sitl._served is not None
        assert sitl._served.kind == kind


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--sim", "--vehicle", "coptr"], "did you mean 'copter'"),
        (["--sim", "--home", "x"], "it must be LAT,LON,ALT"),
        (["-m", "no_such_module"], "No module named no_such_module"),
    ],
)
def test_runner_errors_have_no_traceback(arguments: list[str], text: str, tmp_path: Path) -> None:
    program = [] if "-m" in arguments else [tmp_path / "p.py"]
    (tmp_path / "p.py").write_text("")
    ended = run(*arguments, *program)
    assert ended.returncode == 1
    assert text in ended.stderr
    assert "Traceback" not in ended.stderr
