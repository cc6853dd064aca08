"""``aerokit fly``: refusals, confirmation, exit codes and Ctrl-C, on virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import anyio
import pytest
from cli_harness import HOME, MISSION, ctrl_c, run_on, run_with, wait_until
from exhaustive import exhaustive

import aerokit
from aerokit.apps.cli import fly, main
from aerokit.apps.cli import fly as flown_plan
from aerokit.apps.cli.mission import read_plan
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.sim import SimulatedCopter, SimulatedRover, SimulatedSub, SimulatorServer, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport.link import memory_link_pair

FLY = ("fly", "m.waypoints", "--yes")


@pytest.fixture(autouse=True)
def _plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.waypoints").write_text(MISSION)


@pytest.fixture
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, home=HOME)


def test_fly_flies_mission_to_end(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(copter, FLY) == [0]
    out = capsys.readouterr().out
    for text in (
        "mission: 4 items",
        "uploaded to vehicle",
        "to item 2, NAV_WAYPOINT",
        "mission finished: in AUTO",
    ):
        assert text in out
    assert (copter.is_armed, copter.is_landed) == (False, True)


@pytest.mark.exhaustive
def test_fly_from_auto_shows_no_warning_about_mode(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        async with simulated_link(copter) as link, aerokit.connect(link) as pilot:
            await pilot.wait_ready()
            await pilot.mission.upload(read_plan("m.waypoints").mission)
            await pilot.set_mode("AUTO")
        async with simulated_link(copter) as link:
            return await run_on(link, *FLY)

    assert run_virtual(scenario()) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "AUTO mode not armable" in line]
    assert lines
    assert not any("!" in line for line in lines)


@pytest.mark.exhaustive
def test_fly_sim_starts_at_planned_home(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_virtual(run_on(None, "fly", "m.waypoints", "--sim")) == 0
    assert "simulated copter at 47.397742, 8.545594" in capsys.readouterr().out


def test_fly_sim_starts_at_sea_level_if_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    started = []

    def simulated(kind: str, home: tuple[float, float, float], **options: object) -> None:
        started.append(home)
        raise InvalidArgument("end of this test")

    monkeypatch.setattr("aerokit.sim.kinds.simulated", simulated)
    Path("m.waypoints").write_text(MISSION.replace("\t488\t", "\t0\t"))
    assert run_virtual(run_on(None, "fly", "m.waypoints", "--sim")) == 2
    assert started == [(47.397742, 8.545594, 0.0)]


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("copter", "mission finished: in AUTO, disarmed"),
        exhaustive(pytest.param("px4", "mission finished: in LOITER, disarmed")),
    ],
)
def test_example_plan_is_flown_to_its_end(kind: str, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    plan = Path(__file__).parents[3] / "examples" / "survey.plan"
    assert run_virtual(run_on(None, "fly", str(plan), "--sim", "--vehicle", kind)) == 0
    assert text in capsys.readouterr().out


# ------------------------------------------------------------------------------------ refusals


def test_fly_on_armed_vehicle_sends_no_command(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        async with simulated_link(copter) as link, aerokit.connect(link) as pilot:
            await pilot.wait_ready()
            await pilot.arm()
        async with simulated_link(copter) as link:
            return await run_on(link, *FLY)

    assert run_virtual(scenario()) == 5
    printed = capsys.readouterr()
    assert "the vehicle was armed by another party" in printed.err
    assert "uploaded to vehicle" not in printed.out
    assert copter.is_armed


def test_fly_without_terminal_and_yes_sends_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fly, "is_interactive", lambda: False)
    assert main(["fly", "m.waypoints", "--connect", "tcp:127.0.0.1:1"]) == 2
    assert "--yes omits the question; nothing was sent" in capsys.readouterr().err


@pytest.mark.parametrize(("answer", "code"), [(True, 0), (False, 1)])
def test_fly_asks_before_arming(
    answer: bool,
    code: int,
    copter: SimulatedCopter,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = []

    async def confirm(question: str) -> bool:
        asked.append(question)
        assert not copter.is_armed
        await anyio.sleep(60)  # the link must stay open during the question
        return answer

    monkeypatch.setattr(flown_plan, "confirm", confirm)
    monkeypatch.setattr(fly, "is_interactive", lambda: True)
    assert run_with(copter, ("fly", "m.waypoints")) == [code]
    assert asked == ["arm ArduCopter, system 1, and fly 4 items?"]
    assert not copter.is_armed
    assert ("mode AUTO" in capsys.readouterr().out) is answer


def test_fly_vehicle_armed_during_question_is_not_commanded(
    copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours, theirs = memory_link_pair(), memory_link_pair()

    async def confirm(_: str) -> bool:
        async with aerokit.connect(theirs[0], source_system=254) as pilot:
            await pilot.arm()
        return True

    async def scenario() -> int:
        async with SimulatorServer([copter], [ours[1], theirs[1]]):
            return await run_on(ours[0], "fly", "m.waypoints")

    monkeypatch.setattr(flown_plan, "confirm", confirm)
    monkeypatch.setattr(fly, "is_interactive", lambda: True)
    assert run_virtual(scenario()) == 5
    assert "the vehicle was armed by another party" in capsys.readouterr().err
    assert (mode_of(copter), copter.is_landed) == ("STABILIZE", True)


def test_fly_arming_refusal_prints_reason(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    copter.faults.refuse(MavCmd.COMPONENT_ARM_DISARM, text="Arm: Motors not spinning freely")
    assert run_with(copter, FLY) == [5]
    assert "Arm: Motors not spinning freely" in capsys.readouterr().err


def test_fly_mission_start_refusal_disarms(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    copter.faults.refuse(MavCmd.MISSION_START)
    assert run_with(copter, FLY) == [5]
    assert "on the ground and armed; disarming" in capsys.readouterr().out
    assert not copter.is_armed


def test_fly_mission_without_take_off_is_not_armed(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(MISSION.replace("1\t0\t3\t22", "1\t0\t3\t178"))  # DO_CHANGE_SPEED
    assert run_with(copter, FLY) == [2]
    out, err = capsys.readouterr()
    assert "does not begin with a take-off" in err
    assert "arming" not in out
    assert not copter.is_armed


def test_fly_unsupported_interrupt_action_sends_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedSub(boot_time_s=0.0, home=HOME), FLY) == [5]
    assert "choose land or hold or nothing; nothing was sent" in capsys.readouterr().err
    assert run_with(SimulatedRover(boot_time_s=0.0, home=HOME), (*FLY, "--on-interrupt", "land")) == [5]
    assert "choose return or hold or nothing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "code", "text"),
    [
        ("QGC WPL 110\n", 2, "nothing to fly"),
        ("something else\n", 6, "m.waypoints"),
        (MISSION.replace("47.398\t8.5456", "91\t8.5456"), 6, "line 4: latitude = '91'"),
    ],
    ids=["empty", "another file", "no place on earth"],
)
def test_fly_of_invalid_file_fails(content: str, code: int, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(content)
    assert main([*FLY, "--connect", "tcp:127.0.0.1:1"]) == code
    assert text in capsys.readouterr().err


def test_fly_contradicting_options_exit_with_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*FLY, "--sim", "--connect", "tcp:127.0.0.1:1"]) == 2
    for option, value in (("--vehicle", "plane"), ("--speedup", "5")):
        assert main([*FLY, option, value]) == 2
        assert f"{option} needs --sim" in capsys.readouterr().err


# -------------------------------------------------------------------------------------- Ctrl-C


def mode_of(copter: SimulatedCopter) -> str:
    return CopterMode(copter.mode.number).name


def fly_with(copter: SimulatedCopter, what: Callable[[], Awaitable[None]], *options: str) -> int:
    """Fly, and run another coroutine meanwhile."""

    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, *FLY, *options))
            await what()
            return await flight

    return run_virtual(scenario())


async def in_the_air(copter: SimulatedCopter) -> None:
    await wait_until(lambda: copter.is_armed and not copter.is_landed)
    await anyio.sleep(8)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("wanted", "text", "mode", "is_armed"),
    [
        ("return", "returning to launch", "RTL", False),
        ("land", "landing here", "LAND", False),
        ("hold", "holding here", "BRAKE", True),
        ("nothing", "no command is sent", "AUTO", True),
    ],
)
def test_fly_ctrl_c_in_air_performs_interrupt_action(
    wanted: str,
    text: str,
    mode: str,
    is_armed: bool,
    copter: SimulatedCopter,
    capsys: pytest.CaptureFixture[str],
) -> None:
    async def interrupt() -> None:
        await in_the_air(copter)
        ctrl_c()

    assert fly_with(copter, interrupt, "--on-interrupt", wanted) == 130
    out = capsys.readouterr().out
    assert "interrupted, in AUTO, still armed" in out
    assert text in out
    assert mode_of(copter) == mode
    assert copter.is_armed is is_armed


def test_fly_second_ctrl_c_exits_without_commands(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    async def interrupt_twice() -> None:
        await in_the_air(copter)
        ctrl_c()
        await anyio.sleep(4)
        ctrl_c()

    assert fly_with(copter, interrupt_twice) == 130
    assert "interrupted again; no further commands: vehicle in RTL, still armed" in capsys.readouterr().out
    assert copter.is_armed


def test_fly_ctrl_c_before_arming_leaves_vehicle_disarmed(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=60.0, home=HOME)

    async def interrupt() -> None:
        await anyio.sleep(10)
        ctrl_c()

    assert fly_with(copter, interrupt) == 130
    out = capsys.readouterr().out
    assert "interrupted, in STABILIZE, disarmed" in out
    assert out.endswith("\ninterrupted; the plan is on the vehicle, nothing was armed\n")
    assert not copter.is_armed


def test_fly_ctrl_c_at_question_does_not_arm(
    copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def confirm(_: str) -> bool:
        ctrl_c()
        await anyio.sleep(60)
        return True

    monkeypatch.setattr(flown_plan, "confirm", confirm)
    monkeypatch.setattr(fly, "is_interactive", lambda: True)
    assert run_with(copter, ("fly", "m.waypoints")) == [130]
    assert capsys.readouterr().out.endswith("\ninterrupted; the plan is on the vehicle, nothing was armed\n")
    assert not copter.is_armed


def test_fly_ctrl_c_before_connection_sends_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        flight = asyncio.create_task(run_on(memory_link_pair()[0], *FLY))
        await anyio.sleep(3)
        ctrl_c()
        return await flight

    assert run_virtual(scenario()) == 130
    assert capsys.readouterr().out.endswith("\ninterrupted; nothing was sent\n")


def test_fly_mode_change_by_pilot_ends_flight(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        ours, theirs = memory_link_pair(), memory_link_pair()
        async with SimulatorServer([copter], [ours[1], theirs[1]]):
            flight = asyncio.create_task(run_on(ours[0], *FLY))
            await in_the_air(copter)
            async with aerokit.connect(theirs[0], source_system=254) as pilot:
                await pilot.set_mode("LOITER")
                return await flight

    assert run_virtual(scenario()) == 5
    printed = capsys.readouterr()
    assert "the mode changed to LOITER" in printed.err
    assert "no command is sent: vehicle " in printed.out
    assert (mode_of(copter), copter.is_armed) == ("LOITER", True)


def test_fly_ctrl_c_after_pilot_mode_change_sends_nothing(
    copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]
) -> None:
    async def scenario() -> int:
        ours, theirs = memory_link_pair(), memory_link_pair()
        async with SimulatorServer([copter], [ours[1], theirs[1]]):
            flight = asyncio.create_task(run_on(ours[0], *FLY))
            await in_the_air(copter)
            async with aerokit.connect(theirs[0], source_system=254) as pilot:
                await pilot.set_mode("LOITER")
                await anyio.sleep(0.2)  # the flight has not come to its own conclusion
                ctrl_c()
                return await flight

    assert run_virtual(scenario()) == 130
    assert "the vehicle itself or another party changed the mode to " in capsys.readouterr().out
    assert (mode_of(copter), copter.is_armed) == ("LOITER", True)
