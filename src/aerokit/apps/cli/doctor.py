"""``aerokit doctor``: checks of this computer and of a link, with suggestions."""

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

from aerokit.apps.cli.connecting import add_link, add_seconds, opened
from aerokit.apps.cli.doctor_link import BAUD_RATES, Finding, Level, LinkExamination, emit_finding, listen_at
from aerokit.apps.cli.output import DONE, FAILED, NO_VEHICLE
from aerokit.apps.cli.terminal import showing_countdown
from aerokit.errors import AerokitError, LinkOpenError
from aerokit.transport import LinkAddress, parse_address
from aerokit.transport.sockets import port_bind_error, serial_ports

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator

_DISTRIBUTION = "aerokit-mavlink"

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
"""Maps extras to their modules. A test compares them with pyproject.toml."""

_COMMON_UDP_PORTS = {
    14550: "the port of ground stations such as QGroundControl and MAVProxy",
    14540: "PX4's simulator sends to it",
}
_COMMON_TCP_PORTS = {5760: "ArduPilot's simulator listens on it"}
# How long to listen at each baud rate: long enough for two heartbeats.
BAUD_RATE_TIMEOUT_S = 2.5


def check_installation() -> Iterator[Finding]:
    import aerokit
    from aerokit._internal.imports import installation_problem
    from aerokit._internal.wire import wire_implementation

    where = f"Python {platform.python_version()} on {platform.platform(terse=True)}, in {Path(aerokit.__file__).parent}"
    yield Finding("ok", "aerokit", f"{aerokit.__version__}, {where}")
    wire = "compiled" if wire_implementation == "c" else "Python (slower; see docs/benchmarks.md)"
    yield Finding("ok", "wire", wire)
    if problem := installation_problem(aerokit.__path__[0]):
        yield Finding("problem", "installation", problem, "uninstall both, then install aerokit-mavlink again")
    try:
        requires(_DISTRIBUTION)
    except PackageNotFoundError:
        yield Finding("note", "installation", f"not installed as {_DISTRIBUTION}; running from source")
    missing_modules = {extra: [name for name in names if not find_spec(name)] for extra, names in EXTRAS.items()}
    installed = ", ".join(extra for extra, missing in missing_modules.items() if not missing) or "none"
    yield Finding("ok", "extras", f"installed: {installed}")
    for extra, missing in missing_modules.items():
        if missing:
            text = f"{extra} is incomplete: {', '.join(missing)} not installed"
            yield Finding("note", "extras", text, f"to use it: pip install '{_DISTRIBUTION}[{extra}]'")


def check_serial_port(device: str, description: str = "") -> Finding:
    # The port is not opened, because opening it toggles DTR, which resets some boards.
    name = f"{device} ({description})" if description and description != "n/a" else device
    if os.name == "posix" and os.path.exists(device) and not os.access(device, os.R_OK | os.W_OK):
        return Finding("problem", "serial port", f"{name}: permission denied", _permission_advice(device))
    if programs := _programs_using(device):
        return Finding(
            "problem",
            "serial port",
            f"{name}: in use by {', '.join(programs)}",
            "close that program, or let it forward MAVLink by UDP",
        )
    return Finding("ok", "serial port", f"{name}: available", f"try: aerokit doctor {device}")


def _programs_using(device: str) -> list[str]:
    """Return the names of other programs that have opened the port.

    Only root can see programs of other users.
    """
    programs: list[str] = []
    if sys.platform != "linux" or os.path.realpath(device).startswith("/dev/pts/"):
        return programs  # a pseudo-terminal is always open in the program that created it
    for process in glob("/proc/[0-9]*"):
        process_id = int(Path(process).name)
        if process_id == os.getpid():
            continue
        try:
            open_files = {os.readlink(f"{process}/fd/{descriptor}") for descriptor in os.listdir(f"{process}/fd")}
            if os.path.realpath(device) in open_files:
                programs.append(f"{Path(process, 'comm').read_text().strip()} (process {process_id})")
        except OSError:  # the process belongs to another user, or has ended
            continue
    return programs


