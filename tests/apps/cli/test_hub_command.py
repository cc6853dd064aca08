"""``aerokit hub``: arguments, output and exit codes."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from cli_harness import ctrl_c, records

from aerokit.apps.cli import hub, main
from aerokit.apps.cli.hub import _endpoints
from aerokit.apps.cli.main import make_parser
from aerokit.errors import InvalidArgument
from aerokit.hub import Endpoint
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.messages import Heartbeat
from aerokit.mavlink.tlog import read_tlog

COPTER = Heartbeat(2, 3, 81, 0, 3)


def endpoints(*arguments: str) -> dict[str, Endpoint]:
    found = _endpoints(make_parser("hub").parse_args(["hub", *arguments]))
    return {each.name: each for each in found}


def test_hub_options_configure_endpoints() -> None:
    found = endpoints(
        "radio=/dev/ttyUSB0,57600", "udpout:10.0.0.7:14550", "tablet=tcpin:0.0.0.0:5760",
        "--read-only", "tablet", "--patient", "radio", "--only", "HEARTBEAT,GPS_*@tablet", "--block", "DEBUG*",
        "--rate", "ATTITUDE=5,*=10@udpout:10.0.0.7:14550", "--rate", "VFR_HUD=1",
    )  # fmt: skip
    assert list(found) == ["radio", "udpout:10.0.0.7:14550", "tablet"]
    radio, out, tablet = found.values()
    assert (radio.address, radio.retry_open, radio.read_only) == ("/dev/ttyUSB0,57600", True, False)
    assert (tablet.read_only, tablet.only, tablet.block) == (True, ("HEARTBEAT", "GPS_*"), ("DEBUG*",))
    assert (radio.only, radio.rates) == ((), {"VFR_HUD": 1.0})
    assert out.rates == {"ATTITUDE": 5.0, "*": 10.0, "VFR_HUD": 1.0}


def test_hub_signed_option_needs_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AEROKIT_SIGNING_KEY", raising=False)
    with pytest.raises(InvalidArgument, match="--signed needs a key"):
        endpoints("a=pty", "--signed", "a")
    (tmp_path / "key").write_text("a passphrase")
    found = endpoints("a=pty", "b=pty", "--signed", "a", "--signing-key", str(tmp_path / "key"))
    assert found["a"].signing is not None
    assert found["b"].signing is None


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["a=nonsense:1:2"], "nonsense"),
        (["a=pty", "--rate", "ATTITUDE"], "is not a rate"),
        (["a=pty", "--record", "x.bin"], "does not end in .tlog"),
        (["a=pty", "--read-only", "b"], "no endpoint is named 'b'; endpoints: a"),
        (["radio=pty", "--read-only", "raido"], "no endpoint is named 'raido' (did you mean 'radio'?)"),
        (["a=pty", "--block", "DEBUG*@b"], "no endpoint is named 'b'"),
        (["a=pty", "--only", "@a"], "has no message name"),
        (["a=pty", "--rate", ""], "has no message name"),
        (["a=pty", "--block", "DEBUG*@"], "has no endpoint after the @"),
        (["a=tcpin:127.0.0.1:0", "--only", "NO_SUCH"], "matches no message"),
        (["a=tcpin:127.0.0.1:0", "a=tcpin:127.0.0.1:0"], "two endpoints have the name 'a'"),
        ([], "required"),
    ],
)
def test_hub_invalid_arguments_exit_with_code_2(
    arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main(["hub", *arguments])
    except SystemExit as ended:
        code = ended.code  # type: ignore[assignment]
    assert code == 2
    assert text in capsys.readouterr().err


def test_hub_forwards_frames_prints_events_and_records(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hub.tlog"
    arguments = [
        "a=tcpin:127.0.0.1:0",
        "b=udpin:127.0.0.1:0",
        "--record",
        str(path),
        "--every",
        "0.2",
        "--json",
    ]

    async def run() -> int:
        options = make_parser("hub").parse_args(["hub", *arguments])
        running = asyncio.ensure_future(options.run(options))
        printed: list[dict[str, Any]] = []
        while not any(each["type"] == "hub" for each in printed):
            await asyncio.sleep(0.01)
            printed += records(capsys.readouterr().out)
        (started,) = (each for each in printed if each["type"] == "hub")
        assert [each["kind"] for each in printed if each["type"] == "hub_event"] == ["opened", "opened"]
        host, _, port = started["endpoints"][0].partition(":")[2].rpartition(":")
        _, writer = await asyncio.open_connection(host, int(port))
        writer.write(FrameEncoder(1, 1).encode(COPTER))
        printed.clear()
        while not any(each["type"] == "endpoint" and each["frames_in"] for each in printed):
            await asyncio.sleep(0.01)
            printed += records(capsys.readouterr().out)
        ends = [each for each in printed if each["type"] == "endpoint" and each["name"] == "a"]
        assert [1, 1] in next(each for each in ends if each["frames_in"])["systems"]
        assert [each["kind"] for each in printed if each["type"] == "hub_event"] == ["client_joined"]
        writer.close()
        ctrl_c()
        return int(await running)

    assert asyncio.run(run()) == 0
    assert [raw[5] for _, raw in read_tlog(path)] == [1]
    assert main(["hub", "a=tcpin:127.0.0.1:0", "--record", str(path), "--seconds", "0.1"]) == 0
    assert len(list(read_tlog(path))) == 1  # nothing was received, so the earlier recording keeps its name


def test_hub_prints_statistics_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hub", "a=tcpin:127.0.0.1:0", "--seconds", "0.1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("a: tcpin:127.0.0.1:")
    assert lines[1] == "1 endpoint, for 0.1 s"
    assert lines[-1] == "a: 0 frames in, 0 out, 0 lost; systems none"


def test_hub_prints_nothing_while_terminal_is_stopped(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Printing would block, and the hub would forward nothing."""
    monkeypatch.setattr(hub, "can_print", lambda: False)
    assert main(["hub", "a=tcpin:127.0.0.1:0", "--seconds", "0.3", "--every", "0.1"]) == 0
    first, last = capsys.readouterr().out.splitlines()
    assert first == "1 endpoint, for 0.3 s"
    assert last == "a: 0 frames in, 0 out, 0 lost; systems none"


def test_hub_empty_recording_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "hub.tlog"
    for _ in range(2):
        assert main(["hub", "a=tcpin:127.0.0.1:0", "--seconds", "0.1", "--record", str(path)]) == 0
        assert not path.exists()
