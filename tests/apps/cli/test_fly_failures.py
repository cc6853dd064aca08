"""``aerokit fly`` in trouble: slow links, silence, other stations, failing output."""

from __future__ import annotations

import argparse
import asyncio
import io
import math
import os
import re
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from cli_harness import HOME, MISSION, ctrl_c, run_on, run_with, wait_until
from exhaustive import exhaustive

import aerokit
from aerokit.apps.cli import fly, main
from aerokit.apps.cli import fly as flown_plan
from aerokit.apps.cli.flight_recording import _StillnessNearGround
from aerokit.apps.cli.fly import PlanFlight
from aerokit.apps.cli.main import make_parser
from aerokit.apps.cli.mission import read_plan
from aerokit.apps.cli.output import TIMED_OUT, emit, emit_error
from aerokit.apps.cli.supervised_flight import FlightReport
from aerokit.apps.cli.terminal import InterruptStack
from aerokit.autopilots.modes import Mode
from aerokit.errors import OperationRejected
from aerokit.logs.flights import read_flight
from aerokit.logs.report.statistics import statistics_of, summary
from aerokit.mavlink.enums import CopterMode, MavCmd, MavLandedState, MavResult
from aerokit.mavlink.messages import ParamValue, VfrHud
from aerokit.mavlink.tlog import read_tlog
from aerokit.missions import read_waypoint_file
from aerokit.position import Position
from aerokit.protocols.servers.commands import ReceivedCommand
from aerokit.sim import SimulatedCopter, SimulatorServer, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport.link import memory_link_pair


@pytest.fixture(autouse=True)
def _plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.waypoints").write_text(MISSION)
    monkeypatch.setattr(fly, "is_interactive", lambda: True)


@pytest.fixture
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, home=HOME)


SURVEY = str(Path(__file__).parents[3] / "examples" / "survey.plan")
FLIGHTS = pytest.mark.parametrize("command", [("fly", "m.waypoints", "--yes"), ("demo",)], ids=lambda each: each[0])


@FLIGHTS
def test_interrupted_arm_command_arriving_late_is_disarmed(
    command: tuple[str, ...], copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]
) -> None:
    async def scenario() -> int:
        async with simulated_link(copter, latency_s=0.8) as link:
            flight = asyncio.create_task(run_on(link, *command))
            out = ""
            while "arming" not in out:
                out += capsys.readouterr().out
                await anyio.sleep(0.05)
            assert not copter.is_armed
            ctrl_c()
            await wait_until(lambda: copter.is_armed)  # the command was in flight
            return await flight

    assert run_virtual(scenario()) == 130
    assert not copter.is_armed
    assert "the arm command may still take effect" in capsys.readouterr().out


