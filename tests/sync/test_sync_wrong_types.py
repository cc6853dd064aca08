"""The same in the blocking twin: arguments of wrong types end in our error, and nothing is sent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from served_copter import served
from wrong_types import Misuse, misuses, misuses_of, refusal_of

import aerokit.sync
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.sim import SimulatedCopter
from aerokit.testing.journal import Journal

OWNERS: dict[str, Callable[[aerokit.sync.Vehicle], Any]] = {
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
    "cell": lambda vehicle: vehicle.position,
    "subscription": lambda vehicle: vehicle.subscribe(m.Heartbeat),
    "connection": lambda vehicle: vehicle.connection,
}
LEFT_OUT = {"subscription": frozenset({"close"}), "connection": frozenset({"counts"})}
ASKED_BY_ITSELF = (m.Heartbeat, m.CommandLong, m.Timesync)
"""Messages that a vehicle object sends by itself: requests of version and rates."""


@pytest.fixture(scope="module")
def flight() -> Iterator[tuple[aerokit.sync.Vehicle, Journal]]:
    copter = SimulatedCopter(boot_time_s=0.0)
    with served([copter]) as address, aerokit.sync.connect(address, rates={}) as vehicle:
        copter.journal = journal = Journal()
        yield vehicle, journal


def misuse_it(misuse: Misuse) -> BaseException | None:
    try:
        made = misuse.call()
        if hasattr(made, "__enter__"):
            with made:
                pass
    except Exception as error:
        return error
    return None


@pytest.mark.parametrize("owner", OWNERS)
def test_wrong_types_are_rejected_and_nothing_sent(owner: str, flight: tuple[aerokit.sync.Vehicle, Journal]) -> None:
    vehicle, journal = flight
    left_out = LEFT_OUT.get(owner, frozenset())
    wrong = [refusal_of(misuse, misuse_it(misuse)) for misuse in misuses(OWNERS[owner](vehicle), leave_out=left_out)]
    assert not (found := list(filter(None, wrong))), "\n".join(found)
    kinds = {type(entry.message) for entry in journal.messages}
    assert kinds <= set(ASKED_BY_ITSELF)


@pytest.mark.parametrize("function", [aerokit.sync.connect, aerokit.sync.open_connection])
def test_wrong_types_open_no_link(function: Callable[..., Any]) -> None:
    wrong = [refusal_of(misuse, misuse_it(misuse)) for misuse in misuses_of(function, function.__name__)]
    assert not (found := list(filter(None, wrong))), "\n".join(found)


def test_fleet_checks_literals_by_value() -> None:
    options: dict[str, Any] = {"on_error": "land_others", "on_error_by_group": {"": "continue_others"}}
    with pytest.raises(InvalidArgument, match="count = 0"):  # the arguments before are accepted
        aerokit.sync.fleet("udp:127.0.0.1:0", count=0, min_distance_m=5, on_too_close="report", **options)
    with pytest.raises(InvalidArgument, match="on_error = 'land' is not allowed: it must be one of hold_others,"):
        aerokit.sync.fleet("udp:127.0.0.1:0", on_error="land")  # type: ignore[arg-type]


def test_mapping_with_wrong_key_error_names_allowed_keys() -> None:
    with pytest.raises(InvalidArgument, match="must be a mapping from a class of Message to a number"):
        aerokit.sync.fleet("udp:127.0.0.1:0", rates={"ATTITUDE": 10.0})  # type: ignore[dict-item]
