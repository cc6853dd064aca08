"""A signing vehicle, connected to without a key: every public call that times out says so in its first line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from call_stage import AUTOPILOTS, Stage, open_stage
from call_table import CALLS
from test_cancellation import groups

from aerokit.connection.cells import StateCell
from aerokit.errors import AerokitError, OperationTimeout
from aerokit.mavlink.signing import SigningKey
from aerokit.testing import run_virtual

KEY = SigningKey.from_passphrase("another one's")
HEARTBEAT_S = 1.5
MAX_WAIT_S = 400.0
WHY = "frames are signed and no key was given"


@pytest.mark.sampled(21)
@pytest.mark.parametrize(
    ("names", "autopilot"),
    [
        pytest.param(names, autopilot, id=f"{owner}-{autopilot}")
        for owner, names in groups()
        if owner != "External"  # its streams have no time-out
        for autopilot in AUTOPILOTS
    ],
)
def test_timeout_with_rejected_signatures_says_so(names: list[str], autopilot: str, tmp_path: Path) -> None:
    async def all_of_them() -> dict[str, str]:
        texts: dict[str, str] = {}
        async with open_stage(autopilot, tmp_path) as stage:
            for name in names:
                if autopilot in CALLS[name].on:
                    texts[name] = await timeout_of(stage, name)
        return texts

    texts = run_virtual(all_of_them())
    silent = {name: text for name, text in texts.items() if text and WHY not in text.splitlines()[0]}
    assert not silent, "\n".join(f"{name}: {text}" for name, text in silent.items())


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_cell_timeout_with_rejected_signatures_says_so(autopilot: str, tmp_path: Path) -> None:
    async def wait_for_each() -> dict[str, str]:
        async with open_stage(autopilot, tmp_path) as stage:
            sign(stage, KEY)
            await anyio.sleep(HEARTBEAT_S)
            return {name: await text_of(cell) for name, cell in cells_of(stage)}

    texts = run_virtual(wait_for_each())
    assert len(texts) > 40
    assert [name for name, text in texts.items() if WHY not in text] == []


def cells_of(stage: Stage) -> Iterator[tuple[str, StateCell[Any]]]:
    vehicle = stage.vehicle
    for part in (
        vehicle,
        vehicle.mission,
        vehicle.camera,
        vehicle.gimbal,
        vehicle.gimbals,
        vehicle.component(100),
    ):
        for name in dir(part):
            if not name.startswith("_") and isinstance(cell := getattr(part, name), StateCell):
                yield f"{type(part).__name__}.{name}", cell


async def text_of(cell: StateCell[Any]) -> str:
    try:
        await cell.wait_until(lambda _: False, timeout=0.1)
    except OperationTimeout as error:
        return str(error)
    return ""


async def timeout_of(stage: Stage, name: str) -> str:
    """Return the text of the call's time-out; empty if it ends otherwise."""
    call = CALLS[name]
    await call.place(stage)
    call.before(stage)
    sign(stage, KEY)
    await anyio.sleep(HEARTBEAT_S)
    try:
        with anyio.move_on_after(MAX_WAIT_S):
            await call.do(stage)
    except OperationTimeout as error:
        return str(error)
    except AerokitError:
        pass
    finally:
        call.after(stage)
        sign(stage, None)
        with anyio.CancelScope(shield=True):
            await anyio.sleep(HEARTBEAT_S)
    return ""


def sign(stage: Stage, key: SigningKey | None) -> None:
    stage.simulated.signing.key = key
    stage.simulated.signing.trusts_first_port = key is None  # ArduPilot trusts its first port, which may be USB.
    stage.simulated.signing.load()
