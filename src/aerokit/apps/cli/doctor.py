"""``aerokit doctor``: what keeps this computer and a vehicle apart, and what to do about it."""

from __future__ import annotations

import errno
import os
import platform
import sys
from glob import glob
from importlib.metadata import PackageNotFoundError, requires
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import anyio

from aerokit.apps.cli.doctor_link import Finding, Level, tell_finding
from aerokit.apps.cli.link_command import add_link, add_seconds, opened
from aerokit.apps.cli.output import DONE, FAILED, NOTHING_HEARD
from aerokit.apps.cli.terminal import waiting
from aerokit.errors import AerokitError, LinkOpenError
from aerokit.transport import LinkAddress, parse_address
from aerokit.transport.sockets import network_port_error, serial_ports

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator

DISTRIBUTION = "aerokit-mavlink"

EXTRAS: dict[str, tuple[str, ...]] = {
    "completion": ("argcomplete",),
    "convert": ("gpxpy", "mcap", "pyarrow", "pyulog", "simplekml"),
    "foxglove": ("foxglove",),
    "monitor": ("textual",),
    "mqtt": ("paho",),
    "pictures": ("PIL",),
    "report": ("plotly", "pyulog"),
    "serve": ("starlette", "uvicorn", "websockets"),
    "testing": ("pytest",),
    "video": ("av", "numpy"),
    "zenoh": ("zenoh",),
}
"""Extra → the modules that come with it; compared with pyproject.toml by a test."""

USUAL_PORTS = (
    (14550, "ground stations listen there: QGroundControl and MAVProxy take it, too", True),
    (14540, "PX4's simulator sends to programs there", True),
    (5760, "ArduPilot's simulator listens there", False),
)
"""Number, what it is for, and whether it is of UDP."""


def check_installation() -> Iterator[Finding]:
    """The version, the extras, and whether files of the other aerokit are in between."""
    import aerokit
    from aerokit._internal.imports import complaint

    where = f"Python {platform.python_version()} on {platform.platform(terse=True)}, in {Path(aerokit.__file__).parent}"
    yield Finding("ok", "aerokit", f"{aerokit.__version__}, {where}")
    if mixed := complaint(aerokit.__path__[0]):
        yield Finding("problem", "installation", mixed, "uninstall both, and install aerokit-mavlink again")
    try:
        requires(DISTRIBUTION)
    except PackageNotFoundError:
        yield Finding("note", "installation", f"not installed as {DISTRIBUTION}: it runs from its sources")
    missing = {
        extra: lacking
        for extra, names in EXTRAS.items()
        if (lacking := [each for each in names if not find_spec(each)])
    }
    there = ", ".join(extra for extra in EXTRAS if extra not in missing) or "none"
    yield Finding("ok", "extras", f"installed: {there}")
    for extra, lacking in missing.items():
        text = f"{extra} is not whole: {', '.join(lacking)} not installed"
        yield Finding("note", "extras", text, f"if you want it: pip install '{DISTRIBUTION}[{extra}]'")


def check_serial_port(device: str, description: str = "") -> Finding:
    """Whether we may use a serial port, and who else does, as far as the system tells.

    It is not opened: that moves DTR, and resets some boards.
    """
    name = f"{device} ({description})" if description and description != "n/a" else device
    if os.name == "posix" and os.path.exists(device) and not os.access(device, os.R_OK | os.W_OK):
        return Finding("problem", "serial port", f"{name}: you may not use it", _how_to_be_allowed(device))
    if users := _users_of(device):
        return Finding(
            "problem",
            "serial port",
            f"{name}: {', '.join(users)} uses it",
            "close that program, or have it forward to us by UDP",
        )
    return Finding("ok", "serial port", f"{name} may be used", f"try: aerokit doctor {device}")


def _users_of(device: str) -> list[str]:
    """Names of the other programs that have it open; of other users' programs Linux tells root only."""
    users: list[str] = []
    if sys.platform != "linux" or os.path.realpath(device).startswith("/dev/pts/"):
        return users  # who made a pseudo-terminal keeps it open
    for process in glob("/proc/[0-9]*"):
        number = int(process.rpartition("/")[2])
        if number == os.getpid():
            continue
        try:
            opened = {os.readlink(f"{process}/fd/{each}") for each in os.listdir(f"{process}/fd")}
            if os.path.realpath(device) in opened:
                users.append(f"{Path(process, 'comm').read_text().strip()} (process {number})")
        except OSError:  # not ours to see, or it has ended
            continue
    return users


def _how_to_be_allowed(device: str) -> str:
    if sys.platform == "linux":
        import grp

        try:
            group = grp.getgrgid(os.stat(device).st_gid).gr_name
        except (KeyError, OSError):
            group = "dialout"
        if group != "root":
            return f"sudo usermod -aG {group} $USER, then log in again"
    return f"ask for read and write permission on {device}"


