"""Three failures of the best-known library, which must not be ours.

One unanswered command delays other calls and cached reads; a slow consumer works through a backlog of old values; a
call that was cancelled, or timed out, keeps the program from ending.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import textwrap
import threading

import anyio
import pytest
from flight_harness import Flight, block_loop, now, open_flight

from aerokit import messages as m
from aerokit.errors import CommandTimeout
from aerokit.events import StatusTextReceived
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd

pytestmark = pytest.mark.anyio


# ---------------------------------------------------------------------- 1: unanswered commands


async def test_twenty_unanswered_commands_delay_nothing_else(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    silent = list(range(31_000, 31_020))
    for command in silent:
        grounded.copter.faults.ignore(command)

    async def command_without_answer(command: int) -> None:
        with pytest.raises(CommandTimeout):
            await vehicle.command(command)

    async with anyio.create_task_group() as tasks:
        for command in silent:
            tasks.start_soon(command_without_answer, command)
        await anyio.sleep(0.5)

        started = now()
        assert vehicle.attitude.value is not None  # a property never sends a request
        assert vehicle.mode.fresh(within=1.5)
        assert now() == started

        with anyio.fail_after(0.1):
            await vehicle.command(MavCmd.GET_MESSAGE_INTERVAL, m.Attitude.ID)
        with anyio.fail_after(0.2):
            await vehicle.attitude.wait_until(lambda _: True)
        with vehicle.subscribe(m.Attitude) as attitudes:
            await attitudes.get(timeout=0.2)
        with anyio.fail_after(1.2):
            await vehicle.set_mode("GUIDED")
            await vehicle.arm()
        assert now() - started < 2.0


async def test_unanswered_rate_request_delays_no_other() -> None:
    """A stream that the vehicle never acknowledges does not block later requests either."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.ignore(MavCmd.SET_MESSAGE_INTERVAL, times=4)
        with flight.vehicle.rate(m.ScaledImu2, 5.0), flight.vehicle.subscribe(m.RawImu, rate_hz=10.0) as imu:
            await imu.get(timeout=6.0)


