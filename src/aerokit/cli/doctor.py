"""``aerokit doctor``: what keeps this computer and a vehicle apart, and what to do about it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.cli.doctor_computer import (
    USUAL_PORTS,
    check_installation,
    check_network_port,
    check_serial_port,
)
from aerokit.cli.exits import DONE, FAILED, NOTHING_HEARD
from aerokit.cli.findings import Finding, Level, tell_finding
from aerokit.cli.link_command import add_link, add_seconds, opened
from aerokit.cli.waiting import waiting
from aerokit.errors import AerokitError, LinkOpenError
from aerokit.links import LinkAddress, parse_address
from aerokit.links.local_ports import serial_ports

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

__all__ = ["add_arguments", "run_doctor"]

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
    from aerokit.cli.doctor_link import LinkExamination

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
    from aerokit.cli.baud_rates import BAUD_RATES, listen_at

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
