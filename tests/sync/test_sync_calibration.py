"""Calibrations and corrections without async."""

from __future__ import annotations

import asyncio
import gc
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from queue import Queue

from caster import open_caster
from served_copter import served

import aerokit.sync
from aerokit.sim import SimulatedCopter


def test_calibration_steps_end_with_result() -> None:
    with served([SimulatedCopter(boot_time_s=0.0)]) as address, aerokit.sync.connect(address) as vehicle:
        steps = list(vehicle.calibrate.gyroscope())
        assert [step.result is not None for step in steps] == [False, True]


def test_break_cancels_on_vehicle() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    with served([copter]) as address, aerokit.sync.connect(address) as vehicle:
        for _ in vehicle.calibrate.compass():
            assert copter.calibrations.compasses.is_running
            break
        gc.collect()
        deadline = time.monotonic() + 20
        while copter.calibrations.compasses.is_running and time.monotonic() < deadline:
            vehicle.mode.updates().__next__()  # the next HEARTBEAT
        assert not copter.calibrations.compasses.is_running


@contextmanager
def caster_in_thread() -> Iterator[str]:
    """Serve an NTRIP caster on a loop of its own; return the URL of its mount point."""
    ready: Queue[str] = Queue()
    loop, ended = asyncio.new_event_loop(), asyncio.Event()

    async def serve() -> None:
        async with open_caster() as caster:
            ready.put(caster.url())
            await ended.wait()

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),))
    thread.start()
    try:
        yield ready.get(timeout=20)
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()
        loop.close()


def test_caster_feeds_vehicle_within_block() -> None:
    with (
        caster_in_thread() as url,
        served([SimulatedCopter(boot_time_s=0.0)]) as address,
        aerokit.sync.connect(address) as vehicle,
    ):
        with vehicle.rtk.ntrip(url) as client:
            vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages == 2, timeout=20)
            assert client.is_connected
        assert not client.is_connected


def test_corrections_reach_vehicle() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    message = bytes.fromhex("D300133ED7D30202980EDEEF34B4BD62AC0941986F33360B98")
    with served([copter]) as address, aerokit.sync.connect(address) as vehicle:
        vehicle.rtk.send(message)
        assert vehicle.rtk.corrections.value.message_number == 1005
        list(vehicle.calibrate.barometer())  # The answer shows that the earlier corrections have arrived.
        assert copter.corrections.messages == [message]
