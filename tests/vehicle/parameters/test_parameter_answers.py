"""Interpretation of the vehicle's answers: outcomes of writes, errors without a name, other spellings, late echoes."""

from __future__ import annotations

import math
from typing import Any

import anyio
import pytest
from flight_harness import Flight, open_flight

from aerokit.errors import OperationTimeout, ParameterRejected, ParameterTimeout
from aerokit.mavlink.messages import ParamError, ParamRequestRead, ParamSet, ParamValue
from aerokit.parameters import Parameter, ParameterType
from aerokit.vehicle.parameters.access import ParameterAccess
from aerokit.vehicle.parameters.writing import outcome_of

pytestmark = pytest.mark.anyio

INT, REAL = ParameterType.INT32, ParameterType.REAL32


@pytest.mark.parametrize(
    ("type_", "before", "wanted", "answer", "outcome"),
    [
        (INT, 1, 7, 7, "set"),
        (INT, 7, 7, 7, "unchanged"),
        (INT, None, 7, 7, "set"),
        (INT, 1, 7, 8, "clamped"),
        (INT, 1, 100, 50, "clamped"),
        (INT, 1, -7, 7, "clamped"),
        (INT, 1, 16_777_217, 16_777_216, "rounded"),
        (INT, 16_777_216, 16_777_217, 16_777_216, "rounded"),
        (REAL, 1.0, 100.0, 100.1, "rounded"),
        (REAL, 1.0, -100.0, -100.05, "rounded"),
        (REAL, 1.0, 100.0, 100.2, "clamped"),
        (REAL, 1.0, 0.0, 0.001, "clamped"),
    ],
)
def test_write_outcomes(type_: ParameterType, before: float | None, wanted: float, answer: float, outcome: str) -> None:
    known = None if before is None else Parameter("P", before, type_)
    written, reported = Parameter("P", wanted, type_), Parameter("P", answer, type_)
    assert outcome_of(written, known, reported, bytewise=False) == outcome


def test_unchanged_value_is_a_refusal() -> None:
    old = Parameter("P", 1, INT)
    error = outcome_of(Parameter("P", 7, INT), old, old, bytewise=False)
    assert isinstance(error, ParameterRejected)
    assert str(error).startswith("P = 7 was refused: the vehicle keeps 1")


@pytest.mark.parametrize(
    ("type_", "wanted", "kept", "text"),
    [
        (INT, 1234567, 1234568, "P = 1234567 was refused: the vehicle keeps 1234568"),
        (INT, 16777217, 16777216, "P = 16777217 was refused: the vehicle keeps 16777216"),
        (REAL, 0.1, math.nan, "P = 0.1 was refused: the vehicle keeps nan"),
    ],
)
def test_refusal_shows_all_digits(type_: ParameterType, wanted: float, kept: float, text: str) -> None:
    old = Parameter("P", kept, type_)
    error = outcome_of(Parameter("P", wanted, type_), old, old, bytewise=True)
    assert str(error) == text


async def test_param_error_without_name_is_ignored(grounded: Flight) -> None:
    """PX4 leaves arbitrary values in unused fields of PARAM_ERROR."""
    copter = grounded.copter
    on_read = copter.handlers[ParamRequestRead.ID]

    def doubtful(message: ParamRequestRead, channel: Any) -> None:
        copter.send(ParamError(255, 190, "", 7, 1))
        on_read(message, channel)

    copter.handlers[ParamRequestRead.ID] = doubtful
    assert await grounded.vehicle.parameters.get("LAND_SPEED", timeout=5) == 50
    assert (await grounded.vehicle.parameters.set("LAND_SPEED", 60, timeout=5)).outcome == "set"


async def test_read_times_out_if_only_one_name_is_rejected(grounded: Flight) -> None:
    """The vehicle may have the parameter under the name that it does not answer."""
    copter = grounded.copter

    def reject_new_name(message: ParamRequestRead, channel: Any) -> None:
        if message.param_id == "WP_SPD":
            copter.send(ParamError(255, 190, "WP_SPD", 0, 1))

    copter.handlers[ParamRequestRead.ID] = reject_new_name
    with pytest.raises(ParameterTimeout):
        await grounded.vehicle.parameters.get("WP_SPD", idle_timeout_s=2)


