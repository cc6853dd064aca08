"""``aerokit fly``: who is refused, what is asked, how it ends, and what Ctrl-C does, on virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import anyio
import pytest
from cli_harness import HOME, MISSION, ctrl_c, run_on, run_with, until

import aerokit
from aerokit.apps.cli import fly, main
from aerokit.apps.cli import fly as flown_plan
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.sim import SimulatedCopter, SimulatedRover, SimulatedSub, SimulatorServer, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport.memory import memory_link_pair

FLY = ("fly", "m.waypoints", "--yes")


@pytest.fixture(autouse=True)
def _plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.waypoints").write_text(MISSION)


@pytest.fixture
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, home=HOME)


def test_it_flies_to_the_end(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(copter, FLY) == [0]
    out = capsys.readouterr().out
    for text in (
        "mission: 4 items",
        "are on vehicle",
        "on to item 2 of 4, NAV_WAYPOINT",
        "is finished, in AUTO",
    ):
        assert text in out
    assert (copter.is_armed, copter.is_landed) == (False, True)


def test_the_simulation_begins_at_the_planned_home(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_virtual(run_on(None, "fly", "m.waypoints", "--sim")) == 0
    assert "simulated copter at 47.397742, 8.545594" in capsys.readouterr().out


# ------------------------------------------------------------------------------------ refusals


def test_who_flies_already_is_left_alone(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        async with simulated_link(copter) as link, aerokit.connect(link) as pilot:
            await pilot.wait_ready()
            await pilot.arm()
        async with simulated_link(copter) as link:
            return await run_on(link, *FLY)

    assert run_virtual(scenario()) == 5
    told = capsys.readouterr()
    assert "it is left to whoever armed it" in told.err
    assert "are on vehicle" not in told.out
    assert copter.is_armed


def test_nobody_at_the_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(fly, "is_somebody_there", lambda: False)
    assert main(["fly", "m.waypoints", "--connect", "tcp:127.0.0.1:1"]) == 2
    assert "--yes is not given: nothing was sent" in capsys.readouterr().err


@pytest.mark.parametrize(("answer", "code"), [(True, 0), (False, 1)])
def test_the_question(
    answer: bool,
    code: int,
    copter: SimulatedCopter,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = []

    async def agrees(question: str) -> bool:
        asked.append(question)
        assert not copter.is_armed
        await anyio.sleep(60)  # somebody thinks: the link goes on meanwhile
        return answer

    monkeypatch.setattr(flown_plan, "agrees", agrees)
    monkeypatch.setattr(fly, "is_somebody_there", lambda: True)
    assert run_with(copter, ("fly", "m.waypoints")) == [code]
    assert asked == ["arm ArduCopter, system 1, and fly 4 items?"]
    assert not copter.is_armed
    assert ("mode AUTO" in capsys.readouterr().out) is answer


def test_who_is_armed_while_the_question_stands_is_left_alone(
    copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours, theirs = memory_link_pair(), memory_link_pair()

    async def agrees(_: str) -> bool:
        async with aerokit.connect(theirs[0], source_system=254) as pilot:
            await pilot.arm()
        return True

    async def scenario() -> int:
        async with SimulatorServer([copter], [ours[1], theirs[1]]):
            return await run_on(ours[0], "fly", "m.waypoints")

    monkeypatch.setattr(flown_plan, "agrees", agrees)
    monkeypatch.setattr(fly, "is_somebody_there", lambda: True)
    assert run_virtual(scenario()) == 5
    assert "it is left to whoever armed it" in capsys.readouterr().err
    assert (mode_of(copter), copter.is_landed) == ("STABILIZE", True)


def test_a_refused_arming_says_why(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    copter.faults.refuse(MavCmd.COMPONENT_ARM_DISARM, text="Arm: Motors not spinning freely")
    assert run_with(copter, FLY) == [5]
    assert "Arm: Motors not spinning freely" in capsys.readouterr().err


def test_a_refused_start_disarms(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    copter.faults.refuse(MavCmd.MISSION_START)
    assert run_with(copter, FLY) == [5]
    assert "on the ground and armed; disarming" in capsys.readouterr().out
    assert not copter.is_armed


def test_a_vehicle_that_cannot_do_what_ctrl_c_is_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedSub(boot_time_s=0.0, home=HOME), FLY) == [5]
    assert "choose --on-interrupt land or hold or nothing; nothing was sent" in capsys.readouterr().err
    assert run_with(SimulatedRover(boot_time_s=0.0, home=HOME), (*FLY, "--on-interrupt", "land")) == [5]
    assert "choose --on-interrupt return or hold or nothing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "code", "text"),
    [
        ("QGC WPL 110\n", 2, "there is nothing to fly"),
        ("something else\n", 6, "m.waypoints"),
        (MISSION.replace("47.398\t8.5456", "91\t8.5456"), 6, "line 4: latitude = '91'"),
    ],
    ids=["empty", "another file", "no place on earth"],
)
def test_files_that_cannot_be_flown(
    content: str, code: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("m.waypoints").write_text(content)
    assert main([*FLY, "--connect", "tcp:127.0.0.1:1"]) == code
    assert text in capsys.readouterr().err


def test_arguments_that_contradict_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*FLY, "--sim", "--connect", "tcp:127.0.0.1:1"]) == 2
    assert main([*FLY, "--vehicle", "plane"]) == 2
    assert "--vehicle is for --sim" in capsys.readouterr().err


# -------------------------------------------------------------------------------------- Ctrl-C


def mode_of(copter: SimulatedCopter) -> str:
    return CopterMode(copter.mode.number).name


def fly_and(copter: SimulatedCopter, what: Callable[[], Awaitable[None]], *options: str) -> int:
    """Fly, and do something beside it."""

    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, *FLY, *options))
            await what()
            return await flight

    return run_virtual(scenario())


async def in_the_air(copter: SimulatedCopter) -> None:
    await until(lambda: copter.is_armed and not copter.is_landed)
    await anyio.sleep(8)


@pytest.mark.parametrize(
    ("wanted", "text", "mode", "is_armed"),
    [
        ("return", "returning to launch", "RTL", False),
        ("land", "landing here", "LAND", False),
        ("hold", "holding here", "BRAKE", True),
        ("nothing", "it is left to itself", "AUTO", True),
    ],
)
def test_ctrl_c_in_the_air(
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

    assert fly_and(copter, interrupt, "--on-interrupt", wanted) == 130
    out = capsys.readouterr().out
    assert "interrupted, in AUTO, still armed" in out
    assert text in out
    assert mode_of(copter) == mode
    assert copter.is_armed is is_armed


def test_a_second_ctrl_c_leaves_it_to_itself(
    copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]
) -> None:
    async def interrupt_twice() -> None:
        await in_the_air(copter)
        ctrl_c()
        await anyio.sleep(4)
        ctrl_c()

    assert fly_and(copter, interrupt_twice) == 130
    assert "interrupted again: left in RTL, still armed" in capsys.readouterr().out
    assert copter.is_armed


def test_ctrl_c_before_it_is_armed(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=60.0, home=HOME)

    async def interrupt() -> None:
        await anyio.sleep(10)
        ctrl_c()

    assert fly_and(copter, interrupt) == 130
    assert "interrupted, in STABILIZE, disarmed" in capsys.readouterr().out
    assert not copter.is_armed


def test_a_pilot_who_takes_over_keeps_it(copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> int:
        ours, theirs = memory_link_pair(), memory_link_pair()
        async with SimulatorServer([copter], [ours[1], theirs[1]]):
            flight = asyncio.create_task(run_on(ours[0], *FLY))
            await in_the_air(copter)
            async with aerokit.connect(theirs[0], source_system=254) as pilot:
                await pilot.set_mode("LOITER")
                return await flight

    assert run_virtual(scenario()) == 5
    told = capsys.readouterr()
    assert "the mode changed to LOITER" in told.err
    assert "no order is given: left " in told.out
    assert (mode_of(copter), copter.is_armed) == ("LOITER", True)


def test_ctrl_c_does_not_overrule_a_pilot(
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
    assert "left to whoever put it into " in capsys.readouterr().out
    assert (mode_of(copter), copter.is_armed) == ("LOITER", True)
