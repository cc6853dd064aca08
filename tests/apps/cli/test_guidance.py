"""Help, suggestions, hints and confirmations of the command line, and completion in real shells."""

from __future__ import annotations

import json
import logging
import os
import select
import shutil
import subprocess
import sys
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from cli_harness import HOME, MISSION, run_on, run_with

from aerokit import messages as m
from aerokit.apps.cli import main
from aerokit.apps.cli.main import COMMANDS, GROUPS, RUN, make_parser
from aerokit.apps.cli.output import NotInstalled, import_extra, near_names, plain_warnings, suggestion
from aerokit.mavlink.tlog import read_tlog
from aerokit.parameters.renames import ParameterRenamedWarning
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal
from aerokit.testing import run_virtual


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.waypoints").write_text(MISSION)


# -------------------------------------------------------------------------------- help, suggestions


def test_aerokit_alone_prints_help_by_task(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    printed = capsys.readouterr().out
    assert all(f"\n{title}:\n" in printed for title in GROUPS)
    assert "\n  params " in printed.partition("parameters, files, devices:")[2].partition("\n\n")[0]
    listed = Counter(name for names in GROUPS.values() for name in names)
    assert listed == Counter([*(command.name for command in COMMANDS), RUN]), "name each once in GROUPS of main.py"


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("stauts", "status"),
        ("log", "logs"),
        ("convrt", "convert"),
        ("arm", None),
        ("land", None),
        ("xy", None),
    ],
)
def test_suggestion_is_made_for_near_names_only(name: str, near: str | None) -> None:
    known = [command.name for command in COMMANDS]
    assert near_names(name, known) == ([near] if near else [])
    assert suggestion(name, known) == (f" (did you mean {near!r}?)" if near else "")


def test_unknown_option_gets_no_far_suggestion(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--to", "--foo"):  # not --json, not --force
        with pytest.raises(SystemExit):
            main(["params", "save", "x", option])
        assert "did you mean" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("assignment", "hint"),
    [
        ("RTL_AL=1", "(did you mean 'RTL_ALT' or 'RTL_ALT_TYPE' or 'RTL_ALT_FINAL'?)"),
        ("RTL_ALTITUDE=1", "(did you mean 'RTL_ALT' or 'RTL_ALT_TYPE'?)"),  # a plane's name
        ("BOGUS=1", "; `aerokit params list` shows all names"),
    ],
)
def test_params_set_of_unknown_name_suggests_names(
    assignment: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_with(SimulatedCopter(boot_time_s=0.0), ["params", "set", assignment]) == [5]
    assert capsys.readouterr().out.strip().endswith(hint)


# ------------------------------------------------------------------------------------ confirmations


def test_logs_and_photos_make_their_directory(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0, components=[SimulatedCamera()])
    commands = ["logs", "get", "--to", "flights/logs"], ["camera", "photo", "--to", "pictures"]
    assert run_with(copter, *commands) == [0, 0]
    assert len(list(Path("flights/logs").iterdir())) == len(list(Path("pictures").iterdir())) == 1


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("command", "line"),
    [
        (["files", "mkdir", "/box"], "created /box"),
        (["files", "rmdir", "/APM/empty"], "removed /APM/empty"),
        (["camera", "mode", "video"], "mode video"),
        (["camera", "zoom", "30"], "zoom 30 %"),
        (["gimbal", "point", "-45", "20"], "pointing at pitch -45°, yaw 20°"),
        (["gimbal", "neutral"], "in neutral position"),
        (["gimbal", "release"], "control returned to the pilot"),
        (["params", "load", "same.param"], "1 parameters in same.param, 0 of them differed"),
    ],
    ids=lambda value: " ".join(value[:2]) if isinstance(value, list) else "",
)
def test_successful_action_prints_one_line(command: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0, components=[SimulatedCamera(), SimulatedGimbal()])
    Path("same.param").write_text("RTL_ALT,1500\n")
    assert run_with(copter, ["files", "mkdir", "/APM/empty"], command) == [0, 0]
    assert capsys.readouterr().out.splitlines() == ["created /APM/empty", line]


@pytest.mark.parametrize(("options", "has_streams"), [([], True), (["--as-is"], False)])
def test_record_requests_usual_streams_unless_as_is(options: list[str], has_streams: bool) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    assert run_with(copter, ["record", "flight.tlog", "--seconds", "5", *options]) == [0]
    frames = [raw for _, raw in read_tlog("flight.tlog")]
    attitudes = sum(frame[7:10] == bytes([m.Attitude.ID, 0, 0]) for frame in frames if frame[0] == 0xFD)
    assert (attitudes > 20) is has_streams
    assert any(frame[5] == 254 and frame[7] == m.CommandLong.ID for frame in frames) is has_streams


# ----------------------------------------------------------------------------------------- simulator


