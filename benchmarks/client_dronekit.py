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
from content import LIMIT_S, items_with_home

collections.MutableMapping = collections.abc.MutableMapping  # type: ignore[attr-defined]


def perform(task: Task) -> Any:
    """Connect, then transfer. Only the transfer is timed."""
    dronekit: Any = importlib.import_module("dronekit")
    logging.disable(logging.CRITICAL)
    vehicle = dronekit.connect(task.address, _initialize=False)
    fetch_all = vehicle._master.param_fetch_all
    has_begun = False

    def begin_and_fetch_all() -> None:  # DroneKit itself calls this while it connects, and may repeat the call
        nonlocal has_begun
        if not has_begun:
            has_begun = True
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
    make_command: Any = importlib.import_module("dronekit").Command
    commands = vehicle.commands
    commands.clear()
    for command, frame, p1, p2, p3, p4, x, y, z in items_with_home(task.size):
        commands.add(make_command(
            target_system=0, target_component=0, seq=0, frame=frame, command=command, current=0, autocontinue=1,
            param1=p1, param2=p2, param3=p3, param4=p4, x=x * 1e-7, y=y * 1e-7, z=z,
        ))  # fmt: skip
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
