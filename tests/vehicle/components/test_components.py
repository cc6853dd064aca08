"""Components other than the autopilot: discovery, commands, messages, metadata."""

from __future__ import annotations

import json
import lzma
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import pytest

import aerokit
from aerokit import messages as m
from aerokit.connection.connection import Connection
from aerokit.connection.opening import open_connection
from aerokit.errors import (
    CommandRejected,
    FileFormatError,
    InvalidArgument,
    NotSupported,
    OperationTimeout,
)
from aerokit.events import ComponentFound, StreamSlow, VehicleFound
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal, SimulatedPx4, simulated_link
from aerokit.vehicle.components.component import Component

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def on_board(*components: SimulatedCamera | SimulatedGimbal) -> AsyncIterator[aerokit.Vehicle]:
    copter = SimulatedCopter(boot_time_s=0.0, components=components)
    async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
        await anyio.sleep(1.5)
        yield vehicle


async def test_components_are_listed_with_kind_and_age() -> None:
    async with on_board(SimulatedCamera(), SimulatedCamera(101), SimulatedGimbal()) as vehicle:
        reported = vehicle.components.value
        assert [(event.component_id, event.device_id, event.kind) for event in reported] == [
            (1, 0, "autopilot"),
            (100, 0, "camera"),
            (101, 0, "camera"),
            (154, 0, "gimbal"),
        ]
        assert all(0 <= vehicle.connection.now() - event.received_at <= 1.5 for event in reported)


async def test_new_component_is_added_to_the_list() -> None:
    camera = SimulatedCamera()
    camera.faults.silent = True
    async with on_board(camera) as vehicle:
        assert [component.kind for component in vehicle.components.value] == ["autopilot"]
        assert vehicle.component(100).is_silent
        assert vehicle.component(100).kind == "unknown"
        camera.faults.silent = False
        reported = await vehicle.components.wait_until(lambda reported: len(reported) == 2, timeout=3)
        assert reported[1].kind == vehicle.component(100).kind == "camera"
        assert not vehicle.component(100).is_silent


async def test_devices_attached_to_autopilot_are_listed() -> None:
    async with on_board() as vehicle:
        assert [component.device_id for component in vehicle.components.value] == [0]
        source = m.GimbalDeviceAttitudeStatus(0, 0, 0, 0, (1.0, 0.0, 0.0, 0.0), 0, 0, 0, 0)
        assert source.gimbal_device_id == 0
    device = m.GimbalDeviceAttitudeStatus(0, 0, 0, 0, (1.0, 0.0, 0.0, 0.0), 0, 0, 0, 0, gimbal_device_id=2)
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
        assert len(vehicle.components.value) == 1
        copter.send(device)
        reported = await vehicle.components.wait_until(lambda reported: len(reported) == 2, timeout=3)
        assert (reported[1].component_id, reported[1].device_id, reported[1].kind) == (1, 2, "gimbal")


async def test_component_messages_at_requested_rate() -> None:
    async with on_board(SimulatedCamera(), SimulatedCamera(101)) as vehicle:
        with (
            vehicle.subscribe(StreamSlow, capacity=10) as slow,
            vehicle.component(101).subscribe(m.CameraCaptureStatus, capacity=100, rate_hz=5) as statuses,
        ):
            await anyio.sleep(8.0)
            came = []
            while (status := statuses.get_nowait()) is not None:
                came.append(status)
            assert slow.get_nowait() is None
        assert 35 <= len(came) <= 41
        assert {message.received_frame.component_id for message in came if message.received_frame} == {101}


async def test_message_cell_is_per_component() -> None:
    async with on_board(SimulatedCamera(), SimulatedCamera(101)) as vehicle:
        of_second = vehicle.component(101).message(m.CameraSettings, rate_hz=2)
        assert vehicle.component(101).message(m.CameraSettings) is of_second
        await vehicle.component(100).command(MavCmd.SET_CAMERA_ZOOM, 2, 30)
        await of_second.wait_until(lambda _: True, timeout=3)
        await anyio.sleep(2.0)
        assert of_second.value.zoomLevel == 0


async def test_slow_stream_warning_names_component() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        with vehicle.subscribe(StreamSlow, capacity=10) as slow:
            vehicle.component(100).message(m.CameraSettings, rate_hz=5)
            await anyio.sleep(1.0)
            camera.faults.silent = True
            with anyio.fail_after(20.0):
                event = await slow.get()
            assert isinstance(event, StreamSlow)
            assert event.component_id == 100


async def test_commands_and_requests_reach_the_component() -> None:
    camera = SimulatedCamera()
    async with on_board(camera, SimulatedCamera(101)) as vehicle:
        component = vehicle.component(100)
        assert (await component.command(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1)).result == MavResult.ACCEPTED
        information = await component.request(m.CameraInformation)
        assert information.received_frame is not None
        assert information.received_frame.component_id == 100
        with pytest.raises(CommandRejected) as caught:
            await component.request(m.ComponentInformationBasic)
        assert caught.value.result == MavResult.DENIED
        camera.faults.silent = True
        with pytest.raises(OperationTimeout, match="component 100 sent no CAMERA_INFORMATION"):
            await component.request(m.CameraInformation, timeout=2.0)


async def test_request_waits_for_a_late_answer_until_timeout() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        camera.faults.lose(m.CameraSettings, times=3)
        camera.call_later(6.0, lambda: camera.send(m.CameraSettings(time_boot_ms=7, mode_id=0)))
        answer = await vehicle.component(100).request(m.CameraSettings, timeout=10.0)
        assert answer.time_boot_ms == 7


