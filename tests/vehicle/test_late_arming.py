"""An order to arm that was given up: what is watched afterwards, and what is left alone."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import Flight

from aerokit.errors import CommandTimeout
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.vehicle.orders.late_arming import LATE_S

pytestmark = pytest.mark.anyio

ARM = MavCmd.COMPONENT_ARM_DISARM


def ordered(flight: Flight) -> list[float]:
    """1 for each order to arm that was sent, 0 for each to disarm."""
    return [each.param1 for each in flight.wire.commands(ARM)]


async def test_who_arms_after_it_was_given_up_is_disarmed(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    await anyio.sleep(5.0)
    assert ordered(grounded) == [1, 0]
    assert not grounded.copter.is_armed


async def test_only_what_is_told_after_it_was_given_up_counts(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.lose_ack(ARM)
    scope = anyio.CancelScope()
    detach = grounded.vehicle.armed.observe(lambda _, armed: scope.cancel())
    with scope:
        await grounded.vehicle.arm()
    assert scope.cancelled_caught
    detach()
    assert grounded.vehicle.is_armed
    grounded.copter.arming.disarm()  # somebody else, before another heartbeat
    await anyio.sleep(5.0)
    assert ordered(grounded) == [1]


@pytest.mark.parametrize("ends", ["cancelled", "unanswered"])
async def test_who_was_armed_before_is_left_alone(flying: Flight, ends: str) -> None:
    """It flies: that it is armed is nothing that this order has done."""
    if ends == "cancelled":
        with anyio.move_on_after(0.0):
            await flying.vehicle.arm()
    else:
        flying.copter.faults.ignore(ARM)
        with pytest.raises(CommandTimeout):
            await flying.vehicle.arm()
    await anyio.sleep(20.0)
    assert ordered(flying).count(0) == 0


async def test_disarming_goes_on_when_the_time_to_watch_ends(grounded: Flight) -> None:
    """It armed in the last moment, and the first order to disarm is lost."""
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.ignore(ARM)
    told_at = grounded.vehicle.armed.updated_at
    await grounded.vehicle.armed.wait_until(lambda _: grounded.vehicle.armed.updated_at > told_at)
    await anyio.sleep(0.7)  # of the second from one heartbeat to the next
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    await anyio.sleep(LATE_S - 1.0)
    assert grounded.copter.arming.arm()
    await anyio.sleep(1.0)
    assert grounded.vehicle.is_armed
    assert ordered(grounded) == [1, 0]
    grounded.copter.faults.commands.clear()
    await anyio.sleep(3.0)
    assert ordered(grounded) == [1, 0, 0]
    assert not grounded.copter.is_armed


async def test_who_cannot_be_disarmed_again_is_told_of(
    grounded: Flight, caplog: pytest.LogCaptureFixture
) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    await grounded.vehicle.armed.wait_until(bool, timeout=5)
    grounded.copter.faults.refuse(ARM, MavResult.FAILED)
    await anyio.sleep(5.0)
    (record,) = [each for each in caplog.records if each.levelname == "ERROR"]
    assert "the vehicle armed after the order was given up, and could not be disarmed" in record.message
    assert grounded.copter.is_armed
