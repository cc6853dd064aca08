"""What ``aerokit doctor`` finds on this computer: the installation, serial ports, ports of the network."""

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

from aerokit.cli.findings import Finding
from aerokit.links.local_ports import network_port_error

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["USUAL_PORTS", "check_installation", "check_network_port", "check_serial_port"]

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
    from aerokit.installed import complaint

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