def test_sim_devices_are_components_of_each_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    from aerokit.apps.cli.main import make_parser
    from aerokit.apps.cli.sim import _fleet

    arguments = ["--count", "2", "--camera", "--camera", "--gimbal", "--companion"]
    fleet = _fleet(make_parser("sim").parse_args(["sim", *arguments]))
    assert [[each.component_id for each in vehicle.components] for vehicle in fleet] == [[100, 101, 154, 191]] * 2
    assert run_with(fleet, ["camera", "info", "--system-id", "2"]) == [0]
    assert main(["sim", *["--camera"] * 7]) == 2
    assert "--camera is given 7 times, but a vehicle has at most 6" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("address", "hint"),
    [
        ("udpout:127.0.0.1:45570", "try: aerokit demo --connect udpin:127.0.0.1:45570 --system-id 1"),
        ("udpout:127.0.0.1:{45571+n}", "try: aerokit demo --connect udpin:127.0.0.1:45571"),
    ],
)
def test_sim_hint_chooses_one_of_several_vehicles(address: str, hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", address, "--count", "3", "--duration", "1", "--speedup", "100"]) == 0
    assert hint in capsys.readouterr().out.splitlines()


def test_sim_on_two_ports_prints_vehicle_once_and_programs(capsys: pytest.CaptureFixture[str]) -> None:
    one, other = "udpout:127.0.0.1:45575", "udpout:127.0.0.1:45576"
    assert main(["sim", one, other, "--duration", "1", "--speedup", "100"]) == 0
    lines = capsys.readouterr().out.splitlines()
    place = "udpin:127.0.0.1:45575"
    assert lines[0] == f"system 1 on {one} and {other}, speed 100x"
    assert lines[2] == f"or:  aerokit status {place}, aerokit monitor {place}, aerokit serve {place}"


# -------------------------------------------------------------------------------------------- flying


@pytest.mark.exhaustive
def test_fly_rehearsal_reports_duration_of_real_flight(capsys: pytest.CaptureFixture[str]) -> None:
    lines = {}
    for speedup in ("1", "10"):
        assert run_virtual(run_on(None, "fly", "m.waypoints", "--sim", "--speedup", speedup)) == 0
        (lines[speedup],) = [line for line in capsys.readouterr().out.splitlines() if " armed for " in line]
    assert "armed for 1 min 0" in lines["1"]
    assert "armed for 1 min 0" in lines["10"]
    assert "(simulated in 6 s, 10x)" in lines["10"]
    assert "simulated in" not in lines["1"]


@pytest.mark.exhaustive
def test_fly_prints_four_words_for_each_item(capsys: pytest.CaptureFixture[str]) -> None:
    """The list counts like the progress, and the vehicle's texts with other numbers are left out."""
    copter = SimulatedCopter(boot_time_s=0.0, home=HOME)
    assert run_with(copter, ["fly", "m.waypoints", "--yes"]) == [0]
    lines = capsys.readouterr().out.splitlines()
    listed = [line.split()[:2] for line in lines[1:5]]
    progress = [line.split()[4:] for line in lines if " m  to item " in line]
    expected = [["to", "item", f"{number},", name] for number, name in listed]
    assert progress in (expected, expected[1:])  # the vehicle may have been at the first item before
    assert not any("Reached command" in line or "Mission: " in line for line in lines)


@pytest.mark.exhaustive
def test_next_command_replaces_report_of_earlier_flight(capsys: pytest.CaptureFixture[str]) -> None:
    Path("x.html").touch()
    copter = SimulatedCopter(boot_time_s=0.0, home=HOME)
    assert run_with(copter, ["fly", "m.waypoints", "--yes", "--record", "x.tlog"]) == [0]
    assert capsys.readouterr().out.endswith("\nnext: aerokit report --force x.tlog\n")


@pytest.mark.exhaustive
def test_fly_records_and_names_next_command(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0, home=HOME)
    Path("my flight.tlog").write_text("earlier")
    assert run_with(copter, ["fly", "m.waypoints", "--yes", "--record", "my flight.tlog"]) == [0]
    assert Path("my flight.1.tlog").read_text() == "earlier"
    assert capsys.readouterr().out.endswith("\nnext: aerokit report 'my flight.tlog'\n")
    assert sum(1 for _ in read_tlog("my flight.tlog")) > 100
    assert run_with(SimulatedCopter(boot_time_s=0.0, home=HOME), ["fly", "m.waypoints", "--yes"]) == [0]
    assert "next time: --record FILE.tlog" in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize("command", ["demo", "fly", "serve", "monitor", "hub"])
def test_record_option_exists_where_something_flies(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert "--record FILE" in capsys.readouterr().out


def test_page_of_serve_lists_its_options() -> None:
    parser: Any = make_parser("serve")
    (subparsers,) = parser._subparsers._group_actions
    options = {name for action in subparsers.choices["serve"]._actions for name in action.option_strings}
    page = (Path(__file__).parents[3] / "docs" / "serve.md").read_text(encoding="utf-8")
    of_every_command = {"-h", "--help", "--baud", "--signing-key"}
    assert {name for name in options - of_every_command if name not in page} == set()


def test_fly_without_connection_leaves_no_recording() -> None:
    arguments = ["fly", "m.waypoints", "--yes", "--connect", "tcp:127.0.0.1:1", "--record", "x.tlog"]
    assert main(arguments) == 3
    assert not Path("x.tlog").exists()


# ----------------------------------------------------------------------------------------- completion


@pytest.fixture
def shell_environment(tmp_path: Path) -> dict[str, str]:
    """Return variables with which ``aerokit`` runs this code."""
    program = tmp_path / "bin" / "aerokit"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m aerokit "$@"\n')
    program.chmod(0o755)
    return {**os.environ, "PATH": f"{program.parent}:{os.environ['PATH']}", "TERM": "dumb"}


@pytest.mark.exhaustive
@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_completion_in_fish_offers_matches(shell_environment: dict[str, str]) -> None:
    lines = ("aerokit params l", "aerokit st", "aerokit status tcp")
    program = "aerokit completion fish | source; " + "; ".join(f'complete -C "{line}"' for line in lines)
    done = subprocess.run(["fish", "-c", program], env=shell_environment, capture_output=True, text=True, check=True)
    words = [line.split("\t")[0] for line in done.stdout.splitlines()]
    assert words == ["list", "load", "status", "tcp:127.0.0.1:5760"]


@pytest.mark.exhaustive
@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_completion_in_zsh_completes_line(shell_environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / ".zshrc").write_text(
        'autoload -Uz compinit && compinit -u -D\neval "$(aerokit completion zsh)"\nPS1="READY> "\n'
    )
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        ["zsh", "-i"],
        env={**shell_environment, "ZDOTDIR": str(tmp_path)},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    )

    def read_until(text: bytes) -> None:
        seen, deadline = b"", time.monotonic() + 200
        while text not in seen:
            assert time.monotonic() < deadline, seen
            if select.select([ours], [], [], 0.1)[0]:
                seen += os.read(ours, 65536)

    try:
        read_until(b"READY> ")
        for typed, completed in (
            (b"aerokit sta", b"aerokit status "),
            (b"aerokit params get RTL_ALT_F", b"INAL "),
        ):
            os.write(ours, typed + b"\t")
            read_until(completed)
            os.write(ours, b"\x15")  # clear the line
    finally:
        process.kill()
        process.wait()
        os.close(ours)
        os.close(theirs)


# ------------------------------------------------------------------------------------------- warnings


def test_library_warning_is_printed_as_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    shown: list[object] = []
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: shown.append(message)
        with plain_warnings():
            warnings.showwarning("RTL_ALT_M is still called RTL_ALT", ParameterRenamedWarning, "params.py", 1)
            warnings.showwarning("another library's", UserWarning, "other.py", 1)
    assert capsys.readouterr().err == "aerokit: RTL_ALT_M is still called RTL_ALT\n"
    assert shown == ["another library's"]


def test_blocked_loop_is_reported_as_busy_computer(caplog: pytest.LogCaptureFixture) -> None:
    with plain_warnings():
        logging.getLogger("aerokit").warning("the event loop was blocked for %.1f s: ...; %s", 2.5, "use asyncio.sleep")
        logging.getLogger("aerokit").warning("link lost")
    assert caplog.messages == [
        "this computer was busy for 2.5 s: no messages or heartbeats were processed",
        "link lost",
    ]


# ---------------------------------------------------------------------------------------- parameters


def test_params_list_takes_part_of_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedCopter(boot_time_s=0.0), ["params", "list", "rtl_s"]) == [0]
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert "RTL_SPEED" in names
    assert all("RTL_S" in name for name in names)


