"""``aerokit doctor``: each thing that can be wrong is found, by what is really on a link, a port, a terminal."""

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
from pymavlink.dialects.v20 import common
from test_link_commands import GROUND_STATION, saying

from aerokit import messages as m
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
        ([], b"", 3, "not a single byte was heard"),
        ([], bytes(range(200)) * 3, 3, "but no MAVLink frame: wrong baud rate, or another protocol?"),
        ([(1, 1, HEARTBEAT)], b"", 0, "ok    sender: system 1, component 1: autopilot, MAVLink 2"),
        ([(1, 1, HEARTBEAT)], b"console> " * 20, 1, "bytes are no MAVLink"),
        ([(254, 190, GROUND_STATION)], b"", 3, "they look like our own, which come back"),
        (
            [(1, 1, HEARTBEAT), (255, 190, GROUND_STATION)],
            b"",
            0,
            "another ground station uses our ids (255/190)",
        ),
        ([(1, 1, HEARTBEAT), (1, 2, HEARTBEAT)], b"", 1, "system 1 has 2 autopilots (components 1, 2)"),
        (
            [(1, 1, HEARTBEAT), (1, 1, m.Heartbeat(1, 12, 0, 0, 3, 3))],
            b"",
            1,
            "two senders use system 1, component 1",
        ),
        ([], FROM_SYSTEM_0, 1, "somebody uses system id 0, which is nobody's"),
        ([(1, 100, m.Heartbeat(30, 8, 0, 0, 4, 3))], b"", 1, "only components that are no autopilot"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_on_a_link(
    sources: Iterable[tuple[int, int, Message]],
    noise: bytes,
    code: int,
    text: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert saying(sources, "doctor", noise=noise) == code
    assert text in capsys.readouterr().out


# ----------------------------------------------------------------------------------- real sockets


@contextmanager
def feeding(write: object, *pieces: bytes) -> Iterator[None]:
    """Write these over and over, in a thread."""
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


def listened_to(*writers: FrameEncoder, seconds: str = "0.5", options: tuple[str, ...] = ()) -> int:
    """Have senders examined that send to a UDP port, each from a socket of its own; the exit code."""
    port = free_udp_port()
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in writers]

    def send(_: bytes) -> None:
        for sock, encoder in zip(sockets, writers, strict=True):
            sock.sendto(encoder.encode(HEARTBEAT, 1.8e9), ("127.0.0.1", port))

    try:
        with feeding(send, b""):
            return main(["doctor", f"udpin:127.0.0.1:{port}", "--seconds", seconds, *options])
    finally:
        for sock in sockets:
            sock.close()


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


def test_two_vehicles_with_the_same_id(capsys: pytest.CaptureFixture[str]) -> None:
    code = listened_to(FrameEncoder(1, 1), FrameEncoder(1, 1))
    assert code == 1
    assert "two senders use system 1, component 1: one of them is not listened to" in capsys.readouterr().out


def test_mavlink_1(capsys: pytest.CaptureFixture[str]) -> None:
    code = listened_to(FrameEncoder(1, 1, version=1))
    assert code == 0
    out = capsys.readouterr().out
    assert "note  sender: system 1, component 1: autopilot, MAVLink 1" in out
    assert "SERIALn_PROTOCOL 2" in out


def test_frames_that_are_signed(capsys: pytest.CaptureFixture[str]) -> None:
    encoder = FrameEncoder(1, 1)
    encoder.signing = Signing(SigningKey.from_passphrase("secret"))
    code = listened_to(encoder)
    assert code == 1
    assert "1/1 signs its frames, and no key is given" in capsys.readouterr().out


def test_the_wrong_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = tmp_path / "key"
    key.write_text("another secret")
    encoder = FrameEncoder(1, 1)
    encoder.signing = Signing(SigningKey.from_passphrase("secret"))
    assert listened_to(encoder, options=("--signing-key", str(key))) == 3
    assert "BAD   signing: frames were refused" in capsys.readouterr().out


def test_a_lossy_link(capsys: pytest.CaptureFixture[str]) -> None:
    class Lossy(FrameEncoder):
        def encode(self, message: Message, now: float = 0.0) -> bytes:
            for _ in range(2):
                super().encode(message, now)
            return super().encode(message, now)

    code = listened_to(Lossy(1, 1), seconds="0.8")
    assert code == 1
    assert re.search(r"BAD   loss: system 1: 6\d\.\d % of \d+ frames lost", capsys.readouterr().out)


def test_a_port_that_is_taken(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("0.0.0.0", 0))
        port = sock.getsockname()[1]
        finding = check_network_port(port, "a test", udp=True)
        assert (finding.level, finding.text) == ("note", "another program has it (a test)")
        assert main(["doctor", f"udpin:0.0.0.0:{port}"]) == 3
        assert "BAD   link: cannot open udpin:" in capsys.readouterr().out
    assert check_network_port(port, "a test", udp=True).level == "ok"


# ----------------------------------------------------------------------------------- serial ports


@posix_only
@pytest.mark.parametrize(
    ("baud", "code", "text"),
    [
        (115200, 0, "ok    baud rate: MAVLink is heard on {device} at 115200"),
        (57600, 1, "BAD   baud rate: MAVLink is heard on {device} at 115200, not at 57600"),
    ],
)
def test_the_baud_rate_is_found(
    baud: int, code: int, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The far end sends at 115200: at another rate of the near one, noise."""
    import termios
    import tty

    monkeypatch.setattr(doctor, "BAUD_S", 0.5)
    ours, theirs = os.openpty()
    try:
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        device, encoder = os.ttyname(theirs), FrameEncoder(1, 1)

        def send(_: bytes) -> None:
            frame = encoder.encode(HEARTBEAT)
            right = termios.tcgetattr(ours)[5] == termios.B115200
            with suppress(BlockingIOError):  # nobody reads just now
                os.write(ours, frame if right else bytes(each ^ 0xA5 for each in frame))

        with feeding(send, b""):
            assert main(["doctor", f"{device},{baud}", "--seconds", "0.3"]) == code
        out = capsys.readouterr().out
        assert text.format(device=device) in out
        assert "system 1, component 1: autopilot, MAVLink 2" in out
    finally:
        os.close(ours)
        os.close(theirs)


@posix_only
def test_a_silent_serial_port(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "BAUD_S", 0.1)
    ours, theirs = os.openpty()
    try:
        assert main(["doctor", os.ttyname(theirs), "--seconds", "0.2"]) == 3
        assert "not a single byte was heard" in capsys.readouterr().out
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may use everything")
def test_a_port_that_one_may_not_use(tmp_path: Path) -> None:
    device = tmp_path / "ttyX"
    device.touch(mode=0)
    finding = check_serial_port(str(device))
    assert finding.level == "problem"
    assert "you may not use it" in finding.text


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_port_that_another_program_uses(tmp_path: Path) -> None:
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
        assert f"(process {other.pid}) uses it" in finding.text
    assert check_serial_port(str(device)).level == "ok"


# ----------------------------------------------------------------------------------- installation


def test_the_computer(capsys: pytest.CaptureFixture[str]) -> None:
    main(["doctor"])
    out = capsys.readouterr().out
    for text in (
        "ok    aerokit: ",
        "UDP port 14550",
        "TCP port 5760",
        "aerokit doctor ADDRESS looks at a link",
    ):
        assert text in out


def test_files_of_the_other_aerokit_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit._internal.imports.complaint", lambda *_, **__: "mixed")
    assert any(each.level == "problem" and each.text == "mixed" for each in check_installation())


def test_extras_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.apps.cli.doctor.find_spec", lambda name: None if name == "textual" else 1)
    lacking = [each for each in check_installation() if each.subject == "extras" and each.level == "note"]
    assert [each.text for each in lacking] == ["monitor is not whole: textual not installed"]
    assert "pip install 'aerokit-mavlink[monitor]'" in lacking[0].do


def test_all_extras_are_looked_for() -> None:
    text = (Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    section = text.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    extras = set(re.findall(r"^(\w+) = ", section, re.MULTILINE))
    assert extras - {"all", "test", "dev", "docs"} == set(EXTRAS)