@pytest.mark.parametrize("answers", [True, False])
def test_fly_ctrl_c_during_takeoff_returns_to_launch(
    answers: bool, copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last received landed state is "on ground", but the vehicle refuses to disarm, or does not answer."""

    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, "fly", "m.waypoints", "--yes"))
            while copter.is_landed:  # noqa: ASYNC110 - there is nothing to await
                await anyio.sleep(0.02)
            if not answers:
                copter.faults.ignore(MavCmd.COMPONENT_ARM_DISARM)
            ctrl_c()
            return await flight

    assert run_virtual(scenario()) == 130
    printed = capsys.readouterr().out
    assert "disarming failed" in printed
    assert "returning to launch" in printed
    assert (copter.mode.number, copter.is_armed) == (CopterMode.RTL, False)


def test_fly_vehicle_silent_after_confirmation_is_not_started(
    copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def confirm(_: str) -> bool:
        copter.faults.silent = True
        await anyio.sleep(5)
        return True

    async def scenario() -> int:
        async with simulated_link(copter) as link:
            code = await run_on(link, "fly", "m.waypoints")
            copter.faults.silent = False
            await anyio.sleep(5)
            return code

    monkeypatch.setattr(flown_plan, "confirm", confirm)
    assert run_virtual(scenario()) == 3
    assert "nothing was started" in capsys.readouterr().err
    assert not copter.is_armed


@pytest.mark.parametrize("asks", [True, False])
def test_fly_mission_changed_after_upload_is_not_flown(
    asks: bool, copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours, theirs = memory_link_pair(), memory_link_pair()
    Path("other.waypoints").write_text(MISSION.replace("\t15\t1", "\t99\t1"))

    async def upload_other(_: PlanFlight) -> bool:
        async with aerokit.connect(theirs[0], source_system=254) as other:
            await other.mission.upload(read_waypoint_file("other.waypoints"))
        return True

    async def scenario() -> int:
        async with SimulatorServer([copter], [ours[1], theirs[1]]):
            return await run_on(ours[0], "fly", "m.waypoints", *(() if asks else ("--yes",)))

    monkeypatch.setattr(PlanFlight, "_is_confirmed", upload_other)
    assert run_virtual(scenario()) == 5
    assert "the mission on the vehicle changed after the upload; nothing was started" in capsys.readouterr().err
    assert (copter.is_armed, copter.is_landed) == (False, True)


def test_demo_with_refused_mode_disarms_on_ground(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    copter.faults.refuse(MavCmd.DO_SET_MODE)
    assert run_with(copter, ("demo",)) == [1]
    out = capsys.readouterr().out
    assert "on the ground and armed; disarming" in out
    assert "another party" not in out


def test_fly_fall_ends_with_error_and_sends_nothing(
    copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]
) -> None:
    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, "fly", "m.waypoints", "--yes", "--record", "fall.tlog"))
            await wait_until(lambda: copter.altitude_m > 8)
            copter.faults.motor_failed = True
            with anyio.fail_after(60):
                return await flight

    assert run_virtual(scenario()) == 5
    out, err = capsys.readouterr()
    assert "flying the mission: the vehicle hit the ground at 1" in err
    assert "failed: flying the mission: the vehicle hit the ground at 1" in out
    assert out.endswith("recorded in fall.tlog\nnext: aerokit report fall.tlog\n")


def test_fly_disarmed_in_air_prints_reasons_once(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, "fly", "m.waypoints", "--yes"))
            await wait_until(lambda: copter.altitude_m > 8)
            copter.send_text(0, "Crash: Disarming: AngErr=121>30, Accel=0.9<3.0")  # MAV_SEVERITY_EMERGENCY
            copter.arming.disarm()
            with anyio.fail_after(60):
                return await flight

    assert run_virtual(scenario()) == 5
    out, err = capsys.readouterr()
    assert err.startswith("aerokit: flying the mission: the vehicle ")
    assert "\n  - Crash: Disarming" in err
    assert "  - Crash: Disarming" not in out
    assert "Mission: " not in err
    assert "Reached command" not in err


@pytest.mark.parametrize(
    ("refused", "mode"),
    [({CopterMode.RTL}, CopterMode.BRAKE), ({CopterMode.RTL, CopterMode.BRAKE}, CopterMode.AUTO)],
)
def test_fly_ctrl_c_with_refused_return_holds(
    refused: set[int], mode: CopterMode, capsys: pytest.CaptureFixture[str]
) -> None:
    class RefusingCopter(SimulatedCopter):
        def refusal_of_command(self, command: ReceivedCommand) -> int | None:
            is_refused = command.command == MavCmd.DO_SET_MODE and command.param2 in refused
            return MavResult.FAILED if is_refused else super().refusal_of_command(command)

    copter = RefusingCopter(boot_time_s=0.0, home=HOME)

    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, "fly", "m.waypoints", "--yes"))
            await wait_until(lambda: copter.altitude_m > 8)
            ctrl_c()
            return await flight

    assert run_virtual(scenario()) == 130
    assert copter.mode.number == mode
    printed = capsys.readouterr().out
    assert "; holding here instead" in printed
    assert ("take over, or command it from another ground station" in printed) == (mode == CopterMode.AUTO)


class FullDisk(io.StringIO):
    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")


def test_fly_ctrl_c_with_full_disk_returns_to_launch(copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, "fly", "m.waypoints", "--yes"))
            await wait_until(lambda: copter.is_armed and not copter.is_landed)
            await anyio.sleep(8)
            monkeypatch.setattr(sys, "stdout", FullDisk())
            ctrl_c()
            return await flight

    assert run_virtual(scenario()) == 130
    sys.stdout.close()
    assert (copter.mode.number, copter.is_armed) == (CopterMode.RTL, False)


@pytest.mark.parametrize("as_json", [False, True])
def test_emit_on_ascii_terminal_replaces_characters(as_json: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    options = argparse.Namespace(json=as_json)
    emit(options, "text", {"text": "Grüße"}, "Grüße")
    assert written.getvalue().decode() == ('{"type": "text", "text": "Gr\\u00fc\\u00dfe"}\n' if as_json else "Gr??e\n")


def test_emit_error_on_ascii_terminal_prints_record(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    emit_error(OperationRejected("Grüße"), 5, as_json=True)
    assert '"message": "Gr\\u00fc\\u00dfe"' in written.getvalue().decode()


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("mission.wait_finished: the mode changed to RTL", "flying the mission: the mode changed to RTL"),
        ("go_to(-35.1, 149.2): the mode changed", "flight to -35.1, 149.2: the mode changed"),
        ("arm(): not done within 10 s", "arming: not done within 10 s"),
        ("mission.plan: line 1: expected 'QGC WPL 110'", "mission.plan: line 1: expected 'QGC WPL 110'"),
        ("landing.waypoints: line 2", "landing.waypoints: line 2"),
    ],
)
def test_command_prints_no_names_of_calls(text: str, plain: str, capsys: pytest.CaptureFixture[str]) -> None:
    emit_error(OperationRejected(text), 5, as_json=False)
    assert capsys.readouterr().err == f"aerokit: {plain}\n"


@pytest.mark.exhaustive
def test_demo_repeats_reasons_of_vehicle_while_not_ready(capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        copter = SimulatedCopter(boot_time_s=0.0, home=HOME)
        copter.faults.prearm_failures = ["Compass not healthy"]
        async with simulated_link(copter) as link:
            return await run_on(link, "demo", "--record", "x.tlog")

    assert run_virtual(scenario()) == 1
    after_text = capsys.readouterr().out.partition("! PreArm: Compass not healthy\n")[2]
    lines = [line for line in after_text.splitlines() if "    cannot arm yet: " in line]
    assert len(lines) > 5
    assert all(line.endswith("  cannot arm yet: Compass not healthy") for line in lines)


def test_fly_not_ready_prints_no_empty_list(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0, home=HOME)
    copter.faults.prearm_failures = ["Compass not healthy"]
    Path("m.waypoints").write_text(MISSION)
    assert run_with(copter, ["fly", "m.waypoints", "--yes", "--ready", "10"]) == [TIMED_OUT]
    out, err = capsys.readouterr()
    assert "still missing" not in out
    assert err.endswith("; still missing:\n  - PreArm: Compass not healthy\n")


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("gps_lost@15", "end of the recording: in LAND, disarmed, 0.0 m above home"),
        exhaustive(pytest.param("rc_lost@25", "end of the recording: in RTL, disarmed, 0.0 m above home")),
        exhaustive(pytest.param("silent@25", "the recording ends after 10 s of silence; the vehicle was armed")),
    ],
)
def test_failed_flight_is_recorded_to_its_end(fault: str, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(MISSION.replace("47.3980\t8.5460", "47.400\t8.5460"))
    command = ("fly", "m.waypoints", "--sim", "--speedup", "1", "--fault", fault, "--record", "x.tlog")
    assert run_virtual(run_on(None, *command)) != 0
    out = capsys.readouterr().out
    assert text in out
    parameters = [raw for _, raw in read_tlog("x.tlog") if raw[7:10] == bytes((ParamValue.ID, 0, 0))]
    assert len(parameters) > 1000
    if "silent" in fault:
        assert re.search(r"    - m    silent for [4-9] s; last received: AUTO at 1\d\.\d m\n", out)


def test_fault_of_real_vehicle_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(MISSION)
    assert main(["fly", "m.waypoints", "--yes", "--fault", "gps_lost"]) == 2
    assert main(["demo", "--connect", "tcp:127.0.0.1:1", "--fault", "gps_lost"]) == 2
    assert "--fault needs --sim" in capsys.readouterr().err


def test_fly_explains_wait_after_failsafe_mode(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_virtual(run_on(None, "fly", SURVEY, "--sim", "--fault", "gps_lost@25")) == 5
    texts = [line.split(" m  ", 1)[-1].strip() for line in capsys.readouterr().out.splitlines()]
    changed, waiting, failed = (
        texts.index(text)
        for text in (
            "mode LAND",
            "waiting 15 s for the end of LAND or a report that the mission has ended",
            "failed: flying the mission: the mode changed to LAND, at item 3 of 9",
        )
    )
    assert changed < waiting < failed


def test_fly_prints_long_wait_without_exponent(capsys: pytest.CaptureFixture[str]) -> None:
    run_virtual(run_on(None, "fly", SURVEY, "--sim", "--fault", "gps_lost@25", "--speedup", "70"))
    assert "waiting 105 s for the end of LAND" in capsys.readouterr().out


@pytest.mark.exhaustive
def test_px4_without_position_ends_fly_with_failsafe(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--vehicle", "px4", "--fault", "gps_lost@25", "--record", "x.tlog")
    assert run_virtual(run_on(None, "fly", SURVEY, "--sim", *options)) == 5
    out, err = capsys.readouterr()
    assert "mode LAND" in out
    assert "Failsafe activated" in err
    assert "1 failsafe: Satellite receiver at 0:2" in report_of(Path("x.tlog"))


def test_conditions_of_simulated_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    conditions = ("--battery", "17", "--parameter", "BATT_LOW_MAH=600", "--parameter", "BATT_FS_LOW_ACT=2")
    assert run_virtual(run_on(None, "fly", SURVEY, "--sim", *conditions)) == 5
    assert "Battery Failsafe" in capsys.readouterr().err
    for condition in (conditions[:2], conditions[2:4], ("--wind", "1,2")):
        assert main(["fly", SURVEY, "--yes", *condition]) == 2
        assert f"{condition[0]} needs --sim" in capsys.readouterr().err


@pytest.mark.exhaustive
def test_crash_in_fast_simulation_is_recorded_for_twenty_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    """The seconds are those of the flight: two of the recording, at ten times real speed."""
    options = ("--fault", "motor_failed@25", "--record", "x.tlog")
    assert run_virtual(run_on(None, "fly", SURVEY, "--sim", *options)) == 5
    out = capsys.readouterr().out
    failed_s, ended_s = (
        float(line.split()[0])
        for line in out.splitlines()
        if "m  failed:" in line or "m  end of the recording: " in line
    )
    assert "end of the recording: on the ground in AUTO, still armed" in out
    assert ended_s - failed_s == pytest.approx(20, abs=2.5)
    (printed,) = re.findall(r"armed for 4\d s \((2[45]) s until the impact[;)]", out)
    assert re.search(rf"4\d s armed \({printed} s until the impact\), ", report_of(Path("x.tlog")))


def report_of(path: Path) -> str:
    flight = read_flight(path)
    return "\n".join(summary(flight, statistics_of(flight)))


@pytest.mark.exhaustive
def test_summaries_of_fly_and_report_agree(capsys: pytest.CaptureFixture[str]) -> None:
    """PX4's position is noisy on the ground, which is no flown distance."""
    assert run_virtual(run_on(None, "fly", SURVEY, "--sim", "--vehicle", "px4", "--record", "x.tlog")) == 0
    flown = re.search(r"flown (\d+) m", capsys.readouterr().out)
    reported = re.search(r"(\d+) m flown over ground", report_of(Path("x.tlog")))
    assert flown is not None
    assert reported is not None
    assert int(flown[1]) == pytest.approx(int(reported[1]), abs=1)


@pytest.mark.exhaustive
def test_fly_in_unknown_simulation_counts_its_seconds(
    copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]
) -> None:
    """Like ``fly`` on a vehicle of ``aerokit sim --speedup 5``, whose speed no message contains."""

    async def scenario() -> int:
        async with simulated_link(copter, speedup=5) as link:
            return await run_on(link, "fly", "m.waypoints", "--yes")

    assert run_virtual(scenario()) == 0
    out = capsys.readouterr().out
    assert re.search(r"armed for 1 min 0\d s \(a simulation at 5 times real speed: 1\d s on this clock\)", out)


