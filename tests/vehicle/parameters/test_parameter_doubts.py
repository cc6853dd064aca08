"""Answers about parameters that are not what they seem: errors without a name, other spellings, late echoes."""

from __future__ import annotations

from typing import Any

import pytest
from flight_harness import Flight

from aerokit.mavlink.messages import ParamError, ParamRequestRead, ParamSet, ParamValue

pytestmark = pytest.mark.anyio


async def test_an_error_without_a_name_ends_nothing(grounded: Flight) -> None:
    """PX4 fills the fields of PARAM_ERROR that it does not use with anything."""
    copter = grounded.copter
    on_read = copter.handlers[ParamRequestRead.ID]

    def doubtful(message: ParamRequestRead, channel: Any) -> None:
        copter.send(ParamError(255, 190, "", 7, 1))
        on_read(message, channel)

    copter.handlers[ParamRequestRead.ID] = doubtful
    assert await grounded.vehicle.parameters.get("LAND_SPEED", timeout=5) == 50
    assert (await grounded.vehicle.parameters.set("LAND_SPEED", 60, timeout=5)).outcome == "set"


async def test_ardupilot_is_asked_in_capitals(grounded: Flight) -> None:
    parameters = grounded.vehicle.parameters
    assert (await parameters.set("land_speed", 60)).value == 60
    assert await parameters.get("Land_Speed") == 60
    assert "land_speed" not in parameters.table
    assert {each.param_id for each in grounded.wire.all(ParamSet)} == {"LAND_SPEED"}


async def test_an_echo_of_the_write_before_confirms_nothing(grounded: Flight) -> None:
    """1, 0, 1 in a row, and the last PARAM_SET is lost while an echo of the first one comes late."""
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
