"""MAVProxy uses a component of aerokit: commands, parameters, files, missions.

``python with_mavproxy_component.py``; prints a line for each step that is done and ends with 0 when all are.
"""

# ruff: noqa: T201
from __future__ import annotations

import asyncio
import os
import tempfile
import threading
from pathlib import Path
from typing import Any

from fly import free_port
from steps import wait_for
from with_mavproxy import Console, write_mission

import aerokit
from aerokit.enums import MavAutopilot, MavCmd, MavType
from aerokit.onboard import CommandRequest, OnboardComponent


class Served:
    """A component with a command, two parameters, a file and missions, in a thread."""

    def __init__(self, port: int, folder: Path) -> None:
        self.component: OnboardComponent
        self.dropped_from_m: float | None = None
        self._ready, self._end = threading.Event(), asyncio.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(port, folder)))
        self._thread.start()
        self._ready.wait(10)

    async def _serve(self, port: int, folder: Path) -> None:
        self._loop = asyncio.get_running_loop()
        kind: dict[str, Any] = {"component_id": 1, "type": MavType.QUADROTOR, "autopilot": MavAutopilot.GENERIC}
        kind["bytewise"] = False  # MAVProxy casts integers to float.
        async with aerokit.component(f"udpout:127.0.0.1:{port}", **kind) as component:
            self.component = component

            @component.command(MavCmd.USER_1)
            async def drop(_: CommandRequest, height_m: float) -> None:
                self.dropped_from_m = height_m

            component.parameters.add("LINE_SPEED", 1.5, minimum=0.5, maximum=3.0)
            component.parameters.add("SPOOL", 1)
            component.serve_files(folder, writable=True)
            component.missions.on_upload(lambda _kind, _items: None)
            self._ready.set()
            await self._end.wait()

    def end(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()


def done(name: str) -> None:
    print(f"done\t{name}", flush=True)


def use(console: Console, served: Served, folder: Path) -> None:
    console.wait(r"Detected vehicle|online system 1|Received \d+ parameters")
    done("connect")
    console.command_until_accepted("param fetch", r"Received 2 parameters", 4, 20.0)
    done("parameters")
    console.type("param set LINE_SPEED 2.5")
    wait_for(lambda: served.component.parameters["LINE_SPEED"] == 2.5, f"LINE_SPEED: {console.answer}", 20.0)
    console.type("param set SPOOL 3")
    wait_for(lambda: served.component.parameters["SPOOL"] == 3, f"SPOOL: {console.answer}", 20.0)
    done("set")
    console.command_until_accepted("long USER_1 12.5", r"USER_1: ACCEPTED", 4, 5.0)
    assert served.dropped_from_m == 12.5
    console.command_until_accepted("long USER_2 1", r"USER_2: UNSUPPORTED", 4, 5.0)
    done("commands")
    console.command_until_accepted("ftp list /", r"picture\.jpg", 4, 5.0)
    console.command_until_accepted("ftp get /picture.jpg copy.jpg", r"(?i)wrote|got|done", 4, 10.0)
    wait_for(lambda: Path("copy.jpg").read_bytes() == (folder / "picture.jpg").read_bytes(), "the file", 20.0)
    done("files")
    count = write_mission("copter", Path("flight.txt"))
    console.command_until_accepted("wp load flight.txt", rf"Loaded {count} waypoints in ", 4, 10.0)
    wait_for(lambda: len(served.component.missions.items()) == count, "the mission", 20.0)
    console.command_until_accepted("wp list", r"Saved waypoints to ", 4, 10.0)
    done("missions")


def main() -> None:
    port = free_port()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "served"
        folder.mkdir()
        (folder / "picture.jpg").write_bytes(bytes(range(256)) * 20)
        os.chdir(place)
        served = Served(port, folder)
        try:
            console = Console(port)
            try:
                use(console, served, folder)
            finally:
                console.end()
        finally:
            served.end()


if __name__ == "__main__":
    main()