@pytest.mark.parametrize(
    ("last_command", "is_warned"), [(20, False), (21, False), (85, False), (16, True), (189, True)]
)
def test_fly_warns_if_mission_does_not_end_with_landing(last_command: int, is_warned: bool) -> None:
    """Commands: return, land, VTOL landing, waypoint, DO_LAND_START."""
    Path("m.waypoints").write_text(MISSION.replace("\t20\t", f"\t{last_command}\t"))
    options = make_parser("fly").parse_args(["fly", "m.waypoints"])
    vehicle: Any = SimpleNamespace(distance_to=lambda _: 10.0, connection=SimpleNamespace(now=lambda: 0.0))
    report = FlightReport(vehicle, options, speedup=1.0)
    flight = PlanFlight(vehicle, read_plan("m.waypoints"), report, InterruptStack(), options)
    assert any("does not end with a landing or return" in text for text in flight._warnings()) is is_warned


def test_status_line_has_no_old_speed(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    options = make_parser("fly").parse_args(["fly", "m.waypoints"])

    async def scenario() -> None:
        async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
            await vehicle.wait_ready()
            await vehicle.arm()
            copter.faults.lose(VfrHud, times=1000)
            async with FlightReport(vehicle, options, speedup=1.0).running():
                await anyio.sleep(8)

    run_virtual(scenario())
    assert "STABILIZE, speed unknown" in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="only sockets can be checked there")
