"""The aerokit client of ``transfers.py``, which uses the public API.

The method ``auto`` uses MAVFTP if possible; ``list`` and ``items`` never do.
"""

from __future__ import annotations

import asyncio
from typing import Any

from client import Task, run
from content import DOWNLOAD_PATH, UPLOAD_PATH, as_numbers, mission_items

import aerokit
from aerokit.missions import Mission, MissionItem


def perform(task: Task) -> Any:
    """Connect, then transfer. Only the transfer is timed."""
    return asyncio.run(_perform(task))


async def _perform(task: Task) -> Any:
    async with aerokit.connect(task.address, rates={}) as vehicle:
        transfer = {
            "parameters": _parameters,
            "mission_upload": _mission_upload,
            "mission_download": _mission_download,
            "file_download": _file_download,
            "file_upload": _file_upload,
        }[task.name]
        task.begin()
        content = await transfer(vehicle, task)
        task.end()
        return content


async def _parameters(vehicle: Any, task: Task) -> dict[str, float]:
    return dict((await vehicle.parameters.download(method=task.method)).values_by_name())


async def _mission_upload(vehicle: Any, task: Task) -> None:
    items = [MissionItem(*item) for item in mission_items(task.size)]
    await vehicle.mission.upload(Mission(items), method=task.method)


async def _mission_download(vehicle: Any, task: Task) -> list[Any]:
    return [as_numbers(item) for item in await vehicle.mission.download(method=task.method)]


async def _file_download(vehicle: Any, task: Task) -> None:
    await vehicle.files.download(DOWNLOAD_PATH, task.folder / "out.bin")


async def _file_upload(vehicle: Any, task: Task) -> None:
    await vehicle.files.upload(task.folder / "in.bin", UPLOAD_PATH)


if __name__ == "__main__":
    run(perform)