async def test_value_right_after_rejection_is_used(grounded: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    """After an outage, the answers to many requests arrive in a burst, the last of them after the rejection."""
    read = ParameterAccess.read

    async def read_too_late(access: ParameterAccess, names: Any, *args: Any, probe: bool = False) -> Any:
        answers = await read(access, names, *args, probe=probe)
        return {name: ParameterRejected("not answered", name=name) for name in names} if probe else answers

    monkeypatch.setattr(ParameterAccess, "read", read_too_late)
    assert await grounded.vehicle.parameters.get("LAND_SPEED") == grounded.copter.parameters["LAND_SPEED"]


async def test_ardupilot_names_are_sent_in_upper_case(grounded: Flight) -> None:
    parameters = grounded.vehicle.parameters
    assert (await parameters.set("land_speed", 60)).value == 60
    assert await parameters.get("Land_Speed") == 60
    assert "land_speed" not in parameters.table
    assert {write.param_id for write in grounded.wire.all(ParamSet)} == {"LAND_SPEED"}


async def test_echo_of_previous_write_confirms_nothing(grounded: Flight) -> None:
    """Write 1, 0, 1: the last PARAM_SET is lost, and a late echo of the first one arrives."""
    copter, parameters = grounded.copter, grounded.vehicle.parameters
    await parameters.set("LAND_SPEED", 61)
    await parameters.set("LAND_SPEED", 60)
    on_set = copter.handlers[ParamSet.ID]
    lost: list[ParamSet] = []

    def lose_first(message: ParamSet, channel: Any) -> None:
        if lost:
            on_set(message, channel)
        else:
            lost.append(message)
            copter.send(ParamValue("LAND_SPEED", 61, message.param_type, len(copter.parameters), 65535))

    copter.handlers[ParamSet.ID] = lose_first
    assert (await parameters.set("LAND_SPEED", 61)).outcome == "set"
    assert lost
    assert copter.parameters["LAND_SPEED"] == 61


async def test_late_value_during_other_writes_does_not_stay(grounded: Flight) -> None:
    """The late answer to a read arrives after the confirmation, but before those of the other parameters."""
    copter, parameters = grounded.copter, grounded.vehicle.parameters
    await parameters.download()
    on_set = copter.handlers[ParamSet.ID]

    def send_late_value(message: ParamSet, channel: Any) -> None:
        if message.param_id == "RTL_ALT":
            copter.send(ParamValue("LAND_SPEED", 50, message.param_type, len(copter.parameters), 65535))
        on_set(message, channel)

    copter.handlers[ParamSet.ID] = send_late_value
    await parameters.set_many({"LAND_SPEED": 61, "RTL_ALT": 2000})
    assert (await parameters.upload({"LAND_SPEED": 50}))["LAND_SPEED"].outcome == "set"
    await parameters.set_many({"LAND_SPEED": 61, "RTL_ALT": 2000})
    await anyio.sleep(1.5)
    assert parameters.table["LAND_SPEED"].value == copter.parameters["LAND_SPEED"] == 61


async def test_echo_of_cancelled_write_confirms_nothing(grounded: Flight) -> None:
    """Another station undoes a cancelled write. Its late echo arrives when the same value is written again."""
    copter, parameters = grounded.copter, grounded.vehicle.parameters
    await parameters.get("LAND_SPEED")
    on_set = copter.handlers[ParamSet.ID]
    lost: list[ParamSet] = []

    def lose_two(message: ParamSet, channel: Any) -> None:
        if len(lost) == 2:
            on_set(message, channel)
            return
        lost.append(message)
        if len(lost) == 2:
            copter.send(ParamValue("LAND_SPEED", 61, message.param_type, len(copter.parameters), 65535))

    copter.handlers[ParamSet.ID] = lose_two
    with pytest.raises(OperationTimeout):
        await parameters.set("LAND_SPEED", 61, timeout=0.01)
    assert (await parameters.set("LAND_SPEED", 61)).outcome == "set"
    assert copter.parameters["LAND_SPEED"] == 61


async def test_reads_after_early_answers_wait_for_slow_link() -> None:
    async with open_flight(latency_s=0.15) as flight:
        copter, parameters = flight.copter, flight.vehicle.parameters
        await anyio.sleep(3.0)
        for _ in range(20):  # Each PARAM_VALUE is sent before the request, and arrives after the request was sent.
            copter.send(ParamValue("RTL_ALT", 1500, ParameterType.REAL32, 1, 0))
            await anyio.sleep(0.14)
            await parameters.get("RTL_ALT")
        flight.wire.clear()
        await parameters.get("WPNAV_SPEED")
        assert len(set(flight.wire.times(ParamRequestRead))) == 1