def test_flight_lines_wait_while_output_is_blocked(monkeypatch: pytest.MonkeyPatch) -> None:
    """After Ctrl-S, printing would block the event loop, and with it the heartbeats."""
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    os.set_blocking(writing, False)
    filled = 0
    for size in (1000, 1):
        with suppress(BlockingIOError):
            while True:
                filled += os.write(writing, bytes(size))
    vehicle: Any = SimpleNamespace(
        connection=SimpleNamespace(now=lambda: 0.0), position=SimpleNamespace(age=math.inf), heartbeat_age=0.0
    )
    with os.fdopen(reading, "rb") as reader, os.fdopen(writing, "w") as blocked:
        monkeypatch.setattr(sys, "stdout", blocked)
        report = FlightReport(vehicle, argparse.Namespace(json=False), speedup=1.0)
        report.print_line("one")
        reader.read(filled)
        report.print_line("two")
        assert re.findall(rb"one|two", reader.read() or b"") == [b"one", b"two"]
        monkeypatch.undo()


def test_fly_progress_ends_silently_with_connection(copter: SimulatedCopter) -> None:
    """Its error must not replace that of the flight."""
    ours, theirs = memory_link_pair()
    options = make_parser("fly").parse_args(["fly", "m.waypoints"])

    async def scenario() -> None:
        async with SimulatorServer([copter], [theirs]), aerokit.connect(ours) as vehicle:
            report = FlightReport(vehicle, options, speedup=1.0)
            flight = PlanFlight(vehicle, read_plan("m.waypoints"), report, InterruptStack(), options)
            progress = asyncio.create_task(flight._print_progress())
            await anyio.sleep(1)
            theirs.close()
            await progress

    run_virtual(scenario())


