"""A simulated copter behind a lossy link, in a separate process: the vehicle of ``transfers.py``.

    python benchmarks/bad_vehicle.py TASK PORT LOSS SEED DELAY_S SIZE

The vehicle sends to this UDP port of this machine. Each frame is lost with the probability LOSS, in both directions.
The process prints ``ready``. When it reads a line ``dump FOLDER``, it writes the content of the vehicle to this folder:
``vehicle-parameters.json``, ``vehicle.json`` (the mission without home) and ``vehicle.bin`` (the uploaded file). It
runs until it is terminated.
"""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

from content import DOWNLOAD_PATH, PARAMETERS, UPLOAD_PATH, as_numbers, file_content, mission_items

from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionType
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedCopter, SimulatorServer
from aerokit.testing import FaultModel, FaultyLink
from aerokit.transport import create_link

__all__ = ["main"]

QUICK_PARAMETERS = 100
"""Number of parameters in a quick run, and for missions and files: DroneKit downloads all of them at first."""


def main(arguments: list[str]) -> None:
    """Serve until the process is terminated."""
    task, port, loss, seed, delay_s, size = arguments
    faults = FaultModel(loss=float(loss), delay_s=float(delay_s))
    radio = FaultyLink(create_link(f"udpout:127.0.0.1:{port}"), faults, seed=int(seed))
    asyncio.run(_serve(radio, _copter(task, int(size))))


async def _serve(radio: FaultyLink, copter: SimulatedCopter) -> None:
    def on_line() -> None:
        line = sys.stdin.readline()
        if line:
            _dump(copter, Path(line.removeprefix("dump ").rstrip()))
            print("dumped", flush=True)

    async with SimulatorServer(copter, radio):
        asyncio.get_running_loop().add_reader(sys.stdin, on_line)
        print("ready", flush=True)
        await asyncio.Event().wait()


def _copter(task: str, size: int) -> SimulatedCopter:
    copter = SimulatedCopter(boot_time_s=0.0, parameter_count=None if task == "parameters" else QUICK_PARAMETERS)
    if task == "parameters":
        while len(copter.parameters) < PARAMETERS:
            copter.parameters.add(f"BENCH_{len(copter.parameters)}", 0.5)
    if task == "mission_download":
        home = MissionItem(MavCmd.NAV_WAYPOINT, MavFrame.GLOBAL)
        waypoints = [MissionItem(*item) for item in mission_items(size)]
        copter.missions.replace(MavMissionType.MISSION, [home, *waypoints])
    if task == "file_download":
        copter.files.put(DOWNLOAD_PATH, file_content(size))
    return copter


def _dump(copter: SimulatedCopter, folder: Path) -> None:
    values = {name: copter.parameters[name] for name in copter.parameters}
    (folder / "vehicle-parameters.json").write_text(json.dumps(values))
    _home, *waypoints = copter.missions.items(MavMissionType.MISSION)
    (folder / "vehicle.json").write_text(json.dumps([as_numbers(item) for item in waypoints]))
    if UPLOAD_PATH in copter.files:
        (folder / "vehicle.bin").write_bytes(copter.files.get(UPLOAD_PATH))


if __name__ == "__main__":
    main(sys.argv[1:])
