"""Addresses and files in the place of other arguments: refused before anything is opened."""

from __future__ import annotations

from pathlib import Path

import pytest

from aerokit.apps.cli import main
from aerokit.apps.cli.main import make_parser

PLACE = "udpin:127.0.0.1:14999"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (f"params {PLACE}", f"aerokit params ACTION --connect {PLACE}"),
        (f"params {PLACE} list", f"aerokit params list --connect {PLACE}"),
        (f"params list {PLACE}", f"aerokit params list --connect {PLACE}"),
        (f"params get RTL_ALT {PLACE}", f"aerokit params get RTL_ALT --connect {PLACE}"),
        ("params set A=1 127.0.0.1:14550", "aerokit params set A=1 --connect 127.0.0.1:14550"),
        (f"fly {PLACE}", f"aerokit fly FILE --connect {PLACE}"),
        (f"fly survey.plan {PLACE}", f"aerokit fly survey.plan --connect {PLACE}"),
        ("mission upload /dev/ttyACM0", "aerokit mission upload FILE --connect /dev/ttyACM0"),
        (f"logs get {PLACE}", f"aerokit logs get --connect {PLACE}"),
        (f"demo {PLACE}", f"aerokit demo --connect {PLACE}"),
        (f"files ls {PLACE}", f"aerokit files ls --connect {PLACE}"),
        (f"gimbal point -45 20 {PLACE}", f"aerokit gimbal point -45 20 --connect {PLACE}"),
        (f"status --connect {PLACE} --json", f"aerokit status {PLACE} --json"),
        (f"status --connect={PLACE}", f"aerokit status {PLACE}"),
        (f"sim --connect {PLACE}", f"aerokit sim {PLACE}"),
        (f"bridge {PLACE} foxglove", f"aerokit bridge foxglove {PLACE}"),
        (f"report {PLACE}", f"aerokit record {PLACE} flight.tlog"),
        (f"mission check {PLACE}", f"aerokit record {PLACE} flight.tlog"),
        (PLACE, f"aerokit status {PLACE}"),
        (f"record flight.tlog {PLACE}", "the recording must follow the address: ADDRESS flight.tlog"),
        (f"demo --connect {PLACE} {PLACE}", "is a second address, besides --connect"),
        ("status survey.plan", "`aerokit fly survey.plan` flies it"),
        ("params list --connect mine.param", "`aerokit params load mine.param` sets these parameters"),
        ("monitor hover.py", "`aerokit run hover.py` runs a DroneKit program"),
    ],
)
def test_misplaced_address_or_file_error_has_right_command(
    words: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    assert line in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        f"params list --connect {PLACE}",
        f"params list --conn {PLACE}",
        f"params list --connect={PLACE}",
        f"status {PLACE}",
        "status flight.tlog",
        "files ls /dev/ttyS0",
        f"record {PLACE} flight.tlog",
        f"hub {PLACE} radio=/dev/ttyUSB0,57600",
        "sim udpout:127.0.0.1:14550 pty:/tmp/ttyV0",
        f"bridge zenoh {PLACE} zenoh://fleet/alpha",
        "report flight.tlog",
        "fly survey.plan",
    ],
)
def test_right_command_line_is_accepted(words: str) -> None:
    assert make_parser(words.split()[0]).parse_args(words.split())


def test_existing_file_as_address_is_called_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("")
    with pytest.raises(SystemExit):
        main(["status", str(file)])
    assert "is a file; an address is expected, such as udpin:0.0.0.0:14550" in capsys.readouterr().err
