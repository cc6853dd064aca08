"""``aerokit status``, ``events`` and ``record``: output, sent messages, and files."""

from __future__ import annotations

import asyncio
from pathlib import Path

import anyio
import pytest
from cli_harness import GROUND_STATION, HOME, ctrl_c, records, run_on, run_on_messages, run_with
from flight_harness import Wire

import aerokit
from aerokit import messages as m
from aerokit.apps.cli import listening, main
from aerokit.apps.cli.listening import _printing_kept_name
from aerokit.apps.cli.output import TIMED_OUT
from aerokit.connection.frame_observers import keep_existing
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.mavlink.signing import SigningKey
from aerokit.mavlink.tlog import read_tlog
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import run_virtual

HARMLESS = {
    MavCmd.REQUEST_MESSAGE,
    MavCmd.REQUEST_AUTOPILOT_CAPABILITIES,
    MavCmd.RUN_PREARM_CHECKS,
    MavCmd.SET_MESSAGE_INTERVAL,
}


# -------------------------------------------------------------------------------------- status


def test_status_of_signing_vehicle_names_missing_key(
    capsys: pytest.CaptureFixture[str],
) -> None:
    copter = SimulatedCopter(boot_time_s=0.0, signing_key=SigningKey.from_passphrase("other key"))
    copter.signing.trusts_first_port = False  # no USB
    copter.signing.load()
    assert run_with(copter, ["status"], ["params", "get", "RTL_ALT"]) == [0, TIMED_OUT]
    out, err = capsys.readouterr()
    assert "it signs its frames, and without its key" in out.splitlines()[1]
    assert "  arming   not known whether it arms: no COMMAND_ACK" in out
    assert "frames are signed" in err.splitlines()[0]
    assert copter.now < 25.0, "both commands must finish soon"


