"""A mistake inside a simulated vehicle: whoever waits for the vehicle is told at once, and the test fails with it."""

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
from aerokit.testing import Fleet, Flight, TrackPoint, run_virtual, serve_flight
from aerokit.testing.failure import what_was_flown
from aerokit.testing.interruption import Interruption
from aerokit.testing.served import ServedFlight

LIMIT_S = 100.0


class Mistake(Exception):
    pass


def make_one(*_: object) -> None:
    raise Mistake("in the vehicle")


def mistaken(here: TrackPoint) -> bool:
    raise Mistake(f"in a condition, {here}")


async def by_a_command(flight: Flight) -> None:
    flight.simulated.on(messages.CommandLong, make_one)
    await flight.vehicle.set_mode("GUIDED")


async def by_a_timer_while_nobody_waits(flight: Flight) -> None:
    flight.simulated.call_later(3, make_one)
    await asyncio.sleep(1000)


async def by_a_timer_among_tasks(flight: Flight) -> None:
    flight.simulated.call_later(3, make_one)
    async with anyio.create_task_group() as group:
        group.start_soon(anyio.sleep_forever)
        with anyio.move_on_after(10):
            await anyio.sleep_forever()
        raise AssertionError("it went on")


async def by_a_condition(flight: Flight) -> None:
    flight.faults.when(lambda here: here.time_s > 3 and mistaken(here)).hang()
    await asyncio.sleep(1000)


async def while_the_track_is_read(flight: Flight) -> None:
    flight.simulated.call_at(flight.simulated.now, make_one)
    assert flight.track.end
    raise AssertionError("it went on")


WAYS = [
    by_a_command,
    by_a_timer_while_nobody_waits,
    by_a_timer_among_tasks,
    by_a_condition,
    while_the_track_is_read,
]


@pytest.mark.parametrize("way", WAYS)
def test_it_comes_out_of_the_flight(way: Callable[[Flight], Awaitable[None]]) -> None:
    async def main() -> None:
        fleet = Fleet("copter")
        flight = fleet[0]
        with pytest.raises(Mistake):
            async with fleet.open():
                await flight.vehicle.wait_ready()
                await way(flight)
        assert flight.simulated.now < 6
        assert flight.track.end.time_s == pytest.approx(flight.simulated.now, abs=0.11)
        await asyncio.sleep(1)  # not cancelled any more

    run_virtual(main())


def test_it_comes_out_of_a_server_that_another_task_began() -> None:
    @asynccontextmanager
    async def link() -> AsyncIterator[Any]:
        copter = SimulatedCopter(boot_time_s=0.0)
        async with simulated_link(copter) as near:
            copter.call_later(3, make_one)
            yield near

    async def main() -> None:
        context = link()  # entered and left by tasks of their own, as fixtures may be
        near = await asyncio.create_task(context.__aenter__())
        async with aerokit.connect(near) as vehicle:
            with pytest.raises(LinkLost):
                await vehicle.armed.wait_until(bool, timeout=100)
        with pytest.raises(Mistake):
            await asyncio.create_task(context.__aexit__(None, None, None))

    run_virtual(main())


def test_it_comes_out_while_the_server_begins() -> None:
    async def main() -> None:
        copter = SimulatedCopter()
        copter.when_powered_on(make_one)
        with pytest.raises(Mistake):
            async with simulated_link(copter):
                raise AssertionError("it went on")

    run_virtual(main())


def test_what_the_block_raises_because_of_it_is_its_context() -> None:
    async def main() -> None:
        copter = SimulatedCopter()
        async with SimulatorServer(copter, ()) as server:
            copter.call_later(0, make_one)
            with pytest.raises(Mistake):
                server.wake()
            raise LookupError("the program's")

    with pytest.raises(Mistake) as caught:
        run_virtual(main())
    assert isinstance(caught.value.__context__, LookupError)


# ------------------------------------------------------------------------------------------ served


def test_a_blocking_call_ends() -> None:
    with (
        pytest.raises(Mistake),
        serve_flight() as flight,
        sync.connect(flight.address) as vehicle,
    ):
        vehicle.wait_ready()
        flight.simulated.on(messages.CommandLong, make_one)
        vehicle.set_mode("GUIDED")


def test_a_poll_ends() -> None:
    with pytest.raises(Mistake), serve_flight() as flight:
        flight.faults.when(lambda here: here.time_s > 2 and mistaken(here)).hang()
        while True:
            time.sleep(60)


def test_a_poll_ends_where_ctrl_c_is_ignored() -> None:
    """As in every background job of a script, where it must stay ignored."""
    before, went_on = signal.signal(signal.SIGINT, signal.SIG_IGN), False
    try:
        with pytest.raises(Mistake), serve_flight() as flight:
            signal.raise_signal(signal.SIGINT)
            flight.faults.when(lambda here: here.time_s > 2 and mistaken(here)).hang()
            time.sleep(LIMIT_S)
            went_on = True
        assert not went_on
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_ctrl_c_is_still_ctrl_c() -> None:
    with pytest.raises(KeyboardInterrupt), serve_flight():
        raise KeyboardInterrupt


def test_a_vehicle_that_fails_while_its_story_is_told_does_not_hide_the_failure() -> None:
    stories = []

    async def fly(fleet: Fleet) -> None:
        fleet[0].simulated.call_at(fleet[0].simulated.now, make_one)  # before the loop has a turn
        stories.append(what_was_flown([fleet], "a test", None))

    with pytest.raises(Mistake):
        Fleet("copter").run(fly)
    assert "fails: Mistake('in the vehicle')" in stories[0]


def test_an_interruption_while_a_block_is_entered_or_left_does_not_escape_it() -> None:
    """Without care some of three hundred come out as KeyboardInterrupt, which ends the whole run of pytest."""
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
        with contextlib.suppress(Mistake), flight._interruption.at_an_error():
            flight._server.failure = Mistake()
            raise flight._server.failure

    thread = threading.Thread(target=fail)
    thread.start()
    try:
        with contextlib.suppress(Mistake), flight.failing_at_once():
            _spin(ends + 1e-5)
    except KeyboardInterrupt:
        pytest.fail("it escaped")
    thread.join()


def _spin(until: float) -> None:
    while time.perf_counter() < until:
        len("")
