"""Arguments of wrong types, for every public method: InvalidArgument names the argument, and nothing is sent."""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from flight_harness import Flight, in_the_air
from wrong_types import Misuse, misuses, misuses_of, refusal_of

import aerokit
from aerokit.connection.connection import Connection
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m

pytestmark = pytest.mark.anyio

OWNERS: dict[str, Callable[[aerokit.Vehicle], Any]] = {
    "vehicle": lambda vehicle: vehicle,
    "guided": lambda vehicle: vehicle.guided,
    "external": lambda vehicle: vehicle.external,
    "sticks": lambda vehicle: vehicle.sticks(),
    "stream": lambda vehicle: vehicle.guided.velocity(),
    "parameters": lambda vehicle: vehicle.parameters,
    "settings": lambda vehicle: vehicle.component(100).settings,
    "mission": lambda vehicle: vehicle.mission,
    "fence": lambda vehicle: vehicle.fence,
    "rally": lambda vehicle: vehicle.rally,
    "camera": lambda vehicle: vehicle.camera,
    "files": lambda vehicle: vehicle.files,
    "logs": lambda vehicle: vehicle.logs,
    "rtk": lambda vehicle: vehicle.rtk,
    "calibrate": lambda vehicle: vehicle.calibrate,
    "actuators": lambda vehicle: vehicle.actuators,
    "gripper": lambda vehicle: vehicle.gripper(),
    "winch": lambda vehicle: vehicle.winch(),
    "shell": lambda vehicle: vehicle.shell(),
    "cell": lambda vehicle: vehicle.position,
    "subscription": lambda vehicle: vehicle.subscribe(m.Heartbeat),
    "connection": lambda vehicle: vehicle.connection,
}
USED_BY_THE_LIBRARY = {
    "cell": frozenset({"set", "forget", "close"}),
    "subscription": frozenset({"close"}),
    "connection": frozenset(name for name in vars(Connection) if name.startswith("link_"))
    | {
        "attach",
        "bytes_received",
        "check_types",
        "close",
        "counts",
        "describe_signature_problems",
        "fail",
        "last_heartbeat_at",
        "received_from",
        "send_as",
    }
    | {"on_end", "record", "observe_frames", "observe_sent_frames", "order_refused", "hold_back", "is_held_back"}
    | {"member_link_changed", "member_link_open_failed", "member_link_stalled"},
}
"""Only called by the library itself."""


async def misuse_it(misuse: Misuse) -> BaseException | None:
    """Return the exception of a misuse; the call gets no time to act."""
    error: BaseException | None = None
    with anyio.move_on_after(1.0):
        try:
            made = misuse.call()
            if hasattr(made, "__aenter__"):
                async with made:
                    pass
            elif inspect.isawaitable(made):
                await made
            elif hasattr(made, "__enter__"):
                with made:
                    pass
        except Exception as raised:
            error = raised
    return error


@asynccontextmanager
async def quiet_flight() -> AsyncIterator[Flight]:
    async with in_the_air() as flight:
        await flight.vehicle.wait_ready()
        flight.wire.clear()
        yield flight


@pytest.mark.sampled(2)
@pytest.mark.parametrize("owner", OWNERS)
async def test_connection_unused_does_nothing(owner: str) -> None:
    async with quiet_flight() as flight:
        mode = flight.copter.mode.number
        wrong = []
        for misuse in misuses(OWNERS[owner](flight.vehicle), leave_out=USED_BY_THE_LIBRARY.get(owner, frozenset())):
            error = await misuse_it(misuse)
            wrong.append(refusal_of(misuse, error))
        assert not (found := list(filter(None, wrong))), "\n".join(found)
        received = [message for _, message in flight.wire.sent if not isinstance(message, m.Heartbeat)]
        assert received == []
        assert flight.copter.mode.number == mode
        assert flight.copter.is_armed


@pytest.mark.parametrize("function", [aerokit.connect, aerokit.open_connection])
async def test_connect_invalid_arguments_opens_nothing(function: Callable[..., Any]) -> None:
    wrong = [refusal_of(misuse, await misuse_it(misuse)) for misuse in misuses_of(function, function.__name__)]
    assert not (found := list(filter(None, wrong))), "\n".join(found)


@pytest.mark.parametrize("values", [{"RTL_ALT": "b"}, {1: 2.0}, {"RTL_ALT": None}, {"RTL_ALT": (1,)}])
async def test_values_of_parameters(values: Any) -> None:
    async with quiet_flight() as flight:
        parameters = flight.vehicle.parameters
        for call in (parameters.upload, parameters.diff, parameters.set_many):
            with pytest.raises(InvalidArgument):
                await call(values)
        assert [message for _, message in flight.wire.sent if not isinstance(message, m.Heartbeat)] == []


async def test_invalid_system_time_is_unknown() -> None:
    async with quiet_flight() as flight:
        with pytest.raises(InvalidArgument, match=r"timeout = .* is not allowed: it must be .* seconds above 0"):
            await flight.vehicle.set_mode("LOITER", timeout=10**400)
        assert not flight.wire.mode_orders()