def test_status_counts_frames_and_seconds_from_opening_of_link(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.faults.heartbeats_stopped = True
    copter.call_later(8.0, lambda: setattr(copter.faults, "heartbeats_stopped", False))
    assert run_with(copter, ["status", "--json"]) == [0]
    link = next(record for record in records(capsys.readouterr().out) if record["type"] == "link")
    assert link["seconds"] > 11


def test_status_of_armed_vehicle_does_not_call_it_ready(capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        copter = SimulatedCopter(boot_time_s=0.0, home=HOME)
        async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
            await vehicle.wait_ready()
            await vehicle.arm()
        async with simulated_link(copter) as link:
            return await run_on(link, "status")

    assert run_virtual(scenario()) == 0
    out = capsys.readouterr().out
    assert "ARMED, on ground" in out
    assert "ready    armed already; arming checks do not apply\n" in out


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
def test_status_prints_all_vehicles(
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


def test_status_prints_what_is_missing_for_flight(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedCopter(boot_time_s=600.0), ["status"]) == [1]
    out = capsys.readouterr().out
    assert "  arming   cannot arm: " in out
    assert "position unknown" in out
    assert "ready  " not in out


@pytest.mark.parametrize(("mode", "is_for_flight_only"), [(CopterMode.STABILIZE, True), (CopterMode.GUIDED, False)])
def test_status_without_gps_names_mode_that_allows_arming(
    mode: CopterMode, is_for_flight_only: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)

    async def scenario() -> None:
        async with simulated_link(copter) as link:
            await anyio.sleep(10)
            copter.set_mode(mode)
            copter.faults.gps_lost = True
            await anyio.sleep(20)
            assert await run_on(link, "status", "--seconds", "8") == (0 if is_for_flight_only else 1)

    run_virtual(scenario())
    out = capsys.readouterr().out
    words = "  arming   arms in STABILIZE, but cannot take off by itself or fly GUIDED, AUTO, RTL:\n"
    assert (words in out) is is_for_flight_only
    assert ("cannot arm: " in out) is not is_for_flight_only
    assert "the estimator has no absolute horizontal position" in out


def test_status_of_ready_vehicle_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    assert run_with(copter, ["status", "--seconds", "8"]) == [0]
    out = capsys.readouterr().out
    assert "ready    no reason against arming is reported\n" in out
    assert "missing" not in out
    assert "position -35.3632610, 149.1652300, height above home 0.0 m\n" in out


def test_status_gives_real_reason_alone(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.faults.prearm_failures = ["Compass not healthy"]
    assert run_with(copter, ["status", "--seconds", "8"]) == [1]
    out = capsys.readouterr().out
    assert "  arming   cannot arm: PreArm: Compass not healthy\n" in out
    assert "SYS_STATUS" not in out


def test_status_sends_only_requests_and_restores_rates() -> None:
    async def scenario() -> Wire:
        async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
            wire = Wire(link)
            assert await run_on(wire, "status") == 0
            return wire

    wire = run_virtual(scenario())
    commands = wire.all(m.CommandLong)
    assert {each.command for each in commands} <= HARMLESS
    intervals = {each.param1: each.param2 for each in commands if each.command == MavCmd.SET_MESSAGE_INTERVAL}
    assert set(intervals.values()) == {0.0}  # the last request restores the default rate
    others = {type(message) for _, message in wire.sent} - {m.CommandLong, m.Heartbeat, m.Timesync}
    assert others == set()


def test_status_without_vehicle_names_simulator(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", "udpin:127.0.0.1:45561", "--patience", "0.1"]) == 3
    assert "in another terminal: aerokit sim udpout:127.0.0.1:45561)" in capsys.readouterr().err


def test_status_without_vehicle_lists_ground_stations(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_on_messages([(255, 190, GROUND_STATION)], "status", "--patience", "3") == 3
    printed = capsys.readouterr()
    assert printed.out == "system 255, component 190: ground station\n"
    assert "only ground stations were received (255/190)" in printed.err


# -------------------------------------------------------------------------------------- events


def test_events_prints_events_until_ctrl_c(capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        async with simulated_link(SimulatedCopter(boot_time_s=3.0)) as link:
            command = asyncio.create_task(run_on(link, "events"))
            await anyio.sleep(6)
            ctrl_c()
            return await command

    assert run_virtual(scenario()) == 0
    out = capsys.readouterr().out
    assert "VehicleFound" in out
    assert "ModeChanged  STABILIZE" in out
    assert "INFO: ArduPilot Ready" in out
    assert "LinkReport" not in out


def test_events_names_number_of_missed_events(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(listening, "_MAX_WAITING_EVENTS", 1)
    texts = [(1, 1, m.Statustext(6, f"text {number}")) for number in range(3)]
    assert run_on_messages([(1, 1, m.Heartbeat(2, 3, 81, 0, 3, 3)), *texts], "events", "--seconds", "4") == 0
    lines = capsys.readouterr().out.splitlines()
    text_at = next(index for index, line in enumerate(lines) if line.endswith("INFO: text 2"))
    assert lines[text_at - 1] == "3 events were dropped"


def test_events_wait_while_terminal_is_stopped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Printing would block the event loop, and with it the heartbeat."""
    printed = []

    def can_print() -> bool:
        printed.append(capsys.readouterr().out)
        return len(printed) > 10

    monkeypatch.setattr(listening, "can_print", can_print)
    text = (1, 1, m.Statustext(6, "text"))
    assert run_on_messages([(1, 1, m.Heartbeat(2, 3, 81, 0, 3, 3)), text], "events", "--seconds", "4") == 0
    assert len(printed) > 10
    assert "".join(printed[:11]) == ""
    assert "INFO: text" in "".join(printed[11:]) + capsys.readouterr().out


def test_events_control_characters_are_replaced(capsys: pytest.CaptureFixture[str]) -> None:
    heartbeat = m.Heartbeat(2, 3, 81, 0, 3, 3)
    text = m.Statustext(6, "bad\x1b[2Jtext")
    assert run_on_messages([(1, 1, heartbeat), (1, 1, text)], "events", "--seconds", "4") == 0
    out = capsys.readouterr().out
    assert "bad\N{REPLACEMENT CHARACTER}[2Jtext" in out
    assert "\x1b" not in out


# -------------------------------------------------------------------------------------- record


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_record_interrupted_writes_all_frames(capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
            command = asyncio.create_task(run_on(link, "record", "flight.tlog"))
            await anyio.sleep(5)
            ctrl_c()
            return await command

    assert run_virtual(scenario()) == 0
    received = sum(raw[5] == 1 for _, raw in read_tlog("flight.tlog"))  # the system id, of MAVLink 2
    assert received > 100  # requested by the command
    assert f"flight.tlog: {received} frames received from system 1 in" in capsys.readouterr().out


def test_record_without_frames_keeps_existing_file(capsys: pytest.CaptureFixture[str]) -> None:
    Path("flight.tlog").write_text("mine")
    assert main(["record", "udpin:127.0.0.1:0", "flight.tlog", "--seconds", "0.1"]) == 1
    assert Path("flight.tlog").read_text() == "mine"
    assert "0 bytes: nothing was received" in capsys.readouterr().out


def test_monitor_names_kept_recording_at_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    Path("flight.tlog").write_text("mine")
    with _printing_kept_name("flight.tlog"):
        keep_existing("flight.tlog")
    assert capsys.readouterr().err == "flight.tlog existed and was kept as flight.1.tlog\n"


def test_record_to_existing_file_keeps_it_numbered(capsys: pytest.CaptureFixture[str]) -> None:
    Path("flight.tlog").write_text("mine")
    assert run_on_messages([(1, 1, m.Heartbeat(2, 3, 81, 0, 3))], "record", "flight.tlog", "--seconds", "2") == 0
    assert Path("flight.1.tlog").read_text() == "mine"
    assert len(list(read_tlog("flight.tlog"))) >= 1


def test_record_connection_failure_leaves_no_file() -> None:
    assert main(["record", "tcp:127.0.0.1:1", "flight.tlog", "--seconds", "1"]) == 3
    assert not Path("flight.tlog").exists()


def test_record_without_frames_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_on_messages([], "record", "flight.tlog", "--seconds", "2") == 1
    assert "nothing was received" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            ["udpin:127.0.0.1:0"],
            "'udpin:127.0.0.1:0' is an address; the recording must follow the address",
        ),
        (["a.tlog", "--seconds", "1", "b.tlog"], "aerokit record: error: unrecognized arguments: b.tlog"),
        (
            ["--secnds", "3"],
            "aerokit record: error: unrecognized arguments: --secnds (did you mean '--seconds'?)",
        ),
    ],
)
def test_record_invalid_arguments_create_no_file(
    arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["record", *arguments])
    printed = capsys.readouterr().err
    assert text in printed
    assert "[ADDRESS] FILE" in printed
    assert list(Path().iterdir()) == []


def test_status_of_recording_says_so() -> None:
    from aerokit.apps.cli.status import _link_line

    counts = {"frames": 3, "frames_lost": 0, "seconds": 1.0, "bad_bytes": 0, "bytes": 9, "unknown_messages": 0}
    assert _link_line({"address": "replay:crash.tlog", **counts}).startswith("replay:crash.tlog (a recording, not a")
    assert "recording" not in _link_line({"address": "udpin:0.0.0.0:14550", **counts})
