"""Every public coroutine, cancelled at every await: it ends at once, without leaks.

Here a few of the awaits of each; `nox -s cancel` does all of them.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from call_stage import AUTOPILOTS, Stage, open_stage
from call_table import CALLS
from exhaustive import exhaustive
from public_surface import CLASSES, awaited, own_classes_in
from remains import check_remains, snapshot
from suspensions import Cancelled, Point, cancel_at, points_of

from aerokit.testing import run_virtual

POINTS = int(os.environ.get("AEROKIT_CANCEL_POINTS", "4"))
"""Number of awaits per call at which to cancel; 0: all. The default run has one, and few on PX4."""
ENDS_S = 2.0
BY_DEFAULT = {
    *((owner, "ardupilot") for owner in ("Vehicle", "Parameters", "MissionControl", "StateCell", "functions")),
    *((owner, "px4") for owner in ("Guided", "Camera")),
}


def test_public_coroutines_are_all_in_table() -> None:
    names = awaited()
    missing, unknown = sorted(names.keys() - CALLS), sorted(CALLS.keys() - names)
    assert not missing, (
        "add rows to tests/helpers/call_table.py, or, for outputs and devices, to DEVICE_CALLS or DEVICES in"
        f" device_calls.py: {missing}"
    )
    assert not unknown, f"remove these rows, there are no such coroutines: {unknown}"


def test_public_classes_are_all_covered(tmp_path: Path) -> None:
    async def find_classes() -> None:
        async with open_stage("ardupilot", tmp_path) as stage:
            missing = [cls for cls in own_classes_in(stage.vehicle) if cls not in CLASSES]
            assert not missing, f"add them to CLASSES in tests/calls/public_surface.py: {missing}"

    run_virtual(find_classes())


def groups() -> Iterator[tuple[str, list[str]]]:
    """One flight serves all calls of one class."""
    for owner in dict.fromkeys(name.rpartition(".")[0] for name in CALLS):
        yield owner or "functions", [name for name in CALLS if name.rpartition(".")[0] == owner]


def rows() -> Iterator[Any]:
    """Return each group on each autopilot; by default only some of them."""
    for owner, names in groups():
        for autopilot in AUTOPILOTS:
            row = pytest.param(names, autopilot, id=f"{owner}-{autopilot}")
            yield row if (owner, autopilot) in BY_DEFAULT else exhaustive(row)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("points", [2, exhaustive(POINTS)])
@pytest.mark.parametrize(("names", "autopilot"), list(rows()))
def test_cancelled_at_any_await(names: list[str], autopilot: str, points: int, tmp_path: Path) -> None:
    async def all_of_them() -> list[str]:
        async with open_stage(autopilot, tmp_path) as stage:
            return [fault for name in names async for fault in faults_of(stage, name, autopilot, points)]

    faults = run_virtual(all_of_them())
    assert not faults, "\n".join(faults)


async def faults_of(stage: Stage, name: str, autopilot: str, points: int) -> AsyncIterator[str]:
    if autopilot not in CALLS[name].on:
        return
    rehearsed = await run(stage, name, None)
    if rehearsed.error is not None or rehearsed.counted is None:
        yield (
            f"{name} does not work: {rehearsed.error!r}. If the simulated vehicle lacks the command, add it to"
            " sim/ardupilot/fixed_results.csv or sim/px4/commands.py"
        )
        return
    await check_remains(stage, snapshot(stage))
    await anyio.sleep(2.0)
    for point in points_of(rehearsed.counted.waits, points or None):
        fault = await fault_at(stage, name, point)
        if fault:
            yield f"{name} at {point} of {rehearsed.counted.count}: {fault}"


async def run(stage: Stage, name: str, point: Point | None) -> Cancelled:
    """Run it from its starting state, and restore everything afterwards."""
    call = CALLS[name]
    await call.place(stage)
    call.before(stage)
    outcome = await cancel_at(call.do(stage), point)
    call.after(stage)
    return outcome


async def fault_at(stage: Stage, name: str, point: Point) -> str:
    call = CALLS[name]
    await call.place(stage)
    before = snapshot(stage)
    call.before(stage)
    outcome = await cancel_at(call.do(stage), point)
    call.after(stage)
    if fault := fault_of(outcome, point):
        return fault
    left = await check_remains(stage, before)
    if left:
        return f"left are {dict(left)}"
    try:
        with anyio.fail_after(10):
            await stage.answers()
    except Exception as error:
        return f"then it does not work any more: {error!r}"
    return ""


def fault_of(outcome: Cancelled, point: Point) -> str:
    if outcome.at is None:
        return "" if outcome.error is None else f"ended with {outcome.error!r}"
    if outcome.ended_at - outcome.at > ENDS_S:
        return f"ended {outcome.ended_at - outcome.at:.1f} s after it was cancelled"
    if point.how == "scope":  # A shielded cleanup that completes at once is not cancelled.
        return "" if outcome.error is None else f"ended with {outcome.error!r}"
    ended = isinstance(outcome.error, asyncio.CancelledError)
    return "" if ended else f"swallowed the cancellation: {outcome.error!r}"
