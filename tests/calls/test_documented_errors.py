"""Every error that a docstring promises is provoked; the list of them is made from the docstrings."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import anyio
import pytest
from calibration_calls import CALIBRATIONS
from call_stage import Stage, open_stage
from call_table import provocations
from camera_calls import CAMERA
from component_calls import COMPONENTS
from device_calls import DEVICE_ERRORS
from documented_errors import NAMES, documented
from exhaustive import exhaustive
from provoked import Provocation
from provoked_flight import FLIGHT
from provoked_gimbals import GIMBALS
from provoked_settings import SETTINGS
from provoked_transfers import TRANSFERS
from public_surface import CLASSES
from rtk_calls import RTK
from stream_calls import stream_provocations

from aerokit import errors
from aerokit.connection.bus import Subscription
from aerokit.connection.cells import StateCell
from aerokit.connection.connection import Connection
from aerokit.sim.faults import Faults
from aerokit.testing import run_virtual

PROVOCATIONS = {
    **provocations(),
    **FLIGHT,
    **GIMBALS,
    **TRANSFERS,
    **SETTINGS,
    **CAMERA,
    **COMPONENTS,
    **DEVICE_ERRORS,
    **CALIBRATIONS,
    **RTK,
    **stream_provocations(),
}
PROMISED = documented()
MAX_WAIT_S = 200.0
BY_DEFAULT = ("Vehicle", "Guided", "Parameters", "MissionControl", "Files", "Gimbal")


def test_each_documented_error_is_provoked() -> None:
    missing = sorted(PROMISED - PROVOCATIONS.keys())
    assert not missing, (
        "the docstrings promise these errors, by name or by 'Raises as :meth:': provoke each in one of the tables in"
        f" PROVOCATIONS, such as DEVICE_ERRORS of tests/helpers/device_calls.py, or remove the promise: {missing}"
    )


@pytest.mark.parametrize("cls", [cls for cls in CLASSES if cls not in (Connection, StateCell, Subscription)])
def test_public_methods_check_their_arguments(cls: type) -> None:
    """The three classes left out check single methods, because the library itself calls the others often."""
    methods = {name: value for name, value in vars(cls).items() if name[0] != "_" and inspect.isfunction(value)}
    with_arguments = {name: method for name, method in methods.items() if len(inspect.signature(method).parameters) > 1}
    assert not [name for name, method in with_arguments.items() if not hasattr(method, "__wrapped__")]


def groups() -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """One vehicle serves all calls of one class, except those that leave it unusable."""
    for owner in sorted({name.partition(".")[0] for name, _ in PROMISED & PROVOCATIONS.keys()}):
        yield (
            owner,
            sorted(pair for pair in PROMISED & PROVOCATIONS.keys() if pair[0].partition(".")[0] == owner),
        )


def rows() -> Iterator[Any]:
    for owner, pairs in groups():
        row = pytest.param(pairs, id=owner)
        yield row if owner in BY_DEFAULT else exhaustive(row)


@pytest.mark.sampled(6)
@pytest.mark.parametrize("pairs", list(rows()))
def test_documented_errors_are_raised(pairs: list[tuple[str, str]], tmp_path: Path) -> None:
    faults = run_virtual(faults_of(pairs, tmp_path))
    assert not faults, "\n".join(faults)


async def faults_of(pairs: list[tuple[str, str]], folder: Path) -> list[str]:
    """Return the errors that were not provoked; calls on one autopilot share a flight."""
    found = []
    for on in ("ardupilot", "px4"):
        together = [pair for pair in pairs if PROVOCATIONS[pair].on == on and not PROVOCATIONS[pair].alone]
        alone = [[pair] for pair in pairs if PROVOCATIONS[pair].on == on and PROVOCATIONS[pair].alone]
        for group in filter(None, [together, *alone]):
            async with AsyncExitStack() as stack:
                stage = await stack.enter_async_context(open_stage(on, folder))
                for pair in group:
                    found += [f"{pair}: {fault}" for fault in await fault_of(stage, *pair)]
    return found


async def fault_of(stage: Stage, name: str, error: str) -> list[str]:
    row: Provocation = PROVOCATIONS[name, error]
    handlers = dict(stage.simulated.handlers)
    try:
        await row.place(stage)
        row.before(stage)
        with anyio.fail_after(MAX_WAIT_S):
            await row.do(stage)
    except Exception as raised:
        return [] if is_it(raised, name, error) else [f"raised {type(raised).__name__}: {raised}"]
    finally:
        if not row.alone:
            stage.simulated.faults = Faults()
            stage.camera.faults = Faults()
            stage.simulated.handlers.update(handlers)
            with anyio.CancelScope(shield=True):
                await settle(stage)
    return ["raised nothing"]


async def settle(stage: Stage) -> None:
    """Wait until the vehicle is received again, pending confirmations have arrived, and it stands."""
    await anyio.sleep(4.0)
    await stage.vehicle.home.wait_until(lambda _: True, timeout=30)
    stage.vehicle._arm_cleanup.stop_watching()


def is_it(raised: Exception, name: str, error: str) -> bool:
    """Return True if this is the documented error, or a subclass of it that is not documented separately."""
    known = {cls.__name__ for cls in type(raised).__mro__} & NAMES
    return error in known and not any(
        (name, member) in PROMISED and member != error and issubclass(getattr(errors, member, OSError), _class(error))
        for member in known
    )


def _class(error: str) -> type:
    return getattr(errors, error, OSError)
