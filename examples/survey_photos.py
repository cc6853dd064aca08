"""Survey a field: fly lanes, take a picture every two seconds, and save them with their positions.

python examples/survey_photos.py                              # a simulated copter with a camera, in a few seconds
python examples/survey_photos.py udpin:0.0.0.0:14550 FOLDER   # your vehicle
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Any

import aerokit
from aerokit.sim import SimulatedCamera, SimulatedCopter, simulated_link
from aerokit.testing import run_virtual
from aerokit.vehicle.camera.capture import Capture, geotagged, write_captures

HEIGHT_M = 20.0
LENGTH_M = 40.0
LANE_M = 15.0
LANES = 3


async def main(address: Any, folder: str = "pictures") -> None:
    """Fly the lanes and read the pictures; pictures missed on a bad radio are requested again."""
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready()
        print((await vehicle.camera.wait_found()).model)
        start = vehicle.position.value
        await vehicle.arm()
        await vehicle.take_off(HEIGHT_M)
        async with vehicle.camera.photo_interval(2.0):
            for lane in range(LANES):
                flies_north = lane % 2 == 0
                for north_m in (0.0, LENGTH_M) if flies_north else (LENGTH_M, 0.0):
                    corner = start.offset(north_m=north_m, east_m=lane * LANE_M)
                    await vehicle.go_to(corner.replace(altitude_amsl_m=None, altitude_relative_m=HEIGHT_M))
        await vehicle.return_to_launch()
        captures = await vehicle.camera.load_captures()
        pictures = [await vehicle.camera.read_picture(capture) for capture in captures]
    save(Path(folder), captures, pictures)


def save(folder: Path, captures: list[Capture], pictures: list[bytes]) -> None:
    """Write geotagged pictures and captures.csv."""
    folder.mkdir(exist_ok=True)
    for capture, picture in zip(captures, pictures, strict=True):
        (folder / f"picture{capture.index:04d}.jpg").write_bytes(geotagged(picture, capture))
    write_captures(folder / "captures.csv", captures)
    print(f"{len(captures)} pictures are in {folder}")


async def simulated(folder: str = "pictures") -> None:
    """Fly on a simulated copter, on virtual time."""
    copter = SimulatedCopter(components=[SimulatedCamera()])
    async with simulated_link(copter) as link:
        await main(link, folder)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        asyncio.run(main(*sys.argv[1:3]))
    else:
        run_virtual(simulated())
