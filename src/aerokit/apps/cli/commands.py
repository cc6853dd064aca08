"""The table of commands: a row is all that a new one needs here; its module is imported when it is called."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse


@dataclass(frozen=True)
class Command:
    """``aerokit NAME``: ``aerokit.apps.cli.NAME`` has a function ``add_arguments(parser)``, which also sets ``run``.

    ``run`` is a coroutine function of the parsed options, which gives the exit code.
    """

    name: str
    help: str
    """A few words for the list of commands."""
    description: str
    """Sentences for its own ``--help``."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Have its module add its arguments."""
        import_module(f"aerokit.apps.cli.{self.name}").add_arguments(parser)


COMMANDS = (
    Command(
        "demo",
        "fly a square",
        "Take off, fly a square, come back and land: on a simulated vehicle, or on any vehicle with --connect."
        " Ctrl-C lands it where it is, a second Ctrl-C leaves it to itself.",
    ),
    Command("sim", "simulate vehicles", "Simulate vehicles for other programs, until interrupted."),
    Command(
        "status",
        "what is on a link",
        "Listen to a link and tell what is on it: systems and components, firmware, mode, GPS, battery, link, and what"
        " is missing for flight. Each vehicle is asked for what it does not tell by itself; nothing is ordered.",
    ),
    Command(
        "events",
        "what happens, as it comes",
        "Print what happens on a link and what the vehicles say, as it comes, until Ctrl-C.",
    ),
    Command(
        "doctor",
        "what keeps a vehicle from being heard",
        "Say what is wrong, and what to do: without ADDRESS on this computer (installation, serial ports, permissions,"
        " ports of the network), with one on a link (baud rate, protocol version, ids, signing, dialect, loss).",
    ),
    Command(
        "record",
        "record a telemetry log",
        "Record everything that comes over a link to a telemetry log (.tlog), until Ctrl-C.",
    ),
    Command(
        "hub",
        "join links into one network",
        "Pass MAVLink on between links (serial, UDP, TCP, several of each), by MAVLink's routing rules, until Ctrl-C."
        " Says nothing of its own.",
    ),
    Command(
        "monitor",
        "watch vehicles in the terminal",
        "Show the vehicles on a link in the terminal: state with ages, texts, message rates, link quality, a map."
        " Keys order hold, land and return after a question.",
    ),
    Command(
        "params",
        "parameters of a vehicle",
        "Read, set, save, load and compare the parameters of a vehicle.",
    ),
    Command(
        "mission",
        "missions of a vehicle",
        "Upload, download, show, check and clear missions, fences and rally points.",
    ),
    Command(
        "fly",
        "fly a plan from a file",
        "Upload a plan to a vehicle, arm it, fly the mission to its end and tell how it goes: on a vehicle, after a"
        " question, or with --sim on a simulated one. Ctrl-C has it return, a second Ctrl-C leaves it to itself.",
    ),
    Command("files", "files on a vehicle", "List, fetch and change files on a vehicle by MAVFTP."),
    Command("logs", "flight logs of a vehicle", "List, download and erase the flight logs of a vehicle."),
    Command("camera", "cameras of a vehicle", "Pictures, video, lens and storage of a vehicle's cameras."),
    Command(
        "serve",
        "vehicles in the browser",
        "Serve a page for the browser with map, state, missions, parameters and orders, and an HTTP and WebSocket"
        " API, until interrupted. Orders need the token that is printed.",
    ),
    Command("gimbal", "gimbals of a vehicle", "Say where a vehicle's gimbal points, and point it."),
    Command(
        "bridge",
        "vehicles for programs of others",
        "Show the vehicles on a link in a viewer (Foxglove), or put their states on a network (zenoh).",
    ),
    Command(
        "report",
        "what a flight log tells",
        "Write a flight log (.tlog, .bin, .ulg) as one HTML file that needs no network: summary, map, charts, failsafes"
        " and what led to them, parameters; or two flights compared.",
    ),
    Command(
        "convert",
        "flight logs in other formats",
        "Write a flight log (.tlog, .bin, .ulg) as MCAP for Foxglove, CSV, Parquet, GPX or KML.",
    ),
    Command(
        "completion",
        "completion for your shell",
        "Print a script for your shell, which then completes commands, options and names when you press Tab.",
    ),
)
