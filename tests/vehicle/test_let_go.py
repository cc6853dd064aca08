"""What a program is told of a vehicle that it lets go in flight without having meant to."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import in_the_air, open_flight

pytestmark = pytest.mark.anyio


async def test_a_cancelled_flight_says_that_the_vehicle_holds(caplog: pytest.LogCaptureFixture) -> None:
    with anyio.move_on_after(30) as scope:
        async with in_the_air() as flight:
            scope.deadline = anyio.current_time() + 2
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
    assert scope.cancelled_caught
    (record,) = [each for each in caplog.records if "let go" in each.message]
    assert (record.name, record.levelname) == ("aerokit", "WARNING")
    assert record.message.startswith("vehicle 1 is let go: holding in BRAKE, still armed, ")


async def test_a_mistake_of_the_program_in_flight(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with in_the_air():
            raise ZeroDivisionError
    assert "vehicle 1 is let go: in GUIDED, still armed, 10." in caplog.text


async def test_nothing_is_said_on_the_ground_or_when_it_was_meant(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ZeroDivisionError):
        async with open_flight() as flight:
            await flight.vehicle.wait_ready()
            raise ZeroDivisionError
    async with in_the_air():
        pass
    assert "let go" not in caplog.text
