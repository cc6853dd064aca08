"""The examples of components, with a client on the other end of the link."""

from __future__ import annotations

import asyncio
import io
import json
import runpy
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from onboard_peers import Station
from PIL import Image

import aerokit
from aerokit.connection.opening import open_connection
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavResult, MavType
from aerokit.transport import Link, create_link, memory_link_pair

pytestmark = pytest.mark.anyio

EXAMPLES = Path(__file__).parents[2] / "examples"


@asynccontextmanager
async def running(name: str, *arguments: Any, link: Link, **options: Any) -> AsyncIterator[None]:
    main = runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]
    task = asyncio.ensure_future(main(link, *arguments, **options))
    await asyncio.sleep(0.1)
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def test_payload_lowers_parcel_and_keeps_parameters(tmp_path: Path) -> None:
    near, far = memory_link_pair()
    file = tmp_path / "payload.json"
    async with running("payload", str(file), link=near), open_connection(far) as connection:
        station = Station(connection, (1, 191))
        await station.ask(m.ParamSet(1, 191, "LINE_SPEED", 2.0, 9), m.ParamValue)
        with station.collecting(m.CommandAck) as acks:
            connection.send(station.command_long(MavCmd.USER_1, 10.0))
            await asyncio.sleep(6.0)
            connection.send(station.command_long(MavCmd.USER_1, 30.0))
            await asyncio.sleep(0.5)
    assert [ack.progress for ack in acks if ack.result == MavResult.IN_PROGRESS][:3] == [0, 0, 10]
    assert [ack.result for ack in acks][-2:] == [MavResult.ACCEPTED, MavResult.DENIED]
    assert json.loads(file.read_text())["LINE_SPEED"] == 2.0


async def test_landing_beacon_sends_targets(capsys: pytest.CaptureFixture[str]) -> None:
    near, far = memory_link_pair()
    async with open_connection(far) as connection:
        station = Station(connection, (1, 191))
        with station.collecting(m.LandingTarget) as targets:
            await runpy.run_path(str(EXAMPLES / "landing_beacon.py"))["main"](near)
    assert len(targets) == 100
    assert capsys.readouterr().out == "100 detections were sent\n"


async def test_arm_authorizer_denies_system_without_plan() -> None:
    near, far = memory_link_pair()
    async with running("arm_authorizer", link=near), open_connection(far) as connection:
        station = Station(connection, (1, 191))
        accepted = await station.command(MavCmd.ARM_AUTHORIZATION_REQUEST, 1)
        await asyncio.sleep(1.0)
        with station.collecting(m.CommandAck, m.Statustext) as received:
            connection.send(station.command_long(MavCmd.ARM_AUTHORIZATION_REQUEST, 2))
            await asyncio.sleep(1.0)
    assert (accepted.result, accepted.progress) == (MavResult.IN_PROGRESS, 255)
    assert received[-1].result == MavResult.DENIED
    assert any("no flight plan" in getattr(message, "text", "") for message in received)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_camera_server_takes_pictures_that_are_read(tmp_path: Path) -> None:
    link = create_link("udpin:127.0.0.1:0")
    kind, generic = MavType.QUADROTOR, MavAutopilot.GENERIC
    async with aerokit.component(link, component_id=1, type=kind, autopilot=generic) as autopilot:
        port = link.address.rpartition(":")[2]
        async with aerokit.connect(f"udpout:127.0.0.1:{port}", rates={}) as vehicle:
            main = runpy.run_path(str(EXAMPLES / "camera_server.py"))
            driver = main["VideoDevice"](main["PATTERN"], tmp_path)
            async with aerokit.component(
                connection=autopilot.connection, component_id=100, type=MavType.CAMERA
            ) as component:
                component.serve_files(tmp_path)
                component.add_camera(driver)
                capture = await vehicle.camera.take_photo(timeout=60.0)
                picture = await vehicle.camera.read_picture(capture)
    with Image.open(io.BytesIO(picture)) as image:
        assert image.size == (640, 480)
