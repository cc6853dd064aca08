"""``aerokit fly`` when something comes between: slow links, silence, other stations, outputs that take nothing."""

from __future__ import annotations

import argparse
import asyncio
import io
import sys
from pathlib import Path

import anyio
import pytest
from cli_harness import HOME, MISSION, ctrl_c, run_on, until

import aerokit
from aerokit.apps.cli import fly
from aerokit.apps.cli import fly as flown_plan
from aerokit.apps.cli.output import tell
from aerokit.mavlink.enums import CopterMode
from aerokit.missions import read_waypoint_file
from aerokit.sim import SimulatedCopter, SimulatorServer, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport.memory import memory_link_pair


@pytest.fixture(autouse=True)
def _plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.waypoints").write_text(MISSION)
    monkeypatch.setattr(fly, "is_somebody_there", lambda: True)


@pytest.fixture
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, home=HOME)


FLIGHTS = pytest.mark.parametrize(
    "command", [("fly", "m.waypoints", "--yes"), ("demo",)], ids=lambda each: each[0]
)


@FLIGHTS
def test_an_order_to_arm_that_arrives_late_is_undone(
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
            await until(lambda: copter.is_armed)  # the order was on its way
            return await flight

    assert run_virtual(scenario()) == 130
    assert not copter.is_armed
    assert "the order to arm may still be carried out" in capsys.readouterr().out


def test_ctrl_c_while_it_leaves_the_ground(
    copter: SimulatedCopter, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last that was told is that it stands, and it refuses to disarm."""

    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, "fly", "m.waypoints", "--yes"))
            while copter.is_landed:  # noqa: ASYNC110 - nobody else could say it
                await anyio.sleep(0.02)
            ctrl_c()
            return await flight

    assert run_virtual(scenario()) == 130
    told = capsys.readouterr().out
    assert "it does not disarm" in told
    assert "returning to launch" in told
    assert (copter.mode.number, copter.is_armed) == (CopterMode.RTL, False)


def test_a_vehicle_that_is_not_heard_any_more_when_somebody_agrees(
    copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def agrees(_: str) -> bool:
        copter.faults.silent = True
        await anyio.sleep(5)
        return True

    async def scenario() -> int:
        async with simulated_link(copter) as link:
            code = await run_on(link, "fly", "m.waypoints")
            copter.faults.silent = False
            await anyio.sleep(5)
            return code

    monkeypatch.setattr(flown_plan, "agrees", agrees)
    assert run_virtual(scenario()) == 3
    assert "nothing was started" in capsys.readouterr().err
    assert not copter.is_armed


def test_a_mission_that_somebody_changed_while_the_question_stood_is_not_flown(
    copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours, theirs = memory_link_pair(), memory_link_pair()
    Path("other.waypoints").write_text(MISSION.replace("\t15\t1", "\t99\t1"))

    async def agrees(_: str) -> bool:
        async with aerokit.connect(theirs[0], source_system=254) as other:
            await other.mission.upload(read_waypoint_file("other.waypoints"))
        return True

    async def scenario() -> int:
        async with SimulatorServer([copter], [ours[1], theirs[1]]):
            return await run_on(ours[0], "fly", "m.waypoints")

    monkeypatch.setattr(flown_plan, "agrees", agrees)
    assert run_virtual(scenario()) == 5
    assert "another mission than the one asked about; nothing was started" in capsys.readouterr().err
    assert (copter.is_armed, copter.is_landed) == (False, True)


class FullDisk(io.StringIO):
    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")


def test_ctrl_c_counts_when_nothing_can_be_written(
    copter: SimulatedCopter, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> int:
        async with simulated_link(copter) as link:
            flight = asyncio.create_task(run_on(link, "fly", "m.waypoints", "--yes"))
            await until(lambda: copter.is_armed and not copter.is_landed)
            await anyio.sleep(8)
            monkeypatch.setattr(sys, "stdout", FullDisk())
            ctrl_c()
            return await flight

    assert run_virtual(scenario()) == 130
    sys.stdout.close()
    assert (copter.mode.number, copter.is_armed) == (CopterMode.RTL, False)


@pytest.mark.parametrize("as_json", [False, True])
def test_a_terminal_without_such_letters(as_json: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    options = argparse.Namespace(json=as_json)
    tell(options, "text", {"text": "Grüße"}, "Grüße")
    assert written.getvalue().decode() == (
        '{"type": "text", "text": "Gr\\u00fc\\u00dfe"}\n' if as_json else "Gr??e\n"
    )
