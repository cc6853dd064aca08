"""Exceptions inside simulated vehicles: callers that wait for the vehicle end at once, and the test fails with it."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest

import aerokit
from aerokit import messages, sync
from aerokit.errors import LinkLost
from aerokit.sim import SimulatedCopter, SimulatorServer, simulated_link
from aerokit.testing import Flight, SimulatedFleet, TrackPoint, run_virtual, serve_flight
from aerokit.testing.failure import failure_report
from aerokit.testing.interruption import Interruption
from aerokit.testing.served import ServedFlight
from aerokit.transport import memory_link_pair

MAX_SLEEP_S = 100.0


class VehicleError(Exception):
    pass


def raise_error(*_: object) -> None:
    raise VehicleError("in the vehicle")


def failing_condition(here: TrackPoint) -> bool:
    raise VehicleError(f"in a condition, {here}")


async def in_command_handler(flight: Flight) -> None:
    flight.simulated.on(messages.CommandLong, raise_error)
    await flight.vehicle.set_mode("GUIDED")


async def in_timer_during_sleep(flight: Flight) -> None:
    flight.simulated.call_later(3, raise_error)
    await asyncio.sleep(1000)


async def in_timer_with_tasks(flight: Flight) -> None:
    flight.simulated.call_later(3, raise_error)
    async with anyio.create_task_group() as group:
        group.start_soon(anyio.sleep_forever)
        with anyio.move_on_after(10):
            await anyio.sleep_forever()
        raise AssertionError("it went on")


async def in_condition(flight: Flight) -> None:
    flight.faults.when(lambda here: here.time_s > 3 and failing_condition(here)).hang()
    await asyncio.sleep(1000)


async def while_track_is_read(flight: Flight) -> None:
    flight.simulated.call_at(flight.simulated.now, raise_error)
    assert flight.track.end
    raise AssertionError("it went on")


CAUSES = [
    in_command_handler,
    in_timer_during_sleep,
    in_timer_with_tasks,
    in_condition,
    while_track_is_read,
]


@pytest.mark.parametrize("cause", CAUSES)
def test_vehicle_error_is_raised_by_the_flight(cause: Callable[[Flight], Awaitable[None]]) -> None:
    async def main() -> None:
        fleet = SimulatedFleet("copter")
        flight = fleet[0]
        with pytest.raises(VehicleError):
            async with fleet.open():
                await flight.vehicle.wait_ready()
                await cause(flight)
        assert flight.simulated.now < 6
        assert flight.track.end.time_s == pytest.approx(flight.simulated.now, abs=0.11)
        await asyncio.sleep(1)  # This would raise if the task were still cancelled.

    run_virtual(main())


def test_vehicle_error_is_raised_by_server_of_another_task() -> None:
    @asynccontextmanager
    async def link() -> AsyncIterator[Any]:
        copter = SimulatedCopter(boot_time_s=0.0)
        async with simulated_link(copter) as near:
            copter.call_later(3, raise_error)
            yield near

    async def main() -> None:
        context = link()  # Entered and exited by different tasks, as fixtures may be.
        near = await asyncio.create_task(context.__aenter__())
        async with aerokit.connect(near) as vehicle:
            with pytest.raises(LinkLost):
                await vehicle.armed.wait_until(bool, timeout=100)
        with pytest.raises(VehicleError):
            await asyncio.create_task(context.__aexit__(None, None, None))

    run_virtual(main())


def test_vehicle_error_is_raised_while_server_starts() -> None:
    async def main() -> None:
        copter = SimulatedCopter()
        copter.on_power_on(raise_error)
        with pytest.raises(VehicleError):
            async with simulated_link(copter):
                raise AssertionError("it went on")

    run_virtual(main())


def test_vehicle_error_keeps_block_error_as_context() -> None:
    """The context is checked inside the coroutine.

    `Future.result` raises the exception again, and Python then replaces its context by any exception that a frame
    around the event loop is handling.
    """

    async def main() -> None:
        copter = SimulatedCopter()
        with pytest.raises(VehicleError) as caught:
            async with SimulatorServer(copter, ()) as server:
                copter.call_later(0, raise_error)
                with pytest.raises(VehicleError):
                    server.wake()
                raise LookupError("the program's")
        assert isinstance(caught.value.__context__, LookupError)
        assert not caught.value.__suppress_context__

    run_virtual(main())


def test_error_of_datagram_callback_is_raised_by_server() -> None:
    def on_datagram(_now: float, _data: bytes, is_from_vehicle: bool) -> None:
        if not is_from_vehicle:
            raise_error()

    async def main() -> None:
        near, far = memory_link_pair()
        server = SimulatorServer(SimulatedCopter(), far)
        with pytest.raises(VehicleError):
            async with server, aerokit.connect(near):
                server.on_datagram = on_datagram
                await asyncio.sleep(10)
                raise AssertionError("it went on")

    run_virtual(main())


# ------------------------------------------------------------------------------------------ served


def test_vehicle_error_ends_blocking_call() -> None:
    with (
        pytest.raises(VehicleError),
        serve_flight() as flight,
        sync.connect(flight.address) as vehicle,
    ):
        vehicle.wait_ready()
        flight.simulated.on(messages.CommandLong, raise_error)
        vehicle.set_mode("GUIDED")


def test_vehicle_error_ends_polling_program() -> None:
    with pytest.raises(VehicleError), serve_flight() as flight:
        flight.faults.when(lambda here: here.time_s > 2 and failing_condition(here)).hang()
        while True:
            time.sleep(60)


def test_vehicle_error_ends_poll_if_ctrl_c_is_ignored() -> None:
    """Background jobs of shell scripts ignore Ctrl-C, and it must stay ignored."""
    before, has_continued = signal.signal(signal.SIGINT, signal.SIG_IGN), False
    try:
        with pytest.raises(VehicleError), serve_flight() as flight:
            signal.raise_signal(signal.SIGINT)
            flight.faults.when(lambda here: here.time_s > 2 and failing_condition(here)).hang()
            time.sleep(MAX_SLEEP_S)
            has_continued = True
        assert not has_continued
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_ctrl_c_raises_keyboard_interrupt() -> None:
    with pytest.raises(KeyboardInterrupt), serve_flight():
        raise KeyboardInterrupt


def test_failure_report_survives_vehicle_error() -> None:
    reports = []

    async def fly(fleet: SimulatedFleet) -> None:
        fleet[0].simulated.call_at(fleet[0].simulated.now, raise_error)  # It runs before the loop's next iteration.
        reports.append(failure_report([fleet], "a test", None))

    with pytest.raises(VehicleError):
        SimulatedFleet("copter").run(fly)
    assert "fails: VehicleError('in the vehicle')" in reports[0]


def test_interruption_at_block_edges_does_not_escape() -> None:
    """Without protection some of 300 attempts raise KeyboardInterrupt, which ends the whole pytest run."""
    before = signal.getsignal(signal.SIGINT)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(2e-6)
    try:
        for number in range(300):
            _fail_about_now(delay_s=number % 30 * 1e-5)
    finally:
        sys.setswitchinterval(interval)
    assert signal.getsignal(signal.SIGINT) is before


def _fail_about_now(delay_s: float) -> None:
    flight, ends = ServedFlight.__new__(ServedFlight), time.perf_counter() + delay_s
    flight._interruption, flight._server = Interruption(), cast(Any, SimpleNamespace(failure=None))

    def fail() -> None:
        _spin(ends)
        with contextlib.suppress(VehicleError), flight._interruption.on_error():
            flight._server.failure = VehicleError()
            raise flight._server.failure

    thread = threading.Thread(target=fail)
    thread.start()
    try:
        with contextlib.suppress(VehicleError), flight.raising_vehicle_errors():
            _spin(ends + 1e-5)
    except KeyboardInterrupt:
        pytest.fail("it escaped")
    thread.join()


def _spin(until: float) -> None:
    while time.perf_counter() < until:
        len("")
