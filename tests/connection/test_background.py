"""Background tasks of a block: they end with it, and their exceptions are reported."""

from __future__ import annotations

import asyncio
import sys

import anyio
import pytest

from aerokit.connection.tasks import BackgroundTasks, run_shielded

pytestmark = pytest.mark.anyio


async def test_tasks_run_until_cancelled() -> None:
    background, ticks = BackgroundTasks(lambda error: pytest.fail(repr(error))), list[float]()

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


async def test_exception_is_reported_and_other_tasks_continue() -> None:
    mistakes: list[Exception] = []
    background = BackgroundTasks(mistakes.append)

    async def fail() -> None:
        raise ZeroDivisionError("ours")

    background.start(anyio.sleep_forever)
    background.start(fail)
    await anyio.sleep(1)
    assert [repr(error) for error in mistakes] == ["ZeroDivisionError('ours')"]
    assert len(background) == 1
    await background.aclose()


async def test_aclose_survives_cancellation_of_its_caller() -> None:
    """The tasks end nevertheless, and the cancellation is not suppressed."""
    background, cleaned_up = BackgroundTasks(lambda error: pytest.fail(repr(error))), list[str]()

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


async def test_task_may_cancel_all_tasks() -> None:
    background = BackgroundTasks(lambda error: pytest.fail(repr(error)))

    async def end_all() -> None:
        background.cancel()
        await anyio.sleep_forever()

    background.start(anyio.sleep_forever)
    background.start(end_all)
    await anyio.sleep(0.1)
    assert len(background) == 0


# -------------------------------------------------------------------------------------- shielded work


async def test_run_shielded_finishes_despite_repeated_cancellation() -> None:
    done: list[str] = []

    async def work() -> None:
        for _ in range(5):
            await asyncio.sleep(0)
        done.append("done")

    task = asyncio.get_running_loop().create_task(run_shielded(work()))
    for _ in range(3):
        await asyncio.sleep(0)
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert done == ["done"]


async def test_run_shielded_exception_becomes_cause_of_cancellation() -> None:
    async def work() -> None:
        await asyncio.sleep(0)
        raise ValueError("it did not work")

    with pytest.raises(ValueError, match="it did not work"):
        await run_shielded(work())
    task = asyncio.get_running_loop().create_task(run_shielded(work()))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError) as cancelled:
        await task
    raised: BaseException | None = cancelled.value
    if sys.version_info < (
        3,
        11,
    ):  # there, the awaiting code gets a new CancelledError, with this one as its context
        raised = cancelled.value.__context__
    assert raised is not None
    assert isinstance(raised.__cause__, ValueError)
