"""Every call of the blocking twin, interrupted by Ctrl-C at its first await, at a later one and at its end.

Its task has ended when KeyboardInterrupt leaves it, and nothing is left of it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import anyio
import pytest
from blocking_calls import blocking_calls, blocking_names
from call_stage import LOGS, Stage, stage_cameras
from call_table import CALLS, Call
from exhaustive import exhaustive
from interrupter import AT_ITS_END, Interrupter
from remains import snapshot
from served_copter import served

import aerokit.sync
from aerokit import messages
from aerokit.errors import AerokitError
from aerokit.sim import SimulatedCopter

LATER = 4
"""Interrupted a second time at this await, if it comes there, and a third time when it has ended."""
REBOOTING_S = 2.0
SLOW = ("Vehicle.reboot", "Vehicle.why_not_armable")
ENDURING_MAH = 1e6
"""It flies by the clock of the wall, twenty times as fast, until this machine is through with all calls."""
PATIENCE_S = 200.0
"""Seconds for pending work: an abandoned arm command is monitored, and acknowledged."""


@dataclass
class BlockingStage(Stage):
    """A stage with the blocking vehicle."""

    address: str = ""


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[BlockingStage, Stage]]:
    """Stages for the blocking calls, and for the work on their loop."""
    copter = SimulatedCopter(
        boot_time_s=0.0,
        logs=LOGS,
        battery_capacity_mah=ENDURING_MAH,
        parameters={"BATT_CAPACITY": ENDURING_MAH},
        components=(cameras := stage_cameras()),
    )
    folder = tmp_path_factory.mktemp("calls")
    with (
        served([copter], "tcpin:127.0.0.1:0", "tcpin:127.0.0.1:0") as address,
        aerokit.sync.connect(address, reconnect=True) as vehicle,
    ):
        vehicle.wait_ready()
        blocking = BlockingStage(copter, cast(Any, vehicle), cast(Any, None), folder, cameras[0], address=address)
        blocking.put(blocking.file)
        vehicle.message(messages.ScaledPressure)  # for as long as the vehicle lives
        vehicle.camera.wait_found()
        vehicle.component(100).message(messages.CameraSettings)
        _ = vehicle.component(100).settings
        vehicle.camera_at(101)
        yield blocking, Stage(copter, vehicle.aio, cast(Any, None), folder, cameras[0])


def test_blocking_calls_are_all_in_table() -> None:
    calls, names = blocking_calls(), set(blocking_names())
    missing, unknown = sorted(names - calls.keys()), sorted(calls.keys() - names)
    assert not missing, f"add rows to tests/helpers/call_table.py or tests/calls/blocking_calls.py: {missing}"
    assert not unknown, f"remove these rows, there are no such calls: {unknown}"


def rows() -> list[Any]:
    """Return each call; by default some of them, and none that waits for long."""
    return [exhaustive(name) if place % 28 or name in SLOW else name for place, name in enumerate(blocking_calls())]


@pytest.mark.parametrize("name", rows())
def test_interrupted(name: str, stages: tuple[BlockingStage, Stage], monkeypatch: pytest.MonkeyPatch) -> None:
    blocking, stage = stages
    call = CALLS.get(name, Call(cast(Any, blocking_calls()[name])))
    if "ardupilot" not in call.on:
        pytest.skip("the copter does not know it")
    loop, do = cast(Any, blocking.vehicle)._loop, blocking_calls()[name]
    interrupter = Interrupter(monkeypatch)

    def attempt() -> None:
        with contextlib.suppress(AerokitError):
            do(blocking)

    threads = threading.active_count()
    for at in (1, LATER, AT_ITS_END):
        loop.run(call.place, stage)
        before = loop.call(snapshot, stage)
        call.before(stage)
        was_interrupted = interrupter.interrupted(attempt, at)
        assert was_interrupted or at != AT_ITS_END
        call.after(stage)
        if name == "Vehicle.reboot":  # The vehicle may be rebooting, although the call was interrupted.
            loop.run(anyio.sleep, REBOOTING_S)
        assert (_left(loop, stage, before), at) == (Counter(), at)
        loop.run(stage.answers)
    assert threading.active_count() == threads


def _left(loop: Any, stage: Stage, before: Counter[str]) -> Counter[str]:
    patience = time.monotonic() + PATIENCE_S
    while (left := loop.call(snapshot, stage) - before) and time.monotonic() < patience:
        time.sleep(0.01)
    return Counter(left)