def check_network_port(port: int, meaning: str, *, udp: bool) -> Finding:
    """Whether somebody on this computer has a port of the network."""
    name = f"{'UDP' if udp else 'TCP'} port {port}"
    error = network_port_error("0.0.0.0" if udp else "127.0.0.1", port, udp=udp)
    if error is None:
        return Finding("ok", name, f"free ({meaning})")
    if error.errno != errno.EADDRINUSE:
        return Finding("note", name, f"cannot be tried: {error.strerror or error}")
    if not udp:
        return Finding(
            "ok", name, f"somebody listens ({meaning})", f"try: aerokit doctor tcp:127.0.0.1:{port}"
        )
    return Finding(
        "note",
        name,
        f"another program has it ({meaning})",
        f"close that program before udpin:0.0.0.0:{port} is used, or have it forward to another port",
    )


BAUD_S = 2.5
"""In so many seconds two heartbeats come."""


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_doctor)
    add_link(command, default="without it: this computer is looked at")
    add_seconds(command, "listen for so long (6)", 6.0)


async def run_doctor(options: argparse.Namespace) -> int:
    """Tell what was found; FAILED when something is to be mended, NOTHING_HEARD when nobody speaks on the link."""
    levels: set[Level] = set()

    def found(finding: Finding) -> None:
        levels.add(finding.level)
        tell_finding(options, finding)

    if options.address is None:
        _look_at_computer(found)
    elif not await _look_at_link(options, found):
        return NOTHING_HEARD
    return FAILED if "problem" in levels else DONE


def _look_at_computer(found: Callable[[Finding], None]) -> None:
    for finding in check_installation():
        found(finding)
    ports = serial_ports()
    for port in ports:
        found(check_serial_port(port.device, port.description))
    if not ports:
        do = "plugged in? some USB cables only charge; in a virtual machine or container the port must be passed on"
        found(Finding("note", "serial ports", "there are none", do))
    for number, meaning, udp in USUAL_PORTS:
        found(check_network_port(number, meaning, udp=udp))
    found(Finding("ok", "next", "this was about the computer only", "aerokit doctor ADDRESS looks at a link"))


async def _look_at_link(options: argparse.Namespace, found: Callable[[Finding], None]) -> bool:
    """Whether anybody was heard."""
    from aerokit.apps.cli.doctor_link import LinkExamination

    place = parse_address(options.address) if isinstance(options.address, str) else None
    if place is not None and place.kind == "serial":
        baud = await _find_baud_rate(options, place.device, place.baud or options.baud, found)
        options.address = str(LinkAddress("serial", device=place.device, baud=baud, options=place.options))
    try:
        async with opened(options) as connection:
            examination = LinkExamination(connection)
            async with waiting(options, connection.link.address, options.seconds, "what is heard"):
                await anyio.sleep(options.seconds)
            for finding in examination.findings():
                found(finding)
            try:
                connection.raise_if_ended()
            except AerokitError as error:
                found(Finding("problem", "link", str(error)))
            return not examination.is_silent
    except LinkOpenError as error:
        found(Finding("problem", "link", str(error)))
        return False


async def _find_baud_rate(
    options: argparse.Namespace, device: str, baud: int, found: Callable[[Finding], None]
) -> int:
    """The rate at which there is MAVLink; the one that was given when there is none."""
    from aerokit.apps.cli.doctor_link import BAUD_RATES, listen_at

    port = check_serial_port(device)
    if port.level != "ok":
        found(port)
    heard = []
    for rate in dict.fromkeys((baud, *BAUD_RATES)):
        async with waiting(options, f"{device} at {rate}", BAUD_S, "MAVLink"):
            try:
                listened = await listen_at(device, rate, BAUD_S)
            except AerokitError:  # told when it is opened for the rest
                return baud
        if listened.is_mavlink:
            found(_baud_finding(device, rate, baud))
            return rate
        heard.append(listened)
        if listened.bytes == 0:
            break  # a line on which nothing moves is as silent at other rates
    rates = ", ".join(f"{each.baud}: {each.bytes} bytes" for each in heard)
    found(Finding("note", "baud rate", f"no MAVLink on {device} at any rate tried ({rates})"))
    return baud


def _baud_finding(device: str, rate: int, given: int) -> Finding:
    if rate == given:
        return Finding("ok", "baud rate", f"MAVLink is heard on {device} at {rate}")
    text = f"MAVLink is heard on {device} at {rate}, not at {given}"
    return Finding("problem", "baud rate", text, f"use {device},{rate}")
