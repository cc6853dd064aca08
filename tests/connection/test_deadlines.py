"""Deadlines: many on one timer, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from aerokit.connection.tasks import Deadlines
from aerokit.testing import run_virtual


class Alarms:
    """Deadlines whose alarms note their name and the time."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._began = self._loop.time()
        self.deadlines = Deadlines()
        self.rung: list[tuple[str, float]] = []

    def at(self, name: str, seconds: float) -> Callable[[], None]:
        def alarm() -> None:
            self.rung.append((name, round(self._loop.time() - self._began, 6)))

        self.move(alarm, seconds)
        return alarm

    def move(self, alarm: Callable[[], None], seconds: float) -> None:
        self.deadlines.set(alarm, self._began + seconds)

    def timers(self) -> int:
        scheduled: list[asyncio.TimerHandle] = self._loop._scheduled  # type: ignore[attr-defined]
        return sum("_fire" in repr(timer) and not timer.cancelled() for timer in scheduled)


def test_alarms_fire_once_at_their_time_in_any_order() -> None:
    async def program() -> None:
        alarms = Alarms()
        for name, seconds in (("third", 3.0), ("first", 1.0), ("second", 2.0), ("second too", 2.0)):
            alarms.at(name, seconds)
        assert alarms.timers() == 1
        await asyncio.sleep(10)
        assert alarms.rung == [("first", 1.0), ("second", 2.0), ("second too", 2.0), ("third", 3.0)]
        assert alarms.timers() == 0

    run_virtual(program())


def test_cancelled_alarm_does_not_fire() -> None:
    async def program() -> None:
        alarms = Alarms()
        first = alarms.at("first", 1.0)
        alarms.at("second", 2.0)
        alarms.deadlines.cancel(first)
        alarms.deadlines.cancel(first)
        await asyncio.sleep(10)
        assert alarms.rung == [("second", 2.0)]

    run_virtual(program())


def test_alarm_set_again_fires_at_the_new_time() -> None:
    async def program() -> None:
        alarms = Alarms()
        alarms.move(alarms.at("later", 1.0), 4.0)
        alarms.move(alarms.at("earlier", 3.0), 2.0)
        await asyncio.sleep(10)
        assert alarms.rung == [("earlier", 2.0), ("later", 4.0)]

    run_virtual(program())


def test_alarm_may_set_and_cancel_others() -> None:
    async def program() -> None:
        alarms = Alarms()
        other = alarms.at("other", 2.0)

        def alarm() -> None:
            alarms.deadlines.cancel(other)
            alarms.at("next", 1.5)

        alarms.move(alarm, 1.0)
        await asyncio.sleep(10)
        assert alarms.rung == [("next", 1.5)]

    run_virtual(program())


def test_alarm_may_postpone_another_that_is_due() -> None:
    async def program() -> None:
        alarms = Alarms()
        other: list[Callable[[], None]] = []

        def alarm() -> None:
            alarms.move(other[0], 3.0)

        alarms.move(alarm, 1.0)
        other.append(alarms.at("other", 1.0))
        await asyncio.sleep(10)
        assert alarms.rung == [("other", 3.0)]

    run_virtual(program())


def test_alarm_that_raises_does_not_stop_others() -> None:
    async def program() -> None:
        reported: list[object] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context["exception"]))
        alarms = Alarms()
        error = RuntimeError("an alarm's error")

        def alarm() -> None:
            raise error

        alarms.move(alarm, 1.0)
        alarms.at("same time", 1.0)
        alarms.at("later", 2.0)
        await asyncio.sleep(10)
        assert reported == [error]
        assert alarms.rung == [("same time", 1.0), ("later", 2.0)]

    run_virtual(program())


def test_alarm_that_sets_itself_does_not_delay_others() -> None:
    async def program() -> None:
        alarms = Alarms()
        times = 0

        def again() -> None:
            nonlocal times
            times += 1
            if times < 3:
                alarms.move(again, 1.0 + 5 * times)

        alarms.move(again, 1.0)
        alarms.at("soon", 1.5)
        await asyncio.sleep(20)
        assert (times, alarms.rung) == (3, [("soon", 1.5)])

    run_virtual(program())


def test_answered_requests_use_one_timer_that_close_removes() -> None:
    async def program() -> None:
        alarms = Alarms()
        for number in range(100):
            alarms.deadlines.cancel(alarms.at("answered", 1.0 + number))
        assert alarms.timers() == 1
        alarms.at("open", 1.0)
        alarms.deadlines.close()
        assert alarms.timers() == 0
        await asyncio.sleep(10)
        assert alarms.rung == []

    run_virtual(program())


def test_past_deadlines_fire_on_uvloop() -> None:
    uvloop = pytest.importorskip("uvloop")
    rung: list[str] = []

    async def main() -> None:
        deadlines, now = Deadlines(), asyncio.get_running_loop().time()
        deadlines.set(lambda: rung.append("first"), now - 1.0)
        deadlines.set(lambda: rung.append("second"), now - 2.0)
        deadlines.set(lambda: rung.append("third"), now + 0.01)
        last = asyncio.Event()
        deadlines.set(last.set, now + 0.02)
        await asyncio.wait_for(last.wait(), 5.0)

    loop = uvloop.new_event_loop()
    loop.run_until_complete(main())
    loop.close()
    assert sorted(rung) == ["first", "second", "third"]
