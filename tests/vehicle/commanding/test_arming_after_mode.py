"""arm() that changes the mode first, or was abandoned: orders that the program gives between its steps."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import anyio
import pytest
from flight_harness import Px4Flight, open_px4

from aerokit.errors import CommandTimeout, HeartbeatTimeout, OperationRejected
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import CommandLong
from aerokit.sim.px4.modes import RTL
from aerokit.testing.track import true_point

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def _in_rtl() -> AsyncIterator[Px4Flight]:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        flight.px4.switch_to(RTL)
        await anyio.sleep(2.0)
        flight.wire.clear()
        yield flight


def _has_arm_command(flight: Px4Flight) -> bool:
    sent = flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM)
    return any(isinstance(message, CommandLong) and message.param1 == 1 for message in sent)


async def test_disarm_while_the_mode_changes_ends_arm() -> None:
    async with _in_rtl() as flight:
        ended: list[BaseException] = []

        async def arm() -> None:
            try:
                await flight.vehicle.arm()
            except OperationRejected as error:
                ended.append(error)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(arm)
            await anyio.sleep(0.02)
            await flight.vehicle.disarm()
        assert "another arm or disarm command was given" in str(ended[0])
        assert not _has_arm_command(flight)
        assert not true_point(flight.px4).armed


async def test_arm_vehicle_silent_after_mode_change_sends_no_arm() -> None:
    async with _in_rtl() as flight:

        def cut(_: object, mode: object) -> None:
            flight.px4.faults.silent = True

        end = flight.vehicle.mode.observe(cut)
        with pytest.raises(HeartbeatTimeout, match="the arm command was not sent"):
            await flight.vehicle.arm()
        end()
        assert not _has_arm_command(flight)


async def test_raw_arm_after_abandoned_arm_stays_armed() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        flight.px4.faults.ignore(MavCmd.COMPONENT_ARM_DISARM)
        with pytest.raises(CommandTimeout):
            await flight.vehicle.arm()
        flight.px4.faults.commands.clear()
        with suppress(CommandTimeout):  # its answer is taken for an answer to an earlier order
            await flight.vehicle.command(MavCmd.COMPONENT_ARM_DISARM, 1)
        await anyio.sleep(5.0)
        assert true_point(flight.px4).armed
