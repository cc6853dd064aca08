"""The MAVSDK client of ``transfers.py``, which uses the asyncio API.

The plugins are ``param``, ``mission_raw`` (``mission`` does not work with ArduPilot) and ``ftp`` with burst reads.
"""

# pyright: reportMissingImports=false
# MAVSDK is installed only by the nox session ``bench``.
from __future__ import annotations

import asyncio
import shutil
from pathlib import Path
from typing import Any

from client import Task, run
from content import DOWNLOAD_PATH, UPLOAD_PATH, items_with_home
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk


def perform(task: Task) -> Any:
    """Connect, then transfer. Only the transfer is timed."""
    return asyncio.run(_perform(task))


async def _perform(task: Task) -> Any:
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    mavsdk = Mavsdk(configuration)
    await mavsdk.add_any_connection(f"udpin://127.0.0.1:{task.port}")
    system = await mavsdk.first_autopilot(timeout_s=30.0)
    transfer = {
        "parameters": _parameters,
        "mission_upload": _mission_upload,
        "mission_download": _mission_download,
        "file_download": _file_download,
        "file_upload": _file_upload,
    }[task.name]
    return await transfer(system, task)


async def _parameters(system: Any, task: Task) -> dict[str, float]:
    from mavsdk.asyncio.plugins.param import ParamAsync

    plugin = ParamAsync(system)
    task.begin()
    parameters = await plugin.get_all_params()
    return {parameter.name: parameter.value for parameter in (*parameters.int_params, *parameters.float_params)}


async def _mission_upload(system: Any, task: Task) -> None:
    from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
    from mavsdk.plugins.mission_raw import MissionItem

    plugin = MissionRawAsync(system)
    items = []
    for seq, (command, frame, p1, p2, p3, p4, x, y, z) in enumerate(items_with_home(task.size)):
        current = 1 if seq == 0 else 0
        autocontinue = 1
        mission_type = 0
        items.append(MissionItem(seq, frame, command, current, autocontinue, p1, p2, p3, p4, x, y, z, mission_type))
    task.begin()
    await plugin.upload_mission(items)


async def _mission_download(system: Any, task: Task) -> list[Any]:
    from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync

    plugin = MissionRawAsync(system)
    task.begin()
    _home, *waypoints = await plugin.download_mission()
    return [
        (item.command, item.frame, item.param1, item.param2, item.param3, item.param4, item.x, item.y, item.z)
        for item in waypoints
    ]


async def _file_download(system: Any, task: Task) -> None:
    from mavsdk.asyncio.plugins.ftp import FtpAsync

    plugin = FtpAsync(system)
    task.begin()
    async for _ in plugin.download(DOWNLOAD_PATH, str(task.folder), use_burst=True):
        pass
    (task.folder / Path(DOWNLOAD_PATH).name).rename(task.folder / "out.bin")


async def _file_upload(system: Any, task: Task) -> None:
    from mavsdk.asyncio.plugins.ftp import FtpAsync

    plugin = FtpAsync(system)
    shutil.copy(task.folder / "in.bin", task.folder / Path(UPLOAD_PATH).name)
    task.begin()
    async for _ in plugin.upload(str(task.folder / Path(UPLOAD_PATH).name), str(Path(UPLOAD_PATH).parent)):
        pass


if __name__ == "__main__":
    run(perform)
