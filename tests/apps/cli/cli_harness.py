"""Runs commands on virtual time, with an in-memory link in place of the address."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import anyio

from aerokit import messages as m
from aerokit.apps.cli.main import make_parser
from aerokit.apps.cli.output import DONE, emit_error, exit_code
from aerokit.errors import AerokitError
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedVehicle, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport.link import Link, memory_link_pair

DOCUMENT = Path(__file__).parents[3] / "docs" / "command-line.md"
MISSION = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.397742\t8.545594\t488\t1
1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t15\t1
2\t0\t3\t16\t0\t0\t0\t0\t47.398\t8.5456\t15\t1
3\t0\t3\t16\t0\t0\t0\t0\t47.398\t8.5460\t15\t1
4\t0\t3\t20\t0\t0\t0\t0\t0\t0\t0\t1
"""
HOME = (47.397742, 8.545594, 488.0)
GROUND_STATION = m.Heartbeat(6, 8, 0, 0, 4, 3)


async def run_on(link: Link | None, *arguments: str) -> int:
    """Run a command like ``main``, with this link as its address; return the exit code."""
    options = make_parser(arguments[0]).parse_args(arguments)
    if link is not None:
        setattr(options, "address" if hasattr(options, "address") else "connect", link)
    try:
        code: int = await options.run(options) or DONE
    except (AerokitError, OSError) as error:
        code = exit_code(error)
        emit_error(error, code, as_json=options.json)
    return code


def run_with(vehicles: SimulatedVehicle | Iterable[SimulatedVehicle], *commands: Iterable[str]) -> list[int]:
    """Run commands in sequence, each with a new link to the vehicles; return the exit codes."""

    async def run() -> list[int]:
        codes = []
        for arguments in commands:
            async with simulated_link(vehicles) as link:
                codes.append(await run_on(link, *arguments))
        return codes

    return run_virtual(run())


def run_on_messages(sources: Iterable[tuple[int, int, Message]], *arguments: str, noise: bytes = b"") -> int:
    """Run a command on a link that carries these messages once a second: system, component, message."""

    async def scenario() -> int:
        near, far = memory_link_pair()
        encoders = [(FrameEncoder(system, component), message) for system, component, message in sources]

        class Nobody:
            def bytes_received(self, data: bytes, peer: object) -> None:
                pass

            def link_lost(self, error: Exception) -> None:
                pass

        async def speak() -> None:
            await far.open(Nobody())
            while True:
                far.write(noise)
                for encoder, message in encoders:
                    far.write(encoder.encode(message))
                await anyio.sleep(1)

        speaking = asyncio.create_task(speak())
        try:
            return await run_on(near, *arguments)
        finally:
            speaking.cancel()
            far.close()

    return run_virtual(scenario())


def documented() -> Mapping[str, frozenset[str]]:
    """Return the fields of each record type, from the table in docs/command-line.md."""
    rows = {}
    for line in DOCUMENT.read_text(encoding="utf-8").partition("## JSON")[2].splitlines():
        cells = [each.strip() for each in line.strip("|").split("|")]
        if line.startswith("| `"):
            rows[cells[0].strip("`")] = frozenset(each.strip(" `") for each in cells[2].split(",") if each)
    return rows


def records(text: str) -> list[dict[str, Any]]:
    """Parse the printed records, and check each against the documented fields."""
    printed = [json.loads(line) for line in text.splitlines()]
    rows = documented()
    for record in printed:
        assert next(iter(record)) == "type"
        assert set(record) - {"type"} == rows[record["type"]], record
    return printed


async def wait_until(condition: Callable[[], object]) -> None:
    """Wait, on virtual time, until the condition is true."""
    while not condition():  # noqa: ASYNC110 - there is nothing to await
        await anyio.sleep(0.1)


def ctrl_c() -> None:
    """Send SIGINT, like the terminal."""
    signal.raise_signal(signal.SIGINT)
