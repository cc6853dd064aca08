"""DroneKit programs run unchanged: the alias, and everything a program finds as with ``python program.py``."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import types
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from served_copter import served_copter, without_loop_warnings

import aerokit.dronekit
from aerokit.apps.cli import main as aerokit_main
from aerokit.dronekit import runner
from aerokit.dronekit.runner import install, uninstall

PROBE = """\
import json, sys
import beside
json.dump([__name__, __file__, sys.argv, sys.path, __spec__ is None, __package__, vars(sys.modules["__main__"])
    is globals(), beside.__file__], sys.stdout)
"""


@pytest.fixture(autouse=True)
def without_alias() -> Iterator[None]:
    uninstall()
    yield
    uninstall()


def program(folder: Path, text: str, name: str = "program.py") -> Path:
    (folder / "beside.py").touch()
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def run(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
        cwd=cwd,
    )


# ------------------------------------------------------------------------------------- alias


def test_import_aerokit_does_not_alias_dronekit() -> None:
    assert "dronekit" not in sys.modules


def test_install_aliases_all_imports() -> None:
    install()
    install()
    program: dict[str, Any] = {}
    exec(
        "import dronekit, dronekit.lib, dronekit.mavlink\n"
        "from dronekit import connect, VehicleMode, mavutil, util\n"
        "from dronekit.lib import LocationGlobalRelative\n"
        "from dronekit.util import errprinter\n",
        program,
    )
    assert program["dronekit"] is aerokit.dronekit
    assert program["connect"] is aerokit.dronekit.connect
    assert program["LocationGlobalRelative"] is aerokit.dronekit.LocationGlobalRelative
    assert program["mavutil"].mavlink.MAV_CMD_NAV_WAYPOINT == 16
    assert sys.modules["dronekit.mavlink"] is sys.modules["aerokit.dronekit.mavlink"]
    spec = sys.modules["dronekit.mavlink"].__spec__
    assert spec is not None
    assert spec.name == "aerokit.dronekit.mavlink"
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'dronekit.none'"):
        importlib.import_module("dronekit.none")


def test_uninstall_undoes_install() -> None:
    uninstall()
    install()
    uninstall()
    assert not [name for name in sys.modules if name.split(".")[0] == "dronekit"]


def test_install_with_another_dronekit_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    other = types.ModuleType("dronekit")
    other.__file__ = "/elsewhere/dronekit/__init__.py"
    monkeypatch.setitem(sys.modules, "dronekit", other)
    with pytest.raises(ImportError, match=r"another dronekit was already imported from /elsewhere/"):
        install()
    uninstall()
    assert sys.modules["dronekit"] is other


# ------------------------------------------------------------------------------------ program


def test_program_environment_matches_python(tmp_path: Path) -> None:
    path = program(tmp_path, PROBE)
    arguments = ("program.py", "--connect", "udp:1", "-h", "--", "-m", "")
    plain = run(*arguments, cwd=tmp_path)
    ours = run("-m", "aerokit.dronekit", *arguments, cwd=tmp_path)
    assert ours.stderr == plain.stderr == ""
    assert json.loads(ours.stdout) == json.loads(plain.stdout)
    assert json.loads(ours.stdout)[1:3] == [str(path), list(arguments)]


def test_module_environment_matches_python(tmp_path: Path) -> None:
    program(
        tmp_path,
        "import json, sys\njson.dump([__name__, sys.argv, sys.path[0], __spec__.name], sys.stdout)\n",
    )
    arguments = ("-m", "program", "-x")
    assert run("-m", "aerokit.dronekit", *arguments, cwd=tmp_path).stdout == run(*arguments, cwd=tmp_path).stdout


def test_module_package_may_change_search_path(tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__init__.py").write_text("import sys\nsys.path.insert(0, 'vendored')\n")
    program(tmp_path / "package", "import json, sys\njson.dump(sys.path[:2], sys.stdout)\n")
    arguments = ("-m", "package.program")
    ours = run("-m", "aerokit.dronekit", *arguments, cwd=tmp_path)
    assert json.loads(ours.stdout) == json.loads(run(*arguments, cwd=tmp_path).stdout) == ["vendored", str(tmp_path)]


@pytest.mark.parametrize(
    "text",
    ["import sys\n\ndef fail():\n    raise ValueError('no')\n\nfail()\n", "x = = 1\n"],
    ids=["raises", "syntax"],
)
def test_tracebacks_and_exit_codes_match_python(text: str, tmp_path: Path) -> None:
    path = program(tmp_path, text)
    plain, ours = run(path), run("-m", "aerokit", "run", path)
    assert (ours.returncode, ours.stderr) == (plain.returncode, plain.stderr)
    assert "Error" in ours.stderr


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
def test_ctrl_c_in_program_matches_python(tmp_path: Path) -> None:
    path = program(tmp_path, "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    ours = run("-m", "aerokit.dronekit", path)
    assert ours.returncode == -signal.SIGINT
    assert ours.stderr.count("File ") == 1


def test_missing_program_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert aerokit_main(["run", str(tmp_path / "none.py")]) == 2
    assert "can't open file" in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        aerokit_main(["run"])
    assert caught.value.code == 2


def test_help_text(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        aerokit_main(["run", "--help"])
    assert caught.value.code == 0
    assert "aerokit run [-h] [--sim [OPTION ...]] (PROGRAM.py | -m MODULE)" in capsys.readouterr().out


# --------------------------------------------------------------------------------- in-process


def test_run_script_restores_sys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv, path, main = sys.argv[:], sys.path[:], sys.modules["__main__"]
    runner.run_script(program(tmp_path, PROBE), ["a", "--b"])
    name, file, its_argv, its_path, *_ = json.loads(capsys.readouterr().out)
    assert (name, file, its_argv) == ("__main__", its_argv[0], [str(tmp_path / "program.py"), "a", "--b"])
    assert its_path == [str(tmp_path.resolve()), *path]
    assert (sys.argv, sys.path, sys.modules["__main__"]) == (argv, path, main)
    del sys.modules["beside"]


def test_run_script_propagates_exceptions(tmp_path: Path) -> None:
    main = sys.modules["__main__"]
    with pytest.raises(SystemExit) as caught:
        runner.run_script(program(tmp_path, "import sys, dronekit\nsys.exit(3)"))
    assert caught.value.code == 3
    assert sys.modules["__main__"] is main
    with pytest.raises(FileNotFoundError):
        runner.run_script(tmp_path / "none.py")


def test_folders_and_zip_files_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program(tmp_path, "import dronekit, sys\nprint(sys.argv[1:], __name__)\n", "__main__.py")
    with zipfile.ZipFile(tmp_path / "program.pyz", "w") as archive:
        archive.write(tmp_path / "__main__.py", "__main__.py")
    runner.run_script(tmp_path, ["folder"])
    runner.run_script(tmp_path / "program.pyz", ["zip"])
    assert capsys.readouterr().out.splitlines() == ["['folder'] __main__", "['zip'] __main__"]


LEFT_OPEN = """\
import sys
from dronekit import VehicleMode, connect

vehicle = connect(sys.argv[1], wait_ready=["mode"])
print(vehicle.mode.name)
"""


@pytest.mark.exhaustive
def test_open_vehicles_are_closed_after_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with served_copter() as address:
        threads = set(threading.enumerate())
        runner.run_script(program(tmp_path, LEFT_OPEN), [address])
        assert set(threading.enumerate()) <= threads
        ours = run("-m", "aerokit.dronekit", program(tmp_path, LEFT_OPEN), address)
    assert (ours.returncode, ours.stdout, without_loop_warnings(ours.stderr)) == (0, "STABILIZE\n", "")
    assert capsys.readouterr().out == "STABILIZE\n"