def test_params_set_without_equals_sign_error_says_how(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["params", "set", "RTL_ALT", "2000"])
    assert "'RTL_ALT' has no value; expected NAME=VALUE, without spaces" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "requirement"),
    [
        ({}, "'aerokit-mavlink[monitor]'"),
        ({"url": "file:///home/me/aerokit", "dir_info": {}}, "'aerokit-mavlink[monitor] @ file:///home/me/aerokit'"),
        ({"url": "file:///home/me/my%20kit", "dir_info": {"editable": True}}, "-e '/home/me/my kit[monitor]'"),
        (
            {"url": "https://git.example/aerokit.git", "vcs_info": {"vcs": "git", "commit_id": "5ae20c17"}},
            "'aerokit-mavlink[monitor] @ git+https://git.example/aerokit.git@5ae20c17'",
        ),
    ],
)
def test_missing_extra_names_command_for_this_installation(
    source: dict[str, object], requirement: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Distribution:
        def read_text(self, name: str) -> str:
            assert name == "direct_url.json"
            return json.dumps(source)

    monkeypatch.setattr("importlib.metadata.distribution", lambda name: Distribution())
    with pytest.raises(NotInstalled) as caught:
        import_extra("no_such_module", extra="monitor")
    assert str(caught.value).endswith(f" -m pip install {requirement}")