@pytest.mark.parametrize(
    ("landed", "modes", "is_ours"),
    [
        (MavLandedState.ON_GROUND, [], True),
        (MavLandedState.IN_AIR, [], False),  # a pilot has taken off in the mode in which this program has armed
        (MavLandedState.ON_GROUND, ["AUTO"], False),  # a pilot has restored this mode
    ],
)
def test_mode_of_arming_is_ours_until_left_or_airborne(landed: int, modes: list[str], is_ours: bool) -> None:
    states: Any = SimpleNamespace(landed_state=SimpleNamespace(latest=landed, age=0.0))
    vehicle: Any = SimpleNamespace(mode_name="STABILIZE", is_armed=True, telemetry=states)
    options = make_parser("fly").parse_args(["fly", "m.waypoints"])
    report: Any = SimpleNamespace(print_line=print)
    flight = PlanFlight(vehicle, read_plan("m.waypoints"), report, InterruptStack(), options)
    flight._modes_armed_in.add("STABILIZE")
    for mode in modes:
        flight._on_mode(None, Mode(mode, 3))
    vehicle.autopilot = SimpleNamespace(mode_for=lambda *_, **__: None)
    vehicle.is_vtol = False
    assert flight._is_in_our_mode is is_ours


@pytest.mark.parametrize(
    ("age_s", "height_m", "has_lasted"), [(0.0, 0.5, True), (30.0, 0.5, False), (0.0, None, False), (0.0, 9.0, False)]
)
def test_only_new_positions_near_ground_show_stillness(age_s: float, height_m: float | None, has_lasted: bool) -> None:
    now = [100.0]
    here = Position(47.4, 8.5, altitude_relative_m=height_m)
    vehicle: Any = SimpleNamespace(
        connection=SimpleNamespace(now=lambda: now[0]), position=SimpleNamespace(latest=here, age=age_s)
    )
    stillness = _StillnessNearGround(vehicle, 20.0)
    now[0] = 120.0
    assert stillness.has_lasted() is has_lasted
