"""Signing in programs: the command line's keys, pymavlink's mavutil, the example and the blocking API."""

from __future__ import annotations

import time
from argparse import ArgumentTypeError, Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega
from served_copter import served

import aerokit.sync
from aerokit import Signing, SigningKey
from aerokit.apps.cli import main
from aerokit.apps.cli.connecting import SIGNING_KEY_VARIABLE, key_file, signing_of
from aerokit.sim import SimulatedCopter

KEY = SigningKey.from_passphrase("right")


@pytest.fixture
def copter() -> SimulatedCopter:
    """A vehicle with the key, reached by radio."""
    copter = SimulatedCopter(boot_time_s=0.0, signing_key=KEY, parameter_count=30)
    copter.signing.trusts_first_port = False
    return copter


@pytest.fixture
def address(copter: SimulatedCopter) -> Iterator[str]:
    with served([copter]) as address:
        yield address


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(SIGNING_KEY_VARIABLE, raising=False)


# ----------------------------------------------------------------------------------- command line


@pytest.mark.parametrize("text", ["right\n", KEY.secret.hex(), "\ufeff" + KEY.secret.hex() + "\r\n"])
def test_signing_key_from_file(text: str, tmp_path: Path) -> None:
    path = tmp_path / "vehicle.key"
    path.write_text(text, encoding="utf-8")
    assert key_file(str(path)) == KEY


@pytest.mark.parametrize(
    ("content", "expected"),
    [(None, "No such file"), (b"", "has no signing key"), (b"\xff\xfe\x00", "it is not a text file")],
)
def test_signing_key_file_without_key(content: bytes | None, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "vehicle.key"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ArgumentTypeError, match=expected):
        key_file(str(path))


def test_command_line_signs_with_key(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("vehicle.key").write_text("right")
    assert main(["params", "get", "RTL_ALT", "--connect", address, "--signing-key", "vehicle.key"]) == 0
    assert "RTL_ALT" in capsys.readouterr().out


def test_signing_key_from_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing, given = Namespace(signing_key=None), Namespace(signing_key=KEY)
    assert signing_of(nothing) is None
    monkeypatch.setenv(SIGNING_KEY_VARIABLE, "left")
    for options, expected in ((nothing, SigningKey.from_passphrase("left")), (given, KEY)):
        signing = signing_of(options)
        assert signing is not None
        assert signing.key == expected


# -------------------------------------------------------------------------------------- pymavlink


def test_mavutil_is_accepted_only_with_key(
    address: str, copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    link: Any = mavutil.mavlink_connection(address, source_system=255, dialect="ardupilotmega")
    link.mav = ardupilotmega.MAVLink(link, srcSystem=255)
    link.mav.robust_parsing = True
    link.WIRE_PROTOCOL_VERSION = "2.0"
    try:
        link.wait_heartbeat(timeout=100)
        link.mav.param_set_send(1, 1, b"RTL_ALT", 1234.0, 9)
        link.setup_signing(KEY.secret, link_id=3)
        link.mav.heartbeat_send(6, 8, 0, 0, 4)  # the vehicle's timestamps follow received ones
        link.mav.param_set_send(1, 1, b"RTL_SPEED", 700.0, 9)
        deadline = time.monotonic() + 100
        value = None
        while value is None and time.monotonic() < deadline:
            value = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=0.1)
        assert copter.parameters["RTL_SPEED"] == 700.0
        assert copter.parameters["RTL_ALT"] != 1234.0
        assert value is not None
        assert value.get_signed()
        assert value.get_link_id() == 0
    finally:
        link.close()


# ------------------------------------------------------------------------------------ blocking API


def test_blocking_api_signs(address: str, copter: SimulatedCopter) -> None:
    signing = Signing(KEY)
    with aerokit.sync.connect(address, signing=signing, rates={}) as vehicle:
        assert vehicle.connection.signing is signing
        assert vehicle.parameters.get("RTL_ALT") == 1500
        vehicle.setup_signing(None)
        assert [copter.signing.key, vehicle.connection.signing] == [None, None]
    with aerokit.sync.open_connection(address, signing=signing) as connection:
        assert connection.signing is signing
