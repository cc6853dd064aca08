"""A simulated copter behind a bad radio, in a process of its own: who ``transfers.py`` makes all libraries talk to.

    python benchmarks/bad_vehicle.py TASK PORT LOSS SEED DELAY_S SIZE

It sends to this UDP port of this machine. Each frame is lost with the same probability in both directions. It says
``ready``, and on a line ``dump FOLDER`` it writes what it holds: ``vehicle-parameters.json``, ``vehicle.json`` (its
mission, without home) and ``vehicle.bin`` (the uploaded file). It ends when it is terminated.
"""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

from aerokit.links import FaultModel, FaultyLink, create_link
from aerokit.sim import SimulatedCopter, SimulatorServer

__all__ = ["main"]


def main(arguments: list[str]) -> None:
    """Serve until the process is ended."""
    task, port, loss, seed, delay_s, size = arguments
    bad = FaultModel(loss=float(loss), delay_s=float(delay_s))
    radio = FaultyLink(create_link(f"udpout:127.0.0.1:{port}"), bad, seed=int(seed))
    asyncio.run(_serve(radio, _copter(task, int(size))))


async def _serve(radio: FaultyLink, copter: SimulatedCopter) -> None:
    def on_line() -> None:
        words = sys.stdin.readline().split()
        if words:
            _dump(copter, Path(words[1]))
            print("dumped", flush=True)

    async with SimulatorServer(copter, radio):
        asyncio.get_running_loop().add_reader(sys.stdin, on_line)
        print("ready", flush=True)
        await asyncio.Event().wait()


def _copter(task: str, size: int) -> SimulatedCopter:
    copter = SimulatedCopter(boot_time_s=0.0)
    if task == "mission_download":
        pass
    if task == "file_download":
        pass
    return copter


def _dump(copter: SimulatedCopter, folder: Path) -> None:
    values = {name: copter.parameters[name] for name in copter.parameters}
    (folder / "vehicle-parameters.json").write_text(json.dumps(values))


if __name__ == "__main__":
    main(sys.argv[1:])