def _permission_advice(device: str) -> str:
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
    name = f"{'UDP' if udp else 'TCP'} port {port}"
    error = port_bind_error("0.0.0.0" if udp else "127.0.0.1", port, udp=udp)
    if error is None:
        return Finding("ok", name, f"free ({meaning})")
    if error.errno != errno.EADDRINUSE:
        return Finding("note", name, f"cannot be checked: {error.strerror or error}")
    if not udp:
        return Finding("ok", name, f"a program listens on it ({meaning})", f"try: aerokit doctor tcp:127.0.0.1:{port}")
    return Finding(
        "note",
        name,
        f"in use by another program ({meaning})",
        f"close that program before you use udpin:0.0.0.0:{port}, or let it forward to another port",
    )


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=run_doctor)
    add_link(command, default_text="check this computer")
    add_seconds(command, "listen for S seconds (default: 6)", default=6.0)


async def run_doctor(options: argparse.Namespace) -> int:
    levels: set[Level] = set()

    def report(finding: Finding) -> None:
        levels.add(finding.level)
        emit_finding(options, finding)

    if options.address is None:
        _check_computer(report)
    elif not await _check_link(options, report):
        return NO_VEHICLE
    return FAILED if "problem" in levels else DONE


def _check_computer(report: Callable[[Finding], None]) -> None:
    for finding in check_installation():
        report(finding)
    ports = serial_ports()
    for port in ports:
        report(check_serial_port(port.device, port.description))
    if not ports:
        advice = (
            "check that the device is plugged in, and that the USB cable has data lines; pass the port through to a"
            " virtual machine or container"
        )
        report(Finding("note", "serial ports", "none found", advice))
    for purposes, is_udp in ((_COMMON_UDP_PORTS, True), (_COMMON_TCP_PORTS, False)):
        for number, purpose in purposes.items():
            report(check_network_port(number, purpose, udp=is_udp))
    report(Finding("ok", "next", "only this computer was checked", "check a link: aerokit doctor ADDRESS"))


async def _check_link(options: argparse.Namespace, report: Callable[[Finding], None]) -> bool:
    """Report findings about the link. Return False if it is silent or cannot be opened."""
    parsed = parse_address(options.address) if isinstance(options.address, str) else None
    if parsed is not None and parsed.kind == "serial":
        configured_baud = parsed.baud or options.baud
        baud = await _find_baud_rate(options, parsed.device, configured_baud, report)
        options.address = str(LinkAddress("serial", device=parsed.device, baud=baud, options=parsed.options))
    try:
        async with opened(options) as connection:
            examination = LinkExamination(connection)
            async with showing_countdown(options, connection.link.address, options.seconds, what="messages"):
                await anyio.sleep(options.seconds)
            for finding in examination.findings():
                report(finding)
            try:
                connection.raise_if_ended()
            except AerokitError as error:
                report(Finding("problem", "link", str(error)))
            return not examination.is_silent
    except LinkOpenError as error:
        report(Finding("problem", "link", str(error)))
        return False


async def _find_baud_rate(
    options: argparse.Namespace, device: str, configured_baud: int, report: Callable[[Finding], None]
) -> int:
    """Return the baud rate at which MAVLink is received; ``configured_baud`` if there is none."""
    port_finding = check_serial_port(device)
    if port_finding.level != "ok":
        report(port_finding)
    probes = []
    for rate in dict.fromkeys((configured_baud, *BAUD_RATES)):
        async with showing_countdown(options, f"{device} at {rate}", BAUD_RATE_TIMEOUT_S, what="MAVLink"):
            try:
                probe = await listen_at(device, rate, BAUD_RATE_TIMEOUT_S)
            except AerokitError:  # reported later, when the link is opened
                return configured_baud
        if probe.is_mavlink:
            report(_baud_finding(device, rate, configured_baud))
            return rate
        probes.append(probe)
        if probe.bytes == 0:
            break  # nothing was received, so the other rates would receive nothing either
    rates = ", ".join(f"{probe.baud}: {probe.bytes} bytes" for probe in probes)
    report(Finding("note", "baud rate", f"no MAVLink on {device} at any rate tried ({rates})"))
    return configured_baud


def _baud_finding(device: str, rate: int, configured: int) -> Finding:
    if rate == configured:
        return Finding("ok", "baud rate", f"{device} receives MAVLink at {rate}")
    text = f"{device} receives MAVLink at {rate}, not at {configured}"
    return Finding("problem", "baud rate", text, f"use {device},{rate}")