async def test_silent_vehicle_delays_only_its_own_calls() -> None:
    """Earlier values can be read at once; their age shows how old they are."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.silent = True
        async with anyio.create_task_group() as tasks:

            async def command_without_answer() -> None:
                with pytest.raises(CommandTimeout):
                    await flight.vehicle.arm()

            tasks.start_soon(command_without_answer)
            await anyio.sleep(2.0)
            started = now()
            assert flight.vehicle.position.value.latitude_deg < 0
            assert flight.vehicle.position.age == pytest.approx(2.0, abs=0.2)
            assert now() == started


# -------------------------------------------------------------------------- 2: slow consumers


async def test_slow_subscriber_gets_latest_and_missed_count(grounded: Flight) -> None:
    ages: list[float] = []
    with grounded.vehicle.subscribe(m.Attitude, rate_hz=50.0) as attitudes:
        await anyio.sleep(1.0)
        read, missed_before = 0, attitudes.missed
        started = now()
        async for attitude in attitudes:
            ages.append(grounded.copter.uptime - attitude.time_boot_ms / 1000)
            read += 1
            if now() - started > 15.0:
                break
            await anyio.sleep(0.1)  # 10 Hz on a 50 Hz stream
        missed = attitudes.missed - missed_before
    assert max(ages) <= 0.0211
    assert read == pytest.approx(150, abs=3)
    assert read + missed == pytest.approx(755, abs=5)


async def test_slow_cell_iterator_gets_latest(grounded: Flight) -> None:
    with grounded.vehicle.rate(m.Attitude, 50.0):
        await anyio.sleep(1.0)
        updates = grounded.vehicle.attitude.updates()
        for _ in range(20):
            await anyio.sleep(0.1)
            value = await anext_of(updates)
            assert value is grounded.vehicle.attitude.value
        assert updates.missed == pytest.approx(80, abs=5)


async def anext_of(iterator: object) -> object:
    return await iterator.__anext__()  # type: ignore[attr-defined]


async def test_subscription_capacity_is_explicit(grounded: Flight) -> None:
    with grounded.vehicle.subscribe(StatusTextReceived, capacity=100) as texts:
        for number in range(50):
            grounded.copter.send_text(6, f"text {number}")
        await anyio.sleep(1.0)
        got = [event.text for event in iter(texts.get_nowait, None)]
    assert got == [f"text {number}" for number in range(50)]
    assert texts.missed == 0


async def test_slow_subscriber_does_not_delay_others(grounded: Flight) -> None:
    with (
        grounded.vehicle.subscribe(m.Attitude, rate_hz=50.0) as slow,
        grounded.vehicle.subscribe(m.Attitude, capacity=500) as quick,
    ):
        await anyio.sleep(5.0)
        assert slow.missed > 200
        assert quick.missed == 0


async def test_blocked_loop_then_latest_value_is_available(grounded: Flight) -> None:
    with grounded.vehicle.subscribe(m.Attitude, rate_hz=50.0) as attitudes:
        await anyio.sleep(1.0)
        block_loop(5.0)
        await anyio.sleep(0.05)
        attitude = await attitudes.get(timeout=1.0)
        assert grounded.copter.uptime - attitude.time_boot_ms / 1000 < 0.06


# -------------------------------------------------------- 3: cancelled calls and ending programs


@pytest.mark.parametrize("wait_s", [0.0, 0.2, 1.7])
async def test_call_cancelled_in_silence_ends_immediately(grounded: Flight, wait_s: float) -> None:
    grounded.copter.faults.silent = True
    started = now()
    with anyio.move_on_after(wait_s) as scope:
        await grounded.vehicle.arm()
    assert scope.cancelled_caught
    assert now() - started == pytest.approx(wait_s, abs=1e-6)


PROGRAM = """
    import asyncio, sys
    import aerokit

    async def main(address: str) -> None:
        async with aerokit.connect(address, rates={}) as vehicle:
            print("connected", flush=True)
            for call in (
                lambda: asyncio.wait_for(vehicle.arm(), 0.2),
                lambda: vehicle.command(31000, retries=0, attempt_timeout=0.2),
                lambda: vehicle.position.wait_until(lambda _: True, timeout=0.2),
            ):
                try:
                    await call()
                except (asyncio.TimeoutError, TimeoutError):
                    print("timeout", flush=True)
            cancelled = asyncio.create_task(vehicle.set_mode("GUIDED"))
            await asyncio.sleep(0.1)
            cancelled.cancel()
            try:
                await cancelled
            except asyncio.CancelledError:
                print("cancelled", flush=True)
        print("left", flush=True)

    asyncio.run(main(sys.argv[1]))
    print("done", flush=True)
"""


class SilentVehicle:
    """Sends heartbeats over UDP and answers nothing."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> SilentVehicle:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        encoder = FrameEncoder(1, 1)
        heartbeat = m.Heartbeat(2, 3, 0x51, 0, 3, 3)
        while not self._stop.wait(0.05):
            self._socket.sendto(encoder.encode(heartbeat), ("127.0.0.1", self.port))


def test_program_with_timed_out_calls_exits() -> None:
    """A separate process with a real socket: the interpreter must exit."""
    with SilentVehicle() as silent:
        finished = subprocess.run(
            [sys.executable, "-W", "error", "-c", textwrap.dedent(PROGRAM), f"udpin:127.0.0.1:{silent.port}"],
            capture_output=True,
            text=True,
            timeout=30,  # The program takes two seconds. In another library, it was reported never to end.
            check=False,
        )
    reported = ["connected", "timeout", "timeout", "timeout", "cancelled", "left", "done"]
    assert finished.stdout.split() == reported, finished.stderr
    assert "an arm command may still be executed" in finished.stderr  # it never was answered
    assert finished.returncode == 0
