"""``aerokit doctor``: findings on real links, ports and terminals."""

from __future__ import annotations

import os
import re
import socket
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from cli_harness import GROUND_STATION, run_on_messages
from pymavlink.dialects.v20 import common

from aerokit import messages as m
from aerokit import wire_implementation
from aerokit.apps.cli import doctor, main
from aerokit.apps.cli.doctor import EXTRAS, check_installation, check_network_port, check_serial_port
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import Signing, SigningKey

HEARTBEAT = m.Heartbeat(2, 3, 81, 0, 3, 3)
_NOBODY = common.MAVLink(None, srcSystem=0, srcComponent=1)
FROM_SYSTEM_0: bytes = _NOBODY.heartbeat_encode(2, 3, 81, 0, 3).pack(_NOBODY)
posix_only = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")


@pytest.mark.parametrize(
    ("sources", "noise", "code", "text"),
    [
        ([], b"", 3, "no bytes were received"),
        ([], bytes(range(200)) * 3, 3, "but no MAVLink frame: wrong baud rate, or another protocol?"),
        (
            [(1, 1, HEARTBEAT)],
            b"",
            0,
            "`aerokit status` shows what is missing before the vehicle can arm or fly by itself",
        ),
        ([(1, 1, HEARTBEAT)], b"console> " * 20, 1, "bytes are not MAVLink"),
        ([(254, 190, GROUND_STATION)], b"", 3, "they seem to be an echo of what this program sends"),
        (
            [(1, 1, HEARTBEAT), (255, 190, GROUND_STATION)],
            b"",
            0,
            "another ground station uses the ids of aerokit programs (255/190)",
        ),
        ([(1, 1, HEARTBEAT), (1, 2, HEARTBEAT)], b"", 1, "system 1 has 2 autopilots (components 1, 2)"),
        (
            [(1, 1, HEARTBEAT), (1, 1, m.Heartbeat(1, 12, 0, 0, 3, 3))],
            b"",
            1,
            "two senders use system 1, component 1",
        ),
        ([], FROM_SYSTEM_0, 1, "a sender uses system id 0, which means broadcast"),
        ([(1, 100, m.Heartbeat(30, 8, 0, 0, 4, 3))], b"", 1, "only components that are not autopilots"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_doctor_reports_findings_of_link(
    sources: Iterable[tuple[int, int, Message]],
    noise: bytes,
    code: int,
    text: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_on_messages(sources, "doctor", noise=noise) == code
    assert text in capsys.readouterr().out


# ----------------------------------------------------------------------------------- real sockets


@contextmanager
def repeated_writes(write: object, *pieces: bytes) -> Iterator[None]:
    """Write the pieces repeatedly, in a thread."""
    ended = threading.Event()

    def feed() -> None:
        while not ended.wait(0.02):
            for piece in pieces:
                write(piece)  # type: ignore[operator]

    thread = threading.Thread(target=feed)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def doctor_of_senders(*writers: FrameEncoder, seconds: str = "0.5", options: tuple[str, ...] = ()) -> int:
    """Run `aerokit doctor` on a UDP port with these senders, each with its own socket; return the exit code."""
    port = free_udp_port()
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in writers]

    def send(_: bytes) -> None:
        for sock, encoder in zip(sockets, writers, strict=True):
            sock.sendto(encoder.encode(HEARTBEAT, 1.8e9), ("127.0.0.1", port))

    try:
        with repeated_writes(send, b""):
            return main(["doctor", f"udpin:127.0.0.1:{port}", "--seconds", seconds, *options])
    finally:
        for sock in sockets:
            sock.close()


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


def test_doctor_two_senders_with_same_ids_is_problem(capsys: pytest.CaptureFixture[str]) -> None:
    code = doctor_of_senders(FrameEncoder(1, 1), FrameEncoder(1, 1))
    assert code == 1
    assert "two senders use system 1, component 1; the messages of one are ignored" in capsys.readouterr().out


def test_doctor_mavlink_1_sender_is_note(capsys: pytest.CaptureFixture[str]) -> None:
    code = doctor_of_senders(FrameEncoder(1, 1, version=1))
    assert code == 0
    out = capsys.readouterr().out
    assert "note  sender: system 1, component 1: autopilot, MAVLink 1" in out
    assert "SERIALn_PROTOCOL 2" in out


def test_doctor_signed_frames_without_key_is_problem(capsys: pytest.CaptureFixture[str]) -> None:
    encoder = FrameEncoder(1, 1)
    encoder.signing = Signing(SigningKey.from_passphrase("secret"))
    code = doctor_of_senders(encoder)
    assert code == 1
    assert "frames from 1/1 are signed, but no key is given" in capsys.readouterr().out


def test_doctor_wrong_signing_key_is_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = tmp_path / "key"
    key.write_text("another secret")
    encoder = FrameEncoder(1, 1)
    encoder.signing = Signing(SigningKey.from_passphrase("secret"))
    assert doctor_of_senders(encoder, options=("--signing-key", str(key))) == 3
    assert "BAD   signing: frames were refused" in capsys.readouterr().out


def test_doctor_lossy_link_is_problem(capsys: pytest.CaptureFixture[str]) -> None:
    class Lossy(FrameEncoder):
        def encode(self, message: Message, now: float = 0.0) -> bytes:
            for _ in range(2):
                super().encode(message, now)
            return super().encode(message, now)

    code = doctor_of_senders(Lossy(1, 1), seconds="0.8")
    assert code == 1
    assert re.search(r"BAD   loss: system 1: 6\d\.\d % of \d+ frames lost", capsys.readouterr().out)


def test_doctor_used_udp_port_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("0.0.0.0", 0))
        port = sock.getsockname()[1]
        finding = check_network_port(port, "a test", udp=True)
        assert (finding.level, finding.text) == ("note", "in use by another program (a test)")
        assert main(["doctor", f"udpin:0.0.0.0:{port}"]) == 3
        assert "BAD   link: cannot open udpin:" in capsys.readouterr().out
    assert check_network_port(port, "a test", udp=True).level == "ok"


# ----------------------------------------------------------------------------------- serial ports


@posix_only
@pytest.mark.parametrize(
    ("baud", "code", "text"),
    [
        (115200, 0, "ok    baud rate: {device} receives MAVLink at 115200"),
        (57600, 1, "BAD   baud rate: {device} receives MAVLink at 115200, not at 57600"),
    ],
)
def test_doctor_finds_baud_rate_of_serial_port(
    baud: int, code: int, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The far end sends at 115200; at other rates the near end receives noise."""
    import termios
    import tty

    monkeypatch.setattr(doctor, "BAUD_RATE_TIMEOUT_S", 0.5)
    ours, theirs = os.openpty()
    try:
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        device, encoder = os.ttyname(theirs), FrameEncoder(1, 1)

        def send(_: bytes) -> None:
            frame = encoder.encode(HEARTBEAT)
            right = termios.tcgetattr(ours)[5] == termios.B115200
            with suppress(BlockingIOError):  # the buffer is full
                os.write(ours, frame if right else bytes(each ^ 0xA5 for each in frame))

        with repeated_writes(send, b""):
            assert main(["doctor", f"{device},{baud}", "--seconds", "0.3"]) == code
        out = capsys.readouterr().out
        assert text.format(device=device) in out
        assert "system 1, component 1: autopilot, MAVLink 2" in out
    finally:
        os.close(ours)
        os.close(theirs)


@posix_only
def test_doctor_silent_serial_port_exits_with_code_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "BAUD_RATE_TIMEOUT_S", 0.1)
    ours, theirs = os.openpty()
    try:
        assert main(["doctor", os.ttyname(theirs), "--seconds", "0.2"]) == 3
        assert "no bytes were received" in capsys.readouterr().out
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may use everything")
def test_doctor_serial_port_without_permission_is_problem(tmp_path: Path) -> None:
    device = tmp_path / "ttyX"
    device.touch(mode=0)
    finding = check_serial_port(str(device))
    assert finding.level == "problem"
    assert "permission denied" in finding.text


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_doctor_serial_port_in_use_names_program(tmp_path: Path) -> None:
    import subprocess

    device = tmp_path / "ttyX"
    device.touch()
    program = "import sys; file = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(device)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        finding = check_serial_port(str(device))
        assert finding.level == "problem"
        assert f"(process {other.pid})" in finding.text
    assert check_serial_port(str(device)).level == "ok"


# ----------------------------------------------------------------------------------- installation


def test_doctor_without_address_checks_computer(capsys: pytest.CaptureFixture[str]) -> None:
    main(["doctor"])
    out = capsys.readouterr().out
    for text in (
        "ok    aerokit: ",
        "UDP port 14550",
        "TCP port 5760",
        "check a link: aerokit doctor ADDRESS",
    ):
        assert text in out


def test_doctor_mixed_installation_is_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit._internal.imports.installation_problem", lambda *_, **__: "mixed")
    assert any(each.level == "problem" and each.text == "mixed" for each in check_installation())


def test_doctor_missing_extra_prints_pip_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.apps.cli.doctor.find_spec", lambda name: None if name == "textual" else 1)
    lacking = [each for each in check_installation() if each.subject == "extras" and each.level == "note"]
    assert [each.text for each in lacking] == ["monitor is incomplete: textual not installed"]
    assert "pip install 'aerokit-mavlink[monitor]'" in lacking[0].do


def test_doctor_extras_match_pyproject() -> None:
    text = (Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    section = text.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    extras = set(re.findall(r"^(\w+) = ", section, re.MULTILINE))
    assert extras - {"all", "test", "dev", "docs"} == set(EXTRAS)


def test_doctor_names_implementation_of_wire() -> None:
    (finding,) = [finding for finding in check_installation() if finding.subject == "wire"]
    assert finding.text.startswith("compiled" if wire_implementation == "c" else "Python")