async def test_lost_answer_is_requested_again() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        camera.faults.drop_incoming = 1
        assert (await vehicle.component(100).request(m.CameraInformation)).model_name.startswith(b"Simulated")


async def test_request_where_selects_the_message() -> None:
    async with on_board(SimulatedCamera(streams=["rtsp://127.0.0.1/a", "rtsp://127.0.0.1/b"])) as vehicle:
        stream = await vehicle.component(100).request(
            m.VideoStreamInformation, where=lambda stream_information: stream_information.stream_id == 2
        )
        assert stream.uri == "rtsp://127.0.0.1/b"


async def test_invalid_component_id_is_refused() -> None:
    async with on_board() as vehicle:
        for wrong in (0, 256, -1):
            with pytest.raises(InvalidArgument, match=f"component_id = {wrong} is not allowed: it must be 1 to 255"):
                vehicle.component(wrong)
        assert vehicle.component(100) is vehicle.component(100)


async def test_all_discovered_components_are_published() -> None:
    one = SimulatedCopter(system_id=1, boot_time_s=0.0, components=[SimulatedCamera()])
    two = SimulatedPx4(system_id=2, boot_time_s=1.0)
    async with simulated_link([one, two]) as link, open_connection(link) as connection:
        with connection.subscribe(VehicleFound, ComponentFound, capacity=10) as found:
            await anyio.sleep(2.5)
            reported = []
            while (event := found.get_nowait()) is not None:
                assert isinstance(event, VehicleFound | ComponentFound)
                reported.append((type(event), event.system_id, event.component_id))
        assert sorted(reported, key=lambda report: report[1:]) == [
            (VehicleFound, 1, 1),
            (ComponentFound, 1, 100),
            (VehicleFound, 2, 1),
        ]
        assert await first_vehicles(connection, 2) == [(1, 2, 3), (2, 2, 12)]


async def first_vehicles(connection: Connection, count: int) -> list[tuple[int, int, int]]:
    found = []
    with anyio.fail_after(5.0):
        async for vehicle in connection.vehicles():
            found.append((vehicle.system_id, vehicle.vehicle_type, vehicle.autopilot))
            if len(found) == count:
                return sorted(found)
    raise AssertionError("the connection goes on, and so does the search")


async def test_vehicle_search_continues_while_nothing_is_found() -> None:
    late = SimulatedPx4(system_id=2, boot_time_s=1.0)
    late.faults.silent = True
    copter = SimulatedCopter(boot_time_s=0.0)
    async with (
        simulated_link([copter, late]) as link,
        open_connection(link) as connection,
        anyio.create_task_group() as tasks,
    ):

        async def wake() -> None:
            await anyio.sleep(3.0)
            late.faults.silent = False

        tasks.start_soon(wake)
        assert [vehicle[0] for vehicle in await first_vehicles(connection, 2)] == [1, 2]


async def test_autopilot_is_a_component() -> None:
    async with on_board() as vehicle:
        autopilot = vehicle.component(vehicle.component_id)
        assert autopilot.kind == "autopilot"
        assert autopilot.files is vehicle.files
        assert autopilot.parameters is vehicle.parameters
        assert autopilot.message(m.Attitude) is vehicle.message(m.Attitude)


GENERAL = "/etc/extras/component_general.json.xz"
"""Address of PX4's general metadata."""


@asynccontextmanager
async def px4_with(files: dict[str, bytes]) -> AsyncIterator[Component]:
    px4 = SimulatedPx4(boot_time_s=1.0)
    for path, content in files.items():
        px4.files.put(path, content)
    async with simulated_link(px4) as link, aerokit.connect(link) as vehicle:
        yield vehicle.component(1)


def packed(content: object) -> bytes:
    return lzma.compress(json.dumps(content).encode())


async def test_metadata_is_read_by_mavftp() -> None:
    general = {"version": 1, "metadataTypes": [{"type": 1, "uri": "mftp://etc/extras/parameters.json"}, "?"]}
    parameters = {"version": 1, "parameters": []}
    files = {GENERAL: packed(general), "/etc/extras/parameters.json": json.dumps(parameters).encode()}
    async with px4_with(files) as component:
        assert await component.metadata() == general
        assert await component.metadata("parameter") == parameters
        with pytest.raises(NotSupported, match="no events metadata"):
            await component.metadata("events")


@pytest.mark.parametrize("content", [b"no JSON", b"[]", lzma.compress(b"{}")[:-5], b"[" * 100_000])
async def test_damaged_metadata_is_file_format_error(content: bytes) -> None:
    async with px4_with({GENERAL: content}) as component:
        with pytest.raises(FileFormatError, match="component_general"):
            await component.metadata()


async def test_metadata_with_damaged_list_is_file_format_error() -> None:
    async with px4_with({GENERAL: packed({"metadataTypes": {}})}) as component:
        with pytest.raises(FileFormatError, match="it has no list of files"):
            await component.metadata("parameter")


@pytest.mark.parametrize("uri", ["", "ftp://etc/parameters.json", "mftp://[;comp=0]etc/parameters.json"])
async def test_metadata_at_invalid_address_is_not_supported(uri: str) -> None:
    general = {"metadataTypes": [{"type": 1, "uri": uri}]}
    async with px4_with({GENERAL: packed(general)}) as component:
        with pytest.raises(NotSupported, match="uri = "):
            await component.metadata("parameter")


async def test_component_without_metadata_is_not_supported() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        with pytest.raises(NotSupported, match=r"component 100 reports no metadata: .*DENIED"):
            await vehicle.component(100).metadata()
        camera.faults.silent = True
        with pytest.raises(NotSupported, match="component 100 reports no metadata: component 100 sent no"):
            await vehicle.component(100).metadata()
