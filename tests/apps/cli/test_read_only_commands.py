"""Read-only commands must not trigger a ground station failsafe when they end."""

from __future__ import annotations

import asyncio
import io
import sys
from pathlib import Path

import anyio
import pytest
from cli_harness import HOME, run_on

import aerokit
from aerokit.apps.cli.output import exit_code
from aerokit.mavlink.enums import CopterMode
from aerokit.sim import SimulatedCopter, SimulatorServer, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport.link import memory_link_pair


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("command", "mode"),
    [
        (("status",), CopterMode.GUIDED),
        (("events", "--seconds", "3"), CopterMode.GUIDED),
        (("doctor", "udpin:127.0.0.1:14550", "--seconds", "3"), CopterMode.GUIDED),
        (("record", "udpin:127.0.0.1:14550", "x.tlog", "--seconds", "3"), CopterMode.GUIDED),
        (("params", "get", "RTL_ALT"), CopterMode.GUIDED),
        (("params", "set", "RTL_ALT=1700", "--source-system", "255"), CopterMode.RTL),
        ((), CopterMode.RTL),  # the vehicle's ground station ends: shows that the test can fail
    ],
    ids=["status", "events", "doctor", "record", "params", "params of a station", "a station"],
)
def test_read_only_command_triggers_no_gcs_failsafe(
    command: tuple[str, ...], mode: CopterMode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    copter = SimulatedCopter(boot_time_s=0.0, home=HOME)

    async def scenario() -> None:
        flying, looking = memory_link_pair(), memory_link_pair()
        async with (
            SimulatorServer([copter], [flying[1], looking[1]]),
            aerokit.connect(flying[0], source_system=254) as vehicle,
        ):
            await vehicle.parameters.set("FS_GCS_ENABLE", 1)
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(10)
            if command:
                assert await run_on(looking[0], *command) in (0, 1)
            else:
                async with aerokit.open_connection(looking[0]):
                    await anyio.sleep(3)
            await anyio.sleep(12)

    run_virtual(scenario())
    assert copter.mode.number == mode


def test_events_closed_stdout_ends_command(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    async def scenario() -> int:
        async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
            return await run_on(link, "events")

    monkeypatch.setattr(sys, "stdout", Gone())
    assert run_virtual(asyncio.wait_for(scenario(), 30)) == exit_code(BrokenPipeError())
    sys.stdout.close()
