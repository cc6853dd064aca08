"""Tasks beside a block: gone with it, and their mistakes are told."""

from __future__ import annotations

import asyncio
import sys

import anyio
import pytest

from aerokit.connection.tasks import Background, to_its_end

pytestmark = pytest.mark.anyio


async def test_they_run_until_the_end() -> None:
    background, ticks = Background(lambda error: pytest.fail(repr(error))), list[float]()

    async def tick() -> None:
        while True:
            ticks.append(anyio.current_time())
            await anyio.sleep(1)

    background.start(tick, "tick")
    await anyio.sleep(2.5)
    await background.aclose()
    await background.aclose()
    assert len(ticks) == 3
    assert len(background) == 0
    background.start(tick)
    await anyio.sleep(2)
    assert len(ticks) == 3


async def test_a_mistake_is_told_and_the_others_go_on() -> None:
    mistakes: list[Exception] = []
    background = Background(mistakes.append)

    async def fail() -> None:
        raise ZeroDivisionError("ours")

    background.start(anyio.sleep_forever)
    background.start(fail)
    await anyio.sleep(1)
    assert [repr(error) for error in mistakes] == ["ZeroDivisionError('ours')"]
    assert len(background) == 1
    await background.aclose()


async def test_whoever_ends_them_may_be_cancelled_meanwhile() -> None:
    """They are gone all the same, and the cancellation is not swallowed."""
    background, cleaned_up = Background(lambda error: pytest.fail(repr(error))), list[str]()

    async def slow_to_end() -> None:
        try:
            await anyio.sleep_forever()
        finally:
            with anyio.CancelScope(shield=True):
                await anyio.sleep(0.5)
            cleaned_up.append("yes")

    background.start(slow_to_end)
    await anyio.sleep(0.1)
    closing = asyncio.ensure_future(background.aclose())
    await anyio.sleep(0.1)
    closing.cancel()
    await anyio.sleep(0.1)
    closing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await closing
    assert cleaned_up == ["yes"]
    assert len(background) == 0


async def test_one_of_them_may_end_them_all() -> None:
    background = Background(lambda error: pytest.fail(repr(error)))

    async def end_all() -> None:
        background.cancel()
        await anyio.sleep_forever()

    background.start(anyio.sleep_forever)
    background.start(end_all)
    await anyio.sleep(0.1)
    assert len(background) == 0


# ------------------------------------------------------------------------- what must not be cut short


async def test_work_goes_to_its_end_however_often_its_caller_is_cancelled() -> None:
    done: list[str] = []

    async def work() -> None:
        for _ in range(5):
            await asyncio.sleep(0)
        done.append("done")

    task = asyncio.get_running_loop().create_task(to_its_end(work()))
    for _ in range(3):
        await asyncio.sleep(0)
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert done == ["done"]


async def test_what_such_work_raises_comes_out_and_is_the_cause_of_a_cancellation() -> None:
    async def work() -> None:
        await asyncio.sleep(0)
        raise ValueError("it did not work")

    with pytest.raises(ValueError, match="it did not work"):
        await to_its_end(work())
    task = asyncio.get_running_loop().create_task(to_its_end(work()))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError) as cancelled:
        await task
    raised: BaseException | None = cancelled.value
    if sys.version_info < (
        3,
        11,
    ):  # there, who awaits the task gets another CancelledError, and this one behind it
        raised = cancelled.value.__context__
    assert raised is not None
    assert isinstance(raised.__cause__, ValueError)
