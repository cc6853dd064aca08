"""Terminal features: countdown, questions, completion, suggestions, import time."""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import os
import struct
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from cli_harness import HOME, run_on, run_with

from aerokit.apps.cli import main, output
from aerokit.apps.cli import terminal as asking
from aerokit.apps.cli.output import can_print, emit, nonblocking_stderr, plain_warnings
from aerokit.parameters.renames import ParameterRenamedWarning
from aerokit.protocols.exchange import TransferProgress
from aerokit.sim import SimulatedCopter, SimulatedPx4
from aerokit.testing import run_virtual
from aerokit.transport.link import memory_link_pair

# ----------------------------------------------------------------------------------- countdown


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def stderr_without_vehicle(monkeypatch: pytest.MonkeyPatch, stderr: io.StringIO, *arguments: str) -> str:
    """Run a command on a silent link, and return its stderr."""
    monkeypatch.setattr(sys, "stderr", stderr)
    near, _ = memory_link_pair()
    assert run_virtual(run_on(near, *arguments)) == 3
    return stderr.getvalue()


@pytest.mark.parametrize("arguments", [("params", "list"), ("status",), ("fly", "m.waypoints", "--yes")])
def test_countdown_on_terminal_shows_remaining_seconds(
    arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.waypoints").write_text(
        "QGC WPL 110\n0\t1\t3\t16\t0\t0\t0\t0\t47\t8\t15\t1\n1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t15\t1\n"
    )
    printed = stderr_without_vehicle(monkeypatch, Terminal(), *arguments)
    steps = printed.split("\r\x1b[K")
    assert all(step.startswith("waiting for a heartbeat on ") for step in steps[1:30])
    assert [step.rpartition(" … ")[2] for step in steps[1:30]] == [f"{left} s" for left in range(29, 0, -1)]
    assert steps[-1].startswith("aerokit: ")
    assert "within 30 s" in steps[-1]


def test_countdown_with_json_or_pipe_is_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    assert stderr_without_vehicle(monkeypatch, Terminal(), "params", "list", "--json").startswith("aerokit: ")
    assert stderr_without_vehicle(monkeypatch, io.StringIO(), "params", "list").startswith("aerokit: ")


class FullTerminal(Terminal):
    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")


def test_countdown_error_does_not_replace_error_of_block(monkeypatch: pytest.MonkeyPatch) -> None:
    async def wait() -> None:
        async with asking.showing_countdown(argparse.Namespace(json=False), "tcp:127.0.0.1:1", 30.0):
            await asyncio.sleep(3.0)
            raise LookupError

    with monkeypatch.context() as patch, pytest.raises(LookupError):
        patch.setattr(sys, "stderr", FullTerminal())
        run_virtual(wait())


@pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")
def test_stopped_terminal_delays_warnings_and_progress_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    """After Ctrl-S, printing would block the event loop, and with it the heartbeats."""
    import fcntl
    import termios

    ours, theirs = os.openpty()
    with os.fdopen(ours, "rb", buffering=0) as reading, os.fdopen(theirs, "w") as terminal:
        os.set_blocking(theirs, False)
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        termios.tcflow(theirs, termios.TCOOFF)
        monkeypatch.setattr(sys, "stderr", terminal)
        with plain_warnings(), nonblocking_stderr():
            warnings.simplefilter("always")
            warnings.warn("one", ParameterRenamedWarning, stacklevel=1)
            with asking.progress_bar("two", unit="B") as show:
                show(TransferProgress(10, 10, 1.0))
            termios.tcflow(theirs, termios.TCOON)
            emit(argparse.Namespace(json=False), "line", {}, None)
            printed = b""
            while b"two" not in printed:
                printed += reading.read(10_000)
            assert b"one" in printed
        monkeypatch.undo()


def test_can_print_without_stdout_is_true(monkeypatch: pytest.MonkeyPatch) -> None:
    """Like ``aerokit fly … >&-``."""
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", None)
        assert can_print()


def test_warning_on_closed_terminal_raises_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", FullTerminal())
        with plain_warnings(), nonblocking_stderr():
            warnings.simplefilter("always")
            warnings.warn("one", ParameterRenamedWarning, stacklevel=1)


# ------------------------------------------------------------------------------------ question


@pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")
@pytest.mark.parametrize(
    ("typed", "is_confirmed"),
    [("y\n", True), ("YES\n", True), ("n\n", False), ("\n", False), ("\x04", False)],
)
def test_confirm_while_waiting_does_not_block_loop(
    typed: str, is_confirmed: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours, theirs = os.openpty()
    turns = []

    async def ask() -> bool:
        question = asyncio.create_task(asking.confirm("fly?"))
        for _ in range(5):
            await asyncio.sleep(0)
            turns.append(question.done())
        os.write(ours, typed.encode())
        return await question

    try:
        with os.fdopen(theirs) as stdin:
            monkeypatch.setattr(sys, "stdin", stdin)
            assert asking.is_interactive()
            assert asyncio.run(ask()) is is_confirmed
    finally:
        os.close(ours)
    assert turns == [False] * 5
    assert capsys.readouterr().err == "fly? [y/N] "


@pytest.mark.skipif(os.name != "posix", reason="Windows has no epoll")
@pytest.mark.parametrize(("content", "is_confirmed"), [(b"y\n", True), (b"", False), (b"\xff\n", False)])
def test_confirm_reads_redirected_input(
    content: bytes, is_confirmed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "input").write_bytes(content)
    with (tmp_path / "input").open(encoding="utf-8") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert asyncio.run(asyncio.wait_for(asking.confirm("fly?"), 10.0)) is is_confirmed


def test_text_that_another_thread_has_written_raises_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()

    def can_print_while_other_thread_writes(stream: object) -> bool:
        monkeypatch.setattr(output, "can_print", lambda stream: True)
        sys.stderr.flush()
        return True

    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", terminal)
        with nonblocking_stderr():
            monkeypatch.setattr(output, "can_print", can_print_while_other_thread_writes)
            sys.stderr.write("one")
    assert terminal.getvalue() == "one"


@pytest.mark.parametrize(("command", "question"), [("logs erase", "erase all"), ("camera format", "format the")])
def test_unanswered_question_is_declined_and_keeps_stdout_json(
    command: str, question: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "input").touch()
    with (tmp_path / "input").open() as stdin:
        monkeypatch.setattr(stdin, "isatty", lambda: True)
        monkeypatch.setattr(sys, "stdin", stdin)
        assert main([*command.split(), "--json"]) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {"type": "declined", "action": command}
    assert err.startswith(question)


# ---------------------------------------------------------------------------------- completion


def completions(line: str, tmp_path: Path) -> list[str]:
    out = tmp_path / "out"
    variables = {
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(out),
    }
    subprocess.run([sys.executable, "-m", "aerokit"], env={**os.environ, **variables}, check=True)
    return out.read_text().split()


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("line", "some"),
    [
        ("aerokit st", {"status"}),
        ("aerokit params l", {"list", "load"}),
        ("aerokit fly --on-interrupt ", {"return", "land", "hold", "nothing"}),
        ("aerokit sim --vehicle p", {"plane", "px4", "px4_plane"}),
        ("aerokit params get RTL_ALT_", {"RTL_ALT_FINAL", "RTL_ALT_TYPE"}),
        ("aerokit params set RTL_ALT_T", {"RTL_ALT_TYPE="}),
        ("aerokit status tcp", {"tcp:127.0.0.1:5760"}),
    ],
)
def test_completion_of_partial_line_offers_matches(line: str, some: set[str], tmp_path: Path) -> None:
    assert some <= set(completions(line, tmp_path))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script_is_printed_for_each_shell(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    assert "_ARGCOMPLETE" in (script := capsys.readouterr().out)
    assert "aerokit" in script


# ------------------------------------------------------------------------------ what was meant


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["stauts"], "'status'"),
        (["fly", "m.plan", "--on-interrupt", "lnad"], "'land'"),
        (["fly", "m.plan", "--vehicle", "coptr"], "'copter'"),
        (["mission", "show", "fnce"], "'fence'"),
        (["completion", "bsh"], "'bash'"),
        (["run", "--smi", "program.py"], "'--sim'"),
    ],
    ids=lambda value: " ".join(value),
)
def test_mistyped_argument_suggests_correction(
    arguments: list[str], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    assert f"(did you mean {meant}?)" in capsys.readouterr().err


@pytest.mark.parametrize("word", ["arm", "takeoff"])
def test_action_that_is_no_command_names_what_arms(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([word])
    error = capsys.readouterr().err
    assert f"unknown command '{word}'" in error
    assert all(command in error for command in ("aerokit fly", "aerokit serve", "Python"))


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["params", "get", "RTL_ATL"], 5),
        (["params", "list", "RTL_ATL"], 1),
        (["params", "set", "RTL_ATL=1500"], 5),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistyped_parameter_suggests_correction(
    arguments: list[str], code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_with(SimulatedCopter(boot_time_s=0.0, home=HOME), arguments) == [code]
    printed = capsys.readouterr()
    assert "(did you mean 'RTL_ALT'?)" in printed.out + printed.err


@pytest.mark.parametrize("arguments", [["params", "get", "MIS_TAKEOFF_AL"], ["params", "set", "MIS_TAKEOFF_AL=5"]])
def test_name_refused_by_vehicle_gets_suggestion(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedPx4(boot_time_s=0.0), arguments) == [5]
    printed = capsys.readouterr()
    assert "the vehicle has no such parameter (did you mean 'MIS_TAKEOFF_ALT'" in printed.out + printed.err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nothing.py"], "can't open file 'nothing.py': No such file or directory"),
        (["empty"], "can't find '__main__' module in 'empty'"),
        (["-m", "no_such_module"], "No module named no_such_module"),
        (["-m", "empty"], "'empty' is a package and cannot be directly executed"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_run_of_invalid_program_prints_one_line_error(arguments: list[str], text: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "__init__.py").touch()
    done = subprocess.run(
        [sys.executable, "-m", "aerokit", "run", *arguments], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode in (1, 2)
    assert done.stderr.startswith("aerokit run: ")
    assert done.stderr.count("\n") == 1
    assert text in done.stderr


# ------------------------------------------------------------------------------------- imports


def test_help_imports_no_command_module() -> None:
    """Other slow modules must not be imported either."""
    program = (
        "import sys\nfrom aerokit.apps.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print([name for name in sys.modules if name.startswith(('aerokit.sim', 'aerokit.vehicle',"
        " 'aerokit.connection', 'aerokit.mavlink.messages', 'argcomplete', 'anyio', 'tqdm', 'serial'))])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("\n[]\n")


@pytest.mark.skipif(sys.platform == "win32", reason="no pty")
def test_confirm_ignores_input_typed_before_question(monkeypatch: pytest.MonkeyPatch) -> None:
    import pty

    ours, theirs = pty.openpty()

    async def ask() -> bool:
        os.write(ours, b"y\n")
        question = asyncio.create_task(asking.confirm("fly?"))
        await asyncio.sleep(0)
        os.write(ours, b"n\n")
        return await asyncio.wait_for(question, 100)

    with open(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        assert not asyncio.run(ask())
    os.close(ours)
