"""The DroneKit 2.9.2 client of ``transfers.py``, with the alias that it needs since Python 3.10.

DroneKit cannot transfer files. It downloads the parameters in ``connect``; their time counts from the request, without
the wait for a heartbeat. Missions are transferred when the vehicle object is ready, as DroneKit's guide describes.
"""

from __future__ import annotations

import collections
import collections.abc
import importlib
import logging
import os
from typing import Any

os.environ["MAVLINK20"] = "1"

from client import Task, run
from content import LIMIT_S, mission_items

collections.MutableMapping = collections.abc.MutableMapping  # type: ignore[attr-defined]


def perform(task: Task) -> Any:
    """Connect, then transfer. Only the transfer is timed."""
    dronekit: Any = importlib.import_module("dronekit")
    logging.disable(logging.CRITICAL)
    vehicle = dronekit.connect(task.address, _initialize=False)
    fetch_all = vehicle._master.param_fetch_all
    begun: list[bool] = []

    def begin_and_fetch_all() -> None:
        if not begun:
            begun.append(True)
            task.begin()
        fetch_all()

    vehicle._master.param_fetch_all = begin_and_fetch_all
    vehicle.initialize(rate=None, heartbeat_timeout=30)
    vehicle.wait_ready("parameters", timeout=LIMIT_S)
    if task.name == "parameters":
        return {name: value for name, value in vehicle.parameters.items() if value is not None}
    task.begin()
    return _upload(vehicle, task) if task.name == "mission_upload" else _download(vehicle)


def _upload(vehicle: Any, task: Task) -> None:
    follow_up_command: Any = importlib.import_module("dronekit").Command
    commands = vehicle.commands
    commands.clear()
    for command, frame, p1, p2, p3, p4, x, y, z in [mission_items(1)[0], *mission_items(task.size)]:
        commands.add(follow_up_command(0, 0, 0, frame, command, 0, 1, p1, p2, p3, p4, x * 1e-7, y * 1e-7, z))
    commands.upload(timeout=LIMIT_S)


def _download(vehicle: Any) -> list[Any]:
    commands = vehicle.commands
    commands.download()
    commands.wait_ready(timeout=LIMIT_S)
    return [
        (command.command, command.frame, command.param1, command.param2, command.param3, command.param4,
         round(command.x * 1e7), round(command.y * 1e7), command.z)
        for command in commands
    ]  # fmt: skip


if __name__ == "__main__":
    run(perform)
