"""Cameras and gimbals of several vehicles on one link: each program reaches its own."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import NamedTuple

import anyio
import pytest

import aerokit
from aerokit import messages as m
from aerokit.connection.connection import Connection
from aerokit.connection.opening import open_connection
from aerokit.errors import CommandRejected
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal, SimulatedPx4, simulated_link

pytestmark = pytest.mark.anyio

NAN = float("nan")
START = MavCmd.IMAGE_START_CAPTURE


class Fleet(NamedTuple):
    cameras: list[SimulatedCamera]
    gimbals: list[SimulatedGimbal]
    one: aerokit.Vehicle
    two: aerokit.Vehicle
    connection: Connection


@asynccontextmanager
async def fleet() -> AsyncIterator[Fleet]:
    """A copter and a PX4, each with a camera and a gimbal with equal component ids."""
    gimbals = [SimulatedGimbal(), SimulatedGimbal()]
    cameras = [SimulatedCamera(gimbal=gimbal) for gimbal in gimbals]
    copter = SimulatedCopter(system_id=1, boot_time_s=0.0, components=[cameras[0], gimbals[0]])
    px4 = SimulatedPx4(system_id=2, boot_time_s=1.0, components=[cameras[1], gimbals[1]])
    async with (
        simulated_link([copter, px4]) as link,
        open_connection(link) as connection,
        aerokit.connect(connection, system_id=1) as one,
        aerokit.connect(connection, system_id=2) as two,
    ):
        yield Fleet(cameras, gimbals, one, two, connection)


async def test_take_photo_of_component_camera() -> None:
    async with fleet() as devices:
        with (
            devices.one.subscribe(m.CameraImageCaptured, capacity=10) as mine,
            devices.two.subscribe(m.CameraImageCaptured, capacity=10) as others,
        ):
            await devices.one.command(START, 0, 0, 1, component_id=100)
            with anyio.fail_after(2.0):
                image = await mine.get()
            assert image.image_index == 0
            await anyio.sleep(1.0)
            assert others.get_nowait() is None
        assert [camera.image_count for camera in devices.cameras] == [1, 0]


async def test_cameras_answer_their_own_program() -> None:
    async with fleet() as devices:
        devices.cameras[1].faults.refuse(START, MavResult.TEMPORARILY_REJECTED)

        async def order(vehicle: aerokit.Vehicle, results: list[int]) -> None:
            try:
                ack = await vehicle.command(START, 0, 0, 1, component_id=100)
            except CommandRejected as error:
                results.append(error.result)
            else:
                results.append(ack.result)

        one: list[int] = []
        two: list[int] = []
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(order, devices.one, one)
            tasks.start_soon(order, devices.two, two)
        assert (one, two) == ([MavResult.ACCEPTED], [MavResult.TEMPORARILY_REJECTED])


async def test_autopilot_and_camera_requests_run_concurrently() -> None:
    """The same command to two components: acknowledgements are matched by component."""
    async with fleet() as devices:
        information = m.CameraInformation.ID

        async def ask_the_camera() -> None:
            await devices.one.command(MavCmd.REQUEST_MESSAGE, information, component_id=100)

        async def ask_the_autopilot() -> None:
            with pytest.raises(CommandRejected):
                await devices.one.command(MavCmd.REQUEST_MESSAGE, m.StorageInformation.ID)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(ask_the_autopilot)
            tasks.start_soon(ask_the_camera)


async def test_format_storage_reports_progress() -> None:
    async with fleet() as devices:
        percents: list[int | None] = []
        await devices.two.command(
            MavCmd.STORAGE_FORMAT, 1, 1, component_id=100, on_progress=percents.append, attempt_timeout=3.0
        )
        assert percents == [None, 25, 50, 75]  # devices without a progress value send 0


async def test_gimbal_obeys_its_controller() -> None:
    async with fleet() as devices:
        point = MavCmd.DO_GIMBAL_MANAGER_PITCHYAW
        with pytest.raises(CommandRejected) as refusal:
            await devices.two.command(point, -30, 0, NAN, NAN, component_id=154)
        assert refusal.value.result == MavResult.DENIED
        await devices.two.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, -2, -2, -1, -1, component_id=154)
        await devices.two.command(point, -30, 0, NAN, NAN, component_id=154)
        await anyio.sleep(1.0)
        assert [round(gimbal.angles()[1], 2) for gimbal in devices.gimbals] == [0.0, -0.52]


async def test_devices_do_not_change_vehicle_state() -> None:
    async with fleet() as devices:
        await devices.one.wait_ready()
        await devices.two.wait_ready()
        devices.cameras[0].send_text(4, "lens cap")
        await devices.one.command(START, 0, 0.5, 0, component_id=100)
        await devices.one.set_mode("GUIDED")
        await devices.one.arm()
        await devices.one.take_off(5.0)
        assert devices.one.is_armed
        assert not devices.two.is_armed
        assert devices.one.component_id == 1
        assert devices.cameras[0].image_count > 5
        last = devices.cameras[0].captures.images[-1]
        assert last.relative_alt > 3000
