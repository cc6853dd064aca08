"""``aerokit status``, ``events`` and ``record``: what they tell, what they send, and what they leave on the disk."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from pathlib import Path

import anyio
import pytest
from cli_harness import HOME, ctrl_c, run_on, run_with
from flight_harness import Wire

from aerokit import messages as m
from aerokit.apps.cli import main
from aerokit.apps.cli.output import TIMED_OUT
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import SigningKey
from aerokit.mavlink.tlog import read_tlog
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport.memory import memory_link_pair

HARMLESS = {
    MavCmd.REQUEST_MESSAGE,
    MavCmd.REQUEST_AUTOPILOT_CAPABILITIES,
    MavCmd.RUN_PREARM_CHECKS,
    MavCmd.SET_MESSAGE_INTERVAL,
}
GROUND_STATION = m.Heartbeat(6, 8, 0, 0, 4, 3)


def saying(sources: Iterable[tuple[int, int, Message]], *arguments: str, noise: bytes = b"") -> int:
    """Run a command on a link on which these are said each second: system, component, message."""

    async def scenario() -> int:
        near, far = memory_link_pair()
        encoders = [(FrameEncoder(system, component), message) for system, component, message in sources]

        class Nobody:
            def bytes_received(self, data: bytes, peer: object) -> None:
                pass

            def link_lost(self, error: Exception) -> None:
                pass

        async def speak() -> None:
            await far.open(Nobody())
            while True:
                far.write(noise)
                for encoder, message in encoders:
                    far.write(encoder.encode(message))
                await anyio.sleep(1)

        speaking = asyncio.create_task(speak())
        try:
            return await run_on(near, *arguments)
        finally:
            speaking.cancel()
            far.close()

    return run_virtual(scenario())


# -------------------------------------------------------------------------------------- status


def test_status_of_a_vehicle_that_signs_names_the_missing_key_soon(
    capsys: pytest.CaptureFixture[str],
) -> None:
    copter = SimulatedCopter(boot_time_s=0.0, signing_key=SigningKey.from_passphrase("another one's"))
    copter.signing.trusts_first_port = False  # no USB
    copter.signing.load()
    assert run_with(copter, ["status"], ["params", "get", "RTL_ALT"]) == [0, TIMED_OUT]
    out, err = capsys.readouterr()
    assert "its frames are signed and no key was given" in out.splitlines()[1]
    assert "its frames are signed and no key was given" in err.splitlines()[0]
    assert copter.now < 25.0, "seconds for both"


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
def test_status_of_two_vehicles(
    kind: type[SimulatedCopter] | type[SimulatedPx4], capsys: pytest.CaptureFixture[str]
) -> None:
    vehicles = [kind(system_id=number, boot_time_s=0.0, home=HOME) for number in (1, 7)]
    assert run_with(vehicles, ["status"]) == [0]
    out = capsys.readouterr().out
    for text in (
        "system 1: ",
        "system 7: ",
        "disarmed, on ground",
        "satellites",
        "battery  100 %",
        "MAVLink 2",
    ):
        assert text in out


def test_status_says_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedCopter(boot_time_s=600.0), ["status"]) == [0]
    assert "missing  " in (out := capsys.readouterr().out)
    assert "nothing that is known" not in out


def test_status_orders_nothing_and_leaves_the_rates() -> None:
    async def scenario() -> Wire:
        async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
            wire = Wire(link)
            assert await run_on(wire, "status") == 0
            return wire

    wire = run_virtual(scenario())
    commands = wire.all(m.CommandLong)
    assert {each.command for each in commands} <= HARMLESS
    intervals = {each.param1: each.param2 for each in commands if each.command == MavCmd.SET_MESSAGE_INTERVAL}
    assert set(intervals.values()) == {0.0}  # the last of each: as it was
    others = {type(message) for _, message in wire.sent} - {m.CommandLong, m.Heartbeat, m.Timesync}
    assert others == set()


def test_status_of_a_link_with_a_ground_station_only(capsys: pytest.CaptureFixture[str]) -> None:
    assert saying([(255, 190, GROUND_STATION)], "status", "--patience", "3") == 3
    told = capsys.readouterr()
    assert told.out == "system 255, component 190: ground station\n"
    assert "only ground stations were heard (255/190)" in told.err


# -------------------------------------------------------------------------------------- events


def test_events_until_ctrl_c(capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        async with simulated_link(SimulatedCopter(boot_time_s=3.0)) as link:
            command = asyncio.create_task(run_on(link, "events"))
            await anyio.sleep(6)
            ctrl_c()
            return await command

    assert run_virtual(scenario()) == 0
    out = capsys.readouterr().out
    assert "VehicleFound" in out
    assert "ModeChanged  before None, after STABILIZE" in out
    assert "INFO: ArduPilot Ready" in out
    assert "LinkReport" not in out


def test_what_a_vehicle_says_cannot_move_the_cursor(capsys: pytest.CaptureFixture[str]) -> None:
    heartbeat = m.Heartbeat(2, 3, 81, 0, 3, 3)
    text = m.Statustext(6, "bad\x1b[2Jtext")
    assert saying([(1, 1, heartbeat), (1, 1, text)], "events", "--seconds", "4") == 0
    out = capsys.readouterr().out
    assert "bad\N{REPLACEMENT CHARACTER}[2Jtext" in out
    assert "\x1b" not in out


# -------------------------------------------------------------------------------------- record


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_a_recording_that_is_interrupted_is_whole(capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
            command = asyncio.create_task(run_on(link, "record", "flight.tlog", "--ask"))
            await anyio.sleep(5)
            ctrl_c()
            return await command

    assert run_virtual(scenario()) == 0
    received = sum(raw[5] == 1 for _, raw in read_tlog("flight.tlog"))  # the system id, of MAVLink 2
    assert received > 100  # asked for
    assert f"flight.tlog: {received} frames received of system 1 in" in capsys.readouterr().out


def test_a_recording_replaces_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    Path("flight.tlog").write_text("mine")
    assert main(["record", "udpin:127.0.0.1:0", "flight.tlog", "--seconds", "1"]) == 6
    assert Path("flight.tlog").read_text() == "mine"
    assert capsys.readouterr().err == "aerokit: flight.tlog: is there already; nothing was recorded\n"


def test_a_link_that_cannot_be_opened_leaves_no_file() -> None:
    assert main(["record", "tcp:127.0.0.1:1", "flight.tlog", "--seconds", "1"]) == 3
    assert not Path("flight.tlog").exists()


def test_a_recording_of_nothing_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert saying([], "record", "flight.tlog", "--seconds", "2") == 1
    assert "nothing was heard" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["udpin:127.0.0.1:0"], "argument FILE: 'udpin:127.0.0.1:0' does not end in .tlog"),
        (["a.tlog", "--seconds", "1", "b.tlog"], "aerokit record: error: unrecognized arguments: b.tlog"),
        (
            ["--secnds", "3"],
            "aerokit record: error: unrecognized arguments: --secnds (did you mean '--seconds'?)",
        ),
    ],
)
def test_an_address_is_no_file(arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["record", *arguments])
    told = capsys.readouterr().err
    assert text in told
    assert "[ADDRESS] FILE" in told
    assert list(Path().iterdir()) == []
