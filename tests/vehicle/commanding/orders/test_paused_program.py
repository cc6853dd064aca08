"""A program that is stopped in flight while the ground station failsafe acts: the failsafe stays in control."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from served_copter import served

from aerokit.sim import SimulatedCopter

PAUSE_S, RTL = 7.0, "RTL"
CASES = [(scheme, what) for scheme in ("udpin", "tcpin") for what in ("go_to", "cancelled", "stream")]

PROGRAM = """
import asyncio, json, sys, aerokit
from aerokit import errors
from aerokit.mavlink import Framer
from aerokit.mavlink.dialect import STANDARD

async def main(address, what):
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready(); await vehicle.arm(); await vehicle.take_off(8)
        sent, ages = [], []
        vehicle.connection.observe_sent_frames(
            lambda raw: sent.append(STANDARD.decode(Framer().receive(raw, 0.0)[0]).to_dict().get("command")))
        vehicle.armed.observe(lambda *_: ages.append(vehicle.armed.age), every_arrival=True)
        print("flying", flush=True)
        far, error = vehicle.position.value.offset(north_m=300), None
        try:
            if what == "go_to":
                await vehicle.go_to(far)
            elif what == "cancelled":
                await asyncio.wait_for(vehicle.go_to(far), 4)
            else:
                async with vehicle.guided.velocity() as stream:
                    await stream.fly(aerokit.VelocitySetpoint(north_m_s=2), 60)
        except (errors.AerokitError, asyncio.TimeoutError) as caught:
            error = type(caught).__name__
        await asyncio.sleep(2.5)
        print(json.dumps([error, [command for command in sent if command in (176, 192)], max(ages), vehicle.mode_name]))

asyncio.run(main(*sys.argv[1:]))
"""


def fly(scheme: str, what: str) -> tuple[str, list[int], float, str, str]:
    """Return the outcome, and the mode of the vehicle at the end."""
    copter = SimulatedCopter(boot_time_s=0.0, parameters={"FS_GCS_ENABLE": 1.0})
    with served([copter], f"{scheme}:127.0.0.1:0", speedup=1.0) as address:
        here = address.replace("udpin:", "udpout:")
        program = subprocess.Popen([sys.executable, "-c", PROGRAM, here, what], stdout=subprocess.PIPE, text=True)
        with program:
            try:
                assert program.stdout is not None
                assert program.stdout.readline() == "flying\n"
                time.sleep(1.5)  # The order is in progress.
                os.kill(program.pid, signal.SIGSTOP)
                time.sleep(PAUSE_S)
                os.kill(program.pid, signal.SIGCONT)
                error, sent, oldest_s, reported = json.loads(program.stdout.readline())
            finally:
                program.kill()
        return error, sent, oldest_s, reported, copter.mode.name


@pytest.mark.skipif(sys.platform == "win32", reason="processes are stopped by signals")
@pytest.mark.exhaustive  # twenty seconds of real time
@pytest.mark.parametrize("cases", [CASES[:1], CASES[1:]], ids=["one", "others"])
def test_blocked_program_keeps_failsafe(cases: list[tuple[str, str]]) -> None:
    """Run all of them concurrently, because they mostly wait for the failsafe."""
    with ThreadPoolExecutor(len(cases)) as pool:
        flown = dict(zip(cases, pool.map(lambda case: fly(*case), cases), strict=True))
    for (scheme, what), (error, sent, oldest_s, reported, mode) in flown.items():
        where = f"{what} over {scheme}: {flown[scheme, what]}"
        assert error is not None, where
        assert len(sent) == (what != "stream"), where  # The order was sent before the pause.
        assert oldest_s > PAUSE_S - 1.5, where  # the age of queued HEARTBEATs includes the pause
        assert reported == mode == RTL, where
