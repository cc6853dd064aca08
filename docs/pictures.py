"""Draws docs/images: the true tracks of the demonstration and the examples, terminals, the served page, a report.

python docs/pictures.py [NAME …]        or: nox -s pictures

Flights run on virtual time, or on a socket for blocking programs.
"""

from __future__ import annotations

import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from screen_pictures import take_monitor, take_page, take_report
from terminal_picture import draw_terminal

from aerokit.sim import HOME, SimulatedCamera, SimulatedCopter, simulated_link
from aerokit.testing import run_virtual, serve_flight
from aerokit.testing.picture import save_picture
from aerokit.testing.track import Track, record_track

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs" / "images"
MAX_POINTS = 400
"""Maximum number of points of a track in a picture; more would not be visible."""
SPEEDUP = 20.0

ON_VIRTUAL_TIME: dict[str, list[Any]] = {
    "fly_square": [],
    "guided_velocity": [],
    "land_on_low_battery": [95.0],
    "mission": [],
    "survey_photos": [],
    "two_vehicles": [],
}
"""Maps the name of an example to the arguments of ``main`` after the address."""
ON_A_SOCKET: dict[str, list[str]] = {
    "blocking_hello": ["{address}"],
    "blocking_messages": ["{address}"],
    "dronekit/simple_goto": ["--connect", "{address}"],
    "dronekit/basic_mission": ["--connect", "{address}"],
    "dronekit/guided_velocity_and_yaw": ["--seconds", "0.2", "--altitude", "5", "--connect", "{address}"],
}
"""Maps the name of an example to the arguments of the program."""


def main(names: list[str]) -> None:
    """Draw the named pictures, or all."""
    makers: dict[str, Callable[[], None]] = {"demo": draw_demo}
    makers |= {name: partial(fly_on_virtual_time, name) for name in ON_VIRTUAL_TIME}
    makers |= {name: partial(fly_on_a_socket, name) for name in ON_A_SOCKET}
    screens = IMAGES / "screens"
    makers["monitor"] = partial(take_monitor, IMAGES / "monitor.svg", screens / "monitor-wide.svg")
    makers["report"] = partial(take_report, IMAGES / "report.png", screens / "report.png", screens / "report-phone.png")
    makers["serve"] = partial(
        take_page, IMAGES / "serve.png", screens / "serve-flying.png", screens / "serve-phone.png"
    )
    for name in names or makers:
        makers[name]()


def draw_demo() -> None:
    """Draw the flight and the terminal of ``aerokit demo``."""
    with tempfile.TemporaryDirectory() as folder, serve_flight(speedup=1.0) as flight:
        output = run([sys.executable, "-m", "aerokit", "demo", "--connect", flight.address], folder)
        draw([flight.track], "demo")
    lines = [line for line in output.splitlines() if not line.startswith("connecting")]
    (IMAGES / "terminal.svg").write_text(draw_terminal("aerokit demo", lines), encoding="utf-8")


def fly_on_virtual_time(name: str) -> None:
    """Draw an example with a coroutine ``main``."""
    example = runpy.run_path(str(ROOT / "examples" / f"{name}.py"))
    has_camera = name == "survey_photos"
    latitude_deg, longitude_deg, altitude_m = HOME
    copters = [
        SimulatedCopter(
            system_id=number,
            boot_time_s=0.0,
            home=(latitude_deg, longitude_deg + 0.0001 * number, altitude_m),  # nine metres apart
            components=[SimulatedCamera()] if has_camera else [],
        )
        for number in ((1, 2) if name == "two_vehicles" else (1,))
    ]
    tracks = [record_track(copter) for copter in copters]

    async def fly() -> None:
        async with simulated_link(copters) as link:
            with tempfile.TemporaryDirectory() as folder:
                await example["main"](link, *([folder] if has_camera else ON_VIRTUAL_TIME[name]))

    run_virtual(fly())
    draw(tracks, name)


def fly_on_a_socket(name: str) -> None:
    """Draw an example that runs as a program."""
    is_classic = name.startswith("dronekit/")
    runner = ["-m", "aerokit.dronekit"] if is_classic else []
    with tempfile.TemporaryDirectory() as folder, serve_flight(speedup=SPEEDUP) as flight:
        arguments = [argument.format(address=flight.address) for argument in ON_A_SOCKET[name]]
        run([sys.executable, *runner, str(ROOT / "examples" / f"{name}.py"), *arguments], folder)
        draw([flight.track], name.replace("/", "-"))


def run(command: list[str], folder: str) -> str:
    """Run a program and return its output."""
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def draw(tracks: list[Track], name: str) -> None:
    """Save a picture of tracks, from above and with their altitudes over time."""
    thin = []
    for track in tracks:
        points = list(track)
        step = max(1, len(points) // MAX_POINTS)
        thin.append(Track(track.home, points[::step] + points[-1:], name=track.name))
    save_picture(thin, IMAGES / f"{name}.svg")


if __name__ == "__main__":
    main(sys.argv[1:])
